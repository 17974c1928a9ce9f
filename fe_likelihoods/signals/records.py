"""Excitations: ground motions (`Record`) and displacements imposed in a laboratory (`DisplacementHistory`).

Between two samples the ground acceleration is a straight line, as in step-by-step integration: a record is refined by
linear interpolation, which adds no motion. Before it is coarsened, a filter removes motion above the new Nyquist
frequency, which would otherwise appear at lower frequencies (aliasing).

Several records on one structure, one after the other: `Events` is one loading and knows the times of its events.

The state of the structure is carried from event to event, because a model simulates the joined record as one. Cracks,
yielded bars and residual displacements after one event are the initial state of the next event.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import from_si
from .channels import Channel, Measurements
from .response_spectrum import ResponseSpectrum, spectrum_of
from .sampling import SAME_TIME, array_digest, check_samples, check_step, expect, rest_samples, same_step, sample_window

_APART = 1.3  # smallest ratio of successive durations
_LARGEST_RATIO_TERM = 1000  # of the ratio of steps in `Record.resample`; the filter length grows with it


@dataclass(frozen=True, eq=False)
class Record:
    """A ground acceleration sampled at a constant step.

    Parameters
    ----------
    name : str
        Name of the record, for labels and messages.
    dt : float
        Time step [s].
    acceleration : (n_steps,) array_like
        Ground acceleration [m/s²], stored as a read-only copy.
    source : str, optional
        Origin of the record, and how it was processed.

    Raises
    ------
    ValueError
        If the step is not positive, or the samples are not a one-dimensional array of at least two finite numbers.

    Examples
    --------
    >>> record = Record("short motion", 0.01, [0.0, 0.5, -0.3, 0.1])  # m/s²
    >>> record.duration, record.n_steps
    (0.03, 4)
    >>> record.scale(2.0).acceleration
    array([ 0. ,  1. , -0.6,  0.2])
    """

    name: str
    dt: float
    acceleration: NDArray[np.float64]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", check_step(self.dt, self.name))
        object.__setattr__(self, "acceleration", check_samples(self.acceleration, "acceleration", self.name))

    def __str__(self) -> str:
        peak = from_si(np.abs(self.acceleration).max(), "g")
        return f"{self.name}, {self.n_steps} samples at {self.dt:g} s, peak {peak:.3g} g"

    @property
    def n_steps(self) -> int:
        """Number of samples."""
        return self.acceleration.size

    @property
    def duration(self) -> float:
        """Time from the first sample to the last [s]."""
        return (self.n_steps - 1) * self.dt

    @property
    def time(self) -> NDArray[np.float64]:
        """Times of the samples, from zero, shape (n_steps,) [s]."""
        return np.arange(self.n_steps) * self.dt

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of the step and the samples. Name and source are not included."""
        return array_digest(np.array([self.dt]), self.acceleration)

    def resample(self, dt: float) -> Record:
        """Return the same motion with another time step.

        Parameters
        ----------
        dt : float
            New step [s]. The ratio of the two steps must be a fraction of integers up to 1000.

        Returns
        -------
        Record
            The record with the new step. It ends at the last new instant that is not after the old end.

        Raises
        ------
        ValueError
            If the step is not positive, is longer than half the record, or the ratio is not such a fraction. The
            message names the nearest step that is possible.

        Notes
        -----
        A shorter step interpolates linearly, because the ground acceleration is a straight line between samples. No
        motion is added, and old samples stay exact where old and new instants coincide.

        A longer step filters first, with a symmetric (zero-phase) finite impulse response whose half-amplitude point
        is the new Nyquist frequency, in the polyphase form of `scipy.signal.resample_poly` (Kaiser window, beta = 5).
        Motion below 0.84 times the new Nyquist frequency keeps its amplitude within 0.3 %, motion above 1.16 times this
        frequency keeps less than 0.3 %. Before the first sample and after the last sample the record is continued by
        its mirror image in time and sign about this sample, so that an offset, a drift or a cut does not cause
        oscillations at the ends.

        Examples
        --------
        >>> record.resample(0.01).n_steps
        996
        """
        new_dt = check_step(dt, self.name)
        exact = self.dt / new_dt
        if self.duration < 2 * new_dt:
            raise ValueError(f"new step of {self.name!r} must fit twice in its {self.duration:g} s, got {new_dt:g} s")
        ratio = Fraction(exact).limit_denominator(_LARGEST_RATIO_TERM)
        up, down = ratio.numerator, ratio.denominator
        expected = f"steps in the ratio of integers up to {_LARGEST_RATIO_TERM}"
        nearest = f"the nearest such step is {self.dt / float(ratio)!r} s" if ratio else ""
        fits = 0 < up <= _LARGEST_RATIO_TERM and abs(float(ratio) - exact) <= 1e-9 * exact
        expect(fits, self.name, expected, f"{self.dt!r} s and {new_dt!r} s", nearest)
        if up == down:
            return self
        n_steps = (self.n_steps - 1) * up // down + 1
        if up > down:
            positions = np.arange(n_steps) * down / up  # in old samples, an integer where old and new instants coincide
            samples = np.interp(positions, np.arange(self.n_steps), self.acceleration)
        else:
            from scipy import signal  # takes a second to import, in every worker process

            samples = signal.resample_poly(self.acceleration, up, down, padtype="antireflect")[:n_steps]
        return Record(self.name, new_dt, samples, self._source(f"resampled to dt = {new_dt:g} s"))

    def trim(self, start: float = 0.0, stop: float | None = None) -> Record:
        """Return the part of the record between two times [s], both included. Time starts again from zero.

        ValueError unless 0 <= start < stop <= duration (the default of `stop`), and 2 samples or more remain.

        Examples
        --------
        >>> record.trim(2.0, 8.0).duration
        6.0
        """
        window = sample_window(self.name, self.n_steps, self.dt, start, stop)
        note = f"trimmed to {window.start * self.dt:g} ... {(window.stop - 1) * self.dt:g} s"
        return Record(self.name, self.dt, self.acceleration[window], self._source(note))

    def scale(self, factor: float) -> Record:
        """Return the record with all samples multiplied by `factor`; ValueError if it is not finite.

        Examples
        --------
        >>> Record("short motion", 0.01, [0.0, 0.5, -0.3]).scale(2.0).acceleration
        array([ 0. ,  1. , -0.6])
        """
        expect(math.isfinite(factor), f"scale factor of {self.name!r}", "a finite number", repr(factor))
        note = f"scaled by {factor:g}"
        return Record(self.name, self.dt, factor * self.acceleration, self._source(note))

    def followed_by(self, other: Record, rest: float = 10.0) -> Record:
        """Return this record, `rest` seconds without ground motion and another record of the same step as one record.

        A model simulates the result as one loading, so the state of the structure at the end of this record (cracks,
        yielding, residual displacements) is its state at the beginning of the other record. The pause is rounded to
        whole steps. To keep the times of the events, join the records with `fe_likelihoods.signals.records.Events`.
        ValueError if `other` is not a `Record` or has another step, or `rest` is negative or not finite.

        Examples
        --------
        >>> record.followed_by(record.scale(0.5), rest=5.0).n_steps
        500
        """
        if not isinstance(other, Record):
            raise ValueError(f"{self.name!r} must be followed by a Record, got {type(other).__name__}")
        got = f"{self.dt!r} s ({self.name!r}) and {other.dt!r} s ({other.name!r})"
        advice = "use Record.resample(dt) on one of them"
        expect(same_step(self.dt, other.dt), "records that follow each other", "the same time step", got, advice)
        zeros = np.zeros(rest_samples(rest, self.dt))
        samples = np.concatenate([self.acceleration, zeros, other.acceleration])
        note = f"after a pause of {zeros.size * self.dt:g} s followed by {other.name}"
        note += f" ({other.source})" if other.source else ""
        return Record(f"{self.name}, {other.name}", self.dt, samples, self._source(note))

    def spectrum(
        self, periods: Sequence[float] | NDArray[np.float64] | None = None, damping_ratio: float = 0.05
    ) -> ResponseSpectrum:
        """Compute the elastic response spectrum of this motion.

        Parameters
        ----------
        periods : (n_periods,) array_like, optional
            Undamped periods [s], each at least a tenth of the step. Default: 120 periods, equally spaced on a
            logarithmic scale, from twice the step (at least 0.02 s) to 10 s.
        damping_ratio : float
            Fraction of critical damping, 0 <= damping_ratio < 1.

        Raises
        ------
        ValueError
            If the periods are not one-dimensional, finite and long enough, or the damping ratio is out of range.

        Examples
        --------
        >>> spectrum = record.spectrum([0.5, 1.0, 2.0], damping_ratio=0.05)
        >>> spectrum.pseudo_acceleration.shape
        (3,)
        """
        return spectrum_of(self.acceleration, self.dt, periods, damping_ratio)

    def _source(self, note: str) -> str:
        return f"{self.source}; {note}" if self.source else note


