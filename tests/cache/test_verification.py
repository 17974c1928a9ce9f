"""Rows of a cache are simulated again before they are used: what is compared, when, and what a difference says."""

import logging
import os
import pickle
import sys
import time

import numpy as np
import pytest

from fe_likelihoods import AutoregressiveNoise, FELikelihood, Measurements, SimulationCache
from fe_likelihoods.cache import verification
from fe_likelihoods.cache.verification import StaleCache
from fe_likelihoods.simulation.failure_reasons import ChangedModel, TransientReason
from fe_likelihoods.simulation.model import SimulationFailed
from samplers import SMCSampler
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Hidden, Treacherous, line


class Scaled(Treacherous):
    """Response times a factor that neither fingerprint nor label contains; fails above `limit`; counts its runs."""

    fingerprint = "scaled"
    factor, limit, fault, runs = Hidden(), Hidden(), Hidden(), Hidden()

    def __init__(self, factor=1.0, limit=np.inf, fault=None):
        self.factor, self.limit, self.fault, self.runs = factor, limit, fault, 0

    def __reduce__(self):
        return type(self), (self.factor, self.limit, self.fault)

    def simulate(self, theta):
        self.runs += 1
        if self.fault is not None and theta[0] in self.fault:
            raise SimulationFailed(TransientReason("no licence was free"))
        if theta[0] > self.limit:
            raise SimulationFailed("above the limit")
        return self.factor * line(theta)


def likelihood_of(model, cache, **options):
    values = np.sin(np.arange(1.0 * N_STEPS))[None]
    return FELikelihood(model, Measurements(CHANNELS, DT, values), cache=cache, **options)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache.sqlite"


@pytest.fixture
def thetas(rng):
    return rng.uniform(0.1, 0.9, size=(50, 2))


@pytest.fixture
def filled(path, thetas):
    likelihood_of(Scaled(), path).misfit(thetas)
    return path


# what is compared -----------------------------------------------------------------------------------------------------


def test_a_change_that_no_fingerprint_contains_is_an_error_that_says_what_to_do(filled, thetas):
    likelihood = likelihood_of(Scaled(1.01), filled)
    for _ in range(2):  # it stays an error
        with pytest.raises(StaleCache) as caught:
            likelihood.misfit(thetas[:10])
    row = next(theta for theta in thetas if f"offset = {theta[0]:.17g}, slope = {theta[1]:.17g}" in str(caught.value))
    old, new = (likelihood_of(Scaled(factor), None).misfit(row)[0, 0] for factor in (1.0, 1.01))
    assert f"channel 'a', sum of squared residuals: stored {old:.17g}, simulated again {new:.17g}" in str(caught.value)
    assert "forget(*likelihood.simulator.cache_keys), or give the model a new version= (or depends_on=)" in str(
        caught.value
    )
    assert (likelihood.simulations, likelihood.simulator.cache_hits, len(likelihood.simulator.memory_cache)) == (
        0,
        0,
        0,
    )
    assert likelihood.simulator.verifications == likelihood.model.runs == 1
    likelihood.simulator.cache.forget(*likelihood.simulator.cache_keys)
    np.testing.assert_array_equal(likelihood.misfit(thetas), likelihood_of(Scaled(1.01), None).misfit(thetas))


def test_the_same_model_is_verified_once(filled, thetas):
    likelihood = likelihood_of(Scaled(), filled)
    expected = likelihood_of(Scaled(), None).misfit(thetas)
    np.testing.assert_array_equal(likelihood.misfit(thetas[:1]), expected[:1])
    assert likelihood.simulator.verifications == 2  # the requested row, and the one that was stored last
    np.testing.assert_array_equal(likelihood.misfit(thetas), expected)
    assert likelihood.simulator.verifications == 2
    assert (likelihood.simulations, likelihood.model.runs, likelihood.simulator.disk_hits) == (0, 2, 50)
    assert likelihood.simulator.seconds > 0.0


def test_the_row_that_was_stored_last_is_verified_even_if_it_is_not_requested(filled, thetas):
    """Rows that another model stored under the key, after the rows of this model."""
    other = likelihood_of(Scaled(2.0), filled)
    other.misfit(thetas[:5] + 1.0)
    with pytest.raises(StaleCache, match="stored .*, simulated again"):
        likelihood_of(Scaled(), filled).misfit(thetas)


