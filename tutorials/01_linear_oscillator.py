# %% [markdown]
# # Ten minutes: a linear oscillator, from a record to a prediction
#
# A mass on a spring and a dashpot is shaken at its base; its acceleration and its displacement are measured. How stiff
# is the spring, how strong the damping, how good are the sensors, and what does that mean for the next earthquake?
# All steps of the library are here, on a model that answers in a tenth of a millisecond, so that the whole runs in less
# than a minute and can be checked against numerical integration. **The data are synthetic.**
#
#     python tutorials/01_linear_oscillator.py

# %%
import argparse
import json
import os
import time
from pathlib import Path

import arviz
import corner
import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.lines import Line2D
from scipy.special import logsumexp

from fe_likelihoods import problems
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.plots.predictions import plot_bands
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.probability.likelihood import FELikelihood
from fe_likelihoods.probability.posterior import Posterior
from fe_likelihoods.probability.priors import HalfNormal, Prior, TruncatedNormal
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.units import from_si, to_si
from samplers import SMCSampler, TMCMCSampler
from samplers.reporting.summary import comparison_table, to_arviz

FAST = bool(os.environ.get("FAST"))
parser = argparse.ArgumentParser(description="The ten-minute introduction; figures and summary.json into a folder.")
parser.add_argument("--seed", type=int, default=1)
parser.add_argument("--out", type=Path, default=Path("results-oscillator"))
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)
begin = time.perf_counter()
BLUE, ORANGE, GREEN, GREY = "#1f5a8c", "#d9822b", "#5b8c5a", "#8a8f98"


def save(figure, name: str) -> None:
    """A figure into the folder."""
    figure.savefig(args.out / f"{name}.png", dpi=100, bbox_inches="tight", pad_inches=0.1)
    plt.close(figure)


# %% [markdown]
# ## 1. The record
#
# A `Record` is a name, a step and samples in m/s²; `records.read_at2`, `read_v2` and `read_csv` read yours. Here it is
# the bundled synthetic motion, its first 25 seconds at 32 Hz: `resample` filters before it takes longer steps. The
# spectrum tells where the motion is strong: our oscillator, of about one second, sees little more than a tenth of g.

# %%
record = problems.bridge_column_data().record
record = record.resample(8 * record.dt).trim(0.0, 25.0)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), width_ratios=(1.6, 1), layout="constrained")
record.plot(left)
record.plot_spectrum(axes=right)
right.set_title("response spectrum")
save(figure, "record")

# %% [markdown]
# ## 2. The model
#
# `LinearOscillator` takes multiples of nominal values, here one second and 5 % of critical damping. Any object with
# `simulate(theta)` and a few names is a model: the bridge column of tutorial 02 and your own program of tutorial 05 are
# used in the same way.

# %%
model = LinearOscillator(record, period=1.0, damping_ratio=0.05)
print(f"{model.parameter_names} -> {[f'{c.name} [{c.unit}]' for c in model.channels]}, {model.n_steps} samples")

# %% [markdown]
# ## 3. The measurements
#
# Made by the model at a truth that the rest of this page does not look at: a spring 15 % stiffer and damping 30 % lower
# than nominal. White noise is added. Values are SI in the library; units appear where one reads and draws.

# %%
TRUTH = {"stiffness": 1.15, "damping": 0.7, "sigma_acceleration": to_si(0.02, "g"), "sigma_displacement": 0.005}
truth = np.array([float(value) for value in TRUTH.values()])
rng = np.random.default_rng(args.seed)
clean = model.simulate(truth[:2])
noisy = clean + truth[2:, None] * rng.standard_normal(clean.shape)
measured = Measurements(model.channels, model.dt, noisy, "SYNTHETIC: a linear oscillator plus white noise")
save(measured.plot(), "measurements")

