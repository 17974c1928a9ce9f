"""Tempering by weights: pure functions on log-weights (``docs/theory/tempering``).

Weights are kept as logarithms until their maximum has been subtracted: log-likelihoods of finite-element models have
magnitudes of thousands, and a constant added to them must not change anything.
"""

import numpy as np

from ..resampling import GRID
from .genealogy import FEWEST_FOR_VARIANCE

WHERE_TO_LOOK = (
    "check the model and the prior, and see the failures that the model reports (posterior.report() in fe_likelihoods)"
)
# Below this log-likelihood, rounding errors exceed 1, so that it compares no points: it is as good as -inf.
LOWEST = -1.0 / np.finfo(float).eps
BISECTIONS = 20  # of the next tempering exponent


def _scaled(log_weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Weights divided by their maximum, and the logarithm of the maximum."""
    top = float(np.max(log_weights, initial=-np.inf))
    if top == -np.inf:
        return np.zeros(len(log_weights)), top
    return np.exp(log_weights - top), top


def normalised_weights(log_weights: np.ndarray) -> np.ndarray:
    """Weights (n,) with sum 1, from log-weights with any offset, -inf allowed; ValueError if all weights are zero."""
    weights, top = _scaled(log_weights)
    if top == -np.inf:
        raise ValueError(f"every weight is zero: no point has a finite log-likelihood; {WHERE_TO_LOOK}")
    return weights / weights.sum()


def coarse_weights(log_weights: np.ndarray) -> np.ndarray:
    """Normalised weights from log-weights rounded to 1/4096, for fitting proposals.

    All draws from the fitted proposal then keep their bits when a constant is added to the log-likelihood.
    """
    top = np.max(log_weights)
    return normalised_weights(np.round((log_weights - top) * GRID) / GRID)


def effective_sample_size(log_weights: np.ndarray) -> float:
    """(sum w)^2 / sum w^2 from log-weights (n,); 0 without a positive weight."""
    weights, top = _scaled(log_weights)
    if top == -np.inf:
        return 0.0
    return float(weights.sum() ** 2 / (weights @ weights))


def log_mean_weight(log_weights: np.ndarray) -> float:
    """Logarithm of the mean weight from log-weights (n,); -inf if all weights are zero."""
    weights, top = _scaled(log_weights)
    return top if top == -np.inf else top + float(np.log(weights.mean()))


def next_beta(log_likelihood: np.ndarray, beta: float, target: float, base: np.ndarray | None = None) -> float:
    """Largest next exponent in (beta, 1] whose incremental weights keep the effective sample size at `target`, times
    the share of finite log-likelihoods (n,) if there are no log-weights `base` (n,) at `beta`. ValueError if none is
    finite, or all are so low that rounding errors exceed 1.
    """
    top = np.max(log_likelihood)
    if top < LOWEST:
        finite = "" if top == -np.inf else f" above {LOWEST:.2g}, where rounding errors exceed 1 (largest: {top:.4g})"
        raise ValueError(f"no point of the population has a finite log-likelihood{finite}; {WHERE_TO_LOOK}")
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
    # a step smaller than the rounding error of beta becomes the next representable number, so that annealing ends
    return min(max(beta + low, float(np.nextafter(beta, 2.0))), 1.0)


class EvidenceError:
    """Standard error of the log-evidence, accumulated during one run (Chan & Lai 2013; ``docs/theory/tempering``). Once
    fewer than ten founders are left, the sums are closed, and every point becomes a founder.
    """

    def __init__(self, n_points: int):
        self.n_points = n_points
        self._closed = 0.0
        self._start_groups()

    def _start_groups(self) -> None:
        self._founder = np.arange(self.n_points)
        self._sums = np.zeros(self.n_points)

    def weigh(self, weights: np.ndarray) -> float:
        """Enter the normalised weights (n_points,) of a stage; returns the standard error so far."""
        self._sums += np.bincount(self._founder, weights=weights - 1.0 / self.n_points, minlength=self.n_points)
        return float(np.sqrt(self._closed + self._sums @ self._sums))

    def resample(self, ancestors: np.ndarray) -> None:
        """Follow a resampling: `ancestors` (n,) int is the previous index of each point; n may be another number."""
        self._founder = self._founder[ancestors]
        few = len(np.unique(self._founder)) < FEWEST_FOR_VARIANCE
        if few or len(ancestors) != self.n_points:
            self._closed, self.n_points = self._closed + float(self._sums @ self._sums), len(ancestors)
            self._start_groups()
