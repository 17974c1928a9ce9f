"""The record of a run: all values of the user's function, in one file that is only appended to.

A run is a deterministic function of its start, its settings and these values. A killed run is therefore repeated from
its start: every point in the record is looked up, and nothing is evaluated twice. Counts, failures and the limit of
simulations are computed from the record.

The file is a sequence of blocks: kind, length, two CRC-32, arrays in NumPy's format. There are three kinds:

``RUN``
    An annealing begins: its settings (JSON), the starting points and the state of the random generator.
``EVAL``
    Points that were evaluated, with their log-probabilities, blobs and reasons of failure.
``MEMO``
    Arrays under a key: simulations of a guide, or the order in which points of an asynchronous run arrived.

A kill can leave only the last block incomplete, and an incomplete block is dropped. Without a path, the latest
points are kept in memory, and arrays under a key in a temporary file.
"""

import errno
import io
import json
import logging
import os
import shutil
import struct
import tempfile
import weakref
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import h5py
import numpy as np

from .blobs import joined
from .emcee_names import Backend, HDFBackend
from .interrupts import deferred_interrupts
from .locks import lock_now
from .output_file import DAMAGED, run_of_file, whole_file

__all__ = ["EvaluatedBatch", "Incomplete", "Record", "Remember", "RunStart", "merge_batches", "open_record"]

logger = logging.getLogger(__name__)

MAGIC, BLOCK = b"samplers record 1\n", struct.Struct("<4sQII")  # kind, length, checksums of the content and of both
Remember = Callable[..., list[np.ndarray] | None]  # see `Record.remembering`
_open_records: "weakref.WeakValueDictionary[Path, Record]" = weakref.WeakValueDictionary()


class Incomplete(Exception):
    """A finished run that is made again asks for what its record does not contain: other bits, or a lost record."""


class EvaluatedBatch(NamedTuple):
    """Points that were evaluated."""

    coords: np.ndarray  # (n, ndim)
    log_prob: np.ndarray  # (n,), NaN where the evaluation failed
    blobs: np.ndarray | None  # (n, ...)
    reasons: dict[int, str]  # of each failure, by row; log_prob is -inf if the function counts the failure itself

    @property
    def failed(self) -> np.ndarray:
        """Which evaluations failed, (n,) bool, apart from failures that the function counts itself."""
        return np.isnan(self.log_prob)

    def rows(self, rows: Sequence[int]) -> "EvaluatedBatch":
        """The batch of some rows."""
        reasons = {new: self.reasons[old] for new, old in enumerate(rows) if old in self.reasons}
        blobs = None if self.blobs is None else self.blobs[rows]
        return EvaluatedBatch(self.coords[rows], self.log_prob[rows], blobs, reasons)


def merge_batches(batches: Sequence[EvaluatedBatch]) -> EvaluatedBatch:
    """Several batches as one; at least one is needed. Failed points of a batch without blobs get blobs of zeros."""
    blobs = next((batch.blobs for batch in batches if batch.blobs is not None), None)
    if blobs is not None:
        shape, dtype = blobs.shape[1:], blobs.dtype
        blobs = joined([np.zeros((len(b.coords), *shape), dtype) if b.blobs is None else b.blobs for b in batches])
    first = np.cumsum([0, *(len(batch.coords) for batch in batches)]).tolist()
    reasons = {start + row: text for start, b in zip(first, batches, strict=False) for row, text in b.reasons.items()}
    coords, log_prob = (np.concatenate([batch[column] for batch in batches]) for column in (0, 1))
    return EvaluatedBatch(coords, log_prob, blobs, reasons)


class RunStart(NamedTuple):
    """Start of an annealing."""

    header: dict  # settings and identity of the run, as JSON returns them
    coords: np.ndarray  # (nwalkers, ndim), draws of the prior
    random_state: tuple  # as `numpy.random.RandomState.get_state` returns it


