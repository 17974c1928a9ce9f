"""emcee's HDF5 backend with a journal beside the file, so that a killed run can be continued.

The journal is ``<file>.<group>.journal``, beside the file. Everything is written to the journal first
(`samplers.storage.journal`), and the file follows from it (`samplers.storage.chain_file`). So whatever kills a process,
the file is brought up to the journal when a sampler is made with it. A file that has more steps than its journal is
never cut: they are entered in the journal when the run goes on. A file that differs from its journal in another way is
kept beside, with a warning, and rebuilt.
"""

import logging
import os
import secrets
import time
import weakref
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from emcee.backends import HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .chain_file import create_group, rebuild, write_marks
from .emcee_internals import append_steps, drop_last_step
from .file_lock import FileLock
from .guarded_backend import FAULTS, PATIENCE
from .journal import EvaluatedBatch, Journal, RunStart, Step, lock_path
from .journal_contents import Contents, StoredStep, read_call, read_journal
from .ladder_file import write_check, write_stage, write_verdict
from .recovery import RUN, Recovery
from .script import Request, Script, digest

__all__ = ["JournaledBackend"]

logger = logging.getLogger(__name__)

SECONDS_BETWEEN_WRITES = 0.25

# the objects of this process that write to a journal
_writers: "weakref.WeakValueDictionary[Path, JournaledBackend]" = weakref.WeakValueDictionary()


