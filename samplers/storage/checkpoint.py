"""Checkpoint of a run: what is stored while it runs, and what an interrupted run has left.

A run is a deterministic function of its start and of what ``log_prob_fn`` returns. To resume it, the annealing is
repeated from the start in the journal, and every evaluation that the journal contains is looked up instead of computed.
The chain then continues from the last stored step.
"""

import itertools
import json
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from emcee import State
from emcee.backends import Backend, HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.results import AnnealingResult
from ..tempering.verdict import Verdict
from .backends import JournaledBackend
from .compatibility import differences
from .emcee_internals import trim_chain
from .journal import EvaluatedBatch, RunStart, Step
from .journal_contents import Contents
from .ladder_file import read_check, read_ladder, read_verdict, write_check, write_stage, write_verdict
from .memory_record import MemoryRecord
from .script import Call, Request

__all__ = ["Checkpoint", "Replay"]


class Replay:
    """Evaluations, stages and stored arrays of an interrupted annealing, found by their points, order and keys.

    Points must be equal to the last bit. Evaluations of earlier annealings in the file are not used, so that a run that
    is continued makes the same evaluations, and counts the same, as one that was not interrupted.

    Parameters
    ----------
    contents : Contents
        Contents of the journal.
    """

    def __init__(self, contents: Contents):
        self._batches = contents.evaluated[contents.before_start :]
        self._place = {
            row.tobytes(): (number, index)
            for number, batch in enumerate(self._batches)
            for index, row in enumerate(batch.coords)
        }
        self._remembered: dict[str, deque[list[np.ndarray]]] = {}
        for key, arrays in contents.remembered:
            self._remembered.setdefault(key, deque()).append(arrays)

    def recall(self, key: str) -> list[np.ndarray] | None:
        """The arrays stored under a key, those stored first coming first; None if there are no more."""
        stored = self._remembered.get(key)
        return stored.popleft() if stored else None

    def find(self, coords: np.ndarray) -> list[tuple[slice, EvaluatedBatch | None]]:
        """Consecutive parts of the points (n, ndim): those of one batch with its evaluations, or unknown ones."""
        found = [self._place.get(row.tobytes()) for row in np.ascontiguousarray(coords)]
        parts = []
        for number, group in itertools.groupby(range(len(found)), lambda i: None if found[i] is None else found[i][0]):
            places = list(group)
            rows = slice(places[0], places[-1] + 1)
            parts.append((rows, None if number is None else self._part(number, [found[i][1] for i in places])))
        return parts

    def _part(self, number: int, indices: list[int]) -> EvaluatedBatch:
        batch = self._batches[number]
        reasons = {row: batch.reasons[index] for row, index in enumerate(indices) if index in batch.reasons}
        blobs = None if batch.blobs is None else batch.blobs[indices]
        return EvaluatedBatch(batch.coords[indices], batch.log_prob[indices], blobs, reasons)


