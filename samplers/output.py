"""Data stored with a chain: the run that it belongs to, the ladder, the check of the evidence, the verdict.

emcee's backend writes the chain. In an HDF5 file, the group of the chain has the attribute ``run``, the dataset
``tempering`` (JSON), and the group ``restart``: the population at beta = 1, or the state from which a reset chain
continues. The attribute ``checksum`` of all of this tells a chain that something else has changed. In memory, results
are attributes of the backend.
"""

import json
import logging
import os
import tempfile
import zlib
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import h5py
import numpy as np
from emcee import State
from emcee.backends import Backend, HDFBackend

from .emcee_internals import cut_chain, restore_counts, trim_chain, type_of_blobs
from .estimates.importance import EvidenceCheck
from .finding import Finding
from .judgement.verdict import Verdict
from .output_file import FileHeld, open_file, replace_group, whole_file
from .reports import AnnealingResult, Stage

__all__ = ["DAMAGED", "Output", "make_group", "run_of_file"]

logger = logging.getLogger(__name__)

DAMAGED = "damaged"
CHECKSUM = "checksum"
# attributes and datasets of every chain of emcee
OF_EVERY_CHAIN = {"version", "nwalkers", "ndim", "has_blobs", "iteration", "chain", "log_prob", "accepted"}


class Output:
    """Data stored with the chain of an initialised backend: `result` and `verdict` (empty, None: nothing).

    `first_step` steps were stored before the last annealing. `provisional`: the last step is the estimate of a run that
    the limit of simulations ended, and is replaced when the run continues.
    """

    def __init__(self, backend: Backend):
        self._backend, self._file = backend, whole_file(backend)
        self._counts = int(backend.iteration), np.array(backend.accepted)
        stored = _read(backend)
        self.result, self.verdict = _parsed(stored)
        self.first_step = stored.get("first_step", 0)
        # the process may have been killed after the provisional step was removed, and before its note was
        self.provisional = stored.get("provisional", False) and int(backend.iteration) > self.first_step

    def whole(self) -> AbstractContextManager:
        """Context in which a file is changed as a whole (`samplers.output_file`)."""
        if self._file is None:
            return nullcontext()
        self._file.seal = _seal
        return self._file

    def begin(self, run: str) -> None:
        """A new annealing begins, without results. OSError or ValueError if a file cannot be written."""
        self.result, self.verdict, self.first_step = AnnealingResult(), None, int(self._backend.iteration)
        self._write(run, keep=False)
        if self._file is not None:
            self._file.save()

    def step_stored(self) -> None:
        """A step has been stored completely."""
        self._counts = int(self._backend.iteration), np.array(self._backend.accepted)
        if self._file is not None:
            self._file.save_now_and_then()

    def check_blobs(self, blobs: np.ndarray | None) -> None:
        """Raise ValueError if blobs (n, ...) that are stored next have another type than those of the chain."""
        stored = type_of_blobs(self._backend)
        if blobs is not None and stored not in (None, blobs.dtype):
            raise ValueError(
                f"the chain has blobs of type {stored}, and blobs_dtype is now {blobs.dtype}: use another backend; or "
                "delete the file of the chain, but not its record, from which the chain is made again"
            )

    def undo_half_a_step(self) -> None:
        """Remove a step that an error or Ctrl-C has left incomplete."""
        try:
            restore_counts(self._backend, *self._counts)
        except Exception as error:  # the error that has ended the step is raised
            logger.warning("the chain may end with half of a step (%s)", error)

    def write(self, result: AnnealingResult, verdict: Verdict | None) -> None:
        """Store a result."""
        self.result, self.verdict = result, verdict
        self._write()

    def keep_state(self, state: State | None) -> None:
        """Store the state from which a chain without steps continues, also in another process."""
        self._write(keep=False, state=state)

    def _write(self, run: str | None = None, keep: bool = True, state: State | None = None) -> None:
        """Write the results, the name of a `run`, and a state in place of the stored one, unless that is to `keep`."""
        result, backend = self.result, self._backend
        self._counts = int(backend.iteration), np.array(backend.accepted)
        contents = {
            "ladder": result.ladder,
            "check": result.check,
            "founders": None if result.founders is None else np.asarray(result.founders).tolist(),
            "verdict": self.verdict,
            "first_step": self.first_step,
            "provisional": self.provisional,
        }
        if not isinstance(backend, HDFBackend):
            backend.tempering = contents
            return
        data = np.frombuffer(json.dumps(contents).encode(), dtype=np.uint8)
        with self.whole(), backend.open("a") as file:
            group = file[backend.name]
            if run is not None:
                group.attrs["run"] = run
            if not keep:
                group.pop("restart", None)
            if state is not None and state.log_prob is not None:
                kept = group.create_group("restart")
                for name in ("coords", "log_prob", "blobs"):
                    if (values := getattr(state, name)) is not None:
                        kept.create_dataset(name, data=values)
                for i, value in enumerate(state.random_state or ()):
                    kept.attrs[f"random_state_{i}"] = value
            group.pop("tempering", None)
            group.create_dataset("tempering", data=data)

    # ------------------------------------------------------------------ the state that a chain goes on from

    def last_state(self) -> State | None:
        """The last stored state at beta = 1 of the last annealing; None without any."""
        backend = self._backend
        if backend.iteration > self.first_step:
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

    def mark_again(self, run: str) -> bool:
        """Mark a file whose chain emcee has reset as the file of a run; returns whether this was needed."""
        if self._file is None:
            return False
        with self._backend.open() as file:
            if "run" in file[self._backend.name].attrs:
                return False
        self._write(run)
        return True

    def clear_chain(self, state: State | None) -> None:
        """Remove all steps; the chain continues from `state`."""
        with self.whole():
            cut_chain(self._backend, 0)
            self.first_step, self.provisional = 0, False
            self.keep_state(state)

    def store_provisional_step(self, state: State) -> None:
        """Store the estimate of a run that the limit of simulations ended, as a step that is replaced later."""
        trim_chain(self._backend)
        self._backend.grow(1, state.blobs)
        self._backend.save_step(state, np.zeros(len(state.coords), dtype=bool))
        self.provisional = True
        self._write()

    def drop_provisional_step(self) -> None:
        """Remove the last step if it is provisional."""
        if self.provisional:
            cut_chain(self._backend, int(self._backend.iteration) - 1)
            self.provisional = False
            self._write()


