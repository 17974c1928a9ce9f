"""
Four earthquakes on one column: prediction and damage
=====================================================

A bridge column is shaken by four earthquakes, one after the other, and is damaged more each time. The model is
calibrated with EQ1 and predicts EQ2 to EQ4 before they are measured, once for a virgin column and once for the column
that the earlier events have damaged. Then it is updated with EQ2 and predicts again. At the end, the posterior says
which limit states are reached after each event, where, and with which probability.

**All data are synthetic**: motions and responses were computed, with true parameters that the prior considers likely.
The tutorial therefore shows what a posterior can say where the model is right. With real data the error of the model
comes on top::

    python tutorials/10_damage.py            # a few minutes
    python tutorials/10_damage.py --fast     # seconds, coarse steps and few samples; its numbers are not results
"""

import argparse
import json
import os
import time
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import (
    Events,
    FELikelihood,
    HalfNormal,
    Measurements,
    Posterior,
    RCColumn,
    TruncatedNormal,
    damage,
    damage_measures,
    damage_outputs,
    from_si,
    interval_score,
    park_ang_constants,
    plot_damage,
    problems,
    propagate,
)
from samplers import SMCSampler

parser = argparse.ArgumentParser(description="Predict four earthquakes on one column, and its damage.")
parser.add_argument(
    "--fast", action="store_true", default=bool(os.environ.get("FAST")), help="coarse steps, few samples"
)
parser.add_argument("--seed", type=int, default=1, help="seed of the noise and of the samplers")
parser.add_argument("--out", type=Path, default=Path("results-damage"), help="folder of the results")
args = parser.parse_args()
fast = args.fast or bool(os.environ.get("FAST"))
args.out.mkdir(parents=True, exist_ok=True)
DT, LENGTH, PAUSE, WALKERS, PREDICTED = (1 / 16, 7.0, 2.0, 24, 20) if fast else (1 / 64, 16.0, 6.0, 200, 100)  # s, s, s
begin = time.perf_counter()
if fast:
    print("REDUCED SETTING (fast): coarse steps and few samples; these numbers are not results")

# %%
# The events and the data
# -----------------------
#
# EQ1 cracks the column, and its bars stay elastic. EQ2 yields them. EQ3 and EQ4 are the motion of EQ2 again, 1.3 and
# 1.6 times as strong, EQ3 in the other direction. Six multiples of nominal values are unknown, among them the yield
# strength of the bars, about which EQ1 says nothing.

bundled = problems.bridge_column_data("eq1-eq2").record.records
first, second = (
    record.trim(start, start + LENGTH).resample(DT) for record, start in zip(bundled, (5.0, 4.0), strict=True)
)
events = Events([first, second, second.scale(-1.3), second.scale(1.6)], PAUSE, ["EQ1", "EQ2", "EQ3", "EQ4"])

LIKELY = {"Ec": 0.8, "Es": 1.05, "a0": 0.7, "a1": 1.3, "ft": 1.25, "fy": 1.06}  # the truth, as multiples
PARAMETERS = ("Ec", "ft", "fy") if fast else tuple(LIKELY)  # the others have their nominal values
TRUTH = np.array([LIKELY[name] for name in PARAMETERS])
column = RCColumn.lhpost(events, parameters=PARAMETERS)
NOISE = np.array([problems.BRIDGE_COLUMN_NOISE[channel.name] for channel in column.channels])
prior = dict(problems.bridge_column_prior().distributions) | {"fy": TruncatedNormal(1.0, 0.08)}

rng = np.random.default_rng(args.seed)
response = events.split(column.simulate(TRUTH))
measured = {
    name: Measurements(column.channels, DT, values + NOISE[:, None] * rng.standard_normal(values.shape))
    for name, values in response.items()
}

