"""What a process knows of the stored simulations of one model: its label, their generation, and how many were used."""

import copy
import os
import secrets
import threading
import uuid
import weakref
from collections import Counter, OrderedDict
from hashlib import blake2b
from typing import Any

import numpy as np

from ..simulation.label import ModelLabel, cpu_name
from ..simulation.local_pool import LocalPool
from ..simulation.model import Model
from ..simulation.opened import Opened
from .rows import StoredLabel, StoredSimulation, source_number
from .simulation_cache import SimulationCache

__all__ = ["OWN", "Trust", "shared_trust"]

OWN = 2**40  # rows compared by the label with which a generation began: it stored them itself
MAX_TRUSTS = 32

# while there is a likelihood that has it
_of_models: "weakref.WeakValueDictionary[tuple, Trust]" = weakref.WeakValueDictionary()
_by_token: "OrderedDict[str, Trust]" = OrderedDict()  # of pickled objects: copies in a process share one


class Trust:
    """Label and generation of a model in a file, and how many rows have been used since they were verified.

    It is shared by the likelihoods of one model object, by those that were derived from one, and by their copies.

    Parameters
    ----------
    label : ModelLabel
        Completed by simulations.
    is_local : bool
        Whether simulations run on this machine, so that the processor is known.
    token : str
        Identifies the object in other processes, where it starts anew.

    Attributes
    ----------
    stored : StoredLabel or None
        The label as it is in the file; None until it is known.
    generations : dict of str to int
        Generation in use for the rows of a fingerprint.
    served : Counter
        Rows used since the last full verification, per table and fingerprint.
    """

    def __init__(self, label: ModelLabel, is_local: bool, token: str) -> None:
        self.label, self.is_local, self.token = label, is_local, token
        self.stored: StoredLabel | None = None
        self._of_others: dict[int, StoredLabel] = {}  # the label for further models, by their sources in the file
        self.generations: dict[str, int] = {}
        self.served: Counter[tuple[str, str]] = Counter()
        self.restarts = 0
        self.failed_attempts = 0
        self.pause_ends, self.rows_in_pause = -np.inf, 0
        self.stale: tuple[str, Any] | None = None  # fingerprint of the row that differed, and the error
        self.simulated: dict[tuple, StoredSimulation] = {}  # of the comparison that goes on
        self._lock, self._owner = threading.RLock(), os.getpid()
        self.made_for: tuple = ()  # the model and pool, so that their ids are not reused

    def __reduce__(self) -> tuple:
        _remember(self)
        return _trust, (self.label, self.is_local, self.token)

    @property
    def lock(self) -> threading.RLock:
        """A lock that no thread of a parent process held at the time of the fork."""
        if self._owner != os.getpid():
            self._lock, self._owner = threading.RLock(), os.getpid()
        return self._lock

    @property
    def cpu(self) -> str:
        """Name of the processor; empty if simulations run on other machines."""
        return cpu_name() if self.is_local else ""

    def find(self, cache: SimulationCache, model: Model) -> StoredLabel | None:
        """The label as it is in the file; None if it is unknown there.

        Files that earlier simulations have opened are part of it, as they are now.
        """
        source = source_number(model.fingerprint)
        if self.stored is not None and source != self.stored.source:  # another length of the record, for example
            if source not in self._of_others:
                self._of_others[source] = self._add(cache, model, self.stored.generation, self.stored.compared)
            return self._of_others[source]
        if self.stored is not None:
            return self.stored
        labels = cache.labels_of(model)
        paths = {path: "" for each in labels for path in each.files}
        self.label.add(Opened(paths).read_again(), here=False)
        known = [each for each in labels if each.label == self.text_with(each.files)]
        if known:
            here = [each for each in known if each.cpu == self.cpu]
            self.stored = here[0] if here else self._add(cache, model, known[-1].generation, known[-1].compared)
            self._update(cache)
        return self.stored

    def text_with(self, files: tuple[str, ...]) -> str:
        """Text of the label, if these files were all that simulations opened."""
        known = copy.copy(self.label)
        known.opened = Opened({path: self.label.opened.files.get(path, "") for path in files})
        return known.text

    def adopt(self, cache: SimulationCache, model: Model, generation: int, compared: int) -> None:
        """Enter the label in the file as one of a generation, of which some rows were compared."""
        self._of_others.clear()
        self.stored = self._add(cache, model, generation, compared)

    def begin(self, cache: SimulationCache, model: Model, used: set[int]) -> None:
        """Begin a generation, or go on with the one that another process has begun under the same label."""
        text = f"{model.fingerprint} {self.label.text}".encode()
        generation = int.from_bytes(blake2b(text, digest_size=8).digest()) >> 2 | 1
        if generation in used:  # rows of this label that differ
            generation = secrets.randbits(62) | 1
        move = self.stored is not None
        self._of_others.clear()
        self.stored = self._add(cache, model, generation, OWN, move)
        self.generations.clear()

    def complete(self, cache: SimulationCache, opened: Opened | None) -> None:
        """Add to the label what simulations opened."""
        if self.label.add(opened):
            self._update(cache)

    def _update(self, cache: SimulationCache) -> None:
        if self.stored is not None and self.stored.label != self.label.text:
            new = {"label": self.label.text, "files": tuple(sorted(self.label.opened.files))}
            self.stored = cache.update_label(self.stored._replace(**new))
            for source, stored in self._of_others.items():
                self._of_others[source] = cache.update_label(stored._replace(**new))

    def _add(
        self, cache: SimulationCache, model: Model, generation: int, compared: int, move: bool = False
    ) -> StoredLabel:
        source = source_number(model.fingerprint)
        files = tuple(sorted(self.label.opened.files))
        new = StoredLabel(secrets.randbits(62) | 1, source, self.label.text, self.cpu, generation, compared, files)
        return cache.add_label(new, move)


def _trust(label: ModelLabel, is_local: bool, token: str) -> Trust:
    """The object of this process with a token."""
    return _by_token.get(token) or _remember(Trust(label, is_local, token))


def _remember(trust: Trust) -> Trust:
    _by_token[trust.token] = trust
    while len(_by_token) > MAX_TRUSTS:
        _by_token.popitem(last=False)
    return trust


def shared_trust(cache: SimulationCache, model: Model, pool: Any, label: ModelLabel) -> Trust:
    """The object for a file, a model object in its present state, and a pool."""
    key = (str(cache.path), cache.tolerance, cache.verify, id(model), id(pool), model.fingerprint, label.code)
    trust = _of_models.get(key)
    if trust is None:
        is_local = pool is None or isinstance(pool, LocalPool)
        trust = _of_models[key] = Trust(label, is_local, uuid.uuid4().hex)
        trust.made_for = model, pool
    return trust
