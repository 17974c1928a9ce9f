# %% [markdown]
# # Updating a reinforced-concrete bridge column with SMC
#
# The main job of this library, end to end: a nonlinear fiber finite-element model of a full-scale bridge column
# (Ramancha, Astroza, Conte, Restrepo & Todd, "Bayesian nonlinear finite element model updating of a full-scale
# bridge-column using sequential Monte Carlo") is updated with the acceleration and the displacement of its top.
# Five structural parameters and two noise levels are sampled by SMC; the paper's Table 2 and Figures 3 to 5 are left in
# a folder.
#
# The measurements of the paper are not public. **The data used here are synthetic**: the response of a finer model at
# the paper's posterior means, plus white noise of the paper's levels, under a synthetic base motion (bundled) or under
# any record you name:
#
#     python tutorials/02_bridge_column.py                                       # all data, the default sampler
#     python tutorials/02_bridge_column.py --preset reduced                      # a quarter of the samples; minutes
#     python tutorials/02_bridge_column.py --preset ramancha2022                 # the paper's own algorithm; hours
#     python tutorials/02_bridge_column.py --record motion.AT2 --scale 0.85      # another base motion (AT2, V2, CSV)
#     python tutorials/02_bridge_column.py --preset reduced --classes            # which geometry, which softening?

# %%
import argparse
import csv
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import corner
import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import problems
from fe_likelihoods.models.rc_column import PARAMETERS
from fe_likelihoods.signals import records
from fe_likelihoods.units import from_si
from samplers import RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL, SMCSampler
from samplers.reporting.figures import ladder_plot, pair_plot
from samplers.reporting.summary import ladder_table, summary, to_arviz

# walkers, one sample kept in `every`, sweeps at beta = 1, settings of the sampler
PRESETS = {
    "default": (500, 1, 10, {}),
    "reduced": (500, 4, 4, {}),
    "fast": (40, 16, 4, {"max_moves": 3}),
    "ramancha2022": (1000, 1, 1, RAMANCHA_2022_LITERAL),
    "ramancha2022-constant": (1000, 1, 1, RAMANCHA_2022_CONSTANT),
}

parser = argparse.ArgumentParser(description="Update the bridge column with SMC; tables and figures into a folder.")
parser.add_argument("--record", type=Path, help="base motion: .csv, .at2, .v2 or .zip (default: bundled, synthetic)")
parser.add_argument("--units", help="unit of the record's acceleration, where the file does not state it")
parser.add_argument("--scale", type=float, default=1.0, help="factor on the record")
parser.add_argument("--preset", choices=PRESETS, default="fast" if os.environ.get("FAST") else "default")
parser.add_argument("--walkers", type=int, help="number of particles (default: that of the preset)")
parser.add_argument("--every", type=int, help="keep one sample in EVERY (default: that of the preset)")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--classes", action="store_true", help="compare classes of models by evidence too")
parser.add_argument("--resume", action="store_true", help="go on with the killed run in OUT, begun with these options")
parser.add_argument("--out", type=Path, default=Path("results"))
args = parser.parse_args()

walkers, every, sweeps, settings = PRESETS[args.preset]
walkers, every = args.walkers or walkers, args.every or every
args.out.mkdir(parents=True, exist_ok=True)


# %% [markdown]
# ## The data and the posterior
#
# `problems.bridge_column` puts together what the paper describes: the model, normal priors truncated at zero on the
# five multiples of nominal values, half-normal priors on the noise levels, and the likelihood of its equation (3).


# %%
def read_record(path: Path) -> records.Record:
    """A record of any format the library reads."""
    if path.suffix.lower() == ".at2":
        return records.read_at2(path, units=args.units)
    if path.suffix.lower() in (".v2", ".v2c", ".zip"):
        return records.read_v2(path)
    return records.read_csv(path, units=args.units)


if args.record is None:
    data = problems.bridge_column_data()
    record, measurements = data.record.scale(args.scale), data.measurements
    if args.scale != 1.0:
        measurements = problems.bridge_column_measurements(record, seed=args.seed)
