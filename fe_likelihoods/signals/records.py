"""Excitations: ground motions and imposed displacements, and the readers of their files.

A `Record` is a name, a time step and samples of acceleration in m/s². Between two samples the ground acceleration is
taken as a straight line, as step-by-step integration does; that is why refining a record interpolates linearly and
adds nothing, while coarsening it must first remove what the longer step cannot carry (else it would fold back as a
motion that never was).

A `DisplacementHistory` is what a laboratory actuator imposes on the top of a specimen: steps, no time.

The readers state the unit they found or refuse: PEER's AT2, CSMIP's and COSMOS's V2 (also inside zips), and CSV.
"""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import to_si
from . import file_formats

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .response_spectrum import ResponseSpectrum

__all__ = [
    "DisplacementHistory",
    "Record",
    "SubdividedHistory",
    "read_at2",
    "read_csv",
    "read_v2",
]

_LARGEST_RATIO_TERM = 1000  # of the two steps in `resample`; the filter's length grows with it
_TIME_TOLERANCE = 1e-9  # in steps: round-off of times that are multiples of the step


def _checked_samples(values, what: str, name: str) -> NDArray[np.float64]:
    """Read-only float64 copy of a 1-D array of at least two finite samples."""
    try:
        samples = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} of {name!r} must be an array of numbers: {error}") from None
    if samples.ndim != 1 or samples.size < 2:
        raise ValueError(
            f"{what} of {name!r} must be one-dimensional with 2 samples or more, got shape {samples.shape}"
        )
    bad = np.flatnonzero(~np.isfinite(samples))
    if bad.size:
        raise ValueError(
            f"{what} of {name!r} must be finite: {bad.size} of {samples.size} samples are not, the first is sample "
            f"{bad[0]} ({samples[bad[0]]}); repair or cut the data"
        )
    samples.flags.writeable = False
    return samples


def _digest(*parts: NDArray[np.float64]) -> str:
    """Hex digest of arrays, the same on every machine (little-endian)."""
    state = hashlib.blake2b(digest_size=16)
    for part in parts:
        state.update(np.ascontiguousarray(part, dtype="<f8").tobytes())
    return state.hexdigest()