def test_a_difference_remains_an_error_for_all_rows(filled, thetas):
    """Also for those that are right: a client that tries each point alone must not go on with half of them."""
    other = likelihood_of(Scaled(2.0), filled)
    cache, keys = other.simulator.cache, other.simulator.cache_keys
    cache.discard(thetas[-1:], *keys, generation=cache.generations_of(keys[0])[0])
    other.misfit(thetas[-1:])
    likelihood = likelihood_of(Scaled(), filled)
    runs = []
    for theta in thetas:
        with pytest.raises(StaleCache):
            likelihood.misfit(theta)
        runs.append(likelihood.simulator.verifications)
    assert set(runs) == {1}
    copy = pickle.loads(pickle.dumps(likelihood))
    with pytest.raises(StaleCache):
        copy.misfit(thetas[:1])
    likelihood.misfit(thetas[:1] + 1.0)  # a new simulation


@pytest.mark.parametrize("vectorize", [False, True])
@pytest.mark.parametrize("error", [StaleCache("stale"), ChangedModel("changed")], ids=["stale", "changed"])
def test_samplers_stop(error, vectorize):
    """Instead of counting points as failures and going on with the others."""
    calls = []

    def log_prob(x):
        calls.append(len(x))
        if sum(calls) > 100:
            raise error
        return -0.5 * np.sum(np.square(x), axis=-1)

    start = np.random.default_rng(0).uniform(-5.0, 5.0, size=(60, 2))
    prior = dict(log_prior_fn=lambda x: np.where(np.all(np.abs(x) < 5.0, axis=-1), -2 * np.log(10.0), -np.inf))
    sampler = SMCSampler(60, 2, log_prob, vectorize=vectorize, seed=1, **prior)
    with pytest.raises(type(error), match=str(error)):
        sampler.run_mcmc(start, 2)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.ends_run) == (str(error), True)


@pytest.mark.parametrize(
    ("before", "now", "text"),
    [
        (0.0, np.inf, r"failed \(above the limit\); simulated again, it succeeded.*forget"),
        (np.inf, 0.0, r"succeeded; simulated again, it failed \(above the limit"),
    ],
)
def test_a_failure_that_succeeds_now_or_the_reverse_is_a_difference(path, thetas, before, now, text):
    likelihood_of(Scaled(limit=before), path).misfit(thetas)
    with pytest.raises(StaleCache, match=text):
        likelihood_of(Scaled(limit=now), path).misfit(thetas)


def test_failures_that_fail_again_verify_no_successful_row(path, thetas):
    """A changed model often fails where the earlier one did."""
    thetas = thetas[np.argsort(thetas[:, 0])]
    failed = thetas[:, 0] > 0.3
    likelihood_of(Scaled(limit=0.3), path).misfit(thetas)  # the one that is stored last is a failure
    for first in (thetas, thetas[failed], thetas[failed][:1]):
        with pytest.raises(StaleCache, match="sum of squared residuals"):
            likelihood_of(Scaled(1.01, limit=0.3), path).misfit(first)
    own = likelihood_of(Scaled(limit=0.3), path)
    own.misfit(thetas[failed])
    assert own.simulator.verifications == 2


def test_failures_alone_leave_the_first_verification_to_successful_rows(path, thetas):
    failing, succeeding = thetas[thetas[:, 0] > 0.5], thetas[thetas[:, 0] <= 0.5]
    likelihood_of(Scaled(limit=0.5), path).misfit(failing)
    likelihood = likelihood_of(Scaled(1.01, limit=0.5), path)
    likelihood.misfit(failing)
    likelihood_of(Scaled(limit=0.5), path).misfit(succeeding)
    with pytest.raises(StaleCache):
        likelihood.misfit(succeeding)


def test_a_model_that_is_not_repeatable_is_named(path, thetas):
    class Noisy(Scaled):
        def simulate(self, theta):
            vars(sys)["runs of tests"] = vars(sys).get("runs of tests", 0) + 1
            return super().simulate(theta) * (1.0 + 1e-6 * vars(sys)["runs of tests"])

    likelihood_of(Noisy(), path).misfit(thetas)
    with pytest.raises(StaleCache, match="does not repeat its results.* tolerance="):
        likelihood_of(Noisy(), path).misfit(thetas)


def test_failures_for_other_measurements_are_verified(path, thetas):
    likelihood_of(Scaled(limit=0.0), path).misfit(thetas)
    with pytest.raises(StaleCache, match="simulated again, it succeeded"):
        likelihood_of(Scaled(), path, noise=AutoregressiveNoise(CHANNELS)).misfit(thetas)


def test_stored_responses_are_verified(path, thetas):
    likelihood_of(Scaled(), path).simulate(thetas)
    same = likelihood_of(Scaled(), path, noise=AutoregressiveNoise(CHANNELS))
    same.misfit(thetas)
    assert (same.simulations, same.simulator.verifications) == (0, 2)
    with pytest.raises(StaleCache, match="sum of squared residuals"):
        likelihood_of(Scaled(1.01), path, noise=AutoregressiveNoise(CHANNELS)).simulate(thetas)


# tolerance ------------------------------------------------------------------------------------------------------------


def test_small_differences_are_accepted_up_to_the_tolerance(filled, thetas):
    likelihood_of(Scaled(1.0 + 1e-11), filled).misfit(thetas)
    with pytest.raises(StaleCache) as caught:
        likelihood_of(Scaled(1.0 + 1e-7), filled).misfit(thetas)
    assert "is accepted with SimulationCache(path, tolerance=" in str(caught.value)
    stated = 2.0 * float(str(caught.value).partition("(relative: ")[2].partition(")")[0])
    assert 1e-9 < stated < 1e-6
    likelihood_of(Scaled(1.0 + 1e-7), SimulationCache(filled, tolerance=stated)).misfit(thetas)


# when -----------------------------------------------------------------------------------------------------------------


def test_one_of_every_hundred_rows_is_verified(path, rng):
    thetas = rng.uniform(0.1, 0.9, size=(350, 2))
    likelihood_of(Scaled(), path).misfit(thetas)
    likelihood = likelihood_of(Scaled(), path, memory_rows=0)
    for start in range(0, 350, 10):
        likelihood.misfit(thetas[start : start + 10])
    assert likelihood.simulator.verifications == 2 + 3
    in_one_call = likelihood_of(Scaled(), path)
    in_one_call.misfit(thetas)
    assert in_one_call.simulator.verifications == 2 + 3
    likelihood.model.factor = 2.0
    with pytest.raises(StaleCache, match="Discard this run, which has used 3[0-9]0 rows"):
        for start in range(0, 100, 10):
            likelihood.misfit(thetas[start : start + 10])


def test_a_simulation_that_is_stopped_is_not_a_difference(filled, thetas, caplog):
    """Another row is verified in its place; the first of them is the one that was stored last."""
    likelihood = likelihood_of(Scaled(fault=thetas[-1:, 0]), filled)
    likelihood.misfit(thetas)
    assert (likelihood.simulator.verifications, likelihood.simulator.unverified) == (2, 1)
    assert "1 of 3 stored simulations could not be verified" in caplog.text
    assert likelihood.simulator.failures.count == 0


def test_verified_again_when_simulations_end(filled, thetas):
    likelihood = likelihood_of(Scaled(1.01, fault=thetas[:, 0]), filled, memory_rows=0)
    likelihood.misfit(thetas)
    likelihood.model.fault = None
    with pytest.raises(StaleCache):
        for _ in range(2):  # until 100 rows were used
            likelihood.misfit(thetas)


def test_rows_are_used_if_no_simulation_ends(filled, thetas, caplog):
    likelihood = likelihood_of(Scaled(fault=thetas[:, 0]), filled, memory_rows=0)
    likelihood.misfit(thetas)
    likelihood.misfit(thetas[:40])
    assert likelihood.simulator.verifications == 0
    assert likelihood.simulator.unverified == verification.FIRST_ROWS + 1  # and no more for a while
    warnings = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert sum("could not be verified" in text for text in warnings) == 1


def test_rows_that_the_same_likelihood_has_stored_are_not_verified(path, thetas):
    likelihood = likelihood_of(Scaled(), path, memory_rows=0)
    likelihood.simulate(thetas[:20])
    likelihood.misfit(thetas[20:])
    likelihood.misfit(thetas)
    derived = likelihood.with_noise(AutoregressiveNoise(CHANNELS))
    derived.misfit(thetas[:20])
    assert (likelihood.simulator.verifications, derived.simulator.verifications) == (0, 0)
    assert likelihood.simulator.disk_hits == 50
    other = likelihood_of(Scaled(), path, memory_rows=0)
    other.misfit(thetas)
    other.with_noise(likelihood.noise).misfit(thetas)
    assert (other.simulator.verifications, other.simulations) == (2, 0)


# copies ---------------------------------------------------------------------------------------------------------------


def test_a_process_verifies_once_for_all_copies_of_a_likelihood(filled, thetas):
    data = pickle.dumps(likelihood_of(Scaled(), filled))
    verification._trust.cache_clear()  # as in a new process
    copies = [pickle.loads(data) for _ in range(3)]  # as for the tasks of a pool
    for copy in copies:
        copy.misfit(thetas[:20])
        copy.misfit(thetas[:20])
    assert [copy.simulator.verifications for copy in copies] == [2, 0, 0]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_fork_while_another_thread_verifies_does_not_block(filled, thetas):
    likelihood = likelihood_of(Scaled(), filled)
    with likelihood.simulator._trust.lock:
        child = os.fork()
        if not child:
            likelihood.misfit(thetas)
            os._exit(likelihood.simulator.verifications)
        for _ in range(200):
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                break
            time.sleep(0.05)
    assert os.waitstatus_to_exitcode(status) == 2
