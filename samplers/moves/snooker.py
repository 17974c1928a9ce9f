"""The snooker move of differential evolution, in place of that of emcee.

A walker x moves along the line through x and another walker z, by a multiple of the difference of two more walkers
projected on this line. With the distance r of x from z and the unit vector e = (x - z) / r, the proposal is

    x' = x + gamma e (e . (z1 - z2)),

and the acceptance probability contains the factor (r' / r)^(ndim - 1) with the distance r' of x' from z, since the
density of the direction changes with the distance from z.

Two things differ from ``emcee.moves.DESnookerMove`` of emcee 3.1.6 and earlier. That move divides by the root of
r instead of r, and halves the exponent, so that its stationary distribution is not the target: for three
independent standard normal parameters, it gives a variance of 0.79 instead of 1. It also divides by zero where x and z
are copies of one point, as they often are after resampling. Here, such a proposal is rejected. This keeps detailed
balance, since a line through two different points leads to neither x = z nor x' = z with a positive probability.

References
----------
ter Braak, C. J. F. & Vrugt, J. A. (2008), Differential evolution Markov chain with snooker updater and fewer chains,
Statistics and Computing 18, doi:10.1007/s11222-008-9104-9
"""

from collections.abc import Sequence

import numpy as np
from emcee.moves import DESnookerMove, Move

__all__ = ["SnookerMove", "with_snooker_moves"]


class SnookerMove(DESnookerMove):
    """Snooker move that keeps its target distribution, also where walkers are copies of each other.

    Parameters are those of ``emcee.moves.DESnookerMove``.
    """

    def get_proposal(
        self, s: np.ndarray, c: Sequence[np.ndarray], random: np.random.RandomState
    ) -> tuple[np.ndarray, np.ndarray]:
        """Propose new points.

        Parameters
        ----------
        s : (n, ndim) float
            Walkers to move.
        c : sequence of (m, ndim) float
            Three groups of other walkers.
        random : RandomState
            Source of random numbers.

        Returns
        -------
        proposed : (n, ndim) float
            Proposed points; the walker itself where the proposal is not defined.
        factors : (n,) float
            Logarithm of the factor of the acceptance probability; -inf where the proposal is not defined.
        """
        proposed, factors = s.copy(), np.full(len(s), -np.inf)
        for i, x in enumerate(s):
            others = np.array([group[random.randint(len(group))] for group in c])
            random.shuffle(others)
            z, z1, z2 = others
            distance = np.linalg.norm(x - z)
            if distance == 0.0:
                continue
            unit = (x - z) / distance
            candidate = x + self.gammas * unit * np.dot(unit, z1 - z2)
            new_distance = np.linalg.norm(candidate - z)
            if new_distance > 0.0:
                proposed[i] = candidate
                factors[i] = (s.shape[1] - 1.0) * np.log(new_distance / distance)
        return proposed, factors


def with_snooker_moves(moves: Sequence[Move]) -> list[Move]:
    """The moves, with a `SnookerMove` of the same settings in place of each ``emcee.moves.DESnookerMove``."""
    return [_as_snooker(move) if type(move) is DESnookerMove else move for move in moves]


def _as_snooker(move: DESnookerMove) -> SnookerMove:
    own = SnookerMove(move.gammas)
    vars(own).update(vars(move))
    return own