else:
    record = read_record(args.record).scale(args.scale)
    measurements = problems.bridge_column_measurements(record, seed=args.seed)
posterior = problems.bridge_column(record=record, measurements=measurements, every=every)
model, measured = posterior.likelihood.model, posterior.likelihood.measurements
truth = np.array([*problems.BRIDGE_COLUMN_MEANS.values(), *problems.BRIDGE_COLUMN_NOISE.values()])

print("the damping pair a0, a1 is not expected at its truth: the prior's mean is 6.3 prior sd from the true a1")
print(f"base motion: {record.name} x {args.scale:g}; measurements: {measurements.description}")
print(f"{measured.n_steps} samples at {measured.dt:g} s of {[c.name for c in measured.channels]}")
if every > 1:
    print(
        f"REDUCED SETTING ({args.preset}): one sample in {every} is kept and the model takes steps {every} times\n"
        "  longer, so the posterior is wider, and the parameters make up for the damping that long steps add."
    )


# %%
def plot_data(path: Path) -> None:
    """Fig. 3: input acceleration, output displacement and acceleration."""
    figure, axes = plt.subplots(3, 1, figsize=(9, 6.5), sharex=True, layout="constrained")
    rows = [
        (record.time, from_si(record.acceleration, "g"), "Input: acceleration of the base", "Acc. [g]"),
        *(
            (measured.time, from_si(measured.channel(name), unit), f"Output: {label} of the top", axis)
            for name, unit, label, axis in (
                ("displacement", "in", "relative displacement", "Disp. [in]"),
                ("acceleration", "g", "absolute acceleration", "Acc. [g]"),
            )
        ),
    ]
    for axis, (instants, values, title, label) in zip(axes, rows, strict=True):
        axis.plot(instants, values, color="#1f5a8c", linewidth=0.7)
        axis.axhline(0.0, color="0.7", linewidth=0.6, zorder=0)
        axis.set(title=title, ylabel=label, ylim=np.array([-1.1, 1.1]) * np.abs(values).max())
    axes[-1].set(xlabel="Time [s]", xlim=(0.0, record.duration))
    figure.suptitle("Measurement data for model updating (synthetic)")
    figure.savefig(path, dpi=150)
    plt.close(figure)


plot_data(args.out / "fig3_data.png")

# %% [markdown]
# ## Sampling
#
# SMC climbs from the prior (beta = 0) to the posterior (beta = 1); the chain holds the draws at beta = 1. Chain and
# ladder are kept in `chain.h5` while the run goes on, and every evaluation in the journal beside it: a run that was
# killed goes on with `--resume`, and ends as if it had not been.

# %%
backend = emcee.backends.HDFBackend(args.out / "chain.h5")
if not args.resume:
    backend.reset(walkers, posterior.ndim)
start = time.perf_counter()
sampler = SMCSampler(
    walkers, posterior.ndim, posterior, vectorize=True, backend=backend, seed=args.seed, **dict(settings)
)
sampler.run_mcmc(None, sweeps, progress=True)
seconds = time.perf_counter() - start
samples = sampler.get_chain(flat=True)
report = posterior.report()

# %% [markdown]
# ## Table 2: reported values and posterior

# %%
DISPLAY = {
    "Ec": "ksi",
    "Es": "ksi",
    "ft": "ksi",
    "a0": "1/s",
    "a1": "s",
    "sigma_acceleration": "in/s2",
    "sigma_displacement": "in",
}


