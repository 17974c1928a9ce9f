"""Which stored simulations may be used: those of the model's generation, or of one that new simulations agree with."""

import logging
import random
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from ..signals.comparison import measured_values
from ..simulation.faults import TransientReason
from ..simulation.label import ModelLabel
from ..simulation.model import Model, SimulationBatch, misfit_batch, misfit_of_responses, sent_simulation
from ..simulation.opened import Observed, Opened, observing, unpack
from .coverage import choose_rows
from .generations import MAX_CANDIDATES
from .rows import OF_EARLIER_RELEASES, StoredLabel, StoredSimulation, simulation_keys
from .simulation_cache import SimulationCache, rows_to_compare
from .tolerance import DEFAULT_TOLERANCE, VerifyingRun, difference_of, response_tolerance
from .trust import OWN, shared_trust

__all__ = ["LATEST", "MAX_ATTEMPTS", "Adoption", "is_transient", "observed_batch", "row_of_response"]

logger = logging.getLogger(__name__)

FIRST_COMPARED = 3  # of many rows; then four times as many, and so on, because the first difference is enough
LATEST = 100  # rows among which the latest success is looked for
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
MAX_OWN = 200_000  # keys of 16 bytes, about 100 bytes each in memory
PAUSE_SECONDS = 60.0  # before another attempt, where no simulation could be compared


def observed_batch(
    run: VerifyingRun, thetas: np.ndarray, label: ModelLabel
) -> tuple[np.ndarray, list[str], Opened | None]:
    """Statistics and reasons of simulations, and what they opened; None for nothing new."""
    if not label.observes:
        return *misfit_batch(run.model, thetas, run.measured, run.pool, run.statistic), None
    if run.pool is None:
        with observing() as observer:
            misfit, reasons = misfit_batch(run.model, thetas, run.measured, None, run.statistic)
        return misfit, reasons, observer.result(label.known)
    function = Observed(sent_simulation(run.model, run.measured, run.statistic))
    misfit, reasons, opened = np.full((len(thetas), run.n_numbers), np.nan), [], Opened({})
    for row, outcome in zip(misfit, run.pool.map(function, list(thetas)), strict=True):
        (values, reason), found = unpack(outcome)
        reasons.append(reason)
        opened = opened if found is None else opened | found
        if values is not None:
            row[...] = values
    return misfit, reasons, opened


