"""
Ten minutes: a linear oscillator, from a record to a prediction
===============================================================

A mass on a spring and a dashpot is shaken at its base, and its acceleration and displacement are measured. How stiff is
the spring, how strong is the damping, how accurate are the sensors, and what follows for the next earthquake?

This tutorial goes through all steps of the library. One simulation of the model takes a tenth of a millisecond, so the
script runs in less than a minute and its results can be checked against numerical integration. **The data are
synthetic.** ::

    python tutorials/01_linear_oscillator.py
"""

import argparse
import json
import os
import time
from pathlib import Path

import arviz
import emcee
import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from scipy.special import logsumexp

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
    from_si,
    peak,
    plot_bands,
    plot_fit,
    plot_histories,
    plot_record,
    plot_scores,
    plot_spectrum,
    problems,
    propagate,
    to_si,
)
from samplers import SMCSampler, TMCMCSampler, plot_corner, to_arviz

FAST = bool(os.environ.get("FAST"))  # a shorter chain of emcee, fewer walkers of TMCMC, no progress bars
parser = argparse.ArgumentParser(description="Ten-minute introduction; writes figures and summary.json to a folder.")
parser.add_argument("--seed", type=int, default=1, help="seed of the noise and of the samplers")
parser.add_argument("--out", type=Path, default=Path("results-oscillator"), help="folder of the results")
args = parser.parse_args()
args.out.mkdir(parents=True, exist_ok=True)
begin = time.perf_counter()
BLUE, ORANGE, GREEN, GREY = "#1f5a8c", "#d9822b", "#5b8c5a", "#8a8f98"


def save(figure, name: str) -> None:
    """Save a figure in the output folder and leave it open: the documentation shows the open figures of a cell."""
    figure.savefig(args.out / f"{name}.png", dpi=100, bbox_inches="tight", pad_inches=0.1)


# %%
# 1. The record
# -------------
#
# A ``Record`` has a name, a time step and acceleration samples in m/s². The function
# ``read_record`` reads your own records. Here we use the first 25 seconds of the bundled synthetic motion, resampled to
# 32 Hz; ``resample`` applies a low-pass filter before it increases the step. The response spectrum shows at which
# periods the motion is strong: at one second, the period of our oscillator, it is 0.16 g for 5 % damping.

record = problems.bridge_column_data().record
record = record.resample(8 * record.dt).trim(0.0, 25.0)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), width_ratios=(1.6, 1), layout="constrained")
plot_record(record, left)
plot_spectrum(record, axes=right)
right.set_title("response spectrum")
save(figure, "record")

# %%
# 2. The model
# ------------
#
# The parameters of ``LinearOscillator`` are multiples of nominal values: here a period of one second and 5 % of
# critical damping. Any object with a method ``simulate(theta)`` and a few attributes is a model. The bridge column of
# tutorial 02 and your own program in tutorial 05 are used in the same way.

model = LinearOscillator(record, period=1.0, damping_ratio=0.05)
print("parameters:", ", ".join(model.parameter_names))
print("channels:  ", ", ".join(f"{channel.name} [{channel.unit}]" for channel in model.channels))
print("samples:   ", model.n_steps)

# %%
# 3. The measurements
# -------------------
#
# The measurements are simulated with known parameters, which the rest of the tutorial uses only for comparison: the
# spring is 15 % stiffer than nominal and the damping 30 % lower. White noise is added. All values inside the library
# are in SI units; other units appear only where data are read or plotted.

TRUTH = {"stiffness": 1.15, "damping": 0.7, "sigma_acceleration": to_si(0.02, "g"), "sigma_displacement": 0.005}
truth = np.array([float(value) for value in TRUTH.values()])
rng = np.random.default_rng(args.seed)
clean = model.simulate(truth[:2])
noisy = clean + truth[2:, None] * rng.standard_normal(clean.shape)
measured = Measurements(model.channels, model.dt, noisy, "SYNTHETIC: a linear oscillator plus white noise")
save(plot_histories(measured), "measurements")

