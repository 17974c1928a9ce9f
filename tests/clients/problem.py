"""A posterior that every client can sample in seconds, and its exact moments and evidence.

The model is a strongly damped linear oscillator with four parameters, each with a different kind of prior. It is chosen
so that errors of a client are visible. Thirty samples leave the posterior wide, skewed and truncated by the lower bound
of the damping. In three fifths of the prior the simulation fails (the oscillator is overdamped), so every client
meets -inf; a client that drops such points instead of counting them has a log-evidence that is too large by 0.9.

The exact answer is computed independently of the library: with distributions of `scipy.stats`, an explicit likelihood
and quadrature. Given stiffness and damping, the two noise parameters are independent, so four nested integrals reduce
to a grid of products of two.
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
from fe_likelihoods.signals.sdof import respond

__all__ = ["CRITICAL", "PRIOR", "Exact", "exact", "make_posterior", "reference_log_prob"]

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
def exact(nodes: int = 60) -> Exact:
    """Moments and evidence by Gauss-Legendre quadrature with the given number of nodes per dimension."""
    base, measured = _data()
    unit, weight = np.polynomial.legendre.leggauss(nodes)

    def rule(low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
        return 0.5 * (high - low) * unit + 0.5 * (high + low), 0.5 * (high - low) * weight

    stiffness, stiffness_weight = rule(0.4, 2.4)
    damping, damping_weight = rule(0.7, CRITICAL)
    misfit = np.array([[((_simulate(base, k, c) - measured) ** 2).sum(axis=1) for c in damping] for k in stiffness])

    log_plane = np.log(np.outer(stiffness_weight, damping_weight))
    log_plane += DENSITIES[0].logpdf(stiffness)[:, None] + DENSITIES[1].logpdf(damping)
    means, squares = [], []  # of each noise parameter, given stiffness and damping
    for channel, (low, high) in enumerate([(0.2, 4.0), (0.002, 0.1)]):
        log_sigma, sigma_weight = rule(np.log(low), np.log(high))
        sigma = np.exp(log_sigma)
        log_terms = (
            np.log(sigma_weight * sigma)
            + DENSITIES[2 + channel].logpdf(sigma)
            - N_STEPS * (np.log(sigma) + 0.5 * np.log(2.0 * np.pi))
            - 0.5 * misfit[:, :, channel, None] / sigma**2
        )
        top = log_terms.max(axis=-1)
        terms = np.exp(log_terms - top[..., None])
        total = terms.sum(axis=-1)
        log_plane += top + np.log(total)
        means.append(terms @ sigma / total)
        squares.append(terms @ sigma**2 / total)

    top = log_plane.max()
    plane = np.exp(log_plane - top)
    log_evidence = top + np.log(plane.sum())
    plane /= plane.sum()
    values = [np.broadcast_to(stiffness[:, None], plane.shape), np.broadcast_to(damping, plane.shape)]
    mean = np.array([(plane * value).sum() for value in values + means])
    square = np.array([(plane * value).sum() for value in [value**2 for value in values] + squares])
    return Exact(mean, np.sqrt(square - mean**2), float(log_evidence))
