"""The tempering ladder: pure functions on log-weights.

Between the prior (beta = 0) and the posterior (beta = 1) lies the family

    log pi_beta(theta) = (1 - beta) log prior(theta) + beta log posterior(theta)
                       = log prior(theta) + beta log likelihood(theta) + constant.

A population at beta is carried to beta' by the incremental weights w_i = likelihood(theta_i) ^ (beta' - beta). The next
beta' is the largest one whose weights keep a wanted effective sample size (sum w)^2 / sum w^2, and the product over the
rungs of the mean weights estimates the evidence. Weights never leave the logarithm before their maximum is subtracted:
the log-likelihood of a finite-element model runs into thousands, and a constant added to it must change nothing.

References
----------
Del Moral, Doucet & Jasra (2006), J. R. Stat. Soc. B 68(3), doi:10.1111/j.1467-9868.2006.00553.x
Chan & Lai (2013), Ann. Stat. 41(6), doi:10.1214/13-AOS1172 (standard error of the evidence from one run)
"""

from typing import NamedTuple

import numpy as np

__all__ = [
    "EvidenceError",
    "Stage",
    "coarse_weights",
    "effective_sample_size",
    "log_mean_weight",
    "next_beta",
    "normalised_weights",
]

BISECTIONS = 20
WEIGHT_GRID = 4096.0


class Stage(NamedTuple):
    """One rung of the ladder, as it was climbed.

    Attributes
    ----------
    beta : tempering exponent reached, 0 < beta <= 1.
    effective_sample_size : of the incremental weights that led here.
    acceptance : share of the proposals of this stage that were accepted.
    moves : sweeps of the whole ensemble made at this beta; fast ones are not counted.
    distinct_ancestors : number of different points that survived the resampling.
    log_evidence_increment : log of the mean incremental weight.
    log_evidence_error : standard error of the sum of the increments so far.
    evaluations : points handed to ``log_prob_fn`` in this stage (the first stage includes the draws of the prior);
        fast ones are, so this may exceed the number of simulations.
    seconds : wall time of the stage [s].
    """

    beta: float
    effective_sample_size: float
    acceptance: float
    moves: int
    distinct_ancestors: int
    log_evidence_increment: float
    log_evidence_error: float
    evaluations: int
    seconds: float


