r"""Subset simulation: the probability of a rare event, as a product of larger conditional probabilities.

The event is that a quantity g of the parameters exceeds a threshold. With thresholds :math:`b_1 < \dots < b_m = b`,

.. math:: P(g > b) = P(g > b_1) \prod_{l=2}^m P(g > b_l \mid g > b_{l-1}),

and each factor is near a tenth (Au & Beck 2001). It is Sequential Monte Carlo with the indicator of :math:`g > b_l` as
the likelihood of stage l, so that the same parts do the work as in tempering: points are weighted, resampled
(`samplers.resampling`), and moved (`samplers.tempering.smc_moves.move`), and the error of the product is the error of
the evidence, which counts points with a common ancestor as dependent (`samplers.estimates.weights.EvidenceError`).
Only the choice of the next stage differs: a quantile of g in place of an exponent.

The parameters are standard normal; a prior is mapped. Moves are the conditional sampling of Papaioannou et al. (2015),
whose acceptance does not fall with the number of parameters, in chains of ten steps from each point that a level keeps.
No move is fitted to the points of a level: with a mixture fitted to a hundred points, a probability of 1e-5 came out
five times too small.

References
----------
S.-K. Au, J. L. Beck (2001), Estimation of small failure probabilities in high dimensions by subset simulation,
Probabilistic Engineering Mechanics 16(4), 263-277, doi:10.1016/S0266-8920(01)00019-4.
I. Papaioannou, W. Betz, K. Zwirglmaier, D. Straub (2015), MCMC algorithms for subset simulation, Probabilistic
Engineering Mechanics 41, 89-103, doi:10.1016/j.probengmech.2015.06.006.
"""

import math
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import numpy as np
from emcee import State
from emcee.moves import MHMove
from scipy.special import ndtri

from .estimates.weights import EvidenceError
from .resampling import systematic
from .settings import Settings, as_whole_number
from .tempering.mutation import MoveSchedule, Mutated
from .tempering.population import Population
from .tempering.smc_moves import move, resample

__all__ = ["RareEvent", "subset_simulation"]

FEWEST = 10  # points that a level keeps, and groups of points for the error
LEAST_PROBABILITY = 1e-15
FIRST_SCALE, TARGET_ACCEPTANCE = 0.6, 0.44  # of the moves; the target is that of Papaioannou et al. (2015)
MOST_EQUAL = 0.75  # share of points of one value above which levels make no progress


class RareEvent(NamedTuple):
    """Probability of a rare event; ``str`` is a sentence.

    Attributes
    ----------
    probability : float
        Estimate of the probability that the quantity exceeds the threshold.
    coefficient_of_variation : float
        Standard error of the probability, relative to the probability.
    lower, upper : float
        95 % interval, lognormal with this coefficient.
    threshold : float
        The threshold.
    levels : (n_levels,) float
        Thresholds of the stages, the last one is `threshold`.
    shares : (n_levels,) float
        Estimated conditional probability of each level, whose product is `probability`.
    acceptance : (n_levels - 1,) float
        Share of accepted proposals between the levels. Below a tenth, the points of a stage are nearly copies.
    simulations, failed : int
        Number of points at which the quantity was computed, and how many of them failed.
    coords : (k, ndim) float
        Points of the last stage at which the quantity exceeds the threshold: draws of the parameters given the event,
        not independent.
    """

    probability: float
    coefficient_of_variation: float
    lower: float
    upper: float
    threshold: float
    levels: np.ndarray
    shares: np.ndarray
    acceptance: np.ndarray
    simulations: int
    failed: int
    coords: np.ndarray

    def __str__(self) -> str:
        failed = f", {self.failed} of which failed" if self.failed else ""
        return (
            f"The probability to exceed {self.threshold:.4g} is {self.probability:.3g} (95 % interval {self.lower:.2g} "
            f"to {self.upper:.2g}), from {self.simulations} simulations{failed} in {len(self.levels)} levels."
        )

    __repr__ = __str__


