"""Hierarchical model of several tests from stored posteriors: against NUTS on the whole model, and ranks of the truth.

``hierarchy``: six tests of linear oscillators, whose stiffness and damping have a log-normal population. Each test is
sampled alone, the population from the stored samples. PyMC samples the whole model at once by NUTS (6 x 2 parameters
and four hyper-parameters; gradients by central differences of the same likelihoods). PyMC is not a requirement of the
tests: without it there is a row that says so.

``hierarchy_ranks``: simulation-based calibration. In 200 data sets, the hyper-parameters are drawn from their prior,
and so are tests with normal errors, whose posteriors have a closed form. If the hierarchical posterior is right, the
rank of the truth among its samples is uniform. The samples are those of the exact hierarchical posterior, which is
known here, weighted with the ratio of the two densities. A wrong formula, without the prior density of the stored
samples, is the control.

Reference: S. Talts, M. Betancourt, D. Simpson, A. Vehtari, A. Gelman (2018), Validating Bayesian inference algorithms
with simulation-based calibration, arXiv:1804.06788.
"""

import importlib.util
import time
from typing import Any

import numpy as np
from scipy import stats

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    Record,
    StoredPosterior,
    TruncatedNormal,
    Varying,
)
from samplers import SMCSampler

from .rows import Row

__all__ = ["hierarchy", "ranks"]

_TESTS, _WALKERS = 6, 500
_DRAWS, _TUNE, _CHAINS = 500, 400, 2
_NAMES = ("stiffness", "damping")
_POPULATION = {"stiffness": (1.1, 0.08), "damping": (0.9, 0.30)}  # median and standard deviation of the logarithm
_STORED_PRIOR = (LogNormal(1.0, 0.6), LogNormal(1.0, 1.0))
_VARYING = {
    "stiffness": Varying(LogNormal(1.0, 0.5), HalfNormal(0.3)),
    "damping": Varying(LogNormal(1.0, 0.5), HalfNormal(0.5)),
}
_DATA_SETS, _HYPER_SAMPLES = 200, 400
_ERRORS = np.array([0.3, 0.5, 0.2, 0.4, 0.3, 0.6])  # standard errors of six tests
_CENTER, _SPREAD, _STORED = 0.5, 0.3, 1.0  # standard deviations of the priors of mean, spread and stored samples


def hierarchy(repeats: int = 1) -> list[Row]:
    """Means and standard deviations against those of NUTS, for `repeats` data sets."""
    if importlib.util.find_spec("pymc") is None:
        return [Row("hierarchy against NUTS", "", None, "", "not installed: pip install '.[clients]'")]
    return [row for seed in range(repeats) for row in _against_nuts(seed)]


def _against_nuts(seed: int) -> list[Row]:
    rng = np.random.default_rng(seed)
    posteriors = []
    for k in range(_TESTS):
        theta = [median * np.exp(sd * rng.standard_normal()) for median, sd in _POPULATION.values()]
        model = LinearOscillator(Record(f"EQ{k}", 0.02, rng.standard_normal(250)), period=0.6)
        response = model.simulate(theta)
        level = 0.4 * response.std(axis=1, keepdims=True)
        measured = Measurements(model.channels, model.dt, response + level * rng.standard_normal(response.shape))
        sigmas = {f"sigma_{c.name}": HalfNormal(2.0 * s) for c, s in zip(model.channels, level[:, 0], strict=True)}
        prior = dict(zip(_NAMES, _STORED_PRIOR, strict=True)) | sigmas
        posteriors.append(Posterior(FELikelihood(model, measured), prior).marginal())
    start = time.perf_counter()
    tests = {}
    for k, posterior in enumerate(posteriors):
        sampler = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=k)
        sampler.run_mcmc(None, 1, progress=False)
        tests[f"EQ{k}"] = StoredPosterior(
            sampler.get_chain(flat=True),
            posterior.prior,
            log_evidence=sampler.log_evidence,
            log_evidence_error=sampler.log_evidence_error,
            effective_sample_size=_WALKERS,
        )
    middle = time.perf_counter()
    simulations = sum(posterior.report()["simulations"] for posterior in posteriors)
    population = HierarchicalPosterior(tests, _VARYING)
    sampler = SMCSampler(_WALKERS, population.ndim, population, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 4, progress=False)
    result = Hierarchy(population, sampler.get_chain(flat=True))
    end = time.perf_counter()
    ours = dict(zip(population.parameter_names, result.samples.T, strict=True))
    for name, draws in result.new_test(len(result.samples), rng=1).items():
        ours[f"{name} of a new test"] = np.log(draws)
    for k, (test, stored) in enumerate(tests.items()):
        weights = result.weights(test)
        rows = rng.choice(len(weights), 4 * _WALKERS, p=weights)
        for i, name in enumerate(_NAMES):
            ours[f"{name} of EQ{k}"] = stored.samples[rows, i]
    theirs, evaluations, seconds, warned = _nuts(posteriors, seed)
    case = f"seed {seed}, {_TESTS} tests"
    note = (
        f"{simulations} simulations in {middle - start:.0f} s, then none in {end - middle:.0f} s; NUTS: {evaluations} "
    )
    note += f"simulations in {seconds:.0f} s, {warned}"
    rows = [Row("largest error of a mean by the checks", case, max(result.checks.mean_errors.values()), "sd", note)]
    shifts = {}
    for name, reference in theirs.items():
        shifts[name] = (
            (ours[name].mean() - reference.mean()) / reference.std(),
            ours[name].std() / reference.std(),
        )
    for name in [*population.parameter_names, *(f"{each} of a new test" for each in _NAMES)]:
        shift, ratio = shifts[name]
        note = f"sd ratio {ratio:.3f}; NUTS {theirs[name].mean():.4f} +- {theirs[name].std():.4f}"
        rows.append(Row(f"shift of the mean of {name}", case, float(shift), "sd", note))
    of_tests = np.array([each for name, each in shifts.items() if " of EQ" in name])
    alone = np.array([
        (tests[f"EQ{k}"].samples[:, i].mean() - theirs[f"{name} of EQ{k}"].mean()) / theirs[f"{name} of EQ{k}"].std()
        for k in range(_TESTS)
        for i, name in enumerate(_NAMES)
    ])  # fmt: skip
    note = f"sd ratios {of_tests[:, 1].min():.3f} to {of_tests[:, 1].max():.3f}; of the tests alone "
    note += f"{np.abs(alone).max():.2f} sd"
    return [*rows, Row("largest shift of a test's parameter", case, float(np.abs(of_tests[:, 0]).max()), "sd", note)]


