"""Bridge sampling: the ratio of two normalising constants, from draws of both densities.

References
----------
Meng & Wong (1996), Simulating ratios of normalizing constants via a simple identity: a theoretical exploration,
Statistica Sinica 6, 831-860, section 3
"""

import numpy as np
from scipy.special import expit

__all__ = ["log_ratio"]

MARGIN = 20.0  # log-ratios of the draws span the solution, up to the logarithm of their number


def log_ratio(of_upper: np.ndarray, of_lower: np.ndarray) -> tuple[float, float]:
    """Log of the normalising constant of an upper density over the one of a lower density, and its standard error.

    Arguments are the log-ratios upper / lower, not normalised, at independent draws (n,) of the upper density and (m,)
    of the lower one; -inf is allowed. (nan, inf) if the draws do not determine the ratio.
    """
    from scipy.optimize import brentq  # slow to import

    possible = np.concatenate([of_upper, of_lower])
    possible = possible[np.isfinite(possible)]
    shift = np.log(len(of_upper) / len(of_lower))

    def shares(value: float) -> tuple[np.ndarray, np.ndarray]:
        return expit(of_lower - value + shift), expit(value - shift - of_upper)

    def difference(value: float) -> float:
        at_lower, at_upper = shares(value)
        return float(at_lower.sum() - at_upper.sum())

    if not len(possible):
        return float("nan"), float("inf")
    low, high = possible.min() - MARGIN + shift, possible.max() + MARGIN + shift
    if not difference(low) > 0.0 > difference(high):
        return float("nan"), float("inf")
    value = brentq(difference, low, high)
    error = np.sqrt(sum(each.var() / (len(each) * each.mean() ** 2) for each in shares(value)))
    return float(value), float(error)
