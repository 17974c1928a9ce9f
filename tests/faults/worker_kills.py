"""Kills workers at random while simulations run, and checks that nothing but an answer of the model is stored.

``python -m tests.faults.worker_kills [--points 300] [--seed 1]`` prints one line per kind of pool: kills, points that
failed in the run, those of them with a record, wrong values, simulations of a later run with the same cache, and
whether its values are those of a run without kills.
"""

import argparse
import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.model import simulate_batch
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Treacherous, descendants, line, posterior_of

__all__ = ["main"]

SECONDS = 0.04  # of a simulation
MARK = b"fe_likelihoods.simulation.worker"


class Slow(Treacherous):
    """A line, after some time."""

    fingerprint = "slow"

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        return slow(theta)


def slow(theta: np.ndarray) -> np.ndarray:
    """A line, after some time."""
    time.sleep(SECONDS)
    return line(theta)


def _kill(done: threading.Event, seed: int, kills: list[int], pause: float) -> None:
    """Kill a worker at random, about once in a time [s]."""
    random = np.random.default_rng(seed)
    while not done.wait(pause * random.uniform(0.8, 1.6)):
        workers = []
        for pid in descendants(os.getpid()):
            try:
                if MARK in Path(f"/proc/{pid}/cmdline").read_bytes():
                    workers.append(pid)
            except OSError:
                continue
        if workers:
            kills.append(int(random.choice(workers)))
            try:
                os.kill(kills[-1], signal.SIGKILL)
            except ProcessLookupError:
                kills.pop()


def main() -> None:
    """Run both kinds and print their lines."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.worker_kills", description=__doc__)
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    x = np.random.default_rng(options.seed).uniform(0.0, 1.0, (options.points, 3))
    expected = posterior_of(Treacherous())(x)
    models = {
        "pool of two processes": Slow(),
        "the same, isolated in each": FunctionModel(slow, Slow.parameter_names, CHANNELS, DT, N_STEPS, isolated=True),
    }
    for name, model in models.items():
        with tempfile.TemporaryDirectory() as folder:
            done, kills = threading.Event(), []
            posterior = posterior_of(model, pool=2, cache=Path(folder) / "cache.sqlite")
            start = time.monotonic()
            with LocalPool(2) as pool:
                simulate_batch(model, x[:2, :2], pool)
            # three workers in succession that die while they start end a run
            pause = max(1.0, 1.5 * (time.monotonic() - start))
            killer = threading.Thread(target=_kill, args=(done, options.seed, kills, pause))
            killer.start()
            try:
                values = posterior(x)
            finally:
                done.set()
                killer.join()
            report, failed = posterior.report(), np.isneginf(values)
            pool = posterior.likelihood.simulator.pool
            later = posterior_of(model, pool=pool, cache=posterior.likelihood.simulator.cache)
            equal = np.array_equal(later(x), expected)
            pool.close()
            posterior.likelihood.simulator.cache.close()
        wrong = int(np.sum(values[~failed] != expected[~failed]))
        print(
            f"{name}: {len(kills)} kills, {failed.sum()} of {len(x)} points failed, {report['transient_failures']} of "
            f"them recorded, {wrong} wrong values; a later run simulated {later.report()['simulations']} points, its "
            f"values are {'those' if equal else 'NOT those'} of a run without kills"
        )


if __name__ == "__main__":
    main()
