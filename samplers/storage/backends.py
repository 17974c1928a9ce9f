"""Where a run is kept: the chain in emcee's backend, the ladder beside it, and for an HDF5 file a journal beside that.

In an HDF5 file the ladder is the dataset ``ladder`` in the group of the chain, one row a stage, appended as soon as the
stage is done, and the independent check of the evidence is its attribute ``evidence_check``. In memory both are
attributes of the backend.

An HDF5 file can be damaged by a process that dies while it writes. So the journal (see `samplers.storage.journal`) is written
first, and a chain that does not agree with it is made again from it. It lies beside the file, as
``<file>.<group>.journal``. The group names its run, so that a journal of another run is of no effect.
"""

import logging
import os
import secrets
import time
from pathlib import Path

import h5py
import numpy as np
from emcee.backends import Backend, HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.weights import Stage
from .journal import Contents, Evaluated, Journal, Start, Step, read_journal

__all__ = ["JournaledBackend", "read_check", "read_ladder", "write_check", "write_stage"]

logger = logging.getLogger(__name__)

DATASET = "ladder"
CHECK = "evidence_check"
RUN = "run"
SECONDS_BETWEEN_WRITES = 0.25
STAGE_DTYPE = np.dtype(
    [(name, np.int64 if kind is int else np.float64) for name, kind in Stage.__annotations__.items()]
)


