"""The chain of a run: what emcee's backend writes, and what is stored beside it.

In an HDF5 file, the group of the chain has the attribute ``run``, the dataset ``tempering`` (JSON: ladder, check,
verdict), and the group ``restart``: the state at beta = 1 from which a chain without steps continues. emcee writes in
place, so a kill leaves half of a step, and HDF5 refuses a file that another program has open. So during a call a
backend works on a copy in memory, which takes the place of the file about every second and at the end; its attribute
``checksum`` tells whether something else has changed it.
"""

import io
import json
import logging
import os
import time
import uuid
import zlib
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any
from urllib.parse import quote

import h5py
import numpy as np

from .emcee_names import Backend, HDFBackend, State
from .estimates.importance import EvidenceCheck
from .finding import Finding
from .interrupts import deferred_interrupts
from .judgement.verdict import Verdict
from .record import Record, kept_aside
from .reports import AnnealingResult, Stage

logger = logging.getLogger(__name__)

SECONDS_BETWEEN, SHARE = 1.0, 0.1  # shortest time between two replacements, and their largest share of the time
DAMAGED = "damaged"
CHECKSUM = "checksum"
# attributes and datasets of every chain of emcee
OF_EVERY_CHAIN = {"version", "nwalkers", "ndim", "has_blobs", "iteration", "chain", "log_prob", "accepted"}


class WholeFile:
    """Takes the place of the method ``open`` of an emcee `HDFBackend`: a context in which all its methods use a copy in
    memory. A copy that cannot be written stays.
    """

    def __init__(self, backend: HDFBackend):
        self._backend, self._path = backend, Path(backend.filename).resolve()
        self._copy: io.BytesIO | None = None
        self._version: tuple | None = None  # of the file that was copied
        self._depth, self._next = 0, 0.0

    def __call__(self, mode: str = "r") -> h5py.File:
        return h5py.File(self._copy or self._path, "r" if mode == "r" else "r+")

    def __enter__(self) -> "WholeFile":
        if self._copy is None:
            self._version, self._copy = _version(self._path), io.BytesIO(self._path.read_bytes())
        self._depth += 1
        return self

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        self._depth -= 1
        if self._depth > 0:
            return
        try:
            self.save()
            self._copy = None
        except OSError:
            if error is None:
                raise
            logger.warning("%s cannot be written: the chain is in this sampler only", self._path)

    def make(self, nwalkers: int, ndim: int, run: str) -> None:
        """Make the file with an empty chain in one step; what else a readable file holds is kept."""
        self._version = _version(self._path)
        try:
            self._copy = io.BytesIO(self._path.read_bytes())
            with self("a") as file:
                file.pop(self._backend.name, None)
        except Exception:  # HDF5 raises nearly anything
            self._copy = io.BytesIO()
            h5py.File(self._copy, "w").close()
        self._backend.reset(nwalkers, ndim)
        with self("a") as file:
            file[self._backend.name].attrs["run"] = run
        self.save()
        self._copy = None

    def save(self) -> None:
        """Put the copy in the place of the file; OSError if it cannot be written, or another program has changed it."""
        start = time.monotonic()
        new = self._path.with_name(f"{self._path.name}.{uuid.uuid4().hex[:8]}.new")
        with deferred_interrupts():
            if self._version != (found := _version(self._path)) and found is not None:
                raise OSError(
                    f"{self._path} has been changed by another program since this run has read it: move it away, and "
                    "call run_mcmc again, which writes the chain of this run"
                )
            with self("a") as file:
                group = file[self._backend.name]
                group.attrs[CHECKSUM] = _checksum(group)
            try:
                with open(new, "wb") as file:
                    file.write(self._copy.getbuffer())
                os.replace(new, self._path)
            finally:
                new.unlink(missing_ok=True)
            self._version = _version(self._path)
        now = time.monotonic()
        self._next = now + max(SECONDS_BETWEEN, (now - start) / SHARE)

    def save_now_and_then(self) -> None:
        """Put the copy in its place if that has not been done for a second; later if that fails now."""
        if time.monotonic() >= self._next:
            try:
                self.save()
            except OSError as error:
                logger.info("the chain is in memory: %s", error)
                self._next = time.monotonic() + SECONDS_BETWEEN


def _version(path: Path) -> tuple | None:
    """What changes with a file; None without one."""
    if not path.exists():
        return None
    found = path.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


def whole_file(backend: Backend) -> WholeFile | None:
    """The method ``open`` of a backend with a file that can be written, from now on a `WholeFile`."""
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return None
    if not isinstance(backend.open, WholeFile):
        vars(backend)["open"] = WholeFile(backend)
    return backend.open


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
    """The run that the file of a backend belongs to: empty for a chain without a run, "damaged" for one that is not as
    it was stored, None without a file or chain, or for one that never had a step.
    """
    if not os.path.exists(backend.filename) or os.path.getsize(backend.filename) == 0:
        return None
    try:
        with h5py.File(io.BytesIO(Path(backend.filename).read_bytes()), "r") as file:
            if backend.name not in file:
                return None
            group = file[backend.name]
            if not group.attrs.get("iteration", 0) and "run" not in group.attrs and "log_prob" not in group:
                return None  # emcee was killed while it made the group
            whole = OF_EVERY_CHAIN <= {*group.attrs, *group}
            if "run" in group.attrs or "tempering" in group:  # else a chain of emcee
                whole &= group.attrs.get(CHECKSUM) == _checksum(group)
            return group.attrs.get("run", "") if whole else DAMAGED
    except Exception:  # HDF5 raises nearly anything
        return DAMAGED


