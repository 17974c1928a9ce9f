# %% [markdown]
# # Updating a seismically isolated bridge with TMCMC, and predicting with what is left uncertain
#
# The second system: a rigid deck on two flexible piers, across sliding bearings with friction that depends on
# velocity, rubber devices and fluid dampers, on a shake table. Ten multiples of the nominal values of friction and
# dampers and one noise level are sampled by TMCMC with 1000 samples a stage; the figures of the paper (5 to 7) are left
# in a folder, the uncertainty is propagated to motions that were not used, and two classes of models are compared by
# their evidence.
#
# **Synthetic data, nominal values assumed**: neither the measurements nor most of the values of the tested bridge are
# public. The data are responses of the model at other parameters than the nominal ones, plus white noise of 5 % of each
# channel's root mean square, under a stochastic table motion of our own.
#
#     python tutorials/03_isolated_bridge.py                       # TMCMC, 1000 samples a stage
#     python tutorials/03_isolated_bridge.py --sampler smc         # the same posterior by SMC
#     python tutorials/03_isolated_bridge.py --preset published    # TMCMC as published, and its alarms
#     python tutorials/03_isolated_bridge.py --data means          # data that do not tell the piers apart: two modes

# %%
import argparse
import json
import os
import time
import warnings
from pathlib import Path

import corner
import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from fe_likelihoods.data.make_isolated_bridge import table_motion
from scipy.stats import gaussian_kde

from fe_likelihoods import problems
from fe_likelihoods.models.isolated_bridge import Bearing
from fe_likelihoods.plots.predictions import plot_bands, plot_fragility
from fe_likelihoods.prediction.fragility import fragility
from fe_likelihoods.prediction.propagation import fit_measures, propagate
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.prediction.reliability import exceedance
from samplers import CHING_CHEN_2007, SMCSampler, TMCMCSampler
from samplers.reporting.figures import ladder_plot
from samplers.reporting.model_comparison import compare_models
from samplers.reporting.summary import ladder_table, summary, to_arviz
from samplers.tempering.diagnostics import SamplingWarning

# walkers, sweeps at beta = 1, step of integration [s], samples that are propagated, settings of the sampler
PRESETS = {
    "default": (1000, 2, 0.5e-3, 1000, {}),
    "published": (1000, 1, 0.5e-3, 1000, CHING_CHEN_2007),
    "fast": (50, 4, 1.0e-3, 50, {"max_moves": 3}),
}

parser = argparse.ArgumentParser(description="Update the isolated bridge with TMCMC; tables and figures in a folder.")
parser.add_argument("--preset", choices=PRESETS, default="fast" if os.environ.get("FAST") else "default")
parser.add_argument("--sampler", choices=("tmcmc", "smc"), default="tmcmc")
parser.add_argument("--data", choices=("twin", "means"), default="twin", help="one mode, or two")
parser.add_argument("--channels", type=int, choices=(5, 6, 10), help="measured channels of the twin (default: 6)")
parser.add_argument("--noise", choices=("shared", "per channel"), default="shared")
parser.add_argument("--walkers", type=int, help="samples a stage (default: that of the preset)")
parser.add_argument("--step", type=float, help="step of integration [s] (default: that of the preset)")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--resume", action="store_true", help="go on with the killed run in OUT, begun with these options")
parser.add_argument("--out", type=Path, default=Path("results-isolated-bridge"))
args = parser.parse_args()
walkers, sweeps, step, propagated, settings = PRESETS[args.preset]
walkers, step = args.walkers or walkers, args.step or step
args.out.mkdir(parents=True, exist_ok=True)
begin = time.perf_counter()

# %% [markdown]
# ## The data and the posterior
#
# At a step of .5 ms displacements are within 3e-5 of their peaks, forces within .1 %, accelerations within .3 %: far
# below the noise. The paper has one sigma for all channels, each in units of its measured root mean square.

# %%
problem = dict(data=args.data, channels=args.channels, noise=args.noise, step=step)
posterior = problems.isolated_bridge(**problem)
model, measured = posterior.likelihood.model, posterior.likelihood.measurements
names, n_structural = posterior.parameter_names, len(model.parameter_names)
truth = np.array([problems.ISOLATED_BRIDGE_TRUTH[args.data][name] for name in model.parameter_names])
print(measured.description)
print(f"{measured.n_steps} samples at {measured.dt:g} s of {[c.name for c in measured.channels]}")
if args.preset == "fast":
    print("REDUCED SETTING (fast): few samples and long steps; expect a rough posterior")

# %% [markdown]
# ## Sampling
#
# The sampler's warnings are worth reading: they say when the draws are not to be trusted.

# %%
backend = emcee.backends.HDFBackend(args.out / "chain.h5")
if not args.resume:
    backend.reset(walkers, posterior.ndim)
