r"""Lag, gain and sign of measured channels, compared with an excitation or a response.

With the correlation :math:`c(\tau)` of a channel and the reference that is later by :math:`\tau`, the log-likelihood,
maximised over gain and standard deviation of the error, is :math:`-\frac n2 \log(1 - c^2(\tau))`. The lag is where the
sum over the channels is largest. With the effective number of samples in place of n, two peaks are compared.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .channels import Channel, Measurements
from .interpolation import interpolate, make_interpolation
from .records import Record

__all__ = ["Alignment", "align"]

_LEAST = 1e-3  # energy of the reference at a lag, of the largest at any lag, below which nothing is compared
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
    """

    lag: float
    standard_error: float
    gain: dict[str, float]
    correlation: dict[str, float]
    probability: float
    second_lag: float | None

    @property
    def statement(self) -> str:
        """Lag, gains and their uncertainty, in words."""
        shown = ", ".join(f"{name} {self.gain[name]:.3g} ({c:.3f})" for name, c in self.correlation.items())
        opposite = ", ".join(name for name, value in self.correlation.items() if value < -_GOOD)
        low = ", ".join(name for name, value in self.correlation.items() if abs(value) < _GOOD)
        text = f"lag {self.lag:.5g} s, standard error {self.standard_error:.2g} s, gain (correlation) {shown}"
        text += f"; the sign is opposite: {opposite}" if opposite else ""
        text += f"; NOT SURE: {low} is not a shifted copy of the reference" if low else ""
        if self.second_lag is not None and self.probability < _SURE:
            text += f"; NOT SURE: {self.second_lag:.5g} s is nearly as good, {self.probability:.0%} for the first"
        return text


class _Pair(NamedTuple):
    """Samples (n,) of a channel at times from `start` [s], NaN where missing, and a reference from time zero."""

    name: str
    start: float
    step: float  # [s]
    values: np.ndarray
    dt: float  # step of the reference [s]
    reference: np.ndarray

    @property
    def durations(self) -> tuple[float, float]:
        """Of the channel and of the reference [s]."""
        return float(np.ptp(np.flatnonzero(np.isfinite(self.values)))) * self.step, (len(self.reference) - 1) * self.dt

    def at(self, times: np.ndarray) -> np.ndarray:
        """The reference at times [s], NaN beyond its ends."""
        end = self.durations[1]
        found = interpolate(self.reference, make_interpolation(self.dt, len(self.reference), np.clip(times, 0.0, end)))
        return np.where((times >= -1e-9) & (times <= end + 1e-9), found, np.nan)

    def both(self, *lags: float) -> np.ndarray:
        """Samples and references of these lags (1 + n_lags, n) where all are known, less their means."""
        times = self.start + self.step * np.arange(len(self.values))
        rows = np.stack([self.values, *(self.at(times - lag) for lag in lags)])
        rows = rows[:, np.isfinite(rows).all(axis=0)]
        return rows - rows.mean(axis=1, keepdims=True) if rows.shape[1] > 2 else np.zeros((len(rows), 3))

    def on(self, lags: np.ndarray, step: float) -> np.ndarray:
        """Squared correlations (n_lags,), on a grid of this step; a channel outside of the reference counts against."""
        from scipy.signal import correlate  # slow to import

        times = np.arange(int(self.durations[1] / step + 1e-9) + 1) * step
        every = round(self.step / step)
        there, values = np.zeros((2, every * (len(self.values) - 1) + 1))
        there[::every], values[::every] = np.isfinite(self.values), np.nan_to_num(self.values)
        history = np.nan_to_num(self.at(times))
        power, product = (correlate(*each, method="fft") for each in ((there, history**2), (values, history)))
        squares = product**2 / ((values @ values) * np.maximum(power, _LEAST * power.max()))
        grid = self.start + step * np.arange(1 - len(times), len(there))
        return np.interp(lags, grid, np.minimum(squares, _NEARLY_ONE), left=0.0, right=0.0)


def _fit(y: np.ndarray, r: np.ndarray) -> tuple[float, float, float, np.ndarray]:
    """Gain, correlation, effective number of samples and spectrum of the errors of samples by a reference (n,)."""
    from scipy.ndimage import uniform_filter1d  # slow to import

    product, power, own = float(y @ r), float(r @ r), float(y @ y)
    gain = product / max(power, 1e-300)
    lines = np.abs(np.fft.fft(y - gain * r)) ** 2
    spectrum = uniform_filter1d(lines, max(1, round(_SMOOTH * len(lines))), mode="wrap") + 1e-300
    scaled = spectrum / spectrum.max()
    correlation = product / math.sqrt(power * own) if power * own > 0.0 else 0.0
    return gain, correlation, float(scaled.sum() ** 2 / (scaled @ scaled)), spectrum


def _information(pair: _Pair, lag: float) -> float:
    """Information about the lag [1/s²]."""
    y, r, ahead, behind = pair.both(lag, lag + 0.05 * pair.dt, lag - 0.05 * pair.dt)
    gain, _, _, spectrum = _fit(y, r)
    slope = gain * (ahead - behind) / (0.1 * pair.dt)
    lines = np.abs(np.fft.fft(slope)) ** 2
    return float((len(slope) * (slope @ slope)) ** 2 / max(lines @ spectrum, 1e-300))


