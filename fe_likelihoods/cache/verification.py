"""Verification of a cache: stored simulations are run again and compared before they are trusted.

Stored simulations belong to the declared identity of a model. Nothing that can be computed from code and files tells
with certainty whether the model behind that identity still computes the same. Therefore rows of a file are compared
with new simulations. How many is decided by the label of the model (`fe_likelihoods.simulation.label`):

* The label is known in the file: two rows before the first row is used in a process (the one that was stored last, and
  one at random of those that are requested), and one more for every 1000 rows used. A difference is an error,
  `StaleCache`: something that the label does not contain has changed.
* The label is unknown: so many rows, chosen to cover the space of the parameters, that a change in 5 % of the space is
  found with a probability of 95 % (59 rows, or all there are). If all agree, the rows are adopted: the label is entered
  as one of their generation. If one differs, a new generation begins: the earlier rows stay in the file and are not
  used. Both are logged.

The row that is simulated first also completes the label, by what it opens while it runs. Files of earlier releases have
rows without a label. Those with the right numbers of parameters, channels and samples are compared in the same way.

Failures count only where there is no successful simulation, since a changed model often fails at the same points.
Likelihoods that are made with one model object, pool and file share their comparisons. Rows that the same likelihood
has stored itself need no verification.
"""

import logging
import random
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ..signals.comparison import measured_values
from ..simulation.faults import TransientReason
from ..simulation.label import ModelLabel
from ..simulation.model import Model, SimulationBatch, misfit_batch, misfit_of_responses, sent_simulation
from ..simulation.opened import Observed, Opened, observing
from ..simulation.residual_statistics import needs_response
from .coverage import choose_rows
from .rows import OF_EARLIER_RELEASES, CachedRows, StoredLabel, StoredSimulation, simulation_keys
from .simulation_cache import MAX_CANDIDATES, SimulationCache, rows_to_compare
from .tolerance import DEFAULT_TOLERANCE, VerifyingRun, largest_difference, response_tolerance
from .trust import OWN, shared_trust

__all__ = ["StaleCache", "VerifiedCache", "observed_batch"]

logger = logging.getLogger(__name__)

FIRST_ROWS = 2  # verified before the first row is used, where the label is known
ROWS_PER_VERIFICATION = 1000
FIRST_COMPARED = 3  # of many rows; then four times as many, and so on, because the first difference is enough
LARGEST_ROUNDING = 1e-4  # relative difference of responses that may come from rounding and iterations
LATEST = 100  # rows among which the latest success is looked for
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
CHANGED = (
    "Something has changed that neither its declared identity nor its label contains. Delete its rows with "
    "cache.forget(*likelihood.cache_keys), or give the model a new version= (or depends_on=)"
)
MAX_OWN = 200_000  # keys of 16 bytes, about 100 bytes each in memory
MAX_FAILED_ATTEMPTS = 3  # to verify a row, before rows are used for a while without verification
PAUSE_SECONDS = 60.0  # after failed attempts; at least
PAUSE_RATIO = 20.0  # of the duration of the last attempt


class StaleCache(ValueError):
    """A stored simulation differs from a new one with the same parameters. The message says what to do.

    It is raised again, for any row, as long as that simulation is stored and the model is the same object.

    Attributes
    ----------
    theta : (n_structural,) float
        Structural parameters of the simulation.
    ends_run : bool
        True: samplers stop, since no other point can be evaluated either.
    """

    ends_run = True

    def __init__(self, message: str, theta: np.ndarray) -> None:
        super().__init__(message)
        self.theta = theta

    def __reduce__(self) -> tuple:
        return type(self), (str(self), self.theta)


def observed_batch(run: VerifyingRun, thetas: np.ndarray) -> tuple[np.ndarray, list[str], Opened | None]:
    """Statistics and reasons of simulations, and what the first successful one opened; None if nothing is known."""
    if run.pool is None:
        with observing() as observer:
            misfit, reasons = misfit_batch(run.model, thetas, run.measured, None, run.statistic)
        return misfit, reasons, observer.result() if not all(reasons) else None
    function = Observed(sent_simulation(run.model, run.measured, run.statistic))
    misfit, reasons, opened = np.full((len(thetas), run.n_numbers), np.nan), [], None
    for row, ((values, reason), found) in zip(misfit, run.pool.map(function, list(thetas)), strict=True):
        reasons.append(reason)
        opened = opened or found
        if values is not None:
            row[...] = values
    return misfit, reasons, opened


