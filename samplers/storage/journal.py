"""The journal of a run: evaluations, stages and stored steps, appended to one file, so that a killed run loses nothing.

A journal is a sequence of blocks: kind, length and CRC-32 of the content, CRC-32 of these three, content. A block is
written in one piece and never changed, and holds one fact as a whole. So whatever kills the process can leave only the
last block incomplete, which is then dropped. Arrays are stored in NumPy's own format, texts as JSON; nothing is
pickled::

    HEAD  what is sampled and how (JSON)
    INIT  start of an annealing: draws of the prior, their log-prior, state of the random generator
    EVAL  points, what ``log_prob_fn`` returned for them (NaN where it failed), and why evaluations failed (JSON)
    MEMO  arrays that a guide has stored, after their key and the number of simulations that guides have made by then
    STAG  a tempering stage, after its place in the ladder (JSON); it replaces later stages
    CHCK  the check of the evidence (JSON)
    VERD  the verdict (JSON)
    CALL  a call of the sampler: its place in the script, the steps at beta = 1 that it asks for, what it starts from,
          options (JSON)
    MORE  the call at this place of the script (JSON) goes on, although others were made after it, or by another call of
          the script, the number of which follows
    PASS  a complete call that stores no steps: as CALL, and its last state in the form of STEP
    STEP  a stored step: points, log-probabilities, acceptance, blobs, state of the random generator
    DONE  the call is complete
    HALT  the limit of simulations ended the call (JSON): whether a step follows that only shows the state and will be
          replaced when the run goes on
    BACK  this step has been removed
    WIPE  the chain was reset: the place of the reset in the script (JSON)

A journal appears under its name with its first two blocks, HEAD and INIT, as a whole. It survives the death of the
process. It is not forced to the disk, so a power failure can lose the last seconds.
"""

import io
import json
import os
import struct
import weakref
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .file_lock import FileLock

__all__ = [
    "BEFORE_CONTENT",
    "CHECKSUM",
    "HEADER",
    "MAGIC",
    "EvaluatedBatch",
    "Journal",
    "RunStart",
    "Step",
    "lock_path",
    "merge_batches",
    "unpack_arrays",
    "unpack_random",
]

MAGIC = b"samplers journal 3\n"
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

    def after(self, first: int) -> "EvaluatedBatch":
        """The points after the `first` ones."""
        blobs = None if self.blobs is None else self.blobs[first:]
        reasons = {row - first: reason for row, reason in self.reasons.items() if row >= first}
        return EvaluatedBatch(self.coords[first:], self.log_prob[first:], blobs, reasons)


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


def _pack_arrays(arrays: Sequence[np.ndarray]) -> bytes:
    content = io.BytesIO()
    for array in arrays:
        np.lib.format.write_array(content, np.ascontiguousarray(array), allow_pickle=False)
    return content.getvalue()


def unpack_arrays(content: bytes) -> list[np.ndarray]:
    """Arrays from the content of a block."""
    stream, arrays = io.BytesIO(content), []
    while stream.tell() < len(content):
        arrays.append(np.lib.format.read_array(stream, allow_pickle=False))
    return arrays


def _pack_random(state: Sequence[Any]) -> list[np.ndarray]:
    """State of a RandomState, whose generator is always the Mersenne twister, as arrays."""
    _, keys, position, has_gauss, cached = state
    return [np.asarray(keys, dtype=np.uint32), np.array([position, has_gauss, cached], dtype=float)]


def unpack_random(arrays: Sequence[np.ndarray]) -> tuple:
    """State of a RandomState from its two arrays."""
    keys, (position, has_gauss, cached) = arrays
    return "MT19937", keys, int(position), int(has_gauss), float(cached)


def _pack_text(value: Any) -> np.ndarray:
    """Data as JSON in an array of bytes, to be stored with other arrays."""
    return np.frombuffer(json.dumps(value).encode(), dtype=np.uint8)


def lock_path(journal: Path) -> Path:
    """The file whose lock belongs to the process that writes a journal."""
    return journal.with_suffix(".lock")


def _block(kind: bytes, content: bytes) -> bytes:
    header = HEADER.pack(kind, len(content), zlib.crc32(content))
    return header + CHECKSUM.pack(zlib.crc32(header)) + content


