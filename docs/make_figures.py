"""Make the figures of README and documentation (`make figures`): small files in docs/figures, the same on every run.

Tutorials make most of them. The column with two events takes minutes. Figures of real measurements and of reports are
kept as they are (``real_*.png``, ``report_*.png``, ``stiffness_loss_reliability.png``).
"""

import os
import runpy
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy.signal import lfilter

from fe_likelihoods import (
    AutoregressiveNoise,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    TruncatedNormal,
    Uniform,
    material_curves,
    moment_curvature,
    plot_fit,
    plot_hysteresis,
    plot_residuals,
    plot_section,
    plot_sensors,
    problems,
)
from samplers import SMCSampler, plot_corner

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "figures"
FIGURES_OF_TUTORIALS = {  # name of the figure: name here
    "01_first_steps": {name: f"oscillator_{name}" for name in ("record", "corner", "fit", "prediction")},
    "05_few_simulations": {"marginals": "bridge_marginals"},
    "06_events_and_prediction": {"new_events": "new_events"},
    "07_damage_and_decision": {"damage": "column_damage", "prediction": "damage_prediction"},
    "08_which_sensors": {"column": "sensors_chosen", "motions": "sensors_motions"},
    "09_stiffness_loss": {"losses": "stiffness_losses"},
}
WIDEST = 1100  # pixels
LARGEST = 145 * 1024  # bytes
SEED = 1
CORRELATION_TIME = 0.6  # [s] of the errors: as of model errors, which change more slowly than the samples follow


def shrink(source: Path, name: str) -> None:
    """Save a figure in docs/figures with 128 colours, which look the same and need a third of the space."""
    path, widest = TARGET / f"{name}.png", WIDEST
    while widest == WIDEST or path.stat().st_size > LARGEST:
        picture = Image.open(source).convert("RGB")
        picture.thumbnail((widest, widest), Image.Resampling.LANCZOS)
        picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
        widest = round(0.9 * widest)


def model_figures() -> dict:
    """Figures that the models draw, by name."""
    posterior = problems.bridge_column(every=8)
    column = posterior.likelihood.model
    strong = replace(column, loading=column.loading.scale(2.5))
    loops = plot_hysteresis(strong, [problems.BRIDGE_COLUMN_MEANS[name] for name in column.parameter_names])
    loops.suptitle("bridge column under 2.5 times the synthetic motion", fontsize="medium")
    bearings = plot_hysteresis(problems.isolated_bridge().likelihood.model, np.ones(10))
    bearings.suptitle("isolated bridge, nominal values (assumed), synthetic motion", fontsize="medium")
    means = [problems.BRIDGE_COLUMN_MEANS[name] for name in column.parameter_names]
    bar = round(column.bar_circle_radius, 3)
    places = (*(f"strain@0.3:{x}" for x in (bar, -bar)), f"strain@0.6:{bar}", "curvature@0", "curvature@1.8288")
    outputs = (
        "acceleration",
        "displacement",
        "base_moment",
        "base_shear",
        *places,
        "rotation@0:0.6",
        "rotation@0.6:1.2",
    )
    sensors = plot_sensors(replace(column, outputs=outputs)).figure
    materials, (left, middle, right) = plt.subplots(1, 3, figsize=(12.8, 4.0), layout="constrained")
    core, cover, steel = material_curves(column, np.ones(5))
    for axes, drawn in ((left, (core, cover)), (middle, (steel,))):
        for curve in drawn:
            axes.plot(100.0 * curve.strain, 1e-6 * curve.stress, linewidth=1.2, label=curve.name)
        axes.set(xlabel="strain [%]", ylabel="stress [MPa]")
    curvature = np.linspace(0.0, 0.05, 300)
    cases = {"nominal": np.ones(5), "posterior means": means}
    for name, theta in cases.items():
        right.plot(curvature, 1e-3 * moment_curvature(column, theta, curvature).moment, linewidth=1.2, label=name)
    right.set(xlabel="curvature [1/m]", ylabel="moment [kN m]")
    for axes in (left, middle, right):
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize="small")
    return {
        "column_sensors": sensors,
        "column_materials": materials,
        "column_section": plot_section(column).figure,
        "column_hysteresis": loops,
        "bridge_hysteresis": bearings,
    }


