"""
Updating a seismically isolated bridge with TMCMC, and predicting with the remaining uncertainty
================================================================================================

The second system is a rigid deck on two flexible piers on a shake table. Between deck and piers are sliding bearings
with velocity-dependent friction, rubber devices and fluid dampers. Ten multiples of nominal values of friction and
dampers and one noise level are sampled by TMCMC (Ching & Chen, 2007, doi:10.1061/(ASCE)0733-9399(2007)133:7(816)) with
1000 samples per stage. The script follows a published study of the shake-table tests of Tsopelas et al. (1994, report
NCEER-94-0002) and draws its Figures 2, 3 and 5 to 7. It also propagates the uncertainty to motions that were not used,
and compares two model classes by their evidence.

**The data are synthetic and the nominal values are assumed**: neither the measurements nor most of the values of the
tested bridge are public. The data are responses of the model at parameters that differ from the nominal ones, under a
stochastic table motion, plus white noise of 5 % of the root mean square of each channel::

    python tutorials/03_isolated_bridge.py                       # TMCMC, 1000 samples per stage
    python tutorials/03_isolated_bridge.py --sampler smc         # the same posterior by SMC
    python tutorials/03_isolated_bridge.py --sampler guide --walkers 100      # by SMC with a guide: few simulations
    python tutorials/03_isolated_bridge.py --preset published    # TMCMC as published, and its warnings
    python tutorials/03_isolated_bridge.py --data means          # data that do not distinguish the piers: two modes

With ``FAST=1`` the script uses 50 walkers and steps of 2.5 ms. It then shows how the tutorial works; its numbers are
not results.
"""

import argparse
import json
import os
import time
import warnings
from pathlib import Path

import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import (
    exceedance,
    fragility,
    peak,
    plot_bands,
    plot_fragility,
    problems,
    propagate,
)
from fe_likelihoods.models.isolated_bridge_parts import Bearing
from fe_likelihoods.plots.structures import plot_bridge
from fe_likelihoods.problems import table_motion
from samplers import (
    SamplingWarning,
    SMCSampler,
    TMCMCSampler,
    compare_models,
    ladder_table,
    plot_corner,
    plot_marginals,
    plot_run,
    presets,
    summary,
    to_arviz,
)

# walkers, sweeps at beta = 1, time step [s], number of propagated samples, settings of the sampler
PRESETS = {
    "default": (1000, 2, 0.5e-3, 1000, {}),
    "published": (1000, 1, 0.5e-3, 1000, presets.CHING_CHEN_2007),
    "fast": (50, 2, 2.5e-3, 30, {}),
}

parser = argparse.ArgumentParser(
    description="Update the isolated bridge with TMCMC; write tables and figures to a folder."
)
parser.add_argument("--preset", choices=PRESETS, default="fast" if os.environ.get("FAST") else "default")
parser.add_argument("--sampler", choices=("tmcmc", "smc", "guide"), default="tmcmc")
parser.add_argument(
    "--data", choices=("twin", "means"), default="twin", help="posterior with one mode (twin) or two (means)"
)
parser.add_argument("--channels", type=int, choices=(5, 6, 10), help="measured channels of the twin (default: 6)")
parser.add_argument("--noise", choices=("all", "channel"), default="all")
parser.add_argument("--walkers", type=int, help="samples per stage (default: from the preset)")
parser.add_argument("--step", type=float, help="time step of the model [s] (default: from the preset)")
parser.add_argument("--seed", type=int, default=1, help="seed of sampler, propagation and motions")
parser.add_argument("--resume", action="store_true", help="continue an interrupted run in OUT, with the same options")
parser.add_argument("--out", type=Path, default=Path("results-isolated-bridge"), help="folder of the results")
args = parser.parse_args()
walkers, sweeps, step, propagated, settings = PRESETS[args.preset]
walkers, step = args.walkers or walkers, args.step or step
args.out.mkdir(parents=True, exist_ok=True)
begin = time.perf_counter()


# %%
# The data and the posterior
# --------------------------
#
# With a time step of 0.5 ms displacements are accurate to 3e-5 of their peaks, forces to 0.1 % and accelerations to
# 0.3 %, far below the noise. As in the study, one sigma is shared by all channels; it is relative to the measured root
# mean square of each channel.

