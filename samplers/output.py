"""Data stored with a chain: the run that it belongs to, the ladder, the check of the evidence, the verdict.

emcee's backend writes the chain. In an HDF5 file, the group of the chain has the attribute ``run``, the dataset
``tempering`` (JSON), and the group ``restart``: the population at beta = 1, or the state from which a reset chain
continues.
"""

import json
import logging
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np

from .emcee_names import Backend, HDFBackend, State
from .estimates.importance import EvidenceCheck
from .finding import Finding
from .judgement.verdict import Verdict
from .output_file import whole_file
from .reports import AnnealingResult, Stage

__all__ = ["Output"]

logger = logging.getLogger(__name__)


class Output:
    """Data stored with the chain of an initialised backend: `result` and `verdict` (empty, None: nothing) of a `run`.

    `provisional`: the only step is the estimate of a run that the limit of simulations ended, and is replaced when the
    run continues.
    """

    def __init__(self, backend: Backend):
        self._backend, self._file = backend, whole_file(backend)
        self._counts = int(backend.iteration), np.array(backend.accepted)
        stored = _read(backend)
        self.run = stored.get("run", "")  # empty: a chain of emcee
        self.result, self.verdict = _parsed(stored)
        # the process may have been killed after the provisional step was removed, and before its note was
        self.provisional = stored.get("provisional", False) and backend.iteration > 0

    def whole(self) -> AbstractContextManager:
        """Context in which a file is changed as a whole (`samplers.output_file`)."""
        return nullcontext() if self._file is None else self._file

    def begin(self, run: str) -> None:
        """A new annealing begins, without results. OSError or ValueError if a file cannot be written."""
        self.run, self.result, self.verdict = run, AnnealingResult(), None
        self.write(None)
        if self._file is not None:
            self._file.save()

    def step_stored(self) -> None:
        """A step has been stored completely."""
        self._counts = int(self._backend.iteration), np.array(self._backend.accepted)
        if self._file is not None:
            self._file.save_now_and_then()

    def undo_half_a_step(self) -> None:
        """Remove a step that an error or Ctrl-C has left incomplete."""
        try:
            if self._backend.iteration != self._counts[0] or np.any(self._backend.accepted != self._counts[1]):
                _cut_chain(self._backend, *self._counts)
        except Exception as error:  # the error that has ended the step is raised
            logger.warning("the chain may end with half of a step (%s)", error)

    def trim(self) -> None:
        """Remove allocated steps."""
        _cut_chain(self._backend, int(self._backend.iteration), self._backend.accepted)

    def check_blobs(self, blobs: np.ndarray | None) -> None:
        """Raise ValueError if blobs (n, ...) that are stored next have another type than the blobs of the chain."""
        stored = _type_of_blobs(self._backend)
        if blobs is not None and stored not in (None, blobs.dtype):
            raise ValueError(
                f"the chain has blobs of type {stored}, and blobs_dtype is now {blobs.dtype}: use another backend; or "
                "delete the file of the chain, but not its record, from which the chain is made again"
            )

    def write(self, *state: State | None) -> None:
        """Store the results, and a `state` that a chain without steps goes on from, if it is another one."""
        result, backend = self.result, self._backend
        self._counts = int(backend.iteration), np.array(backend.accepted)
        if self._file is None:
            return
        contents = {
            "ladder": result.ladder,
            "check": result.check,
            "founders": None if result.founders is None else np.asarray(result.founders).tolist(),
            "parents": None if result.parents is None else np.asarray(result.parents).tolist(),
            "verdict": self.verdict,
            "provisional": self.provisional,
        }
        data = np.frombuffer(json.dumps(contents).encode(), dtype=np.uint8)
        with self.whole(), backend.open("a") as file:
            group = file[backend.name]
            group.attrs["run"] = self.run
            if state:
                group.pop("restart", None)
            for each in state:
                if each is not None and each.log_prob is not None:
                    kept = group.create_group("restart")
                    for name in ("coords", "log_prob", "blobs"):
                        if (values := getattr(each, name)) is not None:
                            kept.create_dataset(name, data=values)
                    for i, value in enumerate(each.random_state or ()):
                        kept.attrs[f"random_state_{i}"] = value
            group.pop("tempering", None)
            group.create_dataset("tempering", data=data)

    # ------------------------------------------------------------------ the state that a chain goes on from

    def last_state(self) -> State | None:
        """The last stored state at beta = 1 of the last annealing; None without any."""
        backend = self._backend
        if backend.iteration > 0:
            return backend.get_last_sample()
        if not isinstance(backend, HDFBackend):
            return None
        with backend.open() as file:
            group = file[backend.name].get("restart")
            if group is None:
                return None
            values = {name: dataset[...] for name, dataset in group.items()}
            random_state = tuple(value for _, value in sorted(group.attrs.items())) or backend.random_state
        return State(values.pop("coords"), **values, random_state=random_state)

    @property
    def was_reset(self) -> bool:
        """Whether the user has called the method ``reset`` of the backend."""
        gone = self._backend.iteration < self._counts[0]
        return gone or (self._file is not None and "run" not in _read(self._backend))

    def clear_chain(self, state: State | None) -> None:
        """Remove all steps; the chain continues from `state`."""
        with self.whole():
            _cut_chain(self._backend, 0, np.zeros_like(self._counts[1]))
            self.provisional = False
            self.write(state)

    def store_provisional_step(self, state: State) -> None:
        """Store the estimate of a run that the limit of simulations ended, as a step that is replaced later."""
        self.trim()
        self._backend.grow(1, state.blobs)
        self._backend.save_step(state, np.zeros(len(state.coords), dtype=bool))
        self.provisional = True
        self.write()

    def drop_provisional_step(self) -> None:
        """Remove the last step if it is provisional."""
        if self.provisional:
            _cut_chain(self._backend, 0, self._counts[1])
            self.provisional = False
            self.write()


