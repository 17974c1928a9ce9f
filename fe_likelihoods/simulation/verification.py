"""Verification of a cache: stored simulations are run again and compared before they are trusted.

The key of a stored simulation contains a digest of the model, but no digest contains everything that a model depends
on. Therefore rows of a file are compared with new simulations: two before the first row is used in a process (the one
that was stored last, and one at random of those that are requested), and one more for every 1000 rows used. Failures
count only where there is no successful simulation, since a changed model often fails at the same points. For the
likelihoods of other noises or of a part of the record that are made from a verified one, one row is compared before the
first is used. Likelihoods that are made with one model object, pool and file share their comparisons. Rows that the
same likelihood has stored itself need no verification. The first comparison is repeated after a change of the model
object, of its pool, or of a source file.

A difference is an error, because either the stored rows or the new simulations belong to another model.
"""

import logging
import os
import random
import sys
import time
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np

from ..signals.comparison import Comparison, measured_values
from .cache_rows import CachedRows, StoredSimulation, simulation_keys
from .disk_cache import SimulationCache
from .faults import TransientReason
from .fingerprint import simulation_fingerprint
from .model import Model, SimulationBatch, misfit_batch, misfit_of_responses
from .residual_statistics import Statistic, needs_response
from .tolerance import largest_difference, response_tolerance
from .verification_schedule import Schedule, shared_schedule

__all__ = ["StaleCache", "VerifiedCache", "VerifyingRun"]

logger = logging.getLogger(__name__)