class Journal:
    """A journal that is being written.

    Parameters
    ----------
    path : Path
        The file, which exists.
    size : int
        Its size when it was read [bytes].
    whole : int
        Size up to the end of its last complete block [bytes]; the rest is dropped.

    Raises
    ------
    ValueError
        If another process is writing to the file, or the file has changed since it was read.
    """

    def __init__(self, path: Path, size: int, whole: int):
        self.path = path
        # locks belong to the process: within it, the last sampler that opens the file owns it
        earlier = _open.get(path.resolve())
        self._lock = FileLock(lock_path(path))
        if path.stat().st_size != size:
            self._lock.release()
            raise ValueError(f"another run has written to {path} since it was read: make a new sampler with the file")
        if earlier is not None:
            earlier.close()
        _open[path.resolve()] = self
        self._file = open(path, "r+b", buffering=0)  # noqa: SIM115  open during the run
        self._file.truncate(whole)
        self._file.seek(0, os.SEEK_END)

    @classmethod
    def create(cls, path: Path, header: dict, start: RunStart) -> "Journal":
        """A new journal, which replaces an existing one as a whole."""
        data = MAGIC + _block(b"HEAD", json.dumps(header).encode()) + _block(b"INIT", _pack_start(start))
        new = path.with_name(path.name + ".new")
        new.write_bytes(data)
        os.replace(new, path)
        return cls(path, len(data), len(data))

    @property
    def size(self) -> int:
        """Size of the file [bytes]."""
        return self._file.tell()

    def close(self) -> None:
        """Close the file; nothing can be appended afterwards."""
        self._file.close()
        self._lock.release()

    def _write(self, data: bytes) -> None:
        if self._file.closed:
            raise ValueError(f"another sampler has continued {self.path}: use that one, or give it another file")
        start = self._file.tell()
        try:
            written = 0
            while written < len(data):
                written += self._file.write(data[written:])
        except BaseException as error:
            # an incomplete block would be taken for the end, and hide what is written after it
            self._file.truncate(start)
            self._file.seek(start)
            if not isinstance(error, OSError):  # Ctrl-C
                raise
            raise OSError(
                error.errno,
                f"the journal could not be written ({error.strerror}). Everything stored before is intact: free "
                "some disk space and run again; the run continues from there",
                str(self.path),
            ) from error

    def _append(self, kind: bytes, content: bytes = b"") -> None:
        self._write(_block(kind, content))

    def start(self, start: RunStart) -> None:
        """Enter the start of another annealing."""
        self._append(b"INIT", _pack_start(start))

    def evaluated(self, batch: EvaluatedBatch) -> None:
        """Enter a batch of evaluated points with its failures."""
        blobs = [] if batch.blobs is None else [batch.blobs]
        reasons = _pack_text(list(batch.reasons.items()))
        try:
            content = _pack_arrays([batch.coords, batch.log_prob, reasons, *blobs])
        except ValueError:
            raise ValueError(
                f"blobs of dtype {batch.blobs.dtype} cannot be stored without pickling: pass blobs_dtype, or use a "
                "backend in memory"
            ) from None
        self._append(b"EVAL", content)

    def remembered(self, key: str, arrays: Sequence[np.ndarray], of_guides: float) -> None:
        """Enter arrays that a guide stores, and the number of simulations that guides have made by then."""
        name, count = np.frombuffer(key.encode(), dtype=np.uint8), np.array([of_guides], dtype=float)
        self._append(b"MEMO", _pack_arrays([name, count, *arrays]))

    def stage(self, index: int, stage: Stage) -> None:
        """Enter a stage at its place in the ladder."""
        self._append_text(b"STAG", [index, *stage])

    def check(self, check: EvidenceCheck) -> None:
        """Enter the check of the evidence."""
        self._append_text(b"CHCK", check)

    def verdict(self, verdict: Verdict) -> None:
        """Enter the verdict."""
        self._append_text(b"VERD", verdict)

    def call(self, index: int, nsteps: int, begin: str, options: str) -> None:
        """Enter a call: its place in the script, the steps that it asks for, the digest of where it starts, options."""
        self._append_text(b"CALL", [index, nsteps, begin, options])

    def more(self, index: int, again: int) -> None:
        """Enter that the call at a place of the script goes on, and how many calls of a process went on with it."""
        self._append_text(b"MORE", [index, again])

    def passed(self, index: int, nsteps: int, begin: str, options: str, last: Step) -> None:
        """Enter a call that stores no steps, and its last state."""
        self._append(b"PASS", _pack_arrays([_pack_text([index, nsteps, begin, options]), *_step_arrays(last)]))

    def done(self) -> None:
        """Enter that the call is complete."""
        self._append(b"DONE")

    def halt(self, shows: bool) -> None:
        """Enter that the limit of simulations ended the call; `shows`: the next step only shows the state."""
        self._append_text(b"HALT", shows)

    def back(self) -> None:
        """Enter that the last step, which only showed the state, has been removed."""
        self._append(b"BACK")

    def step(self, step: Step) -> None:
        """Enter a step of the chain."""
        self._append(b"STEP", _pack_arrays(_step_arrays(step)))

    def wipe(self, index: int) -> None:
        """Enter that the chain has been reset: the place of the reset in the script."""
        self._append_text(b"WIPE", index)

    def _append_text(self, kind: bytes, value: Any) -> None:
        self._append(kind, json.dumps(value, default=lambda number: number.item()).encode())


def _step_arrays(step: Step) -> list[np.ndarray]:
    blobs = [] if step.blobs is None else [step.blobs]
    return [step.coords, step.log_prob, step.accepted, *_pack_random(step.random_state), *blobs]


def _pack_start(start: RunStart) -> bytes:
    return _pack_arrays([start.coords, start.log_prior, *_pack_random(start.random_state)])
