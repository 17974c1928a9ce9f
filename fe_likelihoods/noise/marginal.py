"""White noise with its standard deviations integrated out: a likelihood of the structural parameters alone.

Given the sum of squared residuals J of n samples, the likelihood is one integral per standard deviation::

    L(J) = integral of (2 pi)^(-n/2) sigma^-n exp(-J / (2 sigma^2)) p(sigma) d sigma

under its prior p. The evidence and the posterior of the structural parameters are the same; the standard deviations are
drawn afterwards. In t = log sigma the integrand has one maximum, with a width of 1 / sqrt(2 n) where the likelihood
dominates. A refined grid finds it, bisection finds where the integrand has decreased by exp(-36), and Gauss-Legendre
quadrature gives the integral in between. Priors may be bounded. See ``docs/theory/likelihood.rst``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..priors.truncated_normal_integrals import HALF_LOG_TWO_PI
from ..signals.channels import Channel
from .gaussian import GaussianNoise
from .protocol import Noise, noise_title
from .sufficient_statistics import SampleCounts, samples_per_channel

_FALL = 36.0  # decrease of the logarithm at which the integrand is negligible in double precision
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(48)
_GRID = np.linspace(0.0, 1.0, 17)
_MAX_ITERATIONS = 40
_CELLS = 512  # intervals of the tabulated distribution function, which is inverted for draws


@dataclass(frozen=True)
class MarginalNoise:
    """White noise without parameters: the parameters of a `GaussianNoise` are integrated out under their priors.

    Its levels are in SI units, per channel or for all channels; effective samples are allowed, known sensor noise is
    not. `priors` are of exactly the noise's parameters. Raises ValueError for any other noise or priors.

    If the integrand has one maximum, the likelihood is accurate to eight digits for a hundred samples or more and to
    six digits for ten. Half-normal, uniform and lognormal priors make the integrand log-concave in log sigma, so it has
    one maximum. It can have two if an informative `TruncatedNormal` prior is many of its standard deviations away from
    a likelihood with few effective samples; the lower maximum is then left out.
    """

    noise: GaussianNoise
    priors: tuple[Any, ...]

    def __init__(self, noise: GaussianNoise, priors: Mapping[str, Any]) -> None:
        if not isinstance(noise, GaussianNoise) or not noise.white or noise.sensor is not None:
            raise ValueError(
                "marginal() integrates out the standard deviations of white noise in SI units, GaussianNoise(channels) "
                'or GaussianNoise(channels, groups="all"), without sensor noise; got '
                f"{noise_title(noise)}: keep the parameters of this noise"
            )
        object.__setattr__(self, "noise", noise)
        if set(priors) != set(noise.parameter_names):
            raise ValueError(
                f"expected priors of the noise parameters {', '.join(noise.parameter_names)}; got priors of "
                f"{', '.join(priors) or 'none'}"
            )
        object.__setattr__(self, "priors", tuple(priors[name] for name in noise.parameter_names))

    @property
    def title(self) -> str:
        """Title of the noise, with the remark that its levels are integrated out."""
        return f"{noise_title(self.noise)}, its levels integrated out"

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels of the noise."""
        return self.noise.channels

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """No parameters."""
        return ()

    def log_likelihood(self, misfit: np.ndarray, n_samples: int | SampleCounts, parameters: Any = None) -> np.ndarray:
        """Log-likelihood (n,) of sums of squared residuals (n, n_channels) [SI unit of the channel, squared].

        It is -inf where the misfit is NaN (a failed simulation) or infinite; +inf where it is zero and the prior allows
        sigma = 0 (the integral diverges); never NaN. `parameters` is ignored: the noise has none.
        """
        misfit = np.asarray(misfit, dtype=float)
        total = np.full(len(misfit), -np.inf)
        usable = np.isfinite(misfit).all(axis=1)
        if usable.any():
            squares, counts, constant = self._sums(misfit[usable], n_samples)
            terms = [log_integral(*one) for one in zip(squares.T, counts, self.priors, strict=True)]
            total[usable] = constant + np.sum(terms, axis=0)
        return total

    def draw(self, misfit: np.ndarray, n_samples: int | SampleCounts, uniform: np.ndarray) -> np.ndarray:
        """Parameters (n, n_noise) of `noise` from their conditional posterior, one row per misfit (n, n_channels).

        `uniform` (n, n_noise) are independent random numbers in [0, 1). Raises ValueError for a misfit that is not
        finite and positive.
        """
        misfit = np.asarray(misfit, dtype=float)
        good = (np.isfinite(misfit) & (misfit > 0.0)).all(axis=1)
        if not good.all():
            raise ValueError(
                f"the noise can only be drawn where the misfit is finite and positive; in {(~good).sum()} of "
                f"{len(good)} rows it is not, because the simulation failed or fits exactly: leave these rows out"
            )
        squares, counts, _ = self._sums(misfit, n_samples)
        columns = [_draws(*one) for one in zip(squares.T, counts, self.priors, uniform.T, strict=True)]
        return np.stack(columns, axis=1)

    def _sums(self, misfit: np.ndarray, n_samples: int | SampleCounts) -> tuple[np.ndarray, np.ndarray, float]:
        """Sums of squares (n, n_noise) and sample counts (n_noise,) per sigma, and a constant of the log-likelihood."""
        n = samples_per_channel(n_samples)
        counts = np.full(misfit.shape[1], n, dtype=float)
        if self.noise.effective_samples is not None:
            counts = np.minimum(counts, self.noise.effective_samples)
            misfit = misfit * (counts / n)
        if self.noise.groups == "channel":
            return misfit, counts, 0.0
        scales = np.array(self.noise.scales)
        return (misfit / scales**2).sum(axis=1, keepdims=True), counts.sum(keepdims=True), -counts @ np.log(scales)