# %%
# 4. Prior, likelihood, posterior
# -------------------------------
#
# The prior describes what was known before the measurement: stiffness and damping are positive and have their nominal
# values with standard deviations of 30 % and 50 %; the noise levels have half-normal priors with scales of 0.1 g and
# 3 cm. The likelihood compares the response with the measurements, with one unknown noise standard deviation per
# channel. The posterior density is proportional to prior times likelihood. It is a function of four numbers, and this
# function is all that a sampler needs.

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
print(f"log-probability at the nominal values {posterior(nominal):.1f}, at the true values {posterior(truth):.1f}")

# %%
# 5. Three samplers with the same interface
# -----------------------------------------
#
# emcee is a widely used ensemble sampler. ``SMCSampler`` and ``TMCMCSampler`` take the same arguments in the same
# order. They start from the prior and anneal the likelihood until they reach the posterior, so they need no initial
# guess, and they also return the evidence. emcee moves its walkers from the points where they start. If the start is
# the whole prior, a walker can get stuck at parameters whose response is out of phase by one cycle. Therefore the
# walkers of emcee start in a small ball around the best of 500 draws from the prior, and the first third of the chain
# is discarded.

WALKERS = {emcee.EnsembleSampler: 48, SMCSampler: 500, TMCMCSampler: 300 if FAST else 500}
SWEEPS = {emcee.EnsembleSampler: 500 if FAST else 1000, SMCSampler: 4, TMCMCSampler: 4}
discard = SWEEPS[emcee.EnsembleSampler] // 3
prior_draws = posterior.sample_prior(500, args.seed)
best = prior_draws[np.argmax(posterior(prior_draws))]
ball = best * (1.0 + 0.01 * rng.standard_normal((WALKERS[emcee.EnsembleSampler], posterior.ndim)))
runs, samples, seconds, simulations = {}, {}, {}, {}
np.random.seed(args.seed)  # noqa: NPY002 - emcee uses NumPy's global generator
for Sampler in (emcee.EnsembleSampler, SMCSampler, TMCMCSampler):
    is_emcee = Sampler is emcee.EnsembleSampler
    name = "emcee" if is_emcee else Sampler.__name__.removesuffix("Sampler")
    before, start = posterior.report()["simulations"], time.perf_counter()
    seed = {} if is_emcee else {"seed": args.seed}
    sampler = Sampler(WALKERS[Sampler], posterior.ndim, posterior, vectorize=True, **seed)
    sampler.run_mcmc(ball if is_emcee else None, SWEEPS[Sampler], progress=not FAST)
    seconds[name], simulations[name] = time.perf_counter() - start, posterior.report()["simulations"] - before
    runs[name], samples[name] = sampler, sampler.get_chain(flat=True, discard=discard if is_emcee else 0)
for name, sampler in runs.items():
    print(f"{name}: {simulations[name]} simulations, {seconds[name]:.3g} s")
    if name != "emcee":
        print(f"  log-evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2g}")
print(arviz.summary(to_arviz(runs["SMC"]), kind="stats"))  # r_hat needs two runs: to_arviz([run_1, run_2])

# %%
# 6. Is the result correct?
# -------------------------
#
# With so few parameters the posterior can be integrated on a grid. The sum of squared residuals of each channel is
# computed for every pair of stiffness and damping, and the noise standard deviations are integrated for every value of
# that sum. The samplers must agree with the grid within their own standard errors. With an expensive model no grid is
# possible, and these standard errors are the only available measure of accuracy.


def to_display(x: np.ndarray) -> np.ndarray:
    """Convert the noise standard deviations of parameters (..., 4) to g and cm."""
    return np.concatenate([x[..., :2], from_si(x[..., 2:3], "g"), from_si(x[..., 3:], "cm")], axis=-1)


def integrate_on_grid(n: int = 61, width: float = 7.0) -> tuple[np.ndarray, float]:
    """Posterior mean (4,) and log-evidence by sums over `width` standard deviations around the samples."""
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


