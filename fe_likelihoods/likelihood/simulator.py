"""Simulations of a model and their statistics against measurements: each is run once, counted, cached and verified.

A request first takes what is known (`fe_likelihoods.cache.memo`). The other simulations are run in chunks, in this
process (compiled models on threads) or by a pool, and cached as they arrive. With a pool to which single items can be
submitted there is one chunk, so that nothing waits for a batch. Several threads may send requests.
"""

import hashlib
import os
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from samplers.interrupts import interrupts_end_the_run

from ..cache.memo import Memo
from ..cache.memory import MemoryCache, Requested, ResponseMemory, outcomes_of, thetas_of
from ..cache.simulation_cache import SimulationCache
from ..noise.sufficient_statistics import (
    Statistic,
    check_statistic,
    name_of_statistic,
    needs_response,
    statistic_width,
)
from ..priors.points import as_rows
from ..signals.channels import Comparison, Measurements, compare_with
from ..simulation.executors import as_executor
from ..simulation.files import Observed
from ..simulation.model import (
    Model,
    gathered,
    has_jacobian,
    most_responses,
    sent_simulation,
    simulate_batch,
    unpack,
)
from .failure_log import FailureLog

__all__ = ["Simulator"]

_SECONDS_PER_CHUNK = 5.0  # simulation time between two writes to the cache on disk
_ROUNDS_PER_CHUNK = 8  # simulations per worker and chunk: at the end of a chunk, workers idle half a round on average


