"""Verification of a cache: stored simulations are run again and compared before they are trusted.

Code and files cannot prove that the model with a declared identity still computes the same results. The model's label
(`fe_likelihoods.simulation.label`) decides how many rows are compared; numbers and powers: ``docs/parallel.rst``.

* The label is known in the file: the row stored last and a random one before the first row is used in a process, and a
  random one of every 100 rows used. A difference is an error, `StaleCache`.
* The label is unknown: enough rows, chosen to cover the parameter space. If all agree, the label is added to the rows'
  generation (adoption). If one differs, a new generation begins: the earlier rows stay in the file and are not used.

Failures are compared only if there is no successful simulation, since a changed model often fails at the same points.
A likelihood, those derived from it and their copies share their verified and stored rows (`Trust`).
"""

import logging
import secrets
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ..simulation.faults import TransientReason
from ..simulation.label import ModelLabel
from ..simulation.local_pool import LocalPool
from ..simulation.model import Model, SimulationBatch, misfit_of_responses
from .comparison import DEFAULT_TOLERANCE, Simulated, VerifyingRun, difference_in_words, simulate_again
from .labels import Trust, labels_of, trust_of
from .rows import CachedRows, Place, Row, pack_rows, reason_of, source_number
from .simulation_cache import SimulationCache, rows_to_compare

__all__ = ["StaleCache", "VerifiedCache", "choose_rows"]

logger = logging.getLogger(__name__)

FIRST_ROWS = 2  # rows verified before the first row is used, if the label is known
ROWS_PER_VERIFICATION = 100
FIRST_COMPARED = 3  # rows in the first batch of a search; each further batch has four times as many
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
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


class _Comparison(NamedTuple):
    """Result of a comparison of stored rows with new simulations."""

    compared: int
    stopped: list[str]  # reasons of the new simulations that were stopped
    row: Row | None = None  # that differs
    new: Simulated | None = None


