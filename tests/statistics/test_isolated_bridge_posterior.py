"""The isolated bridge sampled by annealing: the truth is found, and two modes get their known masses.

Slow. ``SEED`` is the sampler's. Tutorial 03 samples the same bridge by TMCMC among the slow tests, and with a guide
among the quick ones. The step of integration is 1 ms, and the data were made with 0.05 ms.
"""

import os

import numpy as np
import pytest

from fe_likelihoods import problems
from fe_likelihoods.likelihood.posterior import Posterior
from samplers import SMCSampler
from tests.scipy_bridge import exchange_piers

pytestmark = pytest.mark.slow

SEED = int(os.environ.get("SEED", "1"))
WALKERS = 150


def sampled(data: str) -> tuple[Posterior, np.ndarray]:
    """The posterior and the walkers of a run of SMC from the prior, (WALKERS, 11)."""
    posterior = problems.isolated_bridge(data=data, step=1e-3)
    sampler = SMCSampler(WALKERS, posterior.ndim, posterior, vectorize=True, seed=SEED)
    sampler.run_mcmc(None, 1)
    print(f"\n{data}: {posterior.report()['simulations']} simulations, {sampler.verdict.status}")
    return posterior, sampler.get_chain(flat=True)


def test_the_truth_is_found():
    posterior, samples = sampled("twin")
    values = problems.isolated_bridge_data("twin").attributes["truth"]
    truth = np.array([values[name] for name in posterior.parameter_names])
    z = (samples.mean(axis=0) - truth) / samples.std(axis=0)
    print(np.round(z, 2), samples[:, -1].mean())
    assert np.all(np.abs(z) < 3.0), z
    assert samples[:, -1].mean() == pytest.approx(0.05, rel=0.03)


def exact_weight(samples: np.ndarray, posterior: Posterior) -> float:
    """Of the first mode, from samples of the larger mode alone: the masses are as the prior's densities."""
    model = posterior.likelihood.model
    first = samples[:, 1] < samples[:, 4]
    larger = first if first.mean() > 0.5 else ~first
    inside = samples[larger]
    other = np.column_stack([exchange_piers(model, inside[:, :10]), inside[:, 10]])
    ratio = float(np.mean(np.exp(posterior.log_prior(other) - posterior.log_prior(inside))))
    return 1.0 / (1.0 + ratio) if first.mean() > 0.5 else ratio / (1.0 + ratio)


def test_two_modes_have_the_masses_of_the_prior():
    """The share with the larger increment of friction at pier 2, as in the truth."""
    posterior, samples = sampled("means")
    exact, weight = exact_weight(samples, posterior), np.mean(samples[:, 1] < samples[:, 4])
    print(f"weight of the first mode {weight:.3f}, exact {exact:.3f}")
    assert abs(weight - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / WALKERS)
