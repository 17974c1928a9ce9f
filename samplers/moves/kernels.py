"""Mutation kernels in the form of emcee moves.

A tempered sampler resamples its population and then moves it at the new beta. Any emcee move can do that; the moves of
this module also learn from the population first: they have ``calibrate(coords, weights, inside)``, called once a
stage with the points of the last stage, their weights at the new beta, and a function that tells which points lie in
the support of the prior; and they move the whole ensemble at once.

Fits are made per unit of the weighted standard deviations, so a parameter of 2e-4 s beside one of 3e10 Pa is no matter.
"""

import math
from collections.abc import Callable

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import MHMove, Move

from ..proposals.mixture import (
    Mixture,
    draw,
    fit_mixture,
    flatten,
    invert_roots,
    location_and_root,
    log_density,
    log_responsibilities,
    unflatten,
)
from ..proposals.support_bounds import SupportBounds, find_support_bounds, log_abs_det_jacobian

__all__ = ["MixtureMove", "RandomWalkMove", "StudentTMove", "describe"]
WHOLE_DIFFERENCES = 0.1
REDRAWS = 20
SHARES = (0.5, 0.25, 0.25)
SHARES_DOING_WELL = (0.8, 0.1, 0.1)
Inside = Callable[[np.ndarray], np.ndarray]
CROSSOVERS = (1.0 / 3.0, 2.0 / 3.0, 1.0)


def describe(move: Move) -> dict:
    """A move as plain data: its class and its settings, which are its public attributes of plain type."""
    settings = {}
    for name, value in sorted(vars(move).items()):
        if not name.startswith("_"):
            if isinstance(value, Move):
                settings[name] = describe(value)
            elif value is None or isinstance(value, bool | int | float | str):
                settings[name] = value
            elif isinstance(value, list | tuple) and all(isinstance(item, Move) for item in value):
                settings[name] = [describe(item) for item in value]
    return {"class": type(move).__name__, **settings}


class _FittedMove(MHMove):
    """A Metropolis-Hastings move of the whole ensemble, whose proposal is fitted to weighted points."""

    def __init__(self):
        super().__init__(self._draw)
        self._mean = None
        self._root = None

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit the proposal to points (n, ndim) with normalised weights (n,)."""
        self._mean, self._root = location_and_root(coords, weights)

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """One proposal for every walker: the new state and which proposals (nwalkers,) were accepted."""
        if self._root is None:  # inside a plain EnsembleSampler nobody calibrates: fit to the ensemble as it stands
            n = len(state.coords)
            self.calibrate(state.coords, np.full(n, 1.0 / n))
        return super().propose(model, state)


class RandomWalkMove(_FittedMove):
    """Gaussian random walk with the weighted covariance of the stage.

    Parameters
    ----------
    scale : float, optional — multiplies the root of the covariance; 2.38 / sqrt(ndim) by default (Roberts, Gelman &
        Gilks 1997, doi:10.1214/aoap/1034625254).
    adapt : bool — let ``tune`` steer the scale towards the acceptance `target`; what is learnt stays for later stages.
    target : float — acceptance aimed at.
    """

    def __init__(self, scale: float | None = None, adapt: bool = False, target: float = 0.234):
        if scale is not None and not scale > 0.0:
            raise ValueError(f"scale multiplies the proposal's root and must be positive; got {scale}")
        super().__init__()
        self.scale = scale
        self.adapt = adapt
        self.target = target
        self._log_factor = 0.0

    def _draw(self, coords, random):
        ndim = coords.shape[1]
        scale = (2.38 / math.sqrt(ndim) if self.scale is None else self.scale) * math.exp(self._log_factor)
        return coords + scale * random.standard_normal(coords.shape) @ self._root.T, np.zeros(len(coords))

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Widen the walk where too much is accepted, narrow it where too little is (if `adapt`)."""
        if self.adapt:
            self._log_factor += float(np.mean(accepted)) - self.target


