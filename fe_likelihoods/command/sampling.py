"""The sampler that a TOML file describes, and its run: SMC, TMCMC, or emcee's ensemble sampler."""

from typing import Any

import numpy as np

from .job import Job
from .models import Problem

__all__ = ["STEPS", "discarded", "is_emcee", "make_sampler", "run_sampler"]

STEPS = 4  # of the chain of SMC and TMCMC
_ROUNDS = 20  # of draws of the prior, for walkers that start where the simulation does not fail


def is_emcee(job: Job) -> bool:
    """Whether the sampler is emcee's."""
    return job.sampler.kind == "emcee"


def discarded(job: Job) -> int:
    """Iterations at the beginning of the chain that are left out; 0 for SMC and TMCMC."""
    given = job.sampler
    return 0 if not is_emcee(job) else given.steps // 2 if given.discard is None else given.discard


def make_sampler(job: Job, problem: Problem, backend: Any = None, chain: int = 0) -> Any:
    """Make the sampler of a TOML file, in memory without a backend; ValueError for a setting names its section.

    `chain` is the number of the independent run.
    """
    import samplers

    if is_emcee(job):
        return _make_emcee(job, problem, backend)
    given, where, posterior = job.sampler, job.where("sampler"), problem.posterior
    if given.discard is not None:
        raise ValueError(f'{where} discard: {given.kind} has no burn-in; this key is for kind = "emcee": leave it out')
    settings = given.given("recycle", "ess_ratio", "min_moves", "max_moves", "max_failure_share")
    try:
        return {"smc": samplers.SMCSampler, "tmcmc": samplers.TMCMCSampler}[given.kind](
            given.walkers or 500,
            posterior.ndim,
            posterior,
            backend=backend,
            vectorize=True,
            seed=given.seed + chain,
            guide=posterior.guide() if given.guide else None,
            max_simulations=job.budget.max_simulations,
            **settings,
        )
    except (ValueError, TypeError) as error:
        raise ValueError(f"{where} {error}") from error


def _make_emcee(job: Job, problem: Problem, backend: Any) -> Any:
    """emcee's sampler, after its keys have been checked."""
    import emcee

    where, given, posterior = job.where("sampler"), job.sampler, problem.posterior
    own = ("kind", "walkers", "steps", "seed", "chains", "discard")
    for key, value in given.given().items():
        if key not in own and value is not False:
            raise ValueError(f"{where} {key}: emcee has no such setting; it has {', '.join(own)}: leave it out")
    if given.steps is None:
        raise ValueError(
            f"{where} steps: this key is missing; emcee needs the number of its iterations, such as 2000: 50 "
            "autocorrelation times or more after those that are left out (discard)"
        )
    if job.budget.max_simulations is not None:
        raise ValueError(
            f"{job.where('budget')} max_simulations: emcee makes walkers x (steps + 1) simulations: leave this key out"
        )
    walkers = given.walkers or max(32, 4 * posterior.ndim)
    if walkers < 2 * posterior.ndim or walkers % 2:
        raise ValueError(
            f"{where} walkers: emcee needs an even number of {2 * posterior.ndim} walkers or more, two per parameter; "
            f"got {walkers}"
        )
    if discarded(job) >= given.steps:
        raise ValueError(f"{where} discard: expected fewer than steps = {given.steps}; got {discarded(job)}")
    return emcee.EnsembleSampler(walkers, posterior.ndim, posterior, vectorize=True, backend=backend)


def run_sampler(job: Job, problem: Problem, sampler: Any, progress: bool, chain: int = 0) -> None:
    """Run a sampler, or continue its run, until it has made the steps that the file asks for."""
    if not is_emcee(job):  # the annealing of a stored run is made again from its record, also where no step is missing
        sampler.run_mcmc(None, max((job.sampler.steps or STEPS) - sampler.iteration, 0), progress=progress)
        return
    left = job.sampler.steps - sampler.iteration
    if left > 0:
        start = sampler.get_last_sample() if sampler.iteration else _start(job, problem, sampler, chain)
        sampler.run_mcmc(start, left, progress=progress)


def _start(job: Job, problem: Problem, sampler: Any, chain: int) -> Any:
    """Draws of the prior with a finite posterior density, and the state of the random numbers."""
    import emcee

    posterior, random = problem.posterior, np.random.RandomState(job.sampler.seed + chain)
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
