"""A run with a guide over two processes that a test can kill: ``python -m tests.faults.guided_run CACHE LOG SECONDS``.

Every simulation takes SECONDS and, when it starts, writes the number of samples and the parameters to the file LOG.
"""

import sys
import time
from pathlib import Path

import numpy as np

from fe_likelihoods import Channel, FELikelihood, HalfNormal, Measurements, Posterior, TruncatedNormal
from samplers import SMCSampler

N_STEPS, DT = 200, 0.02


class Vibration:
    """Free vibration [m] of a mass, with stiffness and damping; it can be shortened."""

    parameter_names = ("stiffness", "damping")
    channels = (Channel("top", "displacement", "mm"),)
    dt = DT

    def __init__(self, log, seconds, n_steps=N_STEPS):
        self.log, self.seconds, self.n_steps = log, seconds, n_steps

    @property
    def fingerprint(self):
        return f"vibration {self.n_steps}"

    def first(self, seconds):
        return Vibration(self.log, self.seconds, 1 + round(seconds / self.dt))

    def simulate(self, theta):
        if self.log is not None:
            with open(self.log, "a") as file:  # one short write, so that lines of two processes do not mix
                file.write(" ".join([str(self.n_steps), *(float(value).hex() for value in theta)]) + "\n")
        time.sleep(self.seconds)
        time_of = self.dt * np.arange(self.n_steps)
        omega = 2.0 * np.pi * 1.5 * np.sqrt(theta[0])
        return 0.05 * np.exp(-0.05 * theta[1] * omega * time_of)[None] * np.cos(omega * time_of)


def runs(log):
    """Simulations in a log: list of (number of samples, parameters)."""
    lines = Path(log).read_text().splitlines() if Path(log).exists() else []
    parts = [line.split() for line in lines]
    return [(int(n), *map(float.fromhex, theta)) for n, *theta in parts]


def make(cache, log=None, seconds=0.0, pool=None, sampler=SMCSampler):
    """Sampler and posterior of the run."""
    model = Vibration(log, seconds)
    measured = Vibration(None, 0.0).simulate([1.2, 0.8])
    noise = 2e-3 * np.random.default_rng(1).standard_normal(measured.shape)
    likelihood = FELikelihood(model, Measurements(model.channels, DT, measured + noise), pool=pool, cache=cache)
    prior = {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(1.0, 0.3),
        "sigma_top": HalfNormal(0.01),
    }
    posterior = Posterior(likelihood, prior)
    return sampler(50, 3, posterior, vectorize=True, seed=3, guide=posterior.guide(2)), posterior


if __name__ == "__main__":
    cache, log, seconds = sys.argv[1:]
    sampler, posterior = make(cache, log, float(seconds), pool=2)
    sampler.run_mcmc(None, 2)
    print(repr(float(sampler.log_evidence)), posterior.likelihood.simulations)
