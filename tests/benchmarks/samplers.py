"""Every mode of the samplers on the targets: evaluations, how wrong the answer is, and whether the run warned."""

import time
import warnings

from samplers import (
    CHING_CHEN_2007,
    RAMANCHA_2022_CONSTANT,
    RAMANCHA_2022_LITERAL,
    SamplingWarning,
    SMCSampler,
    TMCMCSampler,
)

from .rows import Row
from .targets import as_row, errors, target_named, target_names

__all__ = ["rows"]

# sampler, walkers, sweeps kept in the chain, settings
MODES = {
    "SMC": (SMCSampler, 500, 4, {}),
    "SMC, moves only": (SMCSampler, 500, 4, {"recycle": False}),
    "TMCMC": (TMCMCSampler, 500, 4, {}),
    "SMC, paper, literal": (SMCSampler, 1000, 1, RAMANCHA_2022_LITERAL),
    "SMC, paper, constant": (SMCSampler, 1000, 1, RAMANCHA_2022_CONSTANT),
    "TMCMC, as published": (TMCMCSampler, 1000, 1, CHING_CHEN_2007),
}


def _run(mode: str, name: str, seed: int) -> dict[str, float]:
    """One run: its cost and its errors."""
    Sampler, nwalkers, nsteps, settings = MODES[mode]
    target = target_named(name)
    start = time.process_time()
    sampler = Sampler(nwalkers, target.ndim, target, vectorize=True, seed=seed, **settings)
    sampler.run_mcmc(None, nsteps)
    seconds = time.process_time() - start
    return {
        "evaluations": target.evaluations,
        "microseconds": 1e6 * seconds / target.evaluations,
        **errors(target, sampler.get_chain(flat=True)),
        "evidence": sampler.log_evidence - target.log_evidence,
        "error": sampler.log_evidence_error,
    }


def rows(repeats: int) -> list[Row]:
    """One row for every mode and target: evaluations (mean over `repeats` seeds), the errors in the note."""
    table = []
    for mode in MODES:
        for name in target_names():
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", SamplingWarning)
                runs = [_run(mode, name, seed) for seed in range(1, repeats + 1)]
            warned = any(issubclass(warning.category, SamplingWarning) for warning in caught)
            table.append(as_row(mode, name, runs, "warned" if warned else ""))
    return table