class Record:
    """Evaluations and remembered arrays of a run, in a file that is written and locked from `begin` or `open` on.

    `slow` are indices of the parameters that a simulation depends on. `start` belongs to the last annealing; `failed`
    are points with reasons, in order, and `counted` those whose failures the function counts itself. `is_complete`:
    the run reached beta = 1 before, so nothing new may be asked for.
    """

    def __init__(self, path: Path | None = None, slow: Sequence[int] | None = None):
        self.path = None if path is None else path.resolve()  # two names of one file are one record
        self._slow, self._file = None if slow is None else list(slow), None
        self._clear()
        if self.path is not None and self.path.exists():
            self._read()

    def _clear(self) -> None:
        self.start: RunStart | None = None
        self.count, self.is_complete = 0, False
        self.failed: list[tuple[np.ndarray, str]] = []
        self.counted: list[tuple[np.ndarray, str]] = []
        self._batches: list[EvaluatedBatch] = []
        self._known: dict[bytes, tuple[EvaluatedBatch, int]] = {}  # batch and row of each point
        self.simulated: set[bytes] = set()  # keys of the points
        self._arrays: dict[str, list[tuple[int, int]]] = {}  # first byte and length of their blocks in the file
        self._whole = 0  # bytes of the file that were read
        self._seen = 0  # size of the file when it was read or closed

    def __getstate__(self):
        content = None
        if self.path is None and self._file is not None:
            self._file.seek(0)
            content = self._file.read()
        return {**self.__dict__, "_file": content, "_seen": self._seen if self._file is None else self._whole}

    def __setstate__(self, state: dict):
        vars(self).update(state, _file=None)
        if state["_file"] is not None:
            with open(self._open_temporary().fileno(), "wb", closefd=False) as file:
                file.write(state["_file"])

    # ------------------------------------------------------------------ evaluations

    def find(self, coords: np.ndarray) -> tuple[np.ndarray, list[EvaluatedBatch]]:
        """Which of points (n, ndim) are known, (n,) bool, and their values in order, in one or more batches."""
        found = [self._known.get(row.tobytes()) for row in np.ascontiguousarray(coords)]
        groups = groupby(filter(None, found), lambda each: id(each[0]))
        parts = [list(group) for _, group in groups]
        known = np.array([each is not None for each in found], dtype=bool)
        return known, [part[0][0].rows([row for _, row in part]) for part in parts]

    @deferred_interrupts()
    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter evaluated points; they are in the file on return. ValueError for blobs that a file cannot hold."""
        if len(batch.coords) == 0:
            return
        blobs = [] if batch.blobs is None else [batch.blobs]
        for each in blobs:
            self.check_blobs(each.dtype)
        if self.path is not None:
            self._write(b"EVAL", [batch.coords, batch.log_prob, _text(batch.reasons), *blobs])
        self._enter(batch)

    def check_blobs(self, dtype: np.dtype) -> None:
        """Raise ValueError for blobs that the file of the record, if there is one, cannot hold."""
        if self.path is None:
            return
        try:
            h5py.h5t.py_create(dtype, logical=True)
            reason = "Python objects" if dtype.hasobject else ""
        except TypeError as error:
            reason = str(error)
        if reason:
            raise ValueError(
                f"blobs of dtype {dtype} cannot be stored in a file ({reason}): return numbers, as many for each point "
                "(numpy.nan for None), or pass blobs_dtype, as for text blobs_dtype='S20'"
            )

    def _enter(self, batch: EvaluatedBatch) -> None:
        self._batches.append(batch)
        coords = np.ascontiguousarray(batch.coords)
        for row, point in enumerate(coords):
            self._known.setdefault(point.tobytes(), (batch, row))
        self.simulated.update(self.keys(coords))
        self.count += len(coords)
        for row, reason in batch.reasons.items():
            (self.failed if np.isnan(batch.log_prob[row]) else self.counted).append((coords[row].copy(), reason))

    def keys(self, coords: np.ndarray) -> list[bytes]:
        """The slow parameters of points (n, ndim) as bytes: points with the same key share a simulation."""
        slow = np.ascontiguousarray(coords if self._slow is None else coords[:, self._slow])
        return [row.tobytes() for row in slow]

    def latest(self, most: int) -> EvaluatedBatch | None:
        """At least the latest `most` evaluated points, in the order of their evaluation; None without any."""
        first = len(self._batches)
        while first > 0 and most > 0:
            first -= 1
            most -= len(self._batches[first].coords)
        return merge_batches(self._batches[first:]) if self._batches else None

    def first(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """The first m <= n evaluated points (m, ndim) that are still known, and their log-probabilities (m,)."""
        coords, log_prob = (np.concatenate([batch[column][:n] for batch in self._batches])[:n] for column in (0, 1))
        return coords, log_prob

    def drop_old_points(self, most: int) -> None:
        """Forget points of a record in memory before the latest `most`: a long chain needs none of them."""
        while self.path is None and self._batches and len(self._known) - len(self._batches[0].coords) >= most:
            for point in np.ascontiguousarray(self._batches.pop(0).coords):
                self._known.pop(point.tobytes(), None)

    # ------------------------------------------------------------------ arrays under a key

    def remembering(self) -> Remember:
        """A function ``remember(key, compute)`` for a run that is made from its start, now or again.

        It returns the arrays that ``compute()`` returns, or those that it returned when the run was made before. For
        equal keys, the arrays that were stored first are returned first. Without `compute`, None instead of new arrays.
        """
        used: Counter[str] = Counter()

        def remember(key: str, compute: Callable[[], Sequence[np.ndarray]] | None = None) -> list[np.ndarray] | None:
            known = self._arrays.setdefault(key, [])
            if used[key] < len(known):
                arrays = self._stored(known[used[key]])
            elif self.is_complete:
                raise Incomplete
            elif compute is None:
                return None
            else:
                arrays = [np.asarray(array) for array in compute()]
                with deferred_interrupts():
                    known.append(self._write(b"MEMO", [_text(key), *arrays]))
            used[key] += 1
            return arrays

        return remember

    @deferred_interrupts()
    def note(self, key: str, array: np.ndarray) -> None:
        """Store an array under a key; only the last one counts (`noted`)."""
        self._arrays[key] = [self._write(b"MEMO", [_text(key), array])]

    def noted(self, key: str) -> np.ndarray | None:
        """The last array that was noted under a key since the annealing began; None without any."""
        return self._stored(self._arrays[key][-1])[0] if key in self._arrays else None

    def _stored(self, place: tuple[int, int]) -> list[np.ndarray]:
        """The arrays in a block of the file."""
        with open(self._file.fileno() if self.path is None else self.path, "rb", closefd=self.path is not None) as file:
            file.seek(place[0])
            return _arrays_of(file.read(place[1]))[1:]

    # ------------------------------------------------------------------ the file

    @deferred_interrupts()
    def begin(self, start: RunStart) -> None:
        """Enter the start of an annealing, which begins the record of a new run."""
        start = start._replace(header=json.loads(json.dumps(start.header)))
        kind, keys, *rest = start.random_state
        if self.path is not None:
            self._write(b"RUN ", [_text([start.header, kind, *rest]), start.coords, keys])
        self.start, self._arrays = start, {}

    def open(self) -> None:
        """Open the file for writing, and lock it. ValueError if another process writes to it."""
        if self.path is None or self._file is not None:
            return
        if (earlier := _open_records.get(self.path)) is not None:  # the last sampler of a process owns it
            earlier.close()
        with deferred_interrupts():
            self.path.touch()
            file = open(self.path, "r+b", buffering=0)  # noqa: SIM115  open during the run
            try:
                try:
                    lock_now(file)
                except BlockingIOError:
                    text = f"another run is writing to {self.path}: wait for its end, or use another file"
                    raise ValueError(text) from None
                except OSError as error:
                    logger.info("%s cannot be locked (%s): do not start two runs on it", self.path, error.strerror)
                if self.path.stat().st_size != self._whole:  # an incomplete block, or another process has written
                    vars(self).update(vars(Record(self.path, self._slow)))
                if self._whole == 0:
                    file.truncate(0)
                    if file.write(MAGIC) < len(MAGIC):
                        file.truncate(0)
                        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
                    self._whole = len(MAGIC)
                file.truncate(self._whole)
                file.seek(self._whole)
            except BaseException:  # the state of an open file is known
                file.close()
                raise
            self._file, _open_records[self.path] = file, self
            weakref.finalize(self, file.close)

    def _open_temporary(self) -> Any:
        # as long as the record; without a buffer, which a forked process would write a second time at its end
        self._file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        weakref.finalize(self, self._file.close)
        return self._file

    def close(self) -> None:
        """Close the file of a record that has a path."""
        if self.path is not None and self._file is not None:
            self._file.close()
            self._file, self._seen = None, self._whole

    @property
    def is_stale(self) -> bool:
        """Whether another sampler has written to the file since it was read or closed."""
        is_closed = self.path is not None and self._file is None
        return is_closed and self.path.exists() and self.path.stat().st_size != self._seen

    def renew(self) -> Path | None:
        """Begin with an empty record; returns the new name of its file, if it has one."""
        aside = None
        if self.path is not None and self.path.exists():
            self.open()  # another process that writes to the file owns it
            self.close()
            aside = _free_name(self.path, "before_reset")
            os.replace(self.path, aside)
        self._clear()
        return aside

    def _write(self, kind: bytes, arrays: Sequence[np.ndarray]) -> tuple[int, int]:
        """Append a block; first byte and length of its content."""
        self.open()
        if self._file is None:
            self._open_temporary()
        data, start = memoryview(_block(kind, arrays)), self._whole
        try:
            self._file.seek(start)
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:  # an incomplete block would hide the blocks after it
            self._file.truncate(start)
            self._file.seek(start)
            raise OSError(
                error.errno,
                f"the record of the run cannot be written ({error.strerror}). Everything before is kept: make space, "
                "and call run_mcmc again",
                str(self.path or "temporary file"),
            ) from error
        self._whole = start + len(data)
        return start + BLOCK.size, len(data) - BLOCK.size

    def _read(self) -> None:
        data, place = self.path.read_bytes(), len(MAGIC)
        if data[:place] != MAGIC[: len(data)]:
            raise ValueError(f"{self.path} is not the record of a run: move it away, or use another file")
        while place + BLOCK.size <= len(data):
            kind, length, checksum, of_both = BLOCK.unpack_from(data, place)
            end, known = place + BLOCK.size + length, of_both == _of_both(kind, length)
            content = data[place + BLOCK.size : end]
            if known and len(content) < length:
                break  # the process was killed while it wrote this block
            if not known or zlib.crc32(content) != checksum or not self._read_block(kind, content, place + BLOCK.size):
                aside = _free_name(self.path, "damaged")
                shutil.copyfile(self.path, aside)
                logger.warning(
                    "%s is damaged after %d of %d bytes, with %d evaluations before: the rest is not used, and a copy "
                    "of the file is kept as %s",
                    self.path,
                    place,
                    len(data),
                    self.count,
                    aside,
                )
                break
            place = end
        self._whole, self._seen = place if len(data) >= len(MAGIC) else 0, len(data)

    def _read_block(self, kind: bytes, content: bytes, start: int) -> bool:
        """Enter a block of the file; False if its content is of another form."""
        try:
            first, *arrays = _arrays_of(content)
            if kind == b"EVAL":
                log_prob, said, *blobs = arrays
                reasons = {int(row): text for row, text in json.loads(said.tobytes()).items()}
                self._enter(EvaluatedBatch(first, log_prob, blobs[0] if blobs else None, reasons))
            elif kind == b"RUN ":
                header, name, *rest = json.loads(first.tobytes())
                self.start, self._arrays = RunStart(header, arrays[0], (name, arrays[1], *rest)), {}
            else:
                self._arrays.setdefault(json.loads(first.tobytes()), []).append((start, len(content)))
        except ValueError:
            return False
        return True


def open_record(backend: Backend | None, nwalkers: int, ndim: int, slow: Sequence[int]) -> Record:
    """The record of the run in a backend's file; the HDF5 file is made if it is missing or damaged.

    Without a file that can be written, the record is kept in memory. `slow` are indices of the parameters that a
    simulation depends on.
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
    if stored == run:
        return record
    if stored in (None, DAMAGED):
        if stored is not None:
            aside = _free_name(path, "damaged")
            shutil.copyfile(path, aside)
            said = "%s does not end with a step that this run has stored: it is damaged, or another program has added"
            logger.warning(f"{said} steps. A copy of it is kept as %s", backend.filename, aside)
        logger.warning("the chain of %s is made again from %s", backend.filename, record.path)
        whole_file(backend).make(*record.start.coords.shape, run, anew=stored == DAMAGED)
        return record
    aside = record.renew()
    logger.warning(
        "%s was reset, or replaced by the chain of another run: a new record begins, the earlier one is kept as %s",
        backend.filename,
        aside,
    )
    return record


def _free_name(path: Path, ending: str) -> Path:
    """A name beside `path` with this ending that no file has: simulations are never overwritten."""
    name, number = path.with_name(f"{path.name}.{ending}"), 2
    while name.exists():
        name, number = path.with_name(f"{path.name}.{ending}.{number}"), number + 1
    return name


def _close_in_child() -> None:
    """Close the parent's files in a forked process, which would otherwise keep their locks after the parent's end."""
    for record in list(_open_records.values()):
        record.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)


def _block(kind: bytes, arrays: Sequence[np.ndarray]) -> bytes:
    content = io.BytesIO()
    for array in arrays:
        np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
    data = content.getvalue()
    return BLOCK.pack(kind, len(data), zlib.crc32(data), _of_both(kind, len(data))) + data


def _of_both(kind: bytes, length: int) -> int:
    """CRC-32 of kind and length, without which a damaged length would look like the end of a file."""
    return zlib.crc32(kind + length.to_bytes(8, "little"))


def _text(value: Any) -> np.ndarray:
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def _arrays_of(content: bytes) -> list[np.ndarray]:
    stream, arrays = io.BytesIO(content), []
    while stream.tell() < len(content):
        arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
    return arrays
