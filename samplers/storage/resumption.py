"""How a sampler goes on from what is stored: interrupted calls are completed, and stored ones are repeated.

A script that is started again makes the same calls. One that is complete restores the run, and returns the state that
it returned, without any step. One that was interrupted goes on from the last stored step. A loop over ``sample`` gets
its stored states again, and sees the chain as it was with each of them, so that it decides as it did before.
"""

import contextlib
import copy
import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from emcee import State
from emcee.backends import HDFBackend

from ..tempering.budget import Budget
from ..tempering.diagnostics import warn
from ..tempering.mutation import MoveSchedule
from ..tempering.results import AnnealingResult
from ..tempering.verdict import Verdict
from .backends import JournaledBackend
from .checkpoint import Checkpoint
from .emcee_internals import get_moves, get_previous_state
from .evaluation import Evaluator
from .journal import Step
from .journal_contents import StoredStep
from .script import Call, Request

__all__ = ["PresentCall", "Resumption"]

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
    # the call that is being made, and whether the next one is made by `run_mcmc`
    _present: "PresentCall | None" = None
    _runs_to_end = False

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
        logger.warning(  # a user who waits sees that the time spent is not lost
            "Continuing %s: stage %d, beta %.3g, %d evaluations and %d steps are stored",
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

    def _repeat(self, present: "PresentCall", bar: dict) -> Iterator[State]:
        """Yield the states of a stored call that is complete, the last one only in `run_mcmc`; nothing is evaluated."""
        call, failure_count, interrupted = present.call, self.failure_count, self._checkpoint.interrupted
        if interrupted is not None and call.annealing == interrupted.annealings:
            self._restore(bar)
            self._verdict = self._checkpoint.stored_verdict()
        state = self._annealed_state
        if call.last is not None:
            state = _as_state(call.last)
        elif call.steps > 0 or state is None:
            state = self.get_last_sample()
        self._annealed_state = state
        logger.warning(
            "%s contains this call of %d steps already: nothing is added. To add steps, make another call"
            " after all that the file contains, or ask for another number of steps",
            self.backend.filename,
            call.steps,
        )
        self._warn_of_failures(failure_count)
        yielded = False
        for yielded_state in self._states(present):
            yielded = True
            yield yielded_state
        self.random_state, self._returned = state.random_state, state.coords
        if not yielded and (call.made > 0 or (call.steps > 0 and call.last is not None)):
            yield State(state, copy=True)

    def _repeat_steps(self, present: "PresentCall", state: State) -> Iterator[State]:
        """Yield the stored states of a call that is not complete, and prepare to go on with it.

        Parameters
        ----------
        present : PresentCall
            The call.
        state : State
            The state from which the run goes on.
        """
        self._restored = state  # for the next call, if the user leaves now
        yield from self._states(present)
        self.random_state, self._restored, present.repeats = state.random_state, None, False
        if self._checkpoint.go_on_with_call():
            logger.warning(
                "%s contains calls after a loop that was left after %d of %d steps, and it goes on now: its steps "
                "are added at the end of the chain",
                self.backend.filename,
                present.call.made,
                present.call.steps,
            )

    def _states(self, present: "PresentCall") -> Iterator[State]:
        """The stored states of a repeated call, for a loop; the chain is shown as it was with each of them."""
        if present.runs_to_end:
            return
        for stored in self.backend.stored_steps() if isinstance(self.backend, JournaledBackend) else ():
            state = _as_state(stored.step)
            self._returned = state.coords.copy()
            self._show(stored)
            yield state
            present.check_is_present()
            self._show(None)

    def _show(self, stored: StoredStep | None) -> None:
        """Show the chain as it was with a stored step; None: all of it."""
        if isinstance(self.backend, JournaledBackend):
            self.backend.show(*(None, None) if stored is None else stored[1:])

    # ------------------------------------------------------------------ beginning and end of a call

    def _begin_call(self, store: bool) -> "PresentCall":
        """The call that begins now; the sampler has one at a time."""
        self._present = PresentCall(self, store, self._runs_to_end)
        self._runs_to_end = False
        return self._present

    def _end_call(self, present: "PresentCall", error: BaseException | None = None) -> None:
        """End a call that was completed, left by the user (GeneratorExit) or interrupted; nothing for an earlier one.

        The next call takes the next place in the script, also after one that the user has left. After an error, the
        same call goes on.
        """
        if self._present is not present:
            return
        self._present, was_left = None, isinstance(error, GeneratorExit)
        self._show(None)
        try:
            if error is None or was_left:
                self._finish(present)
                if was_left and present.has_place:
                    self._checkpoint.go_to_call(present.position + 1)
                return
            with contextlib.suppress(OSError, RuntimeError):  # a disk may be full
                self._checkpoint.prepare_to_continue()
                self._finish(present)
            self._checkpoint.go_to_call(present.position)
        except BaseException:
            self._checkpoint.go_to_call(present.position)
            raise
        if isinstance(error, KeyboardInterrupt) and self._checkpoint.place:
            raise KeyboardInterrupt(self._describe_what_is_kept()) from None
        in_memory = not isinstance(self.backend, HDFBackend) and self._budget.limit is None
        if isinstance(error, KeyboardInterrupt) and in_memory and not self._result.finished:
            raise KeyboardInterrupt(
                "the annealing is not kept, and the next call begins a new one: to go on after an interrupt, give the "
                "sampler a file, backend=emcee.backends.HDFBackend(path)"
            ) from None

    def _finish(self, present: "PresentCall") -> None:
        if present.repeats:
            if present.call.complete:
                self._checkpoint.go_to_call(present.position + 1)
            return
        self._checkpoint.end_call(present.complete)
        self._warn_of_failures(present.failure_count)

    def _leave_open_loop(self) -> None:
        """End a loop that was left, and whose generator Python has not closed yet."""
        if self._present is not None:
            self._end_call(self._present, GeneratorExit())

    @contextlib.contextmanager
    def _interruptible(self) -> Iterator[None]:
        """`run_mcmc`: wherever an error or Ctrl-C comes, the same call goes on, and adds nothing that is stored."""
        position = self._checkpoint.position
        try:
            yield
        except BaseException as error:  # without an error, nothing follows in which Ctrl-C could come
            self._runs_to_end = False
            if self._present is not None:  # between two steps
                self._end_call(self._present, error)
            self._checkpoint.go_to_call(position)
            raise

    def _describe_what_is_kept(self) -> str:
        try:
            steps = f"{self.iteration} steps"
        except OSError:  # a disk that is full: the journal has them
            steps = "all steps"
        return (
            f"{self.evaluations} evaluations and {steps} are kept in {self._checkpoint.place}: run the same script "
            "again, or make the same call, to go on"
        )

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


class PresentCall:
    """The call of a sampler that is being made.

    Parameters
    ----------
    sampler : Resumption
        The sampler.
    store : bool
        Whether the call stores steps.
    runs_to_end : bool
        Whether it was made by `run_mcmc`, which never leaves it.

    Attributes
    ----------
    call : Call, or None
        The stored call that it repeats.
    position : int
        Its place in the script.
    repeats : bool
        Whether nothing new has been made by now.
    complete : bool
        Whether it has made and stored all of its steps.
    failure_count : int
        Number of failures before it.
    """

    def __init__(self, sampler: Resumption, store: bool, runs_to_end: bool):
        self._sampler, self._store, self.runs_to_end = sampler, store, runs_to_end
        self.call: Call | None = None
        self.position, self.failure_count = sampler._checkpoint.position, sampler.failure_count
        self.repeats = self.complete = False

    @property
    def has_place(self) -> bool:
        """Whether the script contains the call."""
        return self._store or self.call is not None

    def find(self, request: Request) -> None:
        """Look up the stored call that this one repeats; a loop that stores nothing is in no script."""
        if self._store or self.runs_to_end:
            self.call = self._sampler._checkpoint.find_call(request)
            self.position = self._sampler._checkpoint.position
            self.repeats = self.call is not None

    def check_is_present(self) -> None:
        """Raise RuntimeError if another call of the sampler has begun, or its chain was reset, since the last state."""
        if self._sampler._present is not self:
            raise RuntimeError(
                "this loop over sample() cannot go on, because another call of the sampler or reset() was made since: "
                "begin a new loop"
            )


def _as_state(step: Step) -> State:
    """A stored step as emcee's state."""
    return State(step.coords, log_prob=step.log_prob, blobs=step.blobs, random_state=step.random_state)