exact, log_evidence = integrate_on_grid()
errors = {name: sampler.mean_error() for name, sampler in runs.items() if name != "emcee"}
length = (SWEEPS[emcee.EnsembleSampler] - discard) * WALKERS[emcee.EnsembleSampler]
tau = runs["emcee"].get_autocorr_time(discard=discard, quiet=True)
errors["emcee"] = samples["emcee"].std(axis=0) * np.sqrt(tau / length)
print(f"{'':<20}" + "".join(f"{name:>21}" for name in ("stiffness [-]", "damping [-]", "sigma_a [g]", "sigma_d [cm]")))
for label, values in (("truth", truth), ("integrals on a grid", exact)):
    print(f"{label:<20}" + "".join(f"{value:>21.5f}" for value in to_display(values)))
for name, x in samples.items():
    pairs = zip(to_display(x.mean(axis=0)), to_display(errors[name]), strict=True)
    print(f"{name:<20}" + "".join(f"{f'{mean:.5f} +- {error:.5f}':>21}" for mean, error in pairs))
for name in ("SMC", "TMCMC"):
    sampler = runs[name]
    print(
        f"{name}: log evidence {sampler.log_evidence:.2f} +- {sampler.log_evidence_error:.2f} (grid {log_evidence:.2f})"
    )

# %%
# The corner plot shows the three posteriors on top of one another, in the units of ``posterior.parameters``.

figure = plot_corner(samples, posterior, truths=truth)
save(figure, "corner")

# %%
# 7. Before and after the update
# ------------------------------
#
# The figure compares the response at the nominal values and at the posterior mean with the measurement. RRMSE is the
# relative root-mean-square error of a channel. After the update, only the noise is left.

theta = {"nominal values": np.ones(2), "posterior mean": samples["SMC"].mean(axis=0)[:2]}
save(plot_fit(measured, {title: model.simulate(values) for title, values in theta.items()}, title=""), "fit")

# %%
# 8. Prediction
# -------------
#
# Every sample is one oscillator that is consistent with the data. Together, the samples give a band at each time; with
# the noise of the sensors included, the 90 % band should contain 90 % of the measured samples. A band that is too wide
# contains more, so the share alone shows little: the interval score is the width of the band plus a penalty for every
# sample outside of it, and the CRPS compares the whole distribution with the measured value; smaller is better.
# The same samples predict the response to an earthquake that was not used in the update: here the peak displacement and
# its uncertainty.

draws = samples["SMC"][:: max(1, len(samples["SMC"]) // 400)]
band = propagate(posterior, draws, noise=True, seed=args.seed, progress=False)
figure = plot_bands(band, measured)
for axes in figure.axes:
    axes.set_xlim(4.0, 14.0)
save(figure, "prediction")
scores = band.score(measured)
another = problems.isolated_bridge_data().record
future = propagate(posterior, draws, quantity=peak("displacement"), record=another, progress=False)
low, middle, high = (float(from_si(future.quantile(p), "cm")) for p in (0.05, 0.5, 0.95))
print(scores)
save(plot_scores(scores), "scores")
print(f"peak displacement under {another.name!r}: median {middle:.2f} cm, 90 % interval {low:.2f} to {high:.2f} cm")
at_nominal = from_si(np.abs(model.with_record(another).simulate([1.0, 1.0])[1]).max(), "cm")
print(f"peak displacement at the nominal values: {at_nominal:.2f} cm")

# %%
# All numbers are also written to ``summary.json``.

result = {
    "data": measured.description,
    "truth": truth.tolist(),
    "grid": exact.tolist(),
    "log_evidence_grid": log_evidence,
    "peak_displacement_cm": [low, middle, high],
    "coverage": scores.coverage.tolist(),
    "interval_score": (scores.interval_score / scores.rms).tolist(),
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
print(f"{time.perf_counter() - begin:.0f} s in total; figures and summary.json are in {args.out}/")
