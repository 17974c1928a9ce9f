"""Model labels in a file, the generation of rows that each label belongs to, and which rows a process trusts.

A generation contains the simulations of one state of a model's code. It may have several labels, which gave equal
results when they were compared (`fe_likelihoods.cache.verification`).
"""

import json
import os
import secrets
import threading
import zlib
from collections import Counter, OrderedDict
from collections.abc import Iterable
from hashlib import blake2b
from typing import Any, NamedTuple

import numpy as np

from ..simulation.files import Opened
from ..simulation.label import ModelLabel, cpu_name
from .comparison import VerifyingRun
from .file import CacheFile
from .rows import source_number

__all__ = ["StoredLabel", "Trust", "labels_of", "trust_of"]

OWN = 2**40  # `compared` of the label with which a generation began, whose rows need no comparison
MAX_TRUSTS = 32


class StoredLabel(NamedTuple):
    """A label under which simulations of a model were stored or adopted."""

    id: int
    source: int  # number of the model
    code: str  # see `fe_likelihoods.simulation.label.ModelLabel`
    files: dict[str, str]  # that simulations opened, with their digests
    generation: int
    compared: int  # rows that were compared before the rows of other labels were adopted

    def packed(self) -> tuple:
        """The values of the columns, the checksum last."""
        files = json.dumps(self.files, sort_keys=True).encode()
        values = self.id, self.source, self.code.encode(), files, self.generation, self.compared
        return (*values, zlib.crc32(repr(values).encode()))


def labels_of(file: CacheFile, source: int) -> list[StoredLabel]:
    """Labels under which the simulations of a model were stored or adopted."""
    query = "SELECT id, source, code, files, generation, compared, crc FROM labels WHERE source = ? ORDER BY rowid"
    rows = [row[:-1] for row in file.select(query, (source,)) if row[-1] == zlib.crc32(repr(row[:-1]).encode())]
    return [StoredLabel(*row[:2], row[2].decode(), json.loads(row[3]), *row[4:]) for row in rows]


class Trust:
    """Label and generation of a model in a file, and which rows are trusted in this process.

    All likelihoods of this process with the same `key` share it (`trust_of`). `cpu` is the number of the processor, 0
    if simulations run on other machines. `stored` has the labels in the file, by the source numbers of models;
    `generations` are in use for the rows of a fingerprint; `served` and `verified` count rows that were used and
    compared, by fingerprint and whether any row is a success; rows with the number of the `session` were stored here
    and need no verification; `stale` is the error of a row that differed.
    """

    def __init__(self, label: ModelLabel, is_local: bool, key: str) -> None:
        self.label, self.is_local, self.key = label, is_local, key
        self.cpu = zlib.crc32(cpu_name().encode()) if is_local else 0
        self.stored: dict[int, StoredLabel] = {}
        self.generations: dict[str, int] = {}
        self.pause_ends = -np.inf  # of the time in which nothing is verified, since no new simulation ended [s]
        self._lock, self._owner = threading.RLock(), os.getpid()
        self.start_again()

    def __reduce__(self) -> tuple:
        _remember(self)
        return trust_of, (self.label, self.is_local, self.key)

    @property
    def lock(self) -> threading.RLock:
        """Lock of this process; replaced after a fork, when another thread of the parent may have held it."""
        if self._owner != os.getpid():
            self._lock, self._owner, self.session = threading.RLock(), os.getpid(), secrets.randbits(62)
        return self._lock

    def start_again(self) -> None:
        """Verify all rows again, including rows that this process has stored."""
        self.served: Counter[tuple[str, bool]] = Counter()
        self.verified: Counter[tuple[str, bool]] = Counter()
        self.stale: Any = None
        self.session = secrets.randbits(62)

    def find(self, file: CacheFile, run: VerifyingRun) -> StoredLabel | None:
        """The label in the file, with the present contents of the files that simulations opened; None if unknown.

        The file is read once for each request.
        """
        source = source_number(run.fingerprint)
        if source not in self.stored and not run.has_no_label:
            labels = labels_of(file, source)
            for each in labels:
                self.label.add(Opened(each.files).read_again(), here=False)
            same = [each for each in labels if each.code == self.label.code]
            known = [each for each in same if Opened(each.files).read_again().files == each.files]
            if known:
                self.stored[source] = max(known, key=lambda each: each.compared)
                self.save(file)
            elif self.stored:  # another length of the record, for example
                other = next(iter(self.stored.values()))
                self.put(file, {source}, other.generation, other.compared)
            run.has_no_label = source not in self.stored
        return self.stored.get(source)

    def put(self, file: CacheFile, sources: Iterable[int], generation: int, compared: int) -> None:
        """Add the label of some models to a generation in the file, after `compared` of its rows were compared."""
        ids = {source: self.stored[source].id if source in self.stored else secrets.randbits(62) for source in sources}
        self.save(file, [StoredLabel(ids[source], source, "", {}, generation, compared) for source in ids])

    def begin(self, file: CacheFile, fingerprint: str, used: set[int]) -> None:
        """Begin a generation, or continue the generation that another process has begun under the same label."""
        text = f"{self.label.code} {sorted(self.label.opened.items().items())}".encode()
        generation = int.from_bytes(blake2b(text, digest_size=8).digest()) >> 2 | 1
        if generation in used:  # it contains rows that differ
            generation = secrets.randbits(62) | 1
        self.put(file, {*self.stored, source_number(fingerprint)}, generation, OWN)
        self.generations.clear()

    def save(self, file: CacheFile, labels: Iterable[StoredLabel] = ()) -> None:
        """Store labels, or all known ones, with the present code and files, where these differ from what is stored."""
        now = {"code": self.label.code, "files": self.label.opened.files}
        new = [each._replace(**now) for each in labels or self.stored.values()]
        new = [each for each in new if self.stored.get(each.source) != each]
        self.stored |= {each.source: each for each in new}
        rows = [each.packed() for each in new]
        delete = "DELETE FROM labels WHERE id = ? OR (source = ? AND code = ? AND files = ?)"
        insert = "INSERT INTO labels (id, source, code, files, generation, compared, crc) VALUES (?, ?, ?, ?, ?, ?, ?)"
        if rows:
            file.write((delete, [row[:4] for row in rows]), (insert, rows))


_trusts: "OrderedDict[str, Trust]" = OrderedDict()  # of this process by key, the most recently used last


def trust_of(label: ModelLabel, is_local: bool, key: str) -> Trust:
    """The object of this process with a key; a new one the first time."""
    return _remember(_trusts.get(key) or Trust(label, is_local, key))


def _remember(trust: Trust) -> Trust:
    _trusts[trust.key] = trust
    _trusts.move_to_end(trust.key)
    while len(_trusts) > MAX_TRUSTS:
        _trusts.popitem(last=False)
    return trust
