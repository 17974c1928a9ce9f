"""Data stored with a chain: the run that it belongs to, the ladder, the check of the evidence, the verdict.

emcee's backend writes the chain. In an HDF5 file, the group of the chain has the attribute ``run``, the dataset
``tempering`` (JSON), and the group ``restart``: the population at beta = 1, or the state from which a reset chain
continues. The attribute ``checksum`` of all of this is written last, so that half of a step is found, as a process
leaves it that was killed while HDF5 wrote. In memory, results are attributes of the backend.
"""

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
from .output_file import FileHeld, change_file, open_file, patient_open, read_object
from .reports import AnnealingResult, Stage, warn

__all__ = ["DAMAGED", "Output", "make_group", "run_of_file"]

logger = logging.getLogger(__name__)

DAMAGED = "damaged"
CHECKSUM = "checksum"
ATTRIBUTES = {"version", "nwalkers", "ndim", "has_blobs", "iteration"}  # of every chain of emcee
STEPS_AT_ONCE = 200  # steps that are read at once for their checksum


class Output:
    """Data stored with the chain of an initialised backend: `result` and `verdict` (empty, None: nothing).

    `first_step` steps were stored before the last annealing. `provisional`: the last step is the estimate of a run that
    the limit of simulations ended, and is replaced when the run continues.
    """

    def __init__(self, backend: Backend):
        self._backend, self._file = backend, patient_open(backend)
        self._counts = int(backend.iteration), np.array(backend.accepted)
        self._summed = 0, 0  # steps, and their checksum
        stored = _read(backend)
        self.result, self.verdict = _parsed(stored)
        self.first_step = stored.get("first_step", 0)
        # the process may have been killed after the provisional step was removed, and before its note was
        self.provisional = stored.get("provisional", False) and int(backend.iteration) > self.first_step

    def begin(self, run: str) -> None:
        """A new annealing begins, without results."""
        self.result, self.verdict, self.first_step = AnnealingResult(), None, int(self._backend.iteration)
        self._write(run, keep=False)

    def step_stored(self) -> None:
        """A step has been stored completely."""
        self._counts = int(self._backend.iteration), np.array(self._backend.accepted)
        if self._file is not None:
            with self._backend.open("a") as file:
                self._seal(file[self._backend.name])

    def _seal(self, group: h5py.Group) -> None:
        """Write the checksum of a chain that is complete, from the checksum of its known steps."""
        self._summed = _checksum_of_steps(group, *self._summed)
        group.attrs[CHECKSUM] = _checksum(group, self._summed[1])

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
                "A new process makes them again from the record beside the file, without a simulation"
            )

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
        with backend.open("a") as file:
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
            self._seal(group)

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


def _checksum_of_steps(group: h5py.Group, known: int = 0, checksum: int = 0) -> tuple[int, int]:
    """Number of steps in a chain, and their CRC-32, from the `checksum` of the first `known` steps."""
    steps = int(group.attrs["iteration"])
    if steps < known:
        known, checksum = 0, 0
    for first in range(known, steps, STEPS_AT_ONCE):
        rows = slice(first, min(first + STEPS_AT_ONCE, steps))
        parts = [group[name][rows] for name in ("chain", "log_prob", "blobs") if name in group]
        for step in zip(*parts, strict=True):
            for part in step:
                checksum = zlib.crc32(part.tobytes(), checksum)
    return steps, checksum


def _checksum(group: h5py.Group, of_steps: int) -> int:
    """CRC-32 of a chain: of its steps, counts, results, restart state and random states."""
    parts = [(name, group.attrs[name]) for name in group.attrs if name.startswith(("iteration", "random_state_"))]
    parts += [(name, group[name][...]) for name in ("accepted", "tempering") if name in group]
    if "restart" in group:
        parts += [("restart", b"")]
        parts += [(name, value[...]) for name, value in group["restart"].items()]
        parts += [(f"restart {name}", value) for name, value in group["restart"].attrs.items()]
    for name, part in sorted(parts, key=lambda each: each[0]):
        data = part.tobytes() if hasattr(part, "tobytes") else repr(part).encode()
        of_steps = zlib.crc32(name.encode() + data, of_steps)
    return of_steps


def run_of_file(backend: HDFBackend) -> str | None:
    """The run that the file of a backend belongs to; the empty string for a chain without a run.

    It is "damaged" for a chain that cannot be read completely, or is not as it was stored. It is None if there is no
    file, the file is empty, or it has no chain with this name, or an incomplete one that never had a step.
    """
    if not os.path.exists(backend.filename) or os.path.getsize(backend.filename) == 0:
        return None
    try:
        with open_file(backend, "r") as file:
            if backend.name not in file:
                return None
            group = file[backend.name]
            group.visititems(read_object)
            if not group.attrs.get("iteration", 0) and "run" not in group.attrs and "log_prob" not in group:
                return None  # emcee was killed while it made the group
            names = list(group.attrs)  # a kill while one is replaced loses another one, or leaves one twice
            whole = ATTRIBUTES <= set(names) and len(set(names)) == len(names)
            whole &= {"chain", "log_prob", "accepted"} <= set(group)
            if whole and ("run" in group.attrs or "tempering" in group):  # else a chain of emcee
                whole = group.attrs.get(CHECKSUM) == _checksum(group, _checksum_of_steps(group)[1])
            return group.attrs.get("run", "") if whole else DAMAGED
    except FileHeld:
        raise
    except Exception:  # HDF5 raises nearly anything
        return DAMAGED


def make_group(backend: HDFBackend, nwalkers: int, ndim: int, run: str, damaged: bool = False) -> None:
    """Make the file of a backend, with an empty chain, in one step; other groups of a readable file are kept."""

    def make(path: Path) -> None:
        options = {"compression": backend.compression, "compression_opts": backend.compression_opts}
        made = HDFBackend(str(path), backend.name, dtype=backend.dtype if backend.dtype_set else None, **options)
        made.reset(nwalkers, ndim)
        with made.open("a") as file:
            group = file[made.name]
            group.attrs["run"] = run
            group.attrs[CHECKSUM] = _checksum(group, _checksum_of_steps(group)[1])

    change_file(backend, make, damaged)
