"""How busy the workers of a cluster are, on a simulated clock.

One row per sampler, number of workers and distribution of run lengths: constant, uniform from 0.2 to 2 (over 1.1),
log-normal with a coefficient of variation of 1, and the same as a function of a parameter. If short runs were
preferred, evidence, mean and variance would deviate from the known answers; the deviations are in standard errors over
all seeds.
The clock counts evaluations only; the annealing ends with beta = 1, without steps of the chain.

Runs with a guide are of a vibrating mass (two parameters), whose truth is known by quadrature; their search for modes
from eight starts is part of the time and of the evaluations.
"""

import itertools
import logging
import warnings
from collections.abc import Callable, Iterator
from functools import cache
from typing import NamedTuple

import numpy as np

from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import Gaussian
from tests.emulation.problems import vibration
from tests.simulated_cluster import SimulatedCluster, SimulatedPool

__all__ = ["LENGTHS", "PATHS", "Busy", "measure", "utilisation"]

# the logarithm of a log-normal variable with a coefficient of variation of 1 has this standard deviation
SPREAD = np.sqrt(np.log(2.0))
FARTHEST = 3.0
LENGTHS = ("constant", "uniform", "log-normal", "correlated")
GUIDED = {"guide": False, "guide asynchronous": True}
PATHS = {
    "recycling": (SMCSampler, {"asynchronous": False}),
    "recycling asynchronous": (SMCSampler, {"asynchronous": True}),
    "moves": (SMCSampler, {"recycle": False}),
    "TMCMC": (TMCMCSampler, {}),
}


class Truth(NamedTuple):
    """Log-evidence, and mean and standard deviation (ndim,) of the parameters."""

    log_evidence: float
    mean: np.ndarray
    sd: np.ndarray


class Busy(NamedTuple):
    """Means over seeds.

    Attributes
    ----------
    sampler, lengths : str
        One of `PATHS` or `GUIDED`, and one of `LENGTHS`.
    workers : int
    busy : float
        Share of the time of all workers in which they were busy.
    duration : float
        Time of the annealing, in mean run lengths.
    evaluations : float
    log_Z, mean, variance : float
        Mean deviations of log-evidence, mean and variance of the first parameter, in standard errors of the mean over
        the seeds; None with one seed.
    """

    sampler: str
    lengths: str
    workers: int
    busy: float
    duration: float
    evaluations: float
    log_Z: float | None
    mean: float | None
    variance: float | None


def lengths_of(name: str, target: Gaussian | Truth, random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Run lengths (n,) of points (n, ndim), with mean 1 for the first three names."""

    def correlated(coords: np.ndarray) -> np.ndarray:
        # long runs where the first parameter is large, on the scale of the posterior
        z = np.clip((coords[:, 0] - target.mean[0]) / target.sd[0], -FARTHEST, FARTHEST)
        return np.exp(SPREAD * z - 0.5 * SPREAD**2)

    return {
        "constant": lambda coords: np.ones(len(coords)),
        "uniform": lambda coords: random.uniform(0.2, 2.0, len(coords)) / 1.1,
        "log-normal": lambda coords: random.lognormal(-0.5 * SPREAD**2, SPREAD, len(coords)),
        "correlated": correlated,
    }[name]


@cache
def truth_of_vibration() -> Truth:
    """By quadrature on grids that are narrowed to the posterior."""
    posterior, mean, sd = vibration(), np.array([1.2, 0.8]), np.array([0.02, 0.2])
    for _ in range(6):
        axes = [np.linspace(mean[k] - 7.0 * sd[k], mean[k] + 7.0 * sd[k], 161) for k in range(2)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        log_prob = posterior.log_prob(grid)
        weights = np.exp(log_prob - log_prob.max())
        mean = weights @ grid / weights.sum()
        sd = np.maximum(np.sqrt(weights @ (grid - mean) ** 2 / weights.sum()), 0.1 * sd)
    cell = (axes[0][1] - axes[0][0]) * (axes[1][1] - axes[1][0])
    return Truth(float(log_prob.max() + np.log(weights.sum() * cell)), mean, sd)


def run_with_guide(path: str, lengths: str, workers: int, nwalkers: int, seed: int) -> tuple:
    """Cluster, sampler, points and truth of a run with the guide of a posterior."""
    posterior, truth = vibration(), truth_of_vibration()
    length, n_steps = lengths_of(lengths, truth, np.random.default_rng(seed)), posterior.likelihood.model.n_steps
    posterior.likelihood.simulator.pool = pool = SimulatedPool(workers, lambda theta: length(theta[None])[0], n_steps)
    sampler = SMCSampler(
        nwalkers, 2, posterior, vectorize=True, seed=seed, guide=posterior.guide(), asynchronous=GUIDED[path]
    )
    with pool.clock():
        return pool, sampler, sampler.run_mcmc(None, 0).coords, truth


def run_without_guide(path: str, lengths: str, workers: int, nwalkers: int, ndim: int, seed: int) -> tuple:
    """The same of the annealing of a sharp Gaussian."""
    target, (Sampler, settings) = Gaussian(ndim, sd=0.02), PATHS[path]
    cluster = SimulatedCluster(target, workers, lengths_of(lengths, target, np.random.default_rng(seed)))
    sampler = Sampler(nwalkers, ndim, cluster, vectorize=True, seed=seed, **settings)
    return cluster, sampler, sampler.run_mcmc(None, 0).coords, target


def measure(path: str, lengths: str, workers: int, nwalkers: int, ndim: int, seeds: int) -> Busy:
    """Run with every seed."""
    numbers = []
    for seed in range(seeds):
        if path in GUIDED:
            cluster, sampler, coords, truth = run_with_guide(path, lengths, workers, nwalkers, seed)
        else:
            cluster, sampler, coords, truth = run_without_guide(path, lengths, workers, nwalkers, ndim, seed)
        z = (coords[:, 0] - truth.mean[0]) / truth.sd[0]
        evidence = (sampler.log_evidence - truth.log_evidence) / sampler.log_evidence_error
        numbers.append((cluster.utilisation, cluster.now, sampler.simulations, evidence, z.mean(), z.var() - 1.0))
    numbers = np.array(numbers)
    means = numbers.mean(axis=0)
    deviations = [None] * 3
    if seeds > 1:
        deviations = means[3:] / (numbers[:, 3:].std(axis=0, ddof=1) / np.sqrt(seeds))
    return Busy(path, lengths, workers, *means[:3], *deviations)


def utilisation(
    repeats: int,
    paths: tuple[str, ...] = (*PATHS, *GUIDED),
    lengths: tuple[str, ...] = LENGTHS,
    workers: tuple[int, ...] = (16, 64, 256),
    walkers: int = 500,
    ndim: int = 5,
) -> Iterator[Busy]:
    """One row per sampler, distribution of run lengths and number of workers; a run with each of `repeats` seeds."""
    warnings.simplefilter("ignore")
    logging.disable(logging.WARNING)
    for path, name, n in itertools.product(paths, lengths, workers):
        yield measure(path, name, n, walkers, ndim, repeats)
