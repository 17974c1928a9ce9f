"""The posterior that the other scripts of this folder sample: put your own model here.

The measurements are synthetic.
"""

import emcee
import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
)
from samplers import SMCSampler, summary

TIME = 0.01 * np.arange(500)  # [s]
WALKERS = 500


def free_vibration(theta: np.ndarray) -> list[np.ndarray]:
    """Displacement [m] for multiples of the stiffness and of the damping: stands for a model that takes minutes."""
    omega = 2.0 * np.pi * 2.0 * np.sqrt(theta[0])
    return [0.05 * np.exp(-0.02 * theta[1] * omega * TIME) * np.cos(omega * TIME)]


def make_posterior(pool=None) -> Posterior:
    """The posterior, with simulations in a pool and in a cache file."""
    names, channels = ["stiffness", "damping"], [Channel("top", "displacement", "mm")]
    noise = 0.002 * np.random.default_rng(1).standard_normal((1, 500))
    measured = Measurements(channels, 0.01, free_vibration(np.array([1.1, 0.8])) + noise)
    # for a slow model also time_limit=7200.0 [s] and runs_per_process=100
    model = FunctionModel(free_vibration, names, channels, 0.01, 500)
    prior = Prior({name: TruncatedNormal(1.0, 0.3) for name in names} | {"sigma_top": HalfNormal(0.01)})
    return Posterior(FELikelihood(model, measured, pool=pool, cache="simulations.db"), prior)


def update(pool=None) -> SMCSampler:
    """Sample the posterior in the files run.h5 and simulations.db; the same call goes on after any interruption."""
    posterior = make_posterior(pool)
    backend = emcee.backends.HDFBackend("run.h5")
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=1, backend=backend, asynchronous=True)
    sampler.run_mcmc(None, 4 - sampler.iteration, progress=True)  # in the output of a job, a line per minute
    samples = sampler.get_chain(flat=True)
    print(summary(samples, posterior.parameters, mean_error=sampler.mean_error()))
    print(f"log-evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f}")
    print(f"{posterior.report()['simulations']} simulations by this process")
    return sampler