def table2() -> list[dict[str, str]]:
    """One row a parameter: prior, reported value, posterior mean and coefficient of variation, truth of the data."""
    rows = []
    moments = summary(samples, posterior.parameter_names)
    for i, name in enumerate(posterior.parameter_names):
        unit, mean, true, cv = DISPLAY[name], moments.mean[i], truth[i], moments.cv[i]
        distance = (mean - true) / moments.sd[i]
        if name in PARAMETERS:
            nominal = model.nominal[name]
            reported = nominal if unit in ("1/s", "s") else from_si(nominal, unit).item()
            shown = f"{reported:.5g} {unit}"
            row = (
                f"normal(1, {posterior.prior.distributions[name].sd:.2f}), > 0",
                shown,
                f"{mean:.5g} x {shown}",
                f"{true:.5g}",
            )
        else:
            percent = f" ({100 * from_si(mean, 'g').item():.3g} % g)" if unit == "in/s2" else ""
            mean, true = (from_si(v, unit).item() for v in (mean, true))
            scale = from_si(posterior.prior.distributions[name].sd, unit).item()
            row = (f"half-normal({scale:.4g} {unit})", "-", f"{mean:.4g} {unit}{percent}", f"{true:.4g} {unit}")
        keys = ("Parameter", "Prior", "Reported value", "Posterior mean", "Truth (synthetic)")
        rows.append(
            dict(zip(keys, (name, *row), strict=True)) | {"CV": f"{cv:.2e}", "(mean-truth)/sd": f"{distance:+.2f}"}
        )
    return rows


rows = table2()
widths = {key: max(len(key), *(len(row[key]) for row in rows)) for key in rows[0]}
lines = ["  ".join(f"{key:<{width}}" for key, width in widths.items())]
lines += ["  ".join(f"{row[key]:<{width}}" for key, width in widths.items()) for row in rows]
(args.out / "table2.txt").write_text("\n".join(line.rstrip() for line in lines) + "\n")
with (args.out / "table2.csv").open("w", newline="") as file:
    writer = csv.DictWriter(file, rows[0])
    writer.writeheader()
    writer.writerows(rows)
print("\n".join(lines))

# %% [markdown]
# ## Figures 4 and 5, corner plot, ladder

# %%
LABELS = ["$E_c$ [x nominal]", "$E_s$ [x nominal]", "$a_0$ [x nominal]", "$a_1$ [x nominal]", "$f_t$ [x nominal]"]
LABELS += [r"$\sigma_a$ [g]", r"$\sigma_d$ [in]"]


def to_display(x: np.ndarray) -> np.ndarray:
    """Parameters (..., 7) with the noise levels in g and in."""
    return np.concatenate([x[..., :5], from_si(x[..., 5:6], "g"), from_si(x[..., 6:], "in")], axis=-1)


shown, true_shown = to_display(samples), to_display(truth)
figure = pair_plot(shown, LABELS, truth=true_shown)
figure.savefig(args.out / "fig4_pair.png", dpi=130)
plt.close(figure)
figure = corner.corner(
    shown, labels=LABELS, truths=true_shown, show_titles=True, title_fmt=".4g", quantiles=[0.05, 0.5, 0.95]
)
figure.savefig(args.out / "corner.png", dpi=110)
plt.close(figure)
figure = ladder_plot(sampler)
figure.savefig(args.out / "ladder.png", dpi=150)
plt.close(figure)
(args.out / "ladder.txt").write_text(ladder_table(sampler) + "\n")


# %%
def rrmse(predicted: np.ndarray, observed: np.ndarray) -> np.ndarray:
    """Relative root-mean-square error of each channel."""
    return np.sqrt(np.sum((predicted - observed) ** 2, axis=1) / np.sum(observed**2, axis=1))


n_structural = len(model.parameter_names)
predictions = {
    "Before updating (reported values)": model.simulate(np.ones(n_structural)),
    "After updating (posterior mean)": model.simulate(samples.mean(axis=0)[:n_structural]),
}
errors = {title: rrmse(response, measured.values) for title, response in predictions.items()}

figure, axes = plt.subplots(2, 2, figsize=(12, 6), sharex=True, sharey="row", layout="constrained")
for column, (title, response) in enumerate(predictions.items()):
    for i, channel in enumerate(measured.channels):
        axis = axes[i, column]
        axis.plot(measured.time, from_si(measured.values[i], channel.unit), color="0.55", linewidth=0.8, label="data")
        axis.plot(measured.time, from_si(response[i], channel.unit), color="#d9822b", linewidth=0.7, label="model")
        axis.set_title(f"{title}\n{channel.quantity}, RRMSE {100 * errors[title][i]:.1f} %", fontsize=10)
        if column == 0:
            axis.set_ylabel(f"{channel.quantity} [{channel.unit}]")
