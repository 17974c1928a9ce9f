"""Expectations from few draws of a guide: their true errors beside their stated errors.

All runs of a problem have the same data. The reference is a run with many walkers, whose own standard error is added to
the stated errors. Stated errors cover if about 95 % of all estimates lie within two of them.
"""

import warnings
from collections.abc import Iterator

import numpy as np

from fe_likelihoods import Posterior, peak, propagate_few
from fe_likelihoods.prediction.prediction import Prediction
from samplers import SamplingWarning, SMCSampler

from .few_simulations_problems import PROBLEMS, oscillator
from .rows import Row

__all__ = ["coverage", "expectations"]

_LEVELS = (0.05, 0.25, 0.5, 0.75, 0.95)


def expectations(
    repeats: int,
    problems: tuple[str, ...] = ("oscillator", "twin", "column4"),
    walkers: int = 30,
    runs: int = 12,
    reference: int = 400,
) -> Iterator[Row]:
    """Simulations, errors of means and coverage per problem; `reference`: walkers of the reference.

    All figures are averages over `runs`, so `repeats` is not used.
    """
    for problem in problems:
        truth, known = _estimates(problem, 1000, reference)
        sd = truth["sd"][0]
        found = [_estimates(problem, seed, walkers) for seed in range(runs)]
        yield Row("simulations", problem, float(np.mean([sampler.simulations for _, sampler in found])), "")
        draws = [sum(r.draws for r in sampler.rounds) for _, sampler in found]
        yield Row("weighted draws", problem, float(np.mean(draws)), "")
        errors = np.array([(each["mean"][0] - truth["mean"][0]) / sd for each, _ in found])
        yield Row("error of means", problem, float(np.sqrt(np.mean(errors**2))), "sd", "root mean square")
        stated = np.array([each["mean"][1] / sd for each, _ in found])
        yield Row("stated error of means", problem, float(np.sqrt(np.mean(stated**2))), "sd")
        for name, (value, error) in truth.items():
            scores = np.array([(each[name][0] - value) / np.hypot(each[name][1], error) for each, _ in found])
            yield Row(f"{name} within two errors", problem, 100.0 * float(np.mean(np.abs(scores) < 2.0)), "%")
        yield from _predictions(problem, known, [sampler for _, sampler in found])


def _predictions(problem: str, reference: SMCSampler, samplers: list[SMCSampler]) -> Iterator[Row]:
    """Peak of the first channel under 1.3 times the motion, from 30 simulations; the reference has 400."""
    truth, found = _peak(problem, reference, 0, 400), [_peak(problem, each, k) for k, each in enumerate(samplers, 1)]
    pairs = [(each.mean, each.standard_error) for each in found], (truth.mean, truth.standard_error)
    quantiles = [(each.quantiles[-1], each.quantile_error[-1]) for each in found]
    for name, values, exact in (
        ("mean of a predicted peak", *pairs),
        ("95 % quantile of a predicted peak", quantiles, (truth.quantiles[-1], truth.quantile_error[-1])),
    ):
        errors = np.array([(value - exact[0]) / truth.sd for value, _ in values])
        scores = np.array([(value - exact[0]) / np.hypot(error, exact[1]) for value, error in values])
        yield Row(f"error of the {name}", problem, float(np.sqrt(np.mean(errors**2))), "sd", "30 simulations")
        yield Row(f"{name} within two errors", problem, 100.0 * float(np.mean(np.abs(scores) < 2.0)), "%")


def _peak(problem: str, sampler: SMCSampler, seed: int, simulations: int = 30) -> Prediction:
    posterior = PROBLEMS[problem].posterior(1)
    model = posterior.likelihood.model
    return propagate_few(
        posterior,
        sampler.signed_sample,
        quantity=peak(model.channels[0].name),
        record=model.record.scale(1.3),
        from_state="virgin",
        simulations=simulations,
        seed=seed,
        progress=False,
    )


def _estimates(problem: str, seed: int, walkers: int) -> tuple[dict[str, tuple], SMCSampler]:
    """Values and stated errors of a run, by name, and its sampler."""
    return _estimates_of(PROBLEMS[problem].posterior(1), seed, walkers)


