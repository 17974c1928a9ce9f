"""The climb from draws of the prior to beta = 1: by recycling where that may be trusted, else by moves.

By moves it is Sequential Monte Carlo: choose the next beta, weigh, resample, move. By recycling it is importance
sampling along the ladder (see `samplers.tempering.adaptive_importance`), thinned to as many points as there are walkers, which then are
moved. Both end with an estimate of the evidence from draws that had no part in the climb. With a cheaper model to climb
on first, recycling sets out from where that led to instead of the prior (see `samplers.tempering.multilevel`).
"""

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from emcee.model import Model
from emcee.moves import Move

from ..proposals.mixture import fit_mixture, log_density
from ..proposals.support_bounds import find_support_bounds
from .adaptive_importance import Start, recycle
from .diagnostics import check_climb, check_ladder, warn
from .evidence_check import EvidenceCheck, draw_inside, evidence_from_weights
from .genealogy import follow
from .multilevel import draw_start
from .mutation import Moved, grow_chains, move_together, tempered_log_prob
from .settings import Settings
from .weights import (
    EvidenceError,
    Stage,
    coarse_weights,
    effective_sample_size,
    log_mean_weight,
    next_beta,
    normalised_weights,
)

__all__ = ["Climbed", "Tempering", "climb"]

logger = logging.getLogger(__name__)

FEWEST_TO_START = 250
START_PER_DIMENSION = 10


class Tempering(NamedTuple):
    """What a climb works with.

    Attributes
    ----------
    evaluate : function of points (n, ndim) that returns their records (log_prob, log_prior[, blobs]).
    evaluate_coarse : the same for a cheaper model to climb on first, or None.
    inside : function of points (n, ndim) that tells which lie in the support of the prior.
    random : RandomState
    moves, shares : the mutation kernels, and how often each is taken.
    settings : Settings
    map : how a move that evaluates by itself maps a function.
    ladder : list of Stage — filled by `enter`.
    enter : called with the fields of a finished stage, and `apart`: evaluations since the last one that are not its.
    show : called with beta, effective sample size and acceptance after each sweep.
    """

    evaluate: Callable[[np.ndarray], np.ndarray]
    evaluate_coarse: Callable[[np.ndarray], np.ndarray] | None
    inside: Callable[[np.ndarray], np.ndarray]
    random: np.random.RandomState
    moves: Sequence[Move]
    shares: Sequence[float]
    settings: Settings
    map: Callable
    ladder: list[Stage]
    enter: Callable[..., None]
    show: Callable[[float, float, float], None]


class Climbed(NamedTuple):
    """A population at beta = 1.

    Attributes
    ----------
    coords, records : (n, ndim) and (n,)
    generations : list of (n,) int — founders of each point (see `samplers.tempering.genealogy`).
    check : EvidenceCheck, or None if none is wanted.
    """

    coords: np.ndarray
    records: np.ndarray
    generations: list[np.ndarray]
    check: EvidenceCheck | None


def climb(coords: np.ndarray, records: np.ndarray | None, tempering: Tempering) -> Climbed:
    """Carry draws of the prior (n, ndim) and their records (n,), None if still to be made, to beta = 1."""
    if tempering.evaluate_coarse is not None:
        found = _from_coarse(coords, tempering.evaluate_coarse, tempering)
        if found is not None:
            return found
    records = tempering.evaluate(coords) if records is None else records
    found = _by_recycling(coords, records, tempering) if tempering.settings.recycle else None
    return _by_moves(coords, records, tempering) if found is None else found


def _by_moves(coords: np.ndarray, records: np.ndarray, tempering: Tempering) -> Climbed:
    """Sequential Monte Carlo."""
    settings, (n, ndim) = tempering.settings, coords.shape
    beta, target, generations = 0.0, float(n), []
    error = EvidenceError(n)
    tempering.ladder.clear()
    while beta < 1.0:
        log_likelihood = records["log_prob"] - records["log_prior"]
        target = settings.target(target, n)
        last_beta, beta = beta, next_beta(log_likelihood, beta, target)
        log_weights = (beta - last_beta) * log_likelihood
        weights = normalised_weights(log_weights)
        standard_error = error.weigh(weights)
        _calibrate(coords, coarse_weights(log_weights), tempering)

        ancestors = settings.resample(weights, tempering.random)
        error.resample(ancestors)
        generations = follow(generations, ancestors)
        coords, records = coords[ancestors], records[ancestors]
        distinct = len(np.unique(coords, axis=0))
        effective = effective_sample_size(log_weights)
        moved = _mutate(coords, records, ancestors, beta, effective, tempering)
        coords, records = moved.coords, moved.records
        tempering.enter(
            beta=beta,
            effective_sample_size=effective,
            acceptance=moved.acceptance,
            moves=moved.moves,
            distinct_ancestors=distinct,
            log_evidence_increment=log_mean_weight(log_weights),
            log_evidence_error=standard_error,
        )
        check_ladder(tempering.ladder, n, ndim)
    check_climb(tempering.ladder, n, ndim, moved.memory)
    check = None if settings.check_draws == 0 else _check_evidence(coords, tempering)
    return Climbed(coords, records, generations, check)


