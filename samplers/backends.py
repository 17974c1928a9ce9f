"""The ladder beside the chain: in the backend that holds the chain, whichever of emcee's it is.

In an HDF5 file the ladder is the dataset ``ladder`` in the group of the chain, one row a stage, appended as soon as the
stage is done, and the independent check of the evidence is its attribute ``evidence_check``; the file is closed in
between, so that a killed run leaves a readable file. In memory both are attributes of the backend.
"""

import numpy as np
from emcee.backends import Backend, HDFBackend

from .importance import EvidenceCheck
from .ladder import Stage

__all__ = ["read_check", "read_ladder", "write_check", "write_stage"]

DATASET = "ladder"
CHECK = "evidence_check"
STAGE_DTYPE = np.dtype(
    [(name, np.int64 if kind is int else np.float64) for name, kind in Stage.__annotations__.items()]
)


def write_stage(backend: Backend, index: int, stage: Stage) -> None:
    """Store a stage at its place in the ladder; what was there from `index` on is dropped,
    and the check of the evidence with it.

    Parameters
    ----------
    backend : an initialised emcee Backend or HDFBackend.
    index : int — place in the ladder, 0 for the first stage.
    stage : Stage
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
    """Stages stored in a backend; empty where there are none.

    Parameters
    ----------
    backend : emcee Backend or HDFBackend. HDF5 locks files: reading one while a run writes it can stop that run, as
        with emcee's chains; set HDF5_USE_FILE_LOCKING=FALSE in both to watch a run.
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
    """Store the check of the evidence beside a ladder that is there."""
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            file[backend.name][DATASET].attrs[CHECK] = np.array(check, dtype=float)
    else:
        setattr(backend, CHECK, check)


def read_check(backend: Backend) -> EvidenceCheck | None:
    """The stored check of the evidence; None where there is none."""
    if not isinstance(backend, HDFBackend):
        return getattr(backend, CHECK, None)
    if not backend.initialized:
        return None
    with backend.open() as file:
        group = file[backend.name]
        row = group[DATASET].attrs.get(CHECK) if DATASET in group else None
    return None if row is None else EvidenceCheck(*row[:4].tolist(), int(row[4]))