def check_storable(dtype: np.dtype) -> None:
    """Raise ValueError for blobs that a file cannot hold."""
    try:
        h5py.h5t.py_create(dtype, logical=True)
    except TypeError as error:
        raise ValueError(
            f"blobs of dtype {dtype} cannot be stored in a file ({error}): return numbers, as many for each point "
            "(numpy.nan for None), or pass blobs_dtype, as for text blobs_dtype='S20'"
        ) from error


def open_record(backend: Backend | None, nwalkers: int, ndim: int, slow: Sequence[int]) -> Record:
    """The record of the run in a backend's file, which is made if it is missing or damaged; in memory without a file
    that can be written. `slow` are indices of the parameters that a simulation depends on.
    """
    if not isinstance(backend, HDFBackend) or backend.read_only:
        return Record(slow=slow)
    path = Path(backend.filename).resolve()
    record = Record(path.with_name(f"{path.name}.{quote(backend.name, safe='')}.record"), slow)
    stored = run_of_file(backend)
    if record.start is None:
        if stored == DAMAGED:
            raise ValueError(f"{backend.filename} is damaged, and has no record {record.path}: move it away")
        if stored is None:
            whole_file(backend).make(nwalkers, ndim, "")  # in one step, unlike emcee
        return record
    run, shape = record.start.header["run"], record.start.coords.shape
    if stored in (run, None, DAMAGED) and shape != (nwalkers, ndim):
        raise ValueError(
            f"{backend.filename} contains a run of {shape[0]} walkers in {shape[1]} dimensions; got "
            f"nwalkers={nwalkers}, ndim={ndim}. Use another file, or backend.reset(nwalkers, ndim)"
        )
    if stored == run:
        return record
    record.open()  # another process that writes to the files owns them, and is between two writes
    stored = run_of_file(backend)
    if stored in (None, DAMAGED):
        if stored is not None:
            said = "%s does not end with a step that this run has stored: it is damaged, or another program has added"
            logger.warning(f"{said} steps. A copy of it is kept as %s", backend.filename, kept_aside(path))
        logger.warning("the chain of %s is made again from %s", backend.filename, record.path)
        whole_file(backend).make(*shape, run)
    elif stored != run:
        said = "%s was reset, or replaced by the chain of another run: its record begins anew, after the earlier one"
        logger.warning(said, backend.filename)
        record.renew()
    return record


class Chain:
    """Data stored with the chain of an initialised backend: `result` and `verdict` (empty, None: nothing) of a `run`.
    The step of a `provisional` chain is the estimate of a run that the limit ended, and is replaced later.
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
        """Context in which a file is changed as a whole (`WholeFile`)."""
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

    def write(self, *state: State | None) -> None:
        """Store the results, and a `state` that a chain without steps goes on from, if it is another one."""
        result, backend = self.result, self._backend
        self._counts = int(backend.iteration), np.array(backend.accepted)
        if self._file is None:
            return
        contents = {name: getattr(result, name) for name in ("ladder", "check", "founders", "parents")}
        contents |= {"verdict": self.verdict, "provisional": self.provisional}
        data = np.frombuffer(json.dumps(contents, default=np.ndarray.tolist).encode(), dtype=np.uint8)
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

    def clear_chain(self, *state: State | None) -> None:
        """Remove all steps; the chain continues from a `state`, or as before."""
        with self.whole():
            _cut_chain(self._backend, 0, np.zeros_like(self._counts[1]))
            self.provisional = False
            self.write(*state)

    def store_step(self, state: State, accepted: bool, provisional: bool = False) -> None:
        """Store a step that no move has made; a `provisional` one, of a run that the limit ended, is replaced later."""
        self.trim()
        self._backend.grow(1, state.blobs)
        self._backend.save_step(state, np.full(len(state.coords), accepted))
        self.provisional = provisional
        self.write()


def _read(backend: Backend) -> dict[str, Any]:
    if not isinstance(backend, HDFBackend):
        return {}
    with backend.open() as file:
        group = file[backend.name]
        stored = json.loads(group["tempering"][...].tobytes()) if "tempering" in group else {}
        return stored | ({"run": group.attrs["run"]} if "run" in group.attrs else {})


def _parsed(stored: dict[str, Any]) -> tuple[AnnealingResult, Verdict | None]:
    makers = {"check": lambda values: EvidenceCheck(*values), "founders": np.array, "parents": np.array}
    known = {name: make(stored[name]) for name, make in makers.items() if stored.get(name) is not None}
    result = AnnealingResult(tuple(map(Stage._make, stored.get("ladder", ()))), **known)
    if (verdict := stored.get("verdict")) is None:
        return result, None
    status, reasons, *others, findings = verdict
    return result, Verdict(status, tuple(reasons), *others, tuple(Finding(*each) for each in findings))


def _cut_chain(backend: Backend, steps: int, accepted: np.ndarray) -> None:
    """Set a chain's number of steps and its counts of accepted proposals (nwalkers,), without what an interrupted step
    or allocation has left, from which emcee's backends cannot grow.
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
