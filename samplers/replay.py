"""Repeating a run from its record: the files of a run, and whether they belong to the sampler.

The record of evaluations (`samplers.record`) and emcee's HDF5 file are kept on disk. If a sampler is made with the file
of a run, the annealing is repeated from the record without an evaluation, and the chain continues from its last stored
step, as in emcee. A damaged or missing chain is repeated as well.
"""

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
from .output import DAMAGED, is_whole, make_group, run_of_file
from .output_file import open_file, patient_open
from .record import EvaluatedBatch, Record, free_name
from .settings import Settings
from .tempering.guide import Guide, guide_fingerprint

__all__ = ["compare", "describe_run", "differences", "open_record", "points_to_compare"]

logger = logging.getLogger(__name__)

CLOSE = {"rtol": 1e-9, "atol": 1e-9}
# entries of a header in which runs may differ
NOT_COMPARED = ("run", "seed", "of_earlier_guides", "log_prior")


def open_record(backend: Backend | None, nwalkers: int, ndim: int, slow: Sequence[int]) -> Record:
    """The record of the run in a backend's file; the HDF5 file is made if it is missing or damaged.

    Without a file that can be written, the record is kept in memory. `slow` are indices of the parameters that a
    simulation depends on.
    """
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return Record(slow=slow)
    if patient_open(backend).is_behind:  # of a sampler whose last steps are in memory only
        open_file(backend, "r+").close()
        patient_open(backend).write_back(wait=True)
    path = Path(backend.filename).resolve()
    record = Record(path.with_name(f"{path.name}.{quote(backend.name, safe='')}.record"), slow)
    stored = run_of_file(backend)
    if record.start is None:
        if stored == DAMAGED:
            raise ValueError(f"{backend.filename} is damaged, and has no record {record.path}: move it away")
        if stored is None:
            make_group(backend, nwalkers, ndim, "")  # in one step, unlike emcee
        return record
    run, shape = record.start.header["run"], record.start.coords.shape
    if stored in (run, None, DAMAGED) and shape != (nwalkers, ndim):
        raise ValueError(
            f"{backend.filename} contains a run of {shape[0]} walkers in {shape[1]} dimensions; got "
            f"nwalkers={nwalkers}, ndim={ndim}. Use another file, or backend.reset(nwalkers, ndim)"
        )
    if stored == run and is_whole(backend, record):
        return record
    record.open()  # another process that writes to the files owns them, and is between two writes
    stored = run_of_file(backend)
    if stored == run and is_whole(backend, record):
        return record
    if stored in (run, None, DAMAGED):
        if stored is not None:
            aside = free_name(path, "damaged")
            shutil.copyfile(path, aside)
            logger.warning(
                "%s does not end with a step that this run has stored: it is damaged, its writer was killed, or "
                "another program has added steps. A copy of it is kept as %s",
                backend.filename,
                aside,
            )
        logger.warning("the chain of %s is made again from %s", backend.filename, record.path)
        make_group(backend, *record.start.coords.shape, run)
        return record
    aside = record.set_aside("before_reset")
    logger.warning(
        "%s was reset, or replaced by the chain of another run: a new record begins, the earlier one is kept as %s",
        backend.filename,
        aside,
    )
    return record


def describe_run(
    function: Callable,
    described: dict,
    settings: Settings,
    moves: Sequence[Move],
    probabilities: Sequence[float],
    guide: Guide | None,
) -> dict:
    """The start of a run as plain data, with the entries `described`.

    The function and the guide are identified by their attributes ``fingerprint``; a guide without one by its class, a
    function without one not at all.
    """
    plain = {name: _plain(value) for name, value in asdict(settings).items()}
    return {
        "log_prob_fn": getattr(function, "fingerprint", None),
        **described,
        **plain,
        "moves": [describe(move) for move in moves],
        "probabilities": [float(probability) for probability in probabilities],
        "guide": None if guide is None else guide_fingerprint(guide),
    }


def _plain(value: Any) -> Any:
    """A setting in a form that JSON accepts: a function by its name."""
    return f"{value.__module__}.{value.__qualname__}" if callable(value) else value


def differences(stored: dict, ours: dict) -> list[str]:
    """Differences between the headers of two runs, as text."""
    if stored["sampler"] != ours["sampler"]:  # most settings then differ as well
        return [f"it was written by {stored['sampler']}, and this is a {ours['sampler']}"]
    names = [name for name in ours if name not in NOT_COMPARED and stored.get(name) != ours[name]]
    return [f"{name} was {stored.get(name)}, is {ours[name]}" for name in names]


def points_to_compare(record: Record, last: State | None) -> EvaluatedBatch | None:
    """One or two points at which a log-density without a fingerprint is compared with a stored run; None without any.

    A chain without a record has the `last` stored step only.
    """
    if record.count > 0 or last is None:
        return record.best_and_first()
    few = np.argsort(last.log_prob)[[0, -1]]
    return EvaluatedBatch(last.coords[few], last.log_prob[few], None if last.blobs is None else last.blobs[few], {})


def compare(known: EvaluatedBatch, compute: Callable[[np.ndarray], EvaluatedBatch]) -> list[str]:
    """Difference between a log-density and its earlier values at known points, as text; empty if there is none."""
    found = compute(known.coords)
    if (known.blobs is None) != (found.blobs is None):
        return [
            "log_prob_fn returned blobs, and returns none" if found.blobs is None else "log_prob_fn returns blobs now"
        ]
    for row, (coords, before, after) in enumerate(zip(known.coords, known.log_prob, found.log_prob, strict=True)):
        if not np.isclose(before, after, **CLOSE, equal_nan=True):
            return [f"log_prob_fn was {before:.10g} at {coords}, is {after:.10g}"]
        if known.blobs is not None and not _same_blobs(known.blobs[row], found.blobs[row]):
            return [f"blobs of log_prob_fn were {known.blobs[row]} at {coords}, are {found.blobs[row]}"]
    return []


def _same_blobs(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the blobs of a point agree: numbers up to rounding, and everything else exactly."""
    before, after = np.asarray(before), np.asarray(after)
    if before.dtype.names is not None:
        same_names = before.dtype.names == after.dtype.names
        return same_names and all(_same_blobs(before[name], after[name]) for name in before.dtype.names)
    if before.shape != after.shape:
        return False
    if before.dtype.kind in "fc" and after.dtype.kind in "fc":
        return bool(np.allclose(before, after, **CLOSE, equal_nan=True))
    return bool(np.all(before == after))
