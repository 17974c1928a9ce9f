"""What a journal contains, read from its blocks (`samplers.storage.journal`)."""

import json
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .journal import (
    BEFORE_CONTENT,
    CHECKSUM,
    HEADER,
    MAGIC,
    EvaluatedBatch,
    RunStart,
    Step,
    unpack_arrays,
    unpack_random,
)
from .script import Script

__all__ = ["Contents", "StoredStep", "as_verdict", "ladders", "read_call", "read_journal"]


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
    before_start : int
        Number of batches that had been evaluated when the last annealing began.
    before_last : int
        Number of batches that had been evaluated when `last` was stored.
    steps : list of Step
        Steps since the chain was last reset.
    last : Step, or None
        Last step since the start, even if the chain was reset after it; also of a call that stores no steps.
    script : Script
        The calls, none of them repeated yet.
    annealings : int
        Number of annealings that have begun.
    stages : list of (int, Stage)
        Stages of the last annealing with their places in the ladder, in the order in which they were stored.
    check : EvidenceCheck, or None
        Check of the evidence of the last annealing.
    verdict : Verdict, or None
        Verdict on the last annealing.
    provisional : Step, or None
        Last step, if it only shows the state of a run that its limit of simulations ended; not in `last` and `script`.
    of_earlier_guides : float
        Simulations that guides had made by themselves when the last annealing started.
    of_guides : float
        Simulations that guides have made by themselves.
    size : int
        Size of the file [bytes].
    whole : int
        Size up to the end of the last complete block [bytes].
    adopted : list of Step
        The last of `steps`, which are in the file of the chain only.
    wiped : bool
        Whether the journal is to record a reset of the chain before `adopted`.
    """

    header: dict
    start: RunStart
    evaluated: list[EvaluatedBatch]
    remembered: list
    before_start: int
    before_last: int
    steps: list[Step]
    last: Step | None
    script: Script
    annealings: int = 1
    stages: Sequence = ()
    check: EvidenceCheck | None = None
    verdict: Verdict | None = None
    provisional: Step | None = None
    of_earlier_guides: float = 0.0
    of_guides: float = 0.0
    size: int = 0
    whole: int = 0
    adopted: Sequence = ()
    wiped: bool = False

    @property
    def ladder(self) -> tuple[Stage, ...]:
        """The ladder as stored last."""
        return ladders(self.stages)[-1]

    @property
    def evaluations(self) -> int:
        """Number of evaluated points."""
        return sum(len(batch.coords) for batch in self.evaluated)


def ladders(stages: Sequence[tuple[int, Stage]]) -> list[tuple[Stage, ...]]:
    """The ladder before the first and after every stored stage."""
    states: list[tuple[Stage, ...]] = [()]
    for index, stage in stages:
        states.append((*states[-1][:index], stage))
    return states


def _blocks(data: bytes, path: Path) -> Iterator[tuple[bytes, bytes, int]]:
    """Kind, content and end of every complete block."""
    place = len(MAGIC)
    while place + BEFORE_CONTENT <= len(data):
        header = data[place : place + HEADER.size]
        if CHECKSUM.unpack_from(data, place + HEADER.size)[0] != zlib.crc32(header):
            raise ValueError(
                _describe_damage(path, f"the header of the block at byte {place} does not match its checksum")
            )
        kind, length, checksum = HEADER.unpack(header)
        end = place + BEFORE_CONTENT + length
        if end > len(data):
            break
        content = data[place + BEFORE_CONTENT : end]
        if zlib.crc32(content) != checksum:
            raise ValueError(_describe_damage(path, f"the block at byte {place} does not match its checksum"))
        yield kind, content, end
        place = end


def _describe_damage(path: Path, what: str) -> str:
    return (
        f"{path} is damaged ({what}), so the run cannot be continued from it: restore it from a copy; or remove it to "
        "continue from the chain alone; or remove it and the file of the chain to start again, where simulations that "
        "are in a cache on disk are not repeated"
    )


class _Reader:
    """Collects the blocks of a journal."""

    def __init__(self):
        self.header: dict = {}
        self.start: RunStart | None = None
        self.evaluated: list[EvaluatedBatch] = []
        self.remembered: list[tuple[str, list]] = []
        self.before_start = self.before_last = self.annealings = 0
        self.steps: list[Step] = []
        self.last: Step | None = None
        self.script = Script()
        self.stages: list[tuple[int, Stage]] = []
        self.check: EvidenceCheck | None = None
        self.verdict: Verdict | None = None
        self.shows, self.provisional = False, None
        self.of_earlier_guides = self.of_guides = 0.0

    def enter_head(self, content: bytes) -> None:
        self.header = json.loads(content)

    def enter_init(self, content: bytes) -> None:
        coords, log_prior, *random = unpack_arrays(content)
        self.start, self.last = RunStart(coords, log_prior, unpack_random(random)), None
        self.stages, self.check, self.verdict = [], None, None
        self.shows, self.provisional, self.of_earlier_guides = False, None, self.of_guides
        self.before_start = self.before_last = len(self.evaluated)
        self.annealings += 1

    def enter_eval(self, content: bytes) -> None:
        coords, log_prob, reasons, *blobs = unpack_arrays(content)
        reasons = {row: reason for row, reason in json.loads(reasons.tobytes())}
        self.evaluated.append(EvaluatedBatch(coords, log_prob, blobs[0] if blobs else None, reasons))

    def enter_memo(self, content: bytes) -> None:
        key, count, *arrays = unpack_arrays(content)
        self.remembered.append((key.tobytes().decode(), arrays))
        self.of_guides = max(self.of_guides, float(count.item()))

    def enter_stag(self, content: bytes) -> None:
        index, *values = json.loads(content)
        self.stages.append((index, Stage(*values)))
        self.check = None

    def enter_chck(self, content: bytes) -> None:
        self.check = EvidenceCheck(*json.loads(content))

    def enter_verd(self, content: bytes) -> None:
        self.verdict = as_verdict(json.loads(content))

    def enter_call(self, content: bytes) -> None:
        self._begin_call(*json.loads(content))

    def _begin_call(self, index: int, nsteps: int, begin: str, options: str) -> None:
        self.script.position = index
        self.script.begin(nsteps, begin, self.annealings, options)
        self.shows = False

    def enter_more(self, content: bytes) -> None:
        self.script.position, again = json.loads(content)
        self.script.go_on(again)

    def enter_pass(self, content: bytes) -> None:
        call, *arrays = unpack_arrays(content)
        self._begin_call(*json.loads(call.tobytes()))
        self.last, self.before_last = _as_step(arrays), len(self.evaluated)
        self.script.finish(self.last)

    def enter_done(self, content: bytes) -> None:
        self.script.complete()

    def enter_step(self, content: bytes) -> None:
        step = _as_step(unpack_arrays(content))
        self.steps.append(step)
        if self.shows:
            self.shows, self.provisional = False, step
        else:
            self.last, self.before_last = step, len(self.evaluated)
            self.script.stepped(step)

    def enter_halt(self, content: bytes) -> None:
        self.shows = json.loads(content)

    def enter_back(self, content: bytes) -> None:
        self.provisional, self.steps = None, self.steps[:-1]

    def enter_wipe(self, content: bytes) -> None:
        self.steps, self.provisional = [], None
        self.script.position = json.loads(content)
        self.script.begin(None)

    def contents(self, size: int, whole: int) -> Contents | None:
        """What was read; None without the start of an annealing."""
        if self.start is None:
            return None
        values = {name: value for name, value in vars(self).items() if name in Contents._fields}
        values["script"] = Script(self.script.calls)
        return Contents(**values, size=size, whole=whole)


def _as_step(arrays: Sequence[np.ndarray]) -> Step:
    coords, log_prob, accepted, keys, rest, *blobs = arrays
    return Step(coords, log_prob, accepted, blobs[0] if blobs else None, unpack_random([keys, rest]))


READERS = {
    b"HEAD": _Reader.enter_head,
    b"INIT": _Reader.enter_init,
    b"EVAL": _Reader.enter_eval,
    b"MEMO": _Reader.enter_memo,
    b"STAG": _Reader.enter_stag,
    b"CHCK": _Reader.enter_chck,
    b"VERD": _Reader.enter_verd,
    b"CALL": _Reader.enter_call,
    b"MORE": _Reader.enter_more,
    b"PASS": _Reader.enter_pass,
    b"STEP": _Reader.enter_step,
    b"DONE": _Reader.enter_done,
    b"HALT": _Reader.enter_halt,
    b"BACK": _Reader.enter_back,
    b"WIPE": _Reader.enter_wipe,
}


def as_verdict(values: list[Any]) -> Verdict:
    """A verdict from JSON."""
    status, reasons, *numbers = values
    return Verdict(status, tuple(reasons), *numbers)


def read_journal(path: Path) -> Contents | None:
    """Read a journal; None if there is none, or if it ends before the start of the annealing.

    Raises
    ------
    ValueError
        If the file is not a journal, or is damaged. An incomplete last block is not damage.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return None
    reader, whole = _Reader(), len(MAGIC)
    for _, end in _read(reader, data, path):
        whole = end
    return reader.contents(len(data), whole)


