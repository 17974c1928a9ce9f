"""Make the figures of README and documentation (`make figures`): small files in docs/figures, the same on every run.

Tutorial 01 makes those of the oscillator, 02 and 03 those of the updates, 10 those of damage, 12 those of the choice of
sensors, 13 those of lost stiffness; they take minutes.
`sampler_figures` compares the samplers and shows what goes wrong. The models draw their section and their hysteresis
loops.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import sampler_figures
from PIL import Image

from fe_likelihoods import (
    LinearStructure,
    RCColumn,
    ShearFrame,
    TruncatedNormal,
    material_curves,
    moment_curvature,
    plot_hysteresis,
    plot_material,
    plot_moment_curvature,
    plot_section,
    plot_sensors,
    problems,
    rank_sensors,
)

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "docs" / "figures"
FIGURES_OF_TUTORIALS = {  # script and options: name of its figure, name here
    "01_linear_oscillator.py": {name: f"oscillator_{name}" for name in ("record", "corner", "fit", "prediction")},
    "02_bridge_column.py --events 2 --guide --walkers 100": {
        "fig4_pair": "column_pair",
        "corner": "column_corner",
        "fig5_response": "column_fit",
    },
    "03_isolated_bridge.py --sampler guide --walkers 100 --step 1e-3": {
        "fig5_parameters_and_fit": "bridge_parameters",
        "fig6_marginals": "bridge_marginals",
        "fig7_predictions": "bridge_prediction",
    },
    "10_damage.py": {"damage_predicted": "column_damage", "prediction": "damage_prediction"},
    "12_which_sensors.py": {"column": "sensors_chosen", "predicted_and_obtained": "sensors_predicted"},
    "13_stiffness_loss.py": {"losses": "stiffness_losses"},
}
WIDEST = 1100  # pixels
LARGEST = 145 * 1024  # bytes


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
    plot_material(core, cover, axes=left)
    plot_material(steel, axes=middle)
    curvature = np.linspace(0.0, 0.05, 300)
    cases = {"nominal": np.ones(5), "posterior means": means}
    curves = {name: moment_curvature(column, theta, curvature) for name, theta in cases.items()}
    plot_moment_curvature(curves, right)
    return {
        "column_sensors": sensors,
        "column_materials": materials,
        "column_section": plot_section(column).figure,
        "column_hysteresis": loops,
        "bridge_hysteresis": bearings,
    }


def ranked_sensors() -> dict:
    """Ranks of sensors on the column and on a frame of eight floors."""
    record = problems.bridge_column_data("short").record
    column = RCColumn.lhpost(record)
    heights, bar = np.round(column.height * np.array([0.0, 0.125, 0.25, 0.375, 0.5, 0.75]), 2), column.bar_circle_radius
    outputs = [f"displacement@{z}" for z in (*heights[1:], 7.3152)]
    outputs += [f"curvature@{z}" for z in heights] + [f"strain@{z}:{x:.3f}" for z in heights for x in (bar, -bar)]
    column = replace(column, outputs=("acceleration", *outputs))
    noise = {"acceleration": 0.1, "displacement": 2e-3, "curvature": 2e-4, "strain": 1e-4}
    options = {"noise": noise, "effective_samples": 50.0}
    best = rank_sensors(column, problems.bridge_column_prior(()), **options).chosen
    floors = {f"floor {i}": i for i in range(1, 9)}
    drifts = [f"displacement@floor {i + 1}:floor {i}" for i in (1, 3, 5, 7)]
    building = LinearStructure(ShearFrame(floors, [1.0] * 8, [900.0] * 8), record, outputs=(*floors, *drifts))
    prior = {f"stiffness_{i}": TruncatedNormal(1.0, 0.2) for i in range(1, 9)}
    prior |= {f"damping_{i}": TruncatedNormal(0.03, 0.01) for i in range(1, 9)}
    figure, (left, right) = plt.subplots(1, 2, figsize=(12.4, 6.0), layout="constrained")
    plot_sensors(column, left, best)
    plot_sensors(building, right, rank_sensors(building, prior, effective_samples=50.0).chosen)
    return {"sensors_ranked": figure}


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        for tutorial, figures in FIGURES_OF_TUTORIALS.items():
            script, *options = tutorial.split()
            command = [sys.executable, ROOT / "tutorials" / script, *options, "--out", folder]
            subprocess.run(command, check=True, env={k: v for k, v in os.environ.items() if k != "FAST"})
            for name, new_name in figures.items():
                shrink(Path(folder) / f"{name}.png", new_name)
        samplers = {"samplers_column": sampler_figures.column(), "samplers_bridge": sampler_figures.bridge()}
        for name, figure in (
            model_figures() | ranked_sensors() | samplers | sampler_figures.correlated_errors()
        ).items():
            figure.savefig(Path(folder) / f"{name}.png", dpi=85)
            shrink(Path(folder) / f"{name}.png", name)
    for path in sorted(TARGET.glob("*.png")):
        print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1024:.0f} kB")
