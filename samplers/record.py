"""The record of a run: all values of the user's function, in one file that is only appended to.

A run is a deterministic function of its start, its settings and these values, so a killed run is repeated from its
start, and nothing is evaluated twice. Counts, failures and the limit of simulations follow from the record; points that
differ only in fast parameters share a simulation.

The file is a sequence of blocks: kind, length, two CRC-32, a text (JSON) and arrays in NumPy's format. Kinds are the
start of the annealing (``RUN``), evaluated points with log-probabilities, blobs and reasons of failure (``EVAL``), and
arrays under a key (``MEMO``), such as simulations of a guide, which stay in the file, without one in a temporary file.
A kill can leave only the last block incomplete, which is dropped.
"""

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
from contextlib import nullcontext
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .interrupts import deferred_interrupts

try:
    import fcntl
except ImportError:  # Windows has no such locks: two programs on one file are not detected there
    fcntl = None

logger = logging.getLogger(__name__)

MAGIC, BLOCK = b"samplers record 1\n", struct.Struct("<4sQII")  # kind, length, checksums of the content and of both
Remember = Callable[..., list[np.ndarray] | None]  # see `Record.remembering`
# Guides count parts of a simulation as fractions: their sums, in another order, differ by less.
ROUNDING = 1e-6
OF_GUIDES = "simulations of guides"  # key in the record
_open_records: "weakref.WeakValueDictionary[Path | int, Record]" = weakref.WeakValueDictionary()  # int: in memory


def lock_now(file: Any) -> None:
    """Lock an open file or its descriptor; BlockingIOError if another process has, OSError if it cannot be locked."""
    if fcntl is not None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


class Incomplete(Exception):
    """A finished run that is made again asks for what its record does not contain: other bits, or a lost record."""


class BudgetExhausted(Exception):
    """The limit of simulations (max_simulations) does not allow a batch, of which nothing was evaluated."""


def as_limit(value: Any) -> float | None:
    """A limit of simulations as float, or None for no limit; ValueError for anything but a positive number."""
    if value is None:
        return None
    if isinstance(value, bool | str) or not isinstance(value, Real) or not value > 0.0:
        raise ValueError(f"max_simulations must be a positive number, or None for no limit; got {value!r}")
    return float(value)


class EvaluatedBatch(NamedTuple):
    """Points that were evaluated."""

    coords: np.ndarray  # (n, ndim)
    log_prob: np.ndarray  # (n,), NaN where the evaluation failed
    blobs: np.ndarray | None  # (n, ...), of the type of the run; None without any, or if all have failed
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


class RunStart(NamedTuple):
    """Start of an annealing."""

    header: dict  # settings and identity of the run, as JSON returns them
    coords: np.ndarray  # (nwalkers, ndim), draws of the prior
    random_state: tuple  # as `numpy.random.RandomState.get_state` returns it