def _estimates_of(posterior: Posterior, seed: int, walkers: int) -> tuple[dict[str, tuple], SMCSampler]:
    sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, guide=posterior.guide())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SamplingWarning)
        sampler.run_mcmc(None, 0)
    sample = sampler.signed_sample
    if sample is None:
        raise RuntimeError(f"seed {seed}: the guide has no emulator, so there are no expectations to compare")
    quantiles = {f"{100 * p:.0f} % quantile": sample.quantile(p) for p in _LEVELS}
    evidence = sample.log_evidence, sample.log_evidence_error
    return {"mean": sample.expectation(), "sd": sample.standard_deviation(), **quantiles, "log Z": evidence}, sampler


def coverage(repeats: int, data_sets: int = 200, walkers: int = 30) -> Iterator[Row]:
    """Synthetic data sets of the oscillator, with true values from the prior: exact posteriors by quadrature.

    About 95 % of all estimates lie within two stated errors of the exact value, and the true values lie in 50 and 90 %
    of the intervals of these levels. `repeats` is not used.
    """
    prior = oscillator(1).prior
    scores: dict[str, list[np.ndarray]] = {}
    inside, simulations, statuses, errors = {0.5: [], 0.9: []}, [], [], []
    for number in range(data_sets):
        truth = prior.rvs(1, number)[0]
        posterior = oscillator(1000 + number, tuple(truth))
        found, sampler = _estimates_of(posterior, number, walkers)
        simulations.append(sampler.simulations)
        statuses.append(sampler.verdict.status)
        exact = _quadrature(posterior, found["mean"][0], found["sd"][0])
        errors.append((found["mean"][0] - exact["mean"]) / exact["sd"])
        for name, (value, error) in found.items():
            scores.setdefault(name, []).append(np.atleast_1d((value - exact[name]) / error))
        for level, kept in inside.items():
            low, high = (found[f"{50 * (1 + sign * level):.0f} % quantile"][0] for sign in (-1, 1))
            kept.append((low < truth) & (truth < high))
    yield Row("simulations", f"oscillator, {data_sets} data sets", float(np.mean(simulations)), "")
    yield Row("converged", "", 100.0 * statuses.count("converged") / data_sets, "%")
    yield Row("error of means", "", float(np.sqrt(np.mean(np.square(errors)))), "sd", "root mean square")
    for name, values in scores.items():
        share = np.mean(np.abs(np.concatenate(values)) < 2.0)
        yield Row(f"{name} within two errors", "", 100.0 * float(share), "%", "95 if the stated errors are right")
    for level, kept in inside.items():
        note = f"standard error {100.0 * np.sqrt(level * (1.0 - level) / np.size(kept)):.1f}"
        yield Row(f"true values in {100 * level:.0f} % intervals", "", 100.0 * float(np.mean(kept)), "%", note)


def _quadrature(posterior: Posterior, mean: np.ndarray, sd: np.ndarray, points: int = 61) -> dict[str, np.ndarray]:
    """Exact values by the midpoint rule for two parameters, six standard deviations about the mean."""
    axes = [np.maximum(m + s * np.linspace(-6.0, 6.0, points), 1e-6) for m, s in zip(mean, sd, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = posterior(grid.reshape(-1, 2)).reshape(points, points)
    weights = np.exp(values - values.max())
    area = np.prod([axis[-1] - axis[-2] for axis in axes])
    exact = {"log Z": float(values.max() + np.log(weights.sum() * area))}
    weights /= weights.sum()
    marginals = weights.sum(axis=1), weights.sum(axis=0)
    exact["mean"] = np.array([w @ axis for w, axis in zip(marginals, axes, strict=True)])
    exact["sd"] = np.sqrt([w @ (axis - m) ** 2 for w, axis, m in zip(marginals, axes, exact["mean"], strict=True)])
    for level in _LEVELS:
        edges = [axis + 0.5 * (axis[-1] - axis[-2]) for axis in axes]
        at = [np.interp(level, np.cumsum(w), edge) for w, edge in zip(marginals, edges, strict=True)]
        exact[f"{100 * level:.0f} % quantile"] = np.array(at)
    return exact
