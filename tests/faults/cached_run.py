"""A run with a cache that a test can kill: ``python -m tests.faults.cached_run CACHE SECONDS``.

A simulation takes SECONDS.
"""

import os
import sys
import time

import numpy as np

from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from samplers import SMCSampler

N, STEPS, SEED = 40, 5, 11
RECORD = Record("beats", 0.05, np.sin(np.arange(120) / 3) * np.cos(np.arange(120) / 20))


class Slow(LinearOscillator):
    """A model whose simulations take a given time and are counted; the time is not part of the key."""

    runs = 0

    def simulate(self, theta):
        self.runs += 1
        time.sleep(float(os.environ.get("SECONDS_PER_SIMULATION", "0")))
        return super().simulate(theta)


def make(cache):
    """Sampler and posterior of the run."""
    model = Slow(RECORD)
    measured = LinearOscillator(RECORD).simulate(np.array([1.1, 0.8]))
    noise = np.array([[0.05], [0.002]]) * np.random.default_rng(1).standard_normal(measured.shape)
    likelihood = FELikelihood(model, Measurements(model.channels, model.dt, measured + noise), cache=cache)
    prior = {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(1.0, 0.6),
        "sigma_acceleration": HalfNormal(0.2),
        "sigma_displacement": HalfNormal(0.01),
    }
    posterior = Posterior(likelihood, prior)
    return SMCSampler(N, posterior.ndim, posterior, vectorize=True, seed=SEED), posterior


if __name__ == "__main__":
    cache, seconds = sys.argv[1:]
    os.environ["SECONDS_PER_SIMULATION"] = seconds
    make(cache)[0].run_mcmc(None, STEPS)
