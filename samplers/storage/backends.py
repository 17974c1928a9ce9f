"""Storage of a run: the chain in emcee's backend, the ladder with it, and a journal beside an HDF5 file.

In an HDF5 file the ladder is the dataset ``ladder`` in the group of the chain, one row per stage, appended when the
stage is finished. The independent check of the evidence is its attribute ``evidence_check``. In memory both are
attributes of the backend.

A process that dies while it writes can damage an HDF5 file. Therefore the journal (`samplers.storage.journal`) is
written first, and a chain that does not agree with it is rebuilt from it. The journal is ``<file>.<group>.journal``,
beside the file. The group names its run, so that the journal of another run has no effect.
"""

import itertools
import json
import logging
import os
import secrets
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from emcee.backends import Backend, HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .emcee_internals import append_steps, drop_last_step, holds_steps
from .journal import Contents, EvaluatedBatch, Journal, RunStart, Step, describe_damage, read_journal

__all__ = [
    "JournaledBackend",
    "read_check",
    "read_ladder",
    "read_verdict",
    "write_check",
    "write_stage",
    "write_verdict",
]

logger = logging.getLogger(__name__)

DATASET = "ladder"
CHECK = "evidence_check"
VERDICT = "verdict"
RUN = "run"
SECONDS_BETWEEN_WRITES = 0.25
# Superblock of HDF5, version 0 (file format specification, section II.A): signature, version, and the end of the file
SIGNATURE, END_OF_FILE, EMPTY_SIZE = b"\x89HDF\r\n\x1a\n\0", slice(40, 48), 2048
STAGE_DTYPE = np.dtype(
    [(name, np.int64 if kind is int else np.float64) for name, kind in Stage.__annotations__.items()]
)