class Simulator(Memo):
    """A model's simulations, compared with measurements in the order of the model's channels; each is run once.

    Options are as in `FELikelihood`; the statistic is the sums of squares by default. `measured` are values
    (n_channels, n_steps), or a `Comparison` where samples are missing. `simulations`, `cache_hits` and `disk_hits`
    count simulations run by this object in this process, cached rows, and rows from the disk; `failures` include known
    ones from the disk. `when_simulated` is called with the number that have ended, in this process only. A subclass
    keeps all responses, in memory and on disk, if they are small (`stores_responses`).
    """

    stores_responses = False

    def __init__(
        self,
        model: Model,
        measurements: Measurements,
        statistic: Statistic | None = None,
        *,
        pool: Any = None,
        cache: SimulationCache | str | os.PathLike | None = None,
        memory_rows: int = 100_000,
        memory_bytes: int = 2**28,
    ) -> None:
        self.failures = FailureLog(model.parameter_names)
        self.memory_cache, self.response_memory = MemoryCache(memory_rows), ResponseMemory(memory_bytes)
        measured = compare_with(measurements, model.dt, model.n_steps)
        check_statistic(statistic, measured)
        self.measurements, self.measured = measurements, measured
        self.model, self.statistic, self.pool = model, statistic, as_executor(pool, model)
        self.n_numbers, self._of_response = statistic_width(measured, statistic), needs_response(statistic)
        self.cache = cache if cache is None or isinstance(cache, SimulationCache) else SimulationCache(cache)
        self._label_model()
        text = f"{model.fingerprint} {measurements.fingerprint}{name_of_statistic(statistic)}"
        text += measured.description if isinstance(measured, Comparison) else ""
        self.simulation_key = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        self.n_structural = len(model.parameter_names)
        self.simulations = self.cache_hits = self.disk_hits = 0
        self._most = 1  # simulations between two writes to the cache on disk, adapted to their duration
        self._together = hasattr(model, "simulate_together")
        self.when_simulated: Callable[[int], None] | None = None

    # counts and identity ------------------------------------------------------------------------------------------

    def report(self) -> dict:
        """Summary of the simulations that were requested in this process, see `Posterior.report`."""
        names = ("simulations", "verifications", "unverified", "cache_hits", "disk_hits", "seconds")
        return {name: getattr(self, name) for name in names} | self.failures.report()

    @property
    def fingerprint(self) -> str:
        """Hex digest of all that the statistics depend on: `simulation_key`, and the code when this object was made."""
        text = f"{self.simulation_key} {self.label.identity}"
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    @property
    def cache_keys(self) -> tuple[str, str]:
        """Keys under which a `SimulationCache` stores the statistics and the responses, as `forget` takes them."""
        return self.simulation_key, self.model.fingerprint

    # requests -----------------------------------------------------------------------------------------------------

    def statistics(self, thetas: np.ndarray) -> np.ndarray:
        """Statistics (n, n_numbers) that the noise needs, at structural parameters (n, n_structural), see `run`."""
        return self.run(as_rows(thetas, self.model.parameter_names))

    def run(self, thetas: np.ndarray, possible: Callable[[], np.ndarray] | None = None, full: bool = False) -> Any:
        """Statistics (n, n_numbers) at structural parameters (n, n_structural), NaN if failed.

        With `full`, also a `SimulationBatch` of the responses [SI]: a point whose statistics are cached without its
        response is simulated again, unless it failed. Duplicates are simulated once, results are cached,
        cached ones are reused, and non-finite rows are skipped. Where `possible`, called unless all rows are in memory,
        is False (n,), nothing is simulated and rows may be NaN. Raises `ChangedModel` or `StaleCache`;
        simulations that have ended are cached, except after the model has changed.
        """
        request = Requested(thetas, full, self.model)
        request.outcomes = self.memory_cache.look_up(request.keys)
        if not full and len(request.outcomes) == len(request.keys):
            self.cache_hits += len(thetas)
            return request.statistics(self.n_numbers)
        if possible is not None and not (wanted := possible()).all():
            statistics = np.full((len(thetas), self.n_numbers), np.nan)
            if wanted.any():
                statistics[wanted] = self.run(thetas[wanted])
            return statistics
        trust, new = self._trust, []
        try:
            with trust.lock:  # after what runs for other requests
                trust.lock.wait_for(lambda: trust.running.isdisjoint(request.keys))
                if new := self._look_up(request):
                    self._check_before()  # so that finished simulations are stored
                    self._trust.running.update(new)  # of another label, if the check has made one
            while left := request.left:
                some, start = left[: self._chunk(len(left))], time.perf_counter()
                if self.pool is None or self._together:
                    with self._observed():
                        batch = simulate_batch(self.model, thetas_of(some, self.n_structural), self.pool)
                    self._record(request, some, *batch, start)
                else:
                    self._run_in_pool(request, some, start)
                # grows by steps: the first simulations may be failures that took no time
                rate = len(some) / (time.perf_counter() - start)
                self._most = min(4 * len(some), 1 + int(_SECONDS_PER_CHUNK * rate))
        finally:
            with self._trust.lock:
                self._trust.running.difference_update(new)
                self._trust.lock.notify_all()
        if not full:
            return request.statistics(self.n_numbers)
        responses = [request.responses[request.keys[place]] for place in request.which]
        return request.statistics(self.n_numbers), self._as_batch(responses)

    # simulations --------------------------------------------------------------------------------------------------

    @property
    def streams(self) -> bool:
        """Whether simulations can be submitted to the pool one by one, and not for several data sets at once."""
        return bool(getattr(self.pool, "submits", False)) and not self._together

    def _chunk(self, n: int) -> int:
        """Number of simulations, of n, between two writes to the cache on disk, or two reports of progress."""
        if self.streams:
            return n
        most = min(n, most_responses(self.model))
        if self.cache is None and (self.when_simulated is None or self.pool is not None):
            return most
        workers = (os.cpu_count() or 1) if self.pool is None else self.pool.n_workers or n
        together = self.pool is not None or hasattr(self.model, "simulate_batch")  # then all workers are to be busy
        return min(max(_ROUNDS_PER_CHUNK * workers if together else 1, self._most), most)

    @interrupts_end_the_run()
    def _run_in_pool(self, request: Requested, keys: Sequence[bytes], start: float) -> None:
        """Run simulations in the pool, and record each as it arrives."""
        responses = self._keeps_responses(request.full)
        shape = (len(self.model.channels), self.model.n_steps) if responses else (self.n_numbers,)
        function = sent_simulation(self.model, *(() if responses else (self.measured, self.statistic)))
        function = Observed(function, self.pool.n_workers == 1)
        with closing(self.pool.as_they_end(function, list(thetas_of(keys, self.n_structural)))) as arriving:
            for found in arriving:
                outcomes, ended = list(map(unpack, found.values())), [keys[number] for number in found]
                for _, opened in outcomes:
                    self.label.add(opened)
                if ended:
                    self._record(request, ended, *gathered([outcome for outcome, _ in outcomes], shape), start)

    def _keeps_responses(self, full: bool) -> bool:
        """Whether responses are kept in memory: they were requested, are stored, or gradients may follow."""
        stored = self.stores_responses or (self.cache is not None and self.cache.responses)
        return full or stored or has_jacobian(self.model)

    def _record(
        self, request: Requested, keys: Sequence[bytes], values: np.ndarray, reasons: list[str], start: float
    ) -> None:
        """Count new simulations (responses or statistics), compare the model if that is due, and cache the results."""
        thetas, statistics, why = thetas_of(keys, self.n_structural), values, reasons
        if values.ndim == 3:
            statistics, why = self.statistics_of(values, reasons)
        with self._trust.lock:
            now = time.perf_counter()
            self.seconds += now - max(start, self._counted_until)  # other requests run meanwhile
            self._counted_until = now
            self.simulations += len(thetas)
            if self.when_simulated is not None:
                self.when_simulated(len(thetas))
            self._check_after(thetas, statistics, why)
            if self._keeps_responses(request.full):
                kept = (reason or response.copy() for reason, response in zip(reasons, values, strict=True))
                self.response_memory.store([(request.fingerprint, key) for key in keys], kept)
            if request.full:
                request.responses |= {key: reasons[k] or values[k] for k, key in enumerate(keys)}
            self._enter(request, outcomes_of(keys, statistics, why))
            if self.cache is not None:
                stored = values if request.full or self.stores_responses or self.cache.responses else None
                self._store(thetas, statistics, why, stored, request.fingerprint)
