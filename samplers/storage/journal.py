"""The journal of a run: evaluations and stored steps, appended to one file, so that a killed run loses nothing.

A journal is a sequence of blocks: kind, length and CRC-32 of the content, CRC-32 of these three, content. A block is
written in one piece and never changed. So whatever kills the process can leave only the last block incomplete, which is
then dropped. Arrays are stored in NumPy's own format, texts as JSON; nothing is pickled::

    HEAD  what is sampled and how (JSON)
    INIT  start of the annealing: draws of the prior, their log-prior, state of the random generator
    EVAL  points, and what ``log_prob_fn`` returned for them (NaN where it failed)
    FAIL  why evaluations failed (JSON), for the block before
    MEMO  arrays that a guide has stored, after their key and the number of simulations that guides have made by then
    CALL  number of steps at beta = 1 that a call asks for (JSON)
    STEP  a stored step: points, log-probabilities, acceptance, blobs, state of the random generator
    DONE  the call is complete
    HALT  the limit of simulations ended the call (JSON): whether a step follows that only shows the state and will be
          replaced when the run goes on
    BACK  this step has been removed
    WIPE  the chain was reset

A journal survives the death of the process. It is not forced to the disk, so a power failure can lose the last seconds.
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
except ImportError:  # without such locks, two runs on one file are not detected
    lockf = None

__all__ = [
    "Contents",
    "EvaluatedBatch",
    "Journal",
    "RunStart",
    "Step",
    "describe_damage",
    "merge_batches",
    "read_journal",
]

MAGIC = b"samplers journal 1\n"
HEADER = struct.Struct("<4sQI")
CHECKSUM = struct.Struct("<I")
BEFORE_CONTENT = HEADER.size + CHECKSUM.size


_open: "weakref.WeakValueDictionary[Path, Journal]" = weakref.WeakValueDictionary()


class RunStart(NamedTuple):
    """Start of the annealing.

    Attributes
    ----------
    coords : (n, ndim) float
        Draws of the prior.
    log_prior : (n,) float
        Their log-prior.
    random_state : tuple
        State of the random generator.
    """

    coords: np.ndarray
    log_prior: np.ndarray
    random_state: tuple


class Step(NamedTuple):
    """A step of the chain, as emcee stores it.

    Attributes
    ----------
    coords : (n, ndim) float
        Positions of the walkers.
    log_prob : (n,) float
        Their log-probabilities.
    accepted : (n,) bool
        Whether the last proposal of each walker was accepted.
    blobs : (n, ...) array, or None
        Their blobs.
    random_state : tuple
        State of the random generator after the step.
    """

    coords: np.ndarray
    log_prob: np.ndarray
    accepted: np.ndarray
    blobs: np.ndarray | None
    random_state: tuple


class EvaluatedBatch(NamedTuple):
    """Points that were evaluated together.

    Attributes
    ----------
    coords : (n, ndim) float
        The points.
    log_prob : (n,) float
        Their log-probabilities, NaN for failures.
    blobs : (n, ...) array, or None
        Their blobs.
    reasons : dict of int to str
        Reasons of failures by row.
    """

    coords: np.ndarray
    log_prob: np.ndarray
    blobs: np.ndarray | None
    reasons: dict[int, str]


def merge_batches(batches: Sequence[EvaluatedBatch]) -> EvaluatedBatch:
    """Several batches as one; at least one is needed."""
    if len(batches) == 1:
        return batches[0]
    coords, log_prob = (np.concatenate([batch[field] for batch in batches]) for field in (0, 1))
    with_blobs = [batch.blobs for batch in batches if batch.blobs is not None]
    blobs = None
    if with_blobs:
        like = with_blobs[0]
        blobs = np.concatenate(
            [np.zeros((len(b.coords), *like.shape[1:]), like.dtype) if b.blobs is None else b.blobs for b in batches]
        )
    reasons, place = {}, 0
    for batch in batches:
        reasons |= {place + row: reason for row, reason in batch.reasons.items()}
        place += len(batch.coords)
    return EvaluatedBatch(coords, log_prob, blobs, reasons)


class Contents(NamedTuple):
    """Contents of a journal.

    Attributes
    ----------
    header : dict
        As given to `Journal.create`.
    start : RunStart
        Start of the last annealing.
    evaluated : list of EvaluatedBatch
        All evaluations.
    remembered : list of (str, list of array)
        Arrays that a guide has stored, with their keys.
    before_last : int
        Number of batches that had been evaluated when `last` was stored.
    steps : list of Step
        Steps since the chain was last reset.
    last : Step, or None
        Last step since the start, even if the chain was reset after it.
    wanted : int, or None
        Number of steps that the last call asked for; None if it is complete.
    made : int
        Number of these steps that were made.
    provisional : Step, or None
        Last step, if it only shows the state of a run that its limit of simulations ended; not in `last` and `made`.
    of_earlier_guides : float
        Simulations that guides had made by themselves when the last annealing started.
    of_guides : float
        Simulations that guides have made by themselves.
    size : int
        Size of the file [bytes].
    whole : int
        Size up to the end of the last complete block [bytes].
    """

    header: dict
    start: RunStart
    evaluated: list[EvaluatedBatch]
    remembered: list[tuple[str, list[np.ndarray]]]
    before_last: int
    steps: list[Step]
    last: Step | None
    wanted: int | None
    made: int
    provisional: Step | None = None
    of_earlier_guides: float = 0.0
    of_guides: float = 0.0
    size: int = 0
    whole: int = 0


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
    """State of a RandomState, whose generator is always the Mersenne twister, as arrays."""
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
    path : Path
        The file.
    contents : Contents, optional
        Contents of an existing file, to append to; an incomplete last block is dropped. By default the file is new.

    Raises
    ------
    ValueError
        If another process is writing to the file, or the file has changed since it was read.
    """

    def __init__(self, path: Path, contents: Contents | None = None):
        self.path = path
        if contents is not None and path.stat().st_size != contents.size:
            raise ValueError(f"another run has written to {path} since it was read: make a new sampler with the file")
        # locks belong to the process: within it, the last sampler that opens the file owns it
        if (earlier := _open.get(path.resolve())) is not None:
            earlier.close()
        _open[path.resolve()] = self
        self._file = open(path, "ab" if contents is None else "r+b", buffering=0)  # noqa: SIM115  open during the run
        if lockf is not None:
            try:
                lockf(self._file, LOCK_EX | LOCK_NB)
            except OSError:
                self._file.close()
                raise ValueError(
                    f"another run is writing to {path}: wait for it or stop it, or give this run another file"
                ) from None
        self._file.truncate(0 if contents is None else contents.whole)
        self._file.seek(0, os.SEEK_END)

    @classmethod
    def create(cls, path: Path, header: dict) -> "Journal":
        """A new journal, which replaces an existing one."""
        journal = cls(path)
        journal._write(MAGIC + _block(b"HEAD", json.dumps(header).encode()))
        return journal

    def close(self) -> None:
        """Close the file; nothing can be appended afterwards."""
        self._file.close()

    def _write(self, data: bytes) -> None:
        if self._file.closed:
            raise ValueError(f"another sampler has continued {self.path}: use that one, or give it another file")
        start = self._file.tell()
        try:
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except OSError as error:
            # an incomplete block would be taken for the end, and hide what is written after it
            self._file.truncate(start)
            self._file.seek(start)
            raise OSError(
                error.errno,
                f"the journal could not be written ({error.strerror}). Everything stored before is intact: free "
                "some disk space and run again; the run continues from there",
                str(self.path),
            ) from error

    def _append(self, kind: bytes, content: bytes = b"") -> None:
        self._write(_block(kind, content))

    def start(self, start: RunStart) -> None:
        """Enter the start of the annealing."""
        self._append(b"INIT", _pack_arrays([start.coords, start.log_prior, *_pack_random(start.random_state)]))

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points."""
        blobs = [] if batch.blobs is None else [batch.blobs]
        try:
            content = _pack_arrays([batch.coords, batch.log_prob, *blobs])
        except ValueError:
            raise ValueError(
                f"blobs of dtype {batch.blobs.dtype} cannot be stored without pickling: pass blobs_dtype, or use a "
                "backend in memory"
            ) from None
        self._append(b"EVAL", content)
        if batch.reasons:
            self._append(b"FAIL", json.dumps(list(batch.reasons.items())).encode())

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores, and the number of simulations that guides have made by then."""
        name, count = np.frombuffer(key.encode(), dtype=np.uint8), np.array([of_guides], dtype=float)
        self._append(b"MEMO", _pack_arrays([name, count, *arrays]))

    def call(self, nsteps: int) -> None:
        """Enter the number of steps that a call asks for."""
        self._append(b"CALL", json.dumps(int(nsteps)).encode())

    def done(self) -> None:
        """Enter that the call is complete, or was ended by the user."""
        self._append(b"DONE")

    def halt(self, shows: bool) -> None:
        """Enter that the limit of simulations ended the call; `shows`: the next step only shows the state."""
        self._append(b"HALT", json.dumps(shows).encode())

    def back(self) -> None:
        """Enter that the last step, which only showed the state, has been removed."""
        self._append(b"BACK")

    def step(self, step: Step) -> None:
        """Enter a step of the chain."""
        blobs = [] if step.blobs is None else [step.blobs]
        random = _pack_random(step.random_state)
        self._append(b"STEP", _pack_arrays([step.coords, step.log_prob, step.accepted, *random, *blobs]))

    def wipe(self) -> None:
        """Enter that the chain has been reset."""
        self._append(b"WIPE")