class JournaledBackend(HDFBackend):
    """emcee's HDF5 backend, with a journal beside it.

    Steps go to the journal at once and to the HDF5 file a few times a second, and before anything is read through this
    object. `TemperedSampler` makes one of any emcee `HDFBackend` that it is given.

    Attributes
    ----------
    contents : Contents, or None — what the journal of a run that is to go on holds; used up by the sampler.
    """

    @classmethod
    def of(cls, backend: HDFBackend) -> "JournaledBackend":
        """Of emcee's backend; what a killed process left is mended.

        Raises
        ------
        ValueError
            If the file is damaged and cannot be made again, or the journal is damaged.
        """
        self = cls.__new__(cls)
        self.__dict__.update(backend.__dict__)
        self._pending: list[Step] = []
        self._written = 0.0
        self._journal: Journal | None = None
        self.contents = self._recover()
        return self

    def __getstate__(self):
        self.flush()
        return {**self.__dict__, "_journal": None}

    @property
    def journal_path(self) -> Path:
        """Where the journal is."""
        return Path(f"{self.filename}.{self.name.replace('/', '.')}.journal")

    # ------------------------------------------------------------------ the chain, as emcee writes it

    def open(self, mode="r"):
        """emcee's: the open HDF5 file; what was waiting is written first."""
        self.flush()
        return super().open(mode)

    def reset(self, nwalkers, ndim):
        """emcee's: clear the chain."""
        super().reset(nwalkers, ndim)
        if self._journal is not None:
            self._journal.wipe()
            self._mark()

    def save_step(self, state, accepted):
        """emcee's: store a step."""
        if self._journal is None:
            super().save_step(state, accepted)
            return
        step = Step(
            state.coords.copy(),
            state.log_prob.copy(),
            np.array(accepted, dtype=bool),
            None if state.blobs is None else state.blobs.copy(),
            state.random_state,
        )
        self._journal.step(step)
        self._pending.append(step)
        if time.perf_counter() - self._written > SECONDS_BETWEEN_WRITES:
            self.flush()

    def flush(self) -> None:
        """Write to the HDF5 file what waits for it."""
        if not self._pending:
            return
        steps, self._pending = self._pending, []
        try:
            with super().open("a") as file:
                group = file[self.name]
                start, stop = group.attrs["iteration"], group.attrs["iteration"] + len(steps)
                group["chain"][start:stop] = np.stack([step.coords for step in steps])
                group["log_prob"][start:stop] = np.stack([step.log_prob for step in steps])
                if steps[0].blobs is not None:
                    group["blobs"][start:stop] = np.stack([step.blobs for step in steps])
                group["accepted"][:] += np.sum([step.accepted for step in steps], axis=0)
                for i, value in enumerate(steps[-1].random_state):
                    group.attrs[f"random_state_{i}"] = value
                group.attrs["iteration"] = stop
        except BaseException:
            self._pending = steps + self._pending
            raise
        self._written = time.perf_counter()

    # ------------------------------------------------------------------ the journal

    def begin(self, header: dict, start: Start) -> None:
        """A climb begins: enter it in the journal, a new one if there is none and the chain is empty."""
        if self._journal is None:
            if self.iteration > 0:
                logger.info("%s holds a chain without a journal: the new run cannot be resumed", self.filename)
                return
            header = {**header, RUN: secrets.token_hex(8)}
            self._run = header[RUN]
            self._journal = Journal.create(self.journal_path, header)
            self._mark()
        self._journal.start(start)

    def go_on(self, contents: Contents) -> None:
        """Go on with the journal that was read; its contents are not kept."""
        self.contents = None
        self._run = contents.header[RUN]
        self._journal = Journal(self.journal_path, contents)

    def evaluated(self, batch: Evaluated) -> None:
        """A batch of points has been evaluated."""
        if self._journal is not None:
            self._journal.evaluated(batch)

    def call(self, nsteps: int) -> None:
        """So many steps are wanted."""
        if self._journal is not None:
            self._journal.call(nsteps)

    def done(self) -> None:
        """They have been made, or are not wanted any more."""
        if self._journal is not None:
            self._journal.done()

    def _mark(self) -> None:
        """Say in the group which run it holds."""
        with super().open("a") as file:
            file[self.name].attrs[RUN] = self._run

    def _recover(self) -> Contents | None:
        """The journal of the run in the file, whose chain is mended where the two differ."""
        if not os.path.exists(self.filename):
            return None
        try:
            with HDFBackend.open(self) as file:
                run = file[self.name].attrs.get(RUN) if self.name in file else None
                if run is None:
                    return None
                contents = read_journal(self.journal_path)
                if contents is None or contents.header[RUN] != run:
                    logger.info("%s: the journal of the run is not there", self.filename)
                    return None
                self._run = run
                if _agree(file[self.name], contents.steps):
                    return contents
        except (OSError, KeyError, RuntimeError) as error:
            contents = read_journal(self.journal_path)
            if contents is None:
                raise ValueError(
                    f"{self.filename} is damaged, or no HDF5 file ({error}), and there is no journal to make it again "
                    f"from at {self.journal_path}: restore it from a copy, or give another file"
                ) from error
            aside = f"{self.filename}.damaged"
            os.replace(self.filename, aside)
            logger.warning("%s is damaged: set aside as %s and made again from its journal", self.filename, aside)
        self._make_again(contents)
        return contents

    def _make_again(self, contents: Contents) -> None:
        self._run = contents.header[RUN]
        ladder = read_ladder(self) if self.initialized else ()
        HDFBackend.reset(self, contents.header["nwalkers"], contents.header["ndim"])
        self._mark()
        for index, stage in enumerate(ladder):
            write_stage(self, index, stage)
        if contents.steps:
            self.grow(len(contents.steps), contents.steps[0].blobs)
            self._pending = list(contents.steps)
            self.flush()


def _agree(group: h5py.Group, steps: list[Step]) -> bool:
    """Whether the chain in the file is the one of the journal."""
    if group.attrs["iteration"] != len(steps):
        return False
    if not steps:
        return True
    stored = group["chain"][: len(steps)], group["log_prob"][: len(steps)], group["accepted"][...]
    coords, log_prob = np.stack([step.coords for step in steps]), np.stack([step.log_prob for step in steps])
    expected = coords.astype(stored[0].dtype), log_prob.astype(stored[1].dtype), sum(step.accepted for step in steps)
    return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(stored, expected, strict=True))


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
