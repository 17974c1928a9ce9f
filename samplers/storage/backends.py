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
from .chain_file import (
    DAMAGE,
    StoredRun,
    adopt,
    compare,
    create_group,
    is_unfinished,
    ladder_differs,
    read_run,
    rebuild,
    set_aside,
    write_marks,
)
from .emcee_internals import append_steps, drop_last_step
from .file_lock import FileLock
from .journal import EvaluatedBatch, Journal, RunStart, Step, lock_path
from .journal_contents import Contents, read_journal
from .ladder_file import write_check, write_stage, write_verdict
from .script import Script, digest

__all__ = ["JournaledBackend"]

logger = logging.getLogger(__name__)

RUN = "run"
SECONDS_BETWEEN_WRITES = 0.25
# How long to wait for a process that reads the file, which locks it
PATIENCE = 30.0

# the objects of this process that write to a journal
_writers: "weakref.WeakValueDictionary[Path, JournaledBackend]" = weakref.WeakValueDictionary()


class JournaledBackend(HDFBackend):
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

    def open(self, mode="r"):
        """emcee's: the open HDF5 file, after pending steps have been written."""
        self.flush()
        return self._open(mode)

    def _open(self, mode: str, patience: float = PATIENCE) -> h5py.File:
        """The open file; waits while another process has locked it by reading."""
        end = time.monotonic() + patience
        while True:
            try:
                return super().open(mode)
            except BlockingIOError:
                if time.monotonic() > end:
                    raise
                time.sleep(0.02)

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
        steps, self._pending = self._pending, []
        try:
            with self._open("a", patience) as file:
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

    def call(self, nsteps: int, coords: np.ndarray) -> None:
        """Enter a call in the journal: the steps that it asks for, and where it starts."""
        index = self.script.begin(int(nsteps), digest(coords), self.annealings)
        if self._journal is not None:
            self._journal.call(index, int(nsteps), digest(coords))

    def done(self) -> None:
        """Enter that the call is complete, or was ended by the user."""
        self.script.complete()
        if self._journal is not None:
            self._journal.done()
        self._mark()

    def halt(self, shows: bool) -> None:
        """Enter in the journal that the limit of simulations ended the call, and whether the next step shows it."""
        self._shows = shows
        if self._journal is not None:
            self._journal.halt(shows)

    def prepare_to_continue(self) -> None:
        """Read the journal, so that the run can be continued."""
        self.flush()
        if self._journal is not None:
            self.contents = read_journal(self.journal_path)

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

    def _enter_adopted(self, contents: Contents) -> None:
        """Enter the steps that only the file of the chain has in the journal, with the calls that made them."""
        known, calls, missing = read_journal(self.journal_path).script.calls, contents.script.calls, contents.adopted
        if contents.provisional is not None:
            missing = missing[:-1]
        self._journal.halt(False)  # a step that the journal announced has not come
        if contents.wiped and not any(call.steps is None for call in calls[len(known) :]):
            self._journal.wipe(len(known))
        for index, call in enumerate(calls):
            new = index >= len(known) or known[index][:2] != call[:2]
            if call.steps is None:
                if new:
                    self._journal.wipe(index)
                continue
            if new:
                self._journal.call(index, call.steps, call.begin)
            later = sum(other.made for other in calls[index + 1 :])
            here = max(len(missing) - later, 0)
            for step in missing[:here]:
                self._journal.step(step)
            missing = missing[here:]
            if call.complete and (new or not known[index].complete):
                self._journal.done()
        for step in missing:
            self._journal.step(step)
        if contents.provisional is not None:
            self._journal.halt(True)
            self._journal.step(contents.provisional)
        if contents.verdict is not None:
            self._journal.verdict(contents.verdict)

    # ------------------------------------------------------------------ recovery

    def _recover(self, torn: bool) -> None:
        """Read the journal and the file of the chain, and bring the file up to the journal.

        Parameters
        ----------
        torn : bool
            Whether a process died while it could write to the file. A part of it that cannot be seen may be damaged,
            so it is rebuilt in any case.
        """
        contents = read_journal(self.journal_path)
        try:
            stored = read_run(self)
        except BlockingIOError as error:  # locked, not damaged
            raise ValueError(
                f"another run is writing to {self.filename}, or another program has opened it: wait for it or stop it, "
                "or give this run another file"
            ) from error
        except DAMAGE as error:
            self._replace_damaged(contents, error)
            return
        if contents is not None and stored is None:
            logger.warning(
                "%s",
                f"{self.filename} is missing or has no group {self.name}: rebuilt from {self.journal_path}. To start a "
                "new run instead, remove both files",
            )
            self._take(contents, rewrite=True)
            return
        if stored is not None and stored.run is None and torn and contents is not None and not stored.fresh:
            self._replace_damaged(contents, ValueError("the name of the run is lost"))
            return
        if stored is None or stored.run is None:
            return
        self._run = stored.run
        if contents is None or contents.header[RUN] != stored.run:
            self._continue_without_journal(stored, contents)
            return
        relation, (stale, foreign) = compare(stored, contents), ladder_differs(stored, contents)
        if relation == "ahead":
            logger.warning(
                "%s",
                f"{self.journal_path} has {len(contents.steps)} steps and {self.filename} has "
                f"{len(stored.chain.coords)}, since the journal was truncated or the chain was continued without it: "
                "the steps of the chain are kept, and evaluations that the journal has lost are made again",
            )
            self._take(adopt(stored, contents), rewrite=False)
            return
        if relation == "differs" or foreign:
            aside = set_aside(self.filename, copy=True)
            what = "the chain" if relation == "differs" else "the ladder"
            logger.warning("%s in %s differs from its journal: kept as %s, and rebuilt", what, self.filename, aside)
        self._take(contents, rewrite=torn or relation != "equal" or stale)

    def _take(self, contents: Contents, rewrite: bool) -> None:
        """Prepare to continue the run of a journal."""
        self._run, self.contents, self.script = contents.header[RUN], contents, Script(contents.script.calls)
        self.annealings, self.known_verdict = contents.annealings, contents.verdict
        self.has_steps = contents.last is not None
        if rewrite:
            rebuild(self, contents, self._run)

    def _continue_without_journal(self, stored: StoredRun, contents: Contents | None) -> None:
        """Use the chain alone, where its journal is lost."""
        if not stored.intact:
            raise ValueError(
                f"{self.filename} is damaged (the chain does not agree with its checksum), and there is no journal of "
                f"this run at {self.journal_path} to rebuild it from: restore both from a copy, or give another file"
            )
        if not stored.has_results:
            logger.info("%s: the run was killed before its journal had a start", self.filename)
            return
        found = "is of another run" if contents is not None else "is missing or ends before the start of the run"
        n = len(stored.chain.coords)
        if n > 0:
            last = adopt(stored._replace(script=[]), _EMPTY).steps[-1]
            calls = stored.script
            if calls and calls[-1].steps is not None:
                calls = [*calls[:-1], calls[-1]._replace(last=last)]
            self.script, self.lost_journal = Script(calls), True
            logger.warning(
                "%s %s: the %d steps in %s are continued without it", self.journal_path, found, n, self.filename
            )
            return
        aside = set_aside(self.filename, copy=True)
        logger.warning(
            "%s",
            f"{self.journal_path} {found}, and {self.filename} has {len(stored.ladder)} stages and no steps: kept as "
            f"{aside}, and the run starts again",
        )
        create_group(self, *self.shape, self._run)
        self._fresh = True

    def _replace_damaged(self, contents: Contents | None, error: Exception) -> None:
        """Rebuild a file that cannot be read."""
        if contents is None and not is_unfinished(self.filename):
            raise ValueError(
                f"{self.filename} is damaged or not an HDF5 file ({error}), and there is no journal at "
                f"{self.journal_path}, or too little of one, to rebuild it from: restore it from a copy, or give "
                "another file"
            ) from error
        aside = set_aside(self.filename)
        if contents is None:
            logger.warning(
                "%s contains nothing, since a process died while it created the file: set aside as %s",
                self.filename,
                aside,
            )
            return
        logger.warning("%s is damaged: set aside as %s and rebuilt from its journal", self.filename, aside)
        self._take(contents, rewrite=True)


_EMPTY = Contents({}, None, [], [], 0, 0, [], None, Script())


def _signature(path: Path) -> tuple | None:
    """What changes when a file is written; None if there is none."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_size, status.st_mtime_ns, status.st_ino
