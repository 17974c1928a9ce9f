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
from numpy.typing import NDArray

from .channels import Measurements
from .interpolation import interpolate, make_interpolation
from .records import Record

__all__ = ["Alignment", "align"]

_FEWEST = 0.5  # the shorter of channel and reference must overlap with this share of its energy and of its samples
_CANDIDATES = 8  # number of the highest peaks on the grid of lags that are refined
_WINDOW = 5.0  # length of the sums over lags of autocorrelations, in correlation times
_DRIFT = 4.0  # a drift beyond this many standard errors is stated
_LARGEST_DRIFT = 0.01
_CONTRADICTION = 8.0  # advantage of a channel's own lag over the common lag that is stated: 4 standard errors
_GOOD = 0.7  # correlation below which the reference does not explain the channel


class Alignment(NamedTuple):
    """A lag and its uncertainty.

    Attributes
    ----------
    lag : float
        Time by which the measurements are later than the reference [s]. ``measurements.shift(-lag)`` corrects them; if
        channels have `own_lags`, ``measurements.shift(-lag, [name])`` corrects one channel.
    standard_error : float
        Standard error of the lag [s], if the highest peak is the right one.
    correlation : dict of str to float
        Correlation of each channel with the shifted reference [-]; negative for a sensor with the opposite sign.
    probability : float
        Probability of the highest peak, compared with the second highest peak at a different lag.
    second_lag : float or None
        Lag of the second highest peak [s]; None if there is none.
    drift : float
        Change of the lag per time [-], from the lags of the reference's first and second half (by energy): 0.002 if the
        clock of the measurements gains 2 ms per second.
    drift_error : float
        Standard error of the drift [-]; inf if the halves are too short.
    own_lags : dict of str to float
        Lags of the channels, each by itself [s], if a channel contradicts the common lag; empty if none does.
    """

    lag: float
    standard_error: float
    correlation: dict[str, float]
    probability: float
    second_lag: float | None
    drift: float = 0.0
    drift_error: float = math.inf
    own_lags: dict[str, float] = {}

    @property
    def statement(self) -> str:
        """Uncertainty of the lag, in words."""
        text = f"lag {self.lag:.5g} s, standard error {self.standard_error:.2g} s, correlation " + ", ".join(
            f"{name} {value:.3f}" for name, value in self.correlation.items()
        )
        opposite = [name for name, value in self.correlation.items() if value < -_GOOD]
        if opposite:
            text += f"; the sign is opposite: {', '.join(opposite)}"
        if self.own_lags:
            lags = ", ".join(f"{name} {lag:.5g} s" for name, lag in self.own_lags.items())
            text += (
                f"; NOT SURE: the channels have different lags, each by itself {lags}, so no common lag fits them; "
                "correct each channel with measurements.shift(-lag, [name])"
            )
        low = [name for name, value in self.correlation.items() if abs(value) < _GOOD]
        if low:
            text += f"; NOT SURE: {', '.join(low)} is not a shifted copy of the reference"
        if self.probability < 0.99:
            text += (
                f"; NOT SURE: a lag of {self.second_lag:.5g} s is nearly as good, {self.probability:.0%} for the first"
            )
        if abs(self.drift) > _DRIFT * self.drift_error:
            text += (
                f"; NOT SURE: the lag changes by {100 * self.drift:.2g} % of the time (standard error "
                f"{100 * self.drift_error:.1g} %), so the clocks run at different speeds, or the reference lacks a "
                "part of the motion; correct the time step of the measurements, or align them in parts"
            )
        return text


