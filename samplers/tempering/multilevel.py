"""Multilevel start: draws near the posterior, from recycling on a cheaper model.

The proposals of recycling lead from the prior to the posterior of the cheaper (coarse) model. Each is a mixture with a
known density, so together they form a distribution to draw from: half of the draws come from the last proposal, the
other half evenly from the prior and all earlier proposals. The fine model starts from these draws instead of from the
prior. If the two posteriors are similar, few stages remain; if they differ, some earlier proposal is wide enough to
cover both. No coarse likelihood enters a weight, so the result is that of the fine model alone.

The best coarse models are less informed, not biased: the first seconds of a record, for example. A larger time step or
fewer strips can shift a sharp posterior by many of its standard deviations, and the way back then costs more than the
coarse model saves.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..proposals.mixture import Mixture
from .archive import StartingDensity, starting_mixture
from .evidence_check import draw_inside

__all__ = ["check_coarse", "draw_start"]

LAST_SHARE = 0.5


def check_coarse(function: Any, recycle: bool, sampler: str) -> None:
    """Raise ValueError for a coarse model that cannot be called, or without recycling.

    Parameters
    ----------
    function : callable
        The coarse log-probability.
    recycle : bool
        Whether the sampler recycles.
    sampler : str
        The sampler and what to do, for the message.
    """
    if not callable(function):
        raise ValueError(f"coarse_log_prob_fn must be callable; got {function!r}")
    if not recycle:
        raise ValueError(f"coarse_log_prob_fn needs recycling, which is off for this {sampler}")


def draw_start(
    proposals: Sequence[tuple[int, Mixture]],
    prior: np.ndarray,
    n: int,
    random: np.random.RandomState,
    inside: Callable[[np.ndarray], np.ndarray],
) -> tuple[np.ndarray, StartingDensity]:
    """About n draws of the proposals of a recycling run and of the prior, and their density.

    Parameters
    ----------
    proposals : sequence of (int, Mixture)
        As in `samplers.tempering.adaptive_importance.Recycled`.
    prior : (m, ndim) float
        Draws of the prior, of which the first few are taken.
    n : int
        Number of draws wanted; rounded per proposal.
    random : RandomState
        Source of random numbers.
    inside : callable
        Function of points (m, ndim); whether each lies in the support of the prior.

    Returns
    -------
    coords : (about n, ndim) float
        The draws.
    start : StartingDensity
        Their density.
    """
    *earlier, (_, last) = proposals
    few = max(1, int(round((1.0 - LAST_SHARE) * n / (len(earlier) + 1))))
    coords = [prior[: 2 * few]]
    parts: list[tuple[int, Mixture]] = []
    for mixture, count in [(mixture, few) for _, mixture in earlier] + [(last, int(LAST_SHARE * n))]:
        drawn, made = draw_inside(mixture, count, random, inside)
        coords.append(drawn)
        parts.append((made, mixture))
    return np.concatenate(coords), starting_mixture(len(coords[0]), parts)
