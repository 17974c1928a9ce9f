"""Hierarchical model of several tests from stored posteriors: against NUTS on the whole model, and ranks of the truth.

``hierarchy``: one parameter of six tests with normal errors, and two parameters of six specimens of an oscillator
(`benchmarks.hierarchy_oscillator`, which says how to install PyMC). PyMC samples the whole model at once by NUTS.
PyMC is not a requirement of the tests: without it there is a row that says so.

``hierarchy_ranks``: simulation-based calibration. In 200 data sets, the hyper-parameters are drawn from their prior,
and so are tests with normal errors, whose posteriors have a closed form. If the hierarchical posterior is right, the
rank of the truth among its samples is uniform. The samples are those of the exact hierarchical posterior, which is
known here, weighted with the ratio of the two densities. A wrong formula, without the prior density of the stored
samples, is the control.

Reference: S. Talts, M. Betancourt, D. Simpson, A. Vehtari, A. Gelman (2018), Validating Bayesian inference algorithms
with simulation-based calibration, arXiv:1804.06788.
"""

import importlib.util

import numpy as np
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    Prior,
    StoredPosterior,
    TruncatedNormal,
    Varying,
)
from samplers import SMCSampler

from .hierarchy_oscillator import oscillator
from .rows import Row

__all__ = ["hierarchy", "ranks"]

_HYPER_SAMPLES = 400
_ERRORS = np.array([0.3, 0.5, 0.2, 0.4, 0.3, 0.6])  # standard errors of six tests
_CENTER, _SPREAD, _STORED = 0.5, 0.3, 1.0  # standard deviations of the priors of mean, spread and stored samples


def hierarchy(repeats: int = 1) -> list[Row]:
    """Means and standard deviations against those of NUTS for one parameter of six tests with normal errors."""
    if importlib.util.find_spec("pymc") is None:
        return [Row("hierarchy against NUTS", "", None, "", "not installed: see benchmarks/hierarchy_oscillator.py")]
    import pymc

    rows = []
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        data = 0.5 + 0.4 * rng.standard_normal(len(_ERRORS)) + _ERRORS * rng.standard_normal(len(_ERRORS))
        prior, tests = Prior({"a": TruncatedNormal(0.0, _STORED, -np.inf, np.inf)}), {}
        for k, (value, error) in enumerate(zip(data, _ERRORS, strict=True)):
            variance = 1.0 / (1.0 / error**2 + 1.0 / _STORED**2)
            draws = variance * value / error**2 + np.sqrt(variance) * rng.standard_normal((1000, 1))
            tests[f"T{k}"] = StoredPosterior(draws, prior)
        varying = Varying(TruncatedNormal(0.0, _CENTER, -np.inf, np.inf), HalfNormal(_SPREAD), "linear")
        posterior = HierarchicalPosterior(tests, {"a": varying})
        sampler = SMCSampler(500, posterior.ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 4, progress=False)
        result = Hierarchy(posterior, sampler.get_chain(flat=True))
        with pymc.Model():
            mean, spread = pymc.Normal("mean_a", 0.0, _CENTER), pymc.HalfNormal("sd_a", _SPREAD)
            values = mean + spread * pymc.Normal("scores", 0.0, 1.0, shape=len(data))
            pymc.Deterministic("values", values)
            pymc.Normal("data", values, _ERRORS, observed=data)
            trace = pymc.sample(1000, tune=1000, chains=2, cores=1, random_seed=seed, progressbar=False)
        pairs = {name: (result.samples[:, i], trace.posterior[name]) for i, name in enumerate(("mean_a", "sd_a"))}
        for k, test in enumerate(tests):
            pairs[f"a of {test}"] = result.draw_test(test, seed)["a"], trace.posterior["values"][..., k]
        for name, (ours, reference) in pairs.items():
            theirs = reference.to_numpy().ravel()
            shift = float((ours.mean() - theirs.mean()) / theirs.std())
            note = f"sd ratio {ours.std() / theirs.std():.3f}; NUTS {theirs.mean():.4f} +- {theirs.std():.4f}"
            rows.append(Row(f"shift of the mean of {name}", f"normal errors, seed {seed}", shift, "sd", note))
    return rows + oscillator(repeats)