def _loss(correlation: float) -> float:
    return math.log1p(-min(correlation**2, _NEARLY_ONE))


def _advantage(pair: _Pair, lag: float, other: float) -> float:
    """Difference between the log-likelihoods of two lags, over the samples that both compare."""
    y, first, second = pair.both(lag, other)
    _, correlation, effective, _ = _fit(y, first)
    return 0.5 * effective * (_loss(_fit(y, second)[1]) - _loss(correlation))


def align(
    reference: Record | Measurements,
    measurements: Measurements,
    channels: Sequence[str] | None = None,
    max_lag: float | None = None,
) -> Alignment:
    """Estimate lag, gain and sign of measurements by cross-correlation.

    Channels with clocks of their own are aligned one by one, with ``channels=[name]``.

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
    from scipy.optimize import minimize_scalar  # slow to import

    pairs = _pairs(reference, measurements, channels)
    longest = min(max(pair.durations) for pair in pairs)
    max_lag = 0.5 * min(min(pair.durations) for pair in pairs) if max_lag is None else max_lag
    if not 0.0 < max_lag < longest:
        raise ValueError(
            f"max_lag must be positive and below {longest:g} s, the duration of the longer of record and "
            f"measurements, got {max_lag!r}"
        )
    steps = [pair.step / max(1, math.ceil(pair.step / pair.dt - 1e-9)) for pair in pairs]
    step = min(steps)
    lags = step * np.arange(-math.floor(max_lag / step), math.floor(max_lag / step) + 1)
    score = -sum(np.log1p(-pair.on(lags, own)) for pair, own in zip(pairs, steps, strict=True))
    best = int(np.argmax(score))
    if best in (0, len(lags) - 1):
        raise ValueError(
            f"the correlation is largest at a lag of {lags[best]:g} s, an end of the range; give a larger max_lag, or "
            "other channels"
        )
    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]) & (score[1:-1] > 0.0))
    tops = [  # the peaks of a periodic signal differ on the grid of lags more than at their tops
        float(
            minimize_scalar(
                lambda trial: sum(_loss(_fit(*pair.both(trial))[1]) for pair in pairs),
                bounds=(lags[k] - step, lags[k] + step),
                options={"xatol": 1e-4 * step},
            ).x
        )
        for k in peaks[np.argsort(-score[peaks])][:2]
    ]
    advantage = sum(_advantage(pair, *tops) for pair in pairs) if len(tops) > 1 else math.inf
    lag, *others = tops if advantage >= 0.0 else tops[::-1]
    fits, information = {pair.name: _fit(*pair.both(lag)) for pair in pairs}, sum(_information(p, lag) for p in pairs)
    return Alignment(
        lag,
        1.0 / math.sqrt(information) if information > 0.0 else math.inf,
        {name: fit[0] for name, fit in fits.items()},
        {name: fit[1] for name, fit in fits.items()},
        1.0 / (1.0 + math.exp(-abs(advantage))),
        others[0] if others else None,
    )


def _pairs(reference: Record | Measurements, measurements: Measurements, channels: Sequence[str] | None) -> list[_Pair]:
    names = [channel.name for channel in measurements.channels]
    if isinstance(channels, str):
        raise ValueError(f"channels takes a sequence of names, for instance [{channels!r}]")
    if isinstance(reference, Record):
        if channels is None:
            channels = [each.name for each in measurements.channels if each.dimension == "acceleration"]
            if len(channels) != 1:
                raise ValueError(
                    f"expected one channel of acceleration among {', '.join(names)}, found {len(channels)}; name the "
                    "one at the base with channels=, or give a simulated response instead of the record"
                )
        kinds = tuple(Channel(name, "acceleration", "m/s2") for name in channels)
        reference = Measurements(kinds, reference.dt, np.tile(reference.acceleration, (len(kinds), 1)))
    if not reference.complete or any(reference.starts):
        raise ValueError("the reference needs all its samples, from time zero; give a simulated response")
    known = [channel.name for channel in reference.channels]
    channels = [name for name in names if name in known] if channels is None else channels
    if not channels or not set(channels) <= set(known):
        raise ValueError(f"the reference has the channels {', '.join(known)}; got {', '.join(channels or names)}")
    pairs = []
    for name in channels:
        one, other = measurements.select([name]), reference.select([name])
        (channel,), (values,), (history,) = one.channels, one.values, other.values
        if channel.dimension != other.channels[0].dimension:
            raise ValueError(
                f"channel {name!r} is {channel.quantity!r}, its reference {other.channels[0].dimension!r}; compare "
                "like with like"
            )
        if any(np.isfinite(each).sum() < 10 or not np.nanmax(each) > np.nanmin(each) for each in (values, history)):
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        pairs.append(_Pair(name, one.start, one.dt, values - np.nanmean(values), other.dt, history - history.mean()))
    return pairs
