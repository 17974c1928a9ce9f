r"""Rounds of importance sampling whose proposal changes from round to round: weights, evidence and its error.

Round r has :math:`n_r` independent draws of a density :math:`q_r` that was fixed before they were made. Each draw is
weighted by its own density, :math:`w_i = \pi(\theta_i) / q_r(\theta_i)` with the posterior density :math:`\pi` before
normalisation. The mean of these weights, :math:`\hat Z_r`, is an unbiased estimate of the evidence whatever the earlier
rounds were like. The rounds are combined as :math:`\hat Z = \sum_r \alpha_r \hat Z_r`.

The shares :math:`\alpha_r` must not depend on the weights of the same round: a round with one very large weight has a
small effective sample size, and a smaller share for it would make the evidence too small on average. Therefore
:math:`\alpha_r` is proportional to the number of draws times the effective share (effective sample size / number of
draws) of the *previous* round. Only the first round has no previous one and takes its own.

The equations are in ``docs/theory/guided``.

References
----------
Owen, A. B. & Zhou, Y. (2020), The square root rule for adaptive importance sampling, ACM Transactions on Modeling and
Computer Simulation 30(2), doi:10.1145/3350426 (unbiased combinations of rounds)
Vehtari, Simpson, Gelman, Yao & Gabry (2024), JMLR 25(72) (Pareto shape)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import stats

from .evidence_check import pareto_shape
from .weights import effective_sample_size, log_mean_weight, normalised_weights

__all__ = [
    "PooledRounds",
    "Round",
    "pool_rounds",
    "round_shares",
    "tail_growth",
    "tail_shape",
    "tail_variance",
    "tails_are_light",
]


# Pareto shape that is assumed for fewer weights than an estimate needs
SHAPE_OF_FEW = 0.7
FEWEST_EFFECTIVE = 5.0
# part of the sum of all weights by which the largest must exceed the others for their shape to matter
SMALLEST_EXCESS = 0.05
# Growth of the weights towards the tails from which on the tails of a proposal are too light, for each part of the
# draws with the lowest posterior. Normal proposals with half the variance of a Student t (3 to 5 degrees of freedom)
# have 0.11 to 0.5, 0.3 to 0.7 and 0.6 to 0.85; with 3 degrees the weights first fall, and grow among the outermost
# draws only. Harmless proposals have less: with 6 degrees on 4, 0.03, 0.08 and 0.12.
LARGE_GROWTH = {0.5: 0.1, 0.25: 0.3, 0.125: 0.3}
SIGNIFICANT = 4.0  # in errors
FEWEST_FOR_GROWTH = 8


class Round(NamedTuple):
    """Draws of one proposal density.

    Attributes
    ----------
    coords : (n, ndim) float
        The draws.
    records : (n,) structured array
        Their records (log_prob, log_prior and, where there are any, blobs).
    log_weights : (n,) float
        Log-probability minus log-density of the proposal; -inf for impossible points.
    """

    coords: np.ndarray
    records: np.ndarray
    log_weights: np.ndarray

    @property
    def effective_sample_size(self) -> float:
        """Of the weights."""
        return effective_sample_size(self.log_weights)

    @property
    def effective_share(self) -> float:
        """Effective sample size divided by the number of draws."""
        return self.effective_sample_size / len(self.log_weights)

    @property
    def pareto_shape(self) -> float:
        """`tail_shape` of the weights; inf for too few of them."""
        return tail_shape(self.log_weights)


class PooledRounds(NamedTuple):
    """All draws of several rounds.

    Attributes
    ----------
    coords : (n, ndim) float
        The draws.
    records : (n,) structured array
        Their records.
    log_weights : (n,) float
        Log-weights, whose sum of exponentials is the evidence.
    log_evidence, log_evidence_error : float
        Log-evidence and its standard error.
    effective_sample_size : float
        Of the weights.
    pareto_shape : float
        `tail_shape` of the weights.
    """

    coords: np.ndarray
    records: np.ndarray
    log_weights: np.ndarray
    log_evidence: float
    log_evidence_error: float
    effective_sample_size: float
    pareto_shape: float


def round_shares(sizes: Sequence[int], effective_shares: Sequence[float]) -> np.ndarray:
    """Share of each round in the evidence, with sum 1.

    Parameters
    ----------
    sizes : sequence of int
        Number of draws per round.
    effective_shares : sequence of float
        Effective sample size of each round divided by its number of draws. That of the last round has no effect unless
        it is the only round.
    """
    lagged = [effective_shares[0], *effective_shares[:-1]]
    # a round after one without a single effective draw still counts as one point
    shares = np.maximum(np.asarray(sizes) * np.asarray(lagged), 1.0)
    return shares / shares.sum()


def tail_shape(log_weights: np.ndarray) -> float:
    """Pareto shape of the largest weights where these have a part in the mean; 0 where they have none.

    The shape of a distribution does not depend on its scale. The weights of a guide that describes the posterior nearly
    exactly are all equal but for small errors, and the shape of these errors says nothing about the mean: it is used
    only if the largest weights exceed the next one by at least 5 % of the sum of all weights together.

    Parameters
    ----------
    log_weights : (n,) float
        Logarithms of the weights, at least one of them finite.
    """
    shape = pareto_shape(log_weights)
    if not np.isfinite(shape):
        return max(shape, 0.0)
    ordered = np.sort(normalised_weights(log_weights))
    n = len(ordered)
    count = int(min(n / 5.0, 3.0 * np.sqrt(n)))
    excess = float((ordered[-count:] - ordered[-count - 1]).sum())
    return shape if excess >= SMALLEST_EXCESS else 0.0


def tail_growth(rounds: Sequence[Round], part: float = 0.5) -> tuple[float, float]:
    r"""Slope of the log-weights over minus the log-posterior, among the draws with the lowest posterior.

    Where the posterior :math:`\pi` is in proportion to a power :math:`q^c` of the proposal density, the slope is
    :math:`(1 - c) / c`: positive for tails of the proposal that are lighter than those of the posterior. No weight
    need be large for that, since draws of light tails do not reach the places where weights are large. Errors of a
    proposal, and jumps of a likelihood, do not make the slope positive on average.

    Parameters
    ----------
    rounds : sequence of Round
        Draws of proposals that were fixed before them.
    part : float
        The part of the draws that is used, those with the lowest posterior.

    Returns
    -------
    slope, error : float
        The slope and its error, by least squares; (0, inf) for fewer than 8 draws in the part. The error is the
        standard error times a factor above 1 for few draws: 4 errors have the same probability for any number of them.
    """
    log_prob = np.concatenate([r.records["log_prob"] for r in rounds])
    log_weights = np.concatenate([r.log_weights for r in rounds])
    possible = np.isfinite(log_weights) & np.isfinite(log_prob)
    depth, log_weights = -log_prob[possible], log_weights[possible]
    if part * len(depth) < FEWEST_FOR_GROWTH:
        return 0.0, float("inf")
    outer = depth >= np.quantile(depth, 1.0 - part)
    depth, log_weights = depth[outer] - depth[outer].mean(), log_weights[outer] - log_weights[outer].mean()
    squares = float(depth @ depth)
    if squares == 0.0:
        return 0.0, float("inf")
    slope = float(depth @ log_weights) / squares
    left = log_weights - slope * depth
    error = float(np.sqrt(left @ left / (len(depth) - 2) / squares))
    few = float(stats.t.isf(stats.norm.sf(SIGNIFICANT), len(depth) - 2)) / SIGNIFICANT
    return slope, few * error


def tails_are_light(rounds: Sequence[Round]) -> bool:
    """Whether the weights of rounds grow significantly towards the tails (`tail_growth`), in one of the outer parts."""
    found = [(*tail_growth(rounds, part), large) for part, large in LARGE_GROWTH.items()]
    return any(slope > max(large, SIGNIFICANT * error) for slope, error, large in found)


def tail_variance(log_weights: np.ndarray) -> float:
    r"""Variance of the log-evidence due to weights larger than all that were drawn.

    If the largest weights have a Pareto shape :math:`0 < k < 1`, the mean excess over the largest normalised weight
    :math:`W_{max}` is about :math:`k W_{max} / (1 - k)`, which is taken as a standard error. It is infinite for
    :math:`k \ge 1`. Where there are too few weights for an estimate, k is 0.7. With an effective sample size below 5,
    points that were not drawn may have any weight, and the variance is infinite.

    Parameters
    ----------
    log_weights : (n,) float
        Logarithms of the weights, at least one of them finite.
    """
    shape = tail_shape(log_weights)
    shape = SHAPE_OF_FEW if shape == np.inf else shape
    if shape >= 1.0 or effective_sample_size(log_weights) < FEWEST_EFFECTIVE:
        return float("inf")
    largest = float(np.max(normalised_weights(log_weights)))
    return (largest * max(shape, 0.0) / (1.0 - shape)) ** 2


def pool_rounds(rounds: Sequence[Round], log_density_error: float = 0.0) -> PooledRounds:
    r"""Combine rounds.

    The variance of the log-evidence is the sum of three parts: the variance of the mean weights of the rounds,
    :math:`\sum_r \alpha_r^2 s_r^2 / (n_r \hat Z^2)` with the sample variance :math:`s_r^2` of the weights, or the
    variance between the rounds, :math:`\sum_r \alpha_r^2 (\hat Z_r / \hat Z - 1)^2`, where that is larger;
    `tail_variance`; and the squared error of the normalising constant of the proposal density.

    Parameters
    ----------
    rounds : sequence of Round
        At least one, in order.
    log_density_error : float
        Standard error of the logarithm of the normalising constant of the proposal density.

    Returns
    -------
    PooledRounds
    """
    sizes = [len(r.log_weights) for r in rounds]
    shares = round_shares(sizes, [r.effective_share for r in rounds])
    parts = [r.log_weights + np.log(share / n) for r, share, n in zip(rounds, shares, sizes, strict=True)]
    log_weights = np.concatenate(parts)
    log_evidence = float(log_mean_weight(log_weights) + np.log(len(log_weights)))
    shape = tail_shape(log_weights)
    coords, records = np.concatenate([r.coords for r in rounds]), np.concatenate([r.records for r in rounds])
    if log_evidence == -np.inf:
        return PooledRounds(coords, records, log_weights, log_evidence, float("inf"), 0.0, shape)
    within, between = 0.0, 0.0
    for part, n, share in zip(parts, sizes, shares, strict=True):
        weights = np.exp(part - log_evidence)
        within += n * float(np.var(weights, ddof=1)) if n > 1 else np.inf
        between += float(weights.sum() - share) ** 2  # a round that missed the posterior has small weights only
    variance = max(within, between) + tail_variance(log_weights) + log_density_error**2
    effective = effective_sample_size(log_weights)
    return PooledRounds(coords, records, log_weights, log_evidence, float(np.sqrt(variance)), effective, shape)
