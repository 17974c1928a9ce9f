"""A posterior that every client can sample in seconds, and its exact moments and evidence.

The model is a strongly damped linear oscillator with four parameters, each with a different kind of prior. In three
fifths of the prior the simulation fails; a client that drops such points has a log-evidence that is too large by 0.9.

The exact answer uses distributions of `scipy.stats`, an explicit likelihood and quadrature.
"""

import functools
from typing import NamedTuple

import numpy as np
from scipy import stats

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    Record,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.signals.response_spectrum import respond

PERIOD, DAMPING_RATIO, DT, N_STEPS = 0.8, 0.5, 0.05, 30
CRITICAL = 1.0 / DAMPING_RATIO  # multiple of the nominal damping above which all simulations fail
TRUTH, NOISE = (1.2, 0.8), (1.0, 0.012)
PRIOR = {
    "stiffness": Uniform(0.4, 2.4),
    "damping": TruncatedNormal(2.2, 0.8, lower=0.7, upper=4.0),
    "sigma_acceleration": HalfNormal(1.0),
    "sigma_displacement": LogNormal(0.01, 0.4),
}
DENSITIES = (
    stats.uniform(0.4, 2.0),
    stats.truncnorm((0.7 - 2.2) / 0.8, (4.0 - 2.2) / 0.8, 2.2, 0.8),
    stats.halfnorm(scale=1.0),
    stats.lognorm(0.4, scale=0.01),
)


class Exact(NamedTuple):
    """Mean and standard deviation of each parameter (4,), and the log-evidence, of the posterior."""

    mean: np.ndarray
    sd: np.ndarray
    log_evidence: float


def starts_of(posterior, n, rng=None):
    """Draws (n, ndim) of the prior at which the posterior is not zero."""
    draws = posterior.sample_prior(10 * n + 50, rng)
    return draws[np.isfinite(posterior(draws))][:n]


def finite(posterior, x):
    """Log-likelihood with -1e100 instead of -inf, as the page of clients has it."""
    return np.maximum(posterior.log_likelihood(x), -1e100)


@functools.cache
def _data() -> tuple[np.ndarray, np.ndarray]:
    """Base acceleration (60,) [m/s²] and measured acceleration and displacement (2, 60)."""
    rng = np.random.default_rng(20240)
    base = 2.0 * rng.normal(size=N_STEPS)
    return base, _simulate(base, *TRUTH) + np.array(NOISE)[:, None] * rng.normal(size=(2, N_STEPS))


def _simulate(base: np.ndarray, stiffness: float, damping: float) -> np.ndarray:
    response = respond(base, DT, 2.0 * np.pi / PERIOD * np.sqrt(stiffness), damping * DAMPING_RATIO)
    return np.stack([response.acceleration, response.displacement])


def make_posterior(prior: dict | None = None) -> Posterior:
    """Make a new posterior, with an empty cache and no simulations counted."""
    base, measured = _data()
    model = LinearOscillator(Record("noise", DT, base), PERIOD, DAMPING_RATIO)
    return Posterior(FELikelihood(model, Measurements(model.channels, DT, measured)), Prior(prior or PRIOR))


def reference_log_prob(x: np.ndarray) -> float:
    """Log-prior plus log-likelihood of one point (4,), which uses only the oscillator of the library."""
    log_prior = sum(density.logpdf(value) for density, value in zip(DENSITIES, x, strict=True))
    if not np.isfinite(log_prior) or x[1] >= CRITICAL:
        return -np.inf
    base, measured = _data()
    scale = np.repeat(x[2:, None], N_STEPS, axis=1)
    return log_prior + stats.norm.logpdf(measured, _simulate(base, x[0], x[1]), scale).sum()


@functools.cache
def exact(nodes: int = 48) -> Exact:
    """Moments and evidence by Gauss-Legendre quadrature with the given number of nodes per dimension."""
    base, measured = _data()
    unit, weight = np.polynomial.legendre.leggauss(nodes)
    bounds = np.array([(0.4, 2.4), (0.7, CRITICAL), *np.log([(0.2, 4.0), (0.002, 0.1)])])  # logarithms of sigmas
    half = 0.5 * np.diff(bounds)
    points, log_weights = bounds.mean(axis=1)[:, None] + half * unit, np.log(half * weight)
    log_weights[2:] += points[2:]
    points[2:] = np.exp(points[2:])
    log_weights += [density.logpdf(x) for density, x in zip(DENSITIES, points, strict=True)]
    misfit = np.array([[((_simulate(base, k, c) - measured) ** 2).sum(axis=1) for c in points[1]] for k in points[0]])
    scaled = misfit[..., None] / points[2:] ** 2 + 2.0 * N_STEPS * np.log(np.sqrt(2.0 * np.pi) * points[2:])
    density = sum(np.ix_(*log_weights)) - 0.5 * (scaled[:, :, 0, :, None] + scaled[:, :, 1, None, :])
    top = density.max()
    density = np.exp(density - top)
    log_evidence = top + np.log(density.sum())
    density /= density.sum()
    margins = [density.sum(axis=tuple({0, 1, 2, 3} - {k})) for k in range(4)]
    mean, square = (np.array([m @ x**n for m, x in zip(margins, points, strict=True)]) for n in (1, 2))
    return Exact(mean, np.sqrt(square - mean**2), float(log_evidence))
