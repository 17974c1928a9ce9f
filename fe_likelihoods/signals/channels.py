"""Measured channels: what was measured (`Channel`), samples of several (`Measurements`), comparison with responses.

Values are always in SI units. The unit of a `Channel` is its display unit, used in labels and figures only. Each
channel is compared at the times at which it was measured; missing samples have residuals of NaN. The response is
interpolated there without a filter, even for channels sampled more coarsely: a filter would remove motion that the
sensor has measured, and the noise of thinned white samples stays white.
"""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit
from .sampling import (
    SAME_TIME,
    Interpolation,
    as_number,
    check_step,
    expect,
    interpolate,
    make_interpolation,
    same_step,
    sample_window,
)


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    Parameters
    ----------
    name : str
        Name, unique among the channels of a model or of measurements.
    quantity : str
        The measured quantity: a dimension of `fe_likelihoods.units.DIMENSIONS`, with or without words before it, such
        as ``"acceleration"`` or ``"relative displacement"``.
    unit : str
        Display unit for labels and figures ("g", "in", "kip"). Values are always in SI units.

    Raises
    ------
    ValueError
        If the name is empty, the quantity does not end with a dimension, or the unit has another dimension.

    Examples
    --------
    >>> top = Channel("top", "relative displacement", "mm")
    >>> top.dimension, top.si_unit
    ('displacement', 'm')
    """

    name: str
    quantity: str
    unit: str

    def __post_init__(self) -> None:
        expect(isinstance(self.name, str) and self.name, "Channel", "a name", repr(self.name))
        known, where = isinstance(self.quantity, str) and self.dimension in DIMENSIONS, f"channel {self.name!r}"
        expected = f"a quantity that is one of {', '.join(DIMENSIONS)}, with or without words before it"
        expect(known, where, expected, repr(self.quantity))
        try:
            find_unit(self.unit, self.dimension)
        except ValueError as error:
            raise ValueError(f"channel {self.name!r}: {error}") from None

    @property
    def dimension(self) -> str:
        """Dimension of the values, the last words of the quantity: a key of `fe_likelihoods.units.DIMENSIONS`."""
        words = self.quantity.split()
        two = " ".join(words[-2:])
        return two if two in DIMENSIONS else words[-1] if words else ""

    @property
    def si_unit(self) -> str:
        """SI unit of the values."""
        return DIMENSIONS[self.dimension]


@dataclass(frozen=True, eq=False, repr=False)
class Measurements:
    """Samples of several channels, each at a constant step.

    Parameters
    ----------
    channels : tuple of Channel
        The channels, with unique names.
    dt : float or sequence of float
        Time step [s], or one per channel.
    values : (n_channels, n_steps) array_like, or sequence of n_channels arrays
        Samples in SI units, one row per channel, stored as a read-only copy. NaN marks a missing sample: a gap, or
        times at which a channel was not measured. Masked elements of a `numpy.ma` array are also missing. Rows of
        different lengths are filled with NaN at their ends.
    description : str, optional
        What was measured, where and when.
    start : float or sequence of float, optional
        Time of the first sample [s] after the first sample of the excitation, or one per channel. Default: zero.
    axis : str
        What the samples are along, if not time: for example "load case", or "position [m]". Steps are then without a
        meaning, and the data are drawn as points.
    points : sequence of str or float, optional
        Names or places of the samples along such an axis. Default: numbers from 1.

    Attributes
    ----------
    dt, start : float or tuple of float
        As given; a single number where all channels have the same.

    Raises
    ------
    ValueError
        If names repeat, the shape does not match the channels, a step is not positive, a sample is infinite, or a
        channel has no sample.

    Examples
    --------
    A channel with a gap, and one at half the rate that begins 0.37 s later:

    >>> acceleration = Channel("acceleration", "acceleration", "g")
    >>> displacement = Channel("displacement", "displacement", "mm")
    >>> measured = Measurements(
    ...     (acceleration, displacement), (0.01, 0.02), [[0.1, np.nan, 0.3], [0.001, 0.002]], start=(0.0, 0.37)
    ... )
    >>> measured.times("displacement").round(2)
    array([0.37, 0.39, 0.41])
    """

    channels: tuple[Channel, ...]
    dt: float | tuple[float, ...]
    values: NDArray[np.float64]
    description: str = ""
    start: float | tuple[float, ...] = 0.0
    axis: str = "time"
    points: Sequence[str | float] = ()

    def __post_init__(self) -> None:
        channels = tuple(self.channels)
        names = [channel.name for channel in channels]
        if not channels or len(set(names)) != len(names):
            raise ValueError(f"measurements need channels with different names, got {names}")
        values = _values_array(self.values, names)
        for row, step in np.argwhere(np.isinf(values))[:1]:
            got = f"{np.isinf(values).sum()} infinite ones, the first is sample {step} of channel {names[row]!r}"
            expect(False, "Measurements", "finite values, or NaN where one is missing", got, "repair or cut the data")
        empty = ", ".join(repr(name) for name, row in zip(names, values, strict=True) if np.isnan(row).all())
        advice = "leave these channels out (Measurements.select, or channels in a TOML file)"
        got = f"all samples of {empty} are missing (NaN)"
        expect(not empty, "Measurements", "a sample of each channel", got, advice)
        values.flags.writeable = False
        steps = [check_step(dt, "the measurements") for dt in _per_channel(self.dt, len(names), "time step")]
        starts = [_check_start(start) for start in _per_channel(self.start, len(names), "start")]
        points = tuple(self.points) or (() if self.is_history else tuple(str(k + 1) for k in range(values.shape[1])))
        fits, got = len(points) in (0, values.shape[1]) and not (points and self.is_history), f"along {self.axis!r}"
        expected = f"a point for each of {values.shape[1]} samples along an axis other than time"
        expect(fits, "measurements", expected, f"{len(points)} points {got}")
        fields = {"channels": channels, "dt": _single(steps), "start": _single(starts), "values": values}
        for name, value in (fields | {"points": points}).items():
            object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        channels = ", ".join(f"{channel.name} [{channel.unit}]" for channel in self.channels)
        along = f"at a step of {self.dt} s" if self.is_history else f"along {self.axis!r}"
        return f"Measurements of {channels}: {self.n_steps} samples {along}"

    @property
    def is_history(self) -> bool:
        """Whether the samples are along time, and not along load cases, positions or modes."""
        return self.axis == "time"

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return len(self.channels)

    @property
    def n_steps(self) -> int:
        """Number of samples per channel."""
        return self.values.shape[1]

    @property
    def steps(self) -> tuple[float, ...]:
        """Time step of each channel [s]."""
        return _per_channel(self.dt, self.n_channels, "time step")

    @property
    def starts(self) -> tuple[float, ...]:
        """Time of the first sample of each channel [s]."""
        return _per_channel(self.start, self.n_channels, "start")

    @property
    def simultaneous(self) -> bool:
        """Whether all channels have the same times."""
        return not isinstance(self.dt, tuple) and not isinstance(self.start, tuple)

    @property
    def complete(self) -> bool:
        """Whether no sample is missing."""
        return not np.isnan(self.values).any()

    @property
    def root_mean_squares(self) -> NDArray[np.float64]:
        """Root mean square of each channel, shape (n_channels,) [SI unit of the channel]."""
        return np.sqrt(np.nanmean(np.square(self.values), axis=1))

    @property
    def time(self) -> NDArray[np.float64]:
        """Times of the samples, shape (n_steps,) [s]; ValueError if they differ between channels (see `times`)."""
        if not self.simultaneous:
            names = ", ".join(channel.name for channel in self.channels)
            raise ValueError(f"the channels {names} have different times; call times(name) for one channel")
        return self.times(self.channels[0].name)

    def times(self, name: str) -> NDArray[np.float64]:
        """Return the sample times of one channel, shape (n_steps,) [s], including the times of missing samples."""
        row = self._row(name)
        times = np.arange(self.n_steps) * self.steps[row]
        return times + self.starts[row] if self.starts[row] else times

    @property
    def end(self) -> float:
        """Time of the last sample of all channels [s]."""
        last = self.n_steps - 1 - np.argmax(np.isfinite(self.values)[:, ::-1], axis=1)
        return float(max(start + k * dt for start, k, dt in zip(self.starts, last, self.steps, strict=True)))

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of names, quantities, times and values. Display units are not included."""
        state = hashlib.blake2b(digest_size=16)
        state.update(json.dumps([[channel.name, channel.quantity] for channel in self.channels]).encode())
        if self.simultaneous and self.start == 0.0:
            state.update(np.array([self.dt, self.n_steps], dtype="<f8").tobytes())
        else:
            state.update(np.array([*self.steps, *self.starts, self.n_steps], dtype="<f8").tobytes())
        values = self.values if self.complete else np.where(np.isnan(self.values), np.nan, self.values)  # one NaN
        state.update(np.ascontiguousarray(values, dtype="<f8").tobytes())
        return state.hexdigest()

    def channel(self, name: str) -> NDArray[np.float64]:
        """Return the samples of one channel, shape (n_steps,) [SI]; raise ValueError if it does not exist."""
        return self.values[self._row(name)]

    def select(self, names: Sequence[str]) -> "Measurements":
        """Return the measurements of the named channels, in this order; raise ValueError if one does not exist.

        Examples
        --------
        >>> measurements.select(["displacement"]).values.shape
        (1, 200)
        """
        expect(not isinstance(names, str), "select", f"a sequence of names, for instance [{names!r}]")
        rows = [self._row(name) for name in names]
        each = (self.channels, self.steps, self.values, self.starts)
        channels, dt, values, start = (tuple(one[row] for row in rows) for one in each)
        return replace(self, channels=channels, dt=dt, values=values, start=start)

    def trim(self, start: float = 0.0, stop: float | None = None) -> "Measurements":
        """Return the samples between two times [s], both included; default of `stop`: the end of the measurements.

        Time starts again from zero. Channels that begin at zero begin at zero again, like a record that is trimmed to
        the same times; for other channels, `start` is the new zero. ValueError unless 0 <= start < stop <= end, or if a
        channel has no sample between them.

        Examples
        --------
        >>> measurements.trim(1.0, 5.0).start
        0.0
        """
        if self.simultaneous and self.start == 0.0:
            window = sample_window("the measurements", self.n_steps, self.dt, start, stop)
            return replace(self, values=self.values[:, window], points=self.points[window])
        stop = self.end if stop is None else stop
        within, got = 0.0 <= start < stop <= self.end * (1.0 + 1e-12), f"start = {start}, stop = {stop}"
        expect(within, "the measurements", f"0 <= start < stop <= {self.end:g} s, their end", got)
        rows, starts = [], []
        for channel, values, dt in zip(self.channels, self.values, self.steps, strict=True):
            times = self.times(channel.name)
            inside = np.flatnonzero((times >= start - SAME_TIME * dt) & (times <= stop + SAME_TIME * dt))
            rows.append(values[inside] if inside.size else [np.nan])
            first = float(times[inside[0]]) - start if inside.size else 0.0
            starts.append(0.0 if abs(first) <= SAME_TIME * dt else first)
        return replace(self, values=rows, start=tuple(starts))

    def shift(self, seconds: float, channels: Sequence[str] | None = None) -> "Measurements":
        """Return the measurements with the times of `channels` (default: all) later by `seconds` [s].

        This corrects the clock of a logger. ValueError for an unknown channel, or a time that is not finite.

        Examples
        --------
        >>> measurements.shift(0.5).start
        0.5
        """
        shift, names = _check_start(seconds), [channel.name for channel in self.channels]
        chosen = names if channels is None else [channel.name for channel in self.select(channels).channels]
        starts = zip(names, self.starts, strict=True)
        return replace(self, start=tuple(start + shift * (name in chosen) for name, start in starts))

    def decimate(self, factor: int) -> "Measurements":
        """Return every `factor`-th sample, starting with the first one, without a filter.

        ValueError unless `factor` is a whole number from 1 to the number of samples.

        Notes
        -----
        This is the right way to thin measurements for a likelihood with white noise: the noise of the remaining samples
        is still independent from sample to sample, and they are compared with the model response at the same instants.
        A filter would correlate the noise.

        The remaining samples are not a band-limited signal, because motion above the new Nyquist frequency appears at
        lower frequencies (aliasing). Do not differentiate or integrate them, or compute their spectra, and resample an
        excitation with `Record.resample` instead.

        Examples
        --------
        >>> measurements.decimate(2).dt
        0.1
        """
        if not isinstance(factor, (int, np.integer)) or not 1 <= factor <= self.n_steps:
            raise ValueError(f"factor must be a whole number from 1 to {self.n_steps}, got {factor!r}")
        dt = self.dt * factor if self.simultaneous else tuple(dt * factor for dt in self.steps)
        return replace(self, dt=dt, values=self.values[:, ::factor], points=self.points[::factor])

    def _row(self, name: str) -> int:
        names = [channel.name for channel in self.channels]
        if name not in names:
            raise ValueError(f"no channel {name!r}; the channels are {', '.join(names)}")
        return names.index(name)