def _scaled(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights over their maximum, and the logarithm of that maximum."""
    top = float(np.max(log_weights))
    if top == -np.inf:
        return np.zeros(len(log_weights)), top
    return np.exp(log_weights - top), top


def normalised_weights(log_weights: np.ndarray) -> np.ndarray:
    """Weights that sum to one.

    Parameters
    ----------
    log_weights : (n,) float, any offset, -inf allowed.

    Raises
    ------
    ValueError
        If every weight is zero.
    """
    weights, top = _scaled(log_weights)
    if top == -np.inf:
        raise ValueError("every weight is zero: no point has a finite log-likelihood; check the model and the prior")
    return weights / weights.sum()


def coarse_weights(log_weights: np.ndarray) -> np.ndarray:
    """Normalised weights from log-weights rounded to 1/4096, for fitting proposals.

    A proposal may be fitted to slightly wrong weights, at no cost but a different proposal. Rounded, the weights are
    the same to the last bit when a constant is added to the log-likelihood, and so are all draws made from the fit.
    """
    top = np.max(log_weights)
    return normalised_weights(np.round((log_weights - top) * WEIGHT_GRID) / WEIGHT_GRID)


def effective_sample_size(log_weights: np.ndarray) -> float:
    """(sum w)^2 / sum w^2 of weights given by their logarithms (n,); 0 when all are zero."""
    weights, top = _scaled(log_weights)
    if top == -np.inf:
        return 0.0
    return float(weights.sum() ** 2 / (weights @ weights))


def log_mean_weight(log_weights: np.ndarray) -> float:
    """Logarithm of the mean of weights given by their logarithms (n,); -inf when all are zero."""
    weights, top = _scaled(log_weights)
    return top if top == -np.inf else top + float(np.log(weights.mean()))


def next_beta(log_likelihood: np.ndarray, beta: float, target: float, base: np.ndarray | None = None) -> float:
    """Largest next exponent whose incremental weights keep the effective sample size at `target`.

    Points of zero likelihood are lost at any exponent above zero, so the target is meant per point that is left: it is
    multiplied by the share of finite log-likelihoods. The step is halved until the target is met, then bisected
    to a relative 1e-6. Its bisections stand on a fixed dyadic grid, so that the last bits of the log-likelihood do not
    reach the exponent.

    Parameters
    ----------
    log_likelihood : (n,) float — at the points of the population; -inf allowed.
    beta : float — exponent of the population, 0 <= beta < 1.
    target : float — wanted effective sample size, 0 < target < n.
    base : (n,) float, optional — log-weights that the points carry at `beta`; by default all the same. With them the
        target is taken as it is, and must be met at `beta`.

    Returns
    -------
    float — in (beta, 1]; 1 when even the full step keeps the target (a flat likelihood, for one).

    Raises
    ------
    ValueError
        If no log-likelihood is finite.
    """
    top = np.max(log_likelihood)
    if top == -np.inf:
        raise ValueError("no point of the population has a finite log-likelihood; check the model and the prior")
    alive = log_likelihood > -np.inf
    relative = log_likelihood[alive] - top
    if base is None:
        carried = 0.0
        target = target * len(relative) / len(log_likelihood)
    else:
        carried = base[alive]

    def meets(step: float) -> bool:
        return effective_sample_size(carried + step * relative) >= target

    step = 1.0 - beta
    if meets(step):
        return 1.0
    while step > 0.0 and not meets(step):
        step *= 0.5
    low, high = step, 2.0 * step
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        if meets(middle):
            low = middle
        else:
            high = middle
    # where the step drowns in the rounding of beta, the next representable number still climbs
    return min(max(beta + low, float(np.nextafter(beta, 2.0))), 1.0)


class EvidenceError:
    r"""Standard error of the log-evidence, gathered while one run climbs.

    Every point belongs to a family: those that descend from one and the same founder. With :math:`W_{ij}` the
    normalised weight of point i at rung j, a family's account is
    :math:`A_k = \sum_j \sum_{i \in k} (W_{ij} - 1/N)`: what it has added to the log-evidence by luck, the noise of
    resampling taken out. Families are independent, thus
    :math:`\mathrm{Var}(\log Z) \approx \sum_k A_k^2`, the estimator of Chan & Lai (2013). If moves mix well it tends to
    the sum over rungs of the variances of the mean weights; if points never move it is the error of plain importance
    sampling: poor mixing is not hidden.

    With few families left the sum says little, so the accounts are closed, and every point founds a new family, once
    fewer than a `quorum` of the points' number are alive. What is closed no longer correlates with what follows.

    Parameters
    ----------
    n_points : int
    quorum : float — share of `n_points`.
    """

    def __init__(self, n_points: int, quorum: float = 0.1):
        self.n_points = n_points
        self.quorum = quorum
        self._closed = 0.0
        self._found()

    def _found(self) -> None:
        self._family = np.arange(self.n_points)
        self._account = np.zeros(self.n_points)

    def weigh(self, weights: np.ndarray) -> float:
        """Enter the normalised weights (n_points,) of a rung; returns the standard error so far."""
        self._account += np.bincount(self._family, weights=weights - 1.0 / self.n_points, minlength=self.n_points)
        return float(np.sqrt(self._closed + self._account @ self._account))

    def resample(self, ancestors: np.ndarray) -> None:
        """Follow a resampling: `ancestors` (n_points,) int is the former index of each point."""
        self._family = self._family[ancestors]
        if len(np.unique(self._family)) < self.quorum * self.n_points:
            self._closed += float(self._account @ self._account)
            self._found()