def _nuts(posteriors: list[Posterior], seed: int) -> tuple[dict[str, np.ndarray], int, float, str]:
    """Samples of the whole model by NUTS under our names, simulations, seconds, and a note on convergence."""
    import arviz
    import pymc
    import pytensor.tensor as pt
    from pytensor.graph.op import Op

    step = 1e-4
    offsets = step * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    counted = [0]
    cache: dict[bytes, np.ndarray] = {}

    def evaluate(logs: np.ndarray) -> np.ndarray:
        """Log-likelihoods at the points of central differences, (n_tests, 5), for logarithms (n_tests, 2)."""
        key = logs.tobytes()
        if key not in cache:
            cache.clear()
            cache[key] = np.stack(
                [p.log_likelihood(np.exp(row + offsets)) for p, row in zip(posteriors, logs, strict=True)]
            )
            counted[0] += cache[key].size
        return cache[key]

    class Gradient(Op):
        itypes, otypes = (pt.dmatrix,), (pt.dmatrix,)

        def perform(self, node: Any, inputs: list, outputs: list) -> None:
            values = np.maximum(evaluate(inputs[0]), -1e10)  # finite where the damping ratio exceeds one
            outputs[0][0] = np.stack([values[:, 1] - values[:, 2], values[:, 3] - values[:, 4]], axis=1) / (2.0 * step)

    class LogLikelihood(Op):
        itypes, otypes = (pt.dmatrix,), (pt.dscalar,)

        def perform(self, node: Any, inputs: list, outputs: list) -> None:
            outputs[0][0] = np.array(evaluate(inputs[0])[:, 0].sum())

        def L_op(self, inputs: list, outputs: list, gradients: list) -> list:  # noqa: N802, the name in pytensor
            return [gradients[0] * Gradient()(inputs[0])]

    start = time.perf_counter()
    with pymc.Model():
        columns = []
        for name in _NAMES:
            each = _VARYING[name]
            median = pymc.LogNormal(f"median_{name}", np.log(each.location.median), each.location.log_sd)
            spread = pymc.HalfNormal(f"sd_log_{name}", each.sd.sd)
            scores = pymc.Normal(f"scores_{name}", 0.0, 1.0, shape=_TESTS)
            columns.append(pymc.Deterministic(f"log_{name}", pt.log(median) + spread * scores))
        pymc.Potential("log_likelihood", LogLikelihood()(pt.stack(columns, axis=1)))
        trace = pymc.sample(
            _DRAWS, tune=_TUNE, chains=_CHAINS, cores=1, random_seed=seed, progressbar=False, target_accept=0.9
        )
    seconds = time.perf_counter() - start
    hyper = [f"{kind}_{name}" for name in _NAMES for kind in ("median", "sd_log")]
    samples = {name: trace.posterior[name].to_numpy().ravel() for name in hyper}
    rng = np.random.default_rng(seed)
    for name in _NAMES:
        median, spread = samples[f"median_{name}"], samples[f"sd_log_{name}"]
        samples[f"{name} of a new test"] = np.log(median) + spread * rng.standard_normal(len(median))
        logs = trace.posterior[f"log_{name}"].to_numpy().reshape(-1, _TESTS)
        samples |= {f"{name} of EQ{k}": np.exp(logs[:, k]) for k in range(_TESTS)}
    divergent = int(trace.sample_stats["diverging"].to_numpy().sum())
    effective = min(float(arviz.ess(trace.posterior[name].to_numpy())) for name in hyper)
    return samples, counted[0], seconds, f"{divergent} divergences, effective sample size {effective:.0f}"


def ranks(repeats: int = 1) -> list[Row]:
    """P-values of the uniformity of ranks (Kolmogorov and Smirnov), for 200 data sets times `repeats`."""
    found = [_rank(seed) for seed in range(_DATA_SETS * repeats)]
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