class JournaledBackend(Recovery):
    """emcee's HDF5 backend, with a journal beside it.

    Steps are written to the journal at once, and to the HDF5 file a few times per second and before anything is read
    through this object. `TemperedSampler` makes one from any emcee `HDFBackend`.

    Attributes
    ----------
    contents : Contents, or None
        Journal of a run that can be continued; None after `continue_run`.
    script : Script
        The calls of the run, and how far this object has repeated them.
    annealings : int
        Number of annealings that have begun.
    known_verdict : Verdict, or None
        The verdict that the journal contains.
    lost_journal : bool
        Whether the chain is continued without its journal, and has not been compared with the posterior yet.
    has_steps : bool
        Whether the last annealing was followed by stored steps.
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
        self._pending_start: int | None = None  # where a flush that was interrupted has begun to write them
        self._written = 0.0
        self._journal: Journal | None = None
        self._run, self._fresh, self._shows = "", False, False
        self.contents: Contents | None = None
        self.script, self.annealings = Script(), 0
        self._accepted: np.ndarray | None = None
        self.known_verdict: Verdict | None = None
        self.has_steps = False
        self.lost_journal = False
        path = self.journal_path
        if (writer := _writers.get(path.resolve())) is not None:
            writer.flush()
        if os.path.exists(self.filename) or path.exists():
            with FileLock(lock_path(path)) as lock:
                self._recover(lock.abandoned)
        self._seen = _signature(path)
        return self

    def __getstate__(self):
        self.flush()
        return {**self.__dict__, "_journal": None}

    @property
    def journal_path(self) -> Path:
        """Path of the journal."""
        return Path(f"{self.filename}.{self.name.replace('/', '.')}.journal")

    # ------------------------------------------------------------------ the chain, as emcee writes it

    def rebuild_file(self) -> None:
        """Rebuild the file from the journal, with the pending steps."""
        if self._journal is not None:
            with self._guarded():
                rebuild(self, read_journal(self.journal_path), self._run)
            self._pending, self._pending_start, self._accepted = [], None, None
        super().rebuild_file()

    def advice(self) -> str:
        """What is kept after an error of the file, and how to go on."""
        if not self.journal_path.exists():
            return super().advice()
        return (
            f"All evaluations and steps are kept in {self.journal_path.name}. Free some disk space, and make the same "
            "call or run the same script again: the file is rebuilt, and the run continues"
        )

    def reset(self, nwalkers, ndim):
        """emcee's: clear the chain."""
        if self.script.skips_reset():
            return
        self._pending, self._pending_start = [], None
        if self.contents is not None and self._journal is None:
            self._write_to(Journal(self.journal_path, self.contents.size, self.contents.whole))
        # the file first: a process that dies between the two has reset nothing
        self._accepted = None
        with FileLock(lock_path(self.journal_path)):
            self._run = secrets.token_hex(8) if self._journal is None else self._run
            with self._guarded():
                create_group(self, nwalkers, ndim, self._run)
        self._fresh = self._journal is None
        if self._journal is not None:
            self._journal.wipe(self.script.begin(None))
            self._mark()
            if self.contents is not None:
                self.contents = self.contents._replace(steps=[], provisional=None, adopted=(), wiped=False)

    def save_step(self, state, accepted):
        """emcee's: store a step."""
        step = Step(
            state.coords.copy(),
            state.log_prob.copy(),
            np.array(accepted, dtype=bool),
            None if state.blobs is None else state.blobs.copy(),
            state.random_state,
        )
        if self._journal is not None:
            self._journal.step(step)
        if not self._shows:
            self.script.stepped(step)
            self.has_steps = True
        self._shows = False
        self._pending.append(step)
        if self._journal is None:
            self.flush()
        elif time.perf_counter() - self._written > SECONDS_BETWEEN_WRITES:
            try:
                self.flush(patience=0.0)
            except BlockingIOError:  # another process reads the file: the journal has the step
                self._written = time.perf_counter()

    def flush(self, patience: float = PATIENCE) -> None:
        """Write pending steps to the HDF5 file.

        Parameters
        ----------
        patience : float
            How long to wait for a process that reads the file [s]. BlockingIOError after it.
        """
        if not self._pending:
            return
        if self._is_broken:
            self.rebuild_file()
            if not self._pending:
                return
        steps, self._pending = self._pending, []
        try:
            with self._writing(patience) as file:
                group = file[self.name]
                if self._accepted is None:
                    self._accepted = group["accepted"][...]
                if self._pending_start is None:
                    self._pending_start = int(group.attrs["iteration"])
                append_steps(group, steps, self._accepted, self._pending_start)
                self._write_marks(file)
        except BaseException:
            self._pending = steps + self._pending
            raise
        self._accepted, self._pending_start = self._accepted + sum(step.accepted for step in steps), None
        self._written = time.perf_counter()

    def close(self) -> None:
        """Write pending steps and close the journal, so that another process may continue the run."""
        self.flush()
        if self._journal is not None:
            self._journal.close()

    # ------------------------------------------------------------------ the journal

    def begin(self, header: dict, start: RunStart) -> None:
        """Enter the start of the annealing in the journal; a new one if there is none and the chain is empty."""
        self.annealings, self.known_verdict, self.has_steps = self.annealings + 1, None, False
        if self._journal is not None:
            self._journal.start(start)
            return
        if self.iteration > 0:
            logger.info("%s contains a chain without a journal: the new run cannot be resumed", self.filename)
            return
        path = self.journal_path
        with FileLock(lock_path(path)):
            if _signature(path) != self._seen:
                raise ValueError(f"another run has written to {path} since it was read: make a new sampler with it")
            if path.exists() and path.stat().st_size > 0:
                os.replace(path, f"{path}.old")
                logger.info("%s belongs to a discarded run: kept as %s.old", path, path.name)
            with self.open() as file:
                fresh = self._fresh and file[self.name].attrs.get(RUN) == self._run
            if not fresh:
                self._run = secrets.token_hex(8)
                with self._guarded():
                    create_group(self, *self.shape, self._run)
            self._write_to(Journal.create(path, {**header, RUN: self._run}, start))
        self._fresh, self.script = False, Script()

    def continue_run(self, contents: Contents) -> Contents:
        """Append to the journal that was read from now on; returns its contents."""
        self.contents = None
        if self._journal is None:
            self._write_to(Journal(self.journal_path, contents.size, contents.whole))
        if contents.adopted:
            self._enter_adopted(contents)
            contents = read_journal(self.journal_path)
            self.script.calls = contents.script.calls
            with self._guarded():
                rebuild(self, contents, self._run)
            self._accepted = None
        return contents

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points in the journal."""
        if self._journal is not None:
            self._journal.evaluated(batch)

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores in the journal, with the number of simulations made by guides."""
        if self._journal is not None:
            self._journal.remembered(key, arrays, of_guides)

    def stage(self, index: int, stage: Stage, in_file: bool = True) -> None:
        """Store a stage at its place in the ladder; with ``in_file=False``, in the journal only."""
        if self._journal is not None:
            self._journal.stage(index, stage)
        if in_file:
            write_stage(self, index, stage)

    def check(self, check: EvidenceCheck) -> None:
        """Store the check of the evidence."""
        if self._journal is not None:
            self._journal.check(check)
        write_check(self, check)

    def verdict(self, verdict: Verdict) -> None:
        """Store the verdict."""
        self.known_verdict = verdict
        if self._journal is not None:
            self._journal.verdict(verdict)
        write_verdict(self, verdict)

    def call(self, request: Request) -> None:
        """Enter a call in the journal."""
        steps, begin = int(request.steps), digest(request.coords)
        index = self.script.begin(steps, begin, self.annealings, request.options)
        if self._journal is not None:
            self._journal.call(index, steps, begin, request.options)

    def go_on(self) -> None:
        """Enter that the present call goes on, although others were made after it, or after a limit was raised."""
        again = self.script.count_again()
        self.script.go_on(again)
        if self._journal is not None:
            self._journal.more(self.script.position, again)

    def passed(self, request: Request, last: Step) -> None:
        """Enter a complete call that stores no steps."""
        if self._journal is None:
            return
        steps, begin = int(request.steps), digest(request.coords)
        index = self.script.begin(steps, begin, self.annealings, request.options)
        self._journal.passed(index, steps, begin, request.options, last)
        self.script.finish(last)
        self._mark()

    def done(self) -> None:
        """Enter that the call is complete."""
        if self._journal is not None:
            self._journal.done()
        self.script.complete()
        self._mark()

    def stored_steps(self) -> list[StoredStep]:
        """The stored steps of the present call, which is repeated; empty where they are not known."""
        found = read_call(self.journal_path, self.script.position) if self._journal is not None else []
        return found if len(found) == self.script.calls[self.script.position].made else []

    def halt(self, shows: bool) -> None:
        """Enter in the journal that the limit of simulations ended the call, and whether the next step shows it."""
        self._shows = shows
        self.script.halt()
        if self._journal is not None:
            self._journal.halt(shows)

    def prepare_to_continue(self) -> None:
        """Read the journal, so that the run can be continued.

        An error or Ctrl-C may have come between the journal and what follows from it: the journal is right.
        """
        if self._journal is None:
            self.flush()
            return
        self.contents = read_journal(self.journal_path)
        self.script.calls, self._shows = self.contents.script.calls, False
        self._is_broken = self._is_broken or self._file_is_behind()

    def _file_is_behind(self) -> bool:
        """Whether file and pending steps are not those of the journal."""
        try:
            with self._open() as file:
                written = int(file[self.name].attrs["iteration"])
        except FAULTS:
            return True
        start = written if self._pending_start is None else self._pending_start
        return start + len(self._pending) != len(self.contents.steps)

    def back(self) -> None:
        """Remove the last step, which only showed the state, from the chain."""
        # the file first: a process that dies between the two has removed nothing
        drop_last_step(self)
        if self._journal is not None:
            self._journal.back()
        self._mark()

    def _write_to(self, journal: Journal) -> None:
        self._journal = journal
        _writers[self.journal_path.resolve()] = self

    def _mark(self) -> None:
        with self.open("a") as file:
            self._write_marks(file)

    def _write_marks(self, file: h5py.File) -> None:
        write_marks(file[self.name], self._run, 0 if self._journal is None else self._journal.size, self.script)


def _signature(path: Path) -> tuple | None:
    """What changes when a file is written; None if there is none."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino
