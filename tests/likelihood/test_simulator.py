"""Simulations of a likelihood: run once, counted, and cached, whether their responses or their statistics are asked."""

import numpy as np
import pytest

from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.models.frames_and_decks import ShearFrame
from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.models.linear_structure import LinearStructure
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.models.rc_column_materials import ColumnAnalysis
from fe_likelihoods.noise.autoregressive import AutoregressiveNoise
from fe_likelihoods.problems import isolated_bridge
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import simulate_batch
from tests.lines import Batched, Line

RECORD = Record("pulse", 0.01, np.sin(np.arange(40) / 3))


def line(theta):
    return theta[0] + theta[1] * np.arange(20.0)[None]


def models():
    column = RCColumn.lhpost(RECORD, analysis=ColumnAnalysis(mesh=10))
    return [
        Line(),
        Batched(),
        FunctionModel(line, ("a", "b"), [Channel("y", "displacement", "m")], 0.1, 20),
        LinearOscillator(RECORD),
        LinearStructure(ShearFrame({"top": 2}, (1.0, 1.0), (900.0, 900.0)), RECORD),
        column,
        isolated_bridge().likelihood.model,
    ]


def likelihood_of(model, noise=None, **kwargs):
    measured = 0.1 * np.sin(np.arange(len(model.channels) * model.n_steps)).reshape(len(model.channels), -1)
    return FELikelihood(model, Measurements(model.channels, model.dt, measured), noise, **kwargs)


def points(likelihood, thetas):
    """With noise parameters."""
    return np.column_stack([thetas, np.full((len(thetas), likelihood.ndim - thetas.shape[1]), 0.3)])


@pytest.fixture
def thetas(rng):
    """Forty points, of which a few fail."""
    return np.column_stack([rng.normal(size=40), rng.uniform(0.0, 1.2, size=40)])


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache.sqlite"


def assert_same_log_likelihood(likelihood, thetas, expected_runs):
    """The log-likelihood needs no simulation, and has the bits of one that has never seen a response."""
    x = points(likelihood, thetas)
    values = likelihood.log_likelihood(x)
    assert likelihood.simulations == expected_runs
    fresh = FELikelihood(likelihood.model, likelihood.measurements, likelihood.noise)
    np.testing.assert_array_equal(values, fresh.log_likelihood(x))


@pytest.mark.parametrize("model", models(), ids=lambda model: type(model).__name__)
@pytest.mark.parametrize("correlated", [False, True])
def test_responses_and_then_log_likelihoods(model, correlated, rng):
    noise = AutoregressiveNoise(model.channels) if correlated else None
    likelihood = likelihood_of(model, noise)
    thetas = rng.uniform(0.7, 0.95, size=(6, len(model.parameter_names)))
    batch = likelihood.simulate(thetas)
    expected = simulate_batch(model, thetas)
    np.testing.assert_array_equal(batch.response, expected.response)
    assert batch.reasons == expected.reasons
    assert np.isfinite(batch.response[:, 0, 0]).any()
    assert likelihood.simulator.failures.count == sum(map(bool, batch.reasons))
    assert_same_log_likelihood(likelihood, thetas, 6)


def test_duplicates_and_rows_that_are_not_finite():
    likelihood = likelihood_of(Line())
    thetas = np.array([[0.0, 0.5], [np.nan, 0.5], [-0.0, 0.5], [1.0, 0.5], [0.0, 0.5], [1.0, 2.0], [1.0, 2.0]])
    batch = likelihood.simulate(thetas)
    assert likelihood.simulations == likelihood.model.runs == 3
    np.testing.assert_array_equal(batch.response[0], batch.response[4])
    np.testing.assert_array_equal(batch.response[3], Line().simulate(thetas[3]))
    assert np.isnan(batch.response[[1, 5, 6]]).all()
    reasons = ["", "the parameters are not finite", "", "", "", Line.reason, Line.reason]
    assert batch.reasons == reasons
    assert likelihood.simulator.failures.reasons == {Line.reason: 1}
    assert likelihood.simulate(thetas[1:2]).reasons == reasons[1:2]
    assert likelihood.simulate(thetas[3]).response.shape == (1, 2, 8)
    empty = likelihood.simulate(np.empty((0, 2)))
    assert empty.response.shape == (0, 2, 8)
    with pytest.raises(ValueError, match="one value for each of the 2 parameters"):
        likelihood.simulate(np.zeros((2, 4)))


def test_a_response_is_simulated_again_and_a_failure_is_not(thetas):
    likelihood = likelihood_of(Line())
    likelihood.misfit(thetas)
    failed = np.isnan(likelihood.misfit(thetas)).any(axis=1)
    assert 0 < failed.sum() == likelihood.simulator.failures.count
    runs, hits = likelihood.simulations, likelihood.simulator.cache_hits
    batch = likelihood.simulate(thetas)
    assert likelihood.simulations == runs + (~failed).sum() == likelihood.model.runs
    assert likelihood.simulator.cache_hits == hits + failed.sum()
    assert likelihood.simulator.failures.count == failed.sum()
    assert [bool(reason) for reason in batch.reasons] == failed.tolist()
    assert np.isnan(batch.response[failed]).all()
    assert np.isfinite(batch.response[~failed]).all()