def _read(backend: Backend) -> dict[str, Any]:
    if not isinstance(backend, HDFBackend):
        return getattr(backend, "tempering", {})
    with backend.open() as file:
        group = file[backend.name]
        return json.loads(group["tempering"][...].tobytes()) if "tempering" in group else {}


def _parsed(stored: dict[str, Any]) -> tuple[AnnealingResult, Verdict | None]:
    check, founders, verdict = (stored.get(name) for name in ("check", "founders", "verdict"))
    result = AnnealingResult(
        tuple(Stage(*values) for values in stored.get("ladder", ())),
        None if check is None else EvidenceCheck(*check),
        None if founders is None else np.array(founders),
    )
    if verdict is None:
        return result, None
    status, reasons, *others, findings = verdict
    return result, Verdict(status, tuple(reasons), *others, tuple(Finding(*each) for each in findings))


def _seal(group: h5py.Group) -> None:
    """Write the checksum of a chain that is complete."""
    group.attrs[CHECKSUM] = _checksum(group)


def _checksum(group: h5py.Group) -> int:
    """CRC-32 of all datasets and attributes of a chain, apart from this number."""
    found = 0

    def add(name: str, node: h5py.Group | h5py.Dataset) -> None:
        nonlocal found
        for key in sorted(node.attrs):
            if key != CHECKSUM:
                found = zlib.crc32(f"{name} {key}".encode() + np.asarray(node.attrs[key]).tobytes(), found)
        if isinstance(node, h5py.Dataset):
            found = zlib.crc32(name.encode() + node[...].tobytes(), found)

    add("", group)
    group.visititems(add)
    return found


def run_of_file(backend: HDFBackend) -> str | None:
    """The run that the file of a backend belongs to; the empty string for a chain without a run.

    It is "damaged" for a chain that cannot be read completely, or is not as it was stored. It is None if there is no
    file, the file is empty, or it has no chain with this name, or an incomplete one that never had a step.
    """
    if not os.path.exists(backend.filename) or os.path.getsize(backend.filename) == 0:
        return None
    try:
        with open_file(backend) as file:
            if backend.name not in file:
                return None
            group = file[backend.name]
            if not group.attrs.get("iteration", 0) and "run" not in group.attrs and "log_prob" not in group:
                return None  # emcee was killed while it made the group
            whole = OF_EVERY_CHAIN <= {*group.attrs, *group}
            if "run" in group.attrs or "tempering" in group:  # else a chain of emcee
                whole &= group.attrs.get(CHECKSUM) == _checksum(group)
            return group.attrs.get("run", "") if whole else DAMAGED
    except FileHeld:
        raise
    except Exception:  # HDF5 raises nearly anything
        return DAMAGED


def make_group(backend: HDFBackend, nwalkers: int, ndim: int, run: str, damaged: bool = False) -> None:
    """Make the file of a backend, with an empty chain, in one step; other groups of a readable file are kept."""
    with tempfile.TemporaryDirectory() as folder:
        options = {"compression": backend.compression, "compression_opts": backend.compression_opts}
        made = HDFBackend(
            f"{folder}/new.h5", backend.name, dtype=backend.dtype if backend.dtype_set else None, **options
        )
        made.reset(nwalkers, ndim)
        with made.open("a") as file:
            group = file[made.name]
            group.attrs["run"] = run
            _seal(group)
            replace_group(backend, file, damaged)