def _from_coarse(
    coords: np.ndarray, evaluate: Callable[[np.ndarray], np.ndarray], tempering: Tempering
) -> Climbed | None:
    """Climb on a cheaper model, then from there to the posterior; None where what is found may not be trusted."""
    n, random, inside = len(coords), tempering.random, tempering.inside

    def enter(beta, effective_sample_size, acceptance, **_):
        tempering.show(beta, effective_sample_size, acceptance)

    # a start needs no weights of its own, and the draws at beta = 1 decide what the end is worth: half the size will do
    few = min(n, max(FEWEST_TO_START, n // 2, START_PER_DIMENSION * (coords.shape[1] + 1)))
    coarse = recycle(coords[:few], evaluate(coords[:few]), evaluate, inside, random, enter, finish=False)
    if coarse.doubt:
        warn(f"the climb on the coarse model failed ({coarse.doubt}): climbing on the fine model alone")
        return None
    drawn, start = draw_start(coarse.proposals, coords, few, random, inside)
    found = _by_recycling(drawn, tempering.evaluate(drawn), tempering, start, n)
    spent = few + sum(made for made, _ in coarse.proposals)
    way = sum(stage.evaluations for stage in tempering.ladder[:-1])
    if found is None:
        warn(
            "the coarse posterior is too far from the fine one to lead to it: climbing on the fine model alone. Use a "
            "closer coarse model, or none"
        )
    elif way > spent:
        warn(
            f"the coarse posterior is far from the fine one: the way from it took {way} evaluations of the fine model, "
            f"more than the climb on the coarse one ({spent}). A closer coarse model may be worth its cost"
        )
    return found


def _by_recycling(
    coords: np.ndarray, records: np.ndarray, tempering: Tempering, start: Start | None = None, wanted: int | None = None
) -> Climbed | None:
    """Adaptive importance sampling over all points; None where its result may not be trusted."""
    n, random, ladder = len(coords) if wanted is None else wanted, tempering.random, tempering.ladder
    ladder.clear()

    def enter(log_evidence, acceptance, effective_sample_size, **fields):
        tempering.enter(
            effective_sample_size=effective_sample_size,
            acceptance=acceptance,
            moves=0,
            distinct_ancestors=int(effective_sample_size),
            log_evidence_increment=log_evidence - sum(stage.log_evidence_increment for stage in ladder),
            **fields,
        )
        tempering.show(fields["beta"], effective_sample_size, acceptance)

    found = recycle(coords, records, tempering.evaluate, tempering.inside, random, enter, start, wanted)
    if not found.trusted:
        logger.info("recycling is not trusted here, because %s: climbing by moves", found.doubt)
        return None
    weights = normalised_weights(found.log_weights)
    _calibrate(found.coords, coarse_weights(found.log_weights), tempering)
    # the weights of few thousand points, thinned to as many points as there are walkers
    ancestors = np.searchsorted(np.cumsum(weights), (np.arange(n) + random.uniform()) / n, side="right")
    ancestors = np.minimum(ancestors, len(weights) - 1)
    effective = effective_sample_size(found.log_weights)
    moved = _mutate(found.coords[ancestors], found.records[ancestors], ancestors, 1.0, effective, tempering)
    wanted = tempering.settings.check_draws != 0
    tempering.enter(
        apart=found.check.evaluations if wanted else 0,
        beta=1.0,
        effective_sample_size=effective,
        acceptance=moved.acceptance,
        moves=moved.moves,
        distinct_ancestors=len(np.unique(ancestors)),
        log_evidence_increment=found.log_evidence - sum(stage.log_evidence_increment for stage in ladder),
        log_evidence_error=found.log_evidence_error,
    )
    return Climbed(moved.coords, moved.records, [ancestors], found.check if wanted else None)


def _check_evidence(coords: np.ndarray, tempering: Tempering) -> EvidenceCheck:
    """The evidence from fresh draws of a mixture fitted to the final population."""
    inside, wanted = tempering.inside, tempering.settings.check_draws
    mixture = fit_mixture(coords, np.full(len(coords), 1.0 / len(coords)), bounds=find_support_bounds(inside, coords))
    drawn, made = draw_inside(mixture, len(coords) if wanted is None else wanted, tempering.random, inside)
    return evidence_from_weights(tempering.evaluate(drawn)["log_prob"] - log_density(mixture, drawn), made)


def _calibrate(coords: np.ndarray, weights: np.ndarray, tempering: Tempering) -> None:
    for move in tempering.moves:
        if hasattr(move, "calibrate"):
            move.calibrate(coords, weights, tempering.inside)


def _mutate(
    coords: np.ndarray,
    records: np.ndarray,
    ancestors: np.ndarray,
    beta: float,
    effective: float,
    tempering: Tempering,
) -> Moved:
    """Move resampled points at beta."""

    def compute(points):
        found = tempering.evaluate(points)
        return tempered_log_prob(found, beta), found

    common: dict[str, Any] = {
        "beta": beta,
        "model": Model(tempering.evaluate, compute, tempering.map, tempering.random),
        "pick": lambda: tempering.random.choice(tempering.moves, p=tempering.shares),
        "settings": tempering.settings,
        "show": lambda share: tempering.show(beta, effective, share),
    }
    if tempering.settings.chains == "leaders":
        return grow_chains(coords, records, ancestors, **common)
    return move_together(coords, records, **common)
