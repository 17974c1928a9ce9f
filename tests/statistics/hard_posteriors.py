"""Small posteriors for samplers that spend few simulations: a smooth one, two modes, a banana, few samples.

The response is a linear combination of smooth shapes over time, with nonlinear functions of the parameters as
coefficients (*features*). With n samples, noise sigma and shapes of mean square one, a feature has the standard
deviation sigma / sqrt(n). The models cannot be shortened (there is no method ``first``).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
)
from fe_likelihoods.priors.distributions import Distribution

DT = 0.02  # s


def _respond(case: "HardPosterior", theta: np.ndarray) -> np.ndarray:
    return case.offset + np.tensordot(case.features(theta[None])[0], case.shapes, axes=1)


@dataclass(frozen=True)
class HardPosterior:
    """A small posterior that is hard in one way; the standard deviations of its noise are integrated out."""

    what: str  # makes it hard
    prior: Mapping[str, Distribution]  # of the structural parameters
    features: Callable[[np.ndarray], np.ndarray]  # coefficients (n, k) of the shapes from theta (n, d)
    target: Any  # (k,), features of the noise-free data; need not be features of any theta
    noise: float = 0.05  # standard deviation of the noise of the data
    n_steps: int = 200
    n_channels: int = 1
    label: Callable[[np.ndarray], np.ndarray] | None = None  # number (n,) of the mode, from 0, from theta (n, d)
    offset: float = 0.0  # constant in the responses and in the data [m]

    @property
    def shapes(self) -> np.ndarray:
        """Shapes of the features over time (k, n_channels, n_steps), of mean square one."""
        t = (np.arange(self.n_steps) + 0.5) / self.n_steps
        k, c = np.arange(len(self.target))[:, None, None], np.arange(self.n_channels)[:, None]
        return np.sqrt(2.0) * np.sin(np.pi * (k + 1 + c) * t)

    def posterior(self, seed: int) -> Posterior:
        """Posterior given the data of a seed, with a model that runs one simulation per call."""
        channels = tuple(Channel(f"c{i + 1}", "displacement", "m") for i in range(self.n_channels))
        model = FunctionModel(partial(_respond, self), tuple(self.prior), channels, DT, self.n_steps, version=self.what)
        clean = self.offset + np.tensordot(np.asarray(self.target, dtype=float), self.shapes, axes=1)
        values = clean + self.noise * np.random.default_rng([seed, 7]).standard_normal(clean.shape)
        measurements = Measurements(channels, DT, values, f"SYNTHETIC, {self.what}, seed {seed}")
        prior = dict(self.prior) | {f"sigma_{channel.name}": HalfNormal(0.5) for channel in channels}
        return Posterior(FELikelihood(model, measurements, GaussianNoise(channels)), prior).marginal()


def _smooth(x):
    a, b, c = x.T
    return np.stack([a * b, b**1.5, c / (1.0 + 0.3 * a)], axis=1)


def _two_modes(x):
    a, b, c = x.T
    # a exp(1 - a) has the value 0.729 at a = 0.4 and at a = 2.02, with slopes of ratio three
    return np.stack([a * np.exp(1.0 - a) * b, b, c * (1.0 + 0.2 * a)], axis=1)


def _banana(x):
    a, b, c = x.T
    return np.stack([(b - a**2) * 0.0035 / 0.02, 0.02 * a, c], axis=1)


def _four(x):
    a, b, c, d = x.T
    return np.stack([a * b, b + 0.3 * c**2, c * d, np.sqrt(a) - 0.5 * d], axis=1)


def _small_or_large(x):
    return (x[:, 0] > 1.0).astype(int)


_THREE = {name: TruncatedNormal(1.0, 0.4) for name in ("a", "b", "c")}
CASES = {
    "smooth": HardPosterior("nothing: a mildly curved posterior, for comparison", _THREE, _smooth, [0.9, 1.1, 0.7]),
    "two_modes": HardPosterior(
        "two modes, one three times as wide as the other",
        {"a": TruncatedNormal(1.2, 0.7), "b": TruncatedNormal(1.0, 0.3), "c": TruncatedNormal(1.0, 0.4)},
        _two_modes,
        [0.729, 1.0, 1.08],
        label=_small_or_large,
    ),
    "banana": HardPosterior(
        "a curved posterior, bent by several times its thickness",
        {"a": TruncatedNormal(1.0, 0.5), "b": TruncatedNormal(1.0, 1.0), "c": TruncatedNormal(1.0, 0.4)},
        _banana,
        [0.0, 0.02, 1.0],
    ),
    "few_samples": HardPosterior(
        "30 samples for four parameters",
        _THREE | {"d": TruncatedNormal(1.0, 0.4)},
        _four,
        [1.0, 1.3, 1.0, 0.5],
        noise=0.3,
        n_steps=30,
    ),
}
"""All cases by name."""
