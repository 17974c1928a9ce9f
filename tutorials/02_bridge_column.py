"""
Updating a reinforced-concrete bridge column
============================================

A nonlinear fiber finite-element model of a full-scale bridge column is updated with the acceleration and the
displacement of its top: five structural parameters and two noise levels. Model, priors and likelihood are from
Ramancha, Astroza, Conte, Restrepo & Todd (2022), "Bayesian nonlinear finite element model updating of a full-scale
bridge-column using sequential Monte Carlo". Their measurements are not public: **the data are synthetic**, ten seconds
of a motion that cracks the column, computed by a finer model. ::

    python tutorials/02_bridge_column.py

A test of your own is updated with the command line (:doc:`/own_column`).
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import plot_fit, plot_hysteresis, plot_section, problems
from samplers import SMCSampler, compare_models, plot_corner, plot_run, summary

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# Data, model and posterior
# -------------------------
#
# ``problems.bridge_column`` combines the parts: the model; normal priors, truncated at zero, on multiples of five
# nominal values; half-normal priors on the noise levels; and a Gaussian likelihood.

posterior = problems.bridge_column(data="short")
data, model = posterior.likelihood.measurements, posterior.likelihood.model
truth = list(problems.bridge_column_data("short").attributes["truth"].values())
print(data.description)
print(f"{data.n_steps} samples at {data.dt:g} s of {', '.join(channel.name for channel in data.channels)}")
for parameter in posterior.parameters:
    prior = posterior.prior.distributions[parameter.name]
    mean, sd = (parameter.shown(value) for value in prior.moments)
    print(f"{parameter.label:<30} {type(prior).__name__}, mean {mean:.3g}, standard deviation {sd:.3g}")
plot_section(model).figure.savefig("section.png")

# %%
# Sampling
# --------
#
# Without a guide, SMC anneals from the prior to the posterior with more than ten thousand simulations. The guide finds
# the posterior by Gauss-Newton steps on the responses, fits emulators of the responses there, and proposes draws. Every
# draw is simulated by the model itself and weighted, so the result belongs to the model; the number of walkers is the
# effective sample size that the run shall reach.

sampler = SMCSampler(50, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide())
sampler.run_mcmc(None, 1)
print(sampler.verdict)
samples = sampler.get_chain(flat=True)
print(summary(samples, posterior.parameters, sampler.mean_error(), sampler.sd_error()))
means = samples.mean(axis=0)
print("(mean - truth) / sd: " + ", ".join(f"{z:+.1f}" for z in (means - truth) / samples.std(axis=0)))
plot_run(sampler).savefig("run.png")

# %%
# The posterior
# -------------
#
# The figure shows thousands of draws of the emulated posterior, which the simulated draws have confirmed. The red lines
# mark the values with which the synthetic data were made. The dotted prior is flat where it is much wider than the
# posterior.

draws = sampler.signed_sample.draw(4000, seed=1)
plot_corner(draws, posterior, truths=truth).savefig("corner.png")

# %%
# The response before and after the update
# ----------------------------------------
#
# RRMSE is the relative root-mean-square error of a channel. At the right is the strongest part of the motion.

points = {"Before updating (nominal values)": np.ones(5), "After updating (posterior mean)": means[:5]}
responses = {title: model.simulate(theta) for title, theta in points.items()}
plot_fit(data, responses, title="synthetic data").savefig("fit.png")
plot_hysteresis(model, means[:5]).savefig("hysteresis.png")

# %%
# Two model classes
# -----------------
#
# The paper does not state how concrete softens in tension. The evidence compares the updated model with one whose
# concrete is nearly brittle in tension. The data were made with softening.

concrete = replace(model.concrete, softening_strain=0.1 * model.concrete.softening_strain)
brittle = problems.bridge_column(data="short", concrete=concrete)
other = SMCSampler(50, brittle.ndim, brittle, vectorize=True, seed=1, guide=brittle.guide())
other.run_mcmc(None, 1)
print(other.verdict)
print(compare_models({"as updated": sampler, "brittle in tension": other}).to_string(float_format="{:.5g}".format))