class ConditionalMove(MHMove):
    """Steps u' = sqrt(1 - s^2) u + s e, e normal, which leave the standard normal distribution unchanged."""

    def __init__(self):
        super().__init__(self._draw)
        self.scale = FIRST_SCALE

    def _draw(self, coords, random):
        proposed = math.sqrt(1.0 - self.scale**2) * coords + self.scale * random.standard_normal(coords.shape)
        return proposed, 0.5 * np.sum(proposed**2 - coords**2, axis=1)

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Increase the scale s when the acceptance exceeds the target, and decrease it otherwise."""
        self.scale = min(self.scale * math.exp(float(np.mean(accepted)) - TARGET_ACCEPTANCE), 1.0)


class _Level:
    """The standard normal density, restricted to values of the quantity of at least `bound`, as moves evaluate it."""

    map = staticmethod(map)

    def __init__(self, function: Callable, failures_exceed: bool):
        self._function, self._failures_exceed, self.bound = function, failures_exceed, -np.inf
        self.evaluations = self.failed = 0

    def evaluate(self, coords: np.ndarray, then: Callable[[np.ndarray, np.ndarray], Any]) -> Any:
        """What `then` makes of points and their records: log-densities (-inf below the bound), values as blobs."""
        records = np.zeros(len(coords), [("log_prob", float), ("log_prior", float), ("blobs", float)])
        records["log_prior"] = -0.5 * np.sum(coords**2, axis=1)  # up to a constant
        values = np.asarray(self._function(coords.copy()), dtype=float)
        if values.shape != (len(coords),):
            raise ValueError(
                f"function must return one number per point, shape ({len(coords)},) for {len(coords)} points; got "
                f"{values.shape}"
            )
        failed = np.isnan(values)
        self.evaluations, self.failed = self.evaluations + len(values), self.failed + int(failed.sum())
        records["blobs"] = np.where(failed, np.inf if self._failures_exceed else -np.inf, values)
        above = (records["blobs"] >= self.bound) & (records["blobs"] > -np.inf)
        records["log_prob"] = np.where(above, records["log_prior"], -np.inf)
        return then(coords, records)


def subset_simulation(
    function: Callable[[np.ndarray], np.ndarray],
    threshold: float,
    ndim: int,
    *,
    n: int = 1000,
    level_probability: float = 0.1,
    failures_exceed: bool = False,
    seed: int | None = None,
) -> RareEvent:
    """Estimate the probability that a quantity exceeds a threshold, down to very small probabilities.

    Parameters
    ----------
    function : callable
        Takes points (k, ndim) and returns the quantity (k,) at each. NaN is a failed simulation, which is left out, so
        that the probability is conditional on simulations that do not fail; infinity is an exceedance, such as a
        collapse.
    threshold : float
        The threshold, in the unit of the quantity.
    ndim : int
        Number of standard normal parameters: map them in the function, ``prior.from_normal(points)``.
    n : int
        Points per level. The coefficient of variation falls with its square root.
    level_probability : float
        Share of the points that each level keeps, at most a half; n times this share is 10 or more.
    failures_exceed : bool
        Count a failed simulation as an exceedance, as in `fe_likelihoods.fragility`.
    seed : int, optional
        Seed of the run.

    Returns
    -------
    RareEvent

    Raises
    ------
    ValueError
        For impossible arguments, or results of the function of another shape. After simulations: if too many fail, most
        points of a level have the same value, or the probability is below 1e-15.

    Notes
    -----
    A level makes n simulations, a probability of 10^-k takes k levels. The estimate has a bias of order 1/n, because
    thresholds are quantiles of the points (study `rare_events` of docs/results.rst has its size). A region that no
    point of the first levels is near is missed, without a sign in the stated error.

    Examples
    --------
    >>> def total(points):
    ...     return points.sum(axis=1)
    >>> rare = subset_simulation(total, 6.0, ndim=2, seed=1)
    >>> bool(0.5e-5 < rare.probability < 2e-5)  # exact: 1.1e-5
    True
    """
    n = as_whole_number("n", n)
    if not (0.0 < level_probability <= 0.5 and n * level_probability >= FEWEST):
        raise ValueError(
            f"level_probability must be above 0 and at most 0.5, and keep {FEWEST} of n points or more; got "
            f"{level_probability} and n={n}"
        )
    if not np.isfinite(threshold):
        raise ValueError(f"threshold must be a finite number; got {threshold!r}")
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
    level, coords = _Level(function, failures_exceed), random.standard_normal((n, as_whole_number("ndim", ndim)))
    records = level.evaluate(coords, lambda _, records: records)
    known = records["log_prob"] > -np.inf
    n, kept = int(known.sum()), int(np.ceil(level_probability * known.sum()))
    if kept < FEWEST:
        raise ValueError(
            f"expected {FEWEST / level_probability:.0f} initial points or more whose simulation succeeds; got {n} of "
            f"{len(coords)}: see why the function returns NaN, or give failures_exceed=True"
        )
    population = Population(1.0, coords[known], records[known], float(n))
    # chains of Au & Beck (2001): from each of the points that a level keeps, one step per copy
    schedule, settings = MoveSchedule([ConditionalMove()], np.ones(1)), Settings(chains="leaders")
    error = EvidenceError(n, FEWEST / n)
    levels, shares, acceptance = [], [], []
    while True:
        values = population.records["blobs"]
        above, bound = values > threshold, float(np.partition(values, -kept)[-kept])
        last = above.mean() >= level_probability
        above = above if last else values >= bound
        levels.append(threshold if last else bound)
        shares.append(float(above.mean()))
        deviation = error.weigh(above / above.sum())
        if last:
            break
        if shares[-1] > MOST_EQUAL or np.prod(shares) < LEAST_PROBABILITY:
            raise ValueError(
                f"expected a quantity that reaches {threshold:g} with a probability above {LEAST_PROBABILITY:g}; at "
                f"{np.prod(shares):.2g}, {shares[-1]:.0%} of the points are at or above {bound:g}, the largest is "
                f"{values.max():g}: check the unit of the threshold, and whether the quantity has a largest value"
            )
        level.bound = bound
        ancestors = systematic(above / above.sum(), random)
        error.resample(ancestors)
        start = resample(population, ancestors, 1.0, float(above.sum()))
        moved = _result(move(start, ancestors, level, random, schedule, settings))
        population = moved.population
        acceptance.append(moved.acceptance)
    probability = float(np.prod(shares))
    factor = float(np.exp(ndtri(0.975) * np.sqrt(np.log1p(deviation**2))))
    return RareEvent(
        probability=probability,
        coefficient_of_variation=deviation,
        lower=probability / factor,
        upper=min(probability * factor, 1.0),
        threshold=float(threshold),
        levels=np.array(levels),
        shares=np.array(shares),
        acceptance=np.array(acceptance),
        simulations=level.evaluations,
        failed=level.failed,
        coords=population.coords[above],
    )


def _result(steps: Generator[object, None, Mutated]) -> Mutated:
    """What a generator returns, after all of its steps."""
    while True:
        try:
            next(steps)
        except StopIteration as stop:
            return stop.value
