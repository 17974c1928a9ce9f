"""
Which sensors and which motion to buy before a test
===================================================

A bridge column will be tested on a shake table. There is money for six sensors and for one motion, and the test shall
tell how far the column moves in a stronger design motion. Before anything is measured:

* `rank_sensors` ranks 29 possible sensors, by the information on five parameters and by the variance of the peak
  displacement that they leave;
* the same function ranks four motions for the same six sensors;
* then the test is simulated, and the six sensors and all 29 update the model: is the predicted share of the prior's
  standard deviation what an update leaves?

**The data are synthetic.** The prediction is a linearisation at draws of the prior: several modes and curved ridges are
left out. It counts on known noise levels, on a known number of independent samples, and on a model without errors other
than this noise. Another noise gives other ranks: the levels below are assumed. ::

    python tutorials/12_which_sensors.py            # a few minutes
    python tutorials/12_which_sensors.py --fast     # seconds, few draws and one test; its numbers are not results
"""

import argparse
import json
import os
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import lfilter

from fe_likelihoods import (
    FELikelihood,
    GaussianNoise,
    LogNormal,
    Measurements,
    Posterior,
    RCColumn,
    Record,
    identifiability,
    peak,
    plot_ranking,
    plot_sensors,
    problems,
    propagate,
    rank_sensors,
)
from samplers import SMCSampler

parser = argparse.ArgumentParser(description="Choose the sensors and the motion of a test before it.")
parser.add_argument("--fast", action="store_true", default=bool(os.environ.get("FAST")), help="few draws, one test")
parser.add_argument("--seed", type=int, default=1, help="seed of the draws and of the synthetic tests")
parser.add_argument("--out", type=Path, default=Path("results-which-sensors"), help="folder of the results")
args = parser.parse_args()
fast = args.fast or bool(os.environ.get("FAST"))
args.out.mkdir(parents=True, exist_ok=True)
DRAWS, TESTS, SECONDS = (5, 1, 6.0) if fast else (30, 5, 9.5)
WALKERS, MOST = (50, 150) if fast else (100, None)
if fast:
    print("REDUCED SETTING (fast): few draws, short motions and one test; these numbers are not results")

# %%
# Sensors and motions
# -------------------
#
# The candidates are the acceleration and the displacement of the top, the base moment of a load cell, the rotations
# over two gauge lengths, and strain gauges on bars at six heights and four positions. The levels of the noise are
# **assumed**. They are close to those of the published update of this column, which contain the error of its model.
# Such errors are correlated in time: the 64 samples of a second count as five.

DT, SUBSTEPS, INDEPENDENT = 1.0 / 64.0, 2, 5.0 * SECONDS
HEIGHTS = (0.15, 0.6, 1.2, 1.8, 3.0, 4.5)
NOISE = {"acceleration": 0.1, "displacement": 2e-3, "base_moment": 2e5, "rotation": 2e-4, "strain": 1e-4}  # [SI]
short, both = (problems.bridge_column_data(data).record for data in ("short", "eq1-eq2"))
short = short.trim(0.0, SECONDS)


def part(name: str, start: float) -> Record:
    """A part of the record of EQ1 and EQ2, at the step of the short motion."""
    return Record(name, DT, both.trim(start, start + SECONDS).resample(DT).acceleration)


motions = {"half of the short motion": short.scale(0.5), "short motion": short}
motions |= {"EQ1": part("EQ1", 4.0), "EQ2": part("EQ2", 64.0)}
bar = RCColumn.lhpost(short).bar_circle_radius
positions = [-bar, -0.5 * bar, 0.5 * bar, bar]
gauges = {(height, x): f"strain@{height:g}:{x:.3f}" for x in positions for height in HEIGHTS}
places = ("acceleration", "displacement", "base_moment", "rotation@0:0.6", "rotation@0:1.2", *gauges.values())
column = RCColumn.lhpost(motions["EQ2"], outputs=places, substeps=SUBSTEPS)
design = column.with_record(motions["EQ2"].scale(1.5))
target = peak("displacement")
prior = problems.bridge_column_prior(())

# %%
# Which sensors?
# --------------
#
# Start with EQ2. The sensors of the top and the gauges at the base on the outermost bars come first, where strains are
# largest: gauges have the same noise at all heights. Sensors repeat much of each other: alone each of the six has about
# 11 nat, but after three of them the next one adds less than 1 nat.