class StudentTMove(_FittedMove):
    """Independent draws from a multivariate Student t with the weighted mean and covariance of the stage.

    For a sharp, nearly Gaussian posterior one sweep renews most of the ensemble. The tails are heavier than those of a
    Gaussian, so the ratio of target and proposal stays bounded where the posterior's own tails are not heavier still.

    Parameters
    ----------
    dof : float — degrees of freedom, above 2 for the covariance to exist.
    """

    def __init__(self, dof: float = 6.0):
        if not dof > 2.0:
            raise ValueError(f"dof must be above 2, else the Student t has no covariance to fit; got {dof}")
        super().__init__()
        self.dof = dof
        self._inverse = None

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit mean and covariance to points (n, ndim) with normalised weights (n,)."""
        super().calibrate(coords, weights, inside)
        self._root = self._root * math.sqrt((self.dof - 2.0) / self.dof)
        self._inverse = invert_roots(self._root[None])[0]

    def _log_density(self, coords):
        """Log density up to a constant."""
        z = (coords - self._mean) @ self._inverse.T
        return -0.5 * (self.dof + z.shape[1]) * np.log1p(np.sum(z**2, axis=1) / self.dof)

    def _draw(self, coords, random):
        z = random.standard_normal(coords.shape)
        stretch = np.sqrt(self.dof / random.chisquare(self.dof, size=len(coords)))
        proposed = self._mean + (z * stretch[:, None]) @ self._root.T
        return proposed, self._log_density(coords) - self._log_density(proposed)


class MixtureMove(MHMove):
    """Three kernels, drawn sweep by sweep, all from one mixture fitted to the stage (see `samplers.proposals.mixture`).

    independence
        A draw from the mixture: crosses between modes, and renews most of an ensemble the mixture fits well. Half of
        all sweeps, and four in five as long as more than `enough` of its draws are accepted. A draw outside the support
        of the prior is repeated, at no evaluation: the proposal is the mixture cut off at the edges of the support.
    local walk
        A random walk with the covariance of one component, drawn from the responsibilities of the components for the
        point; the ratio of the responsibilities after and before makes it reversible.
    differences
        A step along the difference of two points of the last stage, drawn by their weights; now and then the whole
        difference, which leads from mode to mode (after ter Braak 2006, doi:10.1007/s11222-006-8769-1). The points are
        those the stage was calibrated on, so that the steps do not depend on the ensemble being moved.

    The scales of the last two are steered by ``tune`` towards the acceptance `target`.

    Parameters
    ----------
    max_components : int — of the mixture.
    enough : float — acceptance of the independent draws above which the other kernels mostly rest.
    target : float — acceptance aimed at by the walk and the differences.
    """

    def __init__(self, max_components: int = 6, enough: float = 0.5, target: float = 0.25):
        if max_components < 1:
            raise ValueError(f"max_components must be at least 1; got {max_components}")
        super().__init__(self._draw)
        self.max_components = max_components
        self.enough = enough
        self.target = target
        self._mixture: Mixture | None = None
        self._edges: SupportBounds | None = None
        self._kernels = (self._independence, self._local_walk, self._differences)
        self._log_factors = [0.0, 0.0, 0.0]
        self._turn = -1
        self._doing_well = False

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit the mixture to weighted points (n, ndim), (n,); the next sweep is an independent one."""
        if inside is not None and self._edges is None:
            self._edges = find_support_bounds(inside, coords)
        self._mixture = fit_mixture(coords, weights, self.max_components, self._edges)
        self._inside = inside
        self._archive = flatten(self._mixture, coords)
        self._cumulated = np.cumsum(weights)
        self._turn, self._doing_well = -1, False

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """One sweep of one kernel: the new state and which proposals (nwalkers,) were accepted."""
        if self._mixture is None:  # inside a plain EnsembleSampler nobody calibrates: fit to the ensemble as it stands
            n = len(state.coords)
            self.calibrate(state.coords, np.full(n, 1.0 / n))
        # chance decides, not a counter: a run goes on the same from the same random state
        shares = SHARES_DOING_WELL if self._doing_well else SHARES
        self._turn = 0 if self._turn < 0 else model.random.choice(len(self._kernels), p=shares)
        return super().propose(model, state)

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Steer the scale of the kernel made last, or see whether the independent draws do well."""
        share = float(np.mean(accepted))
        if self._turn == 0:
            self._doing_well = share > self.enough
        else:
            self._log_factors[self._turn] += share - self.target

    def _draw(self, coords, random):
        return self._kernels[self._turn](coords, random)

    def _independence(self, coords, random):
        proposed = draw(self._mixture, len(coords), random)
        if self._inside is not None:
            for _ in range(REDRAWS):
                outside = np.flatnonzero(~self._inside(proposed))
                if len(outside) == 0:
                    break
                proposed[outside] = draw(self._mixture, len(outside), random)
        return proposed, log_density(self._mixture, coords) - log_density(self._mixture, proposed)

    def _local_walk(self, coords, random):
        n, ndim = coords.shape
        before = log_responsibilities(self._mixture, coords)
        cumulated = np.cumsum(np.exp(before), axis=1)
        component = np.sum(cumulated < random.uniform(size=n)[:, None] * cumulated[:, -1:], axis=1)
        scale = 2.38 / math.sqrt(ndim) * math.exp(self._log_factors[1])
        steps = np.einsum("nij,nj->ni", self._mixture.roots[component], random.standard_normal((n, ndim)))
        proposed, factors = self._step(coords, scale * steps)
        rows = np.arange(n)
        return proposed, factors + log_responsibilities(self._mixture, proposed)[rows, component] - before[
            rows, component
        ]

    def _step(self, coords, steps):
        """Points moved by steps among the flat ones, and the ratio of volumes for it."""
        proposed = unflatten(self._mixture, flatten(self._mixture, coords) + steps)
        if self._mixture.edges is None:
            return proposed, np.zeros(len(coords))
        before, after = (log_abs_det_jacobian(self._mixture.edges, points) for points in (coords, proposed))
        possible = (before > -np.inf) & (after > -np.inf)
        return proposed, np.where(possible, np.where(possible, before, 0.0) - np.where(possible, after, 0.0), -np.inf)

    def _differences(self, coords, random):
        n, ndim = coords.shape
        first, second = (
            np.searchsorted(self._cumulated, random.uniform(size=n) * self._cumulated[-1], side="right")
            for _ in range(2)
        )
        crossed = random.uniform(size=(n, ndim)) < random.choice(CROSSOVERS, size=n)[:, None]
        crossed[np.arange(n), random.randint(ndim, size=n)] = True
        scale = 2.38 / np.sqrt(2.0 * crossed.sum(axis=1)) * math.exp(self._log_factors[2])
        scale[random.uniform(size=n) < WHOLE_DIFFERENCES] = 1.0
        steps = crossed * scale[:, None] * (self._archive[first] - self._archive[second])
        return self._step(coords, steps)
