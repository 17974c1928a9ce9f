"""Which stored simulations are those of a model: some are run again and compared before the others are used.

Code and files cannot prove that the model with a declared identity still computes the same results. The model's label
(`fe_likelihoods.simulation.label`) decides how many rows are compared; numbers and powers: ``docs/parallel.rst``. Rows
belong to a generation, the simulations of one state of a model; the file says to which generation a label belongs.

* The label is known: the row stored last and a random one before the first row is used in a process, and a random one
  of every 100 rows used. A difference is an error, `StaleCache`.
* The label is unknown: `ROWS` rows that cover the parameter space. If all agree, the label is added to their generation
  (adoption). If one differs, or there are fewer rows, so that repeating them would save nothing, a new generation
  begins: the earlier rows stay in the file and are not used.

Failures are compared only if there is no successful simulation, since a changed model often fails at the same points.
"""

import json
import logging
import os
import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Iterable, Iterator
from hashlib import blake2b
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ..simulation.faults import TransientReason
from ..simulation.files import Opened
from ..simulation.label import ModelLabel
from ..simulation.model import SimulationBatch, misfit_of_responses
from .comparison import Simulated, VerifyingRun, difference_in_words, simulate_again
from .rows import (
    LABEL_COLUMNS,
    STORE_LABEL,
    CachedRows,
    Row,
    is_undamaged_label,
    pack_label,
    pack_rows,
    reason_of,
    source_number,
)
from .simulation_cache import SimulationCache

__all__ = ["ROWS", "StaleCache", "Trust", "VerifiedCache", "choose_rows"]

logger = logging.getLogger(__name__)

ROWS = 59  # find a change of 5 % of the space with 95 %: 0.95 ** 59 < 0.05
FIRST_ROWS = 2  # rows verified before the first row is used, if the label is known
ROWS_PER_VERIFICATION = 100
FIRST_COMPARED = 3  # rows in the first batch of a comparison; each further batch has three times as many as were equal
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
LARGEST_ROUNDING = 1e-4  # largest relative response difference that may come from rounding and iterations
MAX_TRUSTS = 32
DIFFER = "stored simulations of this %s differ from new ones; they stay in the file and are not used"
CHANGED = (
    "Something has changed that neither its declared identity nor its label contains, or the model does not repeat its "
    "results (make it depend on its parameters alone, for example with a fixed seed). Delete its rows with "
    "likelihood.simulator.cache.forget(*likelihood.simulator.cache_keys), or give the model a new version= (or "
    "depends_on=)"
)


class StaleCache(ValueError):
    """A stored simulation differs from a new one with the same parameters. The message says what to do.

    It is raised again, for any row, as long as rows are stored. Samplers stop (`ends_run`), since no point can be
    evaluated any more. `theta` (n_structural,) are the parameters.
    """

    ends_run = True

    def __init__(self, message: str, theta: np.ndarray) -> None:
        super().__init__(message)
        self.theta = theta

    def __reduce__(self) -> tuple:
        return type(self), (str(self), self.theta)


