"""A start near the posterior, from a climb on a cheaper model.

The proposals of a climb by recycling lead from the prior to the posterior of the cheaper (coarse) model. Each is a
mixture with a density, so all of them together are a distribution to draw from: half of it the last one, half spread
over the prior and every rung below. The fine model climbs from there instead of from the prior. Where the two
posteriors are alike that is hardly a climb; where they lie apart, some rung is wide enough to hold both. No coarse
likelihood enters a weight, so the answer is that of the fine model alone.

The best coarse models are not biased but know less: the first seconds of a record, say. A larger step or fewer strips
can move a sharp posterior by many of its standard deviations, and the way back costs more than they save.
"""

from collections.abc import Callable, Sequence

import numpy as np

from ..proposals.mixture import Mixture, log_density
from .adaptive_importance import Start
from .evidence_check import draw_inside

__all__ = ["draw_start"]

LAST_SHARE = 0.5


def draw_start(
    proposals: Sequence[tuple[int, Mixture]],
    prior: np.ndarray,
    n: int,
    random: np.random.RandomState,
    inside: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, Start]:
    """Some n draws (n, ndim) of the proposals of a climb and of the prior, and their density.

    Parameters
    ----------
    proposals : of a climb, as `samplers.tempering.adaptive_importance.Recycled` has them.
    prior : (m, ndim) float — draws of the prior, of which the first few are taken.
    n : int
    random : RandomState
    inside : function of points (m, ndim) that tells which lie in the support of the prior.
    """
    *rungs, (_, last) = proposals
    few = max(1, int(round((1.0 - LAST_SHARE) * n / (len(rungs) + 1))))
    coords = [prior[: 2 * few]]
    parts: list[tuple[int, Mixture]] = []
    for mixture, count in [(mixture, few) for _, mixture in rungs] + [(last, int(LAST_SHARE * n))]:
        drawn, made = draw_inside(mixture, count, random, inside)
        coords.append(drawn)
        parts.append((made, mixture))
    n_prior = len(coords[0])
    made = n_prior + sum(count for count, _ in parts)

    def log_start(points: np.ndarray, records: np.ndarray) -> np.ndarray:
        total = np.log(n_prior / made) + records["log_prior"]
        for count, mixture in parts:
            total = np.logaddexp(total, np.log(count / made) + log_density(mixture, points))
        return total

    return np.concatenate(coords), Start(made, log_start)