figure, rows = plt.subplots(2, 1, figsize=(10, 4.6), sharex=True, layout="constrained")
rows[0].plot(events.time, from_si(events.acceleration, "g"), color="#1f5a8c", linewidth=0.6)
rows[0].set_ylabel("base acceleration [g]")
rows[0].margins(y=0.15)  # room for the names of the events
for window, name in zip(events.windows, events.names, strict=True):
    instants = window.start + measured[name].time
    rows[1].plot(instants, from_si(measured[name].channel("displacement"), "in"), color="#d9822b", linewidth=0.6)
    rows[0].annotate(
        name,
        (window.start, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(0, -4),
        textcoords="offset points",
        va="top",
    )
rows[1].set(xlabel="time [s]", ylabel="measured displacement [in]")
figure.suptitle("Four events on one column (synthetic)")
figure.savefig(args.out / "events.png", dpi=110)

# %%
# Calibration with EQ1, update with EQ2
# -------------------------------------
#
# A likelihood of a model under ``Events`` takes the measurements of the events by name. The column under EQ1, a pause
# and EQ2 carries its cracks from one to the other.


def calibrate(names: list[str]) -> tuple[Posterior, np.ndarray]:
    """The posterior of the events with these names, which come first, and samples of it."""
    records = Events(events.records[: len(names)], PAUSE, names)
    likelihood = FELikelihood(replace(column, loading=records), {name: measured[name] for name in names})
    posterior = Posterior(likelihood, {name: prior[name] for name in PARAMETERS} | SIGMAS)
    sampler = SMCSampler(
        WALKERS, posterior.ndim, posterior, vectorize=True, seed=args.seed, guide=posterior.guide(1 if fast else 8)
    )
    sampler.run_mcmc(None, 2, progress=False)
    print(f"posterior of {' and '.join(names)}: {sampler.simulations:.0f} simulations, {sampler.verdict.status}")
    return posterior, sampler.get_chain(flat=True)


SIGMAS = {f"sigma_{name}": HalfNormal(scale) for name, scale in (("acceleration", 1.0), ("displacement", 0.03))}
posteriors = {"EQ1": calibrate(["EQ1"]), "EQ1 and EQ2": calibrate(["EQ1", "EQ2"])}
sd_of_prior = np.array([prior[name].rvs(20_000, random_state=1).std() for name in PARAMETERS])
lines = [f"{'':<6}{'truth':>8}" + "".join(f"{'mean, sd from ' + name:>30}{'sd/prior':>10}" for name in posteriors)]
for k, name in enumerate(PARAMETERS):
    cells = [
        f"{x[:, k].mean():>20.4f} {x[:, k].std():>9.4f}{x[:, k].std() / sd_of_prior[k]:>10.2f}"
        for _, x in posteriors.values()
    ]
    lines.append(f"{name:<6}{TRUTH[k]:>8.2f}" + "".join(cells))
table = "\n".join(lines)
print(table)

# %%
# Predictions before the events are measured
# ------------------------------------------
#
# ``from_state="end"`` starts a new record from the state after the events of the calibration, ``"virgin"`` from an
# uncracked column. With ``noise=True`` the predictions can be compared with measurements: a band from 5 to 95 %
# should hold 90 % of the samples. The interval score, the width of the band plus a penalty for every sample outside,
# is given in multiples of the root mean square of the channel: a wide band that holds all samples has a large one.


def predict(name: str, state: str) -> dict[str, tuple]:
    """Coverage, error and interval score of every event after those of a calibration, and the prediction itself."""
    posterior, samples = posteriors[name]
    done = len(posterior.likelihood.model.loading.names)
    chosen = samples[:: max(1, len(samples) // PREDICTED)]
    options = {"noise": True, "seed": 1, "progress": False}
    found = {}
    if state == "end":  # all later events together, each in the state that the one before leaves
        later = Events(events.records[done:], PAUSE, events.names[done:])
        joined = later.join({each: measured[each] for each in later.names})
        prediction = propagate(posterior, chosen, record=later, from_state="end", rest=PAUSE, **options)
        for window in later.windows:
            where = {"part": window.samples}
            found[window.name] = (prediction.score(joined, **where), prediction)
    else:
        for each, record in zip(events.names[done:], events.records[done:], strict=True):
            prediction = propagate(posterior, chosen, record=record, from_state="virgin", **options)
            found[each] = (prediction.score(measured[each]), prediction)
    return found


predictions = {(name, state): predict(name, state) for name in posteriors for state in ("virgin", "end")}
rows = [
    f"{'calibrated with':<16}{'state':<8}{'event':<7}{'coverage of 90 % (acc., disp.)':>32}{'RRMSE (acc., disp.)':>24}"
    f"{'interval score / RMS':>24}"
]
for (name, state), found in predictions.items():
    for event, (marks, _) in found.items():
        cells = [f"{100 * a:.0f} %, {100 * d:.0f} %" for a, d in (marks.coverage, marks.rrmse)]
        relative = ", ".join(f"{each:.2f}" for each in marks.interval_score / marks.rms)
        rows.append(f"{name:<16}{state:<8}{event:<7}{cells[0]:>32}{cells[1]:>24}{relative:>24}")
comparison = "\n".join(rows)
print(comparison)

# %%
# The measured EQ4 beside its predictions: the virgin column is too stiff, because EQ1 to EQ3 have not happened to it.

figure, panels = plt.subplots(3, 1, figsize=(10, 7), sharex=True, layout="constrained")
shown = {
    "calibrated with EQ1, virgin column": ("EQ1", "virgin"),
    "calibrated with EQ1, column after EQ1 to EQ3": ("EQ1", "end"),
    "updated with EQ2, column after EQ1 to EQ3": ("EQ1 and EQ2", "end"),
}
instants = measured["EQ4"].time
for axes, (title, key) in zip(panels, shown.items(), strict=True):
    marks, prediction = predictions[key]["EQ4"]
    last = slice(-len(instants), None)
    row = [channel.name for channel in prediction.channels].index("displacement")
    low, high = (from_si(prediction.quantile(p)[row, last], "in") for p in (0.05, 0.95))
    axes.fill_between(instants, low, high, color="#1f5a8c", alpha=0.35, linewidth=0, label="90 % band")
    values = from_si(measured["EQ4"].channel("displacement"), "in")
    axes.plot(instants, values, color="#d9822b", linewidth=0.9, label="measured")
    relative = marks.interval_score[1] / marks.rms[1]
    axes.set_title(f"{title}: {100 * marks.coverage[1]:.0f} % inside, interval score {relative:.2f} RMS", fontsize=10)
    axes.set_ylabel("displacement [in]")
panels[0].legend(loc="upper right", ncols=2)
panels[-1].set_xlabel("time in EQ4 [s]")
figure.savefig(args.out / "prediction.png", dpi=110)

# %%
# Damage
# ------
#
# The same samples, the same four events, and the strains of the bars and of the cover as outputs. No strain was
# measured. The data are synthetic, so the model has no error, which ``noise=False`` states. With real data, give the
# error of each measure, such as ``ratios={"bar tension": EventRatios([1.0], prior_sd=0.3, prior_events=10)}``.

instrumented = replace(column, outputs=damage_outputs(column))
measures = damage_measures(instrumented, park_ang=park_ang_constants(column), settle=min(4.0, PAUSE))
damages = {}
for name, (_, samples) in posteriors.items():
    thetas = samples[:: max(1, len(samples) // PREDICTED), : len(PARAMETERS)]
    damages[name] = damage(propagate(instrumented, thetas, quantity=measures, progress=False), noise=False)
true_damage = damage(propagate(instrumented, TRUTH[None], quantity=measures, progress=False), noise=False)
for name, found in damages.items():
    print(f"\nposterior of {name}\n{found.table()}")
drawn = ["EQ2", "EQ4"] if fast else None  # None: all
plot_damage(damages["EQ1"], drawn).savefig(args.out / "damage_predicted.png", dpi=90)
if not fast:
    plot_damage(damages["EQ1 and EQ2"]).savefig(args.out / "damage_updated.png", dpi=90)

# %%
# The output says how often the 90 % bands of the measures hold the truth, and gives their median widths and interval
# scores as multiples of the true values. A band that misses has a score much larger than its width. The last two
# numbers are the mean probabilities of states that were reached, and of states that were not:

scores = {}
for name, found in damages.items():
    low, high, true = (
        np.concatenate([each[k].ravel() for each in values.extent.values()])
        for values, k in ((found, 0), (found, -1), (true_damage, 0))
    )
    inside, known = (low <= true) & (true <= high), true != 0.0  # a damping change is zero in EQ1
    relative = np.stack([high - low, interval_score(low, high, true, 0.9)])[:, known] / np.abs(true[known])
    reached = np.concatenate([each.probability.ravel() for each in true_damage.presence.values()]) == 1.0
    given = np.concatenate([each.probability.ravel() for each in found.presence.values()])
    scores[name] = {
        "bands": float(inside.mean()),
        "width": float(np.median(relative[0])),
        "interval_score": float(np.median(relative[1])),
        "reached": float(given[reached].mean()),
        "not reached": float(given[~reached].mean()),
    }
    print(
        f"{name}: {100 * scores[name]['bands']:.0f} % of {len(true)} bands hold the truth, median width "
        f"{scores[name]['width']:.3f} and interval score {scores[name]['interval_score']:.3f} times the true value; "
        f"mean probability of states that are reached {scores[name]['reached']:.2f}, of others "
        f"{scores[name]['not reached']:.2f}"
    )

seconds = time.perf_counter() - begin
(args.out / "tables.txt").write_text("\n\n".join([table, comparison, *(d.table() for d in damages.values())]) + "\n")
result = {
    "truth": dict(zip(PARAMETERS, TRUTH.tolist(), strict=True)),
    "mean": {name: x[:, : len(PARAMETERS)].mean(axis=0).tolist() for name, (_, x) in posteriors.items()},
    "sd": {name: x[:, : len(PARAMETERS)].std(axis=0).tolist() for name, (_, x) in posteriors.items()},
    "coverage": {
        f"{name}, {state}, {event}": values[0].coverage.tolist()
        for (name, state), found in predictions.items()
        for event, values in found.items()
    },
    **{
        what: {
            f"{name}, {state}, {event}": (getattr(values[0], what) / values[0].rms).tolist()
            for (name, state), found in predictions.items()
            for event, values in found.items()
        }
        for what in ("interval_score", "crps", "width")
    },
    "rrmse": {
        f"{name}, {state}, {event}": values[0].rrmse.tolist()
        for (name, state), found in predictions.items()
        for event, values in found.items()
    },
    "presence": {
        name: {state: each.probability.tolist() for state, each in found.presence.items()}
        for name, found in (damages | {"truth": true_damage}).items()
    },
    "scores": scores,
    "seconds": seconds,
}
(args.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
print(f"{seconds:.0f} s; tables and figures are in {args.out}/")