# %% [markdown]
# ## 4. Prior, likelihood, posterior
#
# The prior says what was known before: the nominal values, within 30 % and 50 %, never negative; and that sensors err
# by less than .1 g and 3 cm or so. The likelihood compares response and measurements, with one unknown standard
# deviation a channel. Posterior = prior x likelihood: a function of four numbers, and all that any sampler wants.

# %%
prior = Prior(
    {
        "stiffness": TruncatedNormal(1.0, 0.3),
        "damping": TruncatedNormal(1.0, 0.5),
        "sigma_acceleration": HalfNormal(float(to_si(0.1, "g"))),
        "sigma_displacement": HalfNormal(float(to_si(3.0, "cm"))),
    }
)
posterior = Posterior(FELikelihood(model, measured), prior)
nominal = [1.0, 1.0, *truth[2:]]
print(f"log-probability of the nominal values {posterior(nominal):.1f}, of the truth {posterior(truth):.1f}")

# %% [markdown]
# ## 5. Three samplers, the same lines
#
# emcee is the ensemble sampler that many know; `SMCSampler` and `TMCMCSampler` take its arguments in its order. They
# start from the whole prior and climb to the posterior: they need no first guess and give the evidence. emcee walks
# from where it is put. Put over the whole prior, a walker can stay for ever where the phase is wrong by a cycle, so it
# gets a ball around the best of 500 draws of the prior, and a third of its chain is thrown away.

# %%
WALKERS = {emcee.EnsembleSampler: 48, SMCSampler: 500, TMCMCSampler: 500}
SWEEPS = {emcee.EnsembleSampler: 1000, SMCSampler: 4, TMCMCSampler: 4}
discard = SWEEPS[emcee.EnsembleSampler] // 3
prior_draws = posterior.sample_prior(500, args.seed)
best = prior_draws[np.argmax(posterior(prior_draws))]
ball = best * (1.0 + 0.01 * rng.standard_normal((WALKERS[emcee.EnsembleSampler], posterior.ndim)))
runs, samples, seconds, simulations = {}, {}, {}, {}
np.random.seed(args.seed)  # noqa: NPY002 - the generator of emcee
for Sampler in (emcee.EnsembleSampler, SMCSampler, TMCMCSampler):
    is_emcee = Sampler is emcee.EnsembleSampler
    name = "emcee" if is_emcee else Sampler.__name__.removesuffix("Sampler")
    before, start = posterior.report()["simulations"], time.perf_counter()
    seed = {} if is_emcee else {"seed": args.seed}
    sampler = Sampler(WALKERS[Sampler], posterior.ndim, posterior, vectorize=True, **seed)
    sampler.run_mcmc(ball if is_emcee else None, SWEEPS[Sampler], progress=not FAST)
    seconds[name], simulations[name] = time.perf_counter() - start, posterior.report()["simulations"] - before
    runs[name], samples[name] = sampler, sampler.get_chain(flat=True, discard=discard if is_emcee else 0)
print(comparison_table(runs, {"emcee": seconds["emcee"]}, discard=discard))
print(arviz.summary(to_arviz(runs["SMC"]), kind="stats"))  # arviz.from_emcee(sampler) works for all three as well

# %% [markdown]
# ## 6. Is it right?
#
# With so few parameters the integrals can be done on a grid: for every stiffness and damping the sum of squared
# residuals J of a channel, and for every J the integral over its sigma. That is what the samplers are to reproduce,
# within their own standard errors; with a real model there is no grid to ask, and these errors are all one has.


# %%
def shown(x: np.ndarray) -> np.ndarray:
    """Parameters (..., 4) with the noise levels in g and cm."""
    return np.concatenate([x[..., :2], from_si(x[..., 2:3], "g"), from_si(x[..., 3:], "cm")], axis=-1)


