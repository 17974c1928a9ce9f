"""Expectations from few draws of a guide: their true errors beside their stated errors.

All runs of a problem have the same data. The reference is a run with many walkers, whose own standard error is added to
the stated errors. Stated errors cover if about 95 % of all estimates lie within two of them.
"""

import warnings
from collections.abc import Iterator

import numpy as np

from samplers import SamplingWarning, SMCSampler

from .few_simulations_problems import PROBLEMS
from .rows import Row

__all__ = ["expectations"]


def expectations(
    repeats: int,
    problems: tuple[str, ...] = ("oscillator", "twin", "column4"),
    walkers: int = 30,
    runs: int = 12,
    reference: int = 400,
) -> Iterator[Row]:
    """Simulations, errors of means and coverage per problem; `reference`: walkers of the reference.

    All figures are averages over `runs`, so `repeats` is not used.
    """
    for problem in problems:
        truth, _ = _estimates(problem, 1000, reference)
        sd = truth["sd"][0]
        found = [_estimates(problem, seed, walkers) for seed in range(runs)]
        yield Row("simulations", problem, float(np.mean([sampler.simulations for _, sampler in found])), "")
        draws = [sum(r.draws for r in sampler.rounds) for _, sampler in found]
        yield Row("weighted draws", problem, float(np.mean(draws)), "")
        errors = np.array([(each["mean"][0] - truth["mean"][0]) / sd for each, _ in found])
        yield Row("error of means", problem, float(np.sqrt(np.mean(errors**2))), "sd", "root mean square")
        stated = np.array([each["mean"][1] / sd for each, _ in found])
        yield Row("stated error of means", problem, float(np.sqrt(np.mean(stated**2))), "sd")
        for name, (value, error) in truth.items():
            scores = np.array([(each[name][0] - value) / np.hypot(each[name][1], error) for each, _ in found])
            yield Row(f"{name} within two errors", problem, 100.0 * float(np.mean(np.abs(scores) < 2.0)), "%")


def _estimates(problem: str, seed: int, walkers: int) -> tuple[dict[str, tuple], SMCSampler]:
    """Values and stated errors of a run, by name, and its sampler."""
    posterior = PROBLEMS[problem].posterior(1)
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, guide=posterior.guide())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        sampler.run_mcmc(None, 0)
    sample = sampler.signed_sample
    if sample is None:
        raise RuntimeError(
            f"{problem}, seed {seed}: the guide has no emulator, so there are no expectations to compare"
        )
    quantiles = {f"{100 * p:.0f} % quantile": sample.quantile(p) for p in (0.05, 0.5, 0.95)}
    evidence = sample.log_evidence, sample.log_evidence_error
    return {"mean": sample.expectation(), "sd": sample.standard_deviation(), **quantiles, "log Z": evidence}, sampler
