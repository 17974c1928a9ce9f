"""Model labels in a file, the generation of rows that each label belongs to, and their state in a process.

A generation contains the simulations of one state of a model's code. It may have several labels, which gave equal
results when they were compared (`fe_likelihoods.cache.adoption`).
"""

import contextlib
import copy
import os
import secrets
import sqlite3
import threading
import uuid
import weakref
from collections import Counter, OrderedDict
from collections.abc import Callable
from hashlib import blake2b
from typing import Any

import numpy as np

from ..simulation.label import ModelLabel, cpu_name, value_digest
from ..simulation.local_pool import LocalPool
from ..simulation.model import Model
from ..simulation.opened import Opened
from .file import CacheFile
from .rows import (
    LABEL_COLUMNS,
    STORE_LABEL,
    StoredLabel,
    is_undamaged_label,
    pack_label,
    simulation_keys,
    source_number,
    transaction,
    unpack_label,
)

__all__ = ["OWN", "Trust", "labels_of", "shared_trust"]

OWN = 2**40  # `compared` of the label with which a generation began, whose rows need no comparison
MAX_OWN_KEYS = 200_000  # keys of 16 bytes; each takes about 100 bytes in memory
MAX_TRUSTS = 32


# in the file ----------------------------------------------------------------------------------------------------------


def labels_of(file: CacheFile, source: int) -> list[StoredLabel]:
    """Labels under which the simulations of a source number were stored or adopted."""
    query = f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? ORDER BY rowid"
    rows = file.select(query, (source,))
    return [unpack_label(*row) for row in rows if is_undamaged_label(*row)]


def _enter(file: CacheFile, label: StoredLabel, move: bool) -> StoredLabel:
    """Store a label unless another process has stored it (`move`: replace its generation); return the stored label."""

    def enter(connection: sqlite3.Connection) -> StoredLabel:
        with transaction(connection):
            query = f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? AND label = ? AND cpu = ?"
            found = connection.execute(query, (label.source, label.label.encode(), label.cpu.encode())).fetchone()
            new = label
            if found is not None and is_undamaged_label(*found):
                stored = unpack_label(*found)
                new = label._replace(id=stored.id) if move else stored
                if not move and label.generation == stored.generation and label.compared > stored.compared:
                    new = stored._replace(compared=label.compared)
            connection.execute(STORE_LABEL, pack_label(new))
        return new

    with file.lock:
        return file.attempt("written", enter, label) if file.writable else label


# in the process -------------------------------------------------------------------------------------------------------


