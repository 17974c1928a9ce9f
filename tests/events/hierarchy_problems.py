"""Random problems whose hierarchical posterior is known.

The likelihood of every test is normal, or the sum of two normal densities, on the scale of the population, and its
posterior is sampled on a grid. They differ in the number of tests, their errors, the spread between them, the prior,
the scale, the number of samples and where these come from: independent, repeated, weighted, or an autocorrelated chain.
Samples of the exact posterior of the hyper-parameters are weighted with the ratio of the two likelihoods. The error of
a result is the largest shift of a mean of a hyper-parameter, in posterior standard deviations: up to 0.15 is right,
above 0.3 is wrong.
"""

import warnings
from typing import NamedTuple

import numpy as np
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Prior,
    StoredPosterior,
    TruncatedNormal,
    Uniform,
    Varying,
)
from fe_likelihoods.events.reweighting import HierarchyChecks
from fe_likelihoods.priors.distributions import Distribution

__all__ = ["RIGHT", "WRONG", "Problem", "Result", "problem", "solve"]

RIGHT, WRONG = 0.15, 0.3  # largest error of a right result, smallest of a wrong one [posterior sd]
_CENTER, _SPREAD = 0.5, 0.3  # standard deviations of the priors of the mean (about 1, or log 1) and of the spread
_HYPER_SAMPLES = 1500


class Problem(NamedTuple):
    """Tests with known likelihoods."""

    logarithmic: bool  # scale of the population
    # Of the stored samples: "wide", "narrow", "positive", "box", or "far": the prior of the first test is narrow and
    # beside the population, the priors of the others are wide.
    prior: str
    source: str  # of the samples: "independent", "repeated", "weighted" or "chain"
    n_samples: int  # per test
    # (n_parameters, n_tests, 2), means of the two normal densities of each likelihood, on the scale of the population
    centers: np.ndarray
    errors: np.ndarray  # (n_parameters, n_tests, 2), their standard deviations
    shares: np.ndarray  # (n_tests,), of the first of them


class Result(NamedTuple):
    """Largest error of a mean [posterior sd], the ratio of standard deviations, the checks and kinds of warnings."""

    error: float
    sd_ratio: float
    checks: HierarchyChecks
    kinds: tuple[str, ...]


def problem(seed: int) -> Problem:
    """A random problem."""
    rng = np.random.default_rng(seed)
    n_tests, n_parameters = int(rng.choice([2, 3, 5, 8, 15])), int(rng.choice([1, 1, 2]))
    spread = _SPREAD * rng.choice([0.0, 0.3, 1.0, 2.0], size=n_parameters)
    errors = 0.3 * np.exp(rng.choice([-2.0, -1.0, 0.0, 1.0]) + rng.choice([0.0, 1.0]) * rng.standard_normal(n_tests))
    errors = np.clip(errors, 0.003, 3.0)
    logarithmic = bool(rng.random() < 0.5)
    middle = _CENTER * rng.standard_normal(n_parameters) * 0.5 + (0.0 if logarithmic else 1.0)
    truth = middle[:, None] + spread[:, None] * rng.standard_normal((n_parameters, n_tests))
    centers = truth + errors * rng.standard_normal(truth.shape)
    twice = rng.random(n_tests) < (0.5 if rng.random() < 0.3 else 0.0)  # likelihoods with a second mode
    second = np.where(twice, centers + errors * rng.choice([-4.0, -2.0, 2.0, 4.0], n_tests), centers)
    wider = np.where(twice, errors * rng.choice([0.5, 1.0, 3.0], n_tests), errors)  # skewed, or heavy tails
    return Problem(
        logarithmic,
        str(rng.choice(["wide", "wide", "narrow", "positive", "box", "far"])),
        str(rng.choice(["independent", "independent", "repeated", "weighted", "chain"])),
        int(rng.choice([200, 500, 1000, 3000])),
        np.stack([centers, second], axis=-1),
        np.broadcast_to(np.stack([errors, wider], axis=-1), (*centers.shape, 2)),
        np.where(twice, 0.7, 1.0),
    )


