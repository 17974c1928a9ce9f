"""Annealing without a sampler: a generator of populations and reports, which whoever consumes it may stop or show."""

import numpy as np
import pytest

from samplers import SMCSampler
from samplers.estimates.importance import EvidenceCheck
from samplers.judgement import rounds as judged
from samplers.moves.fast_parameters import WithFastSweeps
from samplers.moves.population_moves import MixtureMove
from samplers.reports import AnnealingResult, Restart, Stage, Sweep
from samplers.settings import Settings
from samplers.tempering.anneal import anneal
from samplers.tempering.mutation import MoveSchedule
from samplers.tempering.pending_points import PendingPoints
from samplers.tempering.population import Population
from samplers.tempering.recycling import recycle
from tests.contract.targets import Box, Gaussian

N = 100


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
        return PendingPoints.known(coords, self.evaluate(coords))

    def wait(self, most):
        pass


def steps_of(settings, n=N, seed=1):
    """Steps of a seeded annealing of a sharp Gaussian, and its density."""
    posterior, random = Gaussian(3, sd=0.02), np.random.RandomState(seed)
    density = CountedDensity(posterior)
    start = Population(0.0, posterior.sample_prior(n, random), None, float(n))
    schedule = MoveSchedule([MixtureMove()], np.ones(1))
    return anneal(start, density, random, schedule, settings), density


@pytest.mark.parametrize("recycle", [False, True])
def test_pairs_of_population_and_report(recycle):
    steps, density = steps_of(Settings(recycle=recycle))
    steps = list(steps)
    assert all(isinstance(population, Population) for population, _ in steps)
    stages = [report for _, report in steps if isinstance(report, Stage)]
    assert [stage.beta for stage in stages] == sorted({stage.beta for stage in stages})
    for population, report in steps:
        if isinstance(report, Stage):
            assert population.beta == report.beta
            assert population.effective_sample_size == report.effective_sample_size
    (check,) = [report for _, report in steps if isinstance(report, EvidenceCheck)]
    last, _ = steps[-1]
    assert last.beta == 1.0 and last.coords.shape == (N, 3) and last.log_weights is None
    assert len(last.founders[0]) == N
    value, error = AnnealingResult(tuple(stages), check).evidence
    assert abs(value - density.posterior.log_evidence) < 5 * error + 0.1


def test_sweeps_after_recycling_use_its_last_proposal(monkeypatch):
    """A mixture fitted to the points that it moves would make their tails too light."""
    found = []

    def watched(*arguments):
        found.append((yield from recycle(*arguments)))
        return found[-1]

    monkeypatch.setattr("samplers.tempering.anneal.recycle", watched)
    posterior, random, move = Gaussian(3, sd=0.02), np.random.RandomState(1), MixtureMove()
    start = Population(0.0, posterior.sample_prior(250, random), None, 250.0)
    moves = WithFastSweeps(move, [2])
    list(anneal(start, CountedDensity(posterior), random, MoveSchedule([moves], np.ones(1)), Settings(recycle=True)))
    assert found[0].reliable and move.mixture is found[0].proposals[-1][1]


def test_the_weights_of_recycling_estimate_the_evidence():
    """The share of a round of draws does not depend on its own weights, so their sum has the mean of the evidence."""
    posterior, deviations = Gaussian(3, sd=0.02), []
    for seed in range(20):
        random = np.random.RandomState(seed)
        density = CountedDensity(posterior)
        flight = density.submit(posterior.sample_prior(250, random))
        found = finished(recycle(flight, density, random))
        deviations.append(np.logaddexp.reduce(found.log_weights) - posterior.log_evidence)
    error = np.std(deviations, ddof=1) / np.sqrt(len(deviations))
    assert error < 0.02 and abs(np.mean(deviations)) < 4.0 * error


def finished(generator):
    """What a generator returns."""
    while True:
        try:
            next(generator)
        except StopIteration as stop:
            return stop.value


def test_a_restart_makes_earlier_stages_void(monkeypatch):
    """Here no check can ever agree, so recycling gives up at beta = 1, and moves start from the prior again."""
    monkeypatch.setattr(judged, "LARGEST_DIFFERENCE", -np.inf)
    reports = [report for _, report in steps_of(Settings(recycle=True))[0] if not isinstance(report, Sweep)]
    (place,) = [i for i, report in enumerate(reports) if isinstance(report, Restart)]
    assert "fresh draws lower the log-evidence" in reports[place].reason
    before, after = reports[:place], [report for report in reports[place:] if isinstance(report, Stage)]
    assert before and all(stage.moves == 0 for stage in before)
    assert after[0].beta < 1.0 and after[-1].beta == 1.0 and all(stage.moves > 0 for stage in after)


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