problem = dict(data=args.data, channels=args.channels, noise=args.noise, step=step)
posterior = problems.isolated_bridge(**problem)
model, measured = posterior.likelihood.model, posterior.likelihood.measurements
names, n_structural = posterior.parameter_names, len(model.parameter_names)
truth = np.array([problems.ISOLATED_BRIDGE_TRUTH[args.data][name] for name in model.parameter_names])
print(measured.description)
print(f"{measured.n_steps} samples at {measured.dt:g} s of {', '.join(c.name for c in measured.channels)}")
figure = plot_bridge(model).figure  # Figures 2 and 3 of the study: the bridge and its instrumentation
figure.savefig(args.out / "fig2_scheme_and_channels.png", dpi=150)
if args.preset == "fast":
    print("REDUCED SETTING (fast): few samples and long time steps; these numbers are not results")


# %%
# Sampling
# --------
#
# Read the warnings of the sampler: they say when the draws are not reliable. The verdict says what the result is worth.
# With ``--sampler guide --walkers 100`` the run needs hundreds of simulations instead of more than ten thousand: the
# guide finds the posterior from the responses, and its draws are simulated and weighted.

backend = emcee.backends.HDFBackend(args.out / "chain.h5")
if not args.resume:
    backend.reset(walkers, posterior.ndim)
Sampler = TMCMCSampler if args.sampler == "tmcmc" else SMCSampler
guide = posterior.guide() if args.sampler == "guide" else None
if args.preset == "fast":
    settings = {"burn_in": 1} if Sampler is TMCMCSampler else {"max_moves": 3}
start = time.perf_counter()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", SamplingWarning)
    sampler = Sampler(
        walkers,
        posterior.ndim,
        posterior,
        vectorize=True,
        backend=backend,
        seed=args.seed,
        guide=guide,
        **dict(settings),
    )
    sampler.run_mcmc(None, sweeps - sampler.iteration, progress=True)
messages = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
seconds = time.perf_counter() - start
report = posterior.report()
samples = sampler.get_chain(flat=True)
for message in messages:
    print(f"WARNING: {message}")
print(sampler.verdict)

moments = summary(samples, names)
lines = [f"{'parameter':<10} {'truth':>7} {'mean':>8} {'sd':>8} {'cv':>7} {'(mean-truth)/sd':>16}"]
for i, name in enumerate(names):
    # the true noise level is relative to the clean response, sigma to the measured one: they differ by 0.2 %
    true = truth[i] if i < n_structural else problems.ISOLATED_BRIDGE_NOISE[args.data]
    known = i < n_structural or name == "sigma"
    z = f"{(moments.mean[i] - true) / moments.sd[i]:+.2f}" if known else "-"
    shown = f"{true:.3f}" if known else "-"
    lines.append(f"{name:<10} {shown:>7} {moments.mean[i]:8.4f} {moments.sd[i]:8.4f} {moments.cv[i]:7.3f} {z:>16}")
(args.out / "parameters.txt").write_text("\n".join(lines) + "\n")
print("\n".join(lines))
(args.out / "ladder.txt").write_text(ladder_table(sampler) + "\n")
plot_run(sampler).savefig(args.out / "run.png", dpi=150)


# %%
# Figure 5: parameters, and fit of every sample
# ---------------------------------------------
#
# J is the sum of squared residuals of a channel divided by the sum of squares of the measured channel. Sigma, the level
# of the noise, is drawn as a multiple of its true value; with ``--noise channel`` every channel has one, in its own
# unit, and they are in the table only.

BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"
rng = np.random.default_rng(args.seed)
power = np.nansum(np.square(measured.values), axis=1)
fit, nominal_fit = (
    posterior.likelihood.misfit(each) / power for each in (samples[:, :n_structural], np.ones((1, n_structural)))
)
nominal_fit = nominal_fit[0]

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
few = samples[rng.choice(len(samples), min(500, len(samples)), replace=False)]
shown = n_structural + ("sigma" in names)
nominal = np.ones(shown)
nominal[n_structural:] = problems.ISOLATED_BRIDGE_NOISE[args.data]
for i in range(shown):
    left.plot(i + rng.uniform(-0.16, 0.16, len(few)), few[:, i] / nominal[i], ".", color=BLUE, alpha=0.15, markersize=3)