settings = {"noise": NOISE, "effective_samples": INDEPENDENT, "draws": DRAWS, "seed": args.seed}
for_parameters = rank_sensors(column, prior, **settings)
for_decision = rank_sensors(column, prior, target=target, target_model=design, **settings)
print(f"For the parameters\n{for_parameters}\n\nFor the peak displacement under the design motion\n{for_decision}")
figure = plot_ranking(for_decision)
figure.savefig(args.out / "ranks.png", dpi=150)

# %%
# A lead of less than two standard errors does not decide: such a sensor can be exchanged for the next best one if that
# is cheaper. The column with the six sensors, and the expected information of every gauge alone:

six = for_decision.chosen
figure, (left, right) = plt.subplots(
    1, 2, figsize=(11, 6.4), sharey=True, width_ratios=(1.4, 1.0), layout="constrained"
)
plot_sensors(column, left, six)
left.set_title("the six sensors, with their ranks")
for x in positions:
    alone = [for_decision.alone[for_decision.candidates.index(gauges[height, x])] for height in HEIGHTS]
    right.plot(alone, HEIGHTS, "o-" if abs(x) == bar else "s--", label=f"gauge at {x:+.2f} m")
right.set(xlabel="expected information of the gauge alone [nat]", title="gauges along the column")
right.legend()
figure.savefig(args.out / "column.png", dpi=150)

# %%
# Which motion?
# -------------
#
# A loop over the motions, with the same six sensors. In the full setting every motion determines ``Ec`` and ``a0``, but
# EQ1 and half of the short motion leave more than a fifth of the standard deviation of ``Es``, and EQ2 leaves 4 %: the
# bars carry more once the concrete has cracked. No motion tells much of ``a1``, and more sensors do not help there. The
# design motion is a stronger EQ2, which favours EQ2 where the peak displacement decides.

of_motion = {}
for name, motion in motions.items():
    of_motion[name] = rank_sensors(
        column.with_record(motion), prior, six, target=target, target_model=design, **settings
    )
    known = of_motion[name]
    shares = ", ".join(
        f"{each} {100.0 * x:.1f} %" for each, x in zip(known.parameter_names, known.left[-1], strict=True)
    )
    print(
        f"{name} ({np.abs(motion.acceleration).max():.1f} m/s²): {known.information[-1]:.1f} ± "
        f"{known.information_errors[-1]:.1f} nat; sd of the peak {100.0 * np.sqrt(known.target_left[-1]):.1f} % of "
        f"{1e3 * np.sqrt(known.target_variance):.0f} mm; left are {shares}"
    )
best = max(of_motion, key=lambda name: of_motion[name].information[-1])
print(f"the motion to buy: {best}")

# %%
# The test, with six sensors and with all
# ---------------------------------------
#
# Synthetic tests of columns with parameters drawn from the prior. The measured column has five times as many fibers
# and twice as many time steps as the model, and the errors are correlated in time. The update is a run with a guide, in
# which the levels of the noise are known to 20 % and integrated out.


def measure(theta: np.ndarray, seed: int) -> Measurements:
    """Measurements of all sensors under the best motion."""
    values = dict(zip(column.parameter_names, theta, strict=True))
    exact = problems.bridge_column_measurements(motions[best], theta=values, noise=False, outputs=places)
    correlation = (exact.n_steps - INDEPENDENT) / (exact.n_steps + INDEPENDENT)
    white = np.random.default_rng([args.seed, seed]).standard_normal(exact.values.shape)
    errors = np.sqrt(1.0 - correlation**2) * lfilter([1.0], [1.0, -correlation], white)
    levels = np.array([NOISE[name.partition("@")[0]] for name in places])
    return Measurements(exact.channels, DT, exact.values + levels[:, None] * errors, exact.description)


def update(measured: Measurements) -> tuple[np.ndarray, float, SMCSampler, np.ndarray]:
    """Shares of the prior's standard deviation that are left, sd of the target, the run, and its samples."""
    model = RCColumn.lhpost(motions[best], outputs=[c.name for c in measured.channels], substeps=SUBSTEPS)
    noise = GaussianNoise(model.channels, effective_samples=[INDEPENDENT] * len(model.channels))
    levels = {f"sigma_{c.name}": LogNormal(NOISE[c.name.partition("@")[0]], 0.2) for c in model.channels}
    posterior = Posterior(FELikelihood(model, measured, noise), prior.distributions | levels).marginal()
    sampler = SMCSampler(
        WALKERS,
        posterior.ndim,
        posterior,
        vectorize=True,
        seed=args.seed,
        guide=posterior.guide(starts=2),
        max_simulations=MOST,
    )
    sampler.run_mcmc(None, 1)
    samples = sampler.get_chain(flat=True)
    sd = propagate(design, samples, quantity=target, noise=False, progress=False).sd
    return identifiability(posterior, samples).left, float(np.squeeze(sd)), sampler, samples


