"""Sweeps over the parameters that cost nothing, between the moves that cost a simulation.

Of many posteriors some parameters change the density without a new simulation: the levels of the noise, where the
sums of squared residuals are kept. A function that knows so says it with an attribute ``fast_parameters``, the indices
of these parameters. Each costly move is then followed by a few random walks of these parameters alone, all others held:
Metropolis within Gibbs, so the target stays the same, and the costly move need no more wait for the noise to follow.
"""

import operator
from collections.abc import Sequence

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import Move

from .kernels import Inside, RandomWalkMove

__all__ = ["WithFastSweeps", "with_fast_sweeps"]

TARGET_ACCEPTANCE = 0.35  # best for a walk in two dimensions (Gelman, Roberts & Gilks 1996); 0.44 in one, 0.23 in many


class _FreeWalk(RandomWalkMove):
    """Random walk of some coordinates, with their covariance given the others; the others stay as they are."""

    def __init__(self, indices: Sequence[int]):
        super().__init__(adapt=True, target=TARGET_ACCEPTANCE)
        self.indices = _checked(indices)

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit the walk to points (n, ndim) with normalised weights (n,)."""
        ndim = coords.shape[1]
        _checked(self.indices, ndim)
        held = np.setdiff1d(np.arange(ndim), self.indices)
        super().calibrate(coords[:, np.concatenate([held, self.indices])], weights, inside)
        # the last block of a lower-triangular root is a root of the covariance given what comes before
        self._root = self._root[len(held) :, len(held) :]

    def _draw(self, coords, random):
        proposed = coords.copy()
        proposed[:, self.indices], factors = super()._draw(coords[:, self.indices], random)
        return proposed, factors


class WithFastSweeps(Move):
    """A move, followed by sweeps over the coordinates whose change costs no simulation.

    Parameters
    ----------
    move : emcee move — the costly one. Its acceptance is the acceptance of the whole.
    indices : sequence of int — the coordinates that are free.
    sweeps : int — random walks of the whole ensemble in these coordinates after every move. Their scale is
        2.38 / sqrt(number of free coordinates) times the root of the conditional covariance; ``tune`` steers it.

    Raises
    ------
    ValueError
        If there are no indices, one of them is no coordinate, or `sweeps` is below 1.
    """

    def __init__(self, move: Move, indices: Sequence[int], sweeps: int = 2):
        if sweeps < 1:
            raise ValueError(f"sweeps must be at least 1; got {sweeps}: without them, use the move itself")
        self.move = move
        self.sweeps = sweeps
        self._walk = _FreeWalk(indices)
        self._accepted = np.empty(0)

    @property
    def indices(self) -> tuple[int, ...]:
        """The free coordinates, in ascending order."""
        return self._walk.indices

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit the walk, and the move if it learns, to points (n, ndim) with normalised weights (n,)."""
        if hasattr(self.move, "calibrate"):
            self.move.calibrate(coords, weights, inside)
        self._walk.calibrate(coords, weights, inside)

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """The move, then the fast sweeps: the new state and which proposals (nwalkers,) of the move were accepted."""
        state, accepted = self.move.propose(model, state)
        shares = []
        for _ in range(self.sweeps):
            state, free = self._walk.propose(model, state)
            shares.append(np.mean(free))
        self._accepted = np.array(shares)
        return state, accepted

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Tune the move, and the scale of the fast sweeps made after it."""
        self.move.tune(state, accepted)
        self._walk.tune(state, self._accepted)


def with_fast_sweeps(moves: Sequence[Move], indices: Sequence[int], ndim: int, sweeps: int) -> list[Move]:
    """The moves, each followed by `sweeps` over the free coordinates; as they are if none or all coordinates are free.

    Raises
    ------
    ValueError
        If an index is not one of the `ndim` coordinates.
    """
    if sweeps == 0 or len(indices) == 0:
        return list(moves)
    free = _checked(indices, ndim)
    return list(moves) if len(free) == ndim else [WithFastSweeps(move, free, sweeps) for move in moves]


def _checked(indices: Sequence[int], ndim: int | None = None) -> tuple[int, ...]:
    """Different indices in ascending order, or ValueError."""
    try:
        free = tuple(sorted({operator.index(index) for index in indices}))
    except TypeError:
        raise ValueError(f"fast_parameters must be indices of parameters, whole numbers; got {indices!r}") from None
    if not free or free[0] < 0 or (ndim is not None and free[-1] >= ndim):
        known = "0, 1, ..." if ndim is None else f"0 to {ndim - 1}"
        raise ValueError(f"fast_parameters must be indices of parameters, from {known}; got {tuple(indices)}")
    return free
