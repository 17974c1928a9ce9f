"""Time to read a simulation from the cache and to store it, in microseconds per row."""

import pickle
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np

from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.problems import bridge_column

from .rows import Row

__all__ = ["cache"]

LIMIT_MEMORY, LIMIT_DISK = 10.0, 60.0
LIMIT_POSTERIOR_MEMORY, LIMIT_POSTERIOR_DISK = 50.0, 300.0


def _seconds(function: Callable, *arguments) -> float:
    start = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - start


def _fresh(likelihood: FELikelihood, path: Path) -> FELikelihood:
    """A likelihood with an empty memory cache and an open file."""
    other = FELikelihood(likelihood.model, likelihood.measurements, cache=SimulationCache(path, verify=False))
    other.simulator.cache.look_up("", np.zeros((1, 5)), 2, 1)
    return other


def cache(repeats: int, stored: int = 100_000) -> list[Row]:
    """Times per row of the bridge column, with a file of `stored` rows, at least 10 000."""
    rng = np.random.default_rng(1)
    thetas = rng.uniform(0.5, 1.5, size=(stored, 5))
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cache.sqlite"
        # the stored numbers are random, so they cannot be verified
        likelihood = bridge_column(cache=SimulationCache(path, verify=False)).likelihood
        n_steps, key = likelihood.measurements.n_steps, likelihood.simulator.simulation_key
        misfit = rng.uniform(size=(stored, 2))

        def store(batch: np.ndarray) -> None:
            likelihood.simulator.cache.store(key, thetas[batch], n_steps, misfit[batch], [""] * len(batch), 1.0, 1)

        for start in range(0, stored, 1000):
            store(np.arange(start, start + 1000))
        for size in (1, 500):
            memory, disk, added = [], [], []
            for _ in range(repeats):
                other = _fresh(likelihood, path)
                batches = rng.choice(stored, size=(20, size), replace=False)
                disk.append(median(_seconds(other.misfit, thetas[batch]) for batch in batches) / size)
                memory.append(median(_seconds(other.misfit, thetas[batch]) for batch in batches) / size)
                if other.simulations or other.simulator.disk_hits != 20 * size:
                    raise RuntimeError(f"expected {20 * size} rows from disk, got {other.simulator.disk_hits}")
                thetas[batches] += 1.0  # not yet in the cache
                added.append(median(_seconds(store, batch) for batch in batches) / size)
            case = f"batches of {size}"
            rows += [
                Row(
                    "cache, wall time per row",
                    f"from memory, {case}",
                    1e6 * median(memory),
                    "us",
                    f"at most {LIMIT_MEMORY:g}",
                ),
                Row(
                    "cache, wall time per row",
                    f"from disk, {case}",
                    1e6 * median(disk),
                    "us",
                    f"at most {LIMIT_DISK:g}",
                ),
                Row("cache, wall time per row", f"stored, {case}", 1e6 * median(added), "us"),
            ]
        posterior = bridge_column(cache=SimulationCache(path, verify=False))
        points = np.hstack([thetas[:200], np.full((200, 2), 0.1)])
        posterior(points[0])  # opens the file
        for place, limit in (("disk", LIMIT_POSTERIOR_DISK), ("memory", LIMIT_POSTERIOR_MEMORY)):
            one = 1e6 * median(_seconds(posterior, point) for point in points[1:])
            rows.append(Row("posterior, wall time of one point", f"from {place}", one, "us", f"at most {limit:g}"))
        if posterior.report()["disk_hits"] != 200:
            raise RuntimeError(f"expected 200 rows from disk, got {posterior.report()['disk_hits']}")
        likelihood.simulator.cache.close()
        size = path.stat().st_size
        opened = median(_seconds(SimulationCache, path) for _ in range(repeats))
        copies = [pickle.loads(pickle.dumps(likelihood)) for _ in range(repeats)]
        reopened = median(_seconds(copy.misfit, thetas[:1]) for copy in copies)
    return [
        *rows,
        Row("cache, opened and checked", f"{stored} rows", 1e3 * opened, "ms", f"{size / stored:.0f} bytes per row"),
        Row("cache, first row in another process", f"{stored} rows", 1e3 * reopened, "ms"),
    ]