def _values_array(values: Any, names: Sequence[str]) -> NDArray[np.float64]:
    """Samples as a new array (n_channels, n_steps), NaN where one is masked and at the ends of shorter rows."""
    try:
        rows = [np.ma.asarray(row) for row in values]
        if any(map(np.iscomplexobj, rows)):
            raise TypeError("got complex ones; give the real part if it is the data")
        rows = [row.astype(np.float64).filled(np.nan) for row in rows]
    except (TypeError, ValueError) as error:
        text = f"values must be real numbers, one row per channel: {error}; read tables by read_columns"
        raise ValueError(text) from None
    longest = max((row.size for row in rows), default=0)
    fits = len(rows) == len(names) and longest and all(row.ndim == 1 for row in rows)
    expected = f"values of shape (n_channels, n_steps) = ({len(names)}, n_steps)"
    expect(fits, "Measurements", expected, (len(rows), *(rows[0].shape if rows else ())))
    return np.array([np.append(row, np.full(longest - row.size, np.nan)) for row in rows])


def _per_channel(value: Any, n_channels: int, what: str) -> tuple[Any, ...]:
    if not isinstance(value, Sequence | np.ndarray) or isinstance(value, str):
        return (value,) * n_channels
    if len(value) != n_channels:
        raise ValueError(f"expected one {what}, or one for each of {n_channels} channels, got {len(value)}")
    return tuple(value)


