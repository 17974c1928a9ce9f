"""CPU time of this process per 100 simulations of a run with a guide, in 5, 10 and 20 dimensions.

The model costs next to nothing: a Python function with a mildly nonlinear response of two channels with 1000 samples.
What is measured is the search for modes, the emulators, their sampling and the weights.
"""

import time

import numpy as np

from fe_likelihoods import TruncatedNormal
from tests.statistics.case import HardPosterior
from tests.statistics.guided_runs import run

from .rows import Row

__all__ = ["overhead"]


def _features(x: np.ndarray) -> np.ndarray:
    """Every feature depends on two neighbouring parameters."""
    return x * np.sqrt(np.roll(x, 1, axis=1)) / (1.0 + 0.1 * np.roll(x, 2, axis=1))


def _case(d: int) -> HardPosterior:
    prior = {f"p{i + 1}": TruncatedNormal(1.0, 0.3) for i in range(d)}
    truth = np.random.default_rng(d).uniform(0.8, 1.2, (1, d))
    return HardPosterior("mildly nonlinear", prior, _features, _features(truth)[0], n_steps=1000, n_channels=2)


def overhead(repeats: int, dimensions: tuple[int, ...] = (5, 10, 20), budget: int = 1000) -> list[Row]:
    """One row per number of dimensions: the median over repeats, seconds of CPU per 100 simulations."""
    table = []
    for d in dimensions:
        seconds, notes = [], []
        for seed in range(1, repeats + 1):
            posterior = _case(d).posterior(seed, f"overhead {d}")
            posterior.likelihood.model.simulate(np.ones(d))
            start = time.process_time()
            outcome = run(posterior, seed, budget)
            if outcome.failed:
                notes.append(outcome.failed)
                continue
            own = time.process_time() - start - posterior.report()["seconds"]
            seconds.append(100.0 * own / outcome.simulations)
            notes.append(f"{outcome.status}, {outcome.simulations:.0f} runs, ESS {outcome.effective_sample_size:.0f}")
        value = float(np.median(seconds)) if seconds else None
        table.append(Row("guide, CPU per 100 simulations", f"{d} dimensions", value, "s", "; ".join(notes)))
    return table
