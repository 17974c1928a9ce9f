r"""Subset simulation: the probability of a rare event, as a product of larger conditional probabilities.

The event is that a quantity g of the parameters exceeds a threshold. With thresholds :math:`b_1 < \dots < b_m = b`,

.. math:: P(g > b) = P(g > b_1) \prod_{l=2}^m P(g > b_l \mid g > b_{l-1}),

and each factor is near a tenth (Au & Beck 2001). It is Sequential Monte Carlo with the indicator of :math:`g > b_l` as
the likelihood of stage l, so that the same parts do the work as in tempering: points are weighted, resampled
(`samplers.resampling`), and moved (`samplers.tempering.smc_moves.move`), and the error of the product is the error of
the evidence, which counts points with a common ancestor as dependent (`samplers.estimates.weights.EvidenceError`).
Only the choice of the next stage differs: a quantile of g in place of an exponent.

The parameters are standard normal by default, for priors mapped from standard normal coordinates. Moves are then the
conditional sampling of Papaioannou et al. (2015), whose acceptance does not fall with the number of parameters, in
chains of ten steps from each point that a level keeps. For another density, such as a posterior, the points make a
random walk with the covariance of the initial draws until they are nearly uncorrelated with their start, as in
`samplers.tmcmc`, which takes about six times as many simulations. No move is fitted to the points of a level: with a
mixture fitted to a hundred points, a probability of 1e-5 came out five times too small.

References
----------
S.-K. Au, J. L. Beck (2001), Estimation of small failure probabilities in high dimensions by subset simulation,
Probabilistic Engineering Mechanics 16(4), 263-277, doi:10.1016/S0266-8920(01)00019-4.
I. Papaioannou, W. Betz, K. Zwirglmaier, D. Straub (2015), MCMC algorithms for subset simulation, Probabilistic
Engineering Mechanics 41, 89-103, doi:10.1016/j.probengmech.2015.06.006.
"""

from collections.abc import Callable, Generator
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from .estimates.weights import EvidenceError
from .moves.population_moves import ConditionalMove, RandomWalkMove
from .resampling import systematic
from .settings import Settings, as_whole_number
from .tempering.mutation import MoveSchedule, Mutated
from .tempering.population import Population
from .tempering.smc_moves import move, resample

__all__ = ["RareEvent", "subset_simulation"]

FEWEST = 10  # points that a level keeps, and groups of points for the error
LEAST_PROBABILITY = 1e-15
BURN_IN = 4  # steps of a chain before its points count, and sweeps follow; for other densities than the normal
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


class _Level:
    """The density of the parameters, restricted to values of the quantity of at least `bound`, as moves evaluate it."""

    map = staticmethod(map)

    def __init__(self, function: Callable, log_density: Callable, failures_exceed: bool):
        self._function, self._log_density, self._failures_exceed = function, log_density, failures_exceed
        self.bound = -np.inf
        self.evaluations = self.failed = 0

    def evaluate(self, coords: np.ndarray, observe: Callable[[np.ndarray], None] | None = None) -> np.ndarray:
        """Records (n,) of points: the log-density as log_prior and log_prob (-inf below the bound), values as blobs."""
        records = np.zeros(len(coords), [("log_prob", float), ("log_prior", float), ("blobs", float)])
        log_density = _checked(self._log_density(coords.copy()), len(coords), "log_prob_fn")
        records["log_prior"] = np.where(np.isnan(log_density), -np.inf, log_density)
        inside = records["log_prior"] > -np.inf
        records["blobs"] = -np.inf
        if inside.any():
            values = _checked(self._function(coords[inside]), int(inside.sum()), "function")
            failed = np.isnan(values)
            self.evaluations, self.failed = self.evaluations + len(values), self.failed + int(failed.sum())
            records["blobs"][inside] = np.where(failed, np.inf if self._failures_exceed else -np.inf, values)
        above = inside & (records["blobs"] >= self.bound) & (records["blobs"] > -np.inf)
        records["log_prob"] = np.where(above, records["log_prior"], -np.inf)
        return records


def _checked(values: object, n: int, name: str) -> np.ndarray:
    found = np.asarray(values, dtype=float)
    if found.shape != (n,):
        raise ValueError(f"{name} must return one number per point, shape ({n},) for {n} points; got {found.shape}")
    return found


def _standard_normal(coords: np.ndarray) -> np.ndarray:
    """Log-density, up to a constant."""
    return -0.5 * np.sum(coords**2, axis=1)


def subset_simulation(
    function: Callable[[np.ndarray], np.ndarray],
    threshold: float,
    ndim: int | None = None,
    *,
    log_prob_fn: Callable[[np.ndarray], np.ndarray] | None = None,
    initial: np.ndarray | None = None,
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
    ndim : int, optional
        Number of standard normal parameters: map them in the function, ``prior.from_normal(points)``.
    log_prob_fn : callable, optional
        Another density of the parameters, such as a posterior: takes points (k, ndim), and returns the logarithms (k,)
        of the density, up to a constant. It is called at every point, before the function.
    initial : (n, ndim) array_like, optional
        Independent draws of this density, such as ``sampler.get_chain(flat=True)`` after thinning. If they are
        correlated, the stated error is too small.
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
    A level makes n simulations (about 6 n for another density), a probability of 10^-k takes k levels. The estimate has
    a bias of order 1/n, because thresholds are quantiles of the points (study `rare_events` of docs/results.rst has its
    size). A region that no point of the first levels is near is missed, without a sign in the stated error.

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
    if (log_prob_fn is None) != (initial is None) or (ndim is None) != (log_prob_fn is not None):
        raise ValueError(
            "give ndim for standard normal parameters, or log_prob_fn with initial draws of it for another density; "
            f"got ndim={ndim!r}, log_prob_fn={log_prob_fn!r} and initial={'None' if initial is None else 'draws'}"
        )
    random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
    burn_in = 0 if initial is None else BURN_IN
    if initial is None:
        level, moves = _Level(function, _standard_normal, failures_exceed), ConditionalMove()
        coords = random.standard_normal((n, as_whole_number("ndim", ndim)))
    else:
        coords = np.array(initial, dtype=float)
        if coords.ndim != 2 or len(coords) != n or not np.isfinite(coords).all():
            raise ValueError(f"initial must be n={n} finite points, shape ({n}, ndim); got shape {coords.shape}")
        level = _Level(function, log_prob_fn, failures_exceed)
        moves = RandomWalkMove(adapt=True, target=None)
        moves.calibrate(coords, np.full(n, 1.0 / n))
    records = level.evaluate(coords)
    known = records["log_prob"] > -np.inf
    n, kept = int(known.sum()), int(np.ceil(level_probability * known.sum()))
    if kept < FEWEST:
        raise ValueError(
            f"expected {FEWEST / level_probability:.0f} initial points or more whose simulation succeeds; got {n} of "
            f"{len(coords)}: see why the function returns NaN, or give failures_exceed=True"
        )
    population = Population(1.0, coords[known], records[known], float(n))
    # chains of Au & Beck (2001): from each of the points that a level keeps, one step per copy
    schedule, settings = MoveSchedule([moves], np.ones(1)), Settings(chains="leaders", burn_in=burn_in)
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
