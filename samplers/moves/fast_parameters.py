"""Extra sweeps over fast parameters, made after each move that needs a simulation.

In many posteriors some parameters change the density without a new simulation: the noise standard deviations, for
example, when the sums of squared residuals are cached. The cosmology codes CosmoMC and Cobaya call them *fast
parameters*. A posterior declares them by an attribute ``fast_parameters``, the indices of these parameters. After each
expensive move the ensemble makes a few random-walk steps in the fast parameters alone, with all other parameters fixed.
This is Metropolis within Gibbs, so the target distribution is unchanged, and the fast parameters decorrelate without
additional simulations. The equations are in ``docs/theory/tempering``.

References
----------
Lewis, A. (2013), Efficient sampling of fast and slow cosmological parameters, Physical Review D 87, 103529,
doi:10.1103/PhysRevD.87.103529
"""

import operator
from collections.abc import Sequence

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import Move

from ..proposals.mixture import Mixture
from .population_moves import Inside, MixtureMove, RandomWalkMove, calibrate_move

__all__ = ["FastWalk", "WithFastSweeps", "with_fast_sweeps"]

# Optimal acceptance of a random walk in two dimensions; it is 0.44 in one dimension and 0.23 in many. Gelman, Roberts &
# Gilks (1996), Efficient Metropolis jumping rules, Bayesian Statistics 5, 599-608.
TARGET_ACCEPTANCE = 0.35


class FastWalk(RandomWalkMove):
    """Random walk in the coordinates with some indices, whose covariance is conditional on the others.

    ValueError for no index or an invalid one.
    """

    def __init__(self, indices: Sequence[int]):
        super().__init__(adapt=True, target=TARGET_ACCEPTANCE)
        self.indices = _checked(indices)

    def calibrate(self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None) -> None:
        """Fit the walk to points (n, ndim) with normalised weights (n,)."""
        ndim = coords.shape[1]
        _checked(self.indices, ndim)
        slow = np.setdiff1d(np.arange(ndim), self.indices)
        super().calibrate(coords[:, np.concatenate([slow, self.indices])], weights, inside)
        # The last diagonal block of a lower-triangular root of the covariance is a root of the covariance of the last
        # coordinates, conditional on the others.
        self._root = self._root[len(slow) :, len(slow) :]

    def _draw(self, coords, random):
        proposed = coords.copy()
        proposed[:, self.indices], factors = super()._draw(coords[:, self.indices], random)
        return proposed, factors


class WithFastSweeps(Move):
    """A move, followed by random-walk steps (`sweeps`) of the whole ensemble in the fast parameters (`indices`).

    The reported acceptance is that of the move alone. The initial scale of the walk is 2.38 / sqrt(number of fast
    parameters) times a root of the conditional covariance; ``tune`` adapts it. ValueError for invalid indices, and for
    less than one sweep.
    """

    takes_mixture = True

    def __init__(self, move: Move, indices: Sequence[int], sweeps: int = 2):
        if sweeps < 1:
            raise ValueError(f"sweeps must be at least 1, got {sweeps}; to make no fast sweeps, use the move itself")
        self.move = move
        self.sweeps = sweeps
        self._walk = FastWalk(indices)
        self.indices = self._walk.indices  # in ascending order
        self._accepted = np.empty(0)

    @property
    def walk(self) -> FastWalk:
        """The random walk in the fast parameters."""
        return self._walk

    @property
    def fast_acceptance(self) -> float:
        """Mean acceptance of the fast sweeps after the latest move; NaN before the first move."""
        return float(np.mean(self._accepted)) if len(self._accepted) else float("nan")

    def calibrate(
        self, coords: np.ndarray, weights: np.ndarray, inside: Inside | None = None, mixture: Mixture | None = None
    ) -> None:
        """Fit the walk, and the wrapped move if it can be fitted, to points (n, ndim) with weights (n,).

        `mixture` as in `MixtureMove.calibrate`; other moves do not use it.
        """
        calibrate_move(self.move, coords, weights, inside, mixture)
        self._walk.calibrate(coords, weights, inside)

    def cover_basins(self, coords: np.ndarray, log_target: np.ndarray) -> None:
        """Pass points (n, ndim) and the log-target (n,) to the move if it is a mixture move."""
        if isinstance(self.move, MixtureMove):
            self.move.cover_basins(coords, log_target)

    def follow(self, ancestors: np.ndarray) -> None:
        """See `samplers.moves.population_moves.MixtureMove.follow`; without effect on other moves."""
        if isinstance(self.move, MixtureMove):
            self.move.follow(ancestors)

    def expect_independence(self) -> None:
        """See `samplers.moves.population_moves.MixtureMove.expect_independence`; without effect on other moves."""
        if isinstance(self.move, MixtureMove):
            self.move.expect_independence()

    def propose(self, model: Model, state: State) -> tuple[State, np.ndarray]:
        """Make the move, then the fast sweeps; the accepted proposals (nwalkers,) are those of the move."""
        state, accepted = self.move.propose(model, state)
        acceptances = []
        for _ in range(self.sweeps):
            state, accepted_fast = self._walk.propose(model, state)
            acceptances.append(np.mean(accepted_fast))
        self._accepted = np.array(acceptances)
        return state, accepted

    def tune(self, state: State, accepted: np.ndarray) -> None:
        """Tune the move, and the scale of the fast sweeps that followed it."""
        self.move.tune(state, accepted)
        self._walk.tune(state, self._accepted)


def with_fast_sweeps(moves: Sequence[Move], indices: Sequence[int], ndim: int, sweeps: int) -> list[Move]:
    """The moves, each followed by sweeps over the fast parameters with these indices, if there are any of both.

    The moves themselves if all `ndim` parameters are fast. ValueError for an invalid index.
    """
    if sweeps == 0 or len(indices) == 0:
        return list(moves)
    fast = _checked(indices, ndim)
    return list(moves) if len(fast) == ndim else [WithFastSweeps(move, fast, sweeps) for move in moves]


def _checked(indices: Sequence[int], ndim: int | None = None) -> tuple[int, ...]:
    """Return the distinct indices in ascending order, or raise ValueError."""
    try:
        fast = tuple(sorted({operator.index(index) for index in indices}))
    except TypeError:
        raise ValueError(f"fast_parameters must be indices of parameters (integers); got {indices!r}") from None
    if not fast or fast[0] < 0 or (ndim is not None and fast[-1] >= ndim):
        valid = "0, 1, ..." if ndim is None else f"0 to {ndim - 1}"
        raise ValueError(f"fast_parameters must be indices of parameters, from {valid}; got {tuple(indices)}")
    return fast