left.errorbar(
    range(shown),
    moments.mean[:shown] / nominal,
    moments.sd[:shown] / nominal,
    fmt="_",
    color="k",
    capsize=5,
    markersize=12,
    label="mean and standard deviation",
)
left.plot(range(n_structural), truth, "x", color=ORANGE, markersize=8, label="truth (synthetic)")
left.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--", label="nominal (assumed)")
left.set_xticks(range(shown), names[:shown], rotation=30)
left.set(ylabel="multiple of the nominal value [-]", title="Calibrated model parameters")
left.legend(frameon=False, fontsize="small")
for j in range(fit.shape[1]):
    x = j + rng.uniform(-0.16, 0.16, len(few))
    right.plot(x, fit[rng.choice(len(fit), len(few)), j], ".", color=BLUE, alpha=0.15, markersize=3)
    mean, sd = fit[:, j].mean(), fit[:, j].std()
    low, high = np.quantile(fit[:, j], [0.05, 0.95])
    right.hlines(
        [low, high], j - 0.3, j + 0.3, color="k", linewidth=1.0, label="5 % and 95 % quantiles" if j == 0 else None
    )
    right.hlines(mean, j - 0.3, j + 0.3, color=ORANGE, linewidth=1.6, label="mean" if j == 0 else None)
    right.hlines(
        [mean - sd, mean + sd], j - 0.2, j + 0.2, color=ORANGE, linestyle=":", label="mean ± sd" if j == 0 else None
    )
    right.plot(j, nominal_fit[j], "v", color=GREY, label="nominal parameters" if j == 0 else None)
right.set_yscale("log")
right.set_xticks(range(fit.shape[1]), [f"$J_{j + 1}$\n{c.name}" for j, c in enumerate(measured.channels)])
right.set(ylabel="misfit J [-]", title="Misfit of the measured time histories")
right.legend(*(part[:4] for part in right.get_legend_handles_labels()), frameon=False, fontsize="small")
figure.suptitle("Figure 5 (synthetic data, assumed nominal values)", fontsize="small")
figure.savefig(args.out / "fig5_parameters_and_fit.png", dpi=150)


# %%
# Figure 6: marginal densities
# ----------------------------
#
# The dotted lines are the prior: where they are close to the posterior, the data say little about a parameter. The red
# lines mark the parameters with which the synthetic data were made.

truths = dict(zip(model.parameter_names, truth, strict=True))
note = "synthetic data, assumed nominal values"
figure = plot_marginals(samples, posterior, truths=truths, title=f"Figure 6: prior and posterior ({note})")
figure.savefig(args.out / "fig6_marginals.png", dpi=150)
plot_corner(samples, posterior, truths=truths).savefig(args.out / "corner.png", dpi=80)


# %%
# Figure 7: predicted histories with their uncertainty
# ----------------------------------------------------
#
# The prediction is the mean, the variance and the quantiles of every channel at every time over the posterior samples.
# The band of the response alone is narrow. The band that includes the noise should contain about 90 % of the measured
# samples. CRPS and interval score (the width of the band plus a penalty for every sample outside of it) show that it is
# not too wide for that: smaller is better. The equations are in ``docs/theory/prediction.rst``.

draws = samples[rng.choice(len(samples), min(propagated, len(samples)), replace=False)]
prediction = propagate(posterior, draws, noise=True, seed=args.seed)
response = propagate(posterior, draws, progress=False, seed=args.seed)
four = ("Ub_1", "shear_1", "acc_p1", "drift_1")
four = four if args.data == "twin" else ("mean_Ub", "mean_shear", "mean_acc_p", "mean_drift")
figure = plot_bands(response, measured, four)
figure.suptitle("Figure 7: predicted response and synthetic data (assumed nominal values)", fontsize="small")
figure.savefig(args.out / "fig7_predictions.png", dpi=150)
errors, scores = response.score(measured).rrmse, prediction.score(measured)
covered = scores.coverage
print(scores)


# %%
# Future motions: peak displacement, exceedance, fragility
# --------------------------------------------------------
#
# The posterior also predicts the response to motions that were not measured: six other draws of the stochastic model of
# the table motion, each at several intensities. The devices are designed for bearing displacements of 50 mm. The
# uncertainty of the parameters contributes little here; the differences between motions contribute more. The fragility
# curve includes both. The error of the model is left out, which ``noise=False`` states: with real measurements of
# several motions, give ``ratios=EventRatios(...)`` of measured to fitted peaks.

