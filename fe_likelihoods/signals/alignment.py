r"""Lag, gain and sign of measured channels, compared with a response or an excitation.

With the correlation :math:`c(\tau)` of a channel and the reference that is later by :math:`\tau`, the log-likelihood,
maximised over gain and standard deviation of the error, is :math:`-\frac n2 \log(1 - c^2(\tau))`. The lag is where the
sum over the channels is largest. With the effective number of samples in place of n, two peaks are compared.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.optimize import minimize_scalar

from .channels import Measurements
from .sampling import interpolate, make_interpolation

_SMOOTH = 0.02  # share of the lines over which the spectrum of errors is averaged
_SURE = 0.99  # probability of the highest peak, up to which the second one is stated
_NEARLY_ONE = 1.0 - 1e-12  # largest squared correlation


class Alignment(NamedTuple):
    """Lag, gain and sign of channels, and how sure they are; `statement` says it in words."""

    lag: float  # time by which the measurements are later [s]; ``measurements.shift(-lag)`` corrects them
    standard_error: float  # of the lag [s], if the highest peak is the right one
    gain: dict[str, float]  # measurement by reference [-]; negative for a sensor with the opposite sign
    correlation: dict[str, float]  # of each channel with the shifted reference [-]
    second_lag: float | None  # of another peak that is nearly as high [s]; None if there is none

    @property
    def statement(self) -> str:
        """Lag, gains and their uncertainty, in words."""
        shown = ", ".join(f"{name} {self.gain[name]:.3g} ({c:.3f})" for name, c in self.correlation.items())
        # less is explained than left
        low = ", ".join(name for name, value in self.correlation.items() if value**2 < 1.0 - value**2)
        text = f"lag {self.lag:.5g} s, standard error {self.standard_error:.2g} s, gain (correlation) {shown}"
        text += f"; NOT SURE: {low} is not a shifted copy of the reference" if low else ""
        return text if self.second_lag is None else f"{text}; NOT SURE: {self.second_lag:.5g} s is nearly as good"


class _Pair(NamedTuple):
    """Samples (n,) of a channel from `start` [s] on, NaN where missing, and a reference (m,) from time zero on."""

    start: float
    step: float  # of both [s]
    values: np.ndarray
    reference: np.ndarray

    def fit(self, lag: float) -> tuple[float, float, float, float, float]:
        """Logarithm of the share of energy that is left, gain, correlation, effective samples, information [1/s²]."""
        there, end = np.flatnonzero(np.isfinite(self.values)), self.step * (len(self.reference) - 1)
        there = there[np.abs(self.start + self.step * there - lag - 0.5 * end) <= 0.5 * end + 1e-9]
        at = make_interpolation(self.step, len(self.reference), self.start + self.step * there - lag)
        computed = (interpolate(each, at) for each in (self.reference, np.gradient(self.reference, self.step)))
        rows = np.stack([self.values[there], *computed])
        y, r, slope = rows - rows.mean(axis=1, keepdims=True) if len(there) > 2 else np.zeros((3, 3))
        gain = float(y @ r) / max(float(r @ r), 1e-300)
        correlation = float(y @ r) / max(math.sqrt(float(y @ y) * float(r @ r)), 1e-300)
        errors, slopes = (np.abs(np.fft.fft(each)) ** 2 for each in (y - gain * r, gain * slope))
        spectrum = uniform_filter1d(errors, max(1, round(_SMOOTH * len(errors))), mode="wrap") + 1e-140
        # of slopes s and errors with the spectrum P, the variance of a lag is sum(|S|^2 P) / (n sum(s^2))^2
        information = (gain**2 * len(y) * (slope @ slope)) ** 2 / max(slopes @ spectrum, 1e-300)
        worth = float(spectrum.sum() ** 2 / (spectrum @ spectrum))
        return math.log1p(-min(correlation**2, _NEARLY_ONE)), gain, correlation, worth, float(information)

    def losses(self, lags: np.ndarray) -> np.ndarray:
        """The same logarithm on a grid of lags (n_lags,); a channel outside of the reference counts against."""
        there, values, history = np.isfinite(self.values), np.nan_to_num(self.values), self.reference[::-1]
        n = len(values) + len(history) - 1  # of a correlation at all lags
        power, product = np.fft.irfft(np.fft.rfft([there, values], n) * np.fft.rfft([history**2, history], n), n)
        squares = product**2 / ((values @ values) * np.maximum(power, (1.0 - _NEARLY_ONE) * power.max()))
        grid = self.start + self.step * np.arange(1 - len(history), len(there))
        return np.log1p(-np.interp(lags, grid, np.minimum(squares, _NEARLY_ONE), left=0.0, right=0.0))


def align(reference: Measurements, measurements: Measurements, max_lag: float | None = None) -> Alignment:
    """Estimate lag, gain and sign of measurements by cross-correlation.

    Parameters
    ----------
    reference : Measurements
        A simulated response, ``Measurements(model.channels, model.dt, model.simulate(x))``, or what excites a sensor at
        the base, ``Measurements([Channel("base", "acceleration", "g")], record.dt, [record.acceleration])``.
    measurements : Measurements
        Channels that the reference has as well are compared; with clocks of their own one by one, ``select([name])``.
    max_lag : float, optional
        Largest lag in both directions [s]. Default: half of the shorter duration.

    Returns
    -------
    Alignment
        Its ``statement`` gives lag, error and gains in words, and says where they are not sure.

    Raises
    ------
    ValueError
        If channels do not fit, or the correlation is largest at an end of the lag range.

    Examples
    --------
    >>> early = Measurements(measurements.channels, 0.05, measurements.values[:, 10:])  # begins 0.5 s too late
    >>> found = align(measurements, early)
    >>> round(found.lag, 2)
    -0.5
    """
    pairs = _pairs(reference, measurements)
    shorter = min(each.step * (len(history) - 1) for each in pairs.values() for history in each[2:])
    reach, step = 0.5 * shorter if max_lag is None else max_lag, min(each.step for each in pairs.values())
    lags = step * np.arange(-math.floor(reach / step), math.floor(reach / step) + 1)
    score = -sum(each.losses(lags) for each in pairs.values())
    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:]))
    if not len(peaks) or score.max() > score[peaks].max():
        raise ValueError(f"the correlation is largest at {reach:g} s, an end of the range; give a larger max_lag")
    tops = list[tuple[float, float]]()  # the peaks of a periodic signal differ on the grid more than at their tops
    for k in peaks[np.argsort(-score[peaks])][:2]:
        near, options = (lags[k] - step, lags[k] + step), {"xatol": 1e-4 * step}
        top = minimize_scalar(lambda x: sum(each.fit(x)[0] for each in pairs.values()), bounds=near, options=options)
        tops.append((top.fun, float(top.x)))
    lag, other = min(tops)[1], max(tops)[1]
    first, second = (np.array([each.fit(at) for each in pairs.values()]).T for at in (lag, other))
    alike = 0.5 * first[3] @ (second[0] - first[0]) < -math.log(1.0 / _SURE - 1.0)
    error, second_lag = 1.0 / math.sqrt(first[4].sum() or 1e-300), other if alike and other != lag else None
    return Alignment(lag, error, *(dict(zip(pairs, each.tolist(), strict=True)) for each in first[1:3]), second_lag)


def _pairs(reference: Measurements, measurements: Measurements) -> dict[str, _Pair]:
    if not reference.complete or any(reference.starts):
        raise ValueError("the reference needs all its samples, from time zero; give a simulated response")
    known, pairs = [each.name for each in reference.channels], {}
    for name in (each.name for each in measurements.channels if each.name in known):
        one, other = measurements.select([name]), reference.select([name])
        values, history = (each.values[0] - np.nanmean(each.values) for each in (one, other))
        if (mine := one.channels[0].dimension) != (theirs := other.channels[0].dimension):
            raise ValueError(f"channel {name!r} is {mine!r}, its reference {theirs!r}; compare like with like")
        if any(np.isfinite(each).sum() < 10 or not np.nanmax(each) > np.nanmin(each) for each in (values, history)):
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        every = max(1, math.ceil(one.dt / other.dt - 1e-9))
        step, fine = one.dt / every, np.full(every * (len(values) - 1) + 1, np.nan)
        fine[::every] = values
        times = step * np.arange(int((len(history) - 1) * other.dt / step + 1e-9) + 1)
        history = interpolate(history, make_interpolation(other.dt, len(history), times))
        pairs[name] = _Pair(one.start, step, fine, history)
    if not pairs:
        raise ValueError(f"the reference has the channels {', '.join(known)}, the measurements none of them")
    return pairs