def _oscillator(seed: int) -> tuple[Measurements, LinearOscillator, np.ndarray]:
    """Synthetic measurements with errors that are correlated from sample to sample."""
    motion = problems.bridge_column_data().record
    motion = motion.resample(2 * motion.dt).trim(0.0, 25.0)
    model = LinearOscillator(motion, period=1.0, damping_ratio=0.05)
    truth, correlation = np.array([1.15, 0.7]), np.exp(-motion.dt / CORRELATION_TIME)
    clean = model.simulate(truth)
    errors = np.random.default_rng(seed).standard_normal(clean.shape)
    errors[:, 1:] *= np.sqrt(1.0 - correlation**2)
    errors = 0.3 * clean.std(axis=1, keepdims=True) * lfilter([1.0], [1.0, -correlation], errors, axis=1)
    return Measurements(model.channels, model.dt, clean + errors, "SYNTHETIC: errors with correlation"), model, truth


def _sample(
    measured: Measurements, model: LinearOscillator, correlated: bool, seed: int
) -> tuple[Posterior, np.ndarray]:
    """Posterior and samples under white noise or under AR(1) errors."""
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.5)}
    prior |= {
        f"sigma_{channel.name}": HalfNormal(scale) for channel, scale in zip(model.channels, (5.0, 0.2), strict=True)
    }
    noise = AutoregressiveNoise(model.channels) if correlated else GaussianNoise(model.channels)
    prior |= {f"rho_{channel.name}": Uniform(0.0, 1.0) for channel in model.channels} if correlated else {}
    posterior = Posterior(FELikelihood(model, measured, noise), prior)
    sampler = SMCSampler(300, posterior.ndim, posterior, vectorize=True, seed=seed)
    sampler.run_mcmc(None, 4)
    return posterior, sampler.get_chain(flat=True)


def correlated_errors() -> dict[str, Figure]:
    """What white noise does to a posterior when the errors are correlated: intervals too narrow, and how to see it."""
    measured, model, truth = _oscillator(SEED)
    runs = {"white noise": _sample(measured, model, False, SEED), "AR(1) noise": _sample(measured, model, True, SEED)}
    figure, axes = plt.subplots(figsize=(5.0, 4.0), layout="constrained")
    for label, (_, x) in runs.items():
        axes.plot(x[:, 0], x[:, 1], ".", markersize=3, label=label)
    axes.plot(*truth, "k+", markersize=12, label="true value")
    axes.legend(title="synthetic data")
    posterior, x = runs["white noise"]
    axes.set(xlabel=posterior.parameters[0].label, ylabel=posterior.parameters[1].label)
    residuals = posterior.likelihood.residuals_of(model.simulate(x[:, :2].mean(axis=0)))
    return {
        "wrong_noise": figure,
        "wrong_noise_residuals": plot_residuals(residuals, model.channels, model.dt),
    }


def column_update() -> dict:
    """The column of the published study, updated with EQ1 and a stronger EQ2."""
    posterior = problems.bridge_column(data="eq1-eq2")
    truth = problems.bridge_column_data("eq1-eq2").attributes["truth"]
    sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=SEED, guide=posterior.guide())
    sampler.run_mcmc(None, 1)
    print(sampler.verdict)
    measured, means = posterior.likelihood.measurements, sampler.get_chain(flat=True).mean(axis=0)[:5]
    points = {"Before updating (reported values)": np.ones(5), "After updating (posterior mean)": means}
    model = posterior.likelihood.model
    responses = {title: model.simulate(theta) for title, theta in points.items()}
    corner = plot_corner(sampler.signed_sample.draw(4000, SEED), posterior, truths=list(truth.values()))
    return {"column_corner": corner, "column_fit": plot_fit(measured, responses, title="synthetic data")}


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    made = model_figures() | correlated_errors() | column_update()
    with tempfile.TemporaryDirectory() as folder:
        for name, figure in made.items():
            figure.savefig(Path(folder) / f"{name}.png", dpi=85)
            shrink(Path(folder) / f"{name}.png", name)
        os.chdir(folder)
        for tutorial, figures in FIGURES_OF_TUTORIALS.items():
            runpy.run_path(str(ROOT / "tutorials" / f"{tutorial}.py"))
            for name, new_name in figures.items():
                shrink(Path(folder) / f"{name}.png", new_name)
    for path in sorted(TARGET.glob("*.png")):
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} kB")