class JournaledBackend(HDFBackend):
    """emcee's HDF5 backend, with a journal beside it.

    Steps are written to the journal at once, and to the HDF5 file a few times per second and before anything is read
    through this object. `TemperedSampler` makes one from any emcee `HDFBackend`.

    Attributes
    ----------
    contents : Contents, or None
        Journal of an interrupted run that can be continued; None after `continue_run`.
    """

    @classmethod
    def of(cls, backend: HDFBackend) -> "JournaledBackend":
        """From emcee's backend; a chain that a killed process left incomplete is repaired.

        Raises
        ------
        ValueError
            If the file is damaged and cannot be rebuilt, the journal is damaged, or another process is writing to the
            file.
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
        """Path of the journal."""
        return Path(f"{self.filename}.{self.name.replace('/', '.')}.journal")

    # ------------------------------------------------------------------ the chain, as emcee writes it

    def open(self, mode="r"):
        """emcee's: the open HDF5 file, after pending steps have been written."""
        self.flush()
        return super().open(mode)

    def reset(self, nwalkers, ndim):
        """emcee's: clear the chain."""
        super().reset(nwalkers, ndim)
        if self._journal is not None:
            self._journal.wipe()
            self._write_run()
            if self.contents is not None:
                self.contents = self.contents._replace(steps=[], provisional=None)

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
        """Write pending steps to the HDF5 file."""
        if not self._pending:
            return
        steps, self._pending = self._pending, []
        try:
            with super().open("a") as file:
                append_steps(file[self.name], steps)
        except BaseException:
            self._pending = steps + self._pending
            raise
        self._written = time.perf_counter()

    def close(self) -> None:
        """Write pending steps and close the journal, so that another process may continue the run."""
        self.flush()
        if self._journal is not None:
            self._journal.close()

    # ------------------------------------------------------------------ the journal

    def begin(self, header: dict, start: RunStart) -> None:
        """Enter the start of the annealing in the journal; a new one if there is none and the chain is empty."""
        if self._journal is None:
            if self.iteration > 0:
                logger.info("%s contains a chain without a journal: the new run cannot be resumed", self.filename)
                return
            header = {**header, RUN: secrets.token_hex(8)}
            self._run = header[RUN]
            self._journal = Journal.create(self.journal_path, header)
            self._write_run()
        self._journal.start(start)

    def continue_run(self, contents: Contents) -> None:
        """Append to the journal that was read from now on."""
        self.contents = None
        self._run = contents.header[RUN]
        if self._journal is None:
            self._journal = Journal(self.journal_path, contents)

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points in the journal."""
        if self._journal is not None:
            self._journal.evaluated(batch)

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores in the journal, with the number of simulations made by guides."""
        if self._journal is not None:
            self._journal.remembered(key, arrays, of_guides)

    def call(self, nsteps: int) -> None:
        """Enter the number of steps that a call asks for in the journal."""
        if self._journal is not None:
            self._journal.call(nsteps)

    def done(self) -> None:
        """Enter that the call is complete, or was ended by the user, in the journal."""
        if self._journal is not None:
            self._journal.done()

    def halt(self, shows: bool) -> None:
        """Enter in the journal that the limit of simulations ended the call, and whether the next step shows it."""
        if self._journal is not None:
            self._journal.halt(shows)

    def prepare_to_continue(self) -> None:
        """Read the journal, so that the run can be continued."""
        self.flush()
        if self._journal is not None:
            self.contents = read_journal(self.journal_path)

    def back(self) -> None:
        """Remove the last step, which only showed the state, from the chain."""
        if self._journal is not None:
            self._journal.back()
        drop_last_step(self)

    def _write_run(self) -> None:
        """Name the run in the group."""
        with super().open("a") as file:
            file[self.name].attrs[RUN] = self._run

    def _recover(self) -> Contents | None:
        """The journal of the run in the file; where the chain differs from it, the chain is rebuilt."""
        if not os.path.exists(self.filename):
            return None
        try:
            with HDFBackend.open(self) as file:
                run = file[self.name].attrs.get(RUN) if self.name in file else None
                if run is None:
                    return None
                contents = read_journal(self.journal_path)
                if contents is None and self.journal_path.exists() and _holds_results(file[self.name]):
                    raise ValueError(describe_damage(self.journal_path, "it ends before the start of the run"))
                if contents is None or contents.header[RUN] != run:
                    logger.info("%s: the journal of the run is missing or has no start", self.filename)
                    return None
                self._run = run
                if holds_steps(file[self.name], contents.steps):
                    return contents
        except BlockingIOError as error:  # locked, not damaged
            raise ValueError(
                f"another run is writing to {self.filename}: wait for it or stop it, or give this run another file"
            ) from error
        except (OSError, KeyError, RuntimeError) as error:
            contents = read_journal(self.journal_path)
            if contents is None and not _is_unfinished(self.filename):
                raise ValueError(
                    f"{self.filename} is damaged or not an HDF5 file ({error}), and there is no journal at "
                    f"{self.journal_path}, or too little of one, to rebuild it from: restore it from a copy, or give "
                    "another file"
                ) from error
            aside = _set_aside(self.filename)
            if contents is None:
                logger.warning(
                    "%s contains nothing, since a process died while it created the file: set aside as %s",
                    self.filename,
                    aside,
                )
                return None
            logger.warning("%s is damaged: set aside as %s and rebuilt from its journal", self.filename, aside)
        self._rebuild(contents)
        return contents

    def _rebuild(self, contents: Contents) -> None:
        self._run = contents.header[RUN]
        ladder = read_ladder(self) if self.initialized else ()
        HDFBackend.reset(self, contents.header["nwalkers"], contents.header["ndim"])
        self._write_run()
        for index, stage in enumerate(ladder):
            write_stage(self, index, stage)
        if contents.steps:
            self.grow(len(contents.steps), contents.steps[0].blobs)
            self._pending = list(contents.steps)
            self.flush()


def _holds_results(group: Any) -> bool:
    """Whether the HDF5 group of a run has stages or steps, which a run enters after its start is in the journal."""
    return int(group.attrs["iteration"]) > 0 or (DATASET in group and len(group[DATASET]) > 0)


def _is_unfinished(filename: str) -> bool:
    """Whether a process died while it created an HDF5 file: nothing is in it, or its header is still of an empty file.

    HDF5 writes the header of an empty file first, then the content, and the header with the end of the file last.
    """
    try:
        with open(filename, "rb") as file:
            header = file.read(END_OF_FILE.stop)
    except OSError:  # a folder, or a file that may not be read
        return False
    return not header or (
        header.startswith(SIGNATURE)
        and len(header) == END_OF_FILE.stop
        and int.from_bytes(header[END_OF_FILE], "little") <= EMPTY_SIZE
    )


def _set_aside(filename: str) -> str:
    """Rename a damaged file to a name that is not in use, and return the name."""
    names = itertools.chain([f"{filename}.damaged"], (f"{filename}.damaged-{i}" for i in itertools.count(2)))
    aside = next(name for name in names if not os.path.exists(name))
    os.replace(filename, aside)
    return aside


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
    if text is None:
        return None
    status, reasons, *numbers = json.loads(text)
    return Verdict(status, tuple(reasons), *numbers)
