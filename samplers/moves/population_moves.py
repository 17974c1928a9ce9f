"""Mutation kernels in the form of emcee moves, which also adapt to the population.

Their ``calibrate(coords, weights, inside, mixture)`` gets the points of the previous stage once per stage, their
weights at the new beta, which points lie in the support of the prior, and a known mixture. Proposals are fitted in
units of the weighted standard deviations, so that very different magnitudes (2e-4 s and 3e10 Pa) cause no numerical
problem. Acceptances are derived in ``docs/theory/tempering``.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from numbers import Integral
from typing import Any

import numpy as np

from ..emcee_names import DEMove, MHMove, Model, Move, State
from ..proposals.basins import find_basins, with_components
from ..proposals.mixture import (
    Mixture,
    draw,
    draw_inside,
    fit_mixture,
    from_component_space,
    leave_out,
    location_and_root,
    log_density,
    log_responsibilities,
    to_component_space,
)
from ..proposals.transforms import find_support_bounds, log_abs_det_jacobian
from ..resampling import locate

# Probability of the independence kernel, and while its acceptance is above a half, since it decorrelates the ensemble
# fastest: equal probabilities take a tenth more evaluations. Local walk and differences share the rest.
INDEPENDENT, IF_ACCEPTED = 0.5, 0.8
# Scale of a random walk times the square root of the dimension, and acceptance of the walk and of the differences: best
# for normal densities are 2.38 and 0.234 (Roberts et al. 1997).
BEST_SCALE, TARGET_ACCEPTANCE = 2.38, 0.25
# Parts of the fitted points, where they are fewer than this per number of the means and covariances of a fit; the
# points of a part are moved by a fit to the others and by their differences, and copies, which follow each other, share
# a part. Means of two modes in 11 dimensions were off by 1.3 stated errors with 1.9 points per number without parts, by
# 1.0 from 3.2 on: 3 and 8 would do too. With parts of independent draws alone, nine runs with 20 curved parameters had
# means off by 1.6 errors and log-evidences of the stages .64 too high; with parts of all kernels 1.1 and .16.
PARTS, FEW_POINTS = 10, 5.0
# Share of the difference steps with scale 1, which lead from mode to mode (ter Braak 2006). Without differences, the
# means of 24 runs with two modes in 11 dimensions are off by 1.6 stated errors.
UNIT_SCALE_SHARE = 0.1
# Crossover probabilities of the difference steps, as in DREAM (Vrugt et al. 2009, doi:10.1515/IJNSNS.2009.10.3.273).
# With 1 alone, 1 of 24 runs of TMCMC lost one of several modes instead of none, for 2 % fewer evaluations.
CROSSOVERS = (1.0 / 3.0, 2.0 / 3.0, 1.0)

Inside = Callable[[np.ndarray], np.ndarray]


def describe(move: Move) -> dict:
    """A move as plain data: its class, and its public attributes that are plain, moves or lists of moves."""

    def plain(value: Any) -> Any:
        if isinstance(value, Move):
            return describe(value)
        return [plain(each) for each in value] if isinstance(value, list | tuple) else value

    found = {name: plain(value) for name, value in sorted(vars(move).items()) if name[0] != "_" and name != "is_fitted"}
    kinds = type(None) | bool | int | float | str | dict | list
    return {"class": type(move).__name__} | {name: value for name, value in found.items() if isinstance(value, kinds)}


class _FittedMove(MHMove):
    """A Metropolis-Hastings move of the whole ensemble, whose proposal is fitted to weighted points before."""

    is_fitted = False  # whether the move was calibrated; otherwise it cannot propose

    def __init__(self):
        super().__init__(self._draw_if_fitted)

    def _draw_if_fitted(self, coords: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        """Proposed points and log-ratios of proposal densities for points (n, ndim)."""
        if not self.is_fitted:
            raise ValueError(
                f"{type(self).__name__} is fitted to the stages of an annealing: use it in SMCSampler or TMCMCSampler, "
                "and emcee's own moves in EnsembleSampler"
            )
        return self._draw(coords, random)


def without_unfitted(moves: Sequence[Move]) -> list[Move]:
    """The moves, with emcee's differential evolution instead of those of an annealing that is not made again: a fit to
    the points that it moves would make tails too light (heavy tails kept .94 of their variance).
    """
    inner = (getattr(move, "move", move) for move in moves)
    return [move if getattr(each, "is_fitted", True) else DEMove() for move, each in zip(moves, inner, strict=True)]


class RandomWalkMove(_FittedMove):
    """Gaussian random walk with the weighted covariance of the stage.

    Parameters
    ----------
    scale : float, optional
        Factor on the covariance root; 2.38 / sqrt(ndim) by default.

    References
    ----------
    Roberts, G. O., Gelman, A. & Gilks, W. R. (1997), Weak convergence and optimal scaling of random walk Metropolis
    algorithms, Annals of Applied Probability 7(1), doi:10.1214/aoap/1034625254

    Examples
    --------
    >>> walk = RandomWalkMove(scale=1.0)
    >>> walking = SMCSampler(100, posterior.ndim, posterior, moves=walk, recycle=False, vectorize=True)
    """

    def __init__(self, scale: float | None = None):
        if scale is not None and not scale > 0.0:
            raise ValueError(f"scale multiplies the root of the covariance and must be positive; got {scale}")
        super().__init__()
        self.scale = scale
        self._root: np.ndarray | None = None

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, *others: Any) -> None:
        """Fit the covariance to points (n, ndim) with normalised weights (n,)."""
        self.is_fitted = True
        self._root = location_and_root(coords, weights)[1]

    def _draw(self, coords, random):
        scale = BEST_SCALE / math.sqrt(coords.shape[1]) if self.scale is None else self.scale
        return coords + scale * random.standard_normal(coords.shape) @ self._root.T, np.zeros(len(coords))


class MixtureMove(_FittedMove):
    """Three kernels from one Student t mixture fitted to the stage; each sweep chooses one kernel at random.

    independence
        Draws from the mixture, truncated to the support of the prior, which cross between modes. The first sweep after
        each calibration uses this kernel, as half of all sweeps do, or 80 % while its acceptance is above a half.
    local walk
        Random walk with the covariance of one component, drawn from the responsibilities for the current point.
    differences
        Differential evolution: a step along the difference of two points of the stage that the move was calibrated on,
        drawn by their weights. One step in ten is the whole difference, which leads from mode to mode.

    References
    ----------
    ter Braak, C. J. F. (2006), A Markov chain Monte Carlo version of the genetic algorithm differential evolution,
    Statistics and Computing 16, doi:10.1007/s11222-006-8769-1

    Examples
    --------
    >>> moves = [(MixtureMove(), 0.8), (RandomWalkMove(), 0.2)]
    >>> mixed = SMCSampler(100, posterior.ndim, posterior, moves=moves, vectorize=True)
    """

    def __init__(self):
        super().__init__()
        self._bounds: np.ndarray | None = None  # (2, ndim), of the support
        self._kernels = (self._draw_independence, self._draw_local_walk, self._draw_differences)
        self._log_factors = [0.0, 0.0, 0.0]
        self._part: np.ndarray | None = None  # of each walker, see `follow`
        self._mixtures: list[Mixture] = []  # fitted without the points of one part each, and to all points
        self._current: int | None = None  # kernel index in the latest sweep; None right after a calibration
        self._independence_accepted = False

    def calibrate(
        self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None, mixture: Mixture | None = None
    ) -> None:
        """Fit the mixture to points (n, ndim) with normalised weights (n,), or take a given `mixture`; the bounds of
        the support are found at the first call. Each tenth of few points is moved by a fit to the others, if `follow`
        says which walker descends from which: a point that has shaped a proposal is replaced, or kept, too easily.
        """
        self.is_fitted = True
        if inside is not None and self._bounds is None:
            self._bounds = find_support_bounds(inside, coords)
        whole = fit_mixture(coords, weights, bounds=self._bounds) if mixture is None else mixture
        self._inside, self._weights = inside, weights
        self._archive = to_component_space(whole, coords)
        self._current, self._independence_accepted = None, False
        n, ndim = coords.shape
        self._part, self._parts, self._mixtures = None, np.full(n, -1), [whole]
        if mixture is None and n < FEW_POINTS * len(whole.weights) * ndim * (ndim + 3.0) / 2.0:
            self._parts = np.arange(n) * PARTS // n
            self._mixtures = [*leave_out(whole, coords, weights, self._parts), whole]

    def follow(self, ancestors: np.ndarray) -> None:
        """Say from which of the points of the last calibration each walker descends, by indices (nwalkers,)."""
        self._part = self._parts[ancestors]

    def cover_basins(self, coords: np.ndarray, log_target: np.ndarray) -> None:
        """Add components for parts of the target that the mixture does not cover, from points (n, ndim), also of
        earlier stages, and the `log_target` (n,) there, scaled so that its integral is 1.
        """
        found = find_basins(self._mixtures[-1], coords, log_target)
        self._mixtures = [with_components(mixture, found) for mixture in self._mixtures]

    def expect_independence(self) -> None:
        """Prefer the independence kernel, without a first sweep: the points are independent draws from the same
        mixture.
        """
        self._current, self._independence_accepted = 0, True

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Adapt the scale of the kernel used last, or record whether independent draws have a high acceptance."""
        share = float(np.mean(accepted))
        if self._current == 0:
            self._independence_accepted = share > 0.5
        else:
            self._log_factors[self._current] += share - TARGET_ACCEPTANCE

    def _draw(self, coords, random):
        # A random choice, not a counter: a resumed run continues identically from the stored random state alone.
        first = IF_ACCEPTED if self._independence_accepted else INDEPENDENT
        shares = [first, 0.5 - 0.5 * first, 0.5 - 0.5 * first]
        self._current = 0 if self._current is None else random.choice(len(self._kernels), p=shares)
        known = self._part is not None and len(self._part) == len(coords)
        parts = self._part if known else np.full(len(coords), -1)
        proposed, log_ratios = coords.copy(), np.empty(len(coords))
        for part in np.unique(parts):
            rows = parts == part
            proposed[rows], log_ratios[rows] = self._kernels[self._current](coords[rows], random, part)
        return proposed, log_ratios

    def _draw_independence(self, coords, random, part=-1):
        """Independent draws for points (n, ndim) of a part, and log-ratios (n,) q(x | x') / q(x' | x)."""
        mixture, n, inside = self._mixtures[part], len(coords), self._inside
        drawn = draw(mixture, n, random) if inside is None else draw_inside(mixture, n, random, inside)[0]
        proposed, log_ratios = coords.copy(), np.full(n, -np.inf)  # those without a draw inside do not move
        proposed[: len(drawn)] = drawn
        log_ratios[: len(drawn)] = log_density(mixture, coords[: len(drawn)]) - log_density(mixture, drawn)
        return proposed, log_ratios

    def _draw_local_walk(self, coords, random, part=-1):
        """Steps of the local random walk, and log-ratios as for independent draws."""
        mixture, (n, ndim) = self._mixtures[part], coords.shape
        before = log_responsibilities(mixture, coords)
        cumulated = np.cumsum(np.exp(before), axis=1)
        component = np.sum(cumulated < random.uniform(size=n)[:, None] * cumulated[:, -1:], axis=1)
        scale = BEST_SCALE / math.sqrt(ndim) * math.exp(self._log_factors[1])
        steps = np.einsum("nij,nj->ni", mixture.roots[component], random.standard_normal((n, ndim)))
        proposed, factors = self._step(coords, scale * steps)
        rows = np.arange(n)
        return proposed, factors + log_responsibilities(mixture, proposed)[rows, component] - before[rows, component]

    def _step(self, coords, steps):
        """Make steps in the space of the components; also return the log ratio of volumes that the acceptance needs."""
        space = self._mixtures[-1]
        proposed = from_component_space(space, to_component_space(space, coords) + steps)
        before, after = (log_abs_det_jacobian(space.bounds, points) for points in (coords, proposed))
        possible = (before > -np.inf) & (after > -np.inf)
        return proposed, np.where(possible, np.where(possible, before, 0.0) - np.where(possible, after, 0.0), -np.inf)

    def _draw_differences(self, coords, random, part=-1):
        """Steps along differences of points of other parts, which may have no weight, and log-ratios."""
        n, ndim = coords.shape
        others = self._weights * np.where(self._parts == part, 1e-200, 1.0)
        first, second = (locate(others, random.uniform(size=n)) for _ in range(2))
        crossed = random.uniform(size=(n, ndim)) < random.choice(CROSSOVERS, size=n)[:, None]
        crossed[np.arange(n), random.randint(ndim, size=n)] = True
        scale = BEST_SCALE / np.sqrt(2.0 * crossed.sum(axis=1)) * math.exp(self._log_factors[2])
        scale[random.uniform(size=n) < UNIT_SCALE_SHARE] = 1.0
        steps = crossed * scale[:, None] * (self._archive[first] - self._archive[second])
        return self._step(coords, steps)


