"""Subset simulation: the probability of a rare event, as a product of larger conditional probabilities.

The event is that a quantity exceeds a threshold, which is reached by lower thresholds that each keep about a tenth of
the points (Au & Beck 2001). It is Sequential Monte Carlo with the indicator of each threshold as its likelihood, and
the error of the product is an error of an evidence (`samplers.estimates.weights`). Points move by the conditional
sampling of Papaioannou et al. (2015), whose acceptance does not fall with the number of parameters, in chains of ten
steps. Moves fitted to the points of a level made a probability of 1e-5 five times too small.

References
----------
S.-K. Au, J. L. Beck (2001), Estimation of small failure probabilities in high dimensions by subset simulation,
Probabilistic Engineering Mechanics 16(4), 263-277, doi:10.1016/S0266-8920(01)00019-4.
I. Papaioannou, W. Betz, K. Zwirglmaier, D. Straub (2015), MCMC algorithms for subset simulation, Probabilistic
Engineering Mechanics 41, 89-103, doi:10.1016/j.probengmech.2015.06.006.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from .estimates.genealogy import FEWEST_FOR_VARIANCE
from .estimates.weights import EvidenceError
from .resampling import systematic
from .settings import as_whole_number

LEVEL_PROBABILITY = 0.1  # share of the points that each level keeps (Au & Beck 2001)
LEAST_PROBABILITY = 1e-15
TARGET_ACCEPTANCE = 0.44  # of the moves (Papaioannou et al. 2015)


class RareEvent(NamedTuple):
    """Probability of a rare event; ``str`` is a sentence."""

    probability: float  #: estimate of the probability that the quantity exceeds the threshold
    coefficient_of_variation: float  #: standard error of the probability, relative to the probability
    lower: float  #: end of the 95 % interval, lognormal with this coefficient
    upper: float  #: other end
    threshold: float  #: in the unit of the quantity
    levels: np.ndarray  #: thresholds (n_levels,) of the stages
    shares: np.ndarray  #: their conditional probabilities (n_levels,), whose product is `probability`
    simulations: int  #: number of points at which the quantity was computed
    failed: int  #: how many of them failed
    coords: np.ndarray  #: points (k, ndim) of the last stage beyond the threshold: dependent draws given the event

    def __str__(self) -> str:
        failed = f", {self.failed} of which failed" if self.failed else ""
        return (
            f"The probability to exceed {self.threshold:.4g} is {self.probability:.3g} (95 % interval {self.lower:.2g} "
            f"to {self.upper:.2g}), from {self.simulations} simulations{failed} in {len(self.levels)} levels."
        )

    __repr__ = __str__


def subset_simulation(
    function: Callable[[np.ndarray], np.ndarray],
    threshold: float,
    ndim: int,
    *,
    n: int = 1000,
    seed: int | None = None,
) -> RareEvent:
    """Estimate the probability that a quantity exceeds a threshold, down to very small probabilities.

    Parameters
    ----------
    function : callable
        Takes points (k, ndim) and returns the quantity (k,) at each. NaN is a failed simulation, which is left out, so
        that the probability is conditional on simulations that do not fail; infinity is an exceedance, such as a
        collapse, or a failed simulation that shall count as one.
    threshold : float
        The threshold, in the unit of the quantity.
    ndim : int
        Number of standard normal parameters: map them in the function, ``prior.from_normal(points)``.
    n : int
        Points per level, 100 or more. The coefficient of variation falls with its square root.
    seed : int, optional
        Seed of the run.

    Returns
    -------
    RareEvent

    Raises
    ------
    ValueError
        For impossible arguments or results; if too many simulations fail, most points of a level have the same value,
        or the probability is below 1e-15.

    Notes
    -----
    A probability of 10^-k takes k levels of n simulations. The estimate has a bias of order 1/n, because thresholds are
    quantiles of the points (docs/results.rst). A region that no point of the first levels is near is missed, without a
    sign in the stated error.

    Examples
    --------
    >>> def total(points):
    ...     return points.sum(axis=1)
    >>> rare = subset_simulation(total, 6.0, ndim=2, seed=1)
    >>> bool(0.5e-5 < rare.probability < 2e-5)  # exact: 1.1e-5
    True
    """
    n = as_whole_number("n", n)
    if n * LEVEL_PROBABILITY < FEWEST_FOR_VARIANCE:
        raise ValueError(f"n must be {FEWEST_FOR_VARIANCE / LEVEL_PROBABILITY:.0f} points or more; got {n}")
    if not np.isfinite(threshold):
        raise ValueError(f"threshold must be a finite number; got {threshold!r}")
    simulations = failed = 0

    def quantity(points: np.ndarray) -> np.ndarray:
        nonlocal simulations, failed
        values = np.asarray(function(points.copy()), dtype=float)
        if values.shape != (len(points),):
            raise ValueError(f"function must return one number per point, shape ({len(points)},); got {values.shape}")
        simulations, failed = simulations + len(values), failed + int(np.isnan(values).sum())
        return np.where(np.isnan(values), -np.inf, values)

    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
    points = random.standard_normal((n, as_whole_number("ndim", ndim)))
    values = quantity(points)
    points, values = points[values > -np.inf], values[values > -np.inf]
    made, n, kept = n, len(values), int(np.ceil(LEVEL_PROBABILITY * len(values)))
    if kept < FEWEST_FOR_VARIANCE:
        raise ValueError(
            f"expected {FEWEST_FOR_VARIANCE / LEVEL_PROBABILITY:.0f} initial points or more whose simulation succeeds; "
            f"got {n} of {made}: see why the function returns NaN, or return infinity if failures exceed"
        )
    scale = 1.0
    error = EvidenceError(n)
    levels, shares = [], []
    while True:
        above, bound = values > threshold, float(np.partition(values, -kept)[-kept])
        last, stays = above.mean() >= LEVEL_PROBABILITY, bound in levels[-1:]
        above = above if last else values >= bound
        levels.append(threshold if last else bound)
        shares.append(float(above.mean()))
        deviation = error.weigh(above / above.sum())
        if last:
            break
        if stays or np.prod(shares) < LEAST_PROBABILITY:
            raise ValueError(
                f"expected a quantity that reaches {threshold:g} with a probability above {LEAST_PROBABILITY:g}; at "
                f"{np.prod(shares):.2g}, {shares[-1]:.0%} of the points are at or above {bound:g}, the largest is "
                f"{values.max():g}: check the unit of the threshold, and whether the quantity has a largest value"
            )
        ancestors = systematic(above / above.sum(), random)
        error.resample(ancestors)
        # chains of Au & Beck (2001): from each of the points that a level keeps, one step per copy
        leaders, place, lengths = np.unique(ancestors, return_index=True, return_counts=True)
        ends, at_ends = points[leaders], values[leaders]
        points, values = np.empty_like(points), np.empty_like(values)
        for step in range(lengths.max()):
            growing = np.flatnonzero(lengths > step)
            # u' = sqrt(1 - s^2) u + s e, e normal, leaves the standard normal distribution unchanged
            proposed = random.standard_normal((len(growing), points.shape[1]))
            proposed = math.sqrt(1.0 - scale**2) * ends[growing] + scale * proposed
            found, rows = quantity(proposed), place[growing] + step
            reached = found >= bound
            ends[growing] = points[rows] = np.where(reached[:, None], proposed, ends[growing])
            at_ends[growing] = values[rows] = np.where(reached, found, at_ends[growing])
            scale = min(scale * math.exp(reached.mean() - TARGET_ACCEPTANCE), 1.0)
    probability = float(np.prod(shares))
    factor = float(np.exp(ndtri(0.975) * np.sqrt(np.log1p(deviation**2))))
    interval = probability / factor, min(probability * factor, 1.0)
    stages = np.array(levels), np.array(shares)
    return RareEvent(probability, deviation, *interval, float(threshold), *stages, simulations, failed, points[above])
