"""Ranks of sensors against posteriors that are obtained, and against mechanics.

`variances`: sensors are chosen by `rank_sensors` for the variance of a peak under another motion. Each synthetic test
has parameters drawn from the prior and white noise of known levels, and is updated by a run with a guide. The rows are
ratios of obtained to predicted variances, of the target and of the parameters (in standard normal coordinates of the
prior), where the prediction is linearised at the true parameters; and the mean obtained variance of the target over the
tests against the mean that the ranking predicts before any test.

`heights`: what sensors along the height of the tested column tell, each of them alone, under the short synthetic motion
and with one noise level for all sensors of a kind (assumed).
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    FELikelihood,
    GaussianNoise,
    GroupedFrame,
    LinearOscillator,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    RCColumn,
    TruncatedNormal,
    peak,
    problems,
    propagate,
    rank_sensors,
)
from fe_likelihoods.information.sensors import slopes_at, variance_of
from fe_likelihoods.prediction.quantities import ChannelQuantity, evaluator
from samplers import SMCSampler

from .rows import Row

__all__ = ["heights", "variances"]

WALKERS, SWEEPS, DRAWS = 400, 2, 40
COLUMN_NOISE = {"acceleration": 0.1, "displacement": 2e-3, "curvature": 2e-4, "strain": 1e-4, "bar_stress": 2e7}  # [SI]


class _Case(NamedTuple):
    """A model with its candidates, its prior, their noise levels [SI], the model of the target, and the target."""

    model: Any
    prior: Prior
    noise: dict[str, float]
    design: Any
    target: ChannelQuantity
    n_sensors: int
    tests: int | None = None


def _oscillator() -> _Case:
    motion = problems.table_motion().trim(0.0, 6.0).resample(0.02)
    model = LinearOscillator(motion, 0.5)
    prior = Prior({"stiffness": TruncatedNormal(1.0, 0.2), "damping": TruncatedNormal(1.0, 0.3)})
    sd = 0.2 * model.simulate(np.ones(2)).std(axis=1)
    noise = dict(zip(("acceleration", "displacement"), sd.tolist(), strict=True))
    return _Case(model, prior, noise, model.with_record(motion.trim(0.5, 5.0).scale(2.0)), peak("displacement"), 2)


def _frame() -> _Case:
    motion = problems.table_motion().trim(0.0, 6.0).resample(0.02)
    floors = {f"floor {i}": i for i in range(1, 4)}
    drifts = tuple(f"displacement@floor {i}:floor {i - 1}" for i in range(2, 4))
    frame = GroupedFrame(floors, [1.0] * 3, [1500.0] * 3, groups=[1, 2, 3])
    model = LinearStructure(frame, motion, outputs=(*floors, "displacement@floor 1", *drifts))
    prior = Prior(
        {f"stiffness_{i}": TruncatedNormal(1.0, 0.2) for i in range(1, 4)} | {"damping": LogNormal(0.03, 0.3)}
    )
    middle = prior.from_normal(np.zeros(prior.dim))
    sd = 0.2 * model.simulate(middle).std(axis=1)
    noise = dict(zip((channel.name for channel in model.channels), sd.tolist(), strict=True))
    return _Case(model, prior, noise, model.with_record(motion.trim(0.5, 5.0)), peak("displacement@floor 1"), 3)


def _column() -> _Case:
    motion = problems.bridge_column_data("short").record.trim(0.0, 6.0)
    bar = RCColumn.lhpost(motion).bar_circle_radius
    outputs = ["acceleration", "displacement", "displacement@3.6576", "curvature@0", f"bar_stress@0:{bar:.3f}"]
    outputs += [f"strain@{z}:{x:.3f}" for z in (0.0, 1.8288, 3.6576) for x in (bar, -bar)]
    model = RCColumn.lhpost(motion, outputs=outputs, substeps=2)
    noise = {name: 3.0 * COLUMN_NOISE[name.partition("@")[0]] for name in outputs}
    prior = problems.bridge_column_prior(()).subset(model.parameter_names)
    return _Case(model, prior, noise, model.with_record(motion.scale(1.5)), peak("displacement"), 3, 2)


_CASES = {"oscillator": _oscillator, "frame": _frame, "column": _column}


def _with_sensors(model: Any, names: tuple[str, ...]) -> Any:
    """The model with some of its channels only."""
    if isinstance(model, RCColumn):
        return replace(model, outputs=names)
    if isinstance(model, LinearStructure):
        return LinearStructure(model.parts, model.supports, outputs=names)
    return model


def variances(repeats: int = 1, cases: tuple[str, ...] = tuple(_CASES), tests: int = 20) -> Iterator[Row]:
    """Ratios of obtained to predicted posterior variances of chosen sensors; two tests of the column."""
    for name in cases:
        case = _CASES[name]()
        ranking = rank_sensors(
            case.model,
            case.prior,
            target=case.target,
            target_model=case.design,
            n_sensors=case.n_sensors,
            noise=case.noise,
            draws=DRAWS,
        )
        chosen = tuple(c.name for c in case.model.channels if c.name in ranking.chosen)
        model, n = _with_sensors(case.model, chosen), repeats * min(tests, case.tests or tests)
        coords = np.random.default_rng(3).standard_normal((n, case.prior.dim))
        predicted, of_target = _predicted(case, model, coords)
        found = [_obtained(case, model, theta, seed) for seed, theta in enumerate(case.prior.from_normal(coords))]
        obtained, target, simulations, statuses = (np.array(each) for each in zip(*found, strict=True))
        note = f"{n} tests, {', '.join(ranking.chosen)}; verdicts: {', '.join(sorted(set(statuses)))}"
        for what, ratio in (("the target", target / of_target), ("the parameters", obtained / predicted)):
            between = f"from {ratio.min():.2f} to {ratio.max():.2f}"
            yield Row(f"variance of {what}, obtained by predicted", name, _mean(ratio), "", f"{between}; {note}")
        whole = ranking.target_left[-1] * ranking.target_variance
        errors = target.std(ddof=1) / np.sqrt(n) / whole, ranking.target_left_errors[-1] / ranking.target_left[-1]
        note = f"standard error {errors[0]:.2f} of the tests, {100.0 * errors[1]:.0f} % of the prediction"
        yield Row("mean variance of the target, by the ranking's", name, float(target.mean() / whole), "", note)
        yield Row("simulations of a test", name, float(np.median(simulations)), "", "median")


def _mean(ratio: np.ndarray) -> float:
    return float(np.exp(np.log(ratio).mean()))


def _predicted(case: _Case, model: Any, coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Posterior variances of the coordinates (n, d) and of the target (n,), linearised at the true parameters."""
    steps = np.where(coords > 0.0, -0.02, 0.02)
    function = evaluator(case.target, case.design.channels, case.design.dt, case.design.n_steps).function
    gradients = slopes_at(case.design, case.prior, coords, steps, function).gradients
    weights = np.array([case.noise[channel.name] for channel in model.channels]) ** -2.0
    precision = np.eye(coords.shape[1]) + np.einsum(
        "c,mcij->mij", weights, slopes_at(model, case.prior, coords, steps).products
    )
    return np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2), variance_of(precision, gradients)