@dataclass(frozen=True, eq=False)
class DisplacementHistory:
    """A displacement imposed step by step at the top of a laboratory specimen. It has steps but no time.

    Parameters
    ----------
    name : str
        Name of the test, for labels and messages.
    displacement : (n_steps,) array_like
        Imposed displacement [m], stored as a read-only copy.
    source : str, optional
        Origin of the history.

    Raises
    ------
    ValueError
        If the displacements are not a one-dimensional array of at least two finite numbers.

    Examples
    --------
    >>> cycles = DisplacementHistory("cyclic test", [0.0, 0.02, -0.02, 0.04, -0.04, 0.0])  # m
    >>> tested = RCColumn.lhpost(cycles, parameters=("Ec", "fc", "fy"))
    >>> tested.simulate(np.ones(3)).shape  # the force at each step
    (1, 6)
    """

    name: str
    displacement: NDArray[np.float64]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", check_samples(self.displacement, "displacement", self.name))

    @property
    def n_steps(self) -> int:
        """Number of points."""
        return self.displacement.size

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of the displacements. Name and source are not included."""
        return array_digest(self.displacement)

    def subdivide(self, max_increment: float) -> tuple[DisplacementHistory, NDArray[np.intp]]:
        """Insert points on straight lines so that no increment exceeds `max_increment` [m]; the indices of old points.

        The displacements of the result at these indices (n_steps,) are the given ones, exactly. ValueError if the limit
        is not a positive number.
        """
        known, where = math.isfinite(max_increment) and max_increment > 0, f"largest increment of {self.name!r}"
        expect(known, where, "a positive length [m]", repr(max_increment))
        # The factor keeps an increment of exactly n times the limit at n parts despite round-off.
        parts = np.ceil(np.abs(np.diff(self.displacement)) / max_increment * (1 - 1e-12))
        indices = np.concatenate([[0], np.cumsum(np.maximum(parts, 1).astype(np.intp))])
        displacement = np.interp(np.arange(indices[-1] + 1), indices, self.displacement)
        return replace(self, displacement=displacement), indices


def growing_durations(acceleration: NDArray[np.float64], dt: float, shares: Sequence[float]) -> tuple[float, ...]:
    """Durations [s] after which increasing shares of the Arias intensity have passed, and the full duration.

    Accelerations are (n_channels, n_steps) and not all zero; channels have equal weight. Durations that are not 1.3
    times shorter than the next one are left out. The misfit of a long record has many local minima, since cycles that
    are out of phase by a period nearly fit.
    """
    rows = acceleration[np.abs(acceleration).max(axis=1) > 0.0]
    rows = rows / np.abs(rows).max(axis=1, keepdims=True)  # so that squares do not overflow
    passed = np.cumsum(rows * rows, axis=1)
    passed = (passed / passed[:, -1:]).mean(axis=0)
    durations = [(rows.shape[1] - 1) * dt]
    for index in np.searchsorted(passed, shares)[::-1]:
        if index > 0 and index * dt * _APART <= durations[0]:
            durations.insert(0, float(index * dt))
    return tuple(durations)


class EventWindow(NamedTuple):
    """Place of one event in the joined record."""

    name: str
    first: int  # index of its first sample
    stop: int  # index after its last sample
    start: float  # time of its first sample [s]
    end: float  # time of its last sample [s]

    @property
    def samples(self) -> slice:
        """Samples of the event in the joined record."""
        return slice(self.first, self.stop)


@dataclass(frozen=True, eq=False, init=False)
class Events(Record):
    """Records that follow each other on one structure, with pauses without ground motion between them.

    The object is a `Record`: a model takes it as its excitation. `trim` returns a plain `Record`, without events.

    Parameters
    ----------
    records : sequence of Record
        The events in chronological order, with the same time step. `Events` in the sequence are split into their
        records, and keep their pauses.
    rest : float or sequence of float
        Length of the pauses [s], zero or more, rounded to whole time steps; a sequence has one for each pause. The
        pause should be long enough for the free vibration to decay, as it was in the test.
    names : sequence of str, optional
        Names of the events, which must differ. Default: the names of the records; a repeated name gets a number ("EQ1",
        "EQ1_2").

    Attributes
    ----------
    records : tuple of Record
        The events.
    windows : tuple of EventWindow
        Names, times and samples of the events.
    rests : tuple of float
        The pauses between the events [s], in whole time steps.

    Raises
    ------
    ValueError
        If there are no records, their time steps differ, a pause is negative (the events would overlap), or names are
        repeated or do not match the records.

    Examples
    --------
    >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
    >>> response = LinearOscillator(events).simulate([1.0, 1.0])
    >>> response[:, events.window("second").samples].shape
    (2, 200)
    """

    records: tuple[Record, ...]
    windows: tuple[EventWindow, ...]
    rests: tuple[float, ...]

    def __init__(
        self, records: Sequence[Record], rest: float | Sequence[float] = 10.0, names: Sequence[str] | None = None
    ) -> None:
        given = [records] if isinstance(records, Record) else list(records)
        found = ", ".join(type(record).__name__ for record in given) or "none"
        known = given and all(isinstance(record, Record) for record in given)
        expect(known, "Events", "a sequence of one Record or more", found)
        parts, pauses, names = _flatten(given, rest, names)
        for part in parts[1:]:
            got = f"{parts[0].dt!r} s ({parts[0].name!r}) and {part.dt!r} s ({part.name!r})"
            alike = same_step(parts[0].dt, part.dt)
            expect(alike, "Events", "records of the same time step", got, "use Record.resample(dt) on one of them")
        dt = parts[0].dt
        zeros = [rest_samples(pause, dt) for pause in pauses]
        samples, windows, first = [], [], 0
        for part, name, n_zeros in zip(parts, names, [*zeros, 0], strict=True):
            stop = first + part.n_steps
            windows.append(EventWindow(name, first, stop, first * dt, (stop - 1) * dt))
            samples += [part.acceleration, np.zeros(n_zeros)]
            first = stop + n_zeros
        source = "; ".join(f"{name}: {part.source}" for name, part in zip(names, parts, strict=True))
        super().__init__(", ".join(names), dt, np.concatenate(samples), source)
        rests = tuple(n * dt for n in zeros)
        for field, value in {"records": tuple(parts), "windows": tuple(windows), "rests": rests}.items():
            object.__setattr__(self, field, value)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the events."""
        return tuple(window.name for window in self.windows)

    def window(self, name: str) -> EventWindow:
        """Return the window of one event; raise ValueError if there is no event of this name.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> events.window("second").start
        15.0
        """
        if name not in self.names:
            raise ValueError(f"no event {name!r}; the events are {', '.join(self.names)}")
        return self.windows[self.names.index(name)]

    def split(self, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return the parts of histories (..., n_steps) over the joined record by event, without the pauses.

        ValueError if the histories and the joined record have different numbers of samples.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> response = LinearOscillator(events).simulate([1.0, 1.0])
        >>> {name: part.shape for name, part in events.split(response).items()}
        {'first': (2, 200), 'second': (2, 200)}
        """
        values = np.asarray(values)
        expect(values.shape[-1:] == (self.n_steps,), self.name, f"histories of {self.n_steps} samples", values.shape)
        return {window.name: values[..., window.samples] for window in self.windows}

    def join(self, measurements: Mapping[str, Measurements]) -> Measurements:
        """Put the measurements of single events, by name, at their times in the joined record.

        Time zero of the measurements is the first sample of the event; all have the same time step. An event may be
        left out: it then only changes the state of the structure. A channel may be missing in some events. The result
        has all channels over the joined record, with NaN in the pauses and wherever nothing was measured. ValueError if
        there are no measurements, an event is unknown, the steps differ, samples are outside of their event or between
        the steps of the joined record, or a channel has another quantity in another event.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> joined = events.join({"first": measurements, "second": measurements})  # NaN in the pause
        >>> joined.values.shape
        (2, 500)
        """
        given = isinstance(measurements, Mapping) and measurements
        expect(given, self.name, f"Measurements for one or more of {', '.join(self.names)}", repr(measurements))
        windows = {name: self.window(name) for name in measurements}
        first = next(iter(measurements.values()))
        channels: dict[str, Channel] = {}
        for name, each in measurements.items():
            alike = isinstance(each, Measurements) and each.simultaneous and same_step(first.dt, each.dt)
            advice = "use Measurements.decimate, or join channels with different steps by NaN in one Measurements"
            expect(alike, f"measurements of {name!r}", "one time step for all channels and events", "others", advice)
            for channel in each.channels:
                known = channels.setdefault(channel.name, channel)
                got = f"{channel.quantity!r} in {name!r}"
                alike, what = known.quantity == channel.quantity, f"channel {channel.name!r}"
                expect(alike, what, f"{known.quantity!r} as in another event", got, "rename one of them")
        dt = first.dt
        # steps that differ by round-off, and a start and an end within SAME_TIME, may add up to a little more
        values = np.full((len(channels), math.floor(self.duration / dt + 3.0 * SAME_TIME) + 1), np.nan)
        rows = {name: row for row, name in enumerate(channels)}
        for name, each in measurements.items():
            end, duration = each.start + (each.n_steps - 1) * dt, windows[name].end - windows[name].start
            within = each.start >= -SAME_TIME * dt and end <= duration + SAME_TIME * dt  # not in a pause
            expected = f"samples in the event from 0, its first sample, to {duration:g} s"
            got = f"measurements from {each.start:g} to {end:g} s"
            expect(within, repr(name), expected, got, "use Measurements.trim(start, stop)")
            time = windows[name].start + each.start
            start = round(time / dt)
            expected = f"a first sample at a multiple of the step {dt:g} s of the measurements in the joined record"
            advice = "choose pauses after which every event begins at such a multiple"
            expect(abs(time - start * dt) <= SAME_TIME * dt, repr(name), expected, f"{time:g} s", advice)
            for channel, samples in zip(each.channels, each.values, strict=True):
                values[rows[channel.name], start : start + each.n_steps] = samples
        described = [f"{name}: {each.description}" for name, each in measurements.items() if each.description]
        return Measurements(tuple(channels.values()), dt, values, "; ".join(described))

    def resample(self, dt: float) -> Events:
        """Return the events with another time step, each resampled separately by `Record.resample`."""
        return Events([record.resample(dt) for record in self.records], self.rests, self.names)

    def scale(self, factor: float) -> Events:
        """Return the events with all samples multiplied by `factor`; ValueError if it is not finite."""
        return Events([record.scale(factor) for record in self.records], self.rests, self.names)

    def followed_by(self, other: Record, rest: float = 10.0) -> Events:
        """Return these events, a pause of `rest` [s] and another record or further events; see `Record.followed_by`."""
        return Events([self, other], rest)


def _flatten(
    given: list[Record], rest: float | Sequence[float], names: Sequence[str] | None
) -> tuple[list[Record], list[float], list[str]]:
    """All records with those of `Events` among them, the pauses between them, and their names, each once."""
    n = len(given) - 1
    pauses = [rest] * n if isinstance(rest, str | Mapping) or np.ndim(rest) == 0 else list(rest)
    if len(pauses) != n:
        raise ValueError(f"expected one pause, or one for each of the {n} pauses between the records; got {rest!r}")
    parts, between, unique = [], [], list[str]()
    for record, pause in zip(given, [*pauses, None], strict=True):
        inner = isinstance(record, Events)
        parts += record.records if inner else [record]
        between += [*(record.rests if inner else ()), *([] if pause is None else [pause])]
        for wanted in record.names if inner else [record.name]:
            numbered = (wanted if k == 1 else f"{wanted}_{k}" for k in range(1, len(unique) + 2))
            unique.append(next(name for name in numbered if name not in unique))
    if names is None:
        return parts, between, unique
    stated = [names] if isinstance(names, str) else list(names)
    if len(stated) != len(parts) or len(set(stated)) != len(parts) or not all(isinstance(x, str) and x for x in stated):
        raise ValueError(f"names must be {len(parts)} different texts, one for each event; got {names!r}")
    return parts, between, stated


def find_events(model: Any) -> Events | None:
    """The events that are the excitation of a model; None if the excitation is a plain record."""
    return next((each for each in motions_of(model) if isinstance(each, Events)), None)


def motions_of(model: Any) -> tuple[Record, ...]:
    """The records that excite a model, one for each support that has one; empty for a model of another kind."""
    given = getattr(model, "supports", ()) or [getattr(model, name, None) for name in ("record", "loading")]
    return tuple(each for each in given if isinstance(each, Record))


def events_of(model: Any) -> Events:
    """The events that are the excitation of a model; raise ValueError if the excitation is not `Events`."""
    events = find_events(model)
    got, what = f"{type(model).__name__} with another excitation", "measurements and noise per event"
    expect(events is not None, what, "a model whose excitation is Events([eq1, eq2, ...])", got)
    missing = events.duration - (model.n_steps - 1) * model.dt
    expected = f"a response to all {events.duration:g} s of the events"
    advice = "leave out its lead, and put NaN where the measurements of the first event are not to be compared"
    expect(missing <= 1.000001 * model.dt, what, expected, f"{type(model).__name__} without {missing:g} s", advice)
    return events
