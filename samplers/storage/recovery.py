"""Recovery of a run from its journal and the file of its chain, whatever a killed process has left of them."""

import logging
from pathlib import Path

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
)
from .guarded_backend import GuardedBackend
from .journal import Journal
from .journal_contents import Contents, read_journal
from .script import Script

__all__ = ["RUN", "Recovery"]

logger = logging.getLogger(__name__)

RUN = "run"


class Recovery(GuardedBackend):
    """Base class of `samplers.storage.backends.JournaledBackend`: what it does with what it finds."""

    contents: Contents | None
    script: Script
    annealings: int
    known_verdict: object
    has_steps: bool
    lost_journal: bool
    journal_path: Path
    _journal: Journal | None
    _run: str
    _fresh: bool

    def _enter_adopted(self, contents: Contents) -> None:
        """Enter the steps that only the file of the chain has in the journal, with the calls that made them."""
        known, calls, missing = read_journal(self.journal_path).script.calls, contents.script.calls, contents.adopted
        if contents.provisional is not None:
            missing = missing[:-1]
        self._journal.halt(False)  # a step that the journal announced has not come
        if contents.wiped and not any(call.steps is None for call in calls[len(known) :]):
            self._journal.wipe(len(known))
        for index, call in enumerate(calls):
            new = index >= len(known) or known[index][:3] != call[:3]
            if call.steps is None:
                if new:
                    self._journal.wipe(index)
                continue
            if new:
                self._journal.call(index, call.steps, call.begin, call.options)
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
            with self._guarded():
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