def guide_move(guide: Any) -> MHMove:
    """The move that proposes one independent draw of a guide for each walker: exact for any density that does not
    change (Tierney 1994, Annals of Statistics 22(4), doi:10.1214/aos/1176325750, section 2.3.3).
    """
    return MHMove(partial(_draw_of_guide, guide))


def _draw_of_guide(guide: Any, coords: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
    proposed = guide.draw(len(coords), random)
    return proposed, guide.log_density(coords) - guide.log_density(proposed)


# ---------------------------------------------------------------- sweeps over fast parameters

# Some parameters change the density without a new simulation, such as noise standard deviations (Lewis 2013,
# doi:10.1103/PhysRevD.87.103529). Without sweeps over them, 12 runs of 50 walkers by moves with five structural
# parameters and four noise levels had means that were off by 0.60 standard deviations (with them 0.14), and
# log-evidences by 10.8 (0.4). With 100 and 250 walkers, 15 runs by moves took 5 to 14 % more simulations, with equal
# errors; runs that recycle show no difference.


class WithFastSweeps(MHMove):
    """A move, followed by random-walk steps (`sweeps`) of the whole ensemble in the fast parameters (`indices`), with
    their covariance given the others. The reported acceptance is the move's.
    """

    def __init__(self, move: Move, indices: Sequence[int], sweeps: int = 2):
        super().__init__(self._draw)
        self.move, self.indices, self.sweeps = move, tuple(indices), sweeps
        self._root = np.zeros((len(indices), len(indices)))

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, *others: Any) -> None:
        """Fit the walk, and the move if it can be fitted (`samplers.moves.population_moves`)."""
        if hasattr(self.move, "calibrate"):
            self.move.calibrate(coords, weights, *others)
        slow = np.setdiff1d(np.arange(coords.shape[1]), self.indices)
        # The last diagonal block of a lower-triangular root of the covariance is a root of the covariance of the last
        # coordinates, conditional on the others.
        root = location_and_root(coords[:, np.concatenate([slow, self.indices])], weights)[1]
        self._root = root[len(slow) :, len(slow) :]

    def _draw(self, coords: np.ndarray, random: np.random.RandomState) -> tuple[np.ndarray, np.ndarray]:
        proposed, scale = coords.copy(), BEST_SCALE / math.sqrt(len(self.indices))
        normal = random.standard_normal((len(coords), len(self.indices)))
        proposed[:, self.indices] += scale * normal @ self._root.T
        return proposed, np.zeros(len(coords))

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """Make the move, then the fast sweeps; the accepted proposals (nwalkers,) belong to the move."""
        state, accepted = self.move.propose(model, state)
        for _ in range(self.sweeps):
            state, _ = super().propose(model, state)
        return state, accepted

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Tune the move."""
        self.move.tune(state, accepted)


def with_fast_sweeps(moves: Sequence[Move], indices: Sequence[int], ndim: int, sweeps: int) -> list[Move]:
    """The moves, each followed by sweeps over the parameters with these indices, if some of `ndim`, not all, are fast.

    ValueError for an invalid index.
    """
    if invalid := [index for index in indices if not (isinstance(index, Integral) and 0 <= index < ndim)]:
        raise ValueError(f"fast_parameters must be indices of parameters, from 0 to {ndim - 1}; got {invalid}")
    fast = sorted({int(index) for index in indices})
    if sweeps == 0 or not 0 < len(fast) < ndim:
        return list(moves)
    return [WithFastSweeps(move, fast, sweeps) for move in moves]