def test_responses_are_simulated_once(thetas):
    likelihood = likelihood_of(Line())
    batch = likelihood.simulate(thetas[:30])
    batch.response[:] = 0.0  # what is stored is not changed
    again = likelihood.simulate(thetas)
    expected = simulate_batch(Line(), thetas)
    np.testing.assert_array_equal(again.response, expected.response)
    assert again.reasons == expected.reasons
    assert likelihood.simulations == likelihood.model.runs == 40
    assert (likelihood.simulator.cache_hits, likelihood.simulator.disk_hits) == (30, 0)
    assert_same_log_likelihood(likelihood, thetas, 40)


class Shortened(Line):
    """Can be shortened; counts the runs of all its parts."""

    def __init__(self, n_steps=8, log=None):
        self.n_steps, self.log = n_steps, [] if log is None else log
        self.fingerprint = f"line {n_steps}"

    def first(self, seconds):
        return Shortened(1 + round(seconds / self.dt), self.log)

    def simulate(self, theta):
        self.log.append((self.n_steps, *theta))
        self.runs = 0
        return super().simulate(theta)


def test_likelihoods_of_one_model_share_responses(thetas):
    """Another noise, or the same part of the record again, needs no simulation, with the bits of a new one."""
    likelihood = likelihood_of(Shortened())
    batch = likelihood.simulate(thetas)
    short = likelihood.first(2.0)
    expected = short.simulate(thetas)
    assert len(likelihood.model.log) == 80
    other = likelihood.with_noise(AutoregressiveNoise(Line.channels))
    np.testing.assert_array_equal(other.simulate(thetas).response, batch.response)
    third = likelihood.with_noise(AutoregressiveNoise(Line.channels))
    again = likelihood.first(2.0)
    np.testing.assert_array_equal(again.simulate(thetas).response, expected.response)
    for one in (other, third, again):
        assert_same_log_likelihood(one, thetas, 0)
        assert one.simulator.failures.records == likelihood.simulator.failures.records
    assert len({run for run in likelihood.model.log if run[0] == 8}) == 40


def test_responses_in_memory_are_bounded(thetas):
    good = thetas[thetas[:, 1] < 1.0]
    size = 2 * 8 * 8 + 250
    likelihood = likelihood_of(Line(), memory_bytes=10 * size)
    expected = likelihood.simulate(good).response
    assert len(likelihood.simulator.response_memory) == 10
    np.testing.assert_array_equal(likelihood.simulate(good[-10:]).response, expected[-10:])
    assert likelihood.simulations == len(good)
    np.testing.assert_array_equal(likelihood.simulate(good).response, expected)
    assert likelihood.simulations == 2 * len(good) - 10


@pytest.mark.parametrize("model", [Line, Batched])
@pytest.mark.parametrize("responses", [False, True])
def test_the_disk_cache_has_the_rows_of_statistics(model, responses, path, thetas):
    first = likelihood_of(model(), cache=SimulationCache(path, responses=responses))
    batch = first.simulate(thetas)
    assert first.simulator.cache.info().simulations == 40
    assert first.simulator.cache.info().responses == 40 - first.simulator.failures.count
    assert_same_log_likelihood(first, thetas, 40)
    second = likelihood_of(model(), cache=path)
    assert_same_log_likelihood(second, thetas, 0)
    assert second.simulator.failures.records == first.simulator.failures.records
    third = likelihood_of(model(), cache=SimulationCache(path, responses=responses))
    again = third.simulate(thetas)
    np.testing.assert_array_equal(again.response, batch.response)
    assert again.reasons == batch.reasons
    assert third.simulations == third.model.runs - third.simulator.verifications == 0
    assert third.simulator.disk_hits == third.simulator.cache_hits == 40
    assert third.simulator.failures.count == first.simulator.failures.count
    assert_same_log_likelihood(third, thetas, third.simulations)


def test_statistics_from_stored_responses(path, thetas):
    """Another noise, or other measurements: no simulation, and the bits of a new one."""
    first = likelihood_of(Line(), cache=path)
    first.simulate(thetas)
    second = likelihood_of(Line(), AutoregressiveNoise(Line.channels), cache=path)
    assert_same_log_likelihood(second, thetas, 0)
    assert second.simulator.disk_hits == second.simulator.cache_hits == 40
    assert second.simulator.failures.records == first.simulator.failures.records and first.simulator.failures.count > 0
    third = likelihood_of(Line(), AutoregressiveNoise(Line.channels), cache=path)
    first.simulator.cache.file.connection().execute("DELETE FROM rows WHERE size > 0")
    assert_same_log_likelihood(third, thetas, 0)  # the statistics have been stored


def test_known_statistics_are_recalled_without_a_simulation(thetas):
    first = likelihood_of(Line())
    batch, statistics = first.simulate(thetas), first.simulator.statistics(thetas)
    second = likelihood_of(Line())
    rows = np.r_[0, 0, 1:40]
    second.simulator.recall(thetas[rows], statistics[rows], [batch.reasons[row] for row in rows])
    assert_same_log_likelihood(second, thetas, 0)
    assert second.simulations == 0
    assert second.simulator.failures.records == first.simulator.failures.records
    second.simulator.recall(thetas, np.zeros_like(statistics), batch.reasons)  # cached rows are not changed
    np.testing.assert_array_equal(second.simulator.statistics(thetas), statistics)
    assert second.simulator.failures.count == first.simulator.failures.count
