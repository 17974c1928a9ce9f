"""The HDF5 file of a chain, compared with its journal and rebuilt from it.

A process that dies while it writes can damage an HDF5 file. Therefore everything is written to the journal first, and
the file follows from it. The file is rebuilt beside the old one, which it replaces in one operation.

Attributes of the group of the chain, besides those of emcee:

``run``       name of the run, so that the journal of another run has no effect
``journal``   size of the journal [bytes] when the file was last written; a smaller journal has been truncated
``script``    the calls made so far (JSON), for a run whose journal is lost
``checksum``  number of steps and CRC-32 of their coordinates, log-probabilities and blobs
"""

import contextlib
import io
import itertools
import json
import logging
import os
import shutil
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from emcee.backends import HDFBackend

from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import Stage
from ..tempering.verdict import Verdict
from .emcee_internals import Chain, append_steps, begins_with, checksum, ends_with, read_chain
from .journal import Step
from .journal_contents import Contents, ladders
from .ladder_file import read_check, read_ladder, read_verdict, write_check, write_stage, write_verdict
from .script import Call, Script

logger = logging.getLogger(__name__)

__all__ = [
    "DAMAGE",
    "StoredRun",
    "adopt",
    "compare",
    "create_group",
    "is_unfinished",
    "ladder_differs",
    "read_run",
    "rebuild",
    "set_aside",
    "write_marks",
]

# A group as ``HDFBackend.reset`` of emcee creates it
EMCEE_ATTRIBUTES, EMCEE_DATASETS = {"version", "nwalkers", "ndim", "has_blobs", "iteration"}, 3
RUN, JOURNAL, SCRIPT, CHECKSUM = "run", "journal", "script", "checksum"
# What reading a damaged HDF5 file raises
DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError)
# Superblock of HDF5, version 0 (file format specification, section II.A): signature, version, and the end of the file
SIGNATURE, END_OF_FILE, EMPTY_SIZE = b"\x89HDF\r\n\x1a\n\0", slice(40, 48), 2048


class StoredRun(NamedTuple):
    """What the file of a chain contains.

    Attributes
    ----------
    run : str, or None
        Name of the run; None for a chain that was not made with a journal.
    journal_size : int
        Size of the journal when the file was written [bytes].
    script : list of Call
        The calls, without their steps.
    chain : Chain
        The chain.
    ladder : tuple of Stage
        The ladder.
    check : EvidenceCheck, or None
        The check of the evidence.
    verdict : Verdict, or None
        The verdict.
    intact : bool
        Whether the chain agrees with its checksum.
    marked : int
        Number of steps that the checksum covers.
    fresh : bool
        Whether the group is as emcee creates it.
    """

    run: str | None
    journal_size: int
    script: list[Call]
    chain: Chain
    ladder: tuple[Stage, ...]
    check: EvidenceCheck | None
    verdict: Verdict | None
    intact: bool
    marked: int
    fresh: bool

    @property
    def has_results(self) -> bool:
        """Whether there are stages or steps."""
        return len(self.chain.coords) > 0 or len(self.ladder) > 0


def read_run(backend: HDFBackend) -> StoredRun | None:
    """What the file of a chain contains; None without the file or its group. One of `DAMAGE` if it is damaged."""
    if not os.path.exists(backend.filename):
        return None
    plain = HDFBackend(backend.filename, backend.name, read_only=True)
    with plain.open() as file:
        if backend.name not in file:
            return None
        group = file[backend.name]
        chain, attrs = read_chain(group), group.attrs
        count, crc = (int(value) for value in attrs.get(CHECKSUM, (0, 0)))
        intact = chain.consistent and (count > len(chain.coords) or checksum(group, 0, count) == crc)
        calls = [Call(*values) for values in json.loads(attrs.get(SCRIPT, "[]"))]
        run, journal_size = attrs.get(RUN), int(attrs.get(JOURNAL, 0))
        fresh = set(attrs) == EMCEE_ATTRIBUTES and len(chain.coords) == 0 and len(group) == EMCEE_DATASETS
    extras = read_ladder(plain), read_check(plain), read_verdict(plain)
    return StoredRun(run, journal_size, calls, chain, *extras, intact, count, fresh)