class Record:
    """Evaluations and remembered arrays of a run, in a file that is written and locked from `begin` or `open` on.

    `slow` are indices of the parameters that a simulation depends on, `failed` points with reasons, `counted` those
    whose failures the function counts itself; with `is_complete`, the run reached beta = 1 before, so nothing new may
    be asked for.
    """

    limit: float | None = None

    def __init__(self, path: Path | None = None, slow: Sequence[int] | None = None):
        self.path = None if path is None else path.resolve()  # two names of one file are one record
        self._slow, self._file = None if slow is None else list(slow), None
        self._running: set[bytes] = set()  # points that were submitted, and may not be known yet
        self.use(None)
        self._read()

    def _clear(self) -> None:
        self.start: RunStart | None = None
        self.count, self.is_complete = 0, False
        self.failed: list[tuple[np.ndarray, str]] = []
        self.counted: list[tuple[np.ndarray, str]] = []
        # log-probability, blobs (1, ...) or None, reason of failure, empty without one, and batch of each point
        self._known: dict[bytes, tuple[float, np.ndarray | None, str, int]] = {}
        self.simulated: set[bytes] = set()  # keys of the points
        # by key, in the order of storing: arrays, or their place and length in the file
        self._arrays: dict[str, list[list[np.ndarray] | tuple[int, int]]] = {}

    def __getstate__(self):
        state = {**self.__dict__, "_file": None, "_seen": self._seen if self._file is None else self._whole}
        if self.path is None:
            state["_arrays"] = {key: [*map(self._stored, each)] for key, each in self._arrays.items()}
        return state

    # ------------------------------------------------------------------ evaluations

    def knows(self, coords: np.ndarray) -> np.ndarray:
        """Which of points (n, ndim) have been evaluated, (n,) bool."""
        return np.array([row.tobytes() in self._known for row in np.ascontiguousarray(coords)], dtype=bool)

    def values(self, coords: np.ndarray) -> EvaluatedBatch:
        """Values of points (n, ndim) that have been evaluated; those without blobs beside others get blobs of zeros."""
        found = [self._known[row.tobytes()] for row in np.ascontiguousarray(coords)]
        blobs = next((np.zeros_like(blobs) for _, blobs, *_ in found if blobs is not None), None)
        if blobs is not None:
            blobs = np.concatenate([blobs if own is None else own for _, own, *_ in found])
        reasons = {row: reason for row, (*_, reason, _) in enumerate(found) if reason}
        return EvaluatedBatch(coords, np.array([each[0] for each in found]), blobs, reasons)

    def parts(self, coords: np.ndarray) -> list[np.ndarray]:
        """Points (n, ndim) that have been evaluated, divided where another batch begins, as they were observed."""
        batches = [self._known[row.tobytes()][3] for row in np.ascontiguousarray(coords)]
        return np.split(coords, np.flatnonzero(np.diff(batches)) + 1)

    @deferred_interrupts()
    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter evaluated points; they are in the file on return."""
        if len(batch.coords) > 0:
            blobs = [] if batch.blobs is None else [batch.blobs]
            self._write(b"EVAL", batch.reasons, [batch.coords, batch.log_prob, *blobs])
            self._enter(batch)

    def _enter(self, batch: EvaluatedBatch) -> None:
        coords, blobs, number = np.ascontiguousarray(batch.coords), batch.blobs, self.count
        for row, (point, log_prob) in enumerate(zip(coords, batch.log_prob.tolist(), strict=True)):
            own = None if blobs is None else blobs[row : row + 1]
            self._known.setdefault(point.tobytes(), (log_prob, own, batch.reasons.get(row, ""), number))
        self.simulated.update(self.keys(coords))
        self.count += len(coords)
        for row, reason in batch.reasons.items():
            (self.failed if np.isnan(batch.log_prob[row]) else self.counted).append((coords[row].copy(), reason))

    def keys(self, coords: np.ndarray) -> list[bytes]:
        """The slow parameters of points (n, ndim) as bytes: points with the same key share a simulation."""
        slow = np.ascontiguousarray(coords if self._slow is None else coords[:, self._slow])
        return [row.tobytes() for row in slow]

    def latest(self, most: int | None = None) -> EvaluatedBatch | None:
        """All points, or the latest ones, in the order of their evaluation; None without any."""
        points = list(self._known)[0 if most is None else -most :]
        return self.values(np.frombuffer(b"".join(points)).reshape(len(points), -1)) if points else None

    def drop_old_points(self, most: int) -> None:
        """Forget points of a record in memory before the latest `most`: a long chain needs none of them."""
        if self.path is None and len(self._known) > most + most // 2:
            self._known = dict(list(self._known.items())[-most:])

    # ------------------------------------------------------------------ simulations

    def use(self, guide: Any) -> None:
        """An annealing begins, with a new guide or without one."""
        self.guide, self.refused = guide, False
        self.given_up()

    @property
    def of_guides(self) -> float:
        """Simulations that the guide has made by itself, or those in the record, if the annealing is not made again."""
        if self.guide is not None:
            return self.guide.simulations
        return float(sum(allowed.item() for (allowed,) in map(self._stored, self._arrays.get(OF_GUIDES, ()))))

    @property
    def simulations(self) -> float:
        """Distinct points in the slow parameters, and the simulations of guides."""
        return len(self.simulated) + len(self._running - self.simulated) + self.of_guides

    @property
    def remaining(self) -> float:
        """Simulations left; inf without a limit."""
        return np.inf if self.limit is None else max(self.limit - self.simulations, 0.0)

    def fits(self, simulations: float, remember: Remember) -> bool:
        """Whether this number of further simulations by the guide fits; `refused` notes a refusal. What `remember`
        knows of this annealing costs nothing, and always fits.
        """
        if remember(OF_GUIDES) is None:
            self.refused = self.refused or simulations > self.remaining + ROUNDING
            if not self.refused:
                remember(OF_GUIDES, lambda: [np.array(simulations)])
        return not self.refused

    def submitted(self, coords: np.ndarray) -> None:
        """Points (n, ndim) begin to be evaluated, and count from now on."""
        self._running = (self._running - self.simulated) | set(self.keys(coords))

    def given_up(self) -> None:
        """Points that were running and are not known have been given up."""
        self._running.clear()

    def fitting(self, coords: np.ndarray) -> int:
        """Number of leading points among (n, ndim) that fit into the limit."""
        if self.limit is None:
            return len(coords)
        remaining, new = self.remaining, set()
        for number, key in enumerate(self.keys(coords)):
            if key not in self.simulated and key not in self._running:
                new.add(key)
                if len(new) > remaining:
                    return number
        return len(coords)

    # ------------------------------------------------------------------ arrays under a key

    def remembering(self) -> Remember:
        """A function ``remember(key, compute)`` for a run that is made from its start: arrays that ``compute()``
        returns, or has returned when the run was made before, the first ones first. Without `compute`, None instead of
        new arrays.
        """
        used: Counter[str] = Counter()

        def remember(key: str, compute: Callable[[], Sequence[np.ndarray]] | None = None) -> list[np.ndarray] | None:
            known = self._arrays.setdefault(key, [])
            if used[key] == len(known):
                if self.is_complete:
                    raise Incomplete
                if compute is None:
                    return None
                arrays = [np.asarray(array) for array in compute()]
                with deferred_interrupts():
                    known.append(self._write(b"MEMO", key, arrays))
            used[key] += 1
            return self._stored(known[used[key] - 1])

        return remember

    # ------------------------------------------------------------------ the file

    @deferred_interrupts()
    def begin(self, start: RunStart) -> None:
        """Enter the start of the annealing."""
        kind, keys, *rest = start.random_state
        self._write(b"RUN ", [start.header, kind, *rest], [start.coords, keys])
        self.start = start

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
                    self._read()
                self._file = file
                if self._whole == 0:
                    self._append(MAGIC)
                file.truncate(self._whole)
            except BaseException:  # the state of an open file is known
                self._file = None
                file.close()
                raise
            _open_records[self.path] = self
            weakref.finalize(self, file.close)

    def close(self) -> None:
        """Close the file; a temporary file is lost, with the arrays in it."""
        if self._file is not None:
            self._file.close()
            self._file, self._seen = None, self._whole
        if self.path is None:
            self._arrays.clear()

    @property
    def is_stale(self) -> bool:
        """Whether another sampler has written to the file since it was read or closed."""
        is_closed = self.path is not None and self._file is None
        return is_closed and self.path.exists() and self.path.stat().st_size != self._seen

    def renew(self) -> None:
        """Begin with an empty record, whose blocks follow the earlier ones in the file."""
        self.open()  # another process that writes to the file owns it
        self._clear()

    def _write(self, kind: bytes, text: Any, arrays: Sequence[np.ndarray]) -> tuple[int, int] | None:
        """Append a block to the file; returns the place and length of its content."""
        if self.path is None and kind != b"MEMO":
            return None
        if self.path is None and self._file is None:
            self._file, self._whole = tempfile.TemporaryFile(buffering=0), 0
            weakref.finalize(self, self._file.close)
            _open_records[id(self)] = self
        self.open()
        content = io.BytesIO()
        for array in (np.frombuffer(json.dumps(text).encode(), dtype=np.uint8), *arrays):
            np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
        data = content.getvalue()
        self._append(BLOCK.pack(kind, len(data), zlib.crc32(data), _of_both(kind, len(data))) + data)
        return self._whole - len(data), len(data)

    def _stored(self, kept: list[np.ndarray] | tuple[int, int]) -> list[np.ndarray]:
        """Arrays under a key."""
        if isinstance(kept, list):
            return kept
        with open(self.path, "rb") if self._file is None else nullcontext(self._file) as file:
            file.seek(kept[0])
            return _parsed(file.read(kept[1]))[1]

    def _append(self, data: bytes) -> None:
        """Write all bytes to the end of the file, or none: an incomplete block would hide the blocks after it."""
        try:
            self._file.seek(self._whole)
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            self._file.truncate(self._whole)
            said = f"the record of the run cannot be written ({error.strerror}). Everything before is kept: "
            said += "make space, and call run_mcmc again"
            raise OSError(error.errno, said, str(self.path or tempfile.gettempdir())) from error
        self._whole += len(data)

    def _read(self) -> None:
        self._clear()
        self._whole = self._seen = 0  # bytes of the file that were read; its size when it was read or closed
        if self.path is None or not self.path.exists():
            return
        data, place = self.path.read_bytes(), len(MAGIC)
        if data[:place] != MAGIC[: len(data)]:
            raise ValueError(f"{self.path} is not the record of a run: move it away, or use another file")
        while place + BLOCK.size <= len(data):
            kind, length, checksum, of_both = BLOCK.unpack_from(data, place)
            end, known = place + BLOCK.size + length, of_both == _of_both(kind, length)
            content = data[place + BLOCK.size : end]
            if known and len(content) < length:
                break  # the process was killed while it wrote this block
            if not known or zlib.crc32(content) != checksum:
                said = "%s is damaged after %d of %d bytes, with %d evaluations before: the rest is not used, and a "
                said += "copy of the file is kept as %s"
                logger.warning(said, self.path, place, len(data), self.count, kept_aside(self.path))
                break
            self._read_block(kind, content, place + BLOCK.size)
            place = end
        self._whole, self._seen = place if len(data) >= len(MAGIC) else 0, len(data)

    def _read_block(self, kind: bytes, content: bytes, place: int) -> None:
        text, arrays = _parsed(content)
        if kind == b"EVAL":
            coords, log_prob, *blobs = arrays
            reasons = {int(row): reason for row, reason in text.items()}
            self._enter(EvaluatedBatch(coords, log_prob, blobs[0] if blobs else None, reasons))
        elif kind == b"RUN ":
            self._clear()
            header, name, *rest = text
            self.start = RunStart(header, arrays[0], (name, arrays[1], *rest))
        else:
            self._arrays.setdefault(text, []).append((place, len(content)))


def _parsed(content: bytes) -> tuple[Any, list[np.ndarray]]:
    """Text and arrays of a block."""
    stream, arrays = io.BytesIO(content), []
    while stream.tell() < len(content):
        arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
    return json.loads(arrays[0].tobytes()), arrays[1:]


def kept_aside(path: Path) -> Path:
    """The name of a copy of a damaged file."""
    name, number = path.with_name(f"{path.name}.damaged"), 2
    while name.exists():
        name, number = path.with_name(f"{path.name}.damaged.{number}"), number + 1
    return Path(shutil.copyfile(path, name))


def _close_in_child() -> None:
    """Close the parent's files in a forked process, which would otherwise keep their locks after the parent's end."""
    for record in list(_open_records.values()):
        record.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_in_child)


def _of_both(kind: bytes, length: int) -> int:
    """CRC-32 of kind and length, without which a damaged length would look like the end of a file."""
    return zlib.crc32(kind + length.to_bytes(8, "little"))
