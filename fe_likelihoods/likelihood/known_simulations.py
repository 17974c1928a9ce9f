"""Results of earlier simulations: statistics in memory and on disk, then responses in memory and on disk.

Statistics are computed from a cached response, which is in double precision, with the same bits as from a new
simulation.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from ..cache.comparison import VerifyingRun
from ..cache.memory import MemoryCache, ResponseMemory, thetas_of
from ..cache.verification import StaleCache
from ..simulation.model import SimulationBatch, misfit_of_responses, most_responses
from .checked_model import CheckedModel
from .failure_log import FailureLog

__all__ = ["KnownSimulations", "Requested"]


class Requested:
    """Distinct simulations that were requested, of which known results are filled in.

    For n `keys` (see `distinct_keys`): `thetas` (n, n_structural), `statistics` (n, n_numbers), NaN where not known,
    `reasons` of failures, `responses` (n, n_channels, n_steps) if requested, and whether a result is `known` (its
    statistics), complete so that nothing is to be simulated (`done`), read from the disk (`on_disk`).
    """

    def __init__(self, keys: list[bytes], full: bool, run: VerifyingRun) -> None:
        model = run.model
        self.keys, self.thetas = keys, thetas_of(keys, len(model.parameter_names))
        self.finite = np.isfinite(self.thetas).all(axis=1)
        self.reasons = ["" if fine else "the parameters are not finite" for fine in self.finite]
        self.responses = np.full((len(keys), len(model.channels), model.n_steps), np.nan) if full else None
        self.statistics, self.known = np.empty(0), np.empty(0, bool)
        self.on_disk, self.done = np.zeros((2, len(keys)), bool)


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

    def look_up(self, keys: list[bytes], full: bool, run: VerifyingRun) -> Requested:
        """What is known of distinct keys, with responses if `full`; rows of the disk may be simulated to verify them.

        A point whose statistics are known without its response is not done in a `full` request, unless it failed.
        """
        requested = Requested(keys, full, run)
        requested.statistics, known = self.memory.look_up(keys, run.n_numbers)
        requested.known = np.array(known, dtype=bool) | ~requested.finite
        try:
            self._fill(requested, run)
        except StaleCache:
            self.clear()
            raise
        return requested

    def _fill(self, requested: Requested, run: VerifyingRun) -> None:
        stored, full = self._checked.rows, requested.responses is not None
        new = np.flatnonzero(~requested.known)
        if stored is not None and len(new):
            rows = stored.look_up(self._key, requested.thetas[new], run)
            reasons = [rows.reasons[place] for place in np.flatnonzero(rows.known)]
            self._enter(requested, new[rows.known], rows.values[rows.known], reasons, run, on_disk=True)
        requested.done = requested.known.copy()
        if full:  # a failure needs no response
            requested.done[np.isfinite(requested.statistics).all(axis=1)] = False
            for row in np.flatnonzero(requested.done):
                reason = requested.reasons[row] or self._failures.reason(requested.thetas[row])
                requested.reasons[row] = reason or "the simulation failed before"
        left, size = np.flatnonzero(~requested.done), most_responses(run.model)
        if stored is not None or len(self.responses):
            for start in range(0, len(left), size):
                self._fill_from_responses(requested, left[start : start + size].tolist(), run)

    def _fill_from_responses(self, requested: Requested, rows: list[int], run: VerifyingRun) -> None:
        """Fill in rows whose responses are cached, and their statistics where these are not known."""
        model, stored = run.model, self._checked.rows
        found: list[np.ndarray | str | None] = [None] * len(rows)
        if len(self.responses):
            found = self.responses.look_up(run.fingerprint, [requested.keys[row] for row in rows])
        outcomes = {row: outcome for row, outcome in zip(rows, found, strict=True) if outcome is not None}
        left = [row for row in rows if row not in outcomes]
        if stored is not None and left:
            read = zip(left, stored.look_up_responses(requested.thetas[left], run), strict=True)
            from_disk = {row: response for row, response in read if response is not None}
            requested.on_disk[list(from_disk)] = True
            outcomes |= from_disk
            if requested.responses is not None and from_disk:
                keys = [requested.keys[row] for row in from_disk]
                self.responses.store(run.fingerprint, keys, list(from_disk.values()))
        if not outcomes:
            return
        requested.done[list(outcomes)] = True
        new = [row for row in outcomes if not requested.known[row]]
        if requested.responses is not None:
            for row, outcome in outcomes.items():
                requested.responses[row] = np.nan if isinstance(outcome, str) else outcome
        if new:
            responses = np.full((len(new), len(model.channels), model.n_steps), np.nan)
            reasons = [outcomes[row] if isinstance(outcomes[row], str) else "" for row in new]
            for response, row in zip(responses, new, strict=True):
                response[:] = np.nan if isinstance(outcomes[row], str) else outcomes[row]
            batch = SimulationBatch(responses, reasons)
            statistics, reasons = misfit_of_responses(model, batch, run.measured, run.statistic)
            self._enter(requested, new, statistics, reasons, run)
            if stored is not None:
                stored.store(self._key, requested.thetas[new], statistics, reasons, None, 0.0, run)

    def _enter(
        self,
        requested: Requested,
        rows: Sequence[int] | np.ndarray,
        statistics: np.ndarray,
        reasons: list[str],
        run: VerifyingRun,
        on_disk: Any = False,
    ) -> None:
        """Fill in statistics (n, n_numbers) that were not known in memory, cache them there, and count failures."""
        if not len(rows):
            return
        requested.statistics[rows], requested.known[rows] = statistics, True
        requested.on_disk[rows] |= on_disk
        for row, reason in zip(rows, reasons, strict=True):
            requested.reasons[row] = reason
            if reason and requested.responses is not None:
                requested.responses[row] = np.nan
        self._checked.has_results = True
        if not self._has_repeated_remark:
            self._has_repeated_remark = True
            if self._checked.rows is not None:
                self._checked.rows.cache.repeat_remark(run.model)
        self._failures.count_outcomes(requested.thetas[rows], reasons)
        self.memory.store([requested.keys[row] for row in rows], statistics)