def check_step(dt: float, name: str) -> float:
    """Time step [s] as a float; ValueError unless it is positive and finite."""
    try:
        step = float(dt)
    except (TypeError, ValueError):
        step = math.nan
    if not (math.isfinite(step) and step > 0):
        raise ValueError(f"time step of {name!r} must be a positive number of seconds, got {dt!r}")
    return step


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
        Ground acceleration [m/s²]; kept as a read-only copy.
    source : str, optional
        Where the record comes from and what was done to it.

    Raises
    ------
    ValueError
        If the step is not positive, or the samples are not one-dimensional, at least two, and finite.
    """

    name: str
    dt: float
    acceleration: NDArray[np.float64]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "dt", check_step(self.dt, self.name))
        object.__setattr__(self, "acceleration", _checked_samples(self.acceleration, "acceleration", self.name))

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
        """Hex digest (BLAKE2b, 128 bits) of the step and the samples; name and source do not enter."""
        return _digest(np.array([self.dt]), self.acceleration)

    def resample(self, dt: float) -> "Record":
        """Same motion at another step.

        A shorter step interpolates linearly, because the ground acceleration is a straight line between samples:
        nothing is added, and the old samples stay exact where they coincide with new ones. A longer step filters
        first: a symmetric (zero-phase) finite impulse response with its half-amplitude point at the new Nyquist
        frequency, in the polyphase form of `scipy.signal.resample_poly` (Kaiser window, beta = 5). Motion below 0.84
        of the new Nyquist frequency keeps its amplitude within 0.3 %, motion above 1.16 of it keeps less than 0.3 %.
        Before the first sample and after the last the record is continued by its mirror image in time and sign about
        that sample, so that an offset, a drift or a record that was cut does not ring at its ends.
        The new record ends at the last new instant that is not after the old end.

        Parameters
        ----------
        dt : float
            New step [s]. The ratio of the two steps must be a fraction of whole numbers up to 1000.

        Raises
        ------
        ValueError
            If the step is not positive, is longer than half the record, or the ratio is not such a fraction (the
            message names the nearest step that is).
        """
        new_dt = check_step(dt, self.name)
        exact = self.dt / new_dt
        if self.duration < 2 * new_dt:
            raise ValueError(f"new step of {self.name!r} must fit twice in its {self.duration:g} s, got {new_dt:g} s")
        ratio = Fraction(exact).limit_denominator(_LARGEST_RATIO_TERM)
        if ratio == 0 or ratio.numerator > _LARGEST_RATIO_TERM or abs(float(ratio) - exact) > 1e-9 * exact:
            nearest = f"; the nearest such step is {self.dt / float(ratio)!r} s" if ratio else ""
            raise ValueError(
                f"the steps {self.dt!r} s of {self.name!r} and {new_dt!r} s must be in the ratio of whole numbers up "
                f"to {_LARGEST_RATIO_TERM}{nearest}"
            )
        up, down = ratio.numerator, ratio.denominator
        if up == down:
            return self
        n_steps = (self.n_steps - 1) * up // down + 1
        if up > down:
            positions = np.arange(n_steps) * down / up  # in old samples; whole where old and new instants coincide
            samples = np.interp(positions, np.arange(self.n_steps), self.acceleration)
        else:
            from scipy import signal  # a second to import, which every worker process would wait for

            samples = signal.resample_poly(self.acceleration, up, down, padtype="antireflect")[:n_steps]
        return replace(self, dt=new_dt, acceleration=samples, source=self._source(f"resampled to dt = {new_dt:g} s"))

    def trim(self, start: float = 0.0, stop: float | None = None) -> "Record":
        """Part of the record between two times, both included; time starts again from zero.

        Parameters
        ----------
        start, stop : float
            Times [s] with 0 <= start < stop <= duration; `stop` is the end by default.

        Raises
        ------
        ValueError
            If the times are out of order or out of the record, or fewer than 2 samples remain.
        """
        window = sample_window(self.name, self.n_steps, self.dt, start, stop)
        note = f"trimmed to {window.start * self.dt:g} ... {(window.stop - 1) * self.dt:g} s"
        return replace(self, acceleration=self.acceleration[window], source=self._source(note))

    def scale(self, factor: float) -> "Record":
        """Record with every sample multiplied by `factor` (a finite number; ValueError otherwise)."""
        if not math.isfinite(factor):
            raise ValueError(f"scale factor of {self.name!r} must be a finite number, got {factor!r}")
        note = f"scaled by {factor:g}"
        return replace(self, acceleration=factor * self.acceleration, source=self._source(note))

    def spectrum(
        self, periods: Sequence[float] | NDArray[np.float64] | None = None, damping_ratio: float = 0.05
    ) -> "ResponseSpectrum":
        """Elastic response spectrum; arguments and errors are those of `fe_likelihoods.signals.response_spectrum.response_spectrum`."""
        from .response_spectrum import response_spectrum

        return response_spectrum(self, periods, damping_ratio)

    def plot(self, axes: "Axes | None" = None, unit: str = "g") -> "Axes":
        """Acceleration against time; arguments and errors are those of `fe_likelihoods.plots.histories.plot_record`."""
        from ..plots.histories import plot_record

        return plot_record(self, axes, unit)

    def plot_spectrum(
        self,
        periods: Sequence[float] | NDArray[np.float64] | None = None,
        damping_ratios: Sequence[float] = (0.02, 0.05, 0.1),
        axes: "Axes | None" = None,
        quantity: str = "pseudo_acceleration",
        unit: str | None = None,
    ) -> "Axes":
        """Response spectra for one damping ratio or several; errors are those of `spectrum` and `plot_spectra`.

        Parameters
        ----------
        periods : (n_periods,) array_like, optional
            Undamped periods [s]; see `fe_likelihoods.signals.response_spectrum.response_spectrum`.
        damping_ratios : sequence of float
            Fractions of critical damping, one line each.
        axes, quantity, unit
            See `fe_likelihoods.plots.histories.plot_spectra`.
        """
        from ..plots.histories import plot_spectra

        spectra = [self.spectrum(periods, ratio) for ratio in damping_ratios]
        return plot_spectra(spectra, axes, quantity, unit, self.name)

    def _source(self, note: str) -> str:
        return f"{self.source}; {note}" if self.source else note


def sample_window(name: str, n_steps: int, dt: float, start: float, stop: float | None) -> slice:
    """Slice of the samples whose times lie between `start` and `stop` [s], both included (see `Record.trim`)."""
    duration = (n_steps - 1) * dt
    stop = duration if stop is None else stop
    slack = _TIME_TOLERANCE * dt
    if not (-slack <= start < stop <= duration * (1 + 1e-12) + slack):
        raise ValueError(
            f"expected 0 <= start < stop <= {duration:g} s, the duration of {name!r}, got start = {start}, "
            f"stop = {stop}"
        )
    first = max(math.ceil(start / dt - _TIME_TOLERANCE), 0)
    last = min(math.floor(stop / dt + _TIME_TOLERANCE), n_steps - 1)
    if last - first < 1:
        raise ValueError(f"{start} ... {stop} s keeps fewer than 2 samples of {name!r}, whose step is {dt:g} s")
    return slice(first, last + 1)


class SubdividedHistory(NamedTuple):
    """A finer `DisplacementHistory`, and the `indices` in it of the points of the history it was made from."""

    history: "DisplacementHistory"
    indices: NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class DisplacementHistory:
    """A displacement imposed step by step at the top of a laboratory specimen; there is no time.

    Parameters
    ----------
    name : str
        Name of the test, for labels and messages.
    displacement : (n_steps,) array_like
        Imposed displacement [m]; kept as a read-only copy.
    source : str, optional
        Where the history comes from.

    Raises
    ------
    ValueError
        If the steps are not one-dimensional, at least two, and finite.
    """

    name: str
    displacement: NDArray[np.float64]
    source: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "displacement", _checked_samples(self.displacement, "displacement", self.name))

    @property
    def n_steps(self) -> int:
        """Number of points."""
        return self.displacement.size

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of the displacements; name and source do not enter."""
        return _digest(self.displacement)

    def subdivide(self, max_increment: float) -> SubdividedHistory:
        """History with points inserted on straight lines so that no increment is larger than `max_increment` [m].

        Returns
        -------
        SubdividedHistory
            ``history.displacement[indices]`` are the original points, exactly.

        Raises
        ------
        ValueError
            If `max_increment` is not a positive number.
        """
        if not (math.isfinite(max_increment) and max_increment > 0):
            raise ValueError(f"largest increment of {self.name!r} must be a positive length [m], got {max_increment!r}")
        # The slack keeps an increment of exactly n times the limit at n parts despite round-off.
        parts = np.ceil(np.abs(np.diff(self.displacement)) / max_increment * (1 - 1e-12))
        indices = np.concatenate([[0], np.cumsum(np.maximum(parts, 1).astype(np.intp))])
        displacement = np.interp(np.arange(indices[-1] + 1), indices, self.displacement)
        return SubdividedHistory(replace(self, displacement=displacement), indices)