def write_marks(group: h5py.Group, run: str, journal_size: int, script: Script) -> None:
    """Write the attributes that belong to the journal; see the module."""
    count, crc = (int(value) for value in group.attrs.get(CHECKSUM, (0, 0)))
    iteration = int(group.attrs["iteration"])
    if count > iteration:  # a step was removed
        count, crc = 0, 0
    group.attrs[CHECKSUM] = np.array([iteration, checksum(group, count, iteration, crc)], dtype=np.int64)
    group.attrs[RUN], group.attrs[JOURNAL] = run, journal_size
    group.attrs[SCRIPT] = json.dumps([call[:7] for call in script.calls])


def compare(stored: StoredRun, contents: Contents) -> str:
    """How the file of a chain and its journal relate.

    Returns
    -------
    {"equal", "behind", "ahead", "differs"}
        The file has the steps of the journal; fewer; more, since the journal was truncated or the chain was continued
        without it; or others, where the journal is right.
    """
    steps, n = contents.steps, len(stored.chain.coords)
    same = begins_with(stored.chain, steps[:n])
    if stored.intact and n > 0 and stored.chain.random_state is not None:
        if contents.whole < stored.journal_size:  # the journal was truncated
            if n > len(steps) or not same:
                return "ahead"
        elif same and n > max(len(steps), stored.marked):  # emcee continued the chain
            return "ahead"
    if not same or n > len(steps) or not ends_with(stored.chain, steps[:n]):
        return "differs"
    return "equal" if n == len(steps) else "behind"


def ladder_differs(stored: StoredRun, contents: Contents) -> tuple[bool, bool]:
    """Whether ladder, check or verdict differ from the journal, and whether the file never held this ladder."""
    if contents.whole < stored.journal_size:  # the journal was truncated: the file is newer
        return False, False
    ours = [_text(stored.ladder), _text(stored.check), _text(stored.verdict)]
    theirs = [_text(contents.ladder), _text(contents.check), _text(contents.verdict)]
    return ours != theirs, ours[0] not in [_text(ladder) for ladder in ladders(contents.stages)]


def _text(value: object) -> str:
    """Stages, check or verdict in a form in which NaN equals NaN."""
    return json.dumps(value)


def adopt(stored: StoredRun, contents: Contents) -> Contents:
    """Contents of a journal with the steps that only the file of the chain has."""
    chain, m = stored.chain, len(contents.steps)
    wiped = not begins_with(chain, contents.steps) or m > len(chain.coords)
    kept = [] if wiped else contents.steps
    accepted = chain.accepted - sum((s.accepted for s in kept), 0 * chain.accepted)
    adopted, after_reset = [], []
    for call in stored.script:
        after_reset = [] if call.steps is None else [*after_reset, call.made]
    shows = len(stored.script) > 0 and len(chain.coords) == sum(after_reset) + 1  # the last step only shows the state
    for i in range(len(kept), len(chain.coords)):
        blobs = None if chain.blobs is None else chain.blobs[i]
        share = accepted if i == len(kept) else np.zeros_like(accepted)  # only the sum is known
        state = ("MT19937", chain.random_state[1], *(value.item() for value in chain.random_state[2:]))
        adopted.append(Step(chain.coords[i].astype(float), chain.log_prob[i].astype(float), share, blobs, state))
    calls = [
        call._replace(last=old.last) if old is not None and old[:3] == call[:3] else call
        for call, old in itertools.zip_longest(stored.script, contents.script.calls[: len(stored.script)])
    ]
    real = [*kept, *(adopted[:-1] if shows else adopted)]
    last = real[-1] if real else contents.last
    if calls and calls[-1].steps is not None and calls[-1].made > 0:
        calls[-1] = calls[-1]._replace(last=last)
    return contents._replace(
        steps=[*kept, *adopted],
        last=last,
        before_last=len(contents.evaluated),
        provisional=adopted[-1] if shows else None,
        verdict=stored.verdict,
        script=Script(calls),
        adopted=tuple(adopted),
        wiped=wiped,
    )


