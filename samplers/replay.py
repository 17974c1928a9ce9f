"""Repeating a run from its record: the files of a run, and whether they belong to the sampler.

The record of evaluations (`samplers.record`) and emcee's HDF5 file are kept on disk. If a sampler is made with the file
of a run, the annealing is repeated from the record without an evaluation, and the chain continues from its last stored
step, as in emcee. A damaged or missing chain is repeated as well.
"""

import json
import logging
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from emcee import State
from emcee.backends import Backend, HDFBackend
from emcee.moves import Move

from .moves.population_moves import describe
from .output_file import DAMAGED, run_of_file, whole_file
from .record import EvaluatedBatch, Record, free_name
from .settings import Settings
from .tempering.guide import Guide, guide_fingerprint

__all__ = ["changes", "describe_run", "differences", "open_record"]

logger = logging.getLogger(__name__)

CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def open_record(backend: Backend | None, nwalkers: int, ndim: int, slow: Sequence[int]) -> Record:
    """The record of the run in a backend's file; the HDF5 file is made if it is missing or damaged.

    Without a file that can be written, the record is kept in memory. `slow` are indices of the parameters that a
    simulation depends on.
    """
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return Record(slow=slow)
    path = Path(backend.filename).resolve()
    record = Record(path.with_name(f"{path.name}.{quote(backend.name, safe='')}.record"), slow)
    stored = run_of_file(backend)
    if record.start is None:
        if stored == DAMAGED:
            raise ValueError(f"{backend.filename} is damaged, and has no record {record.path}: move it away")
        if stored is None:
            whole_file(backend).make(nwalkers, ndim, "")  # in one step, unlike emcee
        return record
    run, shape = record.start.header["run"], record.start.coords.shape
    if stored in (run, None, DAMAGED) and shape != (nwalkers, ndim):
        raise ValueError(
            f"{backend.filename} contains a run of {shape[0]} walkers in {shape[1]} dimensions; got "
            f"nwalkers={nwalkers}, ndim={ndim}. Use another file, or backend.reset(nwalkers, ndim)"
        )
    if stored == run:
        return record
    record.open()  # another process that writes to the files owns them, and is between two writes
    stored = run_of_file(backend)
    if stored == run:
        return record
    if stored in (None, DAMAGED):
        if stored is not None:
            aside = free_name(path, "damaged")
            shutil.copyfile(path, aside)
            said = "%s does not end with a step that this run has stored: it is damaged, or another program has added"
            logger.warning(f"{said} steps. A copy of it is kept as %s", backend.filename, aside)
        logger.warning("the chain of %s is made again from %s", backend.filename, record.path)
        whole_file(backend).make(*record.start.coords.shape, run, anew=stored == DAMAGED)
        return record
    aside = record.renew()
    logger.warning(
        "%s was reset, or replaced by the chain of another run: a new record begins, the earlier one is kept as %s",
        backend.filename,
        aside,
    )
    return record


def describe_run(
    sampler: str,
    target: Any,
    settings: Settings,
    moves: Sequence[Move],
    probabilities: Sequence[float],
    guide: Guide | None,
) -> dict:
    """The start of a run as plain data, in the form that JSON returns, with a `samplers.evaluation.user_target.Target`.

    The function and the guide are identified by their attributes ``fingerprint``; a guide without one by its class, a
    function without one not at all.
    """
    header = {
        "log_prob_fn": getattr(target.function, "fingerprint", None),
        "sampler": sampler,
        "log_likelihood_fn": "used" if target.is_likelihood else None,
        **asdict(settings),
        "moves": [describe(move) for move in moves],
        "probabilities": [float(probability) for probability in probabilities],
        "guide": None if guide is None else guide_fingerprint(guide),
    }
    return json.loads(json.dumps(header))


def differences(stored: dict, ours: dict) -> list[str]:
    """Differences between the headers of two runs, as text; entries that only the stored one has do not count."""
    if stored["sampler"] != ours["sampler"]:  # most settings then differ as well
        return [f"it was written by {stored['sampler']}, and this is a {ours['sampler']}"]
    found = [f"{name} was {stored.get(name)}, is {ours[name]}" for name in ours if stored.get(name) != ours[name]]
    if found and found[0].startswith("log_prob_fn was"):  # the first entry; a guide has the same fingerprint
        found[0] += ": its model, data, noise or prior differ, or another line of the module that has the model"
    return found


def changes(record: Record, last: State | None, compute: Callable[[np.ndarray], EvaluatedBatch]) -> list[str]:
    """How a log-density differs from its stored value at the best known point, as text; empty if it does not.

    The known points are those of the `record`, or of the `last` step of a chain without a record.
    """
    known = record.latest(max(record.count, 1))
    if known is None and last is not None:
        known = EvaluatedBatch(last.coords, last.log_prob, last.blobs, {})
    if known is None or not np.isfinite(known.log_prob).any():
        return []
    known = known.rows([int(np.argmax(np.where(np.isfinite(known.log_prob), known.log_prob, -np.inf)))])
    found, (coords,) = compute(known.coords), known.coords
    if not np.isclose(known.log_prob, found.log_prob, **CLOSE).all():
        return [f"log_prob_fn was {known.log_prob[0]:.10g} at {coords}, is {found.log_prob[0]:.10g}"]
    return []