class VerifiedCache:
    """A `SimulationCache` whose rows are verified before they are used.

    Copies in another process verify rows of their own, once for all copies of that process.

    Parameters
    ----------
    cache : SimulationCache
        Its settings `verify` and `tolerance` apply.
    model : Model
        As it is when the likelihood is made. Objects for the same model, pool and file share what they have verified.
    pool : executor or None
    label : ModelLabel
        Label of the model.

    Attributes
    ----------
    compared : int
        Rows that were compared with a new simulation.
    unverified : int
        Rows whose new simulation was stopped for another reason than the model, so that it could not be compared.
    seconds : float
        Wall time of the simulations for verification [s].
    """

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

    # rows ---------------------------------------------------------------------------------------------------------

    def look_up(self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun) -> CachedRows:
        """Rows of `SimulationCache.look_up`, of which some are verified.

        Parameters
        ----------
        fingerprint : str
            As for `SimulationCache.look_up`.
        thetas : (n, n_structural) float
            Structural parameters.
        run : VerifyingRun

        Raises
        ------
        StaleCache
            If a stored row and a new simulation differ, although the label of the model is known.
        """
        self._notice_other_model(run)
        n_steps = measured_values(run.measured).shape[1]
        while True:
            generation = self._generation(fingerprint, run)
            if generation is None:
                self.cache.misses += len(thetas)
                shape = len(thetas), run.n_numbers
                return CachedRows(np.full(shape, np.nan), [""] * len(thetas), np.zeros(len(thetas), bool))
            rows = self.cache.look_up(fingerprint, thetas, run.n_numbers, n_steps, generation)
            if self._verify_rows(fingerprint, thetas, rows, generation, run):
                return rows

    def _verify_rows(
        self, fingerprint: str, thetas: np.ndarray, rows: CachedRows, generation: int, run: VerifyingRun
    ) -> bool:
        """Verify some of the rows that were found; False if another generation is to be used."""
        known = self._of_others(fingerprint, thetas, np.flatnonzero(rows.known).tolist(), generation)
        if not known:
            return True
        failed = [row for row in known if rows.reasons[row]]
        succeeded = [row for row in known if not rows.reasons[row]]
        first = not self._trust.served["simulations", fingerprint]
        latest = None
        if first or not succeeded:
            n_steps = measured_values(run.measured).shape[1]
            stored = self.cache.stored_rows(fingerprint, generation, run.n_numbers, n_steps, LATEST)
            others = (row for row in stored if not row.reason)
            latest = next(others, None)
            if latest is not None and not self._of_others(fingerprint, latest.theta[None], [0], generation):
                latest = None
        # failures alone do not verify successful rows, which may be used later
        table = "failed simulations" if first and latest is None and not succeeded else "simulations"

        def candidates() -> Iterator[StoredSimulation]:
            if latest is not None:
                yield latest
            for some in (succeeded, failed):
                for row in self._in_random_order(thetas, some):
                    if latest is None or not np.array_equal(latest.theta, thetas[row]):
                        yield StoredSimulation(thetas[row], rows.misfit[row], rows.reasons[row], -1)

        return self._verify_due(table, fingerprint, len(known), candidates, run)

    def look_up_responses(self, thetas: np.ndarray, run: VerifyingRun) -> list[np.ndarray | None]:
        """Responses of `SimulationCache.look_up_responses`, of which some are verified by their statistics.

        Raises
        ------
        StaleCache
            If the statistics of a stored response and of a new simulation differ, although the label is known.
        """
        self._notice_other_model(run)
        fingerprint = run.model.fingerprint
        while True:
            generation = self._generation(fingerprint, run, of_responses=True)
            if generation is None:
                return [None] * len(thetas)
            responses = self.cache.look_up_responses(run.model, thetas, generation)
            known = [place for place, response in enumerate(responses) if response is not None]
            known = self._of_others(fingerprint, thetas, known, generation)

            def candidates(known: list = known, responses: list = responses) -> Iterator[StoredSimulation]:
                for row in self._in_random_order(thetas, known):
                    yield _of_response(thetas[row], responses[row], -1, run)

            if not known or self._verify_due("responses", fingerprint, len(known), candidates, run):
                return responses

    def look_up_failures(self, thetas: np.ndarray, run: VerifyingRun) -> list[str]:
        """Reasons of `SimulationCache.look_up_failures`, of which some are verified.

        Those that name a time limit are not, because each would take as long as the limit.

        Raises
        ------
        StaleCache
            If the new simulation succeeds.
        """
        self._notice_other_model(run)
        with self._trust.lock:
            stored = self._trust.find(self.cache, run.model)
        if stored is None:
            return [""] * len(thetas)
        reasons = self.cache.look_up_failures(run.model, thetas, stored.generation)
        known = [row for row, reason in enumerate(reasons) if reason and not _is_transient(reason)]
        known = self._of_others(run.model.fingerprint, thetas, known, stored.generation)

        def candidates() -> Iterator[StoredSimulation]:
            for row in self._random.sample(known, len(known)):
                yield StoredSimulation(thetas[row], np.full(run.n_numbers, np.nan), reasons[row], -1)

        if known and not self._verify_due("failures", run.model.fingerprint, len(known), candidates, run):
            return [""] * len(thetas)
        return reasons

    def complete(self, opened: Opened | None, model: Model) -> None:
        """Complete the label of the model by what a simulation opened."""
        with self._trust.lock:
            self._trust.complete(self.cache, model, opened)

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

    def share_trust(self, other: "VerifiedCache") -> None:
        """Verify no row that another object has verified or stored, unless the code is another one."""
        if other._trust.label.code == self._trust.label.code:
            self._trust = other._trust
            self._own = self._trust.restarts, other._own_rows()

    # generations --------------------------------------------------------------------------------------------------

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
        if not trust.label.complete and n:
            self._complete_label(fingerprint, present, earlier, rows_of, run)
        stored = trust.find(self.cache, run.model, incomplete=True)
        if not n:
            if stored is None:
                trust.adopt(self.cache, run.model, present[0] if present else self._begun(run.model), 0)
            return trust.stored.generation
        if stored is not None:
            if stored.generation in present and stored.compared < n:
                same = stored.label, trust.label.code
                labels = {each.id for each in self.cache.labels_of(run.model) if each.label in same}
                rows = [row for row in rows_of(stored.generation, n + MAX_ATTEMPTS) if row.label not in labels]
                left = min(n, len(rows)) - stored.compared
                if left > 0 and not self._adopts(fingerprint, stored.generation, rows_of, left, run):
                    return trust.stored.generation if trust.stored is not stored else None
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

    def _complete_label(
        self, fingerprint: str, present: list[int], earlier: list[int], rows_of: Callable, run: VerifyingRun
    ) -> None:
        """Simulate the latest success again, which completes the label by what it opens."""
        stored = [row for generation in present[:1] for row in rows_of(generation, LATEST)]
        if not stored:
            n_steps = measured_values(run.measured).shape[1]
            stored = self.cache.stored_rows(earlier[0], OF_EARLIER_RELEASES, run.n_numbers, n_steps, LATEST)
        for row in [row for row in stored if not row.reason][:MAX_ATTEMPTS]:
            self._simulate_again(fingerprint, [row], run)
            if self._trust.label.complete:
                return

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
            chosen = [_of_response(row.theta, found, row.label, run) for row, found in pairs if found is not None]
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
                if _is_transient(new.reason):
                    continue
                compared += 1
                if bool(row.reason) != bool(new.reason):
                    return False, compared
                tolerance = tolerances.get(row.label, max(tolerances[0], DEFAULT_TOLERANCE))
                if not row.reason and _difference(row.misfit, new.misfit, run, tolerance) is not None:
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
            if not self.label.complete:
                misfit, reasons, opened = observed_batch(run, thetas)
                self.complete(opened, run.model)
            else:
                misfit, reasons = misfit_batch(run.model, thetas, run.measured, run.pool, run.statistic)
            self._count(start, reasons)
            for theta, values, reason in zip(thetas, misfit, reasons, strict=True):
                simulated[(*key, theta.tobytes())] = StoredSimulation(theta, values, reason)
        return [simulated[(*key, row.theta.tobytes())] for row in rows]

    def _label_to_store(self, model: Model) -> StoredLabel | None:
        """The label under which new simulations are stored; None while it is not known which rows agree with them."""
        trust = self._trust
        with trust.lock:
            if trust.find(self.cache, model) is None:
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
        self.compared += sum(not _is_transient(reason) for reason in reasons)
        self.unverified += sum(map(_is_transient, reasons))

    # the usual few ------------------------------------------------------------------------------------------------

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

    def _of_others(self, fingerprint: str, thetas: np.ndarray, rows: list[int], generation: int) -> list[int]:
        """Those of some rows that were not stored here; none if the cache is not to be verified."""
        if not self.cache.verify or not rows:
            return []
        own = self._own_rows()
        if not own:
            return rows
        keys = simulation_keys(fingerprint, thetas[rows], generation)
        return [row for row, key in zip(rows, keys, strict=True) if key not in own]

    def _verify_due(
        self, table: str, fingerprint: str, n: int, candidates: Callable[[], Iterator], run: VerifyingRun
    ) -> bool:
        """Verify as many rows as are due now that `n` more are used; False if another generation is to be used."""
        trust = self._trust
        with trust.lock:
            if trust.stale is not None:
                differing, error = trust.stale
                generation = trust.generations.get(differing, 0 if trust.stored is None else trust.stored.generation)
                if self.cache.are_stored([differing], error.theta[None], generation)[0]:
                    raise StaleCache(str(error), error.theta)
                trust.stale = None
            if trust.rows_in_pause < ROWS_PER_VERIFICATION and time.monotonic() < trust.pause_ends:
                trust.rows_in_pause += n
                return True
            before = trust.served[table, fingerprint]
            first = before == 0
            # one row suffices for responses and for shorter records, if others of the same code were verified
            first_rows = 1 if trust.served else FIRST_ROWS
            due = first_rows if first else (before + n) // ROWS_PER_VERIFICATION - before // ROWS_PER_VERIFICATION
            start = time.monotonic()
            try:
                compared = not due or self._verify(candidates(), due, fingerprint, run)
            except StaleCache as error:
                trust.stale = fingerprint, error
                raise
            finally:
                trust.simulated.clear()
            if compared is None:
                return False
            if not compared:
                trust.failed_attempts += 1
                if trust.failed_attempts >= MAX_FAILED_ATTEMPTS:
                    now = time.monotonic()
                    trust.pause_ends = now + max(PAUSE_SECONDS, PAUSE_RATIO * (now - start))
                    trust.rows_in_pause = 0
                return True  # verified with the next rows, or after a pause
            if due:
                trust.failed_attempts = 0
            trust.served[table, fingerprint] = before + n
            return True

    def _verify(self, rows: Iterable[StoredSimulation], due: int, fingerprint: str, run: VerifyingRun) -> bool | None:
        """Simulate the first `due` rows again, and further ones in place of those whose simulation is stopped.

        Returns whether a row was compared; two failures do not count if successful rows could not be compared. None if
        a row of another label differs, and a new generation has begun.
        """
        rows, done, succeeded, reasons = iter(rows), 0, 0, []
        attempts = max(due, MAX_ATTEMPTS)
        while done < due and attempts > 0:
            chosen = [row for row, _ in zip(rows, range(min(due - done, attempts)), strict=False)]
            if not chosen:
                break
            attempts -= len(chosen)
            for row, new in zip(chosen, self._simulate_again(fingerprint, chosen, run), strict=True):
                if _is_transient(new.reason):
                    reasons.append(new.reason)
                elif self._differs(row, new.misfit, new.reason, fingerprint, run):
                    return None
                else:
                    done += 1
                    succeeded += not row.reason
        self.cache.verified += done
        if reasons:
            logger.warning(
                "%s: %d of %d stored simulations could not be verified, because the new simulation was stopped (%s)%s",
                self.cache.path,
                len(reasons),
                len(reasons) + done,
                reasons[0],
                "" if done else ". Rows are used without verification; the next ones are verified instead",
            )
        return bool(succeeded or (done and not reasons))

    def _differs(
        self, row: StoredSimulation, new: np.ndarray, reason: str, fingerprint: str, run: VerifyingRun
    ) -> bool:
        """Whether a row of another label differs, and a new generation has begun; `StaleCache` for other rows."""
        if row.reason and reason:
            return False
        label = self._label_of(row, fingerprint, run)
        names = [channel.name for channel in run.model.channels]
        if row.reason or reason:
            was, now = (f"failed ({text})" if text else "succeeded" for text in (row.reason, reason))
            difference, advice = f"the stored simulation {was}; simulated again, it {now}", ""
            if row.reason:
                advice = ". If failures depend on anything but the parameters, set retry_failures=True"
        else:
            tolerances = self._tolerances(run)
            found = _difference(row.misfit, new, run, tolerances.get(label, max(tolerances[0], DEFAULT_TOLERANCE)))
            if found is None:
                return False
            index, change = found
            what = "sum of squared residuals" if index < len(names) else f"statistic {index}"
            difference = (
                f"channel {names[index % len(names)]!r}, {what}: stored {row.misfit[index]:.17g}, simulated again "
                f"{new[index]:.17g}"
            )
            advice = ""
            if change < LARGEST_ROUNDING:
                advice = (
                    ". If the model is not exactly repeatable, for example on another machine, accept differences of "
                    f"this size, {change:.1e} of the response, with SimulationCache(path, tolerance={2.0 * change:.1e})"
                )
        scatter = self._scatter(row.theta, new, reason, run)
        served = self._trust.served.total()
        self._start_again()
        stored = self._trust.stored
        same = () if stored is None else (stored.label, self.label.code)  # the second, before it was completed
        of_others = {each.id for each in self.cache.labels_of(run.model) if each.label not in same}
        if label in of_others and not scatter:
            # the label was adopted, but the model has changed in a part of the space where no row was compared
            self._begin(fingerprint, run)
            if not served:
                return True
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(run.model.parameter_names, row.theta, strict=True))
        rest = f", and discard this run, which has used {served} rows" if served else ""
        raise StaleCache(
            f"{self.cache.path}: a stored simulation is not that of this {type(run.model).__name__}. At {point}: "
            f"{difference}. {scatter or CHANGED}{rest}{'' if scatter else advice}",
            row.theta,
        )

    def _label_of(self, row: StoredSimulation, fingerprint: str, run: VerifyingRun) -> int:
        """Id of the label under which a row was stored; 0 if it is not known."""
        if row.label != -1:
            return row.label
        generation = self._trust.generations.get(fingerprint)
        return 0 if generation is None else self.cache.label_of(fingerprint, row.theta, generation)

    def _scatter(self, theta: np.ndarray, earlier: np.ndarray, reason: str, run: VerifyingRun) -> str:
        """Advice for a model whose new simulations differ among themselves, after one more; empty if they agree."""
        start = time.perf_counter()
        (new,), (new_reason,) = misfit_batch(run.model, theta[None], run.measured, run.pool, run.statistic)
        self.seconds += time.perf_counter() - start
        if _is_transient(new_reason) or (reason and new_reason):
            return ""
        text = "The model is not repeatable: one more simulation at this point "
        if reason or new_reason:
            outcome = f"failed ({new_reason})" if new_reason else "succeeded"
            return f"{text}{outcome}. Make it depend on its parameters alone, for example with a fixed seed"
        found = _difference(earlier, new, run, self._tolerances(run)[0])
        if found is None:
            return ""
        index, change = found
        return (
            f"{text}gave {new[index]:.17g} instead of {earlier[index]:.17g}, a change of {change:.1e} of the response. "
            "Make it depend on its parameters alone, for example with a fixed seed, or accept such differences with "
            f"SimulationCache(path, tolerance={10.0 * change:.1e})"
        )

    def _notice_other_model(self, run: VerifyingRun) -> None:
        """Start again with the first verification if another model object was set."""
        if run.model is not self._model:
            if self._model is not None:
                with self._trust.lock:
                    self._start_again()
                    self._trust.stale = None
            self._model = run.model

    def _start_again(self) -> None:
        self._trust.served.clear()
        self._trust.restarts += 1


def _of_response(theta: np.ndarray, response: np.ndarray, label: int, run: VerifyingRun) -> StoredSimulation:
    """A stored response as its statistics."""
    batch = SimulationBatch(response[None], [""])
    misfit, (reason,) = misfit_of_responses(run.model, batch, run.measured, run.statistic)
    return StoredSimulation(theta, misfit[0], reason, label)


def _difference(stored: np.ndarray, new: np.ndarray, run: VerifyingRun, tolerance: float) -> tuple[int, float] | None:
    return largest_difference(stored, new, run.measured, tolerance, needs_response(run.statistic))


def _is_transient(reason: str) -> bool:
    """Whether a simulation failed for a reason that says nothing about the model."""
    return isinstance(reason, TransientReason)
