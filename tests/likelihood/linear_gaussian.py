"""Likelihoods whose posterior and evidence are known: linear models, Gaussian noise of known size, Gaussian priors."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from fe_likelihoods import Channel, FELikelihood, Measurements
from fe_likelihoods.simulation.model import SimulationBatch


@dataclass(frozen=True)
class KnownNoise:
    """White noise of known standard deviation, without parameters."""

    sigma: float
    parameter_names = ()

    def log_likelihood(self, misfit, n_samples, parameters):
        n = getattr(n_samples, "samples", n_samples)
        constant = -0.5 * n * np.log(2.0 * np.pi * self.sigma**2)
        return np.sum(constant - 0.5 * misfit / self.sigma**2, axis=-1)


@dataclass(frozen=True, eq=False)
class Linear:
    """Response ``design @ theta`` of one channel."""

    parameter_names: tuple
    design: np.ndarray
    quantity: str = "displacement"
    dt = 0.1

    @property
    def channels(self):
        return (Channel("top", self.quantity, {"displacement": "m", "force": "N"}[self.quantity]),)

    @property
    def n_steps(self):
        return len(self.design)

    @property
    def fingerprint(self):
        return f"linear {self.parameter_names} {self.quantity} {self.design.tolist()}"

    def simulate(self, theta):
        return (self.design @ theta)[None]

    def simulate_batch(self, thetas):
        return SimulationBatch((thetas @ self.design.T)[:, None], [""] * len(thetas))


def likelihood_of(names, rng, n_steps=12, sigma=0.5, noise=KnownNoise):
    """Likelihood of data that the parameters (1, ..., 1) have produced."""
    model = Linear(names, rng.normal(size=(n_steps, len(names))))
    data = model.simulate(np.ones(len(names))) + sigma * rng.normal(size=(1, n_steps))
    return FELikelihood(model, Measurements(model.channels, model.dt, data), noise(sigma) if noise else None)


def exact_log_evidence(likelihoods, names, mean, sd):
    """Log-evidence of likelihoods with `KnownNoise` under independent normal priors of the parameters `names`."""
    rows, data, variances = [], [], []
    for likelihood in likelihoods:
        design = np.zeros((likelihood.model.n_steps, len(names)))
        design[:, [names.index(name) for name in likelihood.model.parameter_names]] = likelihood.model.design
        rows.append(design)
        data.append(likelihood.measurements.values[0])
        variances.append(np.full(len(design), likelihood.noise.sigma**2))
    design, data = np.vstack(rows), np.concatenate(data)
    covariance = design @ np.diag(np.broadcast_to(sd, len(names)) ** 2) @ design.T + np.diag(np.concatenate(variances))
    return stats.multivariate_normal(design @ np.broadcast_to(mean, len(names)), covariance).logpdf(data)
