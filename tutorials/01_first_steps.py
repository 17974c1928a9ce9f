"""
First steps: from a record to a prediction
==========================================

A mass on a spring and a dashpot is shaken at its base, and its acceleration and displacement are measured. How stiff is
the spring, how strong is the damping, how accurate are the sensors, and what follows for the next earthquake?

This tutorial goes through all steps of the library in seconds. **The data are synthetic.** ::

    python tutorials/01_first_steps.py
"""

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    TruncatedNormal,
    from_si,
    peak,
    plot_bands,
    plot_fit,
    plot_histories,
    plot_record,
    plot_spectrum,
    problems,
    propagate,
    to_si,
)
from samplers import SMCSampler, plot_corner, summary

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# 1. The record
# -------------
#
# A `Record` has a name, a time step and acceleration samples in m/s². `read_record` reads your own files. Here we use
# the first 25 seconds of the bundled synthetic motion, resampled to 32 Hz; ``resample`` applies a low-pass filter
# before it increases the step. The response spectrum shows at which periods the motion is strong: at one second, the
# period of our oscillator, it is 0.16 g for 5 % damping.

record = problems.bridge_column_data().record
record = record.resample(8 * record.dt).trim(0.0, 25.0)
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.4), width_ratios=(1.6, 1), layout="constrained")
plot_record(record, left)
plot_spectrum(record, axes=right)
right.set_title("response spectrum")
figure.savefig("record.png")

# %%
# 2. The model
# ------------
#
# The parameters of `LinearOscillator` are multiples of nominal values: here a period of one second and 5 % of critical
# damping. Any object with a method ``simulate(theta)`` and a few attributes is a model. The bridge column of tutorial
# 02 and your own program in tutorial 03 are used in the same way.

model = LinearOscillator(record, period=1.0, damping_ratio=0.05)
print("parameters:", ", ".join(model.parameter_names))
print("channels:  ", ", ".join(f"{channel.name} [{channel.unit}]" for channel in model.channels))

# %%
# 3. The measurements
# -------------------
#
# The measurements are simulated with known parameters, which the rest of the tutorial uses only for comparison: the
# spring is 15 % stiffer than nominal and the damping 30 % lower. White noise is added. All values inside the library
# are in SI units; other units appear only where data are read or plotted.

truth = np.array([1.15, 0.7, to_si(0.02, "g"), to_si(0.5, "cm")])  # stiffness, damping, levels of the noise
clean = model.simulate(truth[:2])
noise = truth[2:, None] * np.random.default_rng(1).standard_normal(clean.shape)
measured = Measurements(model.channels, model.dt, clean + noise, "SYNTHETIC: a linear oscillator plus white noise")
plot_histories(measured).savefig("measurements.png")

# %%
# 4. Prior, likelihood, posterior
# -------------------------------
#
# The prior describes what was known before the measurement: stiffness and damping are positive and have their nominal
# values with standard deviations of 30 % and 50 %; the noise levels have half-normal priors with scales of 0.1 g and
# 3 cm. The likelihood compares the response with the measurements, with one unknown noise standard deviation per
# channel. The posterior is a function of four numbers, and this function is all that a sampler needs.

prior = {
    "stiffness": TruncatedNormal(1.0, 0.3),
    "damping": TruncatedNormal(1.0, 0.5),
    "sigma_acceleration": HalfNormal(to_si(0.1, "g").item()),
    "sigma_displacement": HalfNormal(to_si(3.0, "cm").item()),
}
posterior = Posterior(FELikelihood(model, measured), prior)
nominal = [1.0, 1.0, *truth[2:]]
print(f"log-probability at the nominal values {posterior(nominal):.1f}, at the true values {posterior(truth):.1f}")

# %%
# 5. Sampling
# -----------
#
# `SMCSampler` takes the arguments of `emcee.EnsembleSampler`. It starts from the prior and anneals the likelihood until
# it reaches the posterior, so it needs no initial guess, and it returns the evidence. The verdict says what the result
# is worth. Tutorial 04 compares samplers, and tutorial 05 makes do with a few hundred simulations.

sampler = SMCSampler(500, posterior.ndim, posterior, vectorize=True, seed=1)
sampler.run_mcmc(None, 4)
samples = sampler.get_chain(flat=True)
print(sampler.verdict)
print(summary(samples, posterior.parameters, sampler.mean_error(), sampler.sd_error()))
plot_corner(samples, posterior, truths=truth).savefig("corner.png")

# %%
# 6. Before and after the update
# ------------------------------
#
# RRMSE is the relative root-mean-square error of a channel. After the update, only the noise is left.

theta = {"nominal values": np.ones(2), "posterior mean": samples.mean(axis=0)[:2]}
plot_fit(measured, {title: model.simulate(values) for title, values in theta.items()}, title="").savefig("fit.png")

# %%
# 7. Prediction
# -------------
#
# Every sample is one oscillator that is consistent with the data. Together, the samples give a band at each time; with
# the noise of the sensors included, the 90 % band should contain 90 % of the measured samples. The same samples predict
# the response to an earthquake that was not used: here the peak displacement and its uncertainty.

band = propagate(posterior, samples[::5], noise=True, seed=1, progress=False)
figure = plot_bands(band, measured)
for axes in figure.axes:
    axes.set_xlim(4.0, 14.0)
figure.savefig("prediction.png")
coverage = band.score(measured).coverage
print("measured samples in the 90 % band: " + ", ".join(f"{100 * share:.0f} %" for share in coverage))

another = problems.isolated_bridge_data().record.scale(0.5)
future = propagate(posterior, samples[::5], quantity=peak("displacement"), record=another, progress=False)
low, middle, high = (from_si(future.quantile(p), "cm").item() for p in (0.05, 0.5, 0.95))
print(f"peak displacement under {another.name!r}: median {middle:.2f} cm, 90 % interval {low:.2f} to {high:.2f} cm")