def quadrature(n: int = 61, width: float = 7.0) -> tuple[np.ndarray, float]:
    """Posterior mean (4,) and log-evidence, by sums over `width` standard deviations about the samples."""
    center, spread = samples["SMC"].mean(axis=0), width * samples["SMC"].std(axis=0)
    grid = [np.linspace(max(c - s, 1e-9), c + s, n) for c, s in zip(center, spread, strict=True)]
    log_width = sum(np.log(axis[1] - axis[0]) for axis in grid)
    log_prior = [d.logpdf(axis) for d, axis in zip(prior.distributions.values(), grid, strict=True)]
    total, first = np.zeros((n, n)), []
    responses = np.array([[model.simulate([k, c]) for c in grid[1]] for k in grid[0]])
    misfits = np.sum((responses - measured.values) ** 2, axis=-1)
    for channel, (sigma, density) in enumerate(zip(grid[2:], log_prior[2:], strict=True)):
        terms = density - measured.n_steps * np.log(np.sqrt(2.0 * np.pi) * sigma)
        terms = terms - misfits[..., channel, None] / (2.0 * sigma**2)
        total += logsumexp(terms, axis=-1)
        first.append(np.exp(logsumexp(terms, axis=-1, b=sigma) - logsumexp(terms, axis=-1)))
    total += log_prior[0][:, None] + log_prior[1]
    weights = np.exp(total - logsumexp(total))
    means = [(weights * x).sum() for x in (grid[0][:, None], grid[1][None, :], *first)]
    return np.array(means), float(logsumexp(total) + log_width)


exact, log_evidence = quadrature()
errors = {name: sampler.mean_error() for name, sampler in runs.items() if name != "emcee"}
length = (SWEEPS[emcee.EnsembleSampler] - discard) * WALKERS[emcee.EnsembleSampler]
tau = runs["emcee"].get_autocorr_time(discard=discard, quiet=True)
errors["emcee"] = samples["emcee"].std(axis=0) * np.sqrt(tau / length)
print(f"{'':<20}" + "".join(f"{name:>21}" for name in ("stiffness [-]", "damping [-]", "sigma_a [g]", "sigma_d [cm]")))
for label, values in (("truth", truth), ("integrals on a grid", exact)):
    print(f"{label:<20}" + "".join(f"{value:>21.5f}" for value in shown(values)))
for name, x in samples.items():
    pairs = zip(shown(x.mean(axis=0)), shown(errors[name]), strict=True)
    print(f"{name:<20}" + "".join(f"{f'{mean:.5f} +- {error:.5f}':>21}" for mean, error in pairs))
for name in ("SMC", "TMCMC"):
    sampler = runs[name]
    print(
        f"{name}: log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f} (grid {log_evidence:.2f})"
    )

# %% [markdown]
# The same, seen: three posteriors on top of one another.

# %%
LABELS = ["stiffness\n[x nominal]", "damping\n[x nominal]", r"$\sigma_a$ [g]", r"$\sigma_d$ [cm]"]
COLOURS = {"emcee": GREEN, "SMC": BLUE, "TMCMC": ORANGE}


limits = list(np.quantile(shown(np.concatenate(list(samples.values()))), [0.001, 0.999], axis=0).T)
figure = plt.figure(figsize=(7.6, 7.6))
for name, x in samples.items():
    corner.corner(
        shown(x),
        fig=figure,
        labels=LABELS,
        range=limits,
        color=COLOURS[name],
        weights=np.full(len(x), 1.0 / len(x)),
        plot_datapoints=False,
        plot_density=False,
        no_fill_contours=True,
        levels=(0.5, 0.9),
        truths=shown(truth),
        truth_color=GREY,
        max_n_ticks=4,
        labelpad=0.08,
        smooth=1.0,
    )
for i in range(posterior.ndim):  # corner makes room for the last histogram alone
    diagonal = figure.axes[i * (posterior.ndim + 1)]
    diagonal.set_ylim(0.0, 1.1 * max(patch.get_xy()[:, 1].max() for patch in diagonal.patches))