axes[0, 0].legend(loc="upper right", ncols=2)
for axis in axes[-1]:
    axis.set(xlabel="Time [s]", xlim=(0.0, record.duration))
figure.savefig(args.out / "fig5_response.png", dpi=150)
plt.close(figure)

# %% [markdown]
# ## Classes of models (`--classes`)
#
# The paper leaves open how the geometry is followed and how concrete softens in tension; both change the response by
# tens of per cent. Evidences weigh such choices: here the model that is updated against one with linear geometry and
# one whose concrete is nearly brittle in tension. Predictions are averaged with the probabilities of the classes.

# %%
classes = {}
if args.classes:
    from fe_likelihoods.prediction.averaging import average_predictions
    from fe_likelihoods.prediction.propagation import propagate
    from samplers.reporting.model_comparison import compare_models

    concrete = model.concrete
    variants = {
        "linear geometry": {"geometry": "linear"},
        "brittle in tension": {"concrete": replace(concrete, softening_strain=0.1 * concrete.softening_strain)},
    }
    runs, posteriors = {"as updated": sampler}, {"as updated": posterior}
    for name, change in variants.items():
        posteriors[name] = problems.bridge_column(record=record, measurements=measurements, every=every, **change)
        runs[name] = SMCSampler(
            walkers, posterior.ndim, posteriors[name], vectorize=True, seed=args.seed, **dict(settings)
        )
        runs[name].run_mcmc(None, 1, progress=True)
    comparison = compare_models(runs)
    print(comparison.table())
    (args.out / "classes.txt").write_text(comparison.table() + "\n")
    predictions_of = {
        name: propagate(posteriors[name], run.get_chain(flat=True)[-20:], quantiles=(), progress=False)
        for name, run in runs.items()
    }
    averaged = average_predictions(predictions_of, comparison.probabilities)
    for name, predicted in (*predictions_of.items(), ("averaged", averaged)):
        error = rrmse(predicted.mean, measured.values)
        print(
            f"{name}: RRMSE "
            + ", ".join(f"{c.name} {100 * e:.1f} %" for c, e in zip(measured.channels, error, strict=True))
        )
    classes = {name: [float(run.log_evidence), float(run.log_evidence_error)] for name, run in runs.items()}

# %% [markdown]
# ## What it cost, and the data for arviz

# %%
to_arviz(sampler).to_netcdf(str(args.out / "posterior.nc"))
result = {
    "record": f"{record.name} x {args.scale:g}",
    "data": measurements.description,
    "preset": args.preset,
    "walkers": walkers,
    "every": every,
    "seed": args.seed,
    "stages": len(sampler.ladder),
    "log_evidence": float(sampler.log_evidence),
    "log_evidence_error": float(sampler.log_evidence_error),
    "posterior_mean": dict(zip(posterior.parameter_names, samples.mean(axis=0).tolist(), strict=True)),
    "posterior_sd": dict(zip(posterior.parameter_names, samples.std(axis=0, ddof=1).tolist(), strict=True)),
    "truth": dict(zip(posterior.parameter_names, truth.tolist(), strict=True)),
    "rrmse": {k: dict(zip([c.name for c in measured.channels], v.tolist(), strict=True)) for k, v in errors.items()},
    "simulations": report["simulations"],
    "failures": report["failure_count"],
    "failure_reasons": report["failure_reasons"],
    "seconds": seconds,
    "log_evidence_of_classes": classes,
}
(args.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
for title, error in errors.items():
    print(
        f"{title}: RRMSE "
        + ", ".join(f"{c.name} {100 * e:.1f} %" for c, e in zip(measured.channels, error, strict=True))
    )
print(
    f"log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f}; {len(sampler.ladder)} stages, "
    f"{report['simulations']} simulations ({report['failure_count']} failed) in {seconds:.0f} s\n"
    f"tables and figures are in {args.out}/"
)