class Trust:
    """The label of a model, and which rows of a file this process trusts; a likelihood and its copies share one `key`.

    `generations` and `written` labels are by the source number of the model; `left` has the rows that may be used until
    the next verification, by fingerprint and whether any row is a success; `used` counts rows. Rows with the number of
    the `session` were stored here and need no verification. `stale` is the error of a row that differed; `is_blocked`
    says that rows could not be compared, since no simulation ended.
    """

    _known: "OrderedDict[str, Trust]" = OrderedDict()  # of this process, the most recently used last

    def __init__(self, label: ModelLabel, key: str) -> None:
        self.label, self.key = label, key
        self.generations: dict[int, int] = {}
        self.written: dict[int, tuple] = {}
        self.is_blocked = False
        self._lock, self._owner = threading.RLock(), os.getpid()
        self.start_again()

    @classmethod
    def of(cls, label: ModelLabel, key: str) -> "Trust":
        """The object of this process with a key; a new one the first time."""
        trust = cls._known[key] = cls._known.pop(key, None) or cls(label, key)
        while len(cls._known) > MAX_TRUSTS:
            cls._known.popitem(last=False)
        return trust

    def __reduce__(self) -> tuple:
        return Trust.of, (self.label, self.key)

    @property
    def lock(self) -> threading.RLock:
        """Lock of this process; replaced after a fork, when another thread of the parent may have held it."""
        if self._owner != os.getpid():
            self._lock, self._owner, self.session = threading.RLock(), os.getpid(), secrets.randbits(62)
        return self._lock

    def start_again(self) -> None:
        """Verify all rows again, including rows that this process has stored."""
        self.left: dict[tuple[str, bool], int] = {}
        self.used = 0
        self.stale: StaleCache | None = None
        self.session = secrets.randbits(62)

    def due(self, kind: tuple[str, bool], n: int) -> int:
        """Number of rows to verify when n rows are used."""
        due = 0 if kind in self.left else 1 if self.left else FIRST_ROWS  # others of the same code were verified
        left = self.left.get(kind, ROWS_PER_VERIFICATION) - n
        more = max(0, -left // ROWS_PER_VERIFICATION + 1)
        self.left[kind], self.used = left + more * ROWS_PER_VERIFICATION, self.used + n
        return due + more


class _Comparison(NamedTuple):
    """Result of a comparison of stored rows with new simulations."""

    compared: int
    stopped: list[str]  # reasons of the new simulations that were stopped
    row: Row | None = None  # that differs
    new: Simulated | None = None


class VerifiedCache:
    """A `SimulationCache` whose rows are verified before they are used.

    The `label` is that of the model when the likelihood was made. Counted are rows that were `compared`, `unverified`
    ones whose new simulation was stopped (not by the model), and the wall time, `seconds`. Derived likelihoods and
    copies verify rows once in a process; another process verifies them again.
    """

    def __init__(self, cache: SimulationCache, label: ModelLabel) -> None:
        self._set_up(cache, Trust.of(label, secrets.token_hex(16)))

    def _set_up(self, cache: SimulationCache, trust: Trust) -> None:
        self.cache, self._trust = cache, trust
        self.compared, self.unverified, self.seconds = 0, 0, 0.0
        self._random = np.random.default_rng()  # separate, so that the user's random numbers do not change

    def __getstate__(self) -> tuple:
        return self.cache, self._trust

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)

    @property
    def label(self) -> ModelLabel:
        """Label of the model."""
        return self._trust.label

    def share_trust(self, other: "VerifiedCache") -> None:
        """Trust rows that another object has verified or stored, if its model has the same code."""
        if other.label.code == self.label.code:
            self._trust = other._trust

    # storing ----------------------------------------------------------------------------------------------------------

    def store(
        self,
        fingerprint: str,
        thetas: np.ndarray,
        misfit: np.ndarray | None,
        reasons: list[str],
        responses: np.ndarray | None,
        run: VerifyingRun,
    ) -> None:
        """Store simulations under the model's label: statistics and responses, if given, and failures of the model."""
        trust, source = self._trust, source_number(run.fingerprint)
        with trust.lock:
            is_blocked = trust.is_blocked
            trust.is_blocked = is_blocked and all(isinstance(reason, TransientReason) for reason in reasons)
            generation = trust.generations.get(source) or self._known_generation(source)
            if generation is None and is_blocked:  # it is not known which rows agree
                return
            generation = self._use(source, generation or self._new_generation([]))
        rows = []
        if misfit is not None:
            rows += pack_rows(fingerprint, thetas, misfit, reasons, generation, trust.session)
        if responses is not None or any(reasons):
            finite = np.zeros(len(thetas), bool) if responses is None else np.isfinite(responses).all(axis=(1, 2))
            values = np.zeros((len(thetas), 0)) if responses is None else responses
            chosen = [row for row, reason in enumerate(reasons) if reason or finite[row]]
            why = ["" if finite[row] else reasons[row] for row in chosen]
            rows += pack_rows(run.fingerprint, thetas[chosen], values[chosen], why, generation, trust.session, True)
        self.cache.write(rows)

    def discard(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """Delete rows that were stored here."""
        for generation in set(self._trust.generations.values()):
            self.cache.discard(thetas, *fingerprints, generation=generation)

    # look-ups ---------------------------------------------------------------------------------------------------------

    def look_up(self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun) -> CachedRows:
        """Statistics that are stored, some verified; `StaleCache` if one differs although the label is known."""
        return self._look_up(fingerprint, thetas, run, run.n_numbers)

    def look_up_responses(self, thetas: np.ndarray, run: VerifyingRun) -> list[np.ndarray | str | None]:
        """Responses (n_channels, n_steps) [SI], or reasons of failures for any measurements; None if not stored.

        Some are verified by their statistics, as in `look_up`.
        """
        shape = len(run.model.channels), run.model.n_steps
        rows = self._look_up(run.fingerprint, thetas, run, shape[0] * shape[1]).rows
        return [
            row and (reason_of(row) if row.reason else np.frombuffer(row.value, dtype="<f8").reshape(shape))
            for row in rows
        ]

    def _look_up(self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun, width: int) -> CachedRows:
        trust, source = self._trust, source_number(run.fingerprint)
        while True:
            with trust.lock:
                generation = trust.generations.get(source) or self._find(source, fingerprint, run, width)
            if generation is None:
                return CachedRows([None] * len(thetas), width)
            rows = self.cache.look_up(fingerprint, thetas, width, generation)
            if not self.cache.verify or self._verify(fingerprint, rows.rows, generation, run, width):
                return rows

    # generations ------------------------------------------------------------------------------------------------------

    def _find(self, source: int, fingerprint: str, run: VerifyingRun, width: int) -> int | None:
        """The generation of a known label, or one that new simulations agree with, or a new one; None: cannot tell."""
        trust, cache = self._trust, self.cache
        generation = self._known_generation(source) or next(iter(trust.generations.values()), None)
        if generation is None and not trust.is_blocked and (stored := cache.generations_of(fingerprint)):
            generation = self._adopted(stored, fingerprint, run, width) if cache.verify else stored[0]
        return generation and self._use(source, generation)

    def _adopted(self, stored: list[int], fingerprint: str, run: VerifyingRun, width: int) -> int | None:
        """The generation that new simulations agree with, else a new one; None if no simulation ends."""
        cache, name = self.cache, type(run.model).__name__
        candidates = {generation: cache.candidates(fingerprint, generation, width) for generation in stored}
        candidates = {generation: rows for generation, rows in candidates.items() if len(rows) >= ROWS}
        self._say(
            "the code, a file, a package or the machine of this %s is not that of its stored simulations; "
            + (
                "%d of them are simulated again, to see whether they can be used"
                if candidates
                else "they are fewer than %d, stay in the file, and are not used"
            ),
            *(name, ROWS),
        )
        for generation, rows in candidates.items():
            found = self._compare(cache.rows_of(choose_rows(rows, ROWS, self._random)), ROWS, run)
            if found.row is not None:
                continue
            if found.compared < ROWS / 2:
                self._trust.is_blocked = True
                return None
            self._trust.left[fingerprint, True] = ROWS_PER_VERIFICATION * found.compared
            self._say("%d stored simulations of this %s agree with new ones: all are used", found.compared, name)
            return generation
        if candidates:
            self._say(DIFFER, name)
        return self._new_generation(stored)

    def _known_generation(self, source: int) -> int | None:
        """The generation of the label with the present contents of the files that simulations opened; None if unknown.

        Files that belong to other labels of the model count from now on.
        """
        label = self.label
        rows = self.cache.file.select(f"SELECT {LABEL_COLUMNS} FROM labels WHERE source = ? ORDER BY rowid", (source,))
        rows = list(filter(is_undamaged_label, rows))
        for row in rows:
            label.add(Opened(json.loads(row[2])).read_again())
        known = None
        for row in rows:
            files = json.loads(row[2])
            if row[1] == label.code.encode() and Opened(files).read_again().files == files:
                self._trust.written[source], known = row, row[3]
        return known

    def _new_generation(self, used: Iterable[int]) -> int:
        """The generation that another process has begun under the same label, unless its rows differ."""
        text = f"{self.label.code} {sorted(self.label.opened.items().items())}".encode()
        generation = int.from_bytes(blake2b(text, digest_size=8).digest()) >> 2 | 1
        return secrets.randbits(62) | 1 if generation in used else generation

    def _use(self, source: int, generation: int) -> int:
        """Store to which generation the label belongs, with the files that simulations have opened by now."""
        label, trust = self.label, self._trust
        row = pack_label(source, label.code, label.opened.files, generation)
        before, trust.generations[source], trust.written[source] = trust.written.get(source), generation, row
        if before != row:
            delete = "DELETE FROM labels WHERE source = ? AND code = ? AND files = ?"
            self.cache.file.write((delete, [before[:3]] if before else []), (STORE_LABEL, [row]))
        return generation

    def _say(self, text: str, *values: Any) -> None:
        logger.warning(f"%s: {text}", self.cache.path, *values)

    # comparisons ------------------------------------------------------------------------------------------------------

    def _verify(self, fingerprint: str, rows: list[Row | None], generation: int, run: VerifyingRun, width: int) -> bool:
        """Verify some of the rows that were found; False if the look-up must be repeated in a new generation."""
        trust = self._trust
        with trust.lock:
            others = [row for row in rows if row is not None and row.session != trust.session]
            if not others:
                return True
            if trust.stale is not None:
                raise StaleCache(str(trust.stale), trust.stale.theta)
            if trust.is_blocked:
                return True
            succeeded, latest = [row for row in others if not row.reason], None
            if (fingerprint, True) not in trust.left or not succeeded:
                latest = self.cache.latest_success(fingerprint, generation, width)
                latest = None if latest is None or latest.session == trust.session else latest
            # failures alone do not verify successful rows, which may be used later
            used, kind = trust.used, (fingerprint, bool(latest or succeeded))
            due = trust.due(kind, len(others))
            found = self._compare(self._in_order(latest, others), due, run)
            if found.row is not None:
                return self._use_no_rows(found.row, found.new, used, generation, run)
            if found.stopped:
                if not found.compared:
                    trust.is_blocked = True
                    del trust.left[kind]
                n, total = len(found.stopped), len(found.stopped) + found.compared
                text = "%d of %d stored simulations could not be verified, because the new simulation was stopped (%s)"
                text += ". Rows are used without verification until one ends" if trust.is_blocked else ""
                self._say(text, n, total, found.stopped[0])
            return True

    def _in_order(self, latest: Row | None, rows: list[Row]) -> Iterator[Row]:
        """The row that was stored last, and the others in random order, failures last."""
        if latest is not None:
            yield latest
        shuffled = [rows[place] for place in self._random.permutation(len(rows))]
        yield from (row for row in sorted(shuffled, key=lambda row: bool(row.reason)) if row != latest)

    def _compare(self, rows: Iterable[Row], n: int, run: VerifyingRun) -> _Comparison:
        """Simulate rows again, in growing batches, until n are compared, one differs, or too many stop."""
        rows, compared, stopped = iter(rows), 0, []
        while compared < n and len(stopped) < max(MAX_ATTEMPTS, compared):
            chosen = list(islice(rows, min(max(FIRST_COMPARED, 3 * compared), n - compared)))
            if not chosen:
                break
            thetas = np.array([np.frombuffer(row.theta, dtype="<f8") for row in chosen])
            start = time.perf_counter()
            new = simulate_again(run, thetas, self.label)
            if run.pool is None and self.label.observes:
                self.label.has_changed_itself(self.label.changed(run.model))
            self.seconds += time.perf_counter() - start
            self.compared += len(new)
            for row, each in zip(chosen, new, strict=True):
                if isinstance(each.reason, TransientReason):
                    stopped.append(each.reason)
                    self.compared, self.unverified = self.compared - 1, self.unverified + 1
                elif self._difference(row, each, run)[0]:
                    return _Comparison(compared, stopped, row, each)
                else:
                    compared += 1
        return _Comparison(compared, stopped)

    def _difference(self, row: Row, new: Simulated, run: VerifyingRun) -> tuple[str, float]:
        """How a simulation differs from a stored one, as `difference_in_words`."""
        misfit, reason = np.frombuffer(row.value, dtype="<f8"), reason_of(row)
        if not reason and row.size is not None:  # a response
            batch = SimulationBatch(misfit.reshape(1, len(run.model.channels), -1), [""])
            (misfit,), (reason,) = misfit_of_responses(run.model, batch, run.measured, run.statistic)
        return difference_in_words(misfit, reason, new, run)

    def _use_no_rows(self, row: Row, new: Simulated, used: int, generation: int, run: VerifyingRun) -> bool:
        """Begin a new generation, if the label was adopted and no row was used; False. `StaleCache` otherwise."""
        trust, theta = self._trust, np.frombuffer(row.theta, dtype="<f8")
        trust.start_again()
        query = "SELECT count(*) FROM labels WHERE source = ? AND generation = ?"
        source, difference = source_number(run.fingerprint), self._difference(row, new, run)
        if self.cache.file.select(query, (source, generation)) > [(1,)]:
            # the model has changed in a part of the space where no row was compared, or by what no label contains
            new_generation = self._new_generation([generation])
            for each in {source, *trust.generations}:
                self._use(each, new_generation)
            self._say(DIFFER, type(run.model).__name__)
            if not used:
                return False
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(run.model.parameter_names, theta, strict=True))
        text = f"{self.cache.path}: a stored simulation is not that of this {type(run.model).__name__}. At {point}: "
        text += f"{difference[0]}. {CHANGED}"
        if used:
            text += f", and discard this run, which has used {used} rows"
        if row.reason:
            text += ". Also do so if failures depend on anything but the parameters, such as a licence"
        if 0.0 < difference[1] < LARGEST_ROUNDING:
            text += (
                ". If such a difference comes from rounding, for example on another machine, accept differences of "
                f"this size, with SimulationCache(path, tolerance={2.0 * difference[1]:.1e})"
            )
        trust.stale = StaleCache(text, theta)
        raise trust.stale