class _Pair(NamedTuple):
    """A channel, its samples that are not missing (without their mean), and its reference (without its mean), which
    begins at zero.
    """

    name: str
    start: float  # time of the channel's first sample [s]
    step: float  # [s]
    places: NDArray[np.intp]  # (n,) indices of the samples that are not missing
    values: NDArray[np.float64]  # (n,)
    dt: float  # step of the reference [s]
    reference: NDArray[np.float64]  # (n_steps,)

    @property
    def times(self) -> NDArray[np.float64]:
        return self.start + self.step * self.places

    @property
    def end(self) -> float:
        """Time of the last sample of the reference [s]."""
        return (self.reference.size - 1) * self.dt

    @property
    def finer(self) -> int:
        """Number of lags per channel step, so that lags are not farther apart than the reference samples."""
        return max(1, math.ceil(self.step / self.dt - 1e-9))


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
        Largest lag in both directions [s]. Default: half of the shorter duration. At each lag, half of the shorter of
        channel and reference must overlap with the other.

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
    The standard error follows from least squares with correlated errors: the information of a channel is a^2 sum r'^2 /
    (s^2 k), with the variance s^2 of the errors and k = 1 + 2 sum_j q_j p_j for the autocorrelations q of the errors
    and p of the derivative r' of the reference.

    Examples
    --------
    >>> early = Measurements(measurements.channels, 0.05, measurements.values[:, 10:])  # begins 0.5 s too late
    >>> found = align(measurements, early)
    >>> round(found.lag, 2)
    -0.5
    """
    pairs = _pairs(reference, measurements, channels)
    longest = min(max(p.end, float(np.ptp(p.times))) for p in pairs)
    if max_lag is None:
        max_lag = 0.5 * min(min(p.end, float(np.ptp(p.times))) for p in pairs)
    if not 0.0 < max_lag < longest:
        raise ValueError(
            f"max_lag must be positive and below {longest:g} s, the duration of the longer of record and "
            f"measurements, got {max_lag!r}"
        )
    step = min(p.step / p.finer for p in pairs)
    lags = step * np.arange(-math.floor(max_lag / step), math.floor(max_lag / step) + 1)
    correlations = np.array([_on_lags(p, lags) for p in pairs])
    rough = lags[int(np.argmax(-np.log1p(-np.minimum(correlations**2, 1.0 - 1e-12)).sum(axis=0)))]
    effective = np.array([_effective_samples(p, rough) for p in pairs])
    score = -0.5 * effective @ np.log1p(-np.minimum(correlations**2, 1.0 - 1e-12))
    best = int(np.argmax(score))
    if best in (0, len(lags) - 1):
        raise ValueError(
            f"the correlation is largest at a lag of {lags[best]:g} s, an end of the range; give a larger max_lag, or "
            "other channels"
        )
    peaks = 1 + np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:]))
    others = peaks[np.abs(peaks - best) > 1]
    others = others[np.argsort(-score[others], kind="stable")][:_CANDIDATES]
    # the peaks of a periodic signal differ on the grid of lags more than at their tops, but by less than a half
    explained = effective @ correlations**2
    others = others[(explained[others] > 0.5 * explained[best]) | (np.arange(others.size) == 0)]
    lag, *tops = (_refine(pairs, effective, float(lags[k]), step) for k in (best, *others))
    advantages = [_advantage(pairs, effective, lag, top) for top in tops]
    if advantages and min(advantages) < 0.0:
        k = int(np.argmin(advantages))
        lag, tops[k] = tops[k], lag
        advantages = [_advantage(pairs, effective, lag, top) for top in tops]
    advantage = min(advantages, default=math.inf)
    second = tops[int(np.argmin(advantages))] if tops else None
    probability = 1.0 / (1.0 + math.exp(-max(advantage, 0.0)))
    found = {p.name: _correlation(p, lag) for p in pairs}
    information = sum(_information(p, lag) for p in pairs)
    error = 1.0 / math.sqrt(information) if information > 0.0 else math.inf
    own = {p.name: _own_lag(p, n, lags, c, lag, step) for p, n, c in zip(pairs, effective, correlations, strict=True)}
    contradicted = len(pairs) > 1 and any(each != lag for each in own.values())
    drift = _drift(pairs, effective, lag, step)
    return Alignment(lag, error, found, probability, second, *drift, own if contradicted else {})


def _own_lag(
    pair: _Pair, n: float, lags: NDArray[np.float64], correlation: NDArray[np.float64], lag: float, step: float
) -> float:
    """Lag of one channel by itself, or the common lag if the channel does not contradict it."""
    own = _refine([pair], np.array([n]), float(lags[int(np.argmax(np.abs(correlation)))]), step)
    clear = abs(own - lag) > step and _advantage([pair], np.array([n]), own, lag) > _CONTRADICTION
    return own if clear else lag


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
        simulated = {channel.name: channel for channel in reference.channels}
        channels = [name for name in names if name in simulated] if channels is None else channels
        missing = [name for name in channels if name not in simulated]
        if missing or not channels:
            raise ValueError(
                f"the reference has the channels {', '.join(simulated)}; got {', '.join(missing or names)}"
            )
        references = {
            name: (reference.steps[list(simulated).index(name)], reference.channel(name), simulated[name].dimension)
            for name in channels
        }
    pairs = []
    for name in channels:
        one = measurements.select([name])
        values, (channel,) = one.values[0], one.channels
        dt, history, dimension = references[name]
        if channel.dimension != dimension:
            raise ValueError(
                f"channel {name!r} is {channel.quantity!r}, its reference {dimension!r}; compare like with like"
            )
        there = np.isfinite(values)
        if there.sum() < 10 or not np.ptp(values[there]) > 0.0 or history.size < 10 or not np.ptp(history) > 0.0:
            raise ValueError(f"channel {name!r} and its reference need ten samples or more that are not constant")
        known, (start,), (step,) = values[there], one.starts, one.steps
        centred = history - history.mean()
        pairs.append(_Pair(name, start, step, np.flatnonzero(there), known - known.mean(), dt, centred))
    return pairs


def _shifted(pair: _Pair, lag: float) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Samples whose times are within the shifted reference, and the reference there."""
    times = pair.times - lag
    inside = (times >= -1e-9) & (times <= pair.end + 1e-9)
    at = make_interpolation(pair.dt, pair.reference.size, np.clip(times[inside], 0.0, pair.end))
    return inside, interpolate(pair.reference, at)


def _correlation(pair: _Pair, lag: float) -> float:
    """Correlation of a channel and its shifted reference; zero where they do not overlap."""
    inside, shifted = _shifted(pair, lag)
    return _coefficient(pair.values[inside], shifted)


def _coefficient(own: NDArray[np.float64], shifted: NDArray[np.float64]) -> float:
    """Correlation of two arrays; zero for fewer than three values, or constant ones."""
    if own.size < 3 or not np.ptp(own) > 0.0 or not np.ptp(shifted) > 0.0:
        return 0.0
    own, shifted = own - own.mean(), shifted - shifted.mean()
    return float(own @ shifted / math.sqrt((own @ own) * (shifted @ shifted)))


def _on_lags(pair: _Pair, lags: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlations (n_lags,), interpolated between the lags of the grid; zero with too little overlap.

    The grid has the step of the channel, divided so that it is not longer than the step of the reference.
    """
    step, places = pair.step / pair.finer, pair.finer * pair.places
    steps = int(pair.end / step + 1e-9) + 1
    at = make_interpolation(pair.dt, pair.reference.size, np.minimum(step * np.arange(steps), pair.end))
    reference = interpolate(pair.reference, at)
    there, values = np.zeros(places[-1] + 1), np.zeros(places[-1] + 1)
    there[places], values[places] = 1.0, pair.values

    def products(own: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sums over i of own_i other_(i - k), for k = 1 - steps, ..., own.size - 1."""
        size = 2 ** (own.size + steps).bit_length()
        return np.fft.irfft(np.fft.rfft(own, size) * np.fft.rfft(other[::-1], size), size)[: own.size + steps - 1]

    ones = np.ones(steps)
    n, own, squares = (products(each, ones) for each in (there, values, values**2))
    other, other_squares, both = products(there, reference), products(there, reference**2), products(values, reference)
    n = np.maximum(np.rint(n), 1.0)
    own_power, other_power = squares - own**2 / n, other_squares - other**2 / n
    span = places[-1] - places[0] + 1
    if span <= steps:
        enough = (n >= max(10, _FEWEST * places.size)) & (own_power >= _FEWEST * float(pair.values @ pair.values))
        enough &= other_power > 1e-9 * float(reference @ reference)
    else:  # the channel is longer, so half of the reference must overlap with it
        share = places.size / span  # of the samples that are there
        enough = (n >= max(10, _FEWEST * share * steps)) & (own_power > 0.0)
        enough &= other_power >= _FEWEST * share * float(reference @ reference)
    found = np.where(enough, both - own * other / n, 0.0)
    found /= np.sqrt(np.where(enough, own_power * other_power, 1.0))
    grid = pair.start + step * np.arange(1 - steps, there.size)
    return np.interp(lags, grid, np.clip(found, -1.0, 1.0), left=0.0, right=0.0)


def _advantage(pairs: Sequence[_Pair], effective: NDArray[np.float64], lag: float, other: float) -> float:
    """Difference between the scores of two lags, over the samples that both compare."""
    total = 0.0
    for pair, n in zip(pairs, effective, strict=True):
        common = _shifted(pair, lag)[0] & _shifted(pair, other)[0]
        if common.sum() >= 3:
            part = pair._replace(places=pair.places[common], values=pair.values[common])
            first, second = (min(_correlation(part, each) ** 2, 1.0 - 1e-12) for each in (lag, other))
            total += 0.5 * n * common.mean() * (math.log1p(-second) - math.log1p(-first))
    return total


def _refine(pairs: Sequence[_Pair], effective: NDArray[np.float64], lag: float, step: float) -> float:
    """The lag of the highest score within a step."""
    from scipy.optimize import minimize_scalar  # slow to import

    def negative(trial: float) -> float:
        squares = np.array([_correlation(p, trial) ** 2 for p in pairs])
        return float(effective @ np.log1p(-np.minimum(squares, 1.0 - 1e-15)))

    found = minimize_scalar(negative, bounds=(lag - step, lag + step), method="bounded", options={"xatol": 1e-6 * step})
    return float(found.x)


def _drift(pairs: Sequence[_Pair], effective: NDArray[np.float64], lag: float, step: float) -> tuple[float, float]:
    """Change of the lag per time and its standard error, from the lags of the reference's two halves (by energy)."""
    halves = [[_half(pair, lag, later) for pair in pairs] for later in (False, True)]
    if any(half.values.size < 20 for parts in halves for half in parts):
        return 0.0, math.inf
    duration = max(float(np.ptp(pair.times)) for pair in pairs)
    reach = math.ceil(0.25 * _LARGEST_DRIFT * duration / step) + 1
    trials = lag + step * np.arange(-reach, reach + 1)
    scores = np.zeros((2, trials.size))
    for pair, n, *ends in zip(pairs, effective, *halves, strict=True):
        for k, trial in enumerate(trials):
            inside, shifted = _shifted(pair, float(trial))
            own, places = pair.values[inside], pair.places[inside]
            middle = int(np.searchsorted(places, ends[1].places[0]))
            for row, part in enumerate((slice(None, middle), slice(middle, None))):
                scores[row, k] += n * _coefficient(own[part], shifted[part]) ** 2
    lags, centres, variances = [], [], []
    for parts, score in zip(halves, scores, strict=True):
        best = min(max(int(np.argmax(score)), 1), score.size - 2)
        below, top, above = score[best - 1 : best + 2]
        bend = below - 2.0 * top + above
        lags.append(float(trials[best] + (step * 0.5 * (below - above) / bend if bend < 0.0 else 0.0)))
        information = sum(_information(part, lags[-1]) for part in parts)
        variances.append(1.0 / information if information > 0.0 else math.inf)
        motions = [(part.times[inside], motion) for part in parts for inside, motion in [_shifted(part, lag)]]
        centres.append(np.mean([np.average(times, weights=motion**2) for times, motion in motions]))
    apart = float(centres[1] - centres[0])
    # without noise, the interpolation of the reference limits which lags can be distinguished
    error = math.sqrt(sum(variances) + (0.02 * step) ** 2)
    return (lags[1] - lags[0]) / apart, error / apart


def _half(pair: _Pair, lag: float, later: bool) -> _Pair:
    """The samples within the shifted reference that have the first, or the second, half of the energy."""
    inside, motion = _shifted(pair, lag)
    places, values = pair.places[inside], pair.values[inside]
    energy = np.cumsum(motion**2)
    middle = int(np.searchsorted(energy, 0.5 * energy[-1]))
    part = slice(middle, None) if later else slice(None, middle)
    return pair._replace(places=places[part], values=values[part])


def _errors(pair: _Pair, lag: float) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Errors of the best-fitting shifted reference, the shifted reference times its factor, and this factor."""
    inside, shifted = _shifted(pair, lag)
    own, shifted = pair.values[inside] - pair.values[inside].mean(), shifted - shifted.mean()
    factor = float(own @ shifted / (shifted @ shifted))
    return own - factor * shifted, factor * shifted, factor


def _effective_samples(pair: _Pair, lag: float) -> float:
    errors, _, _ = _errors(pair, lag)
    correlation = _autocorrelation(errors)
    return errors.size / max(1.0, 1.0 + 2.0 * _sum_to_window(correlation**2))


def _information(pair: _Pair, lag: float) -> float:
    """Information about the lag [1/s²]."""
    errors, _, factor = _errors(pair, lag)
    ahead, behind = (_shifted(pair, lag + sign * 0.05 * pair.dt) for sign in (1.0, -1.0))
    both = ahead[0] & behind[0]
    slope = factor * (ahead[1][both[ahead[0]]] - behind[1][both[behind[0]]]) / (0.1 * pair.dt)
    variance = float(np.square(errors).mean()) + 1e-300
    n = min(errors.size, slope.size)
    inflation = 1.0 + 2.0 * _sum_to_window(_autocorrelation(errors)[:n] * _autocorrelation(slope)[:n])
    return float(slope @ slope) / (variance * max(inflation, 0.1))


def _autocorrelation(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Autocorrelation of successive samples, gaps not counted, at lags 0, 1, ..."""
    size = 2 ** (2 * values.size - 1).bit_length()
    spectrum = np.fft.rfft(values, size)
    products = np.fft.irfft(spectrum * spectrum.conj(), size)[: values.size]
    return products / products[0] if products[0] > 0.0 else np.eye(1, values.size)[0]


def _sum_to_window(terms: NDArray[np.float64]) -> float:
    """Sum of the terms at lags of one and more, up to five correlation times, because later terms are mostly noise."""
    times = 1.0 + 2.0 * np.cumsum(np.abs(terms[1:]))
    wide = np.flatnonzero(np.arange(1, terms.size) >= _WINDOW * times)
    last = int(wide[0]) + 1 if wide.size else terms.size - 1
    return float(terms[1 : last + 1].sum())