def create_group(backend: HDFBackend, nwalkers: int, ndim: int, run: str) -> None:
    """An empty chain of a run in place of the group of a backend, written in one operation."""
    _replace(backend, nwalkers, ndim, run, Script())


def rebuild(backend: HDFBackend, contents: Contents, run: str) -> None:
    """The file of the chain from the journal, in one operation."""
    _replace(backend, contents.header["nwalkers"], contents.header["ndim"], run, contents.script, contents)


def _replace(
    backend: HDFBackend, nwalkers: int, ndim: int, run: str, script: Script, contents: Contents | None = None
) -> None:
    # HDF5 writes into memory: on a full disk, it could not be used any more
    image = io.BytesIO()
    with h5py.File(image, "w") as file:
        _copy_other_groups(backend, file)
        new = _OpenBackend(backend, file)
        new.reset(nwalkers, ndim)
        if contents is not None:
            _write_contents(new, contents)
        write_marks(file[new.name], run, 0 if contents is None else contents.whole, script)
    path = Path(f"{backend.filename}.new")
    try:
        path.write_bytes(image.getbuffer())
        os.replace(path, backend.filename)
    except OSError:
        path.unlink(missing_ok=True)
        raise


class _OpenBackend(HDFBackend):
    """emcee's backend for a file that is open.

    Parameters
    ----------
    backend : HDFBackend
        Backend of the same group, of which name, dtype and compression are used.
    file : h5py.File
        The file.
    """

    def __init__(self, backend: HDFBackend, file: h5py.File):
        dtype = backend.dtype if backend.dtype_set else None
        super().__init__(backend.filename, backend.name, False, dtype, backend.compression, backend.compression_opts)
        self._file = file

    def open(self, mode: str = "r") -> contextlib.AbstractContextManager[h5py.File]:
        """emcee's: the open file, which stays open."""
        return contextlib.nullcontext(self._file)


def _write_contents(new: _OpenBackend, contents: Contents) -> None:
    """Write the contents of a journal to an empty group."""
    steps = contents.steps
    if steps:
        new.grow(len(steps), steps[0].blobs)
        with new.open() as file:
            append_steps(file[new.name], steps, np.zeros(contents.header["nwalkers"]))
    for index, stage in enumerate(contents.ladder):
        write_stage(new, index, stage)
    if contents.check is not None:
        write_check(new, contents.check)
    if contents.verdict is not None:
        write_verdict(new, contents.verdict)


def _copy_other_groups(backend: HDFBackend, new: h5py.File) -> None:
    """Copy what the file contains besides the group of a backend to a new file, object by object."""
    if not os.path.exists(backend.filename):
        return
    top = backend.name.strip("/").split("/")[0]
    try:
        with h5py.File(backend.filename, "r") as file:
            for name in file:
                if name != top or name != backend.name.strip("/"):
                    file.copy(name, new)
            if backend.name in new:
                del new[backend.name]
    except BlockingIOError:
        raise
    except DAMAGE as error:
        for name in list(new):
            del new[name]
        aside = set_aside(backend.filename, copy=True)
        logger.warning("the other groups of %s cannot be read (%s): kept as %s", backend.filename, error, aside)


def is_unfinished(filename: str) -> bool:
    """Whether a process died while it created an HDF5 file: nothing is in it, or its header is still of an empty file.

    HDF5 writes the header of an empty file first, then the content, and the header with the end of the file last.
    """
    try:
        with open(filename, "rb") as file:
            header = file.read(END_OF_FILE.stop)
    except OSError:  # a folder, or a file that may not be read
        return False
    return not header or (
        header.startswith(SIGNATURE)
        and len(header) == END_OF_FILE.stop
        and int.from_bytes(header[END_OF_FILE], "little") <= EMPTY_SIZE
    )


def set_aside(filename: str, copy: bool = False) -> str:
    """Rename or copy a file that is not right to a name that is not in use, and return the name."""
    names = itertools.chain([f"{filename}.damaged"], (f"{filename}.damaged-{i}" for i in itertools.count(2)))
    aside = next(name for name in names if not os.path.exists(name))
    if copy:
        shutil.copy(filename, aside)
    else:
        os.replace(filename, aside)
    return aside
