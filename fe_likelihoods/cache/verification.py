"""A model with simulations in a cache: whether it is still the same, and which stored simulations are its own.

The table in ``docs/parallel.rst`` says which stored rows are simulated again. Rows belong to a generation, the
simulations of one state of a model; the file says to which generation a label (`fe_likelihoods.simulation.label`)
belongs, and unknown labels are added to one (adoption) or begin another one.
"""

import logging
import math
import os
import secrets
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from hashlib import blake2b
from itertools import islice
from typing import Any

import numpy as np

from samplers.interrupts import process_name

from ..noise.sufficient_statistics import relative_changes
from ..simulation.failure_reasons import ChangedModel, TransientReason
from ..simulation.files import Observer, digests_by_name, read_again
from ..simulation.label import ModelLabel
from ..simulation.model import SimulationBatch, misfit_of_responses, most_responses, simulate_batch
from .memory import thetas_of
from .simulation_cache import TOLERANCE, Row, pack_rows

__all__ = ["ROWS", "StaleCache", "Trust", "VerifiedModel"]

logger = logging.getLogger(__name__)

ROUNDING = 1e-13  # relative error of a sum of squares, since processors add the terms in different orders
ROWS = 59  # find a change of 5 % of the space with 95 %: 0.95 ** 59 < 0.05
FIRST_ROWS = 2  # rows verified before the first row is used, if the label is known
SHARE_OF_TIME = 0.01  # for comparisons of the model
ROWS_PER_VERIFICATION = round(1.0 / SHARE_OF_TIME)  # one in so many used rows is simulated again
FINGERPRINT = "its fingerprint"
OF_A_PROCESS = ("environment ", "library", "package ", "python", "source of ")  # items that differ between processes
CHANGED = (
    "Something has changed that neither its declared identity nor its label contains, or the model does not repeat its "
    "results or failures (make them depend on the parameters alone, for example with a fixed seed). Delete its rows "
    "with likelihood.simulator.cache.forget(*likelihood.simulator.cache_keys), or give the model a new version= (or "
    "depends_on=). A small difference from rounding, as on another machine, is accepted with SimulationCache(path, "
    "tolerance=...)"
)


class StaleCache(ValueError):
    """A stored simulation differs from a new one with the same parameters. The message says what to do.

    It is raised again, for any row, as long as rows are stored. Samplers stop (`ends_run`), since no point can be
    evaluated any more.
    """

    ends_run = True


