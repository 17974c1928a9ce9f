"""Data stored with a chain: the run that it belongs to, the ladder, the check of the evidence, the verdict.

emcee's backend writes the chain. In an HDF5 file, the group of the chain has the attribute ``run``, the dataset
``tempering`` (JSON), and the group ``restart``, the state from which a reset chain continues. In memory, these are
attributes of the backend.
"""

import contextlib
import json
import logging
import os
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from emcee import State
from emcee.backends import Backend, HDFBackend

from .blobs import converted
from .emcee_internals import change_blobs, cut_chain, restore_counts, trim_chain
from .estimates.importance import EvidenceCheck
from .finding import Finding
from .judgement.verdict import Verdict
from .output_file import FileHeld, open_file, patient_open, read_object, replace_file
from .record import Record
from .reports import AnnealingResult, Stage, warn

__all__ = ["DAMAGED", "Output", "is_whole", "make_group", "run_of_file"]

logger = logging.getLogger(__name__)

DAMAGED = "damaged"
STORED = "stored step"  # key of the checksums of completely stored steps
STEPS_AT_ONCE = 200  # steps that are read at once for their checksum


class Output:
    """Data stored with the chain of an initialised backend; a checksum of each stored step is noted in the record.

    `result` and `verdict` are what is stored (empty, None: nothing). `first_step` steps were stored before the last
    annealing. `provisional` says whether the last step is the estimate of a run that the limit of simulations ended,
    and is replaced when the run continues.
    """

    def __init__(self, backend: Backend, record: Record):
        self._backend, self._record, self._file = backend, record, patient_open(backend)
        self._counts = int(backend.iteration), np.array(backend.accepted)
        self._summed = 0, 0  # steps, and their checksum
        self._is_unnoted = False  # whether the last step was in memory only
        stored = _read(backend)
        self.result, self.verdict = _parsed(stored)
        self.first_step = stored.get("first_step", 0)
        # the process may have been killed after the provisional step was removed, and before its note was
        self.provisional = stored.get("provisional", False) and int(backend.iteration) > self.first_step

    def begin(self, run: str) -> None:
        """A new annealing begins, without results."""
        self.result, self.verdict, self.first_step = AnnealingResult(), None, int(self._backend.iteration)
        self._write(run)
        self.step_stored()

    def step_stored(self) -> None:
        """Note in the record how the chain ends, since a killed process may have stored half a step."""
        self._counts = int(self._backend.iteration), np.array(self._backend.accepted)
        # a step in memory is not noted: a new process goes on from the last step in the file
        self._is_unnoted = self._file is not None and self._file.is_behind
        if self._file is not None and not self._is_unnoted:
            *self._summed, rest = _checksums(self._backend, *self._summed)
            self._record.note(STORED, np.array([self._summed[1], rest]))

    def check_file(self) -> None:
        """Raise ValueError if another program holds the file, which must be written before a run begins."""
        if self._file is not None:
            self._file.write_back(wait=False)
            open_file(self._backend, "r+").close()

    def keep_in_memory(self) -> None:
        """From now on, a chain whose file another program holds open is kept in memory, up to `write_behind`."""
        if self._file is not None:
            self._file.goes_on = True

    def write_behind(self) -> None:
        """Write a chain that was kept in memory to the file; warns if another program still holds the file."""
        if self._file is None:
            return
        self._file.goes_on = False
        if not self._file.write_back(wait=True):
            warn(
                f"{self._backend.filename} is still held open by another program, and its last steps are in this "
                "sampler only. Close the file in the other program and call run_mcmc(None, 0), which writes the steps. "
                f"A new process makes them again from {self._record.path}, without a simulation"
            )
        elif self._is_unnoted:
            self.step_stored()

    def change_blobs(self, blobs: np.ndarray | None) -> None:
        """Store the blobs of the chain in the type of the blobs (n, ...) that are stored next."""
        if blobs is None:
            return

        def convert(stored: np.ndarray) -> np.ndarray:
            """Blobs (steps, n, ...) in the new type."""
            steps, n, *shape = stored.shape
            flat = converted(stored.reshape(steps * n, *shape), blobs.dtype, tuple(shape))
            return flat.reshape(stored.shape)

        if change_blobs(self._backend, blobs.dtype, convert):
            self._summed = 0, 0
            self.step_stored()

    def undo_half_a_step(self) -> None:
        """Remove a step that an error or Ctrl-C has left incomplete."""
        try:
            restore_counts(self._backend, *self._counts)
        except Exception as error:  # the error that has ended the step is raised
            logger.warning("the chain may end with half of a step (%s)", error)

    def write(self, result: AnnealingResult, verdict: Verdict | None) -> None:
        """Store a result. If the file cannot be written, a warning is logged, and the next call stores the result."""
        self.result, self.verdict = result, verdict
        try:
            self._write()
        except (OSError, FileHeld) as error:
            logger.warning("ladder and verdict are not stored (%s): the next call of run_mcmc stores them", error)

    def _write(self, run: str | None = None) -> None:
        result, backend = self.result, self._backend
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
        with backend.open("a") as file:
            group = file[backend.name]
            if run is not None:
                group.attrs["run"] = run
                group.pop("restart", None)
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
        return State(values.pop("coords"), **values, random_state=backend.random_state)

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
        backend = self._backend
        cut_chain(backend, 0)
        self.first_step, self.provisional = 0, False
        self._write()
        if isinstance(backend, HDFBackend):
            with backend.open("a") as file:
                file[backend.name].pop("restart", None)
        if isinstance(backend, HDFBackend) and state is not None and state.log_prob is not None:
            with backend.open("a") as file:
                group = file[backend.name].create_group("restart")
                for name in ("coords", "log_prob", "blobs"):
                    if (values := getattr(state, name)) is not None:
                        group.create_dataset(name, data=values)
                for i, value in enumerate(state.random_state or ()):
                    file[backend.name].attrs[f"random_state_{i}"] = value
        self.step_stored()

    def store_provisional_step(self, state: State) -> None:
        """Store the estimate of a run that the limit of simulations ended, as a step that is replaced later."""
        trim_chain(self._backend)
        self._backend.grow(1, state.blobs)
        self._backend.save_step(state, np.zeros(len(state.coords), dtype=bool))
        self.provisional = True
        self._write()
        self.step_stored()

    def drop_provisional_step(self) -> None:
        """Remove the last step if it is provisional."""
        if self.provisional:
            cut_chain(self._backend, int(self._backend.iteration) - 1)
            self.provisional = False
            self._write()
            self.step_stored()


