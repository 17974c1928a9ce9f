"""Heavy tails: recycling keeps the variance of posteriors whose tails are heavier than the tails of its mixtures."""

import numpy as np
import pytest
from scipy import integrate, stats

from samplers import SMCSampler
from samplers.moves.population_moves import MixtureMove
from samplers.proposals import mixture

SCALE = 0.5


class StudentProduct:
    """Prior t3 (scale 3) times likelihood t2 (scale 0.5) in each parameter: no ellipse follows its corners."""

    def __init__(self, ndim: int):
        self.ndim = ndim

    def log_prior(self, x):
        return np.sum(stats.t.logpdf(x, 3.0, scale=3.0), axis=-1)

    def __call__(self, x):
        return self.log_prior(x) + np.sum(stats.t.logpdf(x, 2.0, scale=SCALE), axis=-1)

    def sample_prior(self, n, random):
        return 3.0 * random.standard_t(3.0, size=(n, self.ndim))

    def moments(self):
        """Log-evidence and variance of a parameter, by quadrature."""

        def density(x, power):
            return x**power * stats.t.pdf(x, 3.0, scale=3.0) * stats.t.pdf(x, 2.0, scale=SCALE)

        zero, two = (2.0 * integrate.quad(density, 0.0, np.inf, args=(power,))[0] for power in (0, 2))
        return self.ndim * np.log(zero), two / zero


def mean_squares(seeds, ndim=2, nwalkers=250):
    """Mean squares of the chain's first step over the truth, and deviations of log Z in stated errors, per run."""
    posterior = StudentProduct(ndim)
    log_evidence, variance = posterior.moments()
    squares, deviations = [], []
    for seed in seeds:
        sampler = SMCSampler(nwalkers, ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 1)
        squares.append(np.mean(sampler.get_chain(flat=True) ** 2) / variance)
        deviations.append((sampler.log_evidence - log_evidence) / sampler.log_evidence_error)
    return np.array(squares), np.array(deviations)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_recycling_keeps_the_variance_of_heavy_tails(seed):
    squares, deviations = mean_squares(1000 * seed + np.arange(200))
    error = squares.std(ddof=1) / np.sqrt(len(squares))
    print(squares.mean(), error, deviations.mean(), deviations.std())
    assert error < 0.03  # a deficit of 12 % would be seen
    assert abs(squares.mean() - 1.0) < 4.0 * error
    assert abs(deviations.mean()) < 0.5 and 0.5 < deviations.std() < 1.3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_light_proposals_that_are_fitted_to_their_points_cut_heavy_tails(seed, monkeypatch):
    """Negative control: six degrees of freedom, and sweeps by a fit to the points that they move."""
    monkeypatch.setattr(mixture, "HEAVIER", mixture.DOF)
    calibrate = MixtureMove.calibrate
    monkeypatch.setattr(MixtureMove, "calibrate", lambda *fit: calibrate(*fit[:4]))  # without the proposal
    squares, _ = mean_squares(1000 * seed + np.arange(200))
    error = squares.std(ddof=1) / np.sqrt(len(squares))
    print(squares.mean(), error)
    assert squares.mean() < 1.0 - 4.0 * error
