"""The sampler that a TOML file describes, and its run."""

from typing import Any

from .job import Job
from .models import Problem

__all__ = ["STEPS", "make_sampler", "run_sampler"]

STEPS = 4  # of the chain


def make_sampler(job: Job, problem: Problem, backend: Any = None, chain: int = 0) -> Any:
    """Make the sampler of a TOML file, in memory without a backend; ValueError for a setting names its section.

    `chain` is the number of the independent run.
    """
    import samplers

    given, where, posterior = job.sampler, job.where("sampler"), problem.posterior
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


def run_sampler(job: Job, sampler: Any, progress: bool) -> None:
    """Run a sampler, or continue its run, until it has made the steps that the file asks for.

    The annealing of a stored run is made again from its record, also where no step is missing.
    """
    sampler.run_mcmc(None, max((job.sampler.steps or STEPS) - sampler.iteration, 0), progress=progress)
