"""What a journal holds, kept in memory: for a run whose limit of simulations may be raised in the same process."""

from collections.abc import Sequence

import numpy as np
from emcee import State
from emcee.backends import Backend

from .emcee_internals import drop_last_step
from .journal import Contents, EvaluatedBatch, RunStart, Step

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
    """

    def __init__(self, backend: Backend):
        self._backend = backend
        self.contents: Contents | None = None
        self._evaluated: list[EvaluatedBatch] = []
        self._remembered: list[tuple[str, list[np.ndarray]]] = []
        self._last: Step | None = None
        self._header: dict = {}
        self._start: RunStart | None = None
        self._before_last, self._wanted, self._made, self._shows = 0, None, 0, False
        self._of_earlier_guides, self._of_guides = 0.0, 0.0

    def begin(self, header: dict, start: RunStart) -> None:
        """Enter the start of the annealing."""
        self._header, self._start, self._last, self._wanted = header, start, None, None
        self._of_earlier_guides = self._of_guides

    def continue_run(self, contents: Contents) -> None:
        """Add to what has been kept from now on."""
        self.contents = None

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points."""
        self._evaluated.append(batch)

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores, and the number of simulations that guides have made by then."""
        self._remembered.append((key, list(arrays)))
        self._of_guides = max(self._of_guides, of_guides)

    def call(self, nsteps: int) -> None:
        """Enter the number of steps that a call asks for."""
        self._wanted, self._made = nsteps, 0

    def stepped(self, state: State) -> None:
        """Enter a stored step of the chain."""
        state = State(state, copy=True)
        accepted = np.zeros(len(state.coords), dtype=bool)
        self._last = Step(state.coords, state.log_prob, accepted, state.blobs, state.random_state)
        self._before_last = len(self._evaluated)
        self._made += 1

    def done(self) -> None:
        """Enter that the call is complete, or was ended by the user."""
        self._wanted = None

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
            self._before_last,
            [],
            self._last,
            self._wanted,
            self._made,
            shown,
            self._of_earlier_guides,
            self._of_guides,
        )

    def forget_steps(self) -> None:
        """The chain was reset."""
        if self.contents is not None:
            self.contents = self.contents._replace(provisional=None)

    def back(self) -> None:
        """Remove the last step, which only showed the state, from the chain."""
        drop_last_step(self._backend)
