"""States of structures at the end of an excitation, kept so that predictions need not run the excitation again.

A prediction that starts from the state after an earlier excitation simulates that excitation, a pause and the new
record as one. A model with a method ``simulate_from(theta, state)`` can do so in two parts: up to the last sample
before the new record, and from there on. The state in between is kept in this process, and so is the state at the end.
A later prediction with the same theta begins at the latest state that belongs to the first part of its own excitation.
The responses have the bits of one simulation of the whole excitation.

A state is identified by the fingerprint of the model under the excitation up to that sample, and by theta. States are
not written to the cache on disk: they would be a thousand times larger than its rows, while each saves only one
simulation.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..simulation.faults import raise_if_it_ends_the_run, reason_of
from ..simulation.label import items_of, note_own_changes, steady_digest
from ..simulation.model import (
    Model,
    SimulationBatch,
    SimulationFailed,
    first_part,
    not_finite,
    real_response,
    simulate_batch,
)
from ..simulation.opened import Observed, unpack
from ..simulation.threads import run_on_threads
from ..simulation.user_code import LIBRARY

__all__ = ["KEPT_STATES", "StateMemory", "simulate_last_part"]


class _Start(NamedTuple):
    """State after the first `n_done` samples of a response; none at the beginning."""

    n_done: int
    state: np.ndarray | None


class StateMemory:
    """States by the fingerprint of the model and theta, within a limit of memory.

    At the limit, the states of the least recently used models are dropped. States of the model in use, and the states
    it started from, are never dropped: new states are then not kept.

    Parameters
    ----------
    limit_bytes : int or None
        Largest size of all states [bytes]. None: no limit.

    Attributes
    ----------
    n_bytes : int
        Size of all states [bytes].
    """

    def __init__(self, limit_bytes: int | None = 256 * 2**20) -> None:
        self.limit_bytes = limit_bytes
        self.n_bytes = 0
        self._of_model: OrderedDict[str, tuple[int, dict[bytes, np.ndarray]]] = OrderedDict()
        self._lock = threading.RLock()

    def __len__(self) -> int:
        return sum(len(states) for _, states in self._of_model.values())

    def get(self, fingerprint: str, theta: np.ndarray) -> np.ndarray | None:
        """The state of one model at one theta; None if it is not kept."""
        with self._lock:
            if fingerprint not in self._of_model:
                return None
            self._of_model.move_to_end(fingerprint)
            return self._of_model[fingerprint][1].get(theta.tobytes())

    def add(self, fingerprint: str, n_steps: int, theta: np.ndarray, state: np.ndarray, in_use: tuple = ()) -> None:
        """Keep a state after `n_steps` response samples; states of the models `in_use` are not dropped for it."""
        with self._lock:
            if self._make_room(state.nbytes, (fingerprint, *in_use)):
                states = self._of_model.setdefault(fingerprint, (n_steps, {}))[1]
                self.n_bytes += state.nbytes - states.get(theta.tobytes(), np.empty(0)).nbytes
                states[theta.tobytes()] = state

    def lengths(self) -> list[int]:
        """Numbers of samples after which there are states, the largest first."""
        with self._lock:
            return sorted({n_steps for n_steps, _ in self._of_model.values()}, reverse=True)

    def limit(self, limit_bytes: int | None) -> None:
        """Set the limit [bytes], and drop states beyond it."""
        with self._lock:
            self.limit_bytes = limit_bytes
            self._make_room(0, ())

    def clear(self) -> None:
        """Drop all states."""
        with self._lock:
            self._of_model.clear()
            self.n_bytes = 0

    def _make_room(self, n_bytes: int, in_use: tuple[str, ...]) -> bool:
        if self.limit_bytes is None:
            return True
        for fingerprint in [each for each in self._of_model if each not in in_use]:
            if self.n_bytes + n_bytes <= self.limit_bytes:
                break
            self.n_bytes -= sum(state.nbytes for state in self._of_model.pop(fingerprint)[1].values())
        return self.n_bytes + n_bytes <= self.limit_bytes


KEPT_STATES = StateMemory()
"""States of all models of this process."""


def simulate_last_part(
    model: Model, first: int, thetas: np.ndarray, pool: Any = None, memory: StateMemory = KEPT_STATES
) -> SimulationBatch:
    """Responses from sample `first` on; parts that earlier calls have simulated are not run again where possible.

    Parameters
    ----------
    model : Model
        Under the whole excitation. States are used if its class itself defines ``simulate_from``. An inherited method
        is not used, because the class may have changed what it computes. Other models run the whole excitation.
    first : int
        First sample of the response that is wanted, 1 or more.
    thetas : (n, n_parameters) float
        Parameter sets.
    pool : object with ``map(function, items)``, optional
        As for `simulate_batch`.
    memory : StateMemory

    Returns
    -------
    SimulationBatch
        Responses (n, n_channels, n_steps - first).
    """
    before = _model_before(model, first)
    if before is None:
        responses, reasons = simulate_batch(model, thetas, pool)
        return SimulationBatch(np.ascontiguousarray(responses[:, :, first:]), reasons)
    key, key_before = _identity(model), _identity(before)
    responses = np.full((len(thetas), len(model.channels), model.n_steps - first), np.nan)
    states = [memory.get(key_before, theta) for theta in thetas]
    reasons = [""] * len(thetas)
    new = [row for row, state in enumerate(states) if state is None]
    starts = _latest_states(before, thetas[new], memory)
    for row, (_, state, reason) in zip(new, _run(before, thetas[new], starts, pool, False), strict=True):
        states[row], reasons[row] = state, reason
        if not reason:
            memory.add(key_before, before.n_steps, thetas[row], state)
    rows = [row for row, reason in enumerate(reasons) if not reason]
    ends = _run(model, thetas[rows], [_Start(first, states[row]) for row in rows], pool, True)
    for row, (response, state, reason) in zip(rows, ends, strict=True):
        reasons[row] = reason
        if not reason:
            responses[row] = response
            memory.add(key, model.n_steps, thetas[row], state, in_use=(key_before,))
    return SimulationBatch(responses, reasons)


def _model_before(model: Model, first: int) -> Model | None:
    """The model under its excitation up to the sample before `first`; None if it cannot go on from a state there."""
    if "simulate_from" not in vars(type(model)) or first < 2:
        return None
    try:
        before = first_part(model, (first - 1) * model.dt)
    except ValueError:
        return None
    return before if before.n_steps == first else None


def _identity(model: Model) -> str:
    """Fingerprint of the model, with a digest of its code for a user's class."""
    cls = type(model)
    if cls.__module__.split(".")[0] == LIBRARY:
        return model.fingerprint
    return f"{model.fingerprint} {steady_digest({'class': cls})}"


