"""The journal of a run: what was evaluated and stored, appended to one file, so that a killed run loses nothing.

A journal is a sequence of blocks: kind, length and CRC-32 of the content, CRC-32 of these three, content. A block is
written in one piece and never changed, so whatever kills the process can leave one thing only that is not whole: the
last block, which is then dropped. Arrays are stored in NumPy's own format, texts as JSON; nothing is pickled.

    HEAD  what is sampled and how (JSON)
    INIT  start of a climb: draws of the prior, their log-prior, state of the random generator
    EVAL  points, and what ``log_prob_fn`` returned for them (NaN where it failed)
    FAIL  why it failed (JSON), for the block before
    CALL  that so many steps at beta = 1 are wanted (JSON)
    STEP  a stored step: points, log-probabilities, acceptance, blobs, state of the random generator
    DONE  the call is complete
    WIPE  the chain was reset

A journal survives the death of the process, not the last seconds before a power failure: it is not forced to the disk.
"""

import io
import json
import os
import struct
import weakref
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

try:
    from fcntl import LOCK_EX, LOCK_NB, lockf
except ImportError:  # no such locks on this system: two runs on one file are not told
    lockf = None

__all__ = ["Contents", "Evaluated", "Journal", "Start", "Step", "read_journal"]

MAGIC = b"samplers journal 1\n"
HEADER = struct.Struct("<4sQI")
CHECKSUM = struct.Struct("<I")
BEFORE_CONTENT = HEADER.size + CHECKSUM.size


_open: "weakref.WeakValueDictionary[Path, Journal]" = weakref.WeakValueDictionary()


class Start(NamedTuple):
    """Start of a climb: draws of the prior (n, ndim), their log-prior (n,), state of the random generator."""

    coords: np.ndarray
    log_prior: np.ndarray
    random_state: tuple


class Step(NamedTuple):
    """A step of the chain, as emcee stores it."""

    coords: np.ndarray
    log_prob: np.ndarray
    accepted: np.ndarray
    blobs: np.ndarray | None
    random_state: tuple


class Evaluated(NamedTuple):
    """Points (n, ndim), what was returned for them (n,), blobs (n, ...) or None, reasons of failures by row."""

    coords: np.ndarray
    log_prob: np.ndarray
    blobs: np.ndarray | None
    reasons: dict[int, str]


class Contents(NamedTuple):
    """What a journal tells.

    Attributes
    ----------
    header : dict — as given to `Journal.create`.
    start : Start, or None — of the last climb.
    evaluated : list of Evaluated — of all climbs and steps.
    before_last : int — how many of them had been made when `last` was stored.
    steps : list of Step — since the chain was last reset.
    last : Step, or None — the last one since the start, even if the chain was reset after it.
    wanted, made : int or None, and int — steps that the last call asked for, None if it is done, and how many it made.
    size, whole : int — bytes of the file, and those up to the end of the last whole block.
    """

    header: dict
    start: Start | None
    evaluated: list[Evaluated]
    before_last: int
    steps: list[Step]
    last: Step | None
    wanted: int | None
    made: int
    size: int
    whole: int


def _pack_arrays(arrays: Sequence[np.ndarray]) -> bytes:
    content = io.BytesIO()
    for array in arrays:
        np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
    return content.getvalue()


def _unpack_arrays(content: bytes) -> list[np.ndarray]:
    stream, arrays = io.BytesIO(content), []
    while stream.tell() < len(content):
        arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
    return arrays


def _pack_random(state: Sequence[Any]) -> list[np.ndarray]:
    """State of a RandomState as arrays; its generator is always the Mersenne twister."""
    _, keys, position, has_gauss, cached = state
    return [np.asarray(keys, dtype=np.uint32), np.array([position, has_gauss, cached], dtype=float)]


def _unpack_random(arrays: Sequence[np.ndarray]) -> tuple:
    keys, (position, has_gauss, cached) = arrays
    return "MT19937", keys, int(position), int(has_gauss), float(cached)


def _block(kind: bytes, content: bytes) -> bytes:
    header = HEADER.pack(kind, len(content), zlib.crc32(content))
    return header + CHECKSUM.pack(zlib.crc32(header)) + content


