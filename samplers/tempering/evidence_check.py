"""Importance sampling from a mixture: an estimate of the evidence, and whether its weights can be trusted.

A mixture fitted to a population is a proposal from which independent points are drawn inside the support of the prior.
The mean of posterior / proposal over the draws estimates the evidence without tempering, and without bias as long as
the proposal was not fitted to the draws. How reliable the estimate is follows from the weights themselves: the largest
ones have a generalised Pareto distribution, and where its shape exceeds 0.7, points that were not drawn dominate the
mean.

References
----------
Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72) (the diagnostic)
Zhang & Stephens (2009), Technometrics 51(3), doi:10.1198/tech.2009.08017 (estimation of the shape)
"""

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln
from scipy.stats import chi2

from ..proposals.mixture import Mixture, draw
from .weights import effective_sample_size, log_mean_weight

__all__ = ["EvidenceCheck", "draw_inside", "evidence_from_weights", "expected_yield", "pareto_shape"]

# Levels of a normal distribution one and two standard deviations above its median.
ONE_AND_TWO_SD = (0.8413, 0.9772)
LARGEST_SHAPE = 0.7
FEW_WEIGHTS = 10.0
ROUNDS = 50
# points of the quadrature over the squared radius of a Gaussian
QUANTILES = 2000


class EvidenceCheck(NamedTuple):
    """The evidence by importance sampling, independent of the tempering stages.

    Attributes
    ----------
    log_evidence : float
        Logarithm of the evidence.
    error : float
        Standard error of `log_evidence`; meaningless unless `reliable`.
    effective_sample_size : float
        Of the weights.
    pareto_shape : float
        Shape of the distribution of the largest weights; below 0.7 the error of the mean is finite in practice.
    evaluations : int
        Points for which ``log_prob_fn`` was called.
    """

    log_evidence: float
    error: float
    effective_sample_size: float
    pareto_shape: float
    evaluations: int

    @property
    def reliable(self) -> bool:
        """Whether the weights are even enough for the estimate and its error to be meaningful."""
        return self.pareto_shape < LARGEST_SHAPE and self.effective_sample_size >= FEW_WEIGHTS


def draw_inside(
    mixture: Mixture, n: int, random: np.random.RandomState, inside: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, int]:
    """At most `n` draws of a mixture that lie inside a region, and the number of draws made.

    Parameters
    ----------
    mixture : Mixture
        What to draw from.
    n : int
        Number of draws wanted.
    random : RandomState
        Source of random numbers.
    inside : callable
        Function of points (m, ndim) that returns whether each lies inside (m,); called up to 50 times.

    Returns
    -------
    coords : (at most n, ndim) float
        The draws inside.
    made : int
        Number of draws made to obtain them.
    """
    kept, found, made = [], 0, 0
    for _ in range(ROUNDS):
        coords = draw(mixture, n, random)
        good = np.flatnonzero(inside(coords))[: n - found]
        kept.append(coords[good])
        found += len(good)
        if found == n:
            return np.concatenate(kept), made + int(good[-1]) + 1
        made += n
    return np.concatenate(kept), made


def evidence_from_weights(log_weights: np.ndarray, made: int) -> EvidenceCheck:
    """Evidence from the log-weights (n,) of the draws inside the support, out of `made` draws.

    The sample variance of n weights is too small where n draws rarely contain the largest ones. Rough likelihoods have
    nearly log-normal weights, whose variance follows from the spread s of their logarithms, exp(s²) - 1 in units of the
    squared mean. The error is that of the larger variance. The spread is the distance of the quantiles that are one
    and two standard deviations above the median of a normal distribution, so that draws far out in the tails of the
    proposal, whose weights are small, do not count.
    """
    full = np.full(made, -np.inf)
    full[: len(log_weights)] = log_weights
    effective = effective_sample_size(full)
    log_evidence = log_mean_weight(full)
    if effective == 0.0:
        return EvidenceCheck(log_evidence, float("inf"), effective, pareto_shape(log_weights), len(log_weights))
    one, two = np.quantile(full, ONE_AND_TWO_SD, method="lower")
    # one effective point has the relative variance 1, which no set of weights exceeds
    log_normal = np.expm1(min((two - one) ** 2, np.log1p(made))) / made if one > -np.inf else 0.0
    error = float(np.sqrt(max(1.0 / effective - 1.0 / made, log_normal)))
    return EvidenceCheck(log_evidence, error, effective, pareto_shape(log_weights), len(log_weights))


