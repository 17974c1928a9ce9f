"""Integrals of a truncated normal distribution, and its map from the standard normal, accurate in both tails.

The map takes z to x = mean + sd t, with the bounds a and b of t: Phi(t) = Phi(a) + m Phi(z), m = Phi(b) - Phi(a). It is
computed for z <= 0 and reflected for z > 0. Next to a finite lower bound, Phi(t) and Phi(a) are nearly equal. There the
distance d = t - a is computed instead, from ::

    int_0^d exp(-a s - s^2 / 2) ds = m Phi(z) / phi(a)

so that x - lower has full relative accuracy, however small it is. This matters for bounds at zero.
"""

import math

import numpy as np

HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)


def standard_moments(a: float, b: float) -> tuple[float, float, float]:
    """Probability of [a, b] under a standard normal, and mean and variance of the normal truncated to it."""
    from scipy.special import erf, ndtr  # slow to import, and not needed for densities of other distributions

    if (b - a) * max(abs(a), abs(b), 1.0) < 1.0:
        # differences of tail probabilities cancel on a narrow interval; the smooth density is integrated instead
        half = 0.5 * (b - a)
        weights = _WEIGHTS * np.exp(-0.5 * (0.5 * (a + b) + half * _NODES) ** 2)
        total = weights.sum()
        if total == 0.0:
            return 0.0, math.nan, math.nan
        offset = weights @ _NODES / total
        variance = half**2 * (weights @ (_NODES - offset) ** 2 / total)
        return half * total * math.exp(-HALF_LOG_TWO_PI), 0.5 * (a + b) + half * offset, variance
    if a > 0.0:
        mass = ndtr(-a) - ndtr(-b)
    elif b < 0.0:
        mass = ndtr(b) - ndtr(a)
    else:
        mass = 0.5 * (erf(b / math.sqrt(2.0)) - erf(a / math.sqrt(2.0)))
    if mass <= 0.0:
        return 0.0, math.nan, math.nan
    density_a, density_b = (math.exp(-0.5 * t * t - HALF_LOG_TWO_PI) / mass for t in (a, b))
    mean = density_a - density_b
    slope = sum(t * density for t, density in ((a, density_a), (-b, density_b)) if density > 0.0)
    return mass, mean, 1.0 + slope - mean**2


def quantile_of_normal(
    z: np.ndarray, mean: float, sd: float, lower: float, upper: float, log_mass: float
) -> np.ndarray:
    """Truncated normal variable x with F(x) = Phi(z), of any shape; mean and sd are of the normal before truncation,
    `log_mass` is its log probability of [lower, upper].
    """
    x = np.empty_like(z)
    low = z <= 0.0
    if low.any():
        x[low] = _lower_half(z[low], mean, sd, lower, upper, log_mass)
    if not low.all():
        x[~low] = -_lower_half(-z[~low], -mean, sd, -upper, -lower, log_mass)
    return x


def score_of_quantile(x: np.ndarray, mean: float, sd: float, lower: float, upper: float, log_mass: float) -> np.ndarray:
    """Standard normal variable z with F(x) = Phi(z), the inverse of `quantile_of_normal`; x (n,) inside the bounds."""
    z = _lower_score(x, mean, sd, lower, upper, log_mass)
    high = ~(z <= 0.0)
    z[high] = -_lower_score(-x[high], -mean, sd, -upper, -lower, log_mass)
    return z


def _lower_half(z: np.ndarray, mean: float, sd: float, lower: float, upper: float, log_mass: float) -> np.ndarray:
    """`quantile_of_normal` for z <= 0."""
    from scipy.special import log_ndtr, ndtri_exp

    a, b = (lower - mean) / sd, (upper - mean) / sd
    log_share = log_ndtr(z) + log_mass
    below = np.logaddexp(log_share, log_ndtr(a))
    above = np.logaddexp(log_ndtr(-z) + log_mass, log_ndtr(-b))
    # from the nearer tail of the normal before truncation
    x = mean + sd * np.where(below < above, 1.0, -1.0) * ndtri_exp(np.minimum(np.minimum(below, above), 0.0))
    if np.isneginf(a):
        return x
    area = np.exp(log_share + 0.5 * a * a + HALF_LOG_TWO_PI)
    near = area * max(1.0, abs(a)) < 1.2  # contains the whole half z <= 0 if a >= 0
    if not near.any():
        return x
    distance = area[near]
    for _ in range(8):  # Newton's method; the area is a concave function of d if a > 0, so it cannot overshoot
        before, slope = distance, np.exp(-distance * (a + 0.5 * distance))
        distance = distance - (_area(distance, a) - area[near]) / slope
        if np.array_equal(distance, before):  # all further iterations would return the same numbers
            break
    x[near] = lower + sd * distance
    return x


def _lower_score(x: np.ndarray, mean: float, sd: float, lower: float, upper: float, log_mass: float) -> np.ndarray:
    """`score_of_quantile` where the result is negative; elsewhere only its sign is right, or it is NaN."""
    from scipy.special import log_ndtr, ndtri_exp

    a, t = (lower - mean) / sd, (x - mean) / sd
    # a difference of the smaller two of the probabilities on either side
    if a > 0.0:
        log_share = log_ndtr(-a) + np.log1p(-np.exp(log_ndtr(-t) - log_ndtr(-a)))
    else:
        log_share = log_ndtr(t) + np.log1p(-np.exp(log_ndtr(a) - log_ndtr(t)))
    if np.isfinite(a):
        distance = (x - lower) / sd
        near = distance * max(1.0, abs(a)) < 1.0
        log_share[near] = np.log(_area(distance[near], a)) - 0.5 * a * a - HALF_LOG_TWO_PI
    return ndtri_exp(np.minimum(log_share - log_mass, 0.0))


def _area(distance: np.ndarray, a: float) -> np.ndarray:
    """Integral of exp(-a s - s^2 / 2) from 0 to a short distance (n,)."""
    s = 0.5 * distance[:, None] * (1.0 + _NODES)
    # not a product of matrices, which may round a row in other ways in a batch than alone
    return distance * (0.5 * _WEIGHTS * np.exp(-s * (a + 0.5 * s))).sum(axis=1)
