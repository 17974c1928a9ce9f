"""CPU time of this process per 100 simulations of a run with a guide, in 5, 10 and 20 dimensions, and many channels.

The model costs next to nothing: a Python function with a mildly nonlinear response of two channels with 1000 samples.
What is measured is the search for modes, the emulators, their sampling and the weights. With many channels of 10 000
samples, what is measured as well is the largest resident memory.
"""

import time
from dataclasses import replace

import numpy as np

from fe_likelihoods import TruncatedNormal
from tests.statistics.case import HardPosterior
from tests.statistics.guided_runs import run

from .job import peak_memory
from .processes import in_process
from .rows import Row

__all__ = ["channels", "overhead"]


def _features(x: np.ndarray) -> np.ndarray:
    """Every feature depends on two neighbouring parameters."""
    return x * np.sqrt(np.roll(x, 1, axis=1)) / (1.0 + 0.1 * np.roll(x, 2, axis=1))


def _truth(d: int) -> np.ndarray:
    return np.random.default_rng(d).uniform(0.8, 1.2, (1, d))


def _case(d: int) -> HardPosterior:
    prior = {f"p{i + 1}": TruncatedNormal(1.0, 0.3) for i in range(d)}
    return HardPosterior("mildly nonlinear", prior, _features, _features(_truth(d))[0], n_steps=1000, n_channels=2)


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


class _Timed:
    """Responses (n, n_channels, n_steps) from features, with the CPU time [s] that they took."""

    def __init__(self, shapes: np.ndarray) -> None:
        self.shapes, self.seconds = shapes, 0.0

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        start = time.process_time()
        response = np.tensordot(_features(theta), self.shapes, axes=1)
        self.seconds += time.process_time() - start
        return response


def _run_of_channels(n_channels: int, budget: int) -> dict:
    """A guided run in 6 dimensions with channels of 10 000 samples, noise levels integrated out."""
    case = replace(_case(6), n_channels=n_channels, n_steps=10_000)
    respond = _Timed(case.shapes)
    posterior = replace(case, respond=respond, truth=_truth(6)[0]).posterior(1, f"{n_channels} channels")
    start = time.process_time()
    outcome = run(posterior, 1, budget)
    if outcome.failed:
        return {"reason": outcome.failed}
    own = time.process_time() - start - respond.seconds
    note = f"{outcome.status}, {outcome.simulations:.0f} runs, ESS {outcome.effective_sample_size:.0f}"
    return {"seconds": 100.0 * own / outcome.simulations, "memory": peak_memory(), "reason": note}


def channels(repeats: int, channels: tuple[int, ...] = (6, 60, 278), budget: int = 1000) -> list[Row]:
    """Two rows per number of channels: CPU time per 100 simulations, and the largest resident memory."""
    table = []
    for n in channels:
        answers = [in_process(_run_of_channels, n, budget, limit=600.0) for _ in range(repeats)]
        notes = "; ".join(dict.fromkeys(answer["reason"] for answer in answers))
        for what, key, unit in (("CPU per 100 simulations", "seconds", "s"), ("largest memory", "memory", "MB")):
            values = [answer[key] for answer in answers if key in answer]
            value = float(np.median(values)) if values else None
            table.append(Row(f"guide, {what}", f"{n} channels of 10 000 samples", value, unit, notes))
    return table