truths = prior.from_normal(np.random.default_rng([args.seed, 0]).standard_normal((TESTS, prior.dim)))
obtained = {"six": [], "all": []}
of_target, misses, simulations = {"six": [], "all": []}, {"six": [], "all": []}, {"six": [], "all": []}
for k, theta in enumerate(truths):
    data = measure(theta, k + 1)
    for name, sensors in (("six", six), ("all", places)):
        left_of_sd, sd, sampler, samples = update(data.select(sensors))
        obtained[name].append(left_of_sd)
        of_target[name].append(sd)
        misses[name].append(np.abs(samples.mean(axis=0) - theta) / samples.std(axis=0))
        simulations[name].append(float(sampler.simulations))
        print(f"test {k + 1}, {name}: {sampler.simulations:.0f} simulations, {sampler.verdict.status}")

# %%
# Predicted and obtained
# ----------------------
#
# Root mean squares over the tests, as the prediction is a root mean square over draws. In the full setting the
# parameters keep 0.8 to 1.6 times the predicted standard deviations, with six sensors and with all; the worst is
# ``ft``. All 29 sensors leave 0.6 to 0.95 times as much as six do.
#
# Of the peak displacement, 1.5 % of the prior's standard deviation is left, and 2.8 % were predicted. A few columns of
# the prior dominate the prediction, and five tests may contain none of them: at the true parameters of the five tests
# the linearisation gives 1.8 %.
#
# Of the 50 estimates of parameters, one is 3.2 posterior standard deviations away from the truth, and 2.7 if the model
# itself is the measured column: most of this is noise, whose correlation the update knows as a number of samples only.

everything = rank_sensors(
    column.with_record(motions[best]), prior, target=target, target_model=design, n_sensors=len(places), **settings
)
labels = [*column.parameter_names, "peak displacement"]
prior_sd = np.sqrt(everything.target_variance)
shown = {}
for name, ranking in (("six", of_motion[best]), ("all", everything)):
    shown[f"{name}, predicted"] = np.append(ranking.left[-1], np.sqrt(ranking.target_left[-1]))
    values = np.column_stack([obtained[name], np.array(of_target[name]) / prior_sd])
    shown[f"{name}, obtained"] = np.sqrt(np.mean(values**2, axis=0))
print("\nstandard deviation left [%]: " + ", ".join(labels))
for name, values in shown.items():
    print(f"{name}: " + ", ".join(f"{100.0 * value:.1f}" for value in values))

figure, ax = plt.subplots(figsize=(8, 4.2), layout="constrained")
colours = ["#9dbbd6", "#1f5a8c", "#f2c38b", "#c46210"]
for k, ((name, values), colour) in enumerate(zip(shown.items(), colours, strict=True)):
    ax.bar(np.arange(len(labels)) + 0.2 * (k - 1.5), 100.0 * values, 0.2, color=colour, label=name)
ax.set_xticks(np.arange(len(labels)), labels)
ax.set_yscale("log")
ax.set_ylim(1.0, 200.0)
ax.set_yticks([1, 3, 10, 30, 100], ["1", "3", "10", "30", "100"])
ax.set_ylabel("standard deviation that is left [%]")
ax.legend(ncols=2)
figure.savefig(args.out / "predicted_and_obtained.png", dpi=150)

summary = {
    "six": six,
    "six_for_parameters": for_parameters.chosen,
    "information_alone": dict(zip(for_decision.candidates, for_decision.alone.tolist(), strict=True)),
    "target_left": for_decision.target_left.tolist(),
    "information_of_motions": {name: float(each.information[-1]) for name, each in of_motion.items()},
    "target_left_of_motions": {name: float(each.target_left[-1]) for name, each in of_motion.items()},
    "left_of_motions": {name: each.left[-1].tolist() for name, each in of_motion.items()},
    "best_motion": best,
    "sd_left": {name: values.tolist() for name, values in shown.items()},
    "labels": labels,
    "deviations": {name: np.array(each).tolist() for name, each in misses.items()},
    "simulations": simulations,
}
(args.out / "summary.json").write_text(json.dumps(summary, indent=1))
