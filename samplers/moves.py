"""Mutation kernels in the form of emcee moves.

A tempered sampler resamples its population and then moves it at the new beta. Any emcee move can do that; the moves of
this module also learn from the population first: they have ``calibrate(coords, weights)``, called once a stage with the
points of the last stage and their weights at the new beta, and they move the whole ensemble at once.

Fits are made per unit of the weighted standard deviations, so a parameter of 2e-4 s beside one of 3e10 Pa is no matter.
"""

import math
from collections.abc import Sequence

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import MHMove, Move
from scipy.linalg import solve_triangular

__all__ = ["AlternatingMove", "RandomWalkMove", "StudentTMove"]

FEW_POINTS = 5.0
SMALLEST_PIVOT = 1e-7


def _location_and_root(coords: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (ndim,) and a lower-triangular root (ndim, ndim) of the weighted covariance, always regular.

    The root is standard deviations times the root of the correlation matrix. With less than five effective points a
    dimension the correlations are not known and are shrunk towards zero; where the matrix is singular all the same, its
    diagonal is raised until it is not.
    """
    mean = weights @ coords
    centred = coords - mean
    sd = np.sqrt(weights @ centred**2)
    # a parameter without spread keeps a sliver of it, in its own unit
    sd = np.maximum(sd, np.maximum(1e-12 * coords.std(axis=0), np.spacing(np.abs(mean))))
    standard = centred / sd
    correlation = (standard * weights[:, None]).T @ standard

    ndim = len(mean)
    shrinkage = max(0.0, 1.0 - 1.0 / (weights @ weights) / (FEW_POINTS * ndim))
    correlation *= 1.0 - shrinkage
    np.fill_diagonal(correlation, 1.0)
    jitter = 0.0
    while True:
        try:
            root = np.linalg.cholesky((correlation + jitter * np.eye(ndim)) / (1.0 + jitter))
            if root.diagonal().min() > SMALLEST_PIVOT:
                return mean, sd[:, None] * root
        except np.linalg.LinAlgError:
            pass
        jitter = max(10.0 * jitter, 1e-12)


class _FittedMove(MHMove):
    """A Metropolis-Hastings move of the whole ensemble, whose proposal is fitted to weighted points."""

    def __init__(self):
        super().__init__(self._draw)
        self._mean = None
        self._root = None

    def calibrate(self, coords: np.ndarray, weights: np.ndarray) -> None:
        """Fit the proposal to points (n, ndim) with normalised weights (n,)."""
        self._mean, self._root = _location_and_root(coords, weights)

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

    def calibrate(self, coords: np.ndarray, weights: np.ndarray) -> None:
        """Fit mean and covariance to points (n, ndim) with normalised weights (n,)."""
        super().calibrate(coords, weights)
        self._root = self._root * math.sqrt((self.dof - 2.0) / self.dof)
        self._inverse = solve_triangular(self._root, np.eye(len(self._root)), lower=True)

    def _log_density(self, coords):
        """Log density up to a constant."""
        z = (coords - self._mean) @ self._inverse.T
        return -0.5 * (self.dof + z.shape[1]) * np.log1p(np.sum(z**2, axis=1) / self.dof)

    def _draw(self, coords, random):
        z = random.standard_normal(coords.shape)
        stretch = np.sqrt(self.dof / random.chisquare(self.dof, size=len(coords)))
        proposed = self._mean + (z * stretch[:, None]) @ self._root.T
        return proposed, self._log_density(coords) - self._log_density(proposed)


class AlternatingMove(Move):
    """Several moves in turn; the first one alone while it does well.

    Parameters
    ----------
    moves : sequence of emcee moves.
    enough : float — acceptance of the first move above which the others rest until the next calibration. Decided in
        ``tune`` only, so that the kernel is a fixed cycle when nobody tunes.
    """

    def __init__(self, moves: Sequence[Move], enough: float = 0.5):
        if len(moves) == 0:
            raise ValueError("moves is empty: give at least one emcee move")
        self.moves = list(moves)
        self.enough = enough
        self._last = -1
        self._first_alone = False

    def calibrate(self, coords: np.ndarray, weights: np.ndarray) -> None:
        """Calibrate every move that learns, and start the cycle again."""
        self._last = -1
        self._first_alone = False
        for move in self.moves:
            if hasattr(move, "calibrate"):
                move.calibrate(coords, weights)

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """One sweep of the move whose turn it is: the new state and which proposals (nwalkers,) were accepted."""
        self._last = 0 if self._first_alone else (self._last + 1) % len(self.moves)
        return self.moves[self._last].propose(model, state)

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Tune the move made last; let the first one work alone if enough of its proposals were accepted."""
        if self._last == 0:
            self._first_alone = float(np.mean(accepted)) > self.enough
        self.moves[self._last].tune(state, accepted)
