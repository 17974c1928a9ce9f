"""One small posterior with a vectorised response, from which a model, a posterior and a reference can be made.

Most responses are linear combinations of smooth shapes over time, with nonlinear functions of the parameters as
coefficients (*features*). With n samples, noise sigma and shapes of mean square one, a feature has the standard
deviation sigma / sqrt(n).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    SimulationFailed,
    Uniform,
)
from fe_likelihoods.priors.distributions import Distribution

__all__ = ["HardPosterior"]

DT = 0.02  # s
Features = Callable[[np.ndarray], np.ndarray]


def _combine(features: Features, shapes: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """Responses (n, n_channels, n_steps) from features (n, k) and shapes (k, n_channels, n_steps)."""
    return np.tensordot(features(theta), shapes, axes=1)


class _OneRun:
    """One simulation: a row of the responses, or `SimulationFailed` where it is NaN."""

    def __init__(self, respond: Callable[[np.ndarray], np.ndarray]) -> None:
        self.respond = respond

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        response = self.respond(theta[None])[0]
        if np.isnan(response).any():
            raise SimulationFailed("the solution did not converge")
        return response


@dataclass(frozen=True)
class HardPosterior:
    """A small posterior that is hard in one way."""

    what: str  # makes it hard
    prior: Mapping[str, Distribution]  # of the structural parameters
    # coefficients (n, k) of the shapes from theta (n, d); NaN where a simulation fails
    features: Features | None = None
    target: Any = None  # (k,), features of the noise-free data; need not be features of any theta
    # response (n, n_channels, n_steps) from theta (n, d), instead of `features`
    respond: Callable[[np.ndarray], np.ndarray] | None = None
    truth: Any = None  # (d,), parameters of the noise-free data where `respond` is given
    noise: float = 0.05  # standard deviation of the noise of the data
    n_steps: int = 200
    n_channels: int = 1
    # "marginal" (white, sigmas integrated out), "white" (sigmas as parameters) or "autoregressive"
    error_model: str = "marginal"
    label: Callable[[np.ndarray], np.ndarray] | None = None  # number (n,) of the mode, from 0, from theta (n, d)
    n_modes: int = 1
    offset: float = 0.0  # constant in the responses and in the data [m]
    # whether the noise has no component along the shapes, so that it does not change the mode shares
    balanced: bool = False

    @property
    def shapes(self) -> np.ndarray:
        """Shapes of the features over time (k, n_channels, n_steps), of mean square one."""
        t = (np.arange(self.n_steps) + 0.5) / self.n_steps
        k, c = np.arange(len(self.target))[:, None, None], np.arange(self.n_channels)[:, None]
        return np.sqrt(2.0) * np.sin(np.pi * (k + 1 + c) * t)

    def responses(self, theta: np.ndarray) -> np.ndarray:
        """Responses of many parameter sets (n, d) at once: (n, n_channels, n_steps), NaN where a simulation fails."""
        if self.respond is not None:
            return self.offset + self.respond(theta)
        return self.offset + _combine(self.features, self.shapes, theta)

    def labels(self, theta: np.ndarray) -> np.ndarray:
        """Number of the mode (n,) of every point (n, ndim)."""
        return np.zeros(len(theta), dtype=int) if self.label is None else self.label(theta)

    def data(self, seed: int) -> np.ndarray:
        """Noise-free response plus white noise of a seed: (n_channels, n_steps)."""
        if self.respond is not None:
            clean = self.respond(np.array([self.truth], dtype=float))[0]
        else:
            clean = np.tensordot(np.asarray(self.target, dtype=float), self.shapes, axes=1)
        noise = np.random.default_rng([seed, 7]).standard_normal(clean.shape)
        if self.balanced:
            rows = self.shapes.reshape(len(self.target), -1)
            along = np.linalg.lstsq(rows.T, noise.ravel(), rcond=None)[0]
            noise -= (along @ rows).reshape(noise.shape)
        return self.offset + clean + self.noise * noise

    def posterior(self, seed: int, name: str = "hard") -> Posterior:
        """Posterior given the data of a seed, with a model that runs one simulation per call."""
        channels = tuple(Channel(f"c{i + 1}", "displacement", "m") for i in range(self.n_channels))
        model = FunctionModel(_OneRun(self.responses), tuple(self.prior), channels, DT, self.n_steps, version=name)
        measurements = Measurements(channels, DT, self.data(seed), f"SYNTHETIC, {name}, seed {seed}")
        prior = dict(self.prior) | {f"sigma_{channel.name}": HalfNormal(0.5) for channel in channels}
        if self.error_model == "autoregressive":
            prior |= {f"rho_{channel.name}": Uniform(-1.0, 1.0) for channel in channels}
            return Posterior(FELikelihood(model, measurements, AutoregressiveNoise(channels)), prior)
        posterior = Posterior(FELikelihood(model, measurements, GaussianNoise(channels)), prior)
        return posterior.marginal() if self.error_model == "marginal" else posterior
