"""References by brute force: importance sampling with hundreds of thousands of evaluations of a vectorised density.

The draws come from a mixture of many Student-t components, each fitted to the neighbourhood of one point of an
annealed population, so that it follows curved posteriors and bounds. Modes are annealed one by one, and a share of the
draws comes from the prior. Nothing of `samplers` is used.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.special import gammaln

from fe_likelihoods.noise.protocol import noise_statistic

from .case import HardPosterior

__all__ = ["Reference", "log_prob_function", "reference"]

_POPULATION, _COMPONENTS, _NEIGHBOURS, _FREEDOM = 4000, 150, 60, 5.0
_PRIOR_SHARE = 0.05
_CHUNK = 4000  # rows evaluated at once


class Reference(NamedTuple):
    """Known answer of a posterior, with standard errors."""

    log_evidence: float
    log_evidence_error: float
    mean: np.ndarray  # (ndim,), as the next three
    mean_error: np.ndarray
    sd: np.ndarray
    sd_error: np.ndarray
    shares: np.ndarray  # (n_modes,), masses of the modes, as the next
    shares_error: np.ndarray
    effective_sample_size: float  # of the weighted draws
    draws: int  # in the last generations


def log_prob_function(case: HardPosterior, seed: int) -> tuple[Callable, Callable]:
    """Vectorised functions log_prior(x) and log_likelihood(x) of a case, without its model."""
    posterior = case.posterior(seed)
    likelihood, d = posterior.likelihood, len(case.prior)
    measured, noise = likelihood.measurements.values, likelihood.noise
    statistic = noise_statistic(noise)

    def log_likelihood(x: np.ndarray) -> np.ndarray:
        residuals = case.responses(x[:, :d]) - measured
        if statistic is None:
            values = np.square(residuals).sum(axis=-1)
        else:
            values = np.array([statistic(one) for one in residuals])
        return noise.log_likelihood(values, measured.shape[1], x[:, d:])

    return posterior.log_prior, log_likelihood


class _Mixture:
    """Equal Student-t components, and the prior with a small share."""

    def __init__(self, centres, factors, prior):
        self.centres, self.factors, self.prior = centres, factors, prior
        self.inverses = np.linalg.inv(factors)
        d = centres.shape[1]
        self.constants = (
            gammaln(0.5 * (_FREEDOM + d))
            - gammaln(0.5 * _FREEDOM)
            - 0.5 * d * np.log(_FREEDOM * np.pi)
            + np.log(np.abs(np.linalg.det(self.inverses)))
        )

    def draw(self, n, rng):
        n_prior = int(_PRIOR_SHARE * n)
        which = rng.integers(len(self.centres), size=n - n_prior)
        z = rng.standard_normal((n - n_prior, self.centres.shape[1]))
        z /= np.sqrt(rng.chisquare(_FREEDOM, n - n_prior) / _FREEDOM)[:, None]
        x = self.centres[which] + np.einsum("nij,nj->ni", self.factors[which], z)
        return np.concatenate([x, self.prior.rvs(n_prior, rng)])

    def logpdf(self, x):
        d = x.shape[1]
        total = np.full(len(x), -np.inf)
        for centre, inverse, constant in zip(self.centres, self.inverses, self.constants, strict=True):
            squares = np.square((x - centre) @ inverse.T).sum(axis=1)
            total = np.logaddexp(total, constant - 0.5 * (_FREEDOM + d) * np.log1p(squares / _FREEDOM))
        total += np.log((1.0 - _PRIOR_SHARE) / len(self.centres))
        return np.logaddexp(total, np.log(_PRIOR_SHARE) + self.prior.logpdf(x))


def _fit(points: np.ndarray, prior, rng) -> _Mixture:
    """Mixture with components at some of the points, each as wide as its neighbourhood."""
    centres = points[rng.choice(len(points), _COMPONENTS, replace=False)]
    scale = points.std(axis=0) + 1e-12
    factors = []
    for _ in range(2):  # the second time, distances are measured with the covariance found the first time
        previous, factors = factors, []
        for i, centre in enumerate(centres):
            steps = points - centre
            z = steps / scale if not previous else np.linalg.solve(previous[i], steps.T).T
            near = steps[np.argpartition(np.square(z).sum(axis=1), _NEIGHBOURS)[:_NEIGHBOURS]]
            covariance = near.T @ near / _NEIGHBOURS
            covariance += np.diag(1e-4 * np.diag(covariance) + (1e-7 * scale) ** 2)
            factors.append(np.linalg.cholesky(covariance))
    return _Mixture(centres, np.array(factors), prior)


def _evaluate(log_prior, log_likelihood, x):
    """Log-prior and log-likelihood (n,), the second only where the first is finite."""
    before, values = log_prior(x), np.full(len(x), -np.inf)
    inside = np.flatnonzero(before > -np.inf)
    for start in range(0, len(inside), _CHUNK):
        rows = inside[start : start + _CHUNK]
        values[rows] = log_likelihood(x[rows])
    return before, values


def _ess(log_weights: np.ndarray) -> float:
    weights = np.exp(log_weights - log_weights.max())
    return weights.sum() ** 2 / (weights**2).sum()


def reference(case: HardPosterior, seed: int, draws: int = 100_000) -> Reference:
    """Evidence, moments and mode shares of a case by brute force, one annealing per mode.

    There are `draws` in the last generation of every mode; the seed belongs to the data. Raises RuntimeError if the
    annealing or the last generation of a mode is too poor to be a reference.
    """
    rng = np.random.default_rng([seed, 11])
    prior = case.posterior(seed).prior
    log_prior, log_likelihood = log_prob_function(case, seed)
    start = prior.rvs(100_000, rng)
    modes = []
    for mode in range(case.n_modes):

        def log_prior_of_mode(x: np.ndarray, mode: int = mode) -> np.ndarray:
            return np.where(case.labels(x) == mode, log_prior(x), -np.inf)

        modes.append(_anneal(log_prior_of_mode, log_likelihood, prior, start, draws, rng))
    x, log_weights = (np.concatenate(parts) for parts in zip(*modes, strict=True))
    return _estimate(case, x, log_weights, draws)


def _anneal(log_prior, log_likelihood, prior, start, draws, rng) -> tuple[np.ndarray, np.ndarray]:
    """Draws of the last generation, at beta = 1, and the logarithms of their weights."""
    x, log_density, beta = start, prior.logpdf(start), 0.0
    for _ in range(60):
        before, values = _evaluate(log_prior, log_likelihood, x)
        base, values = np.where(values > -np.inf, before - log_density, -np.inf), np.maximum(values, -1e100)
        if beta == 1.0:
            break
        low, high = beta, 1.0
        if _ess(base + values) < 0.5 * _POPULATION:
            for _ in range(50):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if _ess(base + middle * values) > 0.5 * _POPULATION else (low, middle)
        beta = low if high < 1.0 or _ess(base + values) < 0.5 * _POPULATION else 1.0
        log_weights = base + beta * values
        weights = np.exp(log_weights - log_weights.max())
        mixture = _fit(x[rng.choice(len(x), _POPULATION, p=weights / weights.sum())], prior, rng)
        x = mixture.draw(draws if beta == 1.0 else 20_000, rng)
        log_density = mixture.logpdf(x)
    else:
        raise RuntimeError("the annealing of the reference did not arrive at beta = 1")
    if not _ess(base + values) > 0.02 * draws:
        raise RuntimeError(f"the reference of a mode has an effective sample size of {_ess(base + values):.0f} only")
    return x, base + values


def _estimate(case: HardPosterior, x: np.ndarray, log_weights: np.ndarray, draws: int) -> Reference:
    """Estimates from independent draws of every mode, `draws` each, whose weights add up to the evidence."""
    top = log_weights.max()
    w = np.exp(log_weights - top)
    total = w.sum() / draws
    groups = w.reshape(-1, draws)
    error = np.sqrt(np.sum(groups.var(axis=1)) / draws) / total
    w /= w.sum()
    mean = w @ x
    variance = w @ (x - mean) ** 2
    sd = np.sqrt(variance)

    def error_of(values: np.ndarray) -> np.ndarray:
        """Standard error of a weighted mean whose centred terms are given: ratio estimator, per mode and in all."""
        terms = (w[:, None] * values).reshape(-1, draws, values.shape[1])
        return np.sqrt(draws * terms.var(axis=1).sum(axis=0))

    inside = case.labels(x)[:, None] == np.arange(case.n_modes)
    shares = np.minimum(w @ inside, 1.0)  # rounding
    return Reference(
        float(top + np.log(total)),
        float(error),
        mean,
        error_of(x - mean),
        sd,
        error_of((x - mean) ** 2 - variance) / (2.0 * sd),
        shares,
        error_of(inside - shares),
        float(1.0 / np.square(w).sum()),
        len(w),
    )