handles = [Line2D([], [], color=COLOURS[name], label=name) for name in samples]
handles.append(Line2D([], [], color=GREY, marker="s", label="truth (synthetic)"))
figure.legend(handles=handles, loc="upper right", fontsize=13, frameon=False, bbox_to_anchor=(0.97, 0.95))
figure.text(0.66, 0.72, "contours hold 50 and 90 %", fontsize=11, ha="left")
save(figure, "corner")

# %% [markdown]
# ## 7. Before and after
#
# The response at the nominal values and at the posterior mean. What is left is the noise.

# %%
theta = {"nominal values": np.ones(2), "posterior mean": samples["SMC"].mean(axis=0)[:2]}
figure, rows = plt.subplots(2, 1, figsize=(9, 5), sharex=True, sharey=True, layout="constrained")
for axes, (label, values) in zip(rows, theta.items(), strict=True):
    data, response = (from_si(x, "cm") for x in (measured.channel("displacement"), model.simulate(values)[1]))
    error = np.sqrt(np.sum((response - data) ** 2) / np.sum(data**2))
    axes.plot(measured.time, data, ".", color=ORANGE, markersize=2.5, label="measured (synthetic)")
    axes.plot(measured.time, response, color=BLUE, linewidth=1.0, label=f"{label}: RRMSE {100 * error:.0f} %")
    axes.legend(frameon=False, fontsize="small", ncols=2, loc="upper left")
    axes.set_ylabel("displacement [cm]")
    axes.grid(alpha=0.25)
rows[-1].set(
    xlabel="time [s]", xlim=(0.0, record.duration), ylim=np.array([-1.1, 1.4]) * np.abs(measured.values[1]).max() * 100
)
save(figure, "fit")

# %% [markdown]
# ## 8. Prediction
#
# Every sample is one oscillator that the data allow. Together they give a band at every instant, here with the noise
# that a sensor would add: nine tenths of what was measured should be inside. And they give numbers for an earthquake
# that was not used: the peak displacement under another motion, with its uncertainty.

# %%
draws = samples["SMC"][:: max(1, len(samples["SMC"]) // 400)]
band = propagate(posterior, draws, noise=True, seed=args.seed, progress=False)
figure = plot_bands(band, measured)
for axes in figure.axes:
    axes.set_xlim(4.0, 14.0)
save(figure, "prediction")
covered = band.coverage(measured)
another = problems.isolated_bridge_data().record
future = propagate(posterior, draws, quantity=peak("displacement"), record=another, progress=False)
low, middle, high = (float(from_si(future.quantile(p), "cm")) for p in (0.05, 0.5, 0.95))
shares = (f"{channel.name} {100 * s:.1f} %" for channel, s in zip(band.channels, covered, strict=True))
print(f"inside the 90 % band: {', '.join(shares)}")
print(f"peak displacement under {another.name!r}: {middle:.2f} cm, {low:.2f} to {high:.2f} cm with 90 % probability")
at_nominal = from_si(np.abs(model.with_record(another).simulate([1.0, 1.0])[1]).max(), "cm")
print(f"at the nominal values it would be {at_nominal:.2f} cm")

# %%
result = {
    "data": measured.description,
    "truth": truth.tolist(),
    "grid": exact.tolist(),
    "log_evidence_grid": log_evidence,
    "peak_displacement_cm": [low, middle, high],
    "coverage": covered.tolist(),
    "samplers": {
        name: {
            "mean": x.mean(axis=0).tolist(),
            "sd": x.std(axis=0).tolist(),
            "mean_error": errors[name].tolist(),
            "log_evidence": float(getattr(runs[name], "log_evidence", np.nan)),
            "log_evidence_error": float(getattr(runs[name], "log_evidence_error", np.nan)),
            "simulations": simulations[name],
            "seconds": seconds[name],
        }
        for name, x in samples.items()
    },
}
(args.out / "summary.json").write_text(json.dumps(result, indent=2) + "\n")
print(f"{time.perf_counter() - begin:.0f} s in all; figures and summary.json are in {args.out}/")