def _blocks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes, int]]:
    """Kind, content and end of every complete block."""
    place = len(MAGIC)
    while place + BEFORE_CONTENT <= len(data):
        header = data[place : place + HEADER.size]
        if CHECKSUM.unpack_from(data, place + HEADER.size)[0] != zlib.crc32(header):
            raise ValueError(
                describe_damage(path, f"the header of the block at byte {place} does not match its checksum")
            )
        kind, length, checksum = HEADER.unpack(header)
        end = place + BEFORE_CONTENT + length
        if end > len(data):
            break
        content = data[place + BEFORE_CONTENT : end]
        if zlib.crc32(content) != checksum:
            raise ValueError(describe_damage(path, f"the block at byte {place} does not match its checksum"))
        yield kind, content, end
        place = end


def describe_damage(path: Path, what: str) -> str:
    """The message of the error for a damaged journal."""
    return (
        f"{path} is damaged ({what}), so the run cannot be continued from it: restore it from a copy; or remove it to "
        "continue from the chain alone; or remove it and the file of the chain to start again, where simulations that "
        "are in a cache on disk are not repeated"
    )


def read_journal(path: Path) -> Contents | None:
    """Read a journal; None if there is none, or if the process died before it had entered the start of the annealing.

    Raises
    ------
    ValueError
        If the file is not a journal, or is damaged. An incomplete last block is not damage.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    if MAGIC.startswith(data):
        return None
    if not data.startswith(MAGIC):
        raise ValueError(describe_damage(path, "it does not start like a journal"))
    header, start, evaluated, remembered, steps, last = {}, None, [], [], [], None
    before_last, wanted, made, whole = 0, None, 0, len(MAGIC)
    shows, provisional, of_earlier_guides, of_guides = False, None, 0.0, 0.0
    for kind, content, end in _blocks(data, path):
        whole = end
        if kind == b"HEAD":
            header = json.loads(content)
        elif kind == b"INIT":
            coords, log_prior, *random = _unpack_arrays(content)
            start, last, wanted = RunStart(coords, log_prior, _unpack_random(random)), None, None
            shows, provisional, of_earlier_guides = False, None, of_guides
        elif kind == b"EVAL":
            coords, log_prob, *blobs = _unpack_arrays(content)
            evaluated.append(EvaluatedBatch(coords, log_prob, blobs[0] if blobs else None, {}))
        elif kind == b"FAIL":
            evaluated[-1].reasons.update({row: reason for row, reason in json.loads(content)})
        elif kind == b"MEMO":
            key, count, *arrays = _unpack_arrays(content)
            remembered.append((key.tobytes().decode(), arrays))
            of_guides = max(of_guides, float(count.item()))
        elif kind == b"CALL":
            wanted, made, shows = json.loads(content), 0, False
        elif kind == b"DONE":
            wanted = None
        elif kind == b"STEP":
            coords, log_prob, accepted, keys, rest, *blobs = _unpack_arrays(content)
            step = Step(coords, log_prob, accepted, blobs[0] if blobs else None, _unpack_random([keys, rest]))
            steps.append(step)
            if shows:
                shows, provisional = False, step
            else:
                last, before_last, made = step, len(evaluated), made + 1
        elif kind == b"HALT":
            shows = json.loads(content)
        elif kind == b"BACK":
            provisional, steps = None, steps[:-1]
        elif kind == b"WIPE":
            steps, provisional = [], None
        else:
            raise ValueError(describe_damage(path, f"it has a block of unknown kind {kind!r}"))
    if start is None:
        return None
    return Contents(
        header,
        start,
        evaluated,
        remembered,
        before_last,
        steps,
        last,
        wanted,
        made,
        provisional,
        of_earlier_guides,
        of_guides,
        len(data),
        whole,
    )
