"""The next tempering exponent: the largest one whose weights keep a wanted effective sample size."""

import numpy as np

from ..estimates.weights import LOWEST, WHERE_TO_LOOK, effective_sample_size

__all__ = ["next_beta"]

BISECTIONS = 20


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