def _prior_of(kind: str, logarithmic: bool) -> Distribution:
    """Prior of a parameter of a test."""
    if kind == "far":
        return LogNormal(0.5, 0.2) if logarithmic else TruncatedNormal(0.3, 0.2, -np.inf, np.inf)
    if kind == "wide":
        return LogNormal(1.0, 1.0) if logarithmic else TruncatedNormal(0.0, 2.0, -np.inf, np.inf)
    if kind == "narrow":
        return LogNormal(1.0, 0.4) if logarithmic else TruncatedNormal(1.0, 0.4, -np.inf, np.inf)
    if kind == "positive":
        return HalfNormal(2.0)
    return Uniform(0.3, 2.5)


def solve(given: Problem, seed: int = 0) -> Result:
    """Compare the hierarchical posterior from stored samples with the exact one."""
    rng = np.random.default_rng([seed, 1])
    names = [f"p{i}" for i in range(len(given.centers))]
    low = -np.inf  # a box is not physical; a positive parameter is
    if given.prior == "positive" and not given.logarithmic:
        low = 0.0
    tests = {}
    for k in range(len(given.shares)):
        prior = _prior_of("wide" if given.prior == "far" and k else given.prior, given.logarithmic)
        columns = [
            _posterior_draws(given, prior, given.centers[i, k], given.errors[i, k], given.shares[k], rng)
            for i in range(len(names))
        ]
        if given.source == "weighted" and len(names) == 2:
            log_weights = columns[0][1] + columns[1][1]
        else:
            log_weights = columns[0][1]
        effective = None if given.source != "chain" else given.n_samples * (1.0 - 0.9) / (1.0 + 0.9)
        if given.source == "repeated":
            effective = None
        samples = np.stack([each[0] for each in columns], axis=1)
        if given.source == "repeated":
            samples = samples[np.sort(rng.integers(len(samples) // 2, size=len(samples)))]
        tests[f"T{k}"] = StoredPosterior(
            samples, Prior(dict.fromkeys(names, prior)), log_weights, effective_sample_size=effective
        )
    center = LogNormal(1.0, _CENTER) if given.logarithmic else TruncatedNormal(1.0, _CENTER, -np.inf, np.inf)
    varying = Varying(center, HalfNormal(_SPREAD), "log" if given.logarithmic else "linear")
    posterior = HierarchicalPosterior(tests, dict.fromkeys(names, varying))
    samples, exact = _exact_samples(given, low, rng)
    change = posterior.log_likelihood(samples) - exact
    weights = np.exp(change - change.max())
    weights /= weights.sum()
    measured = samples.copy()
    if given.logarithmic:
        measured[:, ::2] = np.log(measured[:, ::2])
    mean, sd = measured.mean(axis=0), measured.std(axis=0)
    theirs = weights @ measured
    error = np.abs(theirs - mean) / sd
    ratio = np.sqrt(weights @ np.square(measured - theirs)) / sd
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        checks = Hierarchy(posterior, samples[rng.choice(len(samples), 1000, p=weights)]).checks
    kinds = tuple(each.kind for each in checks.findings)
    return Result(
        float(error.max()),
        float(ratio[np.abs(np.log(ratio)).argmax()]),
        checks,
        kinds,
    )


def _log_mixture(u: np.ndarray, centers: np.ndarray, errors: np.ndarray, share: float) -> np.ndarray:
    """Logarithm of the sum of two normal densities."""
    with np.errstate(divide="ignore"):
        first, second = (stats.norm.logpdf(u, centers[i], errors[i]) for i in range(2))
        return np.logaddexp(np.log(share) + first, np.log1p(-share) + second)


def _posterior_draws(
    given: Problem, prior: Distribution, centers: np.ndarray, errors: np.ndarray, share: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray | None]:
    """Samples of one parameter of one test, and the logarithms of their weights."""
    lowest, highest = min(centers) - 12.0 * errors.max(), max(centers) + 12.0 * errors.max()
    bounds = np.array(prior.bounds)
    if given.logarithmic:
        bounds = np.log(np.maximum(bounds, 1e-300))
    lowest = max(min(lowest, bounds[1] - 1.0), bounds[0] + 1e-9)  # the likelihood may be beyond a bound
    highest = min(max(highest, bounds[0] + 1.0), bounds[1] - 1e-9)
    u = np.linspace(lowest, highest, 20001)
    values = np.exp(u) if given.logarithmic else u
    with np.errstate(divide="ignore"):
        log_density = Prior({"p": prior}).logpdf(values[:, None]) + _log_mixture(u, centers, errors, share)
    log_density = log_density + (u if given.logarithmic else 0.0)
    density = np.exp(log_density - log_density.max())
    log_weights = None
    if given.source == "weighted":  # drawn from the square root of the density: wider by a factor of 1.4
        proposal = np.sqrt(density)
        log_weights = 0.5 * np.log(np.maximum(density, 1e-300))
        density = proposal
    cumulative = np.cumsum(density)
    cumulative /= cumulative[-1]
    if given.source == "chain":
        scores = np.empty(given.n_samples)
        scores[0] = rng.standard_normal()
        for i, z in enumerate(rng.standard_normal(given.n_samples - 1)):
            scores[i + 1] = 0.9 * scores[i] + np.sqrt(1.0 - 0.81) * z
        uniform = stats.norm.cdf(scores)
    else:
        uniform = rng.random(given.n_samples)
    draws = np.interp(uniform, cumulative, u)
    weights = None if log_weights is None else np.interp(draws, u, log_weights)
    return np.exp(draws) if given.logarithmic else draws, weights


def _exact_samples(given: Problem, low: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the exact posterior of the hyper-parameters, and their exact log-likelihoods up to a constant."""
    middle = 0.0 if given.logarithmic else 1.0
    axes = middle + np.linspace(-4.0, 4.0, 401) * _CENTER, np.linspace(0.0005, 4.5 * _SPREAD, 400)
    mean, sd = (each.ravel() for each in np.meshgrid(*axes, indexing="ij"))
    columns, total = [], np.zeros(_HYPER_SAMPLES)
    for centers, errors in zip(given.centers, given.errors, strict=True):

        def log_likelihood(m: np.ndarray, s: np.ndarray, centers=centers, errors=errors) -> np.ndarray:
            value = 0.0
            for k, share in enumerate(given.shares):
                parts = []
                for i, part in enumerate((share, 1.0 - share)):
                    with np.errstate(divide="ignore"):
                        log = np.log(part) + stats.norm.logpdf(centers[k, i], m, np.hypot(errors[k, i], s))
                    if low > -np.inf:  # the part of the product of both normal densities above the bound
                        variance = 1.0 / (1.0 / errors[k, i] ** 2 + 1.0 / s**2)
                        at = variance * (centers[k, i] / errors[k, i] ** 2 + m / s**2)
                        log = log + stats.norm.logcdf((at - low) / np.sqrt(variance))
                    parts.append(log)
                value = value + np.logaddexp(*parts)
            return value

        log_density = log_likelihood(mean, sd) - 0.5 * ((mean - middle) / _CENTER) ** 2 - 0.5 * (sd / _SPREAD) ** 2
        density = np.exp(log_density - log_density.max())
        rows = rng.choice(len(mean), _HYPER_SAMPLES, p=density / density.sum())
        jitter = rng.random((2, _HYPER_SAMPLES)) - 0.5
        m = mean[rows] + jitter[0] * (axes[0][1] - axes[0][0])
        s = np.abs(sd[rows] + jitter[1] * (axes[1][1] - axes[1][0]))
        columns += [np.exp(m) if given.logarithmic else m, s]
        total += log_likelihood(m, s)
    return np.stack(columns, axis=1), total
