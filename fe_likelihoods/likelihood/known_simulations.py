"""Results of earlier simulations: statistics in memory and on disk, then responses in memory and on disk.

Statistics are computed from a cached response, which is in double precision, with the same bits as from a new
simulation.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from ..cache.comparison import VerifyingRun
from ..cache.memory import MemoryCache, ResponseMemory, thetas_of
from ..cache.verification import StaleCache
from ..simulation.model import SimulationBatch, misfit_of_responses, most_responses
from .checked_model import CheckedModel
from .failure_log import FailureLog

__all__ = ["KnownSimulations", "Requested"]


class Requested(NamedTuple):
    """Distinct simulations that were requested, with arrays that are filled in."""

    keys: list[bytes]  # n keys, see `distinct_keys`
    thetas: np.ndarray  # structural parameters (n, n_structural)
    misfit: np.ndarray  # statistics (n, n_numbers), NaN where not known
    known: np.ndarray  # (n,) whether the statistics are known, including failures
    reasons: list[str]  # of n failures
    response: np.ndarray | None  # (n, n_channels, n_steps), if requested
    cached: np.ndarray  # (n,) whether no simulation was needed
    on_disk: np.ndarray  # (n,) whether the result came from the disk

    @classmethod
    def of(
        cls,
        keys: list[bytes],
        n_structural: int,
        misfit: np.ndarray,
        known: np.ndarray,
        response: np.ndarray | None = None,
    ) -> "Requested":
        """A request whose statistics are in memory where `known`."""
        n, thetas = len(keys), thetas_of(keys, n_structural)
        return cls(keys, thetas, misfit, known, [""] * n, response, np.zeros(n, bool), np.zeros(n, bool))


class KnownSimulations:
    """Results of one model in memory and on disk, where the statistics are stored under the declared identity `key`.

    `checked` gives access to the rows on disk; failures that are found are recorded in `failures`.
    """

    def __init__(
        self, key: str, memory: MemoryCache, responses: ResponseMemory, checked: CheckedModel, failures: FailureLog
    ) -> None:
        self.memory, self.responses = memory, responses
        self._key, self._checked, self._failures = key, checked, failures
        self._has_repeated_remark = False

    def clear(self) -> None:
        """Empty the caches in memory, because their results may belong to another model."""
        self.memory.clear()
        self.responses.clear()

    def earlier_points(self, run: VerifyingRun) -> list[tuple[np.ndarray, np.ndarray]]:
        """Parameters and statistics of a successful simulation in memory, if there is one, to be run again."""
        thetas = self.memory.successes(len(run.model.parameter_names))[:1]
        statistics, _ = self.memory.look_up([theta.tobytes() for theta in thetas], run.n_numbers)
        return list(zip(thetas, statistics, strict=True))

    def fill(self, requested: Requested, run: VerifyingRun) -> None:
        """Fill in what is known; some rows of the disk may be simulated again for verification."""
        self._fill_statistics(requested, run)
        if requested.response is None and requested.known.all():  # the usual case, and the fastest
            requested.cached[:] = True
            return
        failed = requested.known & ~np.isfinite(requested.misfit).all(axis=1)
        # a failure needs no response
        requested.cached[:] = requested.known if requested.response is None else failed
        self._name_failures(requested, np.flatnonzero(failed), run)
        left = np.flatnonzero(~requested.cached)
        size = most_responses(run.model)
        for start in range(0, len(left), size):
            self._fill_responses(requested, left[start : start + size], run)

    def _fill_statistics(self, requested: Requested, run: VerifyingRun) -> None:
        """Fill in statistics from the cache on disk; they are then cached in memory, and failures recorded."""
        new = np.flatnonzero(~requested.known)
        if self._checked.rows is None or not len(new):
            return
        stored = self._verified(self._checked.rows.look_up, self._key, requested.thetas[new], run)
        known = stored.known
        rows = new[known]
        requested.misfit[rows] = stored.values[known]
        requested.known[rows] = requested.on_disk[rows] = True
        for row, reason in zip(new, stored.reasons, strict=True):
            requested.reasons[row] = reason
        self._note(requested, rows, run)

    def _verified(self, look_up: Callable, *arguments: Any) -> Any:
        """Rows from the disk. Some are simulated again; if they differ, the caches in memory are emptied."""
        try:
            return look_up(*arguments)
        except StaleCache:
            self.clear()
            raise

    def _fill_responses(self, requested: Requested, rows: np.ndarray, run: VerifyingRun) -> None:
        """Fill in rows whose responses are cached, and their statistics where these are not known."""
        model, stored_rows = run.model, self._checked.rows
        outcomes: list[np.ndarray | str | None] = [None] * len(rows)
        keys = [requested.keys[row] for row in rows]
        if len(self.responses):
            outcomes = self.responses.look_up(model.fingerprint, keys)
        left = [place for place, outcome in enumerate(outcomes) if outcome is None]
        if stored_rows is not None and left:
            stored = self._verified(stored_rows.look_up_responses, requested.thetas[rows[left]], run)
            found = [(place, response) for place, response in zip(left, stored, strict=True) if response is not None]
            for place, response in found:
                outcomes[place] = response
                requested.on_disk[rows[place]] = True
            if requested.response is not None and found:
                found_keys = [keys[place] for place, _ in found]
                self.responses.store(model.fingerprint, found_keys, [response for _, response in found])
        places = [place for place, outcome in enumerate(outcomes) if outcome is not None]
        if not places:
            return
        rows, outcomes = rows[places], [outcomes[place] for place in places]
        nothing = np.full((len(model.channels), model.n_steps), np.nan)
        reasons = [outcome if isinstance(outcome, str) else "" for outcome in outcomes]
        response = np.array([nothing if isinstance(outcome, str) else outcome for outcome in outcomes])
        if requested.response is not None:
            requested.response[rows] = response
        new = np.flatnonzero(~requested.known[rows])
        if len(new):
            batch = SimulationBatch(response[new], [reasons[place] for place in new])
            misfit, reasons_of_new = misfit_of_responses(model, batch, run.measured, run.statistic)
            requested.misfit[rows[new]], requested.known[rows[new]] = misfit, True
            for row, reason in zip(rows[new], reasons_of_new, strict=True):
                requested.reasons[row] = reason
                if reason and requested.response is not None:
                    requested.response[row] = np.nan
            self._note(requested, rows[new], run)
            if stored_rows is not None:
                stored_rows.store(self._key, requested.thetas[rows[new]], misfit, reasons_of_new, None, 0.0, run)
        requested.cached[rows] = True

    def _note(self, requested: Requested, rows: np.ndarray, run: VerifyingRun) -> None:
        """Count simulations whose statistics came from the disk or from a response, and cache these in memory."""
        if not len(rows):
            return
        self._checked.has_results = True
        if not self._has_repeated_remark:
            self._has_repeated_remark = True
            if self._checked.rows is not None:
                self._checked.rows.cache.repeat_remark(run.model)
        self._failures.count_outcomes(requested.thetas[rows], [requested.reasons[row] for row in rows])
        self.memory.store([requested.keys[row] for row in rows], requested.misfit[rows])

    def _name_failures(self, requested: Requested, rows: np.ndarray, run: VerifyingRun) -> None:
        """Fill in failure reasons where only the statistics were cached."""
        rows = [row for row in rows if not requested.reasons[row]]
        if not rows or requested.response is None:
            return
        outcomes = self.responses.look_up(run.model.fingerprint, [requested.keys[row] for row in rows])
        for row, outcome in zip(rows, outcomes, strict=True):
            requested.reasons[row] = outcome if isinstance(outcome, str) else "the simulation failed before"