class Trust:
    """Label and generation of a model in a file, and which rows are trusted in this process.

    Likelihoods with the same file, model and pool share it (`shared_trust`), as do derived likelihoods and copies. In
    other processes, where `token` identifies it, it starts without trusted rows. `is_local`: simulations run on this
    machine, whose processor is known. `stored` is the label in the file, None until it is known; `generations` are in
    use for the rows of a fingerprint; `served` counts rows used since the last full verification, per table and
    fingerprint; `own` are keys of rows that this process has stored, which need no verification; `stale` is the
    fingerprint of a row that differed, and the error.
    """

    def __init__(self, label: ModelLabel, is_local: bool, token: str) -> None:
        self.label, self.is_local, self.token = label, is_local, token
        self.stored: StoredLabel | None = None
        self._of_others: dict[int, StoredLabel] = {}  # the label for further models, by their sources in the file
        self.generations: dict[str, int] = {}
        self.served: Counter[tuple[str, str]] = Counter()
        self.own: set[bytes] = set()
        self.pause_ends = -np.inf  # of the time in which nothing is verified, since no new simulation ended [s]
        self.stale: tuple[str, Any] | None = None
        self._lock, self._owner = threading.RLock(), os.getpid()

    def __reduce__(self) -> tuple:
        _remember(self.token, self)
        return _of_token, (self.label, self.is_local, self.token)

    @property
    def lock(self) -> threading.RLock:
        """Lock of this process; replaced after a fork, when another thread of the parent may have held it."""
        if self._owner != os.getpid():
            self._lock, self._owner = threading.RLock(), os.getpid()
        return self._lock

    @property
    def cpu(self) -> str:
        """Name of the processor; empty if simulations run on other machines."""
        return cpu_name() if self.is_local else ""

    def find(self, file: CacheFile, model: Model) -> StoredLabel | None:
        """The label in the file, with present contents of files that simulations opened; None if unknown there."""
        source = source_number(model.fingerprint)
        if self.stored is not None and source != self.stored.source:  # another length of the record, for example
            if source not in self._of_others:
                self._of_others[source] = self._add(file, model, self.stored.generation, self.stored.compared)
            return self._of_others[source]
        if self.stored is not None:
            return self.stored
        labels = labels_of(file, source)
        paths = {path: "" for each in labels for path in each.files}
        self.label.add(Opened(paths).read_again(), here=False)
        known = [each for each in labels if each.label == self._text_with(each.files)]
        if known:
            here = [each for each in known if each.cpu == self.cpu]
            self.stored = here[0] if here else self._add(file, model, known[-1].generation, known[-1].compared)
            self._update(file)
        return self.stored

    def _text_with(self, files: tuple[str, ...]) -> str:
        """Text of the label if simulations had opened exactly these files."""
        known = copy.copy(self.label)
        known.opened = Opened({path: self.label.opened.files.get(path, "") for path in files})
        return known.text

    def adopt(self, file: CacheFile, model: Model, generation: int, compared: int) -> None:
        """Add the label to a generation in the file, after `compared` of its rows were compared."""
        self._of_others.clear()
        self.stored = self._add(file, model, generation, compared)

    def begin(self, file: CacheFile, model: Model, used: set[int]) -> None:
        """Begin a generation, or continue the generation that another process has begun under the same label."""
        text = f"{model.fingerprint} {self.label.text}".encode()
        generation = int.from_bytes(blake2b(text, digest_size=8).digest()) >> 2 | 1
        if generation in used:  # it contains rows that differ
            generation = secrets.randbits(62) | 1
        move = self.stored is not None
        self._of_others.clear()
        self.stored = self._add(file, model, generation, OWN, move)
        self.generations.clear()

    def start_again(self) -> None:
        """Verify all rows again, including rows that this process has stored."""
        self.served.clear()
        self.own.clear()

    def add_own(self, thetas: np.ndarray, generation: int, *fingerprints: str) -> None:
        """Record that simulations were run and stored in this process."""
        if len(self.own) < MAX_OWN_KEYS:
            for fingerprint in fingerprints:
                self.own.update(simulation_keys(fingerprint, thetas, generation))

    def complete(self, file: CacheFile, opened: Opened | None) -> None:
        """Add what simulations opened to the label."""
        if opened is not None:
            with self.lock:
                if self.label.add(opened):
                    self._update(file)

    def _update(self, file: CacheFile) -> None:
        if self.stored is not None and self.stored.label != self.label.text:
            new = {"label": self.label.text, "files": tuple(sorted(self.label.opened.files))}
            self.stored = self.stored._replace(**new)
            self._of_others = {source: stored._replace(**new) for source, stored in self._of_others.items()}
            file.write(STORE_LABEL, [pack_label(each) for each in (self.stored, *self._of_others.values())])

    def _add(self, file: CacheFile, model: Model, generation: int, compared: int, move: bool = False) -> StoredLabel:
        files = tuple(sorted(self.label.opened.files))
        number, source = secrets.randbits(62) | 1, source_number(model.fingerprint)
        return _enter(file, StoredLabel(number, source, self.label.text, self.cpu, generation, compared, files), move)


# objects of this process, the most recently used last
_by_token: "OrderedDict[str, Trust]" = OrderedDict()  # pickled objects: all copies in a process share one object
_shared: "list[tuple[tuple, list[Callable], Trust]]" = []


def _of_token(label: ModelLabel, is_local: bool, token: str) -> Trust:
    """The object of this process with a token."""
    return _by_token.get(token) or _remember(token, Trust(label, is_local, token))


def _remember(token: str, trust: Trust) -> Trust:
    _by_token[token] = trust
    while len(_by_token) > MAX_TRUSTS:
        _by_token.popitem(last=False)
    return trust


def shared_trust(cache: Any, model: Model, pool: Any, label: ModelLabel, repeats_bits: bool) -> Trust:
    """The `Trust` of this process for a file, a model in its present state, and a pool.

    Compiled models of this library with equal values share it (`repeats_bits`: the same parameters give the same bits
    on the same processor). A model that runs user code may have a state that neither its fingerprint nor its label
    contains, so only the same model object with the same pool shares it.
    """
    is_local = pool is None or isinstance(pool, LocalPool)
    values, objects = "", [each for each in (model, pool) if each is not None]
    if is_local and repeats_bits and not label.observes:
        with contextlib.suppress(ValueError):  # a value that cannot be compared
            values, objects = value_digest(model), []
    key = str(cache.path), cache.tolerance, cache.verify, is_local, model.fingerprint, label.code, values, len(objects)
    others, found = [], Trust(label, is_local, uuid.uuid4().hex)
    for known, referred, trust in list(_shared):
        if known == key and all(refer() is each for refer, each in zip(referred, objects, strict=True)):
            stored = trust.stored  # no longer in the file if another label has replaced it
            if stored is None or stored.id in {each.id for each in labels_of(cache.file, stored.source)}:
                found = trust
        elif all(refer() is not None for refer in referred):
            others.append((known, referred, trust))
    # a new list, since another thread may search at the same time
    _shared[:] = [*others[1 - MAX_TRUSTS :], (key, [_reference(each) for each in objects], found)]
    return found


def _reference(value: Any) -> Callable[[], Any]:
    """A weak reference, or a strong reference if the class does not allow weak ones."""
    try:
        return weakref.ref(value)
    except TypeError:
        return lambda: value