class VerifiedCache:
    """A `SimulationCache` whose rows are verified before they are used.

    Its settings `verify` and `tolerance` apply. `model` and `label` are those in whose state the likelihood was made;
    simulations run in `pool`. Counted are rows that were `compared`, `unverified` ones whose new simulation was stopped
    (not by the model), and the wall time, `seconds`. Likelihoods of a process with equal built-in models and one file
    verify rows once, and so do derived likelihoods and copies; another process verifies them again.
    """

    def __init__(self, cache: SimulationCache, pool: Any, label: ModelLabel, model: Model) -> None:
        # user code may depend on what no label contains: there, each model object is verified
        same = cache.path, cache.file.identity, cache.verify, label.code, model.fingerprint
        key = secrets.token_hex(16) if label.observes else repr(same)
        is_local = pool is None or isinstance(pool, LocalPool)
        self._set_up(cache, trust_of(label, is_local, f"{key} {is_local}"))

    def _set_up(self, cache: SimulationCache, trust: Trust) -> None:
        self.cache, self._trust = cache, trust
        self.compared, self.unverified, self.seconds = 0, 0, 0.0
        self._model: Any = None  # model of the last look-up in this process
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
        seconds: float,
        run: VerifyingRun,
    ) -> None:
        """Store simulations under the model's label: statistics and responses, if given, and failures of the model."""
        trust = self._trust
        with trust.lock:
            stored = trust.find(self.cache.file, run)
            if stored is None:
                if not trust.generations and time.monotonic() < trust.pause_ends:  # it is not known which rows agree
                    return
                trust.begin(self.cache.file, run.fingerprint, set())
                stored = trust.find(self.cache.file, run)
            trust.save(self.cache.file)
            place = Place(stored.generation, trust.cpu, trust.session)
        rows = []
        if misfit is not None:
            rows += pack_rows(fingerprint, thetas, misfit, reasons, seconds, place)
        if responses is not None or any(reasons):
            finite = np.zeros(len(thetas), bool) if responses is None else np.isfinite(responses).all(axis=(1, 2))
            values = np.zeros((len(thetas), 0)) if responses is None else responses
            chosen = [row for row, reason in enumerate(reasons) if reason or finite[row]]
            why = ["" if finite[row] else reasons[row] for row in chosen]
            rows += pack_rows(run.fingerprint, thetas[chosen], values[chosen], why, 0.0, place, True)
        self.cache.write(rows)

    def discard(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """Delete rows that were stored here."""
        for generation in {each.generation for each in self._trust.stored.values()}:
            self.cache.discard(thetas, *fingerprints, generation=generation)

    # look-ups ---------------------------------------------------------------------------------------------------------

    def look_up(self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun) -> CachedRows:
        """Statistics that are stored, some verified; `StaleCache` if one differs although the label is known."""
        return self._look_up(fingerprint, thetas, run, run.n_numbers, None)

    def look_up_responses(self, thetas: np.ndarray, run: VerifyingRun) -> list[np.ndarray | str | None]:
        """Responses (n_channels, n_steps) [SI], or reasons of failures for any measurements; None if not stored.

        Some are verified by their statistics, as in `look_up`, but no failures at a time limit, because each would take
        as long as the limit.
        """
        shape, limit = (len(run.model.channels), run.model.n_steps), getattr(run.model, "time_limit", None)
        rows = self._look_up(run.fingerprint, thetas, run, shape[0] * shape[1], limit).rows
        return [
            row and (reason_of(row) if row.reason else np.frombuffer(row.value, dtype="<f8").reshape(shape))
            for row in rows
        ]

    def _look_up(
        self, fingerprint: str, thetas: np.ndarray, run: VerifyingRun, width: int, limit: float | None
    ) -> CachedRows:
        trust = self._trust
        if self._model is not None and run.model is not self._model:  # another model object was set
            with trust.lock:
                trust.start_again()
        self._model = run.model
        while True:
            with trust.lock:
                generation = trust.generations.get(fingerprint) or self._find(fingerprint, run, width)
                if generation is None:
                    return CachedRows([None] * len(thetas), width)
                trust.generations[fingerprint] = generation
            rows = self.cache.look_up(fingerprint, thetas, width, generation, limit)
            if not self.cache.verify or self._verify(fingerprint, rows.rows, generation, run, width):
                return rows

    def _find(self, fingerprint: str, run: VerifyingRun, width: int) -> int | None:
        """The generation of a known label, or one that new simulations agree with, or a new one; None: cannot tell."""
        trust, cache, n = self._trust, self.cache, rows_to_compare(self.cache.verify)
        stored, source = trust.find(cache.file, run), source_number(run.fingerprint)
        before = 0 if stored is None else stored.compared
        if stored is not None and before >= n:
            return stored.generation
        generations = cache.generations_of(fingerprint) if stored is None else [stored.generation]
        if not n and generations:
            trust.put(cache.file, {source}, generations[0], 0)
            return generations[0]
        rows = {each: cache.candidates(fingerprint, each, width) for each in generations}
        rows = {each: found for each, found in rows.items() if min(n, len(found)) > before}
        if not rows or time.monotonic() < trust.pause_ends:
            return None if stored is None or rows else stored.generation
        self._say_if(
            stored is None,
            "the code, a file, a package or the machine of this %s is not that of its stored simulations; up to %d of "
            "them are simulated again, to see whether they can be used",
            *(type(run.model).__name__, min(n, len(next(iter(rows.values()))))),
        )
        start = time.monotonic()
        for generation, found in rows.items():
            chosen = choose_rows(found, n - before, self._random)
            result = self._compare(cache.rows_of(chosen), len(chosen), FIRST_COMPARED, run)
            if result.row is not None:
                continue
            if result.compared < len(chosen) / 2:
                self._pause(start)
                return None
            trust.put(cache.file, {source}, generation, before + result.compared)
            trust.verified[fingerprint, True] += result.compared
            text = "%d stored simulations of this %s agree with new ones: all are used"
            self._say_if(stored is None, text, result.compared, type(run.model).__name__)
            return generation
        self._begin(fingerprint, run)
        return trust.stored[source].generation

    def _begin(self, fingerprint: str, run: VerifyingRun) -> None:
        used = {*self.cache.generations_of(fingerprint), *self.cache.generations_of(run.fingerprint)}
        self._trust.begin(self.cache.file, run.fingerprint, used)
        text = "stored simulations of this %s differ from new ones; they stay in the file and are not used"
        self._say_if(True, text, type(run.model).__name__)

    def _say_if(self, condition: bool, text: str, *values: Any) -> None:
        if condition:
            logger.warning(f"%s: {text}", self.cache.path, *values)

    # comparisons ------------------------------------------------------------------------------------------------------

    def _verify(self, fingerprint: str, rows: list[Row | None], generation: int, run: VerifyingRun, width: int) -> bool:
        """Verify some of the rows that were found; False if the look-up must be repeated in a new generation."""
        trust = self._trust
        with trust.lock:
            others = [row for row in rows if row is not None and row.session != trust.session and not row.time_limit]
            if not others:
                return True
            if trust.stale is not None:
                raise StaleCache(str(trust.stale), trust.stale.theta)
            if time.monotonic() < trust.pause_ends:
                return True
            succeeded, latest = [row for row in others if not row.reason], None
            if not trust.served[fingerprint, True] or not succeeded:
                latest = self.cache.latest_success(fingerprint, generation, width)
                latest = None if latest is None or latest.session == trust.session else latest
            # failures alone do not verify successful rows, which may be used later
            kind = fingerprint, bool(latest or succeeded or trust.served[fingerprint, True])
            # one row suffices for responses and shorter records if other rows of the same code were verified
            trust.verified.setdefault(kind, -1 if trust.served else -FIRST_ROWS)
            served = trust.served[kind] + len(others)
            due = served // ROWS_PER_VERIFICATION - trust.verified[kind]
            if due > 0:
                start = time.monotonic()
                result = self._compare(self._in_order(latest, others), due, due, run)
                if result.row is not None:
                    return self._use_no_rows(result.row, result.new, fingerprint, generation, run)
                n = len(result.stopped)
                text = "%d of %d stored simulations could not be verified, because the new simulation was stopped (%s)"
                if not result.compared:
                    text += ". Rows are used without verification for a while"
                    self._pause(start)
                self._say_if(n > 0, text, n, n + result.compared, *result.stopped[:1])
                if not result.compared:
                    return True
                # rows that are due and that nobody has requested are not compared later
                trust.verified[kind] = max(trust.verified[kind] + result.compared, served // ROWS_PER_VERIFICATION)
            trust.served[kind] = served
            return True

    def _in_order(self, latest: Row | None, rows: list[Row]) -> Iterator[Row]:
        """The row that was stored last, and the others in random order, failures last."""
        if latest is not None:
            yield latest
        shuffled = [rows[place] for place in self._random.permutation(len(rows))]
        yield from (row for row in sorted(shuffled, key=lambda row: bool(row.reason)) if row != latest)

    def _compare(self, rows: Iterable[Row], n: int, size: int, run: VerifyingRun) -> _Comparison:
        """Simulate rows again, in batches of `size` and more, until n are compared, one differs, or too many stop."""
        rows, compared, stopped = iter(rows), 0, []
        while compared < n and len(stopped) < max(MAX_ATTEMPTS, compared):
            chosen = list(islice(rows, min(size, n - compared)))
            if not chosen:
                break
            size *= 4
            thetas = np.array([np.frombuffer(row.theta, dtype="<f8") for row in chosen])
            for row, new in zip(chosen, self._simulate(thetas, run), strict=True):
                if isinstance(new.reason, TransientReason):
                    stopped.append(new.reason)
                elif self._difference(row, new, run)[0]:
                    return _Comparison(compared, stopped, row, new)
                else:
                    compared += 1
        return _Comparison(compared, stopped)

    def _simulate(self, thetas: np.ndarray, run: VerifyingRun) -> list[Simulated]:
        start, label = time.perf_counter(), self.label
        new = simulate_again(run, thetas, label)
        if run.pool is None and label.observes:
            label.has_changed_itself(label.changed(run.model))
        self.seconds += time.perf_counter() - start
        stopped = sum(isinstance(each.reason, TransientReason) for each in new)
        self.compared, self.unverified = self.compared + len(new) - stopped, self.unverified + stopped
        return new

    def _pause(self, start: float) -> None:
        """Compare nothing for a while, because no new simulation has ended since `start` [s]."""
        now = time.monotonic()
        self._trust.pause_ends = now + max(PAUSE_SECONDS, PAUSE_RATIO * (now - start))

    def _difference(self, row: Row, new: Simulated, run: VerifyingRun) -> tuple[str, float]:
        """How a simulation differs from a stored one, as `difference_in_words`.

        A row of another or unknown processor may differ in the last digits.
        """
        misfit, reason = np.frombuffer(row.value, dtype="<f8"), reason_of(row)
        if not reason and row.size is not None:  # a response
            batch = SimulationBatch(misfit.reshape(1, len(run.model.channels), -1), [""])
            (misfit,), (reason,) = misfit_of_responses(run.model, batch, run.measured, run.statistic)
        other = run.tolerance is None and not row.cpu == self._trust.cpu != 0
        tolerance = max(run.accepted, DEFAULT_TOLERANCE if other else 0.0)
        return difference_in_words(misfit, reason, new, run, tolerance, "stored")

    def _use_no_rows(self, row: Row, new: Simulated, fingerprint: str, generation: int, run: VerifyingRun) -> bool:
        """Begin a new generation, if the label was adopted and no row was used; False. `StaleCache` otherwise."""
        trust, theta = self._trust, np.frombuffer(row.theta, dtype="<f8")
        difference, change = self._difference(row, new, run)
        (once_more,) = simulate_again(run, theta[None])
        scatter, spread = "", 0.0
        if not isinstance(once_more.reason, TransientReason):
            scatter, spread = difference_in_words(new.misfit, new.reason, once_more, run, run.accepted, "first")
        served = trust.served.total()
        trust.start_again()
        labels = labels_of(self.cache.file, source_number(run.fingerprint))
        if not scatter and sum(each.generation == generation for each in labels) > 1:
            # the label was adopted, but the model has changed in a part of the space where no row was compared
            self._begin(fingerprint, run)
            if not served:
                return False
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(run.model.parameter_names, theta, strict=True))
        text = f"{self.cache.path}: a stored simulation is not that of this {type(run.model).__name__}. At {point}: "
        text += f"{difference}. {_NOT_REPEATABLE.format(scatter) if scatter else CHANGED}"
        if served:
            text += f", and discard this run, which has used {served} rows"
        if row.reason and not scatter:
            text += ". Also do so if failures depend on anything but the parameters, such as a licence"
        accepted = 10.0 * spread if scatter else 2.0 * change  # of a model that is not exactly repeatable
        if spread or (0.0 < change < LARGEST_ROUNDING and not scatter):
            text += (
                ". If such a difference comes from rounding, for example on another machine, accept differences of "
                f"this size, with SimulationCache(path, tolerance={accepted:.1e})"
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
    keys = [key for key, _ in rows]
    if len(rows) > n > 0:
        thetas = np.frombuffer(b"".join([theta for _, theta in rows]), dtype="<f8").reshape(len(rows), -1)
        scale = np.ptp(thetas, axis=0)
        thetas = (thetas - thetas.min(axis=0)) / np.where(scale > 0.0, scale, 1.0)
        keys = [keys[rng.choice(cell)] for cell in _cells(np.arange(len(rows)), thetas, n, rng)]
    return [keys[place] for place in rng.permutation(len(keys))] if n > 0 else []


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