def _read(reader: _Reader, data: bytes, path: Path) -> Iterator[tuple[bytes, int]]:
    """Enter every complete block; kind and end of each."""
    if MAGIC.startswith(data):
        return
    if not data.startswith(MAGIC):
        raise ValueError(_describe_damage(path, "it does not start like a journal of this version"))
    for kind, content, end in _blocks(data, path):
        if kind not in READERS:
            raise ValueError(_describe_damage(path, f"it has a block of unknown kind {kind!r}"))
        READERS[kind](reader, content)
        yield kind, end


class StoredStep(NamedTuple):
    """A stored step of a call, and the chain after it.

    Attributes
    ----------
    step : Step
        The step.
    length : int, or None
        Number of steps that the chain had with it; None if the chain was reset later.
    accepted : (n,) float, or None
        Number of accepted proposals per walker until then.
    """

    step: Step
    length: int | None
    accepted: np.ndarray | None


def read_call(path: Path, index: int) -> list[StoredStep]:
    """The stored steps of the call at a place in the script; empty without a journal."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        return []
    reader, found, accepted = _Reader(), [], 0.0
    for kind, _ in _read(reader, data, path):
        if kind == b"WIPE":
            found, accepted = [stored._replace(length=None, accepted=None) for stored in found], 0.0
        if kind == b"STEP" and reader.provisional is None:
            accepted = accepted + reader.last.accepted
        here = reader.script.position == index
        if len(reader.script.calls) <= index or (kind == b"CALL" and here):  # another call is to take its place
            found = []
        elif kind == b"STEP" and reader.provisional is None and here:
            found.append(StoredStep(reader.last, len(reader.steps), accepted))
    return found
