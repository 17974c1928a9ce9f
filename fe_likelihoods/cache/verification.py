"""Verification of a cache: stored simulations are run again and compared before they are trusted.

Stored simulations belong to the declared identity of a model. Code and files cannot prove that the model with this
identity still computes the same results. Therefore stored rows are compared with new simulations. The model's label
(`fe_likelihoods.simulation.label`) decides how many:

* The label is known in the file: two rows before the first row is used in a process (the row stored last, and a random
  one of the requested rows), and a random one of every 100 rows used. A difference is an error, `StaleCache`: something
  that the label does not contain has changed. A change in a share p of the parameter space is noticed with a
  probability of 1 - (1 - p)^n after n rows, in one process or in several.
* The label is unknown: enough rows, chosen to cover the parameter space, to detect a change in 5 % of the space with a
  probability of 95 % (59 rows, or all rows). If all agree, the label is added to the rows' generation (adoption). If
  one differs, a new generation begins: the earlier rows stay in the file and are not used. Both are logged.

Simulations complete the label with the files that they open.

Failures are compared only if there is no successful simulation, since a changed model often fails at the same points.
Likelihoods of one model and file share their verified and stored rows (`fe_likelihoods.cache.labels.shared_trust`).
"""

import logging
import random
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from ..simulation.label import ModelLabel
from ..simulation.model import Model
from ..simulation.opened import Opened
from .adoption import LATEST, MAX_ATTEMPTS, Adoption
from .comparison import (
    Repetition,
    Simulated,
    VerifyingRun,
    difference_of,
    is_transient,
    response_tolerance,
    row_of_response,
    simulate_again,
)
from .labels import Trust, labels_of, shared_trust
from .rows import CachedRows, StoredLabel, StoredSimulation, simulation_keys, source_number
from .simulation_cache import SimulationCache

__all__ = ["StaleCache", "VerifiedCache"]

logger = logging.getLogger(__name__)

FIRST_ROWS = 2  # rows verified before the first row is used, if the label is known
ROWS_PER_VERIFICATION = 100
LARGEST_ROUNDING = 1e-4  # largest relative response difference that may come from rounding and iterations
CHANGED = (
    "Something has changed that neither its declared identity nor its label contains. Delete its rows with "
    "likelihood.simulator.cache.forget(*likelihood.simulator.cache_keys), or give the model a new version= "
    "(or depends_on=)"
)
_NOT_REPEATABLE = (
    "The model is not repeatable: one more simulation at this point differs from the new one ({}). Make it depend on "
    "its parameters alone, for example with a fixed seed"
)
PAUSE_SECONDS = 60.0  # in which rows are used without verification if no new simulation ends
PAUSE_RATIO = 20.0  # shortest pause, relative to the duration of these simulations


class StaleCache(ValueError):
    """A stored simulation differs from a new one with the same parameters. The message says what to do.

    It is raised again, for any row, as long as this simulation is stored and the model is the same object. Samplers
    stop (`ends_run`), since no point can be evaluated any more. `theta` (n_structural,) are the parameters.
    """

    ends_run = True

    def __init__(self, message: str, theta: np.ndarray) -> None:
        super().__init__(message)
        self.theta = theta

    def __reduce__(self) -> tuple:
        return type(self), (str(self), self.theta)