class Journal:
    """A journal that is being written.

    Parameters
    ----------
    path : of the file.
    contents : Contents, optional — of the file that is there, to go on with; a last block that was cut off is dropped.
        A new file by default.

    Raises
    ------
    ValueError
        If another process writes to the file, or it has changed since it was read.
    """

    def __init__(self, path: Path, contents: Contents | None = None):
        self.path = path
        if contents is not None and path.stat().st_size != contents.size:
            raise ValueError(f"another run has written to {path} since it was read: make a new sampler on the file")
        # locks belong to the process: within it, the last one to open the file has it
        if (earlier := _open.get(path.resolve())) is not None:
            earlier.close()
        _open[path.resolve()] = self
        self._file = open(path, "ab" if contents is None else "r+b", buffering=0)  # noqa: SIM115  as long as the run
        if lockf is not None:
            try:
                lockf(self._file, LOCK_EX | LOCK_NB)
            except OSError:
                self._file.close()
                raise ValueError(
                    f"another run is writing to {path}: wait for it or stop it, or give this one another file"
                ) from None
        self._file.truncate(0 if contents is None else contents.whole)
        self._file.seek(0, os.SEEK_END)

    @classmethod
    def create(cls, path: Path, header: dict) -> "Journal":
        """A new journal in the place of any that was there."""
        journal = cls(path)
        journal._write(MAGIC + _block(b"HEAD", json.dumps(header).encode()))
        return journal

    def close(self) -> None:
        """Close the file; nothing can be added any more."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        if self._file.closed:
            raise ValueError(f"another sampler has gone on with {self.path}: use that one, or give it another file")
        start = self._file.tell()
        try:
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            # half a block would be taken for the end, and hide what is written behind it
            self._file.truncate(start)
            self._file.seek(start)
            raise OSError(
                error.errno,
                f"the journal could not be written ({error.strerror}); what was stored before is whole: make room and "
                "run again, the run goes on from there",
                str(self.path),
            ) from error

    def _append(self, kind: bytes, content: bytes = b"") -> None:
        self._write(_block(kind, content))

    def start(self, start: Start) -> None:
        """A climb begins."""
        self._append(b"INIT", _pack_arrays([start.coords, start.log_prior, *_pack_random(start.random_state)]))

    def evaluated(self, batch: Evaluated) -> None:
        """A batch of points has been evaluated."""
        blobs = [] if batch.blobs is None else [batch.blobs]
        try:
            content = _pack_arrays([batch.coords, batch.log_prob, *blobs])
        except ValueError:
            raise ValueError(
                f"blobs of dtype {batch.blobs.dtype} cannot be stored without pickling: give blobs_dtype, or use a "
                "backend in memory"
            ) from None
        self._append(b"EVAL", content)
        if batch.reasons:
            self._append(b"FAIL", json.dumps(list(batch.reasons.items())).encode())

    def call(self, nsteps: int) -> None:
        """So many steps are wanted."""
        self._append(b"CALL", json.dumps(int(nsteps)).encode())

    def done(self) -> None:
        """The steps wanted have been made, or are not wanted any more."""
        self._append(b"DONE")

    def step(self, step: Step) -> None:
        """A step of the chain."""
        blobs = [] if step.blobs is None else [step.blobs]
        random = _pack_random(step.random_state)
        self._append(b"STEP", _pack_arrays([step.coords, step.log_prob, step.accepted, *random, *blobs]))

    def wipe(self) -> None:
        """The chain has been reset."""
        self._append(b"WIPE")


def _blocks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes, int]]:
    """Kind, content and end of every whole block."""
    place = len(MAGIC)
    while place + BEFORE_CONTENT <= len(data):
        header = data[place : place + HEADER.size]
        if CHECKSUM.unpack_from(data, place + HEADER.size)[0] != zlib.crc32(header):
            raise ValueError(_damaged(path, f"the head of the block at byte {place} does not match its checksum"))
        kind, length, checksum = HEADER.unpack(header)
        end = place + BEFORE_CONTENT + length
        if end > len(data):
            break
        content = data[place + BEFORE_CONTENT : end]
        if zlib.crc32(content) != checksum:
            raise ValueError(_damaged(path, f"the block at byte {place} does not match its checksum"))
        yield kind, content, end
        place = end


def _damaged(path: Path, what: str) -> str:
    return (
        f"{path} is damaged ({what}), so the run cannot be continued from it: restore it from a copy, or remove it to "
        "go on from the chain alone"
    )


def read_journal(path: Path) -> Contents | None:
    """Read a journal; None where there is none, or nothing had been entered when the process died.

    Raises
    ------
    ValueError
        If the file is no journal or is damaged. A last block that was cut off is not damage.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    if MAGIC.startswith(data):
        return None
    if not data.startswith(MAGIC):
        raise ValueError(_damaged(path, "it does not begin as a journal"))
    header, start, evaluated, steps, last = {}, None, [], [], None
    before_last, wanted, made, whole = 0, None, 0, len(MAGIC)
    for kind, content, end in _blocks(data, path):
        whole = end
        if kind == b"HEAD":
            header = json.loads(content)
        elif kind == b"INIT":
            coords, log_prior, *random = _unpack_arrays(content)
            start, last, wanted = Start(coords, log_prior, _unpack_random(random)), None, None
        elif kind == b"EVAL":
            coords, log_prob, *blobs = _unpack_arrays(content)
            evaluated.append(Evaluated(coords, log_prob, blobs[0] if blobs else None, {}))
        elif kind == b"FAIL":
            evaluated[-1].reasons.update({row: reason for row, reason in json.loads(content)})
        elif kind == b"CALL":
            wanted, made = json.loads(content), 0
        elif kind == b"DONE":
            wanted = None
        elif kind == b"STEP":
            coords, log_prob, accepted, keys, rest, *blobs = _unpack_arrays(content)
            last = Step(coords, log_prob, accepted, blobs[0] if blobs else None, _unpack_random([keys, rest]))
            steps.append(last)
            before_last = len(evaluated)
            made += 1
        elif kind == b"WIPE":
            steps = []
        else:
            raise ValueError(_damaged(path, f"it has a block of unknown kind {kind!r}"))
    if not header:
        return None
    return Contents(header, start, evaluated, before_last, steps, last, wanted, made, len(data), whole)