def _latest_states(model: Model, thetas: np.ndarray, memory: StateMemory) -> list[_Start]:
    """For every theta, the latest kept state within the excitation."""
    starts = [_Start(0, None)] * len(thetas)
    for n_steps in memory.lengths() if len(thetas) else []:
        if 2 <= n_steps < model.n_steps and any(start.state is None for start in starts):
            shorter = _model_before(model, n_steps)
            if shorter is not None:
                for row, theta in enumerate(thetas):
                    kept = memory.get(_identity(shorter), theta) if starts[row].state is None else None
                    if kept is not None:
                        starts[row] = _Start(n_steps, kept)
    return starts


def _run(
    model: Model, thetas: np.ndarray, starts: list[_Start], pool: Any, responses: bool
) -> list[tuple[np.ndarray | None, np.ndarray | None, str]]:
    """For each simulation: response (if `responses` are wanted), state at the end, and reason if it failed."""
    items = [(theta.copy(), start) for theta, start in zip(thetas, starts, strict=True)]
    before = items_of({"class": type(model)})
    if pool is not None:
        sent = Observed(partial(_continue, responses, model))
        outcomes = [unpack(outcome, pool)[0] for outcome in pool.map(sent, items)] if items else []
    elif getattr(model, "runs_on_threads", False):
        outcomes = run_on_threads(partial(_continue, responses, model), items)
    else:
        outcomes = [_continue(responses, model, item) for item in items]
    note_own_changes(before, items_of({"class": type(model)}))
    return [(*(found or (None, None)), reason) for found, reason in outcomes]


def _continue(responses: bool, model: Model, item: tuple[np.ndarray, _Start]) -> tuple[tuple | None, str]:
    """Run one simulation from a state; returns response and state with an empty reason, or None and the reason."""
    theta, (n_done, state) = item
    try:
        # a model may write into its argument, and the kept state serves later predictions
        response, end = model.simulate_from(theta, None if state is None else np.array(state))
        expected = (len(model.channels), model.n_steps - n_done)
        if np.shape(response) != expected:
            part = "of the whole excitation" if state is None else f"after the first {n_done} samples"
            raise SimulationFailed(
                f"simulate_from of {type(model).__name__} returned a response of shape {np.shape(response)}, expected "
                f"(n_channels, n_steps) = {expected}, the response {part}"
            )
        if not isinstance(end, np.ndarray) or end.dtype.hasobject:
            found = "array of Python objects" if isinstance(end, np.ndarray) else type(end).__name__
            raise SimulationFailed(
                f"simulate_from of {type(model).__name__} returned a state of type {found}: expected an array of "
                "numbers (ndarray), of which copies can be kept; put all that the model needs to go on into one array"
            )
        response = real_response(response, model.channels, expected[1])
    except BaseException as error:  # a model may raise anything, SystemExit among it
        raise_if_it_ends_the_run(error)
        return None, reason_of(error)
    reason = not_finite(model, response)
    return (None, reason) if reason else ((response if responses else None, np.array(end)), "")