class Adoption:
    """Base of `VerifiedCache`, which documents it: finds the generation of a model, and stores rows in it."""

    def __init__(self, cache: SimulationCache, model: Model, pool: Any, label: ModelLabel) -> None:
        self._set_up(cache, shared_trust(cache, model, pool, label))

    def _set_up(self, cache: SimulationCache, trust: Any) -> None:
        self.cache, self._trust = cache, trust
        self.compared, self.unverified, self.seconds = 0, 0, 0.0
        # keys of rows that were stored here since a restart, which need no verification
        self._own: tuple[int, set[bytes]] = (0, set())
        self._model: Any = None  # of the last look-up; None if there was none, or in another process
        self._random = random.Random()  # its own, so that the user's streams of random numbers do not change

    def __getstate__(self) -> tuple:
        return self.cache, self._trust

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)

    def complete(self, opened: Opened | None) -> None:
        """Add to the label of the model what simulations opened."""
        if opened is not None:
            with self._trust.lock:
                self._trust.complete(self.cache, opened)

    @property
    def label(self) -> ModelLabel:
        """Label of the model."""
        return self._trust.label

    def store(
        self,
        fingerprint: str,
        thetas: np.ndarray,
        misfit: np.ndarray | None,
        reasons: list[str],
        responses: np.ndarray | None,
        seconds: float,
        run: VerifyingRun,
    ) -> None:
        """Store simulations under the label of the model: their statistics, responses and failures, where given."""
        stored = self._label_to_store(run.model)
        if stored is None:
            return
        own = [run.model.fingerprint]
        if responses is not None:
            # before the statistics, which are computed from them if the program is killed in between
            self.cache.store_responses(run.model, thetas, responses, stored.generation, stored.id)
        if misfit is not None:
            n_steps = measured_values(run.measured).shape[1]
            self.cache.store(fingerprint, thetas, n_steps, misfit, reasons, seconds, stored.generation, stored.id)
            own.append(fingerprint)
        self.cache.store_failures(run.model, thetas, reasons, stored.generation)
        self._add_own(thetas, stored.generation, *own)

    def discard(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """Delete rows that were stored here."""
        if self._trust.stored is not None:
            self.cache.discard(thetas, *fingerprints, generation=self._trust.stored.generation)

    def are_stored(self, fingerprints: tuple[str, ...], thetas: np.ndarray, model: Model) -> np.ndarray:
        """Whether rows are stored (n,), in any generation that may be used; nothing is verified."""
        with self._trust.lock:
            stored = self._trust.find(self.cache, model)
        if stored is not None:
            return self.cache.are_stored(fingerprints, thetas, stored.generation)
        found = np.zeros(len(thetas), dtype=bool)
        for generation in {each for name in fingerprints for each in self.cache.generations_of(name)}:
            found |= self.cache.are_stored(fingerprints, thetas, generation)
        return found

    def share_trust(self, other: "Adoption") -> None:
        """Verify no row that another object has verified or stored, unless the code is another one."""
        if other._trust.label.code == self._trust.label.code:
            self._trust = other._trust
            self._own = self._trust.restarts, other._own_rows()

    def _generation(self, fingerprint: str, run: VerifyingRun, of_responses: bool = False) -> int | None:
        """Generation whose rows are used; None if no rows of this identity can be used yet."""
        found = self._trust.generations.get(fingerprint)
        if found is not None:
            return found
        with self._trust.lock:
            n_steps = measured_values(run.measured).shape[1]

            def rows_of(generation: int, most: int) -> list[StoredSimulation]:
                if of_responses:
                    points = self.cache.response_points(run.model, generation, most)
                    return [StoredSimulation(theta, None, "", label) for theta, label in points]
                rows = self.cache.stored_rows(fingerprint, generation, run.n_numbers, n_steps, most)
                return [row for row in rows if not (row.reason and self.cache.retry_failures)]

            found = self._find_generation(fingerprint, run, rows_of)
            if found is not None:
                self._trust.generations[fingerprint] = found
            return found

    def _find_generation(self, fingerprint: str, run: VerifyingRun, rows_of: Callable) -> int | None:
        trust, n = self._trust, rows_to_compare(self.cache.verify)
        table = "responses" if fingerprint == run.model.fingerprint else "simulations"
        present = self.cache.generations_of(fingerprint, table)
        present = [each for each in present if each != OF_EARLIER_RELEASES and rows_of(each, LATEST)]
        shape = len(run.model.parameter_names), run.n_numbers, measured_values(run.measured).shape[1]
        earlier = self.cache.earlier_sources(*shape) if fingerprint != run.model.fingerprint else []
        if not present and not earlier:
            stored = trust.find(self.cache, run.model)
            return None if stored is None else stored.generation
        if time.monotonic() < trust.pause_ends:
            return None
        stored, before = trust.find(self.cache, run.model), trust.stored
        if not n:
            if stored is None:
                trust.adopt(self.cache, run.model, present[0] if present else self._begun(run.model), 0)
            return trust.find(self.cache, run.model).generation
        if stored is not None:
            if stored.generation in present and stored.compared < n:
                labels = {each.id for each in self.cache.labels_of(run.model) if each.label == stored.label}
                rows = [row for row in rows_of(stored.generation, n + MAX_ATTEMPTS) if row.label not in labels]
                left = min(n, len(rows)) - stored.compared
                if left > 0 and not self._adopts(fingerprint, stored.generation, rows_of, left, run):
                    return trust.stored.generation if trust.stored is not before else None
            if stored.generation not in present and earlier:
                self._adopt_earlier(fingerprint, earlier, run, n)
            return stored.generation
        count = min(n, len(rows_of(present[0], MAX_CANDIDATES))) if present else n
        logger.warning(
            "%s: the code, a file, a package or the machine of this %s is not that of its stored simulations; up to %d "
            "of them are simulated again, to see whether they can be used",
            self.cache.path,
            type(run.model).__name__,
            count,
        )
        for generation in present:
            adopts = self._adopts(fingerprint, generation, rows_of, n, run)
            if adopts is None:
                return None
            if adopts:
                return trust.stored.generation
        if self._adopt_earlier(fingerprint, earlier, run, n):
            return trust.stored.generation
        self._begin(fingerprint, run)
        return trust.stored.generation

    def _begun(self, model: Model) -> int:
        self._trust.begin(self.cache, model, set())
        return self._trust.stored.generation

    def _begin(self, fingerprint: str, run: VerifyingRun) -> None:
        """Begin a new generation, with the simulations that have shown that it is needed."""
        used = set(self.cache.generations_of(fingerprint))
        used |= set(self.cache.generations_of(run.model.fingerprint, "responses"))
        self._trust.begin(self.cache, run.model, used)
        logger.warning(
            "%s: stored simulations of this %s differ from new ones; they stay in the file and are not used",
            self.cache.path,
            type(run.model).__name__,
        )
        new = [row for (name, *_), row in self._trust.simulated.items() if name == fingerprint]
        if new and fingerprint != run.model.fingerprint:
            thetas, misfit = (np.array([row[place] for row in new]) for place in (0, 1))
            self.store(fingerprint, thetas, misfit, [row.reason for row in new], None, 0.0, run)
        self._trust.simulated.clear()

    def _adopt_earlier(self, fingerprint: str, earlier: list[int], run: VerifyingRun, n: int) -> bool:
        """Compare rows of earlier releases, and take those that agree into the generation of the model."""
        n_steps = measured_values(run.measured).shape[1]
        trust = self._trust
        for source in earlier:
            rows = self.cache.stored_rows(source, OF_EARLIER_RELEASES, run.n_numbers, n_steps)
            same, compared = self._compare_many(fingerprint, choose_rows(rows, n, self._generator()), run)
            if not same or compared < min(n, len(rows)) / 2:
                continue
            if trust.stored is None:
                trust.begin(self.cache, run.model, set())
            self.cache.adopt_earlier(source, fingerprint, trust.stored.generation, trust.stored.id)
            logger.warning(
                "%s: %d simulations of an earlier release agree with new ones and are used", self.cache.path, compared
            )
            return True
        return False

    def _adopts(self, fingerprint: str, generation: int, rows_of: Callable, n: int, run: VerifyingRun) -> bool | None:
        """Whether rows of a generation agree with new simulations; the label is then one of it. None: cannot tell."""
        trust, rows = self._trust, rows_of(generation, MAX_CANDIDATES)
        chosen = choose_rows(rows, n, self._generator())
        if fingerprint == run.model.fingerprint:
            responses = self.cache.look_up_responses(run.model, np.array([row.theta for row in chosen]), generation)
            pairs = zip(chosen, responses, strict=True)
            chosen = [row_of_response(row.theta, found, row.label, run) for row, found in pairs if found is not None]
        same, compared = self._compare_many(fingerprint, chosen, run)
        if same and compared < min(n, len(rows)) / 2:
            trust.pause_ends = time.monotonic() + PAUSE_SECONDS
            return None
        if not same:
            if trust.stored is not None:  # a label that was adopted with fewer rows
                self._begin(fingerprint, run)
            return False
        before = 0 if trust.stored is None else trust.stored.compared
        trust.adopt(self.cache, run.model, generation, min(before + compared, OWN))
        logger.warning(
            "%s: %d stored simulations of this %s agree with new ones: all are used",
            self.cache.path,
            compared,
            type(run.model).__name__,
        )
        return True

    def _compare_many(self, fingerprint: str, rows: list[StoredSimulation], run: VerifyingRun) -> tuple[bool, int]:
        """Whether rows agree with new simulations, as far as these were not stopped, and how many were compared."""
        size, attempts, compared = FIRST_COMPARED, 0, 0
        tolerances = self._tolerances(run)
        while rows and not (attempts >= MAX_ATTEMPTS and compared == 0):
            some, rows = rows[:size], rows[size:]
            attempts += len(some)
            size *= 4
            for row, new in zip(some, self._simulate_again(fingerprint, some, run), strict=True):
                if is_transient(new.reason):
                    continue
                compared += 1
                if bool(row.reason) != bool(new.reason):
                    return False, compared
                tolerance = tolerances.get(row.label, max(tolerances[0], DEFAULT_TOLERANCE))
                if not row.reason and difference_of(row.misfit, new.misfit, run, tolerance) is not None:
                    return False, compared
        self.cache.verified += compared
        return True, compared

    def _simulate_again(
        self, fingerprint: str, rows: list[StoredSimulation], run: VerifyingRun
    ) -> list[StoredSimulation]:
        """New simulations at the points of some rows, those of this search for a generation included."""
        simulated, key = self._trust.simulated, (fingerprint, id(run.measured), id(run.statistic))
        left = [row.theta for row in rows if (*key, row.theta.tobytes()) not in simulated]
        if left:
            thetas, start = np.array(left), time.perf_counter()
            misfit, reasons, opened = observed_batch(run, thetas, self.label)
            self.complete(opened)
            if run.pool is None and self.label.observes:
                self.label.has_changed_itself(self.label.changed(run.model))
            self._count(start, reasons)
            for theta, values, reason in zip(thetas, misfit, reasons, strict=True):
                simulated[(*key, theta.tobytes())] = StoredSimulation(theta, values, reason)
        return [simulated[(*key, row.theta.tobytes())] for row in rows]

    def _label_to_store(self, model: Model) -> StoredLabel | None:
        """The label under which new simulations are stored; None while it is not known which rows agree with them."""
        trust = self._trust
        with trust.lock:
            if (stored := trust.find(self.cache, model)) is not None:
                return stored
            if time.monotonic() < trust.pause_ends and not trust.generations:
                return None
            trust.begin(self.cache, model, set())
            return trust.stored

    def _tolerances(self, run: VerifyingRun) -> dict[int, float]:
        """Tolerances by the label of a row; that at 0 is for rows of the same processor."""
        same = response_tolerance(run.model) if self.cache.tolerance is None else self.cache.tolerance
        other = max(same, DEFAULT_TOLERANCE) if self.cache.tolerance is None else same
        cpu = self._trust.cpu
        found = {each.id: same if each.cpu == cpu != "" else other for each in self.cache.labels_of(run.model)}
        return found | {0: same}

    def _in_random_order(self, thetas: np.ndarray, rows: list[int]) -> list[int]:
        """Indices in random order, first those that have just been simulated again."""
        again = {key[-1] for key in self._trust.simulated}
        shuffled = self._random.sample(rows, len(rows))
        return sorted(shuffled, key=lambda row: thetas[row].tobytes() not in again) if again else shuffled

    def _generator(self) -> np.random.Generator:
        return np.random.default_rng(self._random.getrandbits(64))

    def _count(self, start: float, reasons: list[str]) -> None:
        self.seconds += time.perf_counter() - start
        self.compared += sum(not is_transient(reason) for reason in reasons)
        self.unverified += sum(map(is_transient, reasons))

    def _add_own(self, thetas: np.ndarray, generation: int, *fingerprints: str) -> None:
        """State that simulations were run and stored here, so that they need no verification."""
        own = self._own_rows()
        if len(own) < MAX_OWN:
            for fingerprint in fingerprints:
                own.update(simulation_keys(fingerprint, thetas, generation))

    def _own_rows(self) -> set[bytes]:
        """Keys of the rows that were stored here since the last difference."""
        if self._own[0] != self._trust.restarts:
            self._own = self._trust.restarts, set()
        return self._own[1]


def row_of_response(theta: np.ndarray, response: np.ndarray, label: int, run: VerifyingRun) -> StoredSimulation:
    """A stored response as its statistics."""
    batch = SimulationBatch(response[None], [""])
    misfit, (reason,) = misfit_of_responses(run.model, batch, run.measured, run.statistic)
    return StoredSimulation(theta, misfit[0], reason, label)


def is_transient(reason: str) -> bool:
    """Whether a simulation failed for a reason that says nothing about the model."""
    return isinstance(reason, TransientReason)