def ranks(repeats: int = 1, data_sets: int = 200) -> list[Row]:
    """P-values of the uniformity of ranks (Kolmogorov and Smirnov), for `data_sets` times `repeats`."""
    found = [_rank(seed) for seed in range(data_sets * repeats)]
    rows = []
    for i, label in enumerate(("", "closed form: ", "wrong formula: ")):
        part = [each[i] for each in found]
        ranked = np.array([each[0] for each in part])
        effective = np.array([each[1] for each in part])
        note = f"{len(found)} data sets; effective share of the weighted samples {effective.min():.2f} or more, "
        note += f"median {np.median(effective):.2f}"
        for column, name in enumerate(("mean_a", "sd_a", "mean_b", "sd_b", "a of a new test", "b of a new test")):
            value = stats.kstest(ranked[:, column], "uniform").pvalue
            inside = np.mean(np.abs(ranked[:, column] - 0.5) < 0.45)
            rows.append(
                Row(f"{label}p-value of the ranks, {name}", "", float(value), "", f"{note}; 90 %: {inside:.3f}")
            )
    return rows


def _rank(seed: int) -> list[tuple[list[float], float]]:
    """Ranks of the true hyper-parameters and of the parameters of a new test, and the effective share of the samples.

    For the hierarchical posterior, for the closed form (the same samples without weights, which shows what these data
    sets give), and for the wrong formula.
    """
    rng = np.random.default_rng(seed)
    errors = np.stack([_ERRORS, _ERRORS[::-1]], axis=1)  # of two parameters
    mean, spread = _CENTER * rng.standard_normal(2), np.abs(_SPREAD * rng.standard_normal(2))
    values = mean + spread * rng.standard_normal(errors.shape)
    new = mean + spread * rng.standard_normal(2)
    data = values + errors * rng.standard_normal(errors.shape)
    prior = Prior({name: TruncatedNormal(0.0, _STORED, -np.inf, np.inf) for name in ("a", "b")})
    tests = {}
    for k, (row, error) in enumerate(zip(data, errors, strict=True)):
        variance = 1.0 / (1.0 / error**2 + 1.0 / _STORED**2)
        draws = variance * row / error**2 + np.sqrt(variance) * rng.standard_normal((1000, 2))
        tests[f"T{k}"] = StoredPosterior(draws, prior)
    varying = Varying(TruncatedNormal(0.0, _CENTER, -np.inf, np.inf), HalfNormal(_SPREAD), "linear")
    posterior = HierarchicalPosterior(tests, {"a": varying, "b": varying})
    samples, exact = np.empty((_HYPER_SAMPLES, 4)), np.zeros(_HYPER_SAMPLES)
    grid = np.meshgrid(np.linspace(-1.8, 1.8, 121), np.linspace(0.005, 1.4, 140), indexing="ij")
    width = [grid[0][1, 0] - grid[0][0, 0], grid[1][0, 1] - grid[1][0, 0]]

    def log_likelihood(mean: np.ndarray, sd: np.ndarray, column: int) -> np.ndarray:
        total = np.hypot(errors[:, column], sd[..., None])
        return stats.norm.logpdf(data[:, column], mean[..., None], total).sum(axis=-1)

    for column in range(2):
        log_density = log_likelihood(*grid, column) - 0.5 * (grid[0] / _CENTER) ** 2 - 0.5 * (grid[1] / _SPREAD) ** 2
        density = np.exp(log_density - log_density.max()).ravel()
        cells = rng.choice(density.size, _HYPER_SAMPLES, p=density / density.sum())
        jitter = rng.random((2, _HYPER_SAMPLES)) - 0.5
        for i in range(2):
            samples[:, 2 * column + i] = grid[i].ravel()[cells] + width[i] * jitter[i]
        exact += log_likelihood(samples[:, 2 * column], samples[:, 2 * column + 1], column)
    samples[:, [1, 3]] = np.abs(samples[:, [1, 3]])
    truth = [mean[0], spread[0], mean[1], spread[1]]
    results = []
    flat = Prior({name: TruncatedNormal(0.0, 1e6, -np.inf, np.inf) for name in ("a", "b")})
    for which in ("right", "closed form", "wrong"):
        if which == "wrong":  # as if the prior of the stored samples were constant
            posterior.described = {
                name: each._replace(log_prior=np.zeros(len(each.points)), prior=flat)
                for name, each in posterior.described.items()
            }
        difference = np.zeros(len(exact)) if which == "closed form" else posterior.log_likelihood(samples) - exact
        weights = np.exp(difference - difference.max())
        weights /= weights.sum()
        ranked = [float(weights @ (samples[:, i] < truth[i])) for i in range(4)]
        ranked += [float(weights @ stats.norm.cdf(new[i], samples[:, 2 * i], samples[:, 2 * i + 1])) for i in range(2)]
        results.append((ranked, float(1.0 / np.square(weights).sum() / _HYPER_SAMPLES)))
    return results
