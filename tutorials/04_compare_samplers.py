"""
SMC, TMCMC and emcee on the same posterior
==========================================

Three samplers are exchanged by changing one name. The posterior has two modes whose shares and evidence are known: the
two natural frequencies of a frame with two storeys do not say which of its storeys is the stiff one. The tutorial shows
what each sampler needs, what it returns, and where it fails. **The data are synthetic.** ::

    python tutorials/04_compare_samplers.py
"""

import emcee
import matplotlib.pyplot as plt
import numpy as np

from fe_likelihoods import LogNormal, Prior
from samplers import SMCSampler, TMCMCSampler

plt.style.use("fe_likelihoods.plots.tutorials")

# %%
# A posterior with two modes
# --------------------------
#
# With two equal masses, the squares of the circular frequencies are the roots of
# :math:`\lambda^2 - (k_1 + 2 k_2) \lambda + k_1 k_2`. The stiffnesses :math:`(2 k_2, k_1 / 2)` have the same roots as
# :math:`(k_1, k_2)`. The frequencies have errors of 0.4 %. A posterior is a function of the parameters; with
# ``vectorize=True`` it takes arrays (n, 2).

TRUTH = np.array([1.0, 0.9])  # multiples of a nominal stiffness
OTHER = np.array([2.0 * TRUTH[1], 0.5 * TRUTH[0]])
prior = Prior({"k1": LogNormal(1.0, 0.6), "k2": LogNormal(1.0, 0.6)})


def frequencies(theta: np.ndarray) -> np.ndarray:
    """Frequencies (n, 2), without a unit."""
    half, product = 0.5 * theta[:, 0] + theta[:, 1], theta[:, 0] * theta[:, 1]
    root = np.sqrt(np.maximum(half**2 - product, 0.0))
    return np.sqrt(np.column_stack([half - root, half + root]))


measured = frequencies(TRUTH[None])[0] * (1.0 + 0.004 * np.random.default_rng(1).standard_normal(2))


def log_probability(theta: np.ndarray) -> np.ndarray:
    """Normalised log-prior plus log-likelihood (n,)."""
    found = prior.logpdf(theta)
    possible, sd = np.isfinite(found), 0.004 * measured
    z = (frequencies(theta[possible]) - measured) / sd
    found[possible] -= 0.5 * (z**2).sum(axis=1) + np.log(2.0 * np.pi * sd.prod())
    return found


# %%
# The exact answer
# ----------------
#
# Two parameters can be integrated on a grid. The share of a mode is the probability of its side of the line
# :math:`k_1 = 2 k_2`, on which both storeys count as equally stiff.

axis = np.linspace(0.3, 3.0, 1501)
grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
density = np.exp(log_probability(grid))
exact = {
    "evidence": np.log(density.sum() * (axis[1] - axis[0]) ** 2),
    "share": density[grid[:, 0] < 2.0 * grid[:, 1]].sum() / density.sum(),
}
print(f"exact: log evidence {exact['evidence']:.2f}, share of the true mode {exact['share']:.2f}")

# %%
# The same lines for all samplers
# -------------------------------
#
# SMC and TMCMC start from draws of the prior, anneal, and return draws of the posterior: nothing is discarded, and few
# steps are enough. emcee starts near a mode, here from a small ball around the truth, as from the best fit of an
# optimiser, and the first third of its chain is discarded. It returns no evidence.

rng = np.random.default_rng(2)
samplers = {}
for Sampler in (SMCSampler, TMCMCSampler):
    sampler = Sampler(500, 2, log_probability, log_prior_fn=prior.logpdf, vectorize=True, seed=1)
    sampler.run_mcmc(prior.rvs(500, random_state=1), 4)
    samplers[Sampler.__name__.removesuffix("Sampler")] = sampler
    print(f"{Sampler.__name__}: {sampler.evaluations} evaluations. {sampler.describe()}")
np.random.seed(1)  # noqa: NPY002 - emcee uses NumPy's global generator
samplers["emcee"] = emcee.EnsembleSampler(32, 2, log_probability, vectorize=True)
samplers["emcee"].run_mcmc(TRUTH + 0.01 * rng.standard_normal((32, 2)), 3000)
discard = {"SMC": 0, "TMCMC": 0, "emcee": 1000}
tau = samplers["emcee"].get_autocorr_time(discard=1000).max()
print(f"emcee: 96000 evaluations, the kept chain is worth {32 * 2000 / tau:.0f} independent samples")

# %%
# What emcee does not show
# ------------------------
#
# The chain of emcee has a small autocorrelation, and a large effective sample size, in the mode in which it started.
# Nothing in it shows that there is another mode. A sampler that starts from the whole prior finds both with their
# shares; the verdict lists the modes. Its limits are narrow modes that no draw comes near while beta is small
# (:doc:`/which_sampler`).

shares = {}
figure, panels = plt.subplots(1, 3, figsize=(10, 3.6), sharex=True, sharey=True, layout="constrained")
for axes, (name, sampler) in zip(panels, samplers.items(), strict=True):
    points = sampler.get_chain(flat=True, discard=discard[name])
    shares[name] = np.mean(points[:, 0] < 2.0 * points[:, 1])
    axes.plot(*points[rng.permutation(len(points))[:2000]].T, ".", markersize=3, alpha=0.4, markeredgewidth=0)
    axes.plot(*TRUTH, "k+", markersize=11, label="truth")
    axes.plot(*OTHER, "kx", markersize=8, label="the same frequencies")
    axes.set(xlabel="$k_1$ [x nominal]", title=f"{name}: {100 * shares[name]:.0f} % in the true mode")
panels[0].set(ylabel="$k_2$ [x nominal]")
panels[0].legend()
figure.suptitle(f"exact share of the true mode: {100 * exact['share']:.0f} %", fontsize="medium")
figure.savefig("shares.png")