def _single(numbers: Sequence[float]) -> float | tuple[float, ...]:
    return numbers[0] if len(set(numbers)) == 1 else tuple(numbers)


def _check_start(start: Any) -> float:
    expect(math.isfinite(as_number(start)), "start of the measurements", "a finite number of seconds", repr(start))
    return as_number(start)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measurements that have gaps, or other sample times than a response, prepared for this response."""

    values: NDArray[np.float64]  # (n_channels, n_samples) [SI], NaN where there is none
    places: tuple[Interpolation | None, ...]  # per channel; None if it has the times of the response

    @property
    def description(self) -> str:
        """Whether the response of a channel is evaluated between its samples, for fingerprints."""
        between = any(place is not None and place.weights is not None for place in self.places)
        return " interpolated by six points" if between else ""

    @cached_property
    def missing(self) -> NDArray[np.bool_]:
        """Whether a sample is missing, shape (n_channels, n_samples)."""
        return np.isnan(self.values)

    def at_samples(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the response (n_channels, n_steps) at the sample times, shape (n_channels, n_samples)."""
        if all(place is None for place in self.places):
            return response
        rows = zip(response, self.places, strict=True)
        n = self.values.shape[1]
        return np.stack([row[:n] if place is None else interpolate(row, place) for row, place in rows])

    def residuals(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return response minus measurement, shape (n_channels, n_samples) [SI], NaN where a sample is missing."""
        return np.ascontiguousarray(self.at_samples(response) - self.values)  # as for a complete response

    def known_residuals(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `residuals` with zero where a sample is missing."""
        residuals = self.residuals(response)
        residuals[self.missing] = 0.0
        return residuals


def compare_with(measurements: Measurements, dt: float, n_steps: int) -> NDArray[np.float64] | Comparison:
    """Return the measured values (n_channels, n_steps) if every response sample has one, else a `Comparison`.

    Measurements with the step of the response [s] need as many samples, some of them NaN; with other steps or starts
    they must end within one step before the end of the response, so that a wrong step raises ValueError.
    """
    end = (n_steps - 1) * dt
    _check_end(measurements, dt, n_steps)
    places: list[Interpolation | None] = []
    for row, channel in enumerate(measurements.channels):
        step, start = measurements.steps[row], measurements.starts[row]
        if start == 0.0 and n_steps == measurements.n_steps and same_step(dt, step):
            places.append(None)
            continue
        times = measurements.times(channel.name)
        there = np.isfinite(measurements.values[row])
        known = times[there]
        got = f"samples of channel {channel.name!r} from {known[0]:g} to {known[-1]:g} s"
        advice = "correct their start, or replace the samples before zero by NaN (in a TOML file missing = "
        advice += f"[[{known[0]:g}, {-0.5 * step:g}]])"
        expect(known[0] >= -SAME_TIME * dt, "measurements", f"times of the response, 0 to {end:g} s", got, advice)
        # a missing sample may be outside the response: any place within serves
        places.append(make_interpolation(dt, n_steps, np.where(there, times, known[0])))
    if all(place is None for place in places) and not np.isnan(measurements.values).any():
        return measurements.values
    return Comparison(measurements.values, tuple(places))


def _check_end(measurements: Measurements, dt: float, n_steps: int) -> None:
    """Raise ValueError if the measurements do not end with the response."""
    begin, end, last = min(measurements.starts), (n_steps - 1) * dt, measurements.end
    if begin > end:
        raise ValueError(
            f"the response ends at {end:g} s, and the measurements begin at {begin:g} s; give the time in their file "
            'at which the excitation begins, as zero=12.5 or zero="10:32:07" of read_columns (zero in a TOML file)'
        )
    if measurements.simultaneous and measurements.start == 0.0 and same_step(dt, measurements.dt):
        fits = measurements.n_steps == n_steps
    else:
        # missing samples at the end count: they say that the end was not measured. Channels with fewer samples than
        # others are filled with NaN, so only the channel whose rows end first states the end.
        stated = max(last, min(float(measurements.times(channel.name)[-1]) for channel in measurements.channels))
        fits = last <= end + SAME_TIME * dt and stated >= end - (1.0 + SAME_TIME) * max(dt, *measurements.steps)
    expected = f"{n_steps} samples with a step of {dt} s up to {end:g} s, as the response has"
    got = f"{measurements.n_steps} with a step of {measurements.dt} s up to {last:g} s"
    advice = "use the same part of record and measurements (trim in Python, duration in a TOML file), correct the step,"
    expect(fits, "measurements", expected, got, f"{advice} or fill times that were not measured with NaN")


def measured_values(measured: NDArray[np.float64] | Comparison) -> NDArray[np.float64]:
    """Return the measured values (n_channels, n_samples) [SI], with zero where a sample is missing."""
    return np.nan_to_num(measured.values, nan=0.0) if isinstance(measured, Comparison) else measured


def relative_errors(residuals: np.ndarray, measured: np.ndarray) -> NDArray[np.float64]:
    """Relative root mean square errors (...,) of residuals (..., n_steps): the root of the ratio of sums of squares.

    Samples that are NaN are left out, and a measured history of zeros has the error NaN.
    """
    there = np.isfinite(residuals) & np.isfinite(measured)
    squares, power = (np.square(np.where(there, each, 0.0)).sum(axis=-1) for each in (residuals, measured))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(power > 0.0, squares / power, np.nan))
