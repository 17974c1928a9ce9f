"""Whether a run may be continued: what it was begun with, as plain data, and how that differs from now."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from emcee.moves import Move

from ..moves.kernels import describe
from ..tempering.settings import Settings
from .journal import Contents, Evaluated

__all__ = ["differences", "header"]

CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def header(
    nwalkers: int,
    ndim: int,
    fingerprint: str | None,
    settings: Settings,
    moves: Sequence[Move],
    shares: Sequence[float],
) -> dict:
    """What a run is begun with, as JSON gives it back.

    Parameters
    ----------
    nwalkers, ndim : int
    fingerprint : str, or None — of the posterior, where it has one.
    settings : Settings
    moves, shares : the mutation kernels, and how often each is taken.
    """
    begun = {"nwalkers": nwalkers, "ndim": ndim, "log_prob_fn": fingerprint}
    begun |= {name: _plain(value) for name, value in asdict(settings).items()}
    begun |= {"moves": [describe(move) for move in moves], "shares": list(shares)}
    return json.loads(json.dumps(begun))


def _plain(value: Any) -> Any:
    """A setting as JSON takes it: a function by its name."""
    return f"{value.__module__}.{value.__qualname__}" if callable(value) else value


def differences(
    ours: dict,
    contents: Contents,
    log_prior: Callable[[np.ndarray], np.ndarray],
    ask: Callable[[np.ndarray], Evaluated],
) -> list[str]:
    """What keeps a run from being continued, in words; empty if it may be.

    Settings are compared, then the log-prior of the first draws, then, for a posterior without a fingerprint, the
    log-probability of one point, at one evaluation.

    Parameters
    ----------
    ours : dict — the `header` of the sampler that wants to go on.
    contents : Contents — of the journal.
    log_prior : function of points (n, ndim).
    ask : function of points (n, ndim) that evaluates them.
    """
    theirs, start = contents.header, contents.start
    told = [f"{name} was {theirs.get(name)}, is {value}" for name, value in ours.items() if theirs.get(name) != value]
    if told:
        return told
    if not np.allclose(log_prior(start.coords), start.log_prior, **CLOSE):
        return ["the log-prior of the first draws is another"]
    return [] if ours["log_prob_fn"] is not None else _compare_one_point(contents.evaluated, ask)


def _compare_one_point(evaluated: Sequence[Evaluated], ask: Callable[[np.ndarray], Evaluated]) -> list[str]:
    for batch in evaluated:
        row = int(np.argmax(np.where(np.isnan(batch.log_prob), -np.inf, batch.log_prob)))
        if np.isfinite(batch.log_prob[row]):
            before, again = batch.log_prob[row], ask(batch.coords[row : row + 1]).log_prob[0]
            if np.isclose(before, again, **CLOSE):
                return []
            return [f"log_prob_fn was {before:.10g} at {batch.coords[row]}, is {again:.10g}"]
    return []
