"""Importance sampling: the evidence from weighted draws, and whether their weights are reliable.

A proposal is fixed before its draws are made, so the mean of posterior / proposal over the draws estimates the evidence
without bias. The equations and their sources are in ``docs/theory/guided`` and ``docs/theory/evidence``.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, stdtrit

from .genealogy import FEWEST_FOR_VARIANCE
from .pareto import FEWEST_OF_TAIL, LARGEST_SHAPE, pareto_shape
from .weights import effective_sample_size, log_mean_weight, normalised_weights

# Log-evidences with a larger standard error distinguish hardly any models, and the same weights give the means. Of 1916
# runs, limits of .3, .35, .4 and .45 leave 108, 119, 129 and 137 of 297 wrong ones silent, and doubt 144, 89, 56 and 44
# right ones.
LARGEST_ERROR = 0.35
# Fewer effective points per parameter (and one more) do not determine means and covariances.
POINTS_PER_DIMENSION = 3.0


class EvidenceCheck(NamedTuple):
    """The evidence by importance sampling, independent of the tempering stages."""

    log_evidence: float  #: logarithm of the evidence
    error: float  #: standard error of `log_evidence`; meaningless unless `reliable`
    effective_sample_size: float  #: of the weights
    pareto_shape: float  #: of the largest weights; below 0.7 the error of the mean is finite in practice
    evaluations: int  #: points for which ``log_prob_fn`` was called
    #: means (ndim,) of the weighted draws and their standard errors, if moves have found several parts; else None
    mean: list[float] | None = None
    mean_error: list[float] | None = None

    @property
    def reliable(self) -> bool:
        """Whether the weights are even enough for the estimate and its error to be meaningful."""
        return self.pareto_shape < LARGEST_SHAPE and self.effective_sample_size >= FEWEST_FOR_VARIANCE


def fewest_points(ndim: int) -> float:
    """Smallest effective sample size for which weighted points are a usable population."""
    return max(FEWEST_FOR_VARIANCE, POINTS_PER_DIMENSION * (ndim + 1.0))


def usable(effective_sample_size: float, pareto_shape: float, error: float, ndim: int) -> bool:
    """Whether the means and the evidence from weighted points have errors that can be stated."""
    enough = effective_sample_size >= fewest_points(ndim)
    return enough and pareto_shape < LARGEST_SHAPE and error <= LARGEST_ERROR


def evidence_from_weights(log_weights: np.ndarray, made: int) -> EvidenceCheck:
    """Evidence from the log-weights (n,) of the draws inside the support, out of `made` draws. Its error is from their
    variance or, if larger, from log-normal weights with the spread of the larger half: n draws rarely contain the
    largest weights of a rough likelihood.
    """
    full = np.full(made, -np.inf)
    full[: len(log_weights)] = log_weights
    effective = effective_sample_size(full)
    log_evidence = log_mean_weight(full)
    if effective == 0.0:
        return EvidenceCheck(log_evidence, float("inf"), effective, pareto_shape(log_weights), len(log_weights))
    one, two = np.quantile(full, ndtr([1.0, 2.0]), method="lower")
    # one effective point has the relative variance 1, which no set of weights exceeds
    log_normal = np.expm1(min((two - one) ** 2, np.log1p(made))) / made if one > -np.inf else 0.0
    error = float(np.sqrt(max(1.0 / effective - 1.0 / made, log_normal)))
    return EvidenceCheck(log_evidence, error, effective, pareto_shape(log_weights), len(log_weights))


# ---------------------------------------------------------------- rounds

# Growth of the weights above which the tails of a proposal are too light, in a half, a quarter or an eighth of the
# draws, of the lowest posterior. In 1 to 10 dimensions, 60 samples of 100 to 1000 draws each: 98 to 100 % where normal
# proposals have half the variance of a Student t (3 or 5 degrees of freedom), 50 to 100 % where they have all of it;
# 6 degrees on 4, 30 to 88 % in 1 and 2 dimensions, none in 5 and 10; none where they are wider than a normal density.
LARGE_GROWTH = 0.2
SIGNIFICANT = 4.0  # in errors
# Instead of -inf: rounds of which each misses a draw of another still have shares; from -1e2 to -1e9 they are the same.
SMALLEST_LOG_DENSITY = -1e5


class KnownDensity(NamedTuple):
    """A normalised density whose expectations are known."""

    # log of the normalised density (n,) at points (n, ndim); -inf is allowed
    log_density: Callable[[np.ndarray], np.ndarray]
    coords: np.ndarray  # (m, ndim), points of this density
    weights: np.ndarray  # (m,), with sum 1
    log_density_error: float  # standard error of the log normalising constant


class Round(NamedTuple):
    """Draws of one proposal density, which was fixed before they were made."""

    coords: np.ndarray  # (n, ndim)
    records: np.ndarray  # (n,), fields log_prob, log_prior and, where there are any, blobs
    log_weights: np.ndarray  # (n,), log_prob minus log-density of the proposal; -inf for impossible points
    known: KnownDensity | None = None  # close to the posterior, fixed before the draws were made
    log_known: np.ndarray | None = None  # (n,), log-density of `known` minus log-density of the proposal
    log_density: Callable[[np.ndarray], np.ndarray] | None = None  # (m,) of the proposal at points (m, ndim)
    log_densities: np.ndarray | None = None  # (n, n_rounds) at these draws: of the own proposal, by `add_round` of all

    @property
    def effective_sample_size(self) -> float:
        """Effective sample size of the weights."""
        return effective_sample_size(self.log_weights)

    @property
    def effective_share(self) -> float:
        """Effective sample size divided by the number of draws."""
        return self.effective_sample_size / len(self.log_weights)

    @property
    def pareto_shape(self) -> float:
        """Shape of the largest weights; inf for too few weights."""
        return pareto_shape(self.log_weights)


class PooledRounds(NamedTuple):
    """All draws of several rounds."""

    coords: np.ndarray  # (n, ndim)
    records: np.ndarray  # (n,), as in `Round`
    log_weights: np.ndarray  # (n,), whose sum of exponentials is the evidence
    log_evidence: float
    log_evidence_error: float
    effective_sample_size: float
    pareto_shape: float  # of the largest weights
    shares: np.ndarray  # (n_rounds,) in the evidence, with sum 1


def tail_growth(rounds: Sequence[Round], part: float = 0.5) -> tuple[float, float]:
    """Slope of the log-weights over minus the log-posterior, among the `part` of the draws with the lowest posterior,
    and its error times a factor for few draws; (0, inf) for fewer than three. It is positive if a proposal has lighter
    tails than the posterior (``docs/theory/guided``).
    """
    log_prob = np.concatenate([r.records["log_prob"] for r in rounds])
    log_weights = np.concatenate([r.log_weights for r in rounds])
    possible = np.isfinite(log_weights) & np.isfinite(log_prob)
    depth, log_weights = -log_prob[possible], log_weights[possible]
    if part * len(depth) < 3:  # no degree of freedom is left
        return 0.0, float("inf")
    outer = depth >= np.quantile(depth, 1.0 - part)
    depth, log_weights = depth[outer] - depth[outer].mean(), log_weights[outer] - log_weights[outer].mean()
    squares = float(depth @ depth)
    if squares == 0.0:
        return 0.0, float("inf")
    slope = float(depth @ log_weights) / squares
    left = log_weights - slope * depth
    error = float(np.sqrt(left @ left / (len(depth) - 2) / squares))
    few = float(-stdtrit(len(depth) - 2, ndtr(-SIGNIFICANT))) / SIGNIFICANT
    return slope, few * error


def tails_are_light(rounds: Sequence[Round]) -> bool:
    """Whether the weights of rounds grow significantly towards the tails (`tail_growth`), in any outer part."""
    found = (tail_growth(rounds, part) for part in (0.5, 0.25, 0.125))
    return any(slope > max(LARGE_GROWTH, SIGNIFICANT * error) for slope, error in found)


def tail_variance(log_weights: np.ndarray) -> float:
    """Variance of the log-evidence due to weights larger than all drawn ones: the mean excess over the largest, by the
    Pareto shape, is a standard error, up to 1; infinite for a shape of 1 or an effective size below 5.
    """
    shape = pareto_shape(log_weights)
    shape = LARGEST_SHAPE if shape == np.inf else shape  # of fewer weights than an estimate needs
    if shape >= 1.0 or effective_sample_size(log_weights) < FEWEST_OF_TAIL:
        return float("inf")
    largest = float(np.max(normalised_weights(log_weights)))
    return min(largest * max(shape, 0.0) / (1.0 - shape), 1.0) ** 2


def add_round(rounds: Sequence[Round], latest: Round) -> list[Round]:
    """Rounds and a further one, each with the densities of all of them at its draws."""
    earlier = [
        each._replace(log_densities=np.column_stack([each.log_densities, latest.log_density(each.coords)]))
        for each in rounds
    ]
    densities = [*(each.log_density(latest.coords) for each in rounds), latest.log_densities]
    return [*earlier, latest._replace(log_densities=np.column_stack(densities))]


def joined(first: Round, more: Round) -> Round:
    """A round and further draws of the same proposal, before `add_round`."""
    known = None if first.log_known is None else np.concatenate([first.log_known, more.log_known])
    names = "coords", "records", "log_weights", "log_densities"
    both = {name: np.concatenate([getattr(each, name) for each in (first, more)]) for name in names}
    return first._replace(log_known=known, **both)


def log_mixture(rounds: Sequence[Round], coords: np.ndarray) -> np.ndarray:
    """Log-density (m,) of the draws of all rounds together at points (m, ndim)."""
    sizes = np.array([len(r.coords) for r in rounds])
    parts = [np.log(n / sizes.sum()) + r.log_density(coords) for n, r in zip(sizes, rounds, strict=True)]
    return np.logaddexp.reduce(parts)


def pool_rounds(rounds: Sequence[Round]) -> PooledRounds:
    """Combine rounds, as `add_round` returns them: each draw is weighted by the mixture of all densities
    (``docs/theory/guided``).

    These weights are too small where a density was fitted to earlier draws (their log-sum by .03 to .17), so the
    evidence is the mean of the rounds' own estimates, with the effective share of each density from the draws of all
    rounds.
    """
    coords, records = np.concatenate([r.coords for r in rounds]), np.concatenate([r.records for r in rounds])
    log_prob, sizes = records["log_prob"], np.array([len(r.coords) for r in rounds])
    densities = np.concatenate([r.log_densities for r in rounds])
    log_weights = log_prob - np.logaddexp.reduce(densities + np.log(sizes), axis=1)
    shape, effective = pareto_shape(log_weights), effective_sample_size(log_weights)
    total = np.logaddexp.reduce(log_weights)
    if total == -np.inf:
        return PooledRounds(coords, records, log_weights, -np.inf, float("inf"), 0.0, shape, sizes / sizes.sum())
    alive = log_prob > -np.inf
    under = log_prob[alive, None] - np.maximum(densities[alive], SMALLEST_LOG_DENSITY)
    log_shares = np.log(sizes) - np.logaddexp.reduce(log_weights[alive, None] + under, axis=0)
    log_shares = log_shares - np.logaddexp.reduce(log_shares)
    shares = np.exp(log_shares)
    parts = [r.log_weights + log_share - np.log(n) for r, log_share, n in zip(rounds, log_shares, sizes, strict=True)]
    own = np.concatenate(parts)
    log_evidence = np.logaddexp.reduce(own)
    within, between = 0.0, 0.0
    for part, n, share in zip(parts, sizes, shares, strict=True):
        weights = np.exp(part - log_evidence)
        within += n * float(np.var(weights, ddof=1)) if n > 1 else np.inf
        between += float(weights.sum() - share) ** 2
    known = float(shares @ [0.0 if r.known is None else r.known.log_density_error for r in rounds])
    missed = max(float(total - log_evidence), 0.0)
    error = float(np.sqrt(max(within, between, missed**2) + tail_variance(own) + known**2))
    log_weights = log_weights + (log_evidence - total)
    return PooledRounds(coords, records, log_weights, float(log_evidence), error, effective, shape, shares)
