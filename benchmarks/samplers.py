"""Every mode of the samplers on the targets: evaluations, errors of the result, and whether the run warned.

SMC by moves and TMCMC have equal weights, since a coefficient of variation of 1 is an effective sample size of half the
walkers. They differ in the moves: TMCMC grows chains from leaders before it sweeps all points.
"""

import time
import warnings

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL

from .rows import Row
from .targets import as_row, errors, target_named

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


def _run(mode: str, name: str, seed: int) -> dict:
    """Cost and errors of one run, and whether it warned."""
    Sampler, nwalkers, nsteps, settings = MODES[mode]
    target = target_named(name)
    start = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        sampler = Sampler(nwalkers, target.ndim, target, vectorize=True, seed=seed, **settings)
        sampler.run_mcmc(None, nsteps)
    seconds = time.process_time() - start
    return {
        "evaluations": target.evaluations,
        "microseconds": 1e6 * seconds / target.evaluations,
        **errors(target, sampler.get_chain(flat=True)),
        "evidence": sampler.log_evidence - target.log_evidence,
        "error": sampler.log_evidence_error,
        "warned": any(issubclass(warning.category, SamplingWarning) for warning in caught),
    }


def rows(repeats: int, targets: tuple[str, ...] = ("T1", "T2", "T3", "T4")) -> list[Row]:
    """One row for each mode and target: evaluations (mean over `repeats` seeds), with the errors in the note."""
    return [
        as_row(mode, name, [_run(mode, name, seed) for seed in range(1, repeats + 1)])
        for mode in MODES
        for name in targets
    ]