bearing = "Ub_1" if args.data == "twin" else "mean_Ub"
strengths, n_motions, few_draws = ((0.6, 0.9, 1.2, 1.5, 1.8), 6, 50) if args.preset != "fast" else ((0.8, 1.4), 2, 10)
motions = [table_motion(seed) for seed in range(101, 101 + n_motions)]
new = {"from_state": "virgin", "progress": False}  # the bridge before any motion, not after the recorded one
future = propagate(posterior, draws[: 4 * few_draws], quantity=peak(bearing), record=motions[0], **new)
low, high = 1e3 * future.quantile(0.05), 1e3 * future.quantile(0.95)
beyond = exceedance(future, 1.01 * future.mean, noise=False)
print(
    f"peak of {bearing} under another motion: mean {1e3 * future.mean:.2f} mm, 90 % interval {low:.2f}-{high:.2f} mm;\n"
    f"probability of more than 1.01 times the mean: {beyond.probability:.3f} ({beyond.lower:.3f} to {beyond.upper:.3f})"
)
curve = fragility(
    posterior,
    draws[:few_draws],
    [motion.scale(strength) for motion in motions for strength in strengths],
    peak(bearing),
    50.0,
    unit="mm",
    noise=False,
    **new,
)
figure = plot_fragility(curve)
figure.suptitle(f"P(peak of {bearing} > 50 mm | data, motion)", fontsize="small")
figure.savefig(args.out / "fragility.png", dpi=150)


# %%
# Does friction depend on velocity? Two model classes
# ---------------------------------------------------
#
# The model class without velocity dependence has four parameters fewer. The evidence shows whether its simplicity
# outweighs its poorer fit.

constant = problems.isolated_bridge(
    **problem,
    bearings=(Bearing(f_min=0.09, df=0.0, a=0.0), Bearing(f_min=0.09, df=0.0, a=0.0)),
    parameters=("fmin_1", "fmin_2", "Kd_1", "C0_1", "Kd_2", "C0_2"),
)
cheap = {"max_moves": 3} if args.preset == "fast" else {}
rival = SMCSampler(500 if walkers >= 500 else 24, constant.ndim, constant, vectorize=True, seed=args.seed, **cheap)
rival.run_mcmc(None, 1, progress=True)
comparison = compare_models({"friction depends on velocity": sampler, "constant friction": rival})
print(comparison.table())


# %%
# Cost
# ----

to_arviz(sampler).to_netcdf(str(args.out / "posterior.nc"))
result = {
    "data": measured.description,
    "sampler": args.sampler,
    "preset": args.preset,
    "walkers": walkers,
    "step": step,
    "seed": args.seed,
    "stages": len(sampler.ladder),
    "log_evidence": float(sampler.log_evidence),
    "log_evidence_error": float(sampler.log_evidence_error),
    "log_evidence_constant_friction": float(rival.log_evidence),
    "posterior_mean": dict(zip(names, moments.mean.tolist(), strict=True)),
    "posterior_sd": dict(zip(names, moments.sd.tolist(), strict=True)),
    "truth": dict(zip(model.parameter_names, truth.tolist(), strict=True)),
    "rrmse": dict(zip([c.name for c in measured.channels], errors.tolist(), strict=True)),
    "coverage": dict(zip([c.name for c in measured.channels], covered.tolist(), strict=True)),
    "fragility": {"intensity": curve.intensity.tolist(), "probability": curve.probability.tolist()},
    "verdict": sampler.verdict.status,
    "warnings": messages,
    "simulations": sampler.simulations,
    "failures": report["failure_count"],
    "seconds_sampling": seconds,
    "milliseconds_per_simulation": 1e3 * report["seconds"] / max(1, report["simulations"]),
    "seconds": time.perf_counter() - begin,
}
(args.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
print(
    f"log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f}; {len(sampler.ladder)} stages, "
    f"{sampler.simulations:.0f} simulations ({report['failure_count']} failed) in {seconds:.0f} s, "
    f"{result['seconds']:.0f} s in total\ntables and figures are in {args.out}/"
)