class Checkpoint:
    """Stores the ladder of a run in its backend, keeps its journal, and resumes an interrupted run.

    Without an HDF5 file that can be written there is no journal. A run with a limit of simulations then keeps in memory
    what a journal would contain. Otherwise the methods that concern the journal do nothing.

    Parameters
    ----------
    backend : emcee Backend or HDFBackend, optional
        Backend of the chain; in memory by default.
    limited : bool
        Whether the run has a limit of simulations.

    Attributes
    ----------
    backend : emcee Backend or JournaledBackend
        Backend to use in place of the given one.
    """

    def __init__(self, backend: Backend | HDFBackend | None, limited: bool = False):
        if type(backend) is HDFBackend and not backend.read_only:
            backend = JournaledBackend.of(backend)
        self.backend = Backend() if backend is None else backend
        self._journal: JournaledBackend | MemoryRecord | None = None
        if isinstance(self.backend, JournaledBackend):
            self._journal = self.backend
        elif limited and not isinstance(self.backend, HDFBackend):
            self._journal = MemoryRecord(self.backend)
        self._replayed: Replay | None = None
        self._forget_earlier()

    def _forget_earlier(self) -> None:
        """Look up no more stages of an interrupted run."""
        self._earlier_stages: deque[tuple[int, Stage]] = deque()
        self._stored_ladder: tuple[Stage, ...] = ()
        self._earlier_check: EvidenceCheck | None = None

    # ------------------------------------------------------------------ the ladder

    def stored_result(self) -> AnnealingResult:
        """Ladder and check in the backend."""
        return AnnealingResult(read_ladder(self.backend), read_check(self.backend))

    def stored_verdict(self) -> Verdict | None:
        """Verdict in the backend, if there is one."""
        return read_verdict(self.backend)

    def store_verdict(self, verdict: Verdict) -> None:
        """Store a verdict in the backend, unless it is stored."""
        known = self._journal.known_verdict if isinstance(self._journal, JournaledBackend) else self.stored_verdict()
        if json.dumps(verdict) == json.dumps(known):
            return
        if self._journal is None:
            write_verdict(self.backend, verdict)
        else:
            self._journal.verdict(verdict)

    def store_result(self, result: AnnealingResult, verdict: Verdict | None) -> None:
        """Store ladder, check and verdict in the backend, after it was reset."""
        if isinstance(self._journal, MemoryRecord):
            self._journal.forget_steps()
        if read_ladder(self.backend) == result.ladder:  # the reset repeats a stored one
            return
        if verdict is not None:
            write_verdict(self.backend, verdict)
        for index, stage in enumerate(result.ladder):
            write_stage(self.backend, index, stage)
        if result.check is not None:
            write_check(self.backend, result.check)

    def store_stage(self, index: int, stage: Stage) -> Stage:
        """Store a stage; returns it with its original wall time if it is a repeated stage of an interrupted run."""
        if self._earlier_stages:
            known, earlier = self._earlier_stages.popleft()
            if known == index and earlier == stage._replace(seconds=earlier.seconds):
                return earlier
            self._earlier_stages.clear()
        stored = self._stored_ladder[index : index + 1]
        is_stored = bool(stored) and stored[0] == stage._replace(seconds=stored[0].seconds)
        if is_stored:  # in the file only, whose journal has lost it
            stage = stored[0]
        else:
            self._stored_ladder = (*self._stored_ladder[:index], stage)
        if self._journal is not None:
            self._journal.stage(index, stage, in_file=not is_stored)
        elif not is_stored:
            write_stage(self.backend, index, stage)
        return stage

    def store_check(self, result: AnnealingResult) -> None:
        """Store the check of a finished annealing, if there is one and it is not stored."""
        if result.check is None or json.dumps(result.check) == json.dumps(self._earlier_check):
            return
        if self._journal is None:
            write_check(self.backend, result.check)
        else:
            self._journal.check(result.check)

    # ------------------------------------------------------------------ the journal

    @property
    def interrupted(self) -> Contents | None:
        """Journal of an interrupted run in the backend that has not been resumed yet."""
        return None if self._journal is None else self._journal.contents

    @property
    def wants_start(self) -> bool:
        """Whether the start of the annealing is to be entered with `begin`."""
        return self._journal is not None and self._replayed is None

    def begin(self, header: dict, start: RunStart) -> None:
        """Enter the start of the annealing."""
        self._forget_earlier()
        self._journal.begin(header, start)

    def resume(
        self,
        header: dict,
        log_prior: Callable[[np.ndarray], np.ndarray],
        compute: Callable[[np.ndarray], EvaluatedBatch],
    ) -> Contents:
        """Continue the interrupted run: its evaluations are found by `find` until the end of the call.

        Parameters
        ----------
        header : dict
            `samplers.storage.compatibility.header` of the sampler that continues the run.
        log_prior, compute : callable
            Functions of points (n, ndim): the log-prior, and an evaluation that is not stored.

        Returns
        -------
        Contents
            Of the journal.

        Raises
        ------
        ValueError
            If the run was made with other settings, another prior or another log-probability.
        """
        contents = self.interrupted
        in_memory = isinstance(self._journal, MemoryRecord)  # then nothing can differ
        if not in_memory and (differing := differences(header, contents, log_prior, compute)):
            raise ValueError(
                f"{self.backend.filename} contains another run, which cannot be continued here: {'; '.join(differing)}."
                " Use the settings and functions that it was started with, or another file"
            )
        contents = self._journal.continue_run(contents)
        if contents.provisional is not None:
            self._journal.back()
        self._replayed = Replay(contents)
        self._stored_ladder = read_ladder(self.backend)
        self._earlier_stages = deque(contents.stages)
        self._earlier_check = contents.check
        return contents

    # ------------------------------------------------------------------ the calls of the script

    def find_call(self, request: Request) -> Call | None:
        """The stored call that a new one repeats (`samplers.storage.script.Script.find`); None without a record."""
        if self._journal is None:
            return None
        return self._journal.script.find(request, self.interrupted is not None)

    @property
    def position(self) -> int:
        """Place of the present call in the script."""
        return 0 if self._journal is None else self._journal.script.position

    def go_to_call(self, position: int) -> None:
        """Go to a place in the script: after a call that is repeated or left, or back to one that was interrupted."""
        if self._journal is not None:
            self._journal.script.position = position

    def go_on_with_call(self) -> bool:
        """Enter that the present call, which is incomplete, goes on; returns whether others were made after it."""
        if self._journal is None:
            return False
        is_last = self._journal.script.is_last
        if not is_last or self._journal.script.was_halted:
            self._journal.go_on()
        return not is_last

    @property
    def lost_journal(self) -> bool:
        """Whether a chain is continued without its journal, and has not been compared with the posterior yet."""
        return isinstance(self._journal, JournaledBackend) and self._journal.lost_journal

    def has_compared(self) -> None:
        """Enter that such a chain has been compared with the posterior."""
        self._journal.lost_journal = False

    @property
    def has_steps(self) -> bool:
        """Whether the last annealing was followed by stored steps; without a record, whether the chain has any."""
        return self.backend.iteration > 0 if self._journal is None else self._journal.has_steps

    @property
    def place(self) -> str:
        """Where an interrupted run can be continued from; empty for a run in memory."""
        journal = self._journal
        if not isinstance(journal, JournaledBackend) or journal.annealings == 0:
            return ""
        return f"{journal.filename} and {journal.journal_path.name}"

    def find(self, coords: np.ndarray) -> list[tuple[slice, EvaluatedBatch | None]]:
        """Consecutive parts of the points (n, ndim), with their evaluations if the interrupted run has made them."""
        return [(slice(None), None)] if self._replayed is None else self._replayed.find(coords)

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points."""
        if self._journal is not None:
            self._journal.evaluated(batch)

    def remember(
        self, key: str, compute: Callable[[], Sequence[np.ndarray]], of_guides: Callable[[], float]
    ) -> list[np.ndarray]:
        """Arrays that ``compute()`` returns, or that it returned for this key in the interrupted run.

        New ones are stored with ``of_guides()``, the number of simulations that guides have made by themselves.
        """
        if self._replayed is not None and (arrays := self._replayed.recall(key)) is not None:
            return arrays
        arrays = [np.asarray(array) for array in compute()]
        if self._journal is not None:
            self._journal.remembered(key, arrays, of_guides())
        return arrays

    def begin_call(self, request: Request) -> None:
        """Enter a call."""
        if self._journal is not None:
            self._journal.call(request)

    def pass_call(self, request: Request, state: State) -> None:
        """Enter a complete call that stores no steps, with its last state; a record in memory has none of these."""
        if isinstance(self._journal, JournaledBackend):
            accepted = np.zeros(len(state.coords), dtype=bool)
            self._journal.passed(request, Step(state.coords, state.log_prob, accepted, state.blobs, state.random_state))

    def expect_limit(self, new: bool) -> None:
        """Prepare for a limit of simulations that is set after the sampler was made; `new`: nothing was evaluated."""
        if self._journal is not None or isinstance(self.backend, HDFBackend):
            return
        if not new:
            raise ValueError(
                "max_simulations was set after a run without it, of which too little was kept in memory to go on from "
                "a limit: pass max_simulations when the sampler is made, or use a file"
            )
        self._journal = MemoryRecord(self.backend)

    def stepped(self, state: State, stored: bool) -> None:
        """Enter a step of a run with a limit, `stored` in the chain or not; a journal has stored steps by itself."""
        if stored and isinstance(self._journal, MemoryRecord):
            self._journal.stepped(state)

    def halt(self, state: State, show: bool) -> None:
        """Enter that the limit of simulations ended a call.

        Parameters
        ----------
        state : State
            The last state.
        show : bool
            Whether to store the state as a step, which is replaced when the run goes on.
        """
        trim_chain(self.backend)
        if self._journal is not None:
            self._journal.halt(show)
        if show:
            self.backend.grow(1, state.blobs)
            self.backend.save_step(state, np.zeros(len(state.coords), dtype=bool))
        self.prepare_to_continue()

    def prepare_to_continue(self) -> None:
        """Let the next call of this object continue the run."""
        if self._journal is not None:
            self._journal.prepare_to_continue()

    def end_call(self, complete: bool) -> None:
        """Write pending steps, and enter whether the call was completed; evaluations are no longer looked up."""
        self._replayed = None
        self._forget_earlier()
        trim_chain(self.backend)
        if self._journal is not None:
            self._journal.flush()
            if complete:
                self._journal.done()