class Trust:
    """The label of a model, and which rows of a file this process trusts; likelihoods with one `key` share it.

    `labels` has code, files and generation by the model's fingerprint; `used` counts rows that were used after a
    verification, by identity, apart from failures alone. Rows with the number of the `session` were stored here and
    need no verification. `stale` is the message on a row that differed, `running` are simulations that run now.
    """

    def __init__(self, key: str) -> None:
        self.key, self.label, self.stale, self._owner = key, None, "", 0
        self.labels: dict[str, tuple[str, dict[str, str], int]] = {}
        self.used: dict[str, int] = {}
        self.running: set[bytes] = set()

    @staticmethod
    def of(label: ModelLabel, key: str) -> "Trust":
        """The object of this process with a key; a new one the first time."""
        trust = _trust(key)
        trust.label = trust.label or label
        return trust

    def __reduce__(self) -> tuple:
        return Trust.of, (self.label, self.key)

    @property
    def lock(self) -> threading.Condition:
        """Lock of this process; replaced after a fork, when another thread of the parent may have held it."""
        if self._owner != os.getpid():
            self._lock, self._owner, self.session = threading.Condition(), os.getpid(), secrets.randbits(62)
            self.running.clear()
        return self._lock

    def due(self, kind: str, n: int) -> int:
        """Number of rows to verify when n rows are used."""
        first = 0 if kind in self.used else 1 if self.used else FIRST_ROWS  # one where other rows of the code agreed
        before = self.used.get(kind, 0)
        self.used[kind] = before + n
        return first + (max(0, before + n) // ROWS_PER_VERIFICATION - max(0, before) // ROWS_PER_VERIFICATION)


_trust = lru_cache(32)(Trust)


class VerifiedModel:
    """A model compared with measurements, whose simulations may be stored in a `SimulationCache`.

    `label` identifies the model when it was first simulated. Derived likelihoods and copies share its `Trust`.
    `verifications` counts simulations that were made again, `unverified` rows whose new simulation was stopped (not by
    the model), `seconds` is the wall time of simulations [s]; `has_results` says whether results are known in this
    process. All else has the `Simulator`; methods take the model's `fingerprint`, one for a request.
    """

    verifications = unverified = 0
    seconds = 0.0
    # in a process before its first simulation: points are the first and latest success with its statistics, and those
    # since the last comparison; times [s] are those of the next comparison, and of the last end of a run
    _begun = {"has_results": False, "_points": (), "_unchecked": (), "_not_before": 0.0, "_counted_until": 0.0}

    def _label_model(self) -> None:
        label = ModelLabel(self.model, self.statistic)
        self._trust = Trust.of(label, secrets.token_hex(16))
        self._known: dict[str, str | None] = label.items | {FINGERPRINT: self.model.fingerprint}
        self._labelled_by = process_name()
        vars(self).update(self._begun)

    def __getstate__(self) -> dict:
        return vars(self) | self._begun | {"pool": None, "when_simulated": None}

    @property
    def label(self) -> ModelLabel:
        """Label of the model."""
        return self._trust.label

    def share_trust(self, other: "VerifiedModel") -> None:
        """Trust rows that another object has verified or stored, if its model is the same, or has the same code."""
        if self.model is other.model or other.label.code == self.label.code:
            self._trust = other._trust

    def statistics_of(self, responses: np.ndarray, reasons: list[str]) -> tuple[np.ndarray, list[str]]:
        """Statistics (n, n_numbers) of responses (n, n_channels, n_steps) [SI], and reasons of failures."""
        return misfit_of_responses(self.model, SimulationBatch(responses, reasons), self.measured, self.statistic)

    # new simulations ----------------------------------------------------------------------------------------------

    @contextmanager
    def _observed(self) -> Iterator[None]:
        """Add what the simulations in a ``with`` block open to the label, if it observes simulations."""
        if not self.label.observes:
            yield
            return
        with Observer() as observer:
            yield
        self.label.add(observer.result(self.label.opened) if self.pool is None else observer.noted)

    def _simulate_again(self, thetas: np.ndarray) -> list[tuple[np.ndarray, str, np.ndarray]]:
        """Statistics (n_numbers,), reason of a failure and norms (n_channels,) of the response [SI], for each row."""
        start, rows, size = time.perf_counter(), [], most_responses(self.model)
        for first in range(0, len(thetas), size):
            with self._observed():
                batch = simulate_batch(self.model, thetas[first : first + size], self.pool)
            misfit, reasons = self.statistics_of(*batch)
            with np.errstate(over="ignore", invalid="ignore"):
                norms = np.linalg.norm(batch.response, axis=2)
            rows += zip(misfit, reasons, norms, strict=True)
        self.seconds += time.perf_counter() - start
        self.verifications += len(thetas)
        return rows

    def _difference(self, earlier: np.ndarray, reason: str, now: np.ndarray, why: str, norm: np.ndarray) -> str:
        """How a simulation differs from an earlier one by more than the tolerance of the cache; zero: in any bit."""
        if reason or why:
            was, did = (f"failed ({text})" if text else "succeeded" for text in (reason, why))
            return "" if reason and why else f"it {was}; simulated again, it {did}"
        tolerance = TOLERANCE if self.cache is None else self.cache.tolerance
        change = relative_changes(earlier, now, norm, self._of_response, ROUNDING if tolerance else 0.0)
        worst, n = int(np.argmax(np.nan_to_num(change, nan=np.inf))), len(norm)
        if change[worst] <= tolerance:
            return ""
        what = "sum of squared residuals" if worst < n else f"statistic {worst}"
        values = f"stored {earlier[worst]:.17g}, simulated again {now[worst]:.17g} (relative: {change[worst]:.1e})"
        return f"channel {self.measurements.channels[worst % n].name!r}, {what}: {values}"

    # changes of the model -----------------------------------------------------------------------------------------

    def _check_before(self) -> None:
        """Label the model as it is now, if nothing was simulated or used yet.

        Raises `ChangedModel` if this object was pickled in another process, where the code has other values.
        """
        if self._points or self.has_results:
            return
        changed = self._changes() - self.label.changing
        found = sorted(name for name in changed if not name.startswith(OF_A_PROCESS))
        if found and self._labelled_by != process_name():
            raise ChangedModel(
                f"the {type(self.model).__name__} in this process is not the one that was sent ({', '.join(found[:3])} "
                "differ): modules have other contents or values here. Give the pool to the likelihood, "
                "FELikelihood(..., pool=...), which sends code and values, or make a new likelihood"
            )
        if changed:
            self._label_model()

    def _check_after(self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str]) -> None:
        """Compare the model after simulations, unless the last comparison was too recent.

        Raises `ChangedModel`; what was simulated since the last comparison, on either side of the change, is dropped.
        """
        self._unchecked += (thetas,)
        is_first, succeeded = not self._points, [row for row, reason in enumerate(reasons) if not reason]
        points = [(thetas[row].copy(), misfit[row].copy()) for row in succeeded[:1] + succeeded[-1:]]
        self._points = [*(self._points or points)[:1], *points[-1:]]
        if not self._points or (start := time.monotonic()) < self._not_before:
            return
        if changed := self._changes():
            # the first simulation may change values itself
            is_own = FINGERPRINT not in changed and ((is_first and self.pool is None) or self._repeats())
            if not is_own:
                self._clear()
                for *_, generation in self._trust.labels.values():
                    places = self.simulation_key, self.model.fingerprint
                    self.cache.discard(np.concatenate(self._unchecked), *places, generation=generation)
                raise ChangedModel(
                    f"the {type(self.model).__name__} has changed since the likelihood was made (different: "
                    f"{', '.join(sorted(changed)[:3])}): another model was set, or a value or file that it uses, so "
                    "that an earlier simulation gives another result. Make a new model and a new likelihood; what "
                    "varies during a run has to be a parameter"
                )
            self.label.has_changed_itself(changed)
            now = self.label.present(self.model)
            self._known |= {name: now.get(name) for name in changed}
        self._unchecked = ()
        now = time.monotonic()
        self._not_before = now + (now - start) / SHARE_OF_TIME

    def _clear(self) -> None:
        self.memory_cache.clear()
        self.response_memory.clear()

    def _changes(self) -> set[str]:
        """Names of what has changed; a file counts from when a simulation opened it."""
        known = digests_by_name(self.label.opened) | self._known
        now = self.label.present(self.model) | {FINGERPRINT: self.model.fingerprint}
        return {name for name in known.keys() | now.keys() if known.get(name) != now.get(name)}

    def _repeats(self) -> bool:
        """Whether the first and latest simulation give the earlier results again (user code has counted), or never."""
        thetas, earlier = np.array([theta for theta, _ in self._points]), [misfit for _, misfit in self._points]
        for is_original in (True, False):
            new = self._simulate_again(thetas)
            ended = [
                (was, *now) for was, now in zip(earlier, new, strict=True) if not isinstance(now[1], TransientReason)
            ]
            if not any(self._difference(was, "", *now) for was, *now in ended):
                return is_original
            earlier = [misfit for misfit, *_ in new]
        return True

    # stored rows --------------------------------------------------------------------------------------------------

    def _store(
        self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], responses: np.ndarray | None, fingerprint: str
    ) -> None:
        """Store simulations under the model's label: statistics, responses if given, and failures of the model."""
        trust = self._trust
        if {TransientReason}.issuperset(map(type, reasons)) or not (generation := self._generation(fingerprint)):
            return
        self._use(fingerprint, generation)
        rows = pack_rows(self.simulation_key, thetas, misfit, reasons, generation, trust.session)
        values = np.zeros((len(thetas), 0)) if responses is None else responses
        # without a response, only failures; a failure of the statistic alone has one
        finite = np.zeros(len(thetas), bool) if responses is None else np.isfinite(responses).all(axis=(1, 2))
        if chosen := [row for row, reason in enumerate(reasons) if reason or finite[row]]:
            why = ["" if finite[row] else reasons[row] for row in chosen]
            rows += pack_rows(fingerprint, thetas[chosen], values[chosen], why, generation, trust.session, True)
        self.cache.write(rows)

    def _stored(self, keys: Sequence[bytes], fingerprint: str, of_responses: bool) -> dict[bytes, Any]:
        """Stored statistics (bytes), or responses (n_channels, n_steps) [SI], and reasons of failures, by key.

        Some are verified; `StaleCache` if one differs and the label is known.
        """
        shape = (len(self.model.channels), self.model.n_steps) if of_responses else (self.n_numbers,)
        identity, generation = fingerprint if of_responses else self.simulation_key, self._generation(fingerprint)
        thetas = thetas_of(keys, len(self.model.parameter_names))
        rows = self.cache.look_up(identity, thetas, math.prod(shape), generation)
        self._verify(identity, rows, generation, math.prod(shape))
        found = {key: row.outcome for key, row in zip(keys, rows, strict=True) if row is not None}
        if of_responses:
            found |= {key: np.frombuffer(x, "<f8").reshape(shape) for key, x in found.items() if isinstance(x, bytes)}
        return found

    # generations --------------------------------------------------------------------------------------------------

    def _generation(self, fingerprint: str) -> int:
        """The generation of a label with the present contents of its files, or of rows that agree; else a new one.

        Files that belong to other labels of the model count from now on.
        """
        known = self._trust.labels
        if fingerprint not in known:
            stored = self.cache.labels_of(fingerprint)
            for _, files, _ in stored:
                self.label.add(read_again(files))
            same = [each for each in stored if each[0] == self.label.code and read_again(each[1]) == each[1]]
            if not same:  # it is stored with the first row
                same = [("", {}, next((each[2] for each in known.values()), 0) or self._adopted(fingerprint))]
            if not same[-1][2]:  # it is not known which rows agree
                return 0
            known.setdefault(fingerprint, same[-1])
        return known[fingerprint][2]

    def _adopted(self, fingerprint: str) -> int:
        """The generation that new simulations agree with, else a new one."""
        identities = {self.simulation_key: self.n_numbers, fingerprint: len(self.model.channels) * self.model.n_steps}
        stored = list(dict.fromkeys(each for identity in identities for each in self.cache.generations_of(identity)))
        if stored:
            what = f"are used if {ROWS} of them agree with new simulations"
            self._say("the code, a file, a package or the machine is not that of stored simulations, which %s", what)
        waits = False
        for generation in stored:
            choices = (self.cache.some_rows(each, generation, width, ROWS) for each, width in identities.items())
            rows = next((rows for rows in choices if len(rows) == ROWS and not all(row.reason for row in rows)), [])
            compared, stopped, other = self._compare(rows, ROWS)
            if other is None and compared >= ROWS / 2:
                self._trust.used |= dict.fromkeys(identities, -ROWS_PER_VERIFICATION * compared)
                self._say("%d stored simulations agree with new ones: all are used", compared)
                self._use(fingerprint, generation)
                return generation
            waits |= other is None and bool(stopped)
        if waits:  # as without a licence: later simulations decide
            return 0
        if stored:
            self._say("stored simulations differ from new ones, or are too few: they stay in the file, not used")
        # the one that another process begins under the same label
        text = f"{self.label.code} {sorted(digests_by_name(self.label.opened).items())} {stored}".encode()
        return int.from_bytes(blake2b(text, digest_size=8).digest()) >> 2 | 1

    def _use(self, fingerprint: str, generation: int) -> None:
        """Store to which generation the label belongs, with the files that simulations have opened by now."""
        labels, label = self._trust.labels, (self.label.code, self.label.opened, generation)
        if (before := labels.get(fingerprint, ("",))) != label:
            labels[fingerprint] = label
            self.cache.store_label(fingerprint, label, before if before[0] else None)

    def _say(self, text: str, *values: Any) -> None:
        logger.warning(f"%s, {type(self.model).__name__}: {text}", self.cache.path, *values)

    # comparisons of rows ------------------------------------------------------------------------------------------

    def _verify(self, identity: str, rows: list[Row | None], generation: int, width: int) -> None:
        """Verify some of the rows that were found; `StaleCache` if one differs."""
        trust = self._trust
        others = [row for row in rows if row is not None and row.session != trust.session]
        if not others:
            return
        if trust.stale:
            raise StaleCache(trust.stale)
        latest, kind = [], identity
        if identity not in trust.used:
            latest = self.cache.some_rows(identity, generation, width, 1, other_than=trust.session)
        # at random, failures last; the user's random numbers do not change
        shuffled = sorted(others, key=lambda row: (bool(row.reason), secrets.randbits(62)))
        chosen = latest + [row for row in shuffled if row not in latest]
        if chosen[0].reason and identity not in trust.used:
            kind += " failures"  # alone, they verify no successes, which may be used later
        used = sum(trust.used.values())
        compared, stopped, other = self._compare(chosen, trust.due(kind, len(others)))
        if other is not None:
            self._refuse(*other, used)
        if stopped:
            text = "%d of %d stored simulations could not be verified, because the new simulation was stopped (%s)"
            self._say(text, len(stopped), len(stopped) + compared, stopped[0])

    def _compare(self, rows: Iterable[Row], n: int) -> tuple[int, list[str], tuple[Row, str] | None]:
        """Simulate rows again, in growing batches, until n are compared, one differs, or too many stop.

        Returns how many agree, the reasons of new simulations that were stopped, and how which row differs.
        """
        rows, compared, stopped = iter(rows), 0, []
        while compared < n and len(stopped) <= FIRST_ROWS + compared:
            chosen = list(islice(rows, min(3 * compared + 1, n - compared)))
            if not chosen:
                break
            again = self._simulate_again(np.array([np.frombuffer(row.theta, dtype="<f8") for row in chosen]))
            if self.pool is None and self.label.observes:
                self.label.has_changed_itself(self._changes())
            for row, new in zip(chosen, again, strict=True):
                if isinstance(new[1], TransientReason):
                    stopped.append(new[1])
                    self.verifications, self.unverified = self.verifications - 1, self.unverified + 1
                    continue
                misfit, reason = np.frombuffer(row.value, dtype="<f8"), row.outcome if row.reason else ""
                if not reason and row.size is not None:  # a response
                    (misfit,), (reason,) = self.statistics_of(misfit.reshape(1, len(self.model.channels), -1), [""])
                if difference := self._difference(misfit, reason, *new):
                    return compared, stopped, (row, difference)
                compared += 1
        return compared, stopped, None

    def _refuse(self, row: Row, difference: str, used: int) -> None:
        """Raise `StaleCache`, now and for all rows until they are deleted."""
        trust, theta = self._trust, np.frombuffer(row.theta, dtype="<f8")
        trust.used, trust.session = {}, secrets.randbits(62)
        point = ", ".join(f"{n} = {value:.17g}" for n, value in zip(self.model.parameter_names, theta, strict=True))
        trust.stale = f"{self.cache.path}: a stored simulation is not that of this {type(self.model).__name__}. "
        trust.stale += f"At {point}: {difference}. {CHANGED}"
        trust.stale += f". Discard this run, which has used {used} rows" if used > 0 else ""
        raise StaleCache(trust.stale)
