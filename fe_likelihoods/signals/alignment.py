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
    """Lag, gain and sign of channels, and how sure they are; `statement` says it in words."""

    lag: float  # time by which the measurements are later [s]; ``measurements.shift(-lag)`` corrects them
    standard_error: float  # of the lag [s], if the highest peak is the right one
    gain: dict[str, float]  # measurement by reference [-]; negative for a sensor with the opposite sign
    correlation: dict[str, float]  # of each channel with the shifted reference [-]
    probability: float  # of the highest peak, compared with the second one
    second_lag: float | None  # of the second highest peak [s]; None if there is none

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

    def at(self, times: np.ndarray, history: np.ndarray) -> np.ndarray:
        """A history of the reference at times [s], NaN beyond its ends."""
        n, end = len(history), (len(history) - 1) * self.dt
        found = interpolate(history, make_interpolation(self.dt, n, np.clip(times, 0.0, end)))
        return np.where((times >= -1e-9) & (times <= end + 1e-9), found, np.nan)

    def fit(self, lag: float) -> tuple[float, float, float, float, float]:
        """Logarithm of the share of energy that is left, gain, correlation, effective samples, information [1/s²].

        With the derivative s of the shifted reference times its gain, and errors with the spectrum P, the variance of
        the lag by least squares is ``sum(|S|^2 P) / (n sum(s^2))^2``.
        """
        from scipy.ndimage import uniform_filter1d  # slow to import

        times = self.start + self.step * np.arange(len(self.values)) - lag
        histories = (self.reference, np.gradient(self.reference, self.dt))
        rows = np.stack([self.values, *(self.at(times, each) for each in histories)])
        rows = rows[:, np.isfinite(rows).all(axis=0)]
        y, r, slope = rows - rows.mean(axis=1, keepdims=True) if rows.shape[1] > 2 else np.zeros((3, 3))
        gain = float(y @ r) / max(float(r @ r), 1e-300)
        correlation = float(y @ r) / max(math.sqrt(float(y @ y) * float(r @ r)), 1e-300)
        errors, slopes = (np.abs(np.fft.fft(each)) ** 2 for each in (y - gain * r, gain * slope))
        spectrum = uniform_filter1d(errors, max(1, round(_SMOOTH * len(errors))), mode="wrap") + 1e-300
        information = (gain**2 * len(y) * (slope @ slope)) ** 2 / max(slopes @ spectrum, 1e-300)
        spectrum /= spectrum.max()
        worth = float(spectrum.sum() ** 2 / (spectrum @ spectrum))
        return math.log1p(-min(correlation**2, _NEARLY_ONE)), gain, correlation, worth, float(information)

    def losses(self, lags: np.ndarray) -> np.ndarray:
        """The same logarithm on a grid of lags (n_lags,); a channel outside of the reference counts against."""
        from scipy.signal import correlate  # slow to import

        every = max(1, math.ceil(self.step / self.dt - 1e-9))
        step = self.step / every
        times = np.arange(int((len(self.reference) - 1) * self.dt / step + 1e-9) + 1) * step
        there, values = np.zeros((2, every * (len(self.values) - 1) + 1))
        there[::every], values[::every] = np.isfinite(self.values), np.nan_to_num(self.values)
        history = np.nan_to_num(self.at(times, self.reference))
        power, product = (correlate(*each, method="fft") for each in ((there, history**2), (values, history)))
        squares = product**2 / ((values @ values) * np.maximum(power, _LEAST * power.max()))
        grid = self.start + step * np.arange(1 - len(times), len(there))
        return np.log1p(-np.interp(lags, grid, np.minimum(squares, _NEARLY_ONE), left=0.0, right=0.0))


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

    Examples
    --------
    >>> early = Measurements(measurements.channels, 0.05, measurements.values[:, 10:])  # begins 0.5 s too late
    >>> found = align(measurements, early)
    >>> round(found.lag, 2)
    -0.5
    """
    from scipy.optimize import minimize_scalar  # slow to import

    pairs = _pairs(reference, measurements, channels)
    durations = [((len(each.values) - 1) * each.step, (len(each.reference) - 1) * each.dt) for each in pairs]
    longest, max_lag = min(map(max, durations)), 0.5 * min(map(min, durations)) if max_lag is None else max_lag
    if not 0.0 < max_lag < longest:
        raise ValueError(f"max_lag must be positive and below {longest:g} s, the longer duration, got {max_lag!r}")
    step = min(each.step / max(1, math.ceil(each.step / each.dt - 1e-9)) for each in pairs)
    lags = step * np.arange(-math.floor(max_lag / step), math.floor(max_lag / step) + 1)
    score = -sum(each.losses(lags) for each in pairs)
    if (best := int(np.argmax(score))) in (0, len(lags) - 1):
        raise ValueError(
            f"the correlation is largest at a lag of {lags[best]:g} s, an end of the range; give a larger max_lag, or "
            "other channels"
        )
    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]) & (score[1:-1] > 0.0))
    tops = list[tuple[float, list]]()  # the peaks of a periodic signal differ on the grid more than at their tops
    for k in peaks[np.argsort(-score[peaks])][:2]:
        near, options = (lags[k] - step, lags[k] + step), {"xatol": 1e-4 * step}
        found = minimize_scalar(lambda lag: sum(each.fit(lag)[0] for each in pairs), bounds=near, options=options)
        tops.append((float(found.x), [each.fit(float(found.x)) for each in pairs]))
    advantage = math.inf
    if len(tops) > 1:
        advantage = sum(0.5 * a[3] * (b[0] - a[0]) for a, b in zip(tops[0][1], tops[1][1], strict=True))
    (lag, fits), *others = tops if advantage >= 0.0 else tops[::-1]
    names = [each.name for each in pairs]
    return Alignment(
        lag,
        1.0 / math.sqrt(sum(fit[4] for fit in fits) or 1e-300),
        dict(zip(names, (fit[1] for fit in fits), strict=True)),
        dict(zip(names, (fit[2] for fit in fits), strict=True)),
        1.0 / (1.0 + math.exp(-abs(advantage))),
        others[0][0] if others else None,
    )


def _pairs(reference: Record | Measurements, measurements: Measurements, channels: Sequence[str] | None) -> list[_Pair]:
    names = [each.name for each in measurements.channels]
    if isinstance(reference, Record):
        of_motion = [each.name for each in measurements.channels if each.dimension == "acceleration"]
        if channels is None and len(of_motion) != 1:
            raise ValueError(
                f"expected one channel of acceleration among {', '.join(names)}, found {len(of_motion)}; name the one "
                "at the base with channels=, or give a simulated response instead of the record"
            )
        kinds = tuple(Channel(name, "acceleration", "m/s2") for name in channels or of_motion)
        reference = Measurements(kinds, reference.dt, np.tile(reference.acceleration, (len(kinds), 1)))
    if not reference.complete or any(reference.starts):
        raise ValueError("the reference needs all its samples, from time zero; give a simulated response")
    known, pairs = [each.name for each in reference.channels], []
    channels = [name for name in names if name in known] if channels is None else channels
    if not channels or not set(channels) <= set(known):
        raise ValueError(f"the reference has the channels {', '.join(known)}; got {', '.join(channels or names)}")
    for name in channels:
        one, other = measurements.select([name]), reference.select([name])
        values, history = (each.values[0] - np.nanmean(each.values) for each in (one, other))
        if (mine := one.channels[0].dimension) != (theirs := other.channels[0].dimension):
            raise ValueError(f"channel {name!r} is {mine!r}, its reference {theirs!r}; compare like with like")
        if any(np.isfinite(each).sum() < 10 or not np.nanmax(each) > np.nanmin(each) for each in (values, history)):
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        pairs.append(_Pair(name, one.start, one.dt, values, other.dt, history))
    return pairs
