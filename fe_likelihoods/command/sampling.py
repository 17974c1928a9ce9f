"""The sampler that a TOML file describes, and its run: SMC, TMCMC, or emcee's ensemble sampler."""

from typing import Any

import numpy as np

from .job import Job
from .models import Problem

__all__ = ["STEPS", "discarded", "is_emcee", "make_sampler", "run_sampler"]

STEPS = 4  # of the chain of SMC and TMCMC
PRESETS = {
    "ramancha2022": "RAMANCHA_2022_LITERAL",
    "ramancha2022-constant": "RAMANCHA_2022_CONSTANT",
    "ching-chen-2007": "CHING_CHEN_2007",
}
_KINDS = ("smc", "tmcmc", "emcee")
_OF_EMCEE = ("kind", "walkers", "steps", "seed", "discard")
_ROUNDS = 20  # of draws of the prior, for walkers that start where the simulation does not fail


def is_emcee(job: Job) -> bool:
    """Whether the sampler is emcee's."""
    return job.sampler.get("kind", "smc") == "emcee"


def discarded(job: Job) -> int:
    """Iterations at the beginning of the chain that are left out; 0 for SMC and TMCMC."""
    return job.sampler.get("discard", job.sampler["steps"] // 2) if is_emcee(job) else 0


def make_sampler(job: Job, problem: Problem, backend: Any = None) -> Any:
    """Make the sampler of a TOML file, in memory without a backend; ValueError for a setting names its section."""
    import samplers

    given = dict(job.sampler)
    kind, preset = given.pop("kind", "smc"), given.pop("preset", None)
    where = job.where("sampler")
    if kind not in _KINDS:
        raise ValueError(f"{where} kind: expected one of {', '.join(_KINDS)}; got {kind!r}")
    if kind == "emcee":
        return _make_emcee(job, problem, backend)
    if "discard" in given:
        raise ValueError(f'{where} discard: {kind} has no burn-in; this key is for kind = "emcee": leave it out')
    if preset is not None and preset not in PRESETS:
        raise ValueError(f"{where} preset: expected one of {', '.join(PRESETS)}; got {preset!r}")
    settings = {} if preset is None else dict(getattr(samplers.presets, PRESETS[preset]))
    walkers, seed, guided = given.pop("walkers", 500), given.pop("seed", 1), given.pop("guide", False)
    given.pop("steps", None)
    posterior = problem.posterior
    try:
        return {"smc": samplers.SMCSampler, "tmcmc": samplers.TMCMCSampler}[kind](
            walkers,
            posterior.ndim,
            posterior,
            backend=backend,
            vectorize=True,
            seed=seed,
            guide=posterior.guide() if guided else None,
            max_simulations=job.budget.get("max_simulations"),
            **(settings | given),
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where} {error}") from error


def _make_emcee(job: Job, problem: Problem, backend: Any) -> Any:
    """emcee's sampler, after its keys have been checked."""
    import emcee

    where, given, posterior = job.where("sampler"), job.sampler, problem.posterior
    for key in given:
        if key not in _OF_EMCEE:
            raise ValueError(f"{where} {key}: emcee has no such setting; it has {', '.join(_OF_EMCEE)}: leave it out")
    if "steps" not in given:
        raise ValueError(
            f"{where} steps: this key is missing; emcee needs the number of its iterations, such as 2000: 50 "
            "autocorrelation times or more after those that are left out (discard)"
        )
    if "max_simulations" in job.budget:
        raise ValueError(
            f"{job.where('budget')} max_simulations: emcee makes walkers x (steps + 1) simulations: leave this key out"
        )
    walkers = given.get("walkers", max(32, 4 * posterior.ndim))
    if walkers < 2 * posterior.ndim or walkers % 2:
        raise ValueError(
            f"{where} walkers: emcee needs an even number of {2 * posterior.ndim} walkers or more, two per parameter; "
            f"got {walkers}"
        )
    if discarded(job) >= given["steps"]:
        raise ValueError(f"{where} discard: expected fewer than steps = {given['steps']}; got {discarded(job)}")
    return emcee.EnsembleSampler(walkers, posterior.ndim, posterior, vectorize=True, backend=backend)


def run_sampler(job: Job, problem: Problem, sampler: Any, progress: bool) -> None:
    """Run a sampler, or continue its run, until it has made the steps that the file asks for."""
    if not is_emcee(job):  # the annealing of a stored run is made again from its record, also where no step is missing
        sampler.run_mcmc(None, max(job.sampler.get("steps", STEPS) - sampler.iteration, 0), progress=progress)
        return
    left = job.sampler["steps"] - sampler.iteration
    if left > 0:
        start = sampler.get_last_sample() if sampler.iteration else _start(job, problem, sampler)
        sampler.run_mcmc(start, left, progress=progress)


def _start(job: Job, problem: Problem, sampler: Any) -> Any:
    """Draws of the prior with a finite posterior density, and the state of the random numbers."""
    import emcee

    posterior, random = problem.posterior, np.random.RandomState(job.sampler.get("seed", 1))
    found = np.empty((0, posterior.ndim))
    for _ in range(_ROUNDS):
        points = posterior.sample_prior(sampler.nwalkers, random)
        found = np.concatenate([found, points[np.isfinite(posterior(points))]])
        if len(found) >= sampler.nwalkers:
            return emcee.State(found[: sampler.nwalkers], random_state=random.get_state())
    raise ValueError(
        f"{job.where('sampler')} of {_ROUNDS * sampler.nwalkers} draws of the prior only {len(found)} have a finite "
        f"likelihood, and emcee needs one for each of {sampler.nwalkers} walkers: check [model] and [priors]"
    )