Sampler = {"tmcmc": TMCMCSampler, "smc": SMCSampler}[args.sampler]
start = time.perf_counter()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always", SamplingWarning)
    sampler = Sampler(
        walkers, posterior.ndim, posterior, vectorize=True, backend=backend, seed=args.seed, **dict(settings)
    )
    sampler.run_mcmc(None, sweeps, progress=True)
alarms = [str(w.message) for w in caught if issubclass(w.category, SamplingWarning)]
seconds = time.perf_counter() - start
report = posterior.report()
samples = sampler.get_chain(flat=True)
for alarm in alarms:
    print(f"WARNING: {alarm}")

moments = summary(samples, names)
lines = [f"{'parameter':<10} {'truth':>7} {'mean':>8} {'sd':>8} {'cv':>7} {'(mean-truth)/sd':>16}"]
for i, name in enumerate(names):
    # the level of the noise is known as a share of the clean response, sigma is one of the measured: alike within .2 %
    true = truth[i] if i < n_structural else problems.ISOLATED_BRIDGE_NOISE[args.data]
    known = i < n_structural or name == "sigma"
    z = f"{(moments.mean[i] - true) / moments.sd[i]:+.2f}" if known else "-"
    shown = f"{true:.3f}" if known else "-"
    lines.append(f"{name:<10} {shown:>7} {moments.mean[i]:8.4f} {moments.sd[i]:8.4f} {moments.cv[i]:7.3f} {z:>16}")
(args.out / "parameters.txt").write_text("\n".join(lines) + "\n")
print("\n".join(lines))
(args.out / "ladder.txt").write_text(ladder_table(sampler) + "\n")
figure = ladder_plot(sampler)
figure.savefig(args.out / "ladder.png", dpi=150)
plt.close(figure)

# %% [markdown]
# ## Figure 5: parameters, and the fit of every sample
#
# J is the sum of squared residuals of a channel over the sum of squares of the measured channel.

# %%
BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"
LABELS = [
    *(rf"${symbol}$" for symbol in (r"f_{\min,1}", r"\Delta f_1", "a_1", r"f_{\min,2}", r"\Delta f_2", "a_2")),
    *(rf"${symbol}$" for symbol in ("K_{d1}", "C_{01}", "K_{d2}", "C_{02}")),
    *(r"$\sigma$" if name == "sigma" else name for name in names[n_structural:]),
]
rng = np.random.default_rng(args.seed)
fit = fit_measures(posterior, samples)
nominal_fit = fit_measures(posterior, np.ones((1, n_structural)))[0]

figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.6), layout="constrained")
few = samples[rng.choice(len(samples), min(500, len(samples)), replace=False)]
for i in range(n_structural):
    left.plot(i + rng.uniform(-0.16, 0.16, len(few)), few[:, i], ".", color=BLUE, alpha=0.15, markersize=3)
left.errorbar(
    range(n_structural),
    moments.mean[:n_structural],
    moments.sd[:n_structural],
    fmt="_",
    color="k",
    capsize=5,
    markersize=12,
    label="mean and standard deviation",
)
left.plot(range(n_structural), truth, "x", color=ORANGE, markersize=8, label="truth (synthetic)")
left.axhline(1.0, color=GREY, linewidth=0.8, linestyle="--", label="nominal (assumed)")
left.set_xticks(range(n_structural), LABELS[:n_structural])
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
        [mean - sd, mean + sd], j - 0.2, j + 0.2, color=ORANGE, linestyle=":", label="mean +- sd" if j == 0 else None
    )
    right.plot(j, nominal_fit[j], "v", color=GREY, label="nominal parameters" if j == 0 else None)
right.set_yscale("log")
right.set_xticks(range(fit.shape[1]), [f"$J_{j + 1}$\n{c.name}" for j, c in enumerate(measured.channels)])
right.set(ylabel="fit J [-]", title="Fit with the measured time histories")
right.legend(*(part[:4] for part in right.get_legend_handles_labels()), frameon=False, fontsize="small")
figure.suptitle("Synthetic data, nominal values assumed", fontsize="small")
figure.savefig(args.out / "fig5_parameters_and_fit.png", dpi=150)
plt.close(figure)

# %% [markdown]
# ## Figure 6: marginal densities

