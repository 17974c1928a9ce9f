"""Whether an interrupted run may be continued: what it was started with, as plain data, and what differs now."""

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from emcee.moves import Move

from ..moves.kernels import describe
from ..tempering.guide import Guide, guide_fingerprint
from ..tempering.settings import Settings
from .journal import EvaluatedBatch, merge_batches
from .journal_contents import Contents

__all__ = ["SEED", "differences", "header", "warn_of_other_seed"]

logger = logging.getLogger(__name__)

# the seed in the header of a journal, which is not compared where a run is continued
SEED = "seed"
CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def header(
    nwalkers: int,
    ndim: int,
    log_prob_fn: Callable,
    coarse_log_prob_fn: Callable | None,
    settings: Settings,
    moves: Sequence[Move],
    probabilities: Sequence[float],
    guide: Guide | None = None,
) -> dict:
    """What a run is started with, in the form in which JSON returns it.

    Parameters
    ----------
    nwalkers, ndim : int
        Size of the ensemble.
    log_prob_fn, coarse_log_prob_fn : callable
        The densities; identified by their attribute ``fingerprint``, where they have one.
    settings : Settings
        Settings of the sampler.
    moves : sequence of Move
        The moves.
    probabilities : sequence of float
        Probability of each move to be chosen.
    guide : Guide, optional
        The guide; identified by its attribute ``fingerprint``, or else by its class.
    """
    described = {"nwalkers": nwalkers, "ndim": ndim, "log_prob_fn": _fingerprint(log_prob_fn)}
    described |= {name: _plain(value) for name, value in asdict(settings).items()}
    described |= {"moves": [describe(move) for move in moves], "probabilities": list(probabilities)}
    coarse = None
    if coarse_log_prob_fn is not None:
        coarse = _fingerprint(coarse_log_prob_fn) or "one without a fingerprint"
    described |= {"coarse_log_prob_fn": coarse, "guide": None if guide is None else guide_fingerprint(guide)}
    return json.loads(json.dumps(described))


def _fingerprint(function: Callable) -> str | None:
    """Identity of a user's function, if it states one."""
    return getattr(function, "fingerprint", None)


def _plain(value: Any) -> Any:
    """A setting in a form that JSON accepts: a function by its name."""
    return f"{value.__module__}.{value.__qualname__}" if callable(value) else value


def differences(
    ours: dict,
    contents: Contents,
    log_prior: Callable[[np.ndarray], np.ndarray],
    compute: Callable[[np.ndarray], EvaluatedBatch],
) -> list[str]:
    """What prevents a run from being continued, as text; empty if nothing does.

    Settings are compared, then the log-prior of the starting points, then, for a posterior without a fingerprint, the
    log-probabilities of the first points of the annealing, as many as there are walkers, and of the best point. Half of
    the space may have changed, so one point is not enough. This costs an evaluation per point, beyond any limit of
    simulations, which a fingerprint saves; the log says so.

    Parameters
    ----------
    ours : dict
        `header` of the sampler that is to continue the run.
    contents : Contents
        Contents of the journal.
    log_prior : callable
        Log-prior of points (n, ndim).
    compute : callable
        Evaluates points (n, ndim).
    """
    theirs, start = contents.header, contents.start
    found = [f"{name} was {theirs.get(name)}, is {value}" for name, value in ours.items() if theirs.get(name) != value]
    if found:
        return found
    if not np.allclose(log_prior(start.coords), start.log_prior, **CLOSE):
        return ["the log-prior of the starting points differs"]
    if ours["log_prob_fn"] is not None or not contents.evaluated[contents.before_start :]:
        return []
    before = merge_batches(contents.evaluated[contents.before_start :])
    rows = np.arange(min(ours["nwalkers"], len(before.coords)))
    best = int(np.argmax(np.where(np.isnan(before.log_prob), -np.inf, before.log_prob)))
    rows = rows if best in rows else np.append(rows, best)
    return _compare_points(before.coords[rows], before.log_prob[rows], compute)


def _compare_points(
    coords: np.ndarray, log_prob: np.ndarray, compute: Callable[[np.ndarray], EvaluatedBatch]
) -> list[str]:
    logger.warning(  # these are simulations that the user has not asked for
        "log_prob_fn has no fingerprint: it is evaluated again at %d points of the stored run, to compare. These "
        "evaluations are not part of max_simulations; an attribute fingerprint saves them",
        len(coords),
    )
    now = compute(coords).log_prob
    different = np.flatnonzero(~np.isclose(log_prob, now, **CLOSE, equal_nan=True))
    if len(different) == 0:
        return []
    row = different[0]
    return [
        f"log_prob_fn was {log_prob[row]:.10g} at {coords[row]}, is {now[row]:.10g} ({len(different)} of {len(coords)} "
        "points differ)"
    ]


def warn_of_other_seed(filename: str, contents: Contents, seed: list | None) -> None:
    """Warn in the log where a stored run has another seed than one that was given."""
    if seed is None or contents.header.get(SEED) == seed:
        return
    stored = contents.header.get(SEED)
    logger.warning(
        "%s contains a run %s: seed=%s has no effect. Use another file for an independent run",
        filename,
        "without a seed" if stored is None else f"with seed={_seed_text(stored)}",
        _seed_text(seed),
    )


def _seed_text(seed: list) -> str:
    return str(seed[0] if len(seed) == 1 else seed)