def _read(backend: Backend) -> dict[str, Any]:
    if not isinstance(backend, HDFBackend):
        return {}
    with backend.open() as file:
        group = file[backend.name]
        stored = json.loads(group["tempering"][...].tobytes()) if "tempering" in group else {}
        return stored | ({"run": group.attrs["run"]} if "run" in group.attrs else {})


def _parsed(stored: dict[str, Any]) -> tuple[AnnealingResult, Verdict | None]:
    check, founders, parents, verdict = (stored.get(name) for name in ("check", "founders", "parents", "verdict"))
    result = AnnealingResult(
        tuple(Stage(*values) for values in stored.get("ladder", ())),
        None if check is None else EvidenceCheck(*check),
        None if founders is None else np.array(founders),
        None if parents is None else np.array(parents),
    )
    if verdict is None:
        return result, None
    status, reasons, *others, findings = verdict
    return result, Verdict(status, tuple(reasons), *others, tuple(Finding(*each) for each in findings))


def _cut_chain(backend: Backend, steps: int, accepted: np.ndarray) -> None:
    """Set a chain's number of steps and its counts of accepted proposals (nwalkers,).

    What an interrupted step or allocation has left, from which emcee's backends cannot grow, is removed.
    """
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            group = file[backend.name]
            group.attrs["iteration"] = steps
            group["accepted"][...] = accepted
            group.attrs["has_blobs"] &= steps > 0
            if not group.attrs["has_blobs"]:  # emcee sets it after it has made the dataset
                group.pop("blobs", None)
        return
    backend.iteration, backend.accepted = steps, np.array(accepted)
    backend.chain, backend.log_prob = backend.chain[:steps], backend.log_prob[:steps]
    backend.blobs = None if backend.blobs is None or steps == 0 else backend.blobs[:steps]


def _type_of_blobs(backend: Backend) -> np.dtype | None:
    """The type of the blobs of a chain; None without any."""
    if not isinstance(backend, HDFBackend):
        return None if backend.blobs is None else backend.blobs.dtype
    with backend.open() as file:
        group = file[backend.name]
        return group["blobs"].dtype.base if group.attrs["has_blobs"] else None