# coverage of the space ------------------------------------------------------------------------------------------------


def choose_rows(rows: list[tuple[bytes, bytes]], n: int, rng: np.random.Generator) -> list[bytes]:
    """Choose n of the rows, given by keys and parameters, that would show a change of the model in a part of the space.

    The space is divided into n cells with about equal numbers of rows, and a random row of each cell is chosen. A
    change that concerns a share p of the rows is then missed with a probability of at most (1 - p)^n, as with n random
    rows, and less if the changed part is connected. Returns keys in random order.
    """
    thetas = np.frombuffer(b"".join([theta for _, theta in rows]), dtype="<f8").reshape(len(rows), -1)
    scale = np.ptp(thetas, axis=0)
    thetas = (thetas - thetas.min(axis=0)) / np.where(scale > 0.0, scale, 1.0)
    chosen = [rows[rng.choice(cell)][0] for cell in _cells(np.arange(len(rows)), thetas, n, rng)]
    return [chosen[place] for place in rng.permutation(n)]


def _cells(rows: np.ndarray, thetas: np.ndarray, n: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Divide rows into n parts, each time along the widest parameter (a random one of equally wide parameters)."""
    if n == 1:
        return [rows]
    width = np.ptp(thetas[rows], axis=0)
    axis = int(rng.choice(np.flatnonzero(width >= width.max())))
    ordered = rows[np.argsort(thetas[rows, axis], kind="stable")]
    left = n // 2
    cut = min(max(round(len(rows) * left / n), left), len(rows) - (n - left))
    return [*_cells(ordered[:cut], thetas, left, rng), *_cells(ordered[cut:], thetas, n - left, rng)]
