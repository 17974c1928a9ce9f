"""Every mode of the samplers on four targets with known answers: evaluations, and how wrong the answer is.

The targets are those of ``benchmarks/sampler_targets.py`` in the reference material (``FE_SHARED``): a mimic of the
column paper's posterior (T1), two modes in eleven dimensions (T2), two bananas (T3), a two-storey building (T4).
Evaluations are counted at the likelihood; errors of means are in posterior standard deviations, root mean square over
dimensions and seeds.
"""

import importlib.util
import os
import time
import warnings
from pathlib import Path

import emcee
import numpy as np

from samplers import (
    CHING_CHEN_2007,
    RAMANCHA_2022_CONSTANT,
    RAMANCHA_2022_LITERAL,
    SamplingWarning,
    SMCSampler,
    TMCMCSampler,
)

from .rows import Row

__all__ = ["rows"]

SHARED = Path(os.environ.get("FE_SHARED", Path(__file__).resolve().parents[3] / "shared"))
# sampler, walkers, sweeps kept in the chain, settings
MODES = {
    "SMC": (SMCSampler, 500, 4, {}),
    "SMC, moves only": (SMCSampler, 500, 4, {"recycle": False}),
    "TMCMC": (TMCMCSampler, 500, 4, {}),
    "SMC, paper, literal": (SMCSampler, 1000, 1, RAMANCHA_2022_LITERAL),
    "SMC, paper, constant": (SMCSampler, 1000, 1, RAMANCHA_2022_CONSTANT),
    "TMCMC, as published": (TMCMCSampler, 1000, 1, CHING_CHEN_2007),
    "emcee, stretch move": (emcee.EnsembleSampler, 100, 1000, {}),
}


class _Target:
    """A target as a posterior that counts the points it is asked for."""

    def __init__(self, target: dict, log_density, transform):
        self.prior, self.log_likelihood = target["prior"], target["log_likelihood"]
        self.mean, self.sd, self.mode = target["mean"], target["sd"], target["mode"]
        self.log_evidence = target["log_evidence"]
        self._log_density, self._transform = log_density, transform
        self.ndim, self.evaluations = len(self.prior), 0

    def log_prior(self, x):
        return self._log_density(self.prior, x)

    def __call__(self, x):
        log_prior = self.log_prior(x)
        inside = log_prior > -np.inf
        self.evaluations += int(inside.sum())
        log_prob = np.full(len(x), -np.inf)
        log_prob[inside] = log_prior[inside] + self.log_likelihood(x[inside])
        return log_prob

    def sample_prior(self, n, random):
        return self._transform(self.prior, random.random_sample((n, self.ndim)))


def _targets() -> dict:
    """Functions that build the targets, by name."""
    path = SHARED / "benchmarks" / "sampler_targets.py"
    if not path.exists():
        raise ValueError(f"the targets must be at {path}: set FE_SHARED to the folder of the reference material")
    spec = importlib.util.spec_from_file_location("sampler_targets", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return {
        name: lambda build=build: _Target(build(), module.prior_log_density, module.prior_transform)
        for name, build in module.TARGETS.items()
    }


def _scores(mode: str, target: _Target, seed: int) -> dict[str, float]:
    """One run: its cost and its errors."""
    Sampler, nwalkers, nsteps, settings = MODES[mode]
    random = np.random.RandomState(seed)
    start = time.process_time()
    if Sampler is emcee.EnsembleSampler:
        sampler = Sampler(nwalkers, target.ndim, target, vectorize=True)
        sampler.random_state = random.get_state()
        sampler.run_mcmc(target.sample_prior(nwalkers, random), nsteps)
        chain = sampler.get_chain(flat=True, discard=nsteps // 2)
    else:
        sampler = Sampler(nwalkers, target.ndim, target, vectorize=True, seed=seed, **settings)
        sampler.run_mcmc(None, nsteps)
        chain = sampler.get_chain(flat=True)
    scores = {
        "evaluations": target.evaluations,
        "microseconds": 1e6 * (time.process_time() - start) / target.evaluations,
        "z": np.sqrt(np.mean(((chain.mean(axis=0) - target.mean) / target.sd) ** 2)),
        "sd": np.sqrt(np.mean((chain.std(axis=0) / target.sd - 1.0) ** 2)),
    }
    if target.mode is not None:
        scores["weight"] = target.mode[0](chain).mean() - target.mode[1]
    if hasattr(sampler, "ladder"):
        scores["evidence"] = sampler.log_evidence - target.log_evidence
        scores["error"] = sampler.log_evidence_error
    return scores


def rows(repeats: int) -> list[Row]:
    """One row for every mode and target: evaluations (mean over `repeats` seeds), the errors in the note."""
    table = []
    for mode in MODES:
        for name, build in _targets().items():
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", SamplingWarning)
                runs = [_scores(mode, build(), seed) for seed in range(1, repeats + 1)]
            column = {key: np.array([run[key] for run in runs]) for key in runs[0]}
            note = [
                f"z {np.sqrt(np.mean(column['z'] ** 2)):.3f}",
                f"sd {100 * np.sqrt(np.mean(column['sd'] ** 2)):.1f} %",
            ]
            if "weight" in column:
                note.append(f"mode's weight {np.max(np.abs(column['weight'])):.3f} at most")
            if "evidence" in column:
                pairs = zip(column["evidence"], column["error"], strict=True)
                note.append("log Z " + " ".join(f"{value:+.2f}({error:.2f})" for value, error in pairs))
            note.append(f"{column['microseconds'].mean():.1f} us CPU")
            if any(issubclass(warning.category, SamplingWarning) for warning in caught):
                note.append("warned")
            table.append(Row(f"{mode}: evaluations", name, column["evaluations"].mean(), "", "; ".join(note)))
    return table