def _read(backend: Backend) -> dict[str, Any]:
    if not isinstance(backend, HDFBackend):
        return getattr(backend, "tempering", {})
    with backend.open() as file:
        group = file[backend.name]
        return _tempering(group)


def _tempering(group: h5py.Group) -> dict[str, Any]:
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
    status, reasons, *others = verdict[:6]
    findings = verdict[6] if len(verdict) > 6 else ()  # version 0.2 stored none
    return result, Verdict(status, tuple(reasons), *others, tuple(Finding(*each) for each in findings))


def _checksums(backend: HDFBackend, known: int = 0, checksum: int = 0) -> tuple[int, int, int]:
    """Number of steps in a chain, CRC-32 of all steps, and CRC-32 of counts, restart state and random state.

    The checksum of all steps is computed from the `checksum` of the first `known` steps.
    """
    with backend.open() as file:
        group = file[backend.name]
        steps = int(group.attrs["iteration"])
        if steps < known:
            known, checksum = 0, 0
        for first in range(known, steps, STEPS_AT_ONCE):
            rows = slice(first, min(first + STEPS_AT_ONCE, steps))
            parts = [group[name][rows] for name in ("chain", "log_prob", "blobs") if name in group]
            for step in zip(*parts, strict=True):
                for part in step:
                    checksum = zlib.crc32(part.tobytes(), checksum)
        stored = _tempering(group)
        parts, rest = [steps, stored.get("first_step"), stored.get("provisional")], 0
        parts += [group["accepted"][...]]
        parts += [group.attrs[name] for name in sorted(group.attrs) if name.startswith("random_state_")]
        parts += [dataset[...] for _, dataset in sorted(group.get("restart", {}).items())]
        for part in parts:
            data = part.tobytes() if isinstance(part, np.ndarray | np.generic) else repr(part).encode()
            rest = zlib.crc32(data, rest)
    return steps, checksum, rest


def is_whole(backend: HDFBackend, record: Record) -> bool:
    """Whether a chain has all stored steps, each complete, or is empty and has never had a step."""
    try:
        with backend.open() as file:
            group = file[backend.name]
            if group.attrs["iteration"] == 0 and "restart" not in group and not np.any(group["accepted"]):
                return True
        noted = record.noted(STORED)
        return noted is not None and tuple(noted.tolist()) == _checksums(backend)[1:]
    except FileHeld:
        raise
    except Exception:  # HDF5 raises nearly anything
        return False


def run_of_file(backend: HDFBackend) -> str | None:
    """The run that the file of a backend belongs to; the empty string for a chain without a run.

    It is "damaged" for a chain that cannot be read completely, and None if there is no file, the file is empty, or it
    has no chain with this name, or an incomplete one that never had a step.
    """
    if not os.path.exists(backend.filename) or os.path.getsize(backend.filename) == 0:
        return None
    try:
        with open_file(backend, "r") as file:
            group = file.get(backend.name)
            if group is None:
                return None
            group.visititems(read_object)
            if "tempering" in group:
                json.loads(group["tempering"][...].tobytes())
            if not group.attrs.get("iteration", 0) and "run" not in group.attrs and "log_prob" not in group:
                return None  # emcee was killed while it made the group
            complete = {"chain", "log_prob", "accepted"} <= set(group) and "iteration" in group.attrs
            return group.attrs.get("run", "") if complete else DAMAGED
    except FileHeld:
        raise
    except Exception:  # HDF5 raises nearly anything
        return DAMAGED


def make_group(backend: HDFBackend, nwalkers: int, ndim: int, run: str) -> None:
    """Make the file of a backend, with an empty chain, in one step; other readable groups are kept."""

    def make(path: Path) -> None:
        options = {"compression": backend.compression, "compression_opts": backend.compression_opts}
        made = HDFBackend(str(path), backend.name, dtype=backend.dtype if backend.dtype_set else None, **options)
        made.reset(nwalkers, ndim)
        with made.open("a") as file:
            file[made.name].attrs["run"] = run

    while True:
        is_new = not os.path.exists(backend.filename)
        try:
            present = None if is_new else open_file(backend, "r+")
        except OSError as error:
            logger.debug("no group is copied from %s: %s", backend.filename, error)
            present = None
        with contextlib.nullcontext() if present is None else present, contextlib.suppress(FileExistsError):
            return replace_file(backend, make, present, is_new)
