"""Recycling without a sampler, and the moves of a likelihood with one value."""

import numpy as np
import pytest

from samplers import SMCSampler
from samplers.tempering.population import PendingPoints
from samplers.tempering.recycling import recycle
from tests.contract.targets import Box, Gaussian


class CountedDensity:
    """The smallest object that annealing accepts."""

    map, workers = map, 0

    def __init__(self, posterior):
        self.posterior, self.evaluations = posterior, 0

    def inside(self, coords):
        return np.isfinite(self.posterior.log_prior(coords))

    def evaluate(self, coords, then=lambda coords, records: records):
        self.evaluations += len(coords)
        records = np.zeros(len(coords), dtype=[("log_prob", float), ("log_prior", float)])
        records["log_prob"], records["log_prior"] = self.posterior(coords), self.posterior.log_prior(coords)
        return then(coords, records)

    def submit(self, coords):
        records = self.evaluate(coords)
        return PendingPoints(coords, records["log_prior"], records=records)

    def wait(self, most):
        pass


def test_the_weights_of_recycling_estimate_the_evidence():
    """The share of a round of draws does not depend on its own weights, so their sum has the mean of the evidence."""
    posterior, deviations = Gaussian(3, sd=0.02), []
    for seed in range(20):
        random = np.random.RandomState(seed)
        density = CountedDensity(posterior)
        flight = density.submit(posterior.sample_prior(250, random))
        found = finished(recycle(flight, 250, density, random))
        deviations.append(np.logaddexp.reduce(found.points.log_weights) - posterior.log_evidence)
    error = np.std(deviations, ddof=1) / np.sqrt(len(deviations))
    assert error < 0.02 and abs(np.mean(deviations)) < 4.0 * error


def finished(generator):
    """What a generator returns."""
    while True:
        try:
            next(generator)
        except StopIteration as stop:
            return stop.value


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_the_constant_of_a_likelihood_with_one_value_has_no_effect():
    """Rounding errors of a constant log-likelihood are no correlation with the start, which would end the moves."""
    found = []
    for value in (0.0, 0.1, -123.4):
        posterior = Box([0, 0], [1, 1], lambda x, value=value: np.where(np.all(x < 0.4, axis=-1), value, -np.inf))
        sampler = SMCSampler(100, 2, posterior, vectorize=True, seed=1, recycle=False)
        sampler.run_mcmc(None, 1)
        found.append((sampler.get_chain(), [stage.moves for stage in sampler.ladder], sampler.log_evidence - value))
    chain, moves, log_evidence = found[0]
    for each in found[1:]:
        assert np.array_equal(each[0], chain) and each[1] == moves
        assert each[2] == pytest.approx(log_evidence, abs=1e-12)
