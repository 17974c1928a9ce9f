"""What is known of simulations: statistics and responses, in memory and on disk, and reasons of failures.

A request takes statistics in memory and on disk first, then responses in memory and on disk, from which the statistics
are computed with the same bits as from a new simulation.
"""

from collections.abc import Sequence

import numpy as np

from ..simulation.model import SimulationBatch, gathered, most_responses
from .memory import Requested, outcomes_of, reason_in, thetas_of
from .verification import StaleCache, VerifiedModel

__all__ = ["Memo"]


class Memo(VerifiedModel):
    """A model with its known simulations: the `memory_cache`, the `response_memory` and the `cache` on disk.

    A subclass has them, and counts: `cache_hits`, `disk_hits`, and `failures` (`FailureLog`).
    """

    def _look_up(self, request: Requested) -> list[bytes]:
        """Fill in what is known, and count it; returns the keys that are to be simulated."""
        finite = np.isfinite(thetas_of(request.keys, self.n_structural)).all(axis=1)
        skipped = [key for key, fine in zip(request.keys, finite, strict=True) if not fine]
        request.enter(self.memory_cache.look_up(request.keys) | dict.fromkeys(skipped, "the parameters are not finite"))
        try:
            if self.cache is not None and not request.full and (left := request.left):
                self._enter(request, read := self._stored(left, request.fingerprint, False))
                self.disk_hits += len(read)
            if self.cache is not None or len(self.response_memory):
                self._take_responses(request)
        except StaleCache:  # results in memory may belong to another model
            self._clear()
            raise
        found = set(request.keys).difference(skipped, left := request.left)
        self.cache_hits += sum([request.keys[place] in found for place in request.which])
        return left

    def _take_responses(self, request: Requested) -> None:
        """Fill in stored responses, and statistics that are not known."""
        left, size, fingerprint = request.left, most_responses(self.model), request.fingerprint
        for start in range(0, len(left), size):
            keys = left[start : start + size]
            in_memory = self.response_memory.look_up([(fingerprint, key) for key in keys])
            found = {key: response for (_, key), response in in_memory.items()}
            missing = [key for key in keys if key not in found]
            if self.cache is not None and missing:
                found |= (read := self._stored(missing, fingerprint, True))
                self.disk_hits += len(read)
                if request.full:
                    self.response_memory.store([(fingerprint, key) for key in read], read.values())
            if request.full:
                request.responses |= found
            if new := [key for key in found if key not in request.outcomes]:
                statistics, reasons = self.statistics_of(*self._as_batch([found[key] for key in new]))
                self._enter(request, outcomes_of(new, statistics, reasons))
                if self.cache is not None:
                    self._store(thetas_of(new, self.n_structural), statistics, reasons, None, fingerprint)

    def _enter(self, request: Requested, outcomes: dict[bytes, bytes | str]) -> None:
        """Fill in statistics and reasons of failures, count these, and cache both in memory."""
        if outcomes:
            thetas = thetas_of(list(outcomes), self.n_structural)
            self.failures.count_outcomes(thetas, list(map(reason_in, outcomes.values())))
            request.enter(outcomes)
            self.memory_cache.store(outcomes, outcomes.values())
            self.has_results = True

    def _as_batch(self, found: Sequence[np.ndarray | str]) -> SimulationBatch:
        """Responses or reasons of failures as a batch."""
        outcomes = [(None, each) if isinstance(each, str) else (each, "") for each in found]
        return SimulationBatch(*gathered(outcomes, (len(self.model.channels), self.model.n_steps)))

    def recall(self, thetas: np.ndarray, statistics: np.ndarray | None, reasons: Sequence[str]) -> None:
        """Cache statistics (n, n_numbers) of an earlier run in memory, at structural parameters (n, n_structural).

        Failures (with a reason) are recorded. Rows that are cached already are not changed. Nothing is written to the
        cache on disk. Without statistics, only failures are cached.
        """
        rows = {theta.tobytes(): row for row, theta in enumerate(thetas + 0.0) if np.isfinite(theta).all()}
        known = self.memory_cache.look_up(rows)
        for key, row in rows.items():
            if key not in known:
                self.failures.count_outcomes(thetas[row : row + 1], [reasons[row]])
                if reasons[row] or statistics is not None:
                    self.memory_cache.store([key], [reasons[row] or statistics[row].tobytes()])