def pareto_shape(log_weights: np.ndarray) -> float:
    """Shape of the generalised Pareto distribution of the largest weights, given by their logarithms (n,).

    The largest min(n / 5, 3 sqrt(n)) weights are used. The shape is -inf for weights without a tail, and inf for too
    few weights.
    """
    finite = log_weights[log_weights > -np.inf]
    n = len(log_weights)
    count = int(min(n / 5.0, 3.0 * np.sqrt(n)))
    if count < 5 or len(finite) <= count:
        return float("inf")
    ordered = np.sort(np.exp(finite - finite.max()))
    tail = ordered[-count:] - ordered[-count - 1]
    if tail[-1] <= 1e-9:
        return float("-inf")
    tail = tail[tail > 0.0]
    count = len(tail)
    if count < 5:
        return float("inf")
    grid = 30 + int(np.sqrt(count))
    quartile = tail[max(int(count / 4.0 + 0.5) - 1, 0)]
    theta = 1.0 / tail[-1] + (1.0 - np.sqrt(grid / (np.arange(1, grid + 1) - 0.5))) / (3.0 * quartile)
    shapes = np.mean(np.log1p(-theta[:, None] * tail), axis=1)
    profile = count * (np.log(-theta / shapes) - shapes - 1.0)
    posterior = np.exp(profile - profile.max())
    theta = float(theta @ posterior / posterior.sum())
    shape = float(np.mean(np.log1p(-theta * tail)))
    # a weak prior towards 0.5 stabilises the estimate from few weights (Vehtari et al. 2024)
    return (count * shape + 5.0) / (count + 10.0)


def expected_yield(ndim: int, dof: float, components: int, points: float) -> float:
    r"""Effective sample size per draw of a mixture that is fitted to draws of a mixture of as many Gaussians.

    Without the noise of the fit it is :math:`1 / \mathrm{E}[p / q]` for a Gaussian p and the Student t q with the same
    degrees of freedom as the mixture that maximises the likelihood. With K components of d dimensions and n points,
    each fitted number costs about 1 / n: the yield is divided by :math:`1 + K d (d + 3) / (2 n)`.

    Parameters
    ----------
    ndim : int
        Number of parameters.
    dof : float
        Degrees of freedom of the mixture.
    components : int
        Number of components.
    points : float
        Effective number of points that the mixture was fitted to.

    Returns
    -------
    float
        Between 0 and 1.
    """
    return _yield_without_noise(ndim, dof) / (1.0 + components * ndim * (ndim + 3) / (2.0 * points))


@lru_cache
def _yield_without_noise(ndim: int, dof: float) -> float:
    """1 / E[p / q] for a standard Gaussian p and the Student t q of maximum likelihood."""
    radii = chi2.ppf((np.arange(QUANTILES) + 0.5) / QUANTILES, ndim)  # squared
    scale = 1.0  # squared
    for _ in range(100):  # expectation-maximisation
        scale = float(np.mean((dof + ndim) / (dof + radii / scale) * radii)) / ndim
    log_p = -0.5 * (ndim * np.log(2.0 * np.pi) + radii)
    log_q = gammaln(0.5 * (dof + ndim)) - gammaln(0.5 * dof) - 0.5 * ndim * np.log(dof * np.pi * scale)
    log_q -= 0.5 * (dof + ndim) * np.log1p(radii / (dof * scale))
    return float(1.0 / np.mean(np.exp(log_p - log_q)))