class VerifiedCache:
    """A `SimulationCache` whose rows are verified before they are used.

    Its settings `verify` and `tolerance` apply. `model` and `label` are those in whose state the likelihood was made;
    simulations run in `pool`. `again` counts the simulations for verification. Another process verifies rows again,
    once for all copies of this object there.
    """

    def __init__(self, cache: SimulationCache, model: Model, pool: Any, label: ModelLabel) -> None:
        self._set_up(cache, shared_trust(cache, model, pool, label, response_tolerance(model) == 0.0))

    def _set_up(self, cache: SimulationCache, trust: Trust) -> None:
        self.cache, self._trust = cache, trust
        self.again = Repetition(cache.file, trust)
        self._adoption = Adoption(cache, trust, self.again)
        self._model: Any = None  # model of the last look-up in this process
        self._random = random.Random()  # separate, so that the user's random number streams do not change

    def __getstate__(self) -> tuple:
        return self.cache, self._trust

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)

    @property
    def label(self) -> ModelLabel:
        """Label of the model."""
        return self._trust.label

    def complete(self, opened: Opened | None) -> None:
        """Add what simulations opened to the model's label."""
        self._trust.complete(self.cache.file, opened)

    def share_trust(self, other: "VerifiedCache") -> None:
        """Trust rows that another object has verified or stored, if its model has the same code."""
        if other._trust.label.code == self._trust.label.code:
            self._set_up(self.cache, other._trust)

    # storing ----------------------------------------------------------------------------------------------------------

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
        """Store simulations under the model's label: statistics, responses and failures, if given."""
        stored = self._label_to_store(run.model)
        if stored is None:
            return
        place = stored.generation, stored.id
        if responses is not None:
            # before the statistics, which can be computed from the responses if the program is killed in between
            self.cache.store_responses(run.model, thetas, responses, *place)
        if misfit is not None:
            self.cache.store(fingerprint, thetas, run.n_steps, misfit, reasons, seconds, *place)
        if any(reasons):
            self.cache.store_failures(run.model, thetas, reasons, stored.generation)
        self._trust.add_own(thetas, stored.generation, *{fingerprint, run.model.fingerprint})

    def _label_to_store(self, model: Model) -> StoredLabel | None:
        """The label under which new simulations are stored; None while the search for a generation pauses."""
        trust = self._trust
        with trust.lock:
            stored = trust.find(self.cache.file, model)
            if stored is None and (trust.generations or time.monotonic() >= trust.pause_ends):
                trust.begin(self.cache.file, model, set())
                stored = trust.stored
            return stored

    def discard(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """Delete rows that were stored here."""
        if self._trust.stored is not None:
            self.cache.discard(thetas, *fingerprints, generation=self._trust.stored.generation)

    def are_stored(self, fingerprints: tuple[str, ...], thetas: np.ndarray, model: Model) -> np.ndarray:
        """Whether rows are stored (n,), in any generation that may be used; nothing is verified."""
        with self._trust.lock:
            stored = self._trust.find(self.cache.file, model)
        if stored is not None:
            return self.cache.are_stored(fingerprints, thetas, stored.generation)
        found = np.zeros(len(thetas), dtype=bool)
        for generation in {each for name in fingerprints for each in self.cache.generations_of(name)}:
            found |= self.cache.are_stored(fingerprints, thetas, generation)
        return found

    # look-ups ---------------------------------------------------------------------------------------------------------

    def look_up(self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun) -> CachedRows:
        """Rows of `SimulationCache.look_up`, some verified; `StaleCache` if one differs although the label is known."""
        self._notice_other_model(run)
        while True:
            generation = self._adoption.generation(fingerprint, run)
            if generation is None:
                self.cache.misses += len(thetas)
                shape = len(thetas), run.n_numbers
                return CachedRows(np.full(shape, np.nan), [""] * len(thetas), np.zeros(len(thetas), bool))
            rows = self.cache.look_up(fingerprint, thetas, run.n_numbers, run.n_steps, generation)
            if self._verify_rows(fingerprint, thetas, rows, generation, run):
                return rows

    def _verify_rows(
        self, fingerprint: str, thetas: np.ndarray, rows: CachedRows, generation: int, run: VerifyingRun
    ) -> bool:
        """Verify some of the rows that were found; False if the look-up must be repeated in a new generation."""
        known = self._of_others(fingerprint, thetas, np.flatnonzero(rows.known).tolist(), generation)
        if not known:
            return True
        failed = [row for row in known if rows.reasons[row]]
        succeeded = [row for row in known if not rows.reasons[row]]
        first = not self._trust.served["simulations", fingerprint]
        latest = None
        if first or not succeeded:
            stored = self.cache.stored_rows(fingerprint, generation, run.n_numbers, run.n_steps, LATEST)
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
        """Responses from `SimulationCache.look_up_responses`; some of them are verified by their statistics."""
        self._notice_other_model(run)
        fingerprint = run.model.fingerprint
        while True:
            generation = self._adoption.generation(fingerprint, run)
            if generation is None:
                return [None] * len(thetas)
            responses = self.cache.look_up_responses(run.model, thetas, generation)
            known = [place for place, response in enumerate(responses) if response is not None]
            known = self._of_others(fingerprint, thetas, known, generation)

            def candidates(known: list = known, responses: list = responses) -> Iterator[StoredSimulation]:
                for row in self._in_random_order(thetas, known):
                    yield row_of_response(thetas[row], responses[row], -1, run)

            if not known or self._verify_due("responses", fingerprint, len(known), candidates, run):
                return responses

    def look_up_failures(self, thetas: np.ndarray, run: VerifyingRun) -> list[str]:
        """Reasons from `SimulationCache.look_up_failures`; some of them are verified, as in `look_up`.

        Failures at a time limit are not verified, because each would take as long as the limit.
        """
        self._notice_other_model(run)
        with self._trust.lock:
            stored = self._trust.find(self.cache.file, run.model)
        if stored is None:
            return [""] * len(thetas)
        reasons = self.cache.look_up_failures(run.model, thetas, stored.generation)
        known = [row for row, reason in enumerate(reasons) if reason and not is_transient(reason)]
        known = self._of_others(run.model.fingerprint, thetas, known, stored.generation)

        def candidates() -> Iterator[StoredSimulation]:
            for row in self._random.sample(known, len(known)):
                yield StoredSimulation(thetas[row], np.full(run.n_numbers, np.nan), reasons[row], -1)

        if known and not self._verify_due("failures", run.model.fingerprint, len(known), candidates, run):
            return [""] * len(thetas)
        return reasons

    # the usual few ------------------------------------------------------------------------------------------------

    def _of_others(self, fingerprint: str, thetas: np.ndarray, rows: list[int], generation: int) -> list[int]:
        """The rows that this process has not stored; none if the cache is not to be verified."""
        if not self.cache.verify or not rows:
            return []
        own = self._trust.own
        if not own:
            return rows
        keys = simulation_keys(fingerprint, thetas[rows], generation)
        return [row for row, key in zip(rows, keys, strict=True) if key not in own]

    def _verify_due(
        self, table: str, fingerprint: str, n: int, candidates: Callable[[], Iterator], run: VerifyingRun
    ) -> bool:
        """Verify the rows that are due when `n` more rows are used; False if a new generation has begun."""
        trust = self._trust
        with trust.lock:
            if trust.stale is not None:
                differing, error = trust.stale
                generation = trust.generations.get(differing, 0 if trust.stored is None else trust.stored.generation)
                if self.cache.are_stored([differing], error.theta[None], generation)[0]:
                    raise StaleCache(str(error), error.theta)
                trust.stale = None
            if time.monotonic() < trust.pause_ends:
                return True
            before = trust.served[table, fingerprint]
            due = (before + n) // ROWS_PER_VERIFICATION - before // ROWS_PER_VERIFICATION
            if not before:
                # one row suffices for responses and shorter records if other rows of the same code were verified
                due += 1 if trust.served else FIRST_ROWS
            start = time.monotonic()
            try:
                compared = not due or self._verify(candidates(), due, fingerprint, run)
            except StaleCache as error:
                trust.stale = fingerprint, error
                raise
            finally:
                self.again.found.clear()
            if compared is None:
                return False
            if compared:
                trust.served[table, fingerprint] = before + n
            else:
                now = time.monotonic()
                trust.pause_ends = now + max(PAUSE_SECONDS, PAUSE_RATIO * (now - start))
            return True

    def _verify(self, rows: Iterable[StoredSimulation], due: int, fingerprint: str, run: VerifyingRun) -> bool | None:
        """Simulate the first `due` rows again; for each new simulation that is stopped, a further row instead.

        Whether rows were compared; failures alone do not count if another simulation was stopped. None if a row of
        another label differs, and a new generation has begun.
        """
        rows, done, succeeded, reasons = iter(rows), 0, 0, []
        attempts = max(due, MAX_ATTEMPTS)
        while done < due and attempts > 0:
            chosen = [row for row, _ in zip(rows, range(min(due - done, attempts)), strict=False)]
            if not chosen:
                break
            attempts -= len(chosen)
            for row, new in zip(chosen, self.again.simulate(fingerprint, chosen, run), strict=True):
                if is_transient(new.reason):
                    reasons.append(new.reason)
                elif self._differs(row, new, fingerprint, run):
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
                "" if done else ". Rows are used without verification for a while",
            )
        return bool(succeeded or (done and not reasons))

    def _differs(self, row: StoredSimulation, new: Simulated, fingerprint: str, run: VerifyingRun) -> bool:
        """Whether a row of another label differs, and a new generation has begun; `StaleCache` for other rows."""
        label, tolerances = row.label, self.again.tolerances(run)
        if label == -1:  # not read yet
            generation = self._trust.generations.get(fingerprint)
            label = 0 if generation is None else self.cache.label_of(fingerprint, row.theta, generation)
        difference, change = _difference(row, new, run, tolerances[label])
        if not difference:
            return False
        start = time.perf_counter()
        (once_more,) = simulate_again(run, row.theta[None])
        self.again.seconds += time.perf_counter() - start
        scatter, spread = "", 0.0
        if not is_transient(once_more.reason):
            first = StoredSimulation(row.theta, new.misfit, new.reason)
            scatter, spread = _difference(first, once_more, run, tolerances[0], "first")
        served = self._trust.served.total()
        self._trust.start_again()
        stored, labels = self._trust.stored, labels_of(self.cache.file, source_number(run.model.fingerprint))
        if not scatter and label in {each.id for each in labels if stored and each.label != stored.label}:
            # the label was adopted, but the model has changed in a part of the space where no row was compared
            self._adoption.begin(fingerprint, run)
            if not served:
                return True
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(run.model.parameter_names, row.theta, strict=True))
        text = f"{self.cache.path}: a stored simulation is not that of this {type(run.model).__name__}. At {point}: "
        text += f"{difference}. {_NOT_REPEATABLE.format(scatter) if scatter else CHANGED}"
        if served:
            text += f", and discard this run, which has used {served} rows"
        if spread:
            text += f", or accept such differences with SimulationCache(path, tolerance={10.0 * spread:.1e})"
        elif row.reason and not scatter:
            text += ". If failures depend on anything but the parameters, set retry_failures=True"
        elif 0.0 < change < LARGEST_ROUNDING and not scatter:
            text += (
                ". If the model is not exactly repeatable, for example on another machine, accept differences of this "
                f"size, {change:.1e} of the response, with SimulationCache(path, tolerance={2.0 * change:.1e})"
            )
        raise StaleCache(text, row.theta)

    def _notice_other_model(self, run: VerifyingRun) -> None:
        """Verify all rows again if another model object was set."""
        if run.model is not self._model:
            if self._model is not None:
                with self._trust.lock:
                    self._trust.start_again()
                    self._trust.stale = None
                    self.again.found.clear()
            self._model = run.model

    def _in_random_order(self, thetas: np.ndarray, rows: list[int]) -> list[int]:
        """Indices in random order, but rows that have just been simulated again come first."""
        again = {key[-1] for key in self.again.found}
        shuffled = self._random.sample(rows, len(rows))
        return sorted(shuffled, key=lambda row: thetas[row].tobytes() not in again) if again else shuffled


def _difference(
    earlier: StoredSimulation, new: Simulated, run: VerifyingRun, tolerance: float, origin: str = "stored"
) -> tuple[str, float]:
    """How a simulation differs from an earlier one, in words and relative to the response norm; empty if it agrees."""
    if earlier.reason or new.reason:
        if earlier.reason and new.reason:
            return "", 0.0
        was, now = (f"failed ({text})" if text else "succeeded" for text in (earlier.reason, new.reason))
        return f"it {was}; simulated again, it {now}", 0.0
    found = difference_of(earlier.misfit, new, run, tolerance)
    if found is None:
        return "", 0.0
    index, change = found
    names = [channel.name for channel in run.model.channels]
    what = "sum of squared residuals" if index < len(names) else f"statistic {index}"
    values = f"{origin} {earlier.misfit[index]:.17g}, simulated again {new.misfit[index]:.17g}"
    return f"channel {names[index % len(names)]!r}, {what}: {values}", change
