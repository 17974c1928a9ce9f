r"""Lag between measurements and an excitation or a response, from their cross-correlation.

A measured channel is modelled as :math:`y(t) = a\, r(t - \tau) + e(t)` with a reference r, an unknown factor a, the lag
:math:`\tau` and an error e. With the correlation :math:`c(\tau)` of y and the shifted reference, the log-likelihood,
maximised over a and the standard deviation of e, is :math:`-\frac n2 \log(1 - c^2(\tau))`. The lag is where the sum
over the channels, with the effective number of samples in place of n, is largest.

A structure delays and filters its excitation, so a channel of the structure is not a shifted record. Compare like with
like: the record with the channel at its base, and the channels of the structure with a simulated response.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .channels import Measurements
from .interpolation import interpolate, make_interpolation
from .records import Record

__all__ = ["Alignment", "align"]

_LEAST = 1e-3  # energy of the reference at a lag, of the largest at any lag, below which nothing is compared
_CLOSE = 0.5  # share of the highest score from which other peaks are refined
_CANDIDATES = 8  # number of the highest peaks on the grid of lags that are refined
_CONTRADICTION = 8.0  # advantage of a part's own lag over the common lag that is stated: 4 standard errors
_GOOD = 0.7  # correlation below which the reference does not explain the channel
_SMOOTH = 0.02  # share of the lines over which the spectrum of errors is averaged
_NEARLY_ONE = 1.0 - 1e-12  # largest squared correlation


class Alignment(NamedTuple):
    """A lag and its uncertainty.

    Attributes
    ----------
    lag : float
        Time by which the measurements are later than the reference [s]. ``measurements.shift(-lag)`` corrects them.
    standard_error : float
        Standard error of the lag [s], if the highest peak is the right one.
    correlation : dict of str to float
        Correlation of each channel with the shifted reference [-]; negative for a sensor with the opposite sign.
    probability : float
        Probability of the highest peak, compared with the second highest peak at a different lag.
    second_lag : float or None
        Lag of the second highest peak [s]; None if there is none.
    own_lags : dict of str to float
        Lags of the channels, each by itself [s], if one contradicts the common lag (``measurements.shift(-lag,
        [name])`` corrects one); else those of the first and the second half, if one contradicts it; else empty.
    """

    lag: float
    standard_error: float
    correlation: dict[str, float]
    probability: float
    second_lag: float | None
    own_lags: dict[str, float] = {}

    @property
    def statement(self) -> str:
        """Uncertainty of the lag, in words."""
        shown = ", ".join(f"{name} {value:.3f}" for name, value in self.correlation.items())
        text = f"lag {self.lag:.5g} s, standard error {self.standard_error:.2g} s, correlation {shown}"
        if opposite := [name for name, value in self.correlation.items() if value < -_GOOD]:
            text += f"; the sign is opposite: {', '.join(opposite)}"
        if self.own_lags:
            lags = ", ".join(f"{name} {lag:.5g} s" for name, lag in self.own_lags.items())
            text += (
                f"; NOT SURE: parts have other lags, each by itself {lags}: correct each channel with "
                "measurements.shift(-lag, [name]); where the halves differ, the clocks run at different speeds, or the "
                "reference lacks a part of the motion"
            )
        if low := [name for name, value in self.correlation.items() if abs(value) < _GOOD]:
            text += f"; NOT SURE: {', '.join(low)} is not a shifted copy of the reference"
        if self.probability < 0.99:
            text += (
                f"; NOT SURE: a lag of {self.second_lag:.5g} s is nearly as good, {self.probability:.0%} for the first"
            )
        return text


class _Pair(NamedTuple):
    """A channel at its samples that are not missing, and its reference, which begins at time zero."""

    name: str
    start: float  # time of the channel's first sample [s]
    step: float  # [s]
    places: np.ndarray  # (n,) indices of the samples that are not missing
    values: np.ndarray  # (n,)
    dt: float  # step of the reference [s]
    reference: np.ndarray  # (n_steps,)

    @property
    def durations(self) -> tuple[float, float]:
        """Of the channel and of the reference [s]."""
        return float(np.ptp(self.places)) * self.step, (self.reference.size - 1) * self.dt

    @property
    def grid(self) -> float:
        """Step of the lags [s]: the channel's, divided so that it is not longer than the reference's."""
        return self.step / max(1, math.ceil(self.step / self.dt - 1e-9))

    def part(self, chosen: np.ndarray) -> "_Pair":
        return self._replace(places=self.places[chosen], values=self.values[chosen])

    def shifted(self, lag: float) -> tuple[np.ndarray, np.ndarray]:
        """Samples whose times are within the shifted reference (n,) bool, and the reference there."""
        times, end = self.start + self.step * self.places - lag, self.durations[1]
        inside = (times >= -1e-9) & (times <= end + 1e-9)
        at = make_interpolation(self.dt, self.reference.size, np.clip(times[inside], 0.0, end))
        return inside, interpolate(self.reference, at)


def align(
    reference: Record | Measurements,
    measurements: Measurements,
    channels: Sequence[str] | None = None,
    max_lag: float | None = None,
) -> Alignment:
    """Estimate the lag of measurements by cross-correlation.

    Parameters
    ----------
    reference : Record or Measurements
        The excitation, or a response simulated with it (``Measurements(model.channels, model.dt, model.simulate(x))``).
    measurements : Measurements
        The measurements. Missing samples are left out.
    channels : sequence of str, optional
        The channels to use. Default: the channels that the response also has; for a record, the only acceleration.
    max_lag : float, optional
        Largest lag in both directions [s]. Default: half of the shorter duration.

    Returns
    -------
    Alignment
        The lag, its error, and a statement of its uncertainty.

    Raises
    ------
    ValueError
        If channels do not exist or do not fit, a channel or the reference is constant, the largest lag is beyond the
        record, or the correlation is largest at an end of the lag range.

    Notes
    -----
    The standard error is that of least squares with correlated errors: the derivative s of the shifted reference times
    its factor, and the errors with the spectrum P, give the variance ``sum(|S|^2 P) / (n sum(s^2))^2``.

    Examples
    --------
    >>> early = Measurements(measurements.channels, 0.05, measurements.values[:, 10:])  # begins 0.5 s too late
    >>> found = align(measurements, early)
    >>> round(found.lag, 2)
    -0.5
    """
    pairs = _pairs(reference, measurements, channels)
    longest = min(max(pair.durations) for pair in pairs)
    max_lag = 0.5 * min(min(pair.durations) for pair in pairs) if max_lag is None else max_lag
    if not 0.0 < max_lag < longest:
        raise ValueError(
            f"max_lag must be positive and below {longest:g} s, the duration of the longer of record and "
            f"measurements, got {max_lag!r}"
        )
    step = min(pair.grid for pair in pairs)
    lags = step * np.arange(-math.floor(max_lag / step), math.floor(max_lag / step) + 1)
    lag, second, advantage = _best_lag(pairs, lags)
    if abs(lag) > abs(lags[0]) - 0.5 * step:
        raise ValueError(
            f"the correlation is largest at a lag of {lag:g} s, an end of the range; give a larger max_lag, or other "
            "channels"
        )
    own: dict[str, float] = {}
    halves = {name: [_half(pair, lag, name) for pair in pairs] for name in ("first half", "second half")}
    for parts in ({pair.name: [pair] for pair in pairs}, halves) if len(pairs) > 1 else (halves,):
        found = {name: _best_lag(each, lags)[0] for name, each in parts.items() if all(p.values.any() for p in each)}
        contradict = [
            abs(t - lag) > step and _advantage(parts[name], t, lag) > _CONTRADICTION for name, t in found.items()
        ]
        own = own or (found if any(contradict) else {})
    information = sum(_information(pair, lag) for pair in pairs)
    return Alignment(
        lag,
        1.0 / math.sqrt(information) if information > 0.0 else math.inf,
        {pair.name: _coefficient(pair, lag) for pair in pairs},
        1.0 / (1.0 + math.exp(-advantage)),
        second,
        own,
    )


def _pairs(reference: Record | Measurements, measurements: Measurements, channels: Sequence[str] | None) -> list[_Pair]:
    names = [channel.name for channel in measurements.channels]
    if isinstance(channels, str):
        raise ValueError(f"channels takes a sequence of names, for instance [{channels!r}]")
    if isinstance(reference, Record):
        if channels is None:
            channels = [c.name for c in measurements.channels if c.dimension == "acceleration"]
            if len(channels) != 1:
                raise ValueError(
                    f"expected one channel of acceleration among {', '.join(names)}, found {len(channels)}; name the "
                    "one at the base with channels=, or give a simulated response instead of the record"
                )
        references = dict.fromkeys(channels, (reference.dt, reference.acceleration, "acceleration"))
    else:
        if not reference.complete or any(reference.starts):
            raise ValueError("the reference needs all its samples, from time zero; give a simulated response")
        rows = zip(reference.channels, reference.steps, reference.values, strict=True)
        simulated = {channel.name: (step, history, channel.dimension) for channel, step, history in rows}
        channels = [name for name in names if name in simulated] if channels is None else channels
        missing = [name for name in channels if name not in simulated]
        if missing or not channels:
            raise ValueError(
                f"the reference has the channels {', '.join(simulated)}; got {', '.join(missing or names)}"
            )
        references = {name: simulated[name] for name in channels}
    pairs = []
    for name, (dt, history, dimension) in references.items():
        one = measurements.select([name])
        values, (channel,) = one.values[0], one.channels
        if channel.dimension != dimension:
            raise ValueError(
                f"channel {name!r} is {channel.quantity!r}, its reference {dimension!r}; compare like with like"
            )
        there = np.isfinite(values)
        if there.sum() < 10 or not np.ptp(values[there]) > 0.0 or history.size < 10 or not np.ptp(history) > 0.0:
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        known = values[there] - values[there].mean()
        pairs.append(_Pair(name, one.start, one.dt, np.flatnonzero(there), known, dt, history - history.mean()))
    return pairs


def _half(pair: _Pair, lag: float, which: str) -> _Pair:
    """The samples with the first or the second half of the energy of the shifted reference."""
    inside, motion = pair.shifted(lag)
    middle = np.searchsorted(np.cumsum(motion**2), 0.5 * float(motion @ motion))
    chosen = np.arange(len(motion)) < middle if which == "first half" else np.arange(len(motion)) >= middle
    return pair.part(np.flatnonzero(inside)[chosen])


def _compared(pair: _Pair, lag: float) -> tuple[np.ndarray, np.ndarray]:
    """Samples of a channel and the shifted reference where they overlap, without means."""
    inside, shifted = pair.shifted(lag)
    own = pair.values[inside]
    return (own - own.mean(), shifted - shifted.mean()) if len(own) > 2 else (np.zeros(3), np.zeros(3))


def _coefficient(pair: _Pair, lag: float) -> float:
    """Correlation of a channel and its shifted reference; zero where they do not overlap, or one is constant."""
    own, shifted = _compared(pair, lag)
    power = float((own @ own) * (shifted @ shifted))
    return float(own @ shifted) / math.sqrt(power) if power > 0.0 else 0.0


def _on_lags(pair: _Pair, lags: np.ndarray) -> np.ndarray:
    """Correlations (n_lags,), interpolated between the lags of the channel's grid.

    What a channel has outside of the reference counts against a lag.
    """
    from scipy.signal import correlate  # slow to import

    step, end = pair.grid, pair.durations[1]
    places = round(pair.step / step) * (pair.places - pair.places[0])
    steps = int(end / step + 1e-9) + 1
    history = interpolate(
        pair.reference, make_interpolation(pair.dt, pair.reference.size, np.minimum(step * np.arange(steps), end))
    )
    there, values = np.zeros((2, places[-1] + 1))
    there[places], values[places] = 1.0, pair.values
    power, product = (correlate(*each, method="fft") for each in ((there, history**2), (values, history)))
    found = product / np.sqrt((pair.values @ pair.values) * np.maximum(power, _LEAST * power.max()))
    grid = pair.start + pair.step * pair.places[0] + step * np.arange(1 - steps, len(there))
    return np.interp(lags, grid, np.clip(found, -1.0, 1.0), left=0.0, right=0.0)


def _best_lag(pairs: Sequence[_Pair], lags: np.ndarray) -> tuple[float, float | None, float]:
    """The lag of the highest score, that of the second highest peak, and the difference of their scores."""
    from scipy.optimize import minimize_scalar  # slow to import

    squares = np.minimum(np.square([_on_lags(pair, lags) for pair in pairs]), _NEARLY_ONE)
    rough = float(lags[np.argmax(-np.log1p(-squares).sum(axis=0))])
    effective = np.array([_effective_samples(pair, rough) for pair in pairs])
    score, step = -0.5 * effective @ np.log1p(-squares), lags[1] - lags[0]
    if np.argmax(score) in (0, len(lags) - 1):
        return float(lags[np.argmax(score)]), None, math.inf

    def negative(trial: float) -> float:
        found = np.array([_coefficient(pair, trial) ** 2 for pair in pairs])
        return float(effective @ np.log1p(-np.minimum(found, _NEARLY_ONE)))

    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]) & (score[1:-1] > 0.0))
    peaks = peaks[np.argsort(-score[peaks])][:_CANDIDATES]
    peaks = peaks[score[peaks] > _CLOSE * score.max()]
    options = {"xatol": 1e-4 * step}
    tops = [
        float(minimize_scalar(negative, bounds=(t - step, t + step), method="bounded", options=options).x)
        for t in lags[peaks]
    ]
    best = tops[0]
    for top in tops[1:]:  # the peaks of a periodic signal differ on the grid of lags more than at their tops
        best = top if _advantage(pairs, top, best) > 0.0 else best
    margins = {top: _advantage(pairs, best, top) for top in tops if top != best}
    second = min(margins, key=margins.__getitem__, default=None)
    return best, second, margins.get(second, math.inf)


def _advantage(pairs: Sequence[_Pair], lag: float, other: float) -> float:
    """Difference between the scores of two lags, over the samples that both compare."""
    total = 0.0
    for pair in pairs:
        common = pair.part(pair.shifted(lag)[0] & pair.shifted(other)[0])
        first, second = (min(_coefficient(common, each) ** 2, _NEARLY_ONE) for each in (lag, other))
        total += 0.5 * _effective_samples(common, lag) * (math.log1p(-second) - math.log1p(-first))
    return total


def _errors(pair: _Pair, lag: float) -> tuple[np.ndarray, float]:
    """Spectrum (n,) of the errors of the shifted reference, n times their variance in the mean, and its factor."""
    from scipy.ndimage import uniform_filter1d  # slow to import

    own, shifted = _compared(pair, lag)
    factor = float(own @ shifted) / max(float(shifted @ shifted), 1e-300)
    lines = np.abs(np.fft.fft(own - factor * shifted)) ** 2
    return uniform_filter1d(lines, max(1, round(_SMOOTH * len(lines))), mode="wrap") + 1e-300, factor


def _effective_samples(pair: _Pair, lag: float) -> float:
    spectrum, _ = _errors(pair, lag)
    scaled = spectrum / spectrum.max()
    return float(scaled.sum() ** 2 / (scaled @ scaled))


def _information(pair: _Pair, lag: float) -> float:
    """Information about the lag [1/s²]."""
    (both, ahead), (other, behind) = (pair.shifted(lag + sign * 0.05 * pair.dt) for sign in (1.0, -1.0))
    common = both & other
    spectrum, factor = _errors(pair.part(common), lag)
    slope = factor * (ahead[common[both]] - behind[common[other]]) / (0.1 * pair.dt)
    lines = np.abs(np.fft.fft(slope, len(spectrum))) ** 2
    return float((len(slope) * (slope @ slope)) ** 2 / max(lines @ spectrum, 1e-300))
