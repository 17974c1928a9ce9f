"""Simulation-based calibration: over draws of the prior and of data, the truth is one more draw of the posterior.

Among independent draws of the posterior, the rank of theta is uniform, parameter by parameter, and so is the rank of
the log-likelihood. Talts, Betancourt, Simpson, Vehtari & Gelman (2018), arXiv:1804.06788; Modrak et al. (2023),
doi:10.1214/23-BA1404 (which functions).
"""

import numpy as np
import pytest
from scipy import stats

from samplers import SMCSampler, TMCMCSampler
from samplers.presets import RAMANCHA_2022_LITERAL

SAMPLERS = {
    "SMC": (SMCSampler, {}),
    "SMC, moves only": (SMCSampler, {"recycle": False}),
    "TMCMC": (TMCMCSampler, {}),
    "SMC, literal": (SMCSampler, RAMANCHA_2022_LITERAL),
}
DRAWS, BINS = 19, 10
NOISE = 0.3


class Linear:
    """Data are a linear function of standard normal parameters, plus white noise that is taken to be of sd `noise`."""

    ndim = 2
    matrix = np.array([[1.0, 0.5], [0.3, -1.0], [0.8, 0.2]])

    def __init__(self, data: np.ndarray, noise: float):
        self.data, self.noise = data, noise

    def log_prior(self, x):
        return np.sum(stats.norm.logpdf(x), axis=-1)

    def log_likelihood(self, x):
        return np.sum(stats.norm.logpdf(self.data, x @ self.matrix.T, self.noise), axis=-1)

    def __call__(self, x):
        return self.log_prior(x) + self.log_likelihood(x)

    def sample_prior(self, n, random):
        return random.standard_normal((n, self.ndim))


def p_values(name, seed, repeats, nwalkers, noise=NOISE):
    """Probability of ranks as uneven as these or more, for each parameter and the log-likelihood."""
    Sampler, settings = SAMPLERS[name]
    ranks = np.empty((repeats, Linear.ndim + 1), dtype=int)
    for k in range(repeats):
        rng = np.random.default_rng([seed, list(SAMPLERS).index(name), k])
        theta = rng.standard_normal(Linear.ndim)
        posterior = Linear(Linear.matrix @ theta + NOISE * rng.standard_normal(3), noise)
        sampler = Sampler(
            nwalkers,
            posterior.ndim,
            posterior,
            vectorize=True,
            seed=rng.integers(2**32, size=4),
            **settings,
        )
        sampler.run_mcmc(None, 1)
        # few of many walkers: copies are seldom among them
        draws = rng.choice(sampler.get_chain()[-1], size=DRAWS, replace=False)
        functions = np.column_stack([draws, posterior.log_likelihood(draws)])
        ranks[k] = np.sum(functions < [*theta, posterior.log_likelihood(theta)], axis=0)
    counts = [np.bincount(column * BINS // (DRAWS + 1), minlength=BINS) for column in ranks.T]
    return np.array([stats.chisquare(count).pvalue for count in counts])


@pytest.mark.slow
@pytest.mark.parametrize("name", SAMPLERS)
def test_ranks_are_uniform(name, seed):
    assert np.min(p_values(name, seed, repeats=150, nwalkers=100)) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_noise_is_caught(factor, seed):
    """Negative control: a likelihood that believes the data too much, or too little."""
    assert np.min(p_values("SMC, moves only", seed, repeats=60, nwalkers=80, noise=factor * NOISE)) < 1e-4