def sampled_noise(noise: Noise) -> Noise:
    """Noise whose parameters are in a complete sample: for a `MarginalNoise`, the noise inside it."""
    return noise.noise if isinstance(noise, MarginalNoise) else noise


class _Peak(NamedTuple):
    """Peak of the integrand over t = log sigma, for n rows: its position and the limits of integration, all (n, 1)."""

    top: np.ndarray
    low: np.ndarray
    high: np.ndarray


def _log_integrand(t: np.ndarray, fit: np.ndarray, count: float, prior: Any) -> np.ndarray:
    """Logarithm of the integrand at t = log sigma (n, k); `fit` (n, 1) is the likelihood's maximum, log sqrt(J / n)."""
    with np.errstate(over="ignore", invalid="ignore"):
        likelihood = -count * (HALF_LOG_TWO_PI + t + 0.5 * np.exp(2.0 * (fit - t)))
    return likelihood + prior.logpdf(np.exp(t)) + t


def _find(fit: np.ndarray, count: float, prior: Any) -> _Peak:
    """Peak of the integrand for every row of `fit` (n, 1)."""
    least, most = _logarithms(prior)
    middle, far = np.log(prior.ppf(np.array([0.5, 1.0 - 1e-15])))
    # the maximum is between the maxima of likelihood and prior; refine until grid neighbours are almost as high
    low, high = np.clip(np.minimum(fit, middle - 5.0), least, most), np.clip(np.maximum(fit, far), least, most)
    for _ in range(_MAX_ITERATIONS):
        t = low + (high - low) * _GRID
        values = _log_integrand(t, fit, count, prior)
        best = np.argmax(values, axis=1)[:, None]
        (low, left), (high, right) = (
            [np.take_along_axis(a, np.clip(best + step, 0, len(_GRID) - 1), axis=1) for a in (t, values)]
            for step in (-1, 1)
        )
        top, highest = (np.take_along_axis(a, best, axis=1) for a in (t, values))
        if (highest - np.minimum(left, right)).max() < 1.0:
            break
    floor = highest - _FALL
    # three below the likelihood's maximum, its exponent is exp(2 * 3) = 400 times as large
    below = np.maximum(np.minimum(top, fit) - 3.0, least)
    above = np.minimum(top + (far - middle) + 3.0, most)
    inside, outside = top, np.concatenate([below, above], axis=1)
    for _ in range(_MAX_ITERATIONS):
        half = 0.5 * (inside + outside)
        fallen = _log_integrand(half, fit, count, prior) < floor
        inside, outside = np.where(fallen, inside, half), np.where(fallen, half, outside)
        if (np.abs(outside - inside) <= 0.1 * np.abs(outside - top)).all():
            break
    return _Peak(top, *np.split(outside, 2, axis=1))


def _logarithms(prior: Any) -> tuple[float, float]:
    """Logarithms of the prior's bounds for positive sigma, moved inwards so that exp(log) is within the bounds."""
    least, most = prior.bounds
    tiny = np.finfo(float).tiny
    return math.log(max(least, tiny)) + 1e-14, math.log(min(most, 1.0 / tiny)) - 1e-14


def log_integral(squares: np.ndarray, count: float, prior: Any) -> np.ndarray:
    """Logarithm of L(J) (n,) for sums of squares (n,) of `count` samples, and the prior of sigma."""
    with np.errstate(divide="ignore"):
        fit = 0.5 * np.log(squares / count)[:, None]
    result = np.full(len(squares), np.inf)
    exists = np.isfinite(fit[:, 0]) | (prior.bounds[0] > 0.0)
    fit = np.maximum(fit[exists], math.log(np.finfo(float).tiny))
    if not exists.any():
        return result
    peak = _find(fit, count, prior)
    half = 0.5 * (peak.high - peak.low)
    values = _log_integrand(peak.low + half * (1.0 + _NODES), fit, count, prior)
    largest = values.max(axis=1)
    result[exists] = largest + np.log((half * np.exp(values - largest[:, None])) @ _WEIGHTS)
    return result


def _draws(squares: np.ndarray, count: float, prior: Any, uniform: np.ndarray) -> np.ndarray:
    """Standard deviations for sums of squares (n,): the inverse of their distribution function at uniform numbers."""
    fit = 0.5 * np.log(squares / count)[:, None]
    peak = _find(fit, count, prior)
    t = peak.low + (peak.high - peak.low) * np.linspace(0.0, 1.0, _CELLS + 1)
    values = _log_integrand(t, fit, count, prior)
    density = np.exp(values - values.max(axis=1, keepdims=True))
    cumulative = np.cumsum(0.5 * (density[:, 1:] + density[:, :-1]), axis=1)
    wanted = uniform[:, None] * cumulative[:, -1:]
    cell = np.minimum((cumulative < wanted).sum(axis=1, keepdims=True), _CELLS - 1)
    before = np.where(cell > 0, np.take_along_axis(cumulative, np.maximum(cell - 1, 0), axis=1), 0.0)
    share = (wanted - before) / (np.take_along_axis(cumulative, cell, axis=1) - before)
    return np.exp(peak.low + (peak.high - peak.low) * (cell + share) / _CELLS)[:, 0]