FIRST_ROWS = 2  # verified before the first row is used
ROWS_PER_VERIFICATION = 1000
LARGEST_ROUNDING = 1e-4  # relative difference of responses that may come from rounding and iterations
MAX_ATTEMPTS = 4  # simulations that may fail for other reasons than the model
STAMP_SECONDS = 1.0  # between two looks at the source files
CHANGED = (
    "The model has changed in a way that its fingerprint does not contain. Delete its rows with "
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


class VerifyingRun(NamedTuple):
    """What a simulation for verification needs.

    Attributes
    ----------
    model : Model
    pool : executor or None
        Where the simulations of the likelihood run.
    measured : (n_channels, n_steps) float, or Comparison
        Measured response [SI].
    statistic : Statistic or None
        Statistic of the residuals that is stored; None for the sums of squares.
    n_numbers : int
        Length of the statistic.
    """

    model: Model
    pool: Any
    measured: np.ndarray | Comparison
    statistic: Statistic | None
    n_numbers: int


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

    Attributes
    ----------
    compared : int
        Rows that were compared with a new simulation.
    unverified : int
        Rows whose new simulation was stopped for another reason than the model, so that it could not be compared.
    seconds : float
        Wall time of the simulations for verification [s].
    """

    def __init__(self, cache: SimulationCache, model: Model, pool: Any) -> None:
        self._set_up(cache, shared_schedule(cache, model, pool))

    def _set_up(self, cache: SimulationCache, schedule: Schedule) -> None:
        self.cache, self._schedule = cache, schedule
        self.compared, self.unverified, self.seconds = 0, 0, 0.0
        self._objects: tuple | None = None  # of the last look-up; None if there was none, or in another process
        self._stamp_time = -np.inf
        # keys of rows that were stored here since a restart of the schedule, which need no verification
        self._own: tuple[int, set[bytes]] = (0, set())
        self._random = random.Random()  # its own, so that the user's streams of random numbers do not change

    def __getstate__(self) -> tuple:
        return self.cache, self._schedule

    def __setstate__(self, state: tuple) -> None:
        self._set_up(*state)

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
            If a stored row and a new simulation differ.
        """
        n_steps = measured_values(run.measured).shape[1]
        rows = self.cache.look_up(fingerprint, thetas, run.n_numbers, n_steps)
        known = self._of_others(fingerprint, thetas, np.flatnonzero(rows.known).tolist(), run)
        if known:
            failed = [row for row in known if rows.reasons[row]]
            succeeded = [row for row in known if not rows.reasons[row]]
            first = not self._schedule.served["simulations", fingerprint]
            latest = None
            if first or not succeeded:
                latest = self.cache.latest_success(fingerprint, run.n_numbers, n_steps)
                if latest is not None and not self._of_others(fingerprint, latest.theta[None], [0], run):
                    latest = None
            # failures alone do not verify successful rows, which may be used later
            table = "failed simulations" if first and latest is None and not succeeded else "simulations"

            def candidates() -> Iterator[StoredSimulation]:
                if latest is not None:
                    yield latest
                for some in (succeeded, failed):
                    for row in self._random.sample(some, len(some)):
                        if latest is None or not np.array_equal(latest.theta, thetas[row]):
                            yield StoredSimulation(thetas[row], rows.misfit[row], rows.reasons[row])

            self._verify_due(table, fingerprint, len(known), candidates, run)
        return rows

    def look_up_responses(self, thetas: np.ndarray, run: VerifyingRun) -> list[np.ndarray | None]:
        """Responses of `SimulationCache.look_up_responses`, of which some are verified by their statistics.

        Raises
        ------
        StaleCache
            If the statistics of a stored response and of a new simulation differ.
        """
        responses = self.cache.look_up_responses(run.model, thetas)
        known = [place for place, response in enumerate(responses) if response is not None]
        fingerprint = simulation_fingerprint(run.model) if known else ""
        known = self._of_others(fingerprint, thetas, known, run)
        if known:

            def candidates() -> Iterator[StoredSimulation]:
                for row in self._random.sample(known, len(known)):
                    batch = SimulationBatch(responses[row][None], [""])
                    misfit, (reason,) = misfit_of_responses(run.model, batch, run.measured, run.statistic)
                    yield StoredSimulation(thetas[row], misfit[0], reason)

            self._verify_due("responses", fingerprint, len(known), candidates, run)
        return responses

    def look_up_failures(self, thetas: np.ndarray, run: VerifyingRun) -> list[str]:
        """Reasons of `SimulationCache.look_up_failures`, of which some are verified.

        Those that name a time limit are not, because each would take as long as the limit.

        Raises
        ------
        StaleCache
            If the new simulation succeeds.
        """
        reasons = self.cache.look_up_failures(run.model, thetas)
        known = [row for row, reason in enumerate(reasons) if reason and not _is_transient(reason)]
        fingerprint = simulation_fingerprint(run.model) if known else ""
        known = self._of_others(fingerprint, thetas, known, run)
        if known:

            def candidates() -> Iterator[StoredSimulation]:
                for row in self._random.sample(known, len(known)):
                    yield StoredSimulation(thetas[row], np.full(run.n_numbers, np.nan), reasons[row])

            self._verify_due("failures", fingerprint, len(known), candidates, run)
        return reasons

    def add_own(self, thetas: np.ndarray, *fingerprints: str) -> None:
        """State that simulations were run and stored here, so that they need no verification.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters.
        *fingerprints : str
            As for `SimulationCache.look_up`.
        """
        own = self._own_rows()
        if len(own) < MAX_OWN:
            for fingerprint in fingerprints:
                own.update(simulation_keys(fingerprint, thetas))

    def share_schedule(self, other: "VerifiedCache") -> None:
        """Verify no row that another object has verified or stored."""
        self._schedule = other._schedule
        self._own = self._schedule.restarts, other._own_rows()

    def _own_rows(self) -> set[bytes]:
        """Keys of the rows that were stored here since the last change of the model."""
        if self._own[0] != self._schedule.restarts:
            self._own = self._schedule.restarts, set()
        return self._own[1]

    def _of_others(self, fingerprint: str, thetas: np.ndarray, rows: list[int], run: VerifyingRun) -> list[int]:
        """Those of some rows that were not stored here; none if the cache is not to be verified."""
        if not self.cache.verify or not rows:
            return []
        with self._schedule.lock:
            self._notice_changes(fingerprint, run)  # after an edit of the source files no row counts as stored here
        own = self._own_rows()
        if not own:
            return rows
        keys = simulation_keys(fingerprint, thetas[rows])
        return [row for row, key in zip(rows, keys, strict=True) if key not in own]

    def _verify_due(self, table: str, fingerprint: str, n: int, candidates: Any, run: VerifyingRun) -> None:
        """Verify as many rows as are due now that `n` more are used."""
        schedule = self._schedule
        with schedule.lock:
            self._notice_changes(fingerprint, run)
            if schedule.stale is not None:
                differing, error = schedule.stale
                if self.cache.are_stored([differing], error.theta[None])[0]:
                    raise StaleCache(str(error), error.theta)
                schedule.stale = None
            if schedule.rows_in_pause < ROWS_PER_VERIFICATION and time.monotonic() < schedule.pause_ends:
                schedule.rows_in_pause += n
                return
            before = schedule.served[table, fingerprint]
            first = before == 0
            # one row suffices for responses and for shorter records, if others of the same code were verified
            first_rows = 1 if schedule.served else FIRST_ROWS
            due = first_rows if first else (before + n) // ROWS_PER_VERIFICATION - before // ROWS_PER_VERIFICATION
            start = time.monotonic()
            try:
                compared = not due or self._verify(candidates(), due, run)
            except StaleCache as error:
                schedule.stale = fingerprint, error
                raise
            if not compared:
                schedule.failed_attempts += 1
                if schedule.failed_attempts >= MAX_FAILED_ATTEMPTS:
                    now = time.monotonic()
                    schedule.pause_ends = now + max(PAUSE_SECONDS, PAUSE_RATIO * (now - start))
                    schedule.rows_in_pause = 0
                return  # verified with the next rows, or after a pause
            if due:
                schedule.failed_attempts = 0
            schedule.served[table, fingerprint] = before + n

    def _verify(self, rows: Iterable[StoredSimulation], due: int, run: VerifyingRun) -> bool:
        """Simulate the first `due` rows again, and further ones in place of those whose simulation is stopped.

        Returns whether a row was compared; two failures do not count if successful rows could not be compared.
        """
        rows, done, succeeded, reasons = iter(rows), 0, 0, []
        attempts = max(due, MAX_ATTEMPTS)
        while done < due and attempts > 0:
            chosen = [row for row, _ in zip(rows, range(min(due - done, attempts)), strict=False)]
            if not chosen:
                break
            attempts -= len(chosen)
            thetas = np.array([row.theta for row in chosen])
            start = time.perf_counter()
            misfit, new_reasons = misfit_batch(run.model, thetas, run.measured, run.pool, run.statistic)
            self.seconds += time.perf_counter() - start
            self.compared += sum(not _is_transient(reason) for reason in new_reasons)
            self.unverified += sum(map(_is_transient, new_reasons))
            for row, values, reason in zip(chosen, misfit, new_reasons, strict=True):
                if _is_transient(reason):
                    reasons.append(reason)
                else:
                    self._compare(row, values, reason, run)
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

    def _compare(self, row: StoredSimulation, new: np.ndarray, reason: str, run: VerifyingRun) -> None:
        """Raise `StaleCache` if a stored simulation differs from a new one."""
        if row.reason and reason:
            return
        names = [channel.name for channel in run.model.channels]
        if row.reason or reason:
            was, now = (f"failed ({text})" if text else "succeeded" for text in (row.reason, reason))
            difference, advice = f"the stored simulation {was}; simulated again, it {now}", ""
            if row.reason:
                advice = ". If failures depend on anything but the parameters, set retry_failures=True"
        else:
            tolerance = self._tolerance(run)
            found = largest_difference(row.misfit, new, run.measured, tolerance, needs_response(run.statistic))
            if found is None:
                return
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
        served = self._schedule.served.total()
        self._start_again()
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(run.model.parameter_names, row.theta, strict=True))
        rest = f", and discard this run, which has used {served} rows" if served else ""
        raise StaleCache(
            f"{self.cache.path}: a stored simulation is not that of this {type(run.model).__name__}. At {point}: "
            f"{difference}. {scatter or CHANGED}{rest}{'' if scatter else advice}",
            row.theta,
        )

    def _tolerance(self, run: VerifyingRun) -> float:
        return response_tolerance(run.model) if self.cache.tolerance is None else self.cache.tolerance

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
        found = largest_difference(earlier, new, run.measured, self._tolerance(run), needs_response(run.statistic))
        if found is None:
            return ""
        index, change = found
        return (
            f"{text}gave {new[index]:.17g} instead of {earlier[index]:.17g}, a change of {change:.1e} of the response. "
            "Make it depend on its parameters alone, for example with a fixed seed, or accept such differences with "
            f"SimulationCache(path, tolerance={10.0 * change:.1e})"
        )

    def _notice_changes(self, fingerprint: str, run: VerifyingRun) -> None:
        """Start again with the first verification if the model object, its pool or a source file has changed."""
        objects = run.model, run.pool
        same = self._objects is not None and all(a is b for a, b in zip(objects, self._objects, strict=True))
        if self._objects is not None and not same:
            self._start_again()
            self._schedule.stale = None
        now = time.monotonic()
        if not same or now > self._stamp_time + STAMP_SECONDS:
            stamps = tuple(_stamp(file) for file in watched_files(run.model))
            if self._schedule.stamps.get(fingerprint, stamps) != stamps:
                self._start_again()
            self._schedule.stamps[fingerprint], self._stamp_time = stamps, now
        self._objects = objects

    def _start_again(self) -> None:
        self._schedule.served.clear()
        self._schedule.restarts += 1


def watched_files(model: Model) -> list[str]:
    """Files of the source code of a model and of its attributes, and those that it names as ``watched_files``."""
    things = [model, *getattr(model, "__dict__", {}).values()]
    modules = {getattr(thing, "__module__", None) or "" for thing in things} | {type(model).__module__}
    files = {getattr(sys.modules.get(module), "__file__", None) for module in modules if isinstance(module, str)}
    files |= {str(file) for file in getattr(model, "watched_files", ())}
    return sorted(file for file in files if file)


def _stamp(file: str) -> tuple[int, int] | None:
    """Size and time of modification of a file; None if it does not exist."""
    try:
        status = os.stat(file)
    except OSError:
        return None
    return status.st_size, status.st_mtime_ns


def _is_transient(reason: str) -> bool:
    """Whether a simulation failed for a reason that says nothing about the model."""
    return isinstance(reason, TransientReason)