def _obtained(case: _Case, model: Any, theta: np.ndarray, seed: int) -> tuple[np.ndarray, float, float, str]:
    """Posterior variances of the coordinates (d,) and of the target, simulations, and the verdict of one test."""
    levels = np.array([case.noise[channel.name] for channel in model.channels])
    errors = levels[:, None] * np.random.default_rng([seed, 1]).standard_normal((len(levels), model.n_steps))
    measured = Measurements(model.channels, model.dt, model.simulate(theta) + errors)
    known = {f"sigma_{c.name}": LogNormal(case.noise[c.name], 1e-3) for c in model.channels}
    likelihood = FELikelihood(model, measured, GaussianNoise(model.channels))
    posterior = Posterior(likelihood, case.prior.distributions | known)
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed, guide=posterior.guide())
    sampler.run_mcmc(None, SWEEPS)
    samples = sampler.get_chain(flat=True)[:, : case.prior.dim]
    sd = propagate(case.design, samples, quantity=case.target, progress=False).sd
    of_coords = case.prior.to_normal(samples).var(axis=0)
    return of_coords, float(np.squeeze(sd)) ** 2, float(sampler.simulations), sampler.verdict.status


def heights(repeats: int = 1, draws: int = 20) -> Iterator[Row]:
    """Information of sensors along the height of the column, each alone, and what they leave of the parameters."""
    record = problems.bridge_column_data("short").record
    column = RCColumn.lhpost(record)
    height, bar = column.height, column.bar_circle_radius
    places = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 6.0]) * height / 8.0
    outputs = [f"displacement@{z:.4f}" for z in (*places[1:], height)]
    outputs += [f"acceleration@{z:.4f}" for z in height * np.arange(1, 5) / 4.0]
    outputs += [f"curvature@{z:.4f}" for z in places] + [f"strain@{z:.4f}:{bar:.3f}" for z in places]
    outputs += [f"bar_stress@0:{bar:.3f}"]
    column = replace(column, outputs=tuple(outputs), column_mass=2.05e4, n_elements=4, substeps=16)
    prior = problems.bridge_column_prior(()).subset(column.parameter_names)
    coords = np.random.default_rng(1).standard_normal((repeats * draws, prior.dim))
    slopes = slopes_at(column, prior, coords, np.where(coords > 0.0, -0.1, 0.1))
    for i, name in enumerate(outputs):
        level, rms = COLUMN_NOISE[name.partition("@")[0]], np.sqrt(slopes.mean_squares[:, i].mean())
        precision = np.eye(prior.dim) + slopes.products[:, i] * 50.0 / column.n_steps / level**2
        information = 0.5 * np.linalg.slogdet(precision)[1].mean()
        left = np.sqrt(np.diagonal(np.linalg.inv(precision), axis1=1, axis2=2).mean(axis=0))
        shares = ", ".join(f"{each} {100.0 * x:.0f} %" for each, x in zip(prior.names, left, strict=True))
        yield Row("information alone", name, float(information), "nat", f"RMS {rms:.3g}; left: {shares}")