# %%
columns = 4
figure, axes = plt.subplots(
    -(-len(names) // columns), columns, figsize=(11, 2.3 * -(-len(names) // columns)), layout="constrained"
)
for axis in axes.flat[len(names) :]:
    axis.axis("off")
for i, axis in enumerate(axes.flat[: len(names)]):
    axis.hist(samples[:, i], bins=40, density=True, color=BLUE, alpha=0.35)
    if np.ptp(samples[:, i]) > 0.0:
        x = np.linspace(samples[:, i].min(), samples[:, i].max(), 300)
        axis.plot(x, gaussian_kde(samples[:, i])(x), color=BLUE)
    if i < n_structural:
        axis.axvline(truth[i], color=ORANGE, linewidth=1.0)
    axis.set(xlabel=LABELS[i], yticks=[])
    axis.xaxis.set_major_locator(matplotlib.ticker.MaxNLocator(4))
figure.suptitle("Marginal posterior densities; lines: truth (synthetic data, nominal values assumed)", fontsize="small")
figure.savefig(args.out / "fig6_marginals.png", dpi=150)
plt.close(figure)
figure = corner.corner(samples, labels=LABELS, truths=[*truth, *[None] * (len(names) - n_structural)])
figure.savefig(args.out / "corner.png", dpi=80)
plt.close(figure)

# %% [markdown]
# ## Figure 7: predicted histories with their uncertainty
#
# Mean, variance and quantiles of every channel at every instant over the posterior samples (equations 9 to 13). The
# band of the response is thin, as in the paper; with the noise it must hold about nine tenths of what was measured.

# %%
draws = samples[rng.choice(len(samples), min(propagated, len(samples)), replace=False)]
prediction = propagate(posterior, draws, noise=True, seed=args.seed)
response = propagate(posterior, draws, progress=False, seed=args.seed)
four = ("Ub_1", "shear_1", "acc_p1", "drift_1")
four = four if args.data == "twin" else ("mean_Ub", "mean_shear", "mean_acc_p", "mean_drift")
figure = plot_bands(response, measured, four)
figure.suptitle("Predicted response (mean, 5 to 95 %) and data: synthetic, nominal values assumed", fontsize="small")
figure.savefig(args.out / "fig7_predictions.png", dpi=150)
plt.close(figure)
errors, covered = response.rrmse(measured), prediction.coverage(measured)
for channel, error, share in zip(measured.channels, errors, covered, strict=True):
    print(f"{channel.name:<10} RRMSE {100 * error:5.2f} %, inside the 90 % band with noise {100 * share:5.1f} %")

# %% [markdown]
# ## Motions to come: peak displacement, exceedance, fragility
#
# The same posterior under motions that were not measured: six other draws of the stochastic model that made the table's
# motion, at several strengths. The devices are made for bearing displacements of 50 mm. What the parameters leave
# uncertain is little here; that no two motions are alike is more, and the fragility curve holds both.

# %%
bearing = "Ub_1" if args.data == "twin" else "mean_Ub"
strengths, n_motions, few_draws = ((0.6, 0.9, 1.2, 1.5, 1.8), 6, 50) if args.preset != "fast" else ((0.8, 1.4), 2, 10)
motions = [table_motion(seed) for seed in range(101, 101 + n_motions)]
future = propagate(posterior, draws[: 4 * few_draws], quantity=peak(bearing), record=motions[0], progress=False)
low, high = 1e3 * future.quantile(0.05), 1e3 * future.quantile(0.95)
beyond = exceedance(future, 1.01 * future.mean)
print(
    f"peak of {bearing} under another motion: {1e3 * future.mean:.2f} mm, {low:.2f} to {high:.2f} mm (90 %); "
    f"more than 1 % above the mean with probability {beyond.probability:.3f} ({beyond.lower:.3f} to {beyond.upper:.3f})"
)
curve = fragility(
    posterior,
    draws[:few_draws],
    [motion.scale(strength) for motion in motions for strength in strengths],
    peak(bearing),
    50.0,
    unit="mm",
    progress=False,
)
figure = plot_fragility(curve)
figure.suptitle(f"P(peak of {bearing} > 50 mm | data, motion)", fontsize="small")
figure.savefig(args.out / "fragility.png", dpi=150)
plt.close(figure)

# %% [markdown]
# ## Does friction depend on velocity? Two classes of models
#
# The class without velocity dependence has four parameters less. Its evidence says how much worse it explains the data
# than its simplicity can make up for.

# %%
constant = problems.isolated_bridge(
    **problem,
    bearings=(Bearing(f_min=0.09, df=0.0, a=0.0), Bearing(f_min=0.09, df=0.0, a=0.0)),
    parameters=("fmin_1", "fmin_2", "Kd_1", "C0_1", "Kd_2", "C0_2"),
)
cheap = {"max_moves": 3} if args.preset == "fast" else {}
rival = SMCSampler(500 if walkers >= 500 else 30, constant.ndim, constant, vectorize=True, seed=args.seed, **cheap)
rival.run_mcmc(None, 1, progress=True)
comparison = compare_models({"mu(v)": sampler, "constant mu": rival})
print(comparison.table())

# %% [markdown]
# ## What it cost

# %%
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
    "alarms": alarms,
    "simulations": report["simulations"],
    "failures": report["failure_count"],
    "seconds_sampling": seconds,
    "milliseconds_per_simulation": 1e3 * report["seconds"] / max(1, report["simulations"]),
    "seconds": time.perf_counter() - begin,
}
(args.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
print(
    f"log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f}; {len(sampler.ladder)} stages, "
    f"{report['simulations']} simulations ({report['failure_count']} failed) in {seconds:.0f} s, the whole in "
    f"{result['seconds']:.0f} s\ntables and figures are in {args.out}/"
)
