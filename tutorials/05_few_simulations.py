"""
Few simulations: an isolated bridge with a guide
================================================

A rigid deck on two flexible piers is shaken on a table. Between deck and piers are sliding bearings with
velocity-dependent friction, rubber devices and fluid dampers. Ten multiples of nominal values are updated with a few
hundred simulations instead of tens of thousands, because a guide sees the responses and not only log-probabilities.
The system follows the shake-table tests of Tsopelas et al. (1994, report NCEER-94-0002). **The data are synthetic and
the nominal values are assumed.** ::

    python tutorials/05_few_simulations.py
"""

import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import peak, problems, propagate
from samplers import SMCSampler, plot_marginals

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# The bridge and its sensors
# --------------------------
#
# Six channels are measured: displacement and force of a bearing, drift and shear of a pier, the acceleration of a pier,
# and the displacement of the other bearing. The noise is 5 % of the root mean square of each channel.

whole = problems.isolated_bridge(step=1e-3)
model, measured = whole.likelihood.model, whole.likelihood.measurements
print(f"{measured.n_steps} samples at {measured.dt:g} s of {', '.join(c.name for c in measured.channels)}")

# %%
# One parameter fewer
# -------------------
#
# A change of the noise level needs no simulation. ``marginal()`` integrates the noise levels by quadrature: posterior
# and evidence are the same, and ten parameters are sampled instead of eleven.

posterior = whole.marginal()
print("parameters: " + ", ".join(posterior.parameter_names))

# %%
# A run with a guide
# ------------------
#
# The guide finds the modes by Gauss-Newton steps on the responses, fits emulators of the responses there, and proposes
# draws. Every draw is simulated by the model and weighted, so the result does not depend on the guide being right.
# The number of walkers is the effective sample size at which the run ends. ``max_simulations=`` limits the cost; after
# a run that was limited, a larger limit continues where it stopped, and with ``cache="simulations.db"`` no simulation
# is repeated in another process either. Every step of the chain costs simulations, so one is made.

sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1, guide=posterior.guide())
sampler.run_mcmc(None, 1)

# %%
# The verdict says what the run is worth. The guide cannot see a mode to which none of its starts leads: the last
# sentence of the verdict says how large a part of the starts such a mode would attract. It fails where the response is
# not a smooth function of the parameters; the run then says so, and annealing without a guide remains
# (:doc:`/few_simulations`).

print(sampler.verdict)

# %%
# The posterior
# -------------
#
# The chain has a hundred draws. Expectations by ``signed_sample`` are more accurate, because the emulated posterior is
# known at thousands of points, which the simulated draws correct. The dotted lines in the figure are the prior: where
# they are close to the posterior, the data say little about a parameter.

stored = problems.isolated_bridge_data("twin").attributes["truth"]
truth = {name: stored[name] for name in posterior.parameter_names}  # the noise levels are integrated out
signed = sampler.signed_sample
mean, sd = signed.expectation(), signed.standard_deviation()
for i, (name, true) in enumerate(truth.items()):
    print(f"{name:<8} truth {true:.3f}, mean {mean.value[i]:.4f} +- {mean.error[i]:.4f}, sd {sd.value[i]:.4f}")
draws = signed.draw(4000, seed=1)
figure = plot_marginals(draws, posterior, truths=list(truth.values()))
figure.suptitle("synthetic data, assumed nominal values")
figure.savefig("marginals.png")

# %%
# Prediction
# ----------
#
# Uncertain parameters can have a certain response: parameters that the data do not determine hardly matter for what was
# measured. Under another motion the draws predict the peak displacement of a bearing, which the devices must follow.

chain = sampler.get_chain(flat=True)
motion = problems.table_motion(101)
future = propagate(posterior, chain, quantity=peak("Ub_1"), record=motion, from_state="virgin", progress=False)
low, middle, high = 1e3 * np.array([future.quantile(p) for p in (0.05, 0.5, 0.95)]).ravel()
print(f"peak of Ub_1 under another motion: {middle:.1f} mm, 90 % interval {low:.1f} to {high:.1f} mm")
