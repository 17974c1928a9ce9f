"""Storage of the ladder, the check of the evidence and the verdict with a chain, in an emcee backend.

In an HDF5 file the ladder is the dataset ``ladder`` in the group of the chain, one row per stage. The check of the
evidence is an attribute of it, the verdict one of the group. In memory, all three are attributes of the backend.
"""

import json

import numpy as np
from emcee.backends import Backend, HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .journal_contents import as_verdict

__all__ = [
    "read_check",
    "read_ladder",
    "read_verdict",
    "write_check",
    "write_stage",
    "write_verdict",
]

DATASET = "ladder"
CHECK = "evidence_check"
VERDICT = "verdict"
STAGE_DTYPE = np.dtype(
    [(name, np.int64 if kind is int else np.float64) for name, kind in Stage.__annotations__.items()]
)


def write_stage(backend: Backend, index: int, stage: Stage) -> None:
    """Store a stage at its place in the ladder; later stages and the check of the evidence are dropped.

    Parameters
    ----------
    backend : emcee Backend or HDFBackend
        Initialised.
    index : int
        Place in the ladder, 0 for the first stage.
    stage : Stage
        The stage.
    """
    row = np.array(tuple(stage), dtype=STAGE_DTYPE)
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            group = file[backend.name]
            if DATASET not in group:
                group.create_dataset(DATASET, shape=(0,), maxshape=(None,), chunks=(64,), dtype=STAGE_DTYPE)
            group[DATASET].resize(index + 1, axis=0)
            group[DATASET].attrs.pop(CHECK, None)
            group[DATASET][index] = row
    else:
        stored = getattr(backend, DATASET, np.empty(0, dtype=STAGE_DTYPE))
        setattr(backend, DATASET, np.append(stored[:index], row))
        setattr(backend, CHECK, None)


def read_ladder(backend: Backend) -> tuple[Stage, ...]:
    """The ladder stored in a backend.

    Parameters
    ----------
    backend : emcee Backend or HDFBackend
        HDF5 locks files: reading a file while a run writes to it can stop that run, as with emcee's chains. To watch a
        run, set HDF5_USE_FILE_LOCKING=FALSE in both processes.

    Returns
    -------
    tuple of Stage
        The sequence of stages; empty if there are none.
    """
    if isinstance(backend, HDFBackend):
        if not backend.initialized:
            return ()
        with backend.open() as file:
            group = file[backend.name]
            rows = group[DATASET][...] if DATASET in group else np.empty(0, dtype=STAGE_DTYPE)
    else:
        rows = getattr(backend, DATASET, np.empty(0, dtype=STAGE_DTYPE))
    return tuple(Stage(*row.item()) for row in rows)


def write_check(backend: Backend, check: EvidenceCheck) -> None:
    """Store the check of the evidence with a stored ladder."""
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            file[backend.name][DATASET].attrs[CHECK] = np.array(check, dtype=float)
    else:
        setattr(backend, CHECK, check)


def read_check(backend: Backend) -> EvidenceCheck | None:
    """The stored check of the evidence; None if there is none."""
    if not isinstance(backend, HDFBackend):
        return getattr(backend, CHECK, None)
    if not backend.initialized:
        return None
    with backend.open() as file:
        group = file[backend.name]
        row = group[DATASET].attrs.get(CHECK) if DATASET in group else None
    return None if row is None else EvidenceCheck(*row[:4].tolist(), int(row[4]))


def write_verdict(backend: Backend, verdict: Verdict) -> None:
    """Store the verdict on a run with its chain."""
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            file[backend.name].attrs[VERDICT] = json.dumps(verdict)
    else:
        setattr(backend, VERDICT, verdict)


def read_verdict(backend: Backend) -> Verdict | None:
    """The stored verdict; None if there is none."""
    if not isinstance(backend, HDFBackend):
        return getattr(backend, VERDICT, None)
    if not backend.initialized:
        return None
    with backend.open() as file:
        text = file[backend.name].attrs.get(VERDICT)
    return None if text is None else as_verdict(json.loads(text))
