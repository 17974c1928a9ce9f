"""How a sampler goes on from what is stored: interrupted calls are completed, and stored ones are repeated.

A script that is started again makes the same calls. One that is complete restores the run, and returns the state that
it returned, without any step. One that was interrupted goes on from the last stored step.
"""

import copy
import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from emcee import State

from ..tempering.budget import Budget
from ..tempering.diagnostics import warn
from ..tempering.mutation import MoveSchedule
from ..tempering.results import AnnealingResult
from ..tempering.verdict import Verdict
from .checkpoint import Checkpoint
from .emcee_internals import get_moves, get_previous_state
from .evaluation import Evaluator
from .journal import Step
from .script import Call

__all__ = ["Resumption"]

logger = logging.getLogger(__name__)


class Resumption:
    """Base class of `samplers.tempered.TemperedSampler`: what it does with stored calls."""

    backend: Any
    iteration: int
    random_state: tuple
    evaluations: int
    failure_count: int
    get_last_sample: Callable[[], State]
    _checkpoint: Checkpoint
    _evaluator: Evaluator
    _budget: Budget
    _result: AnnealingResult
    _verdict: Verdict | None
    _usual_moves: MoveSchedule | None
    _first_moves: Any
    _drawn: np.ndarray | None
    _header: Callable[[], dict]
    _anneal: Callable[..., State]
    _needs_annealing: Callable[[State], bool]
    # the state at beta = 1 that the annealing ended with
    _annealed_state: State | None = None
    # the last state of a run whose stored calls are being repeated
    _restored: State | None = None
    # coordinates that the last repeated call returned
    _returned: np.ndarray | None = None

    def _first_state(
        self, state: State, call: Call | None, is_open: bool, skip_check: bool, bar: dict
    ) -> tuple[State, bool]:
        """The state at beta = 1 from which a call goes on, and whether it is known to be one of this run.

        Parameters
        ----------
        state : State
            What the call was given.
        call : Call, optional
            The interrupted call that it completes.
        is_open : bool
            Whether the call was given no state.
        skip_check, bar
            As in `_anneal`.
        """
        if self._checkpoint.interrupted is not None:
            self._check_continues(state)
            self._restore(bar)
            is_open = True
        restored, self._restored = self._restored, None
        previous = get_previous_state(self)
        if restored is not None:
            known = (restored, *(() if previous is None else (previous,)))
            if is_open or call is not None or any(np.array_equal(state.coords, known.coords) for known in known):
                return restored, True
        if call is not None and call.last is not None:
            return _as_state(call.last), True
        return (self._anneal(state, skip_check, bar), True) if self._needs_annealing(state) else (state, False)

    def _check_continues(self, state: State) -> None:
        """Raise ValueError unless a state is one that the interrupted run can be continued from."""
        contents = self._checkpoint.interrupted
        known_states = contents.start, contents.last, contents.provisional, get_previous_state(self)
        if not any(np.array_equal(state.coords, known.coords) for known in known_states if known is not None):
            raise ValueError(
                f"{self.backend.filename} contains a run from other draws of the prior: pass None as initial_state to "
                "continue it, or use another file; backend.reset(nwalkers, ndim) discards it"
            )

    def _restore(self, bar: dict) -> None:
        """Restore the interrupted run: repeat the annealing without evaluations, and go to the last stored step.

        The run was killed, or ended by its limit of simulations, perhaps in this process.
        """
        contents = self._checkpoint.resume(self._header(), self._evaluator.log_base, self._evaluator.compute)
        start, last, ladder = contents.start, contents.last, self._checkpoint.stored_result().ladder
        logger.info(
            "Resuming %s at stage %d, beta %.3g: %d evaluations and %d steps kept",
            self._checkpoint.place or "the run",
            len(ladder),
            ladder[-1].beta if ladder else 0.0,
            contents.evaluations,
            self.iteration,
        )
        self.random_state = start.random_state
        if self.evaluations > 0:  # a run of this object: its moves have adapted
            _, probabilities = self._usual_moves or get_moves(self)
            self._usual_moves = MoveSchedule(copy.deepcopy(self._first_moves), probabilities)
        known = (batch.coords for batch in contents.evaluated)
        self._budget.restore(known, contents.of_earlier_guides, contents.of_guides)
        self._evaluator.count_again(contents.evaluated[: contents.before_start])
        self._drawn = start.coords  # tested when the run began
        self._annealed_state = state = self._anneal(State(start.coords, copy=True), True, bar)
        if last is not None and self._result.halt is None:
            state = _as_state(last)
            self.random_state = last.random_state
            self._evaluator.count_again(contents.evaluated[: contents.before_last])
        self._restored = state

    def _repeat(self, call: Call, bar: dict) -> Iterator[State]:
        """Yield the last state of a stored call that is complete, if it has steps; nothing is added to the chain."""
        failure_count, interrupted = self.failure_count, self._checkpoint.interrupted
        if interrupted is not None and call.annealing == interrupted.annealings:
            self._restore(bar)
            self._verdict = self._checkpoint.stored_verdict()
        state = self._annealed_state
        if call.last is not None:
            state = _as_state(call.last)
        elif call.steps > 0 or state is None:
            state = self.get_last_sample()
        self.random_state, self._annealed_state, self._returned = state.random_state, state, state.coords
        self._checkpoint.skip_call()
        logger.warning(
            "%s contains this call of %d steps already: nothing is added. To add steps, make another call"
            " after all that the file contains, or ask for another number of steps",
            self.backend.filename,
            call.steps,
        )
        self._warn_of_failures(failure_count)
        if call.made > 0:
            yield State(state, copy=True)

    def _compare_last_state(self) -> None:
        """Raise ValueError if a chain without a journal has other log-probabilities than those of the posterior."""
        last = self.get_last_sample()
        few = np.argsort(last.log_prob)[[0, len(last.log_prob) // 2, -1]]
        computed, stored = self.compute_log_prob(last.coords[few])[0], last.log_prob[few]
        if not np.allclose(computed, stored, rtol=1e-9, atol=1e-9):
            raise ValueError(
                f"{self.backend.filename} contains a run of another posterior: at three points of its last step the "
                f"log-probability is {stored}, and log_prob_fn gives {computed}. Its journal is lost. "
                "Use another file, or restore the journal from a copy"
            )
        self._checkpoint.has_compared()

    def _warn_of_failures(self, before: int) -> None:
        """Warn if there are more failures than before a call."""
        if self.failure_count > before:
            warn(
                f"{self.failure_count - before} evaluations failed and count as impossible "
                f"({self._evaluator.failures.most_common()}); see failures"
            )


def _as_state(step: Step) -> State:
    """A stored step as emcee's state."""
    return State(step.coords, log_prob=step.log_prob, blobs=step.blobs, random_state=step.random_state)
