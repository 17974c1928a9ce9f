"""What a journal holds, kept in memory: for a run whose limit of simulations may be raised in the same process."""

from collections.abc import Sequence

import numpy as np
from emcee import State
from emcee.backends import Backend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .emcee_internals import drop_last_step
from .journal import EvaluatedBatch, RunStart, Step
from .journal_contents import Contents
from .ladder_file import write_check, write_stage, write_verdict
from .script import Request, Script, digest

__all__ = ["MemoryRecord"]


class MemoryRecord:
    """Evaluations and state of a run whose chain is in memory.

    Parameters
    ----------
    backend : emcee.backends.Backend
        Backend of the chain.

    Attributes
    ----------
    contents : Contents, or None
        What can be continued; None unless the limit of simulations has ended the run.
    script : Script
        The calls of the run.
    annealings : int
        Number of annealings that have begun.
    """

    def __init__(self, backend: Backend):
        self._backend = backend
        self.contents: Contents | None = None
        self._evaluated: list[EvaluatedBatch] = []
        self._remembered: list[tuple[str, list[np.ndarray]]] = []
        self._last: Step | None = None
        self._header: dict = {}
        self._start: RunStart | None = None
        self._before_start, self._before_last, self._shows = 0, 0, False
        self.script, self.annealings = Script(), 0
        self._of_earlier_guides, self._of_guides = 0.0, 0.0

    @property
    def has_steps(self) -> bool:
        """Whether the last annealing was followed by stored steps."""
        return self._last is not None

    def begin(self, header: dict, start: RunStart) -> None:
        """Enter the start of the annealing."""
        self._header, self._start, self._last = header, start, None
        self._before_start = self._before_last = len(self._evaluated)
        self._of_earlier_guides = self._of_guides
        self.annealings += 1

    def continue_run(self, contents: Contents) -> Contents:
        """Add to what has been kept from now on."""
        self.contents = None
        return contents

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points."""
        self._evaluated.append(batch)

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores, and the number of simulations that guides have made by then."""
        self._remembered.append((key, list(arrays)))
        self._of_guides = max(self._of_guides, of_guides)

    def stage(self, index: int, stage: Stage, in_file: bool = True) -> None:
        """Store a stage at its place in the ladder, unless it is stored."""
        if in_file:
            write_stage(self._backend, index, stage)

    def check(self, check: EvidenceCheck) -> None:
        """Store the check of the evidence."""
        write_check(self._backend, check)

    def verdict(self, verdict: Verdict) -> None:
        """Store the verdict."""
        write_verdict(self._backend, verdict)

    def call(self, request: Request) -> None:
        """Enter a call."""
        self.script.begin(int(request.steps), digest(request.coords), self.annealings, request.options)

    def go_on(self) -> None:
        """Enter that the present call goes on, although others were made after it."""
        self.script.go_on(0)

    def stepped(self, state: State) -> None:
        """Enter a stored step of the chain."""
        state = State(state, copy=True)
        accepted = np.zeros(len(state.coords), dtype=bool)
        self._last = Step(state.coords, state.log_prob, accepted, state.blobs, state.random_state)
        self._before_last = len(self._evaluated)
        self.script.stepped(self._last)

    def done(self) -> None:
        """Enter that the call is complete."""
        self.script.complete()

    def flush(self) -> None:
        """Nothing is pending in memory."""

    def halt(self, shows: bool) -> None:
        """Enter that the limit of simulations ended the call, and whether the next step shows it."""
        self._shows = shows

    def prepare_to_continue(self) -> None:
        """Collect what has been kept, so that the run can be continued."""
        shown = None
        if self._start is None:
            return
        if self._shows:
            last = self._backend.get_last_sample()
            shown = Step(last.coords, last.log_prob, np.zeros(len(last.coords), dtype=bool), last.blobs, ())
        self.contents = Contents(
            self._header,
            self._start,
            list(self._evaluated),
            list(self._remembered),
            self._before_start,
            self._before_last,
            [],
            self._last,
            self.script,
            self.annealings,
            provisional=shown,
            of_earlier_guides=self._of_earlier_guides,
            of_guides=self._of_guides,
        )

    def forget_steps(self) -> None:
        """The chain was reset."""
        if self.contents is not None:
            self.contents = self.contents._replace(provisional=None)

    def back(self) -> None:
        """Remove the last step, which only showed the state, from the chain."""
        drop_last_step(self._backend)