def read_at2(path: str | Path, units: str | None = None) -> Record:
    """Record from a PEER AT2 file, in the new (``NPTS=  4096, DT=  .0100 SEC``) or old (``4096 .0100 NPTS, DT``) form.

    Parameters
    ----------
    path : path
        The file.
    units : str, optional
        Unit of the samples when the header does not say ``UNITS OF ...``; if it does, the two must agree.

    Raises
    ------
    ValueError
        If there is no such file, no header, no unit, another quantity than acceleration, another number of samples
        than NPTS, or a sample that is not a finite number.
    """
    series = file_formats.parse_at2(file_formats.read_text(path), str(path))
    return _record(series, units, path, Path(path).stem)


def read_v2(path: str | Path, channel: int | None = None, member: str | None = None) -> Record:
    """Corrected acceleration of one channel from a CSMIP or COSMOS V2 file, or from a zip of them.

    Zips may hold zips, as downloads of whole stations do. The unit stands in the file and is required there.

    Parameters
    ----------
    path : path
        A V2 file (one channel or several) or a zip.
    channel : int, optional
        The station's channel number (``STA CHN``; the recorder's own number where the file has no other). Needed
        unless there is only one channel.
    member : str, optional
        End of the name of a file in the zip, such as ``"CHAN12.V2"`` or ``"Free Field.zip/CHAN012.V2"``, for zips
        that hold a channel more than once.

    Raises
    ------
    ValueError
        If there is no such file or channel, if several fit (the message lists them), or if the file is damaged.
    """
    candidates = file_formats.find_v2_channels(path, member)
    chosen = [each for each in candidates if channel is None or each.channel == channel]
    if len(chosen) != 1:
        listing = "\n  ".join(f"channel {each.channel}: {each.label} [{each.file}]" for each in chosen or candidates)
        raise ValueError(
            f"{path}: expected one channel with channel = {channel}, member = {member!r}, found {len(chosen)}; choose "
            f"with channel= and member= among\n  {listing}"
        )
    series = file_formats.parse_v2(chosen[0])
    record = _record(series, None, chosen[0].file, series.title)
    return replace(record, source=chosen[0].file.removeprefix(f"{Path(path).parent}/"))


def read_csv(path: str | Path, units: str | None = None, dt: float | None = None, column: str | None = None) -> Record:
    """Record from a CSV file with a header line such as ``time_s,acc_g``, and comment lines that start with ``#``.

    The unit is the suffix of the column's name (``acc_g``, ``acc_cm_s2``, ``acc [m/s2]``), or the comment
    ``# units: g``, or `units`; where several speak they must agree. Times must be uniform within the rounding with
    which they are printed. Comments ``dt = 0.02 s`` and ``npts = 1559`` are checked where present.

    Parameters
    ----------
    path : path
        The file. Without a header line it must have one single column.
    units : str, optional
        Unit of the samples.
    dt : float, optional
        Time step [s], needed for a file without times.
    column : str, optional
        Name of the column, needed if there is more than one besides the time.

    Raises
    ------
    ValueError
        If there is no such file or column, no unit or no step, if statements disagree, if a cell is not a finite
        number, or if a time step is irregular (the first one is named).
    """
    table = file_formats.read_table(path)
    series = file_formats.csv_series(table, column, dt)
    return _record(series, units, path, Path(path).stem)


def _record(series: file_formats.Series, units: str | None, file: str | Path, name: str) -> Record:
    unit = file_formats.agreed_unit(series.unit, units, "acceleration", file)
    # The file's name without its folder: the source is written into data sets, which travel.
    source = Path(file).name + (f": {series.title}" if series.title else "")
    return Record(name, series.dt, to_si(series.values, unit, "acceleration"), source)
