r"""Lag, gain and sign of measured channels, compared with an excitation or a response.

With the correlation :math:`c(\tau)` of a channel and the reference that is later by :math:`\tau`, the log-likelihood,
maximised over gain and standard deviation of the error, is :math:`-\frac n2 \log(1 - c^2(\tau))`. The lag is where the
sum over the channels, with the effective number of samples in place of n, is largest.
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
_CONTRADICTION = 8.0  # advantage of a channel's own lag over the common one that is stated: 4 standard errors
_GOOD = 0.7  # correlation below which the reference does not explain the channel
_SMOOTH = 0.02  # share of the lines over which the spectrum of errors is averaged
_SURE = 0.99  # probability of the highest peak below which the second one is stated
_NEARLY_ONE = 1.0 - 1e-12  # largest squared correlation


class Alignment(NamedTuple):
    """Lag, gain and sign of channels, and how sure they are.

    Attributes
    ----------
    lag : float
        Time by which the measurements are later than the reference [s]. ``measurements.shift(-lag)`` corrects them.
    standard_error : float
        Standard error of the lag [s], if the highest peak is the right one.
    gain : dict of str to float
        Measurement by reference of each channel [-]; negative for a sensor with the opposite sign.
    correlation : dict of str to float
        Correlation of each channel with the shifted reference [-].
    probability : float
        Probability of the highest peak, compared with the second highest peak at a different lag.
    second_lag : float or None
        Lag of the second highest peak [s]; None if there is none.
    own_lags : dict of str to float
        Lag of each channel by itself [s], if one contradicts the common lag (``measurements.shift(-lag, [name])``
        corrects one); else of the first and the second half, if one contradicts it: clocks of different speed.
    """

    lag: float
    standard_error: float
    gain: dict[str, float]
    correlation: dict[str, float]
    probability: float
    second_lag: float | None
    own_lags: dict[str, float] = {}

    @property
    def statement(self) -> str:
        """Lag, gains and their uncertainty, in words."""
        shown = ", ".join(f"{name} {self.gain[name]:.3g} ({c:.3f})" for name, c in self.correlation.items())
        lags = ", ".join(f"{name} {lag:.5g} s" for name, lag in self.own_lags.items())
        opposite = ", ".join(name for name, value in self.correlation.items() if value < -_GOOD)
        low = ", ".join(name for name, value in self.correlation.items() if abs(value) < _GOOD)
        nearly = "" if self.second_lag is None else f"{self.second_lag:.5g} s is nearly as good, {self.probability:.0%}"
        return "; ".join(
            [f"lag {self.lag:.5g} s, standard error {self.standard_error:.2g} s, gain (correlation) {shown}"]
            + ([f"the sign is opposite: {opposite}"] if opposite else [])
            + ([f"NOT SURE: parts have other lags, each by itself {lags}: see own_lags"] if lags else [])
            + ([f"NOT SURE: {low} is not a shifted copy of the reference"] if low else [])
            + ([f"NOT SURE: {nearly} for the first"] if self.probability < _SURE else [])
        )


class _Fit(NamedTuple):
    """A channel by the shifted reference."""

    gain: float
    correlation: float  # zero where nothing is compared
    effective: float  # number of samples
    spectrum: np.ndarray  # of the errors

    def score(self, size: float) -> float:
        """Log-likelihood of as many independent samples."""
        return -0.5 * size * math.log1p(-min(self.correlation**2, _NEARLY_ONE))


class _Pair(NamedTuple):
    """Samples (n,) of a channel at times from `start` [s], NaN where missing, and a reference from time zero."""

    name: str
    start: float
    step: float  # [s]
    values: np.ndarray
    dt: float  # step of the reference [s]
    reference: np.ndarray

    @property
    def ends(self) -> tuple[float, float]:
        """Durations of the channel and of the reference [s]."""
        return float(np.ptp(np.flatnonzero(np.isfinite(self.values)))) * self.step, (len(self.reference) - 1) * self.dt

    @property
    def grid(self) -> float:
        """Step of the lags [s]: the channel's, divided so that it is not longer than the reference's."""
        return self.step / max(1, math.ceil(self.step / self.dt - 1e-9))

    def only(self, chosen: np.ndarray) -> "_Pair":
        """The pair without the samples that are not chosen."""
        return self._replace(values=np.where(chosen, self.values, np.nan))

    def at(self, times: np.ndarray) -> np.ndarray:
        """The reference at times within its ends."""
        return interpolate(self.reference, make_interpolation(self.dt, len(self.reference), times))

    def shifted(self, lag: float) -> np.ndarray:
        """The shifted reference at the times of the samples, NaN where it, or the sample, is unknown."""
        times, end = self.start + self.step * np.arange(len(self.values)) - lag, self.ends[1]
        known = (times >= -1e-9) & (times <= end + 1e-9) & np.isfinite(self.values)
        return np.where(known, self.at(np.clip(times, 0.0, end)), np.nan)

    def fit(self, lag: float) -> _Fit:
        """Least squares at a lag."""
        from scipy.ndimage import uniform_filter1d  # slow to import

        shifted = self.shifted(lag)
        both = np.isfinite(shifted)
        y, r = (x[both] - x[both].mean() if both.sum() > 2 else np.zeros(3) for x in (self.values, shifted))
        product, power, own = float(y @ r), float(r @ r), float(y @ y)
        gain = product / max(power, 1e-300)
        lines = np.abs(np.fft.fft(y - gain * r)) ** 2
        spectrum = uniform_filter1d(lines, max(1, round(_SMOOTH * len(lines))), mode="wrap") + 1e-300
        scaled = spectrum / spectrum.max()
        correlation = product / math.sqrt(power * own) if power * own > 0.0 else 0.0
        return _Fit(gain, correlation, float(scaled.sum() ** 2 / (scaled @ scaled)), spectrum)

    def information(self, lag: float) -> float:
        """Information about the lag [1/s²]."""
        ahead, behind = (self.shifted(lag + sign * 0.05 * self.dt) for sign in (1.0, -1.0))
        common = np.isfinite(ahead + behind)
        fit = self.only(common).fit(lag)
        slope = fit.gain * (ahead - behind)[common] / (0.1 * self.dt)
        lines = np.abs(np.fft.fft(slope)) ** 2
        return float((len(slope) * (slope @ slope)) ** 2 / max(lines @ fit.spectrum, 1e-300))

    def on(self, lags: np.ndarray) -> np.ndarray:
        """Correlations (n_lags,); what a channel has outside of the reference counts against a lag."""
        from scipy.signal import correlate  # slow to import

        step, end = self.grid, self.ends[1]
        every, steps = round(self.step / step), int(end / step + 1e-9) + 1
        history = self.at(np.minimum(step * np.arange(steps), end))
        there, values = np.zeros((2, every * (len(self.values) - 1) + 1))
        there[::every], values[::every] = np.isfinite(self.values), np.nan_to_num(self.values)
        power, product = (correlate(*each, method="fft") for each in ((there, history**2), (values, history)))
        found = product / np.sqrt((values @ values) * np.maximum(power, _LEAST * power.max()))
        grid = self.start + step * np.arange(1 - steps, len(there))
        return np.interp(lags, grid, np.clip(found, -1.0, 1.0), left=0.0, right=0.0)


def align(
    reference: Record | Measurements,
    measurements: Measurements,
    channels: Sequence[str] | None = None,
    max_lag: float | None = None,
) -> Alignment:
    """Estimate lag, gain and sign of measurements by cross-correlation.

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
        Its ``statement`` gives lag, error and gains in words, and says where they are not sure.

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
    longest = min(max(pair.ends) for pair in pairs)
    max_lag = 0.5 * min(min(pair.ends) for pair in pairs) if max_lag is None else max_lag
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
    own, halves = dict[str, float](), {"first half": list[_Pair](), "second half": list[_Pair]()}
    for pair in pairs:  # the samples with the first and the second half of the energy
        energy = np.nancumsum(np.square(pair.shifted(lag)))
        for part, chosen in zip(halves.values(), (energy < 0.5 * energy[-1], energy >= 0.5 * energy[-1]), strict=True):
            part.append(pair.only(chosen))
    for parts in ({pair.name: [pair] for pair in pairs}, halves):
        some = {name: part for name, part in parts.items() if all(np.nan_to_num(pair.values).any() for pair in part)}
        found = {name: _best_lag(part, lags)[0] for name, part in some.items()}
        apart = [abs(t - lag) > step and _advantage(parts[name], t, lag) > _CONTRADICTION for name, t in found.items()]
        own = found if any(apart) and not own else own
    fits, information = {pair.name: pair.fit(lag) for pair in pairs}, sum(pair.information(lag) for pair in pairs)
    return Alignment(
        lag,
        1.0 / math.sqrt(information) if information > 0.0 else math.inf,
        {name: fit.gain for name, fit in fits.items()},
        {name: fit.correlation for name, fit in fits.items()},
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
        known = dict.fromkeys(channels, (reference.dt, reference.acceleration, "acceleration"))
    else:
        if not reference.complete or any(reference.starts):
            raise ValueError("the reference needs all its samples, from time zero; give a simulated response")
        rows = zip(reference.channels, reference.steps, reference.values, strict=True)
        known = {channel.name: (step, history, channel.dimension) for channel, step, history in rows}
        channels = [name for name in names if name in known] if channels is None else channels
        missing = [name for name in channels if name not in known]
        if missing or not channels:
            raise ValueError(f"the reference has the channels {', '.join(known)}; got {', '.join(missing or names)}")
    pairs = []
    for name in channels:
        (dt, history, dimension), one = known[name], measurements.select([name])
        values, (channel,) = one.values[0], one.channels
        if channel.dimension != dimension:
            raise ValueError(
                f"channel {name!r} is {channel.quantity!r}, its reference {dimension!r}; compare like with like"
            )
        if any(np.isfinite(each).sum() < 10 or not np.nanmax(each) > np.nanmin(each) for each in (values, history)):
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        pairs.append(_Pair(name, one.start, one.dt, values - np.nanmean(values), dt, history - history.mean()))
    return pairs


def _best_lag(pairs: Sequence[_Pair], lags: np.ndarray) -> tuple[float, float | None, float]:
    """The lag of the highest score, that of the second highest peak, and the difference of their scores."""
    from scipy.optimize import minimize_scalar  # slow to import

    squares = np.minimum(np.square([pair.on(lags) for pair in pairs]), _NEARLY_ONE)
    rough = float(lags[np.argmax(-np.log1p(-squares).sum(axis=0))])
    effective = np.array([pair.fit(rough).effective for pair in pairs])
    score, step = -0.5 * effective @ np.log1p(-squares), lags[1] - lags[0]
    if np.argmax(score) in (0, len(lags) - 1):
        return float(lags[np.argmax(score)]), None, math.inf

    def negative(trial: float) -> float:
        return -sum(pair.fit(trial).score(size) for pair, size in zip(pairs, effective, strict=True))

    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]) & (score[1:-1] > 0.0))
    tops = [  # the peaks of a periodic signal differ on the grid of lags more than at their tops
        float(minimize_scalar(negative, bounds=(t - step, t + step), options={"xatol": 1e-4 * step}).x)
        for t in lags[peaks[np.argsort(-score[peaks])][:2]]
    ]
    if len(tops) < 2:
        return tops[0], None, math.inf
    advantage = _advantage(pairs, *tops)
    return (*tops, advantage) if advantage >= 0.0 else (*tops[::-1], -advantage)


def _advantage(pairs: Sequence[_Pair], lag: float, other: float) -> float:
    """Difference between the scores of two lags, over the samples that both compare."""
    total = 0.0
    for pair in pairs:
        first, second = map(pair.only(np.isfinite(pair.shifted(lag) + pair.shifted(other))).fit, (lag, other))
        total += first.score(first.effective) - second.score(first.effective)
    return total
