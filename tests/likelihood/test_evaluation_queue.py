"""Points that are submitted and collected: the bits of a call of the posterior, and nothing waits for a long run."""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.pool import ThreadPool
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.joint import JointLikelihood
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.priors.distributions import HalfNormal, Uniform
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.faults import ChangedModel
from tests.cache.stored import look_up
from tests.faults.treacherous import Gated, Treacherous, posterior_of

SECONDS = 60.0  # after which a test gives up
LONG = np.array([[0.95, 0.1, 0.5], [0.96, 0.1, 0.5]])
SHORT = np.column_stack([np.linspace(0.1, 0.8, 12), np.full(12, 0.1), np.full(12, 0.5)])
ROOT = Path(__file__).parents[2]


def wait_until(condition):
    stop = time.monotonic() + SECONDS
    while not condition():
        assert time.monotonic() < stop, "it does not happen"
        time.sleep(0.01)


def collect(queue, tickets):
    """Values of points in the order of their tickets."""
    values = {}
    while len(values) < len(tickets):
        values.update(queue.collect())
    return np.array([values[ticket] for ticket in tickets])


def one_by_one(posterior, x):
    return np.array([posterior(row[None])[0] for row in x])


def points(posterior, n=40):
    """Draws of the prior, a duplicate, points outside the prior, and one with an impossible noise."""
    x = posterior.sample_prior(n, 1)
    x[4] = x[3]
    x[5, 0], x[6, 2], x[7, 1] = 99.0, -1.0, np.nan
    return x


class Mapping:
    """A pool with ``map`` only."""

    def map(self, function, items):
        return [function(item) for item in items]


POOLS = {
    "None": lambda: None,
    "local": lambda: LocalPool(2),
    "threads": lambda: ThreadPoolExecutor(2),
    "ThreadPool": lambda: ThreadPool(2),
    "multiprocessing": lambda: multiprocessing.get_context("spawn").Pool(1),
    "map only": Mapping,
}


@pytest.mark.parametrize("make", POOLS.values(), ids=POOLS)
def test_values_are_those_of_single_points_on_every_pool(make, tmp_path):
    x = points(posterior_of(Treacherous(), top=1.2))
    expected = one_by_one(posterior_of(Treacherous(), top=1.2), x)
    assert np.isneginf(expected).sum() >= 4  # runs that fail among them
    pool = make()
    posterior = posterior_of(Treacherous(), top=1.2, pool=pool, cache=tmp_path / "cache.sqlite")
    with posterior.evaluation_queue() as queue:
        assert queue.workers in (1, 2, None)
        tickets = queue.submit(x[:25]) + queue.submit(x[25:])
        np.testing.assert_array_equal(collect(queue, tickets), expected)
        with pytest.raises(RuntimeError, match="no point is pending"):
            queue.collect()
        known = queue.submit(x)
        np.testing.assert_array_equal(collect(queue, known), expected)  # from memory
        assert not set(known) & set(tickets)
    assert posterior.likelihood.simulations == 36
    np.testing.assert_array_equal(posterior(x), expected)
    synchronous = posterior_of(Treacherous(), top=1.2, pool=pool, cache=tmp_path / "other.sqlite")
    np.testing.assert_array_equal(synchronous(x), expected)
    assert synchronous.report()["failure_reasons"] == posterior.report()["failure_reasons"]
    assert (
        synchronous.likelihood.simulator.cache.info().simulations
        == posterior.likelihood.simulator.cache.info().simulations
        == 36
    )
    again = posterior_of(Treacherous(), top=1.2, pool=pool, cache=tmp_path / "cache.sqlite")
    with again.evaluation_queue() as queue:
        np.testing.assert_array_equal(collect(queue, queue.submit(x)), expected)  # from the disk
    assert again.likelihood.simulations == 0 < again.likelihood.simulator.verifications < 3  # by the order of arrival
    assert again.likelihood.simulator.disk_hits in (36, 37)  # the duplicate may find its point in memory
    for end in ("terminate", "shutdown", "close"):
        if hasattr(pool, end):
            getattr(pool, end)()
            break


def test_points_come_back_while_others_are_submitted(tmp_path, shared_pool):
    """New points go to the free worker, and duplicates of a running point are simulated once."""
    with shared_pool(2) as pool:
        posterior = posterior_of(Gated(tmp_path), pool=pool)
        with posterior.evaluation_queue() as queue:
            (long,) = queue.submit(LONG[:1])
            for row in SHORT[:3]:
                (ticket,) = queue.submit(row[None])
                assert [done for done, _ in queue.collect()] == [ticket]
            other = LONG[:1] * [1.0, 1.0, 1.1]  # another noise
            same = queue.submit(np.concatenate([LONG[:1], other]))
            (tmp_path / "go").touch()
            values = {}
            while len(values) < 3:
                values.update(queue.collect())
        assert posterior.likelihood.simulations == 4
        assert values[long] == values[same[0]] == posterior(LONG[0])
        assert values[same[1]] == posterior(other[0])


def oscillator(seed, **options):
    model = LinearOscillator(Record("noise", 0.02, np.random.default_rng(seed).normal(size=100)), period=0.6)
    return FELikelihood(model, Measurements(model.channels, 0.02, np.ones((2, 100))), **options)


@pytest.mark.parametrize("pooled", [(True, True), (True, False), (False, False)], ids=str)
def test_a_joint_likelihood_simulates_later_parts_where_earlier_ones_are_possible(pooled):
    def posterior_with(pools):
        parts = {key: oscillator(seed, pool=pool) for seed, (key, pool) in enumerate(zip("ab", pools, strict=True))}
        joint = JointLikelihood(parts)
        priors = {name: Uniform(0.1, 30.0) for name in joint.parameter_names[:2]}
        priors |= {name: HalfNormal(1.0) for name in joint.parameter_names[2:]}
        return Posterior(joint, priors)

    reference = posterior_with([None, None])
    x = reference.sample_prior(30, 3)
    x[:, :2] = np.where(np.arange(30)[:, None] % 3 == 0, 25.0, 1.0 + 0.01 * np.arange(30)[:, None])  # some fail
    expected = one_by_one(reference, x)
    assert 0 < np.isneginf(expected).sum() < 30
    with ThreadPoolExecutor(2) as one, ThreadPoolExecutor(1) as two:
        posterior = posterior_with([pool if use else None for pool, use in zip((one, two), pooled, strict=True)])
        with posterior.evaluation_queue() as queue:
            assert queue.workers == {2: 3, 1: 2, 0: 1}[sum(pooled)]
            np.testing.assert_array_equal(collect(queue, queue.submit(x)), expected)
    assert posterior.report()["simulations"] == reference.report()["simulations"]


class Changing(Treacherous):
    """A model whose fingerprint can be computed again."""

    factor = 1.0

    def current_fingerprint(self):
        return f"{self.factor}"

    fingerprint = property(current_fingerprint)


def test_a_model_that_has_changed_ends_the_run(monkeypatch):
    monkeypatch.setattr("fe_likelihoods.cache.verification.NO_TIME", np.inf)  # compared before every batch
    with ThreadPoolExecutor(2) as pool:
        posterior = posterior_of(Changing(), pool=pool)
        with posterior.evaluation_queue() as queue:
            collect(queue, queue.submit(SHORT[:2]))
            posterior.likelihood.model.factor = 2.0
            queue.submit(SHORT[2:])
            with pytest.raises(ChangedModel):
                for _ in SHORT:
                    queue.collect()


def test_a_closed_queue_cancels_what_waits_and_caches_what_runs(tmp_path, shared_pool):
    path = tmp_path / "cache.sqlite"
    with shared_pool(1) as pool:
        posterior = posterior_of(Gated(tmp_path), pool=pool, cache=path)
        queue = posterior.evaluation_queue()
        queue.submit(np.concatenate([LONG[:1], SHORT]))
        wait_until(lambda: (tmp_path / f"started {LONG[0, 0]!r}").exists())
        queue.close()
        queue.close()
        with pytest.raises(RuntimeError, match="no point is pending"):
            queue.collect()
        (tmp_path / "go").touch()
        stored, key = SimulationCache(path), posterior.likelihood.simulator.simulation_key
        wait_until(lambda: look_up(stored, key, LONG[:1, :2], 1)[0] is not None)
        assert not any(each is not None for each in look_up(stored, key, SHORT[:, :2], 1))
        assert posterior.likelihood.simulations == 1
        np.testing.assert_array_equal(posterior(SHORT), posterior_of(Treacherous())(SHORT))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_killed_queue_has_stored_what_has_ended(tmp_path):
    """SIGKILL while one point runs: a later run simulates that point only."""
    path, x = tmp_path / "cache.sqlite", np.concatenate([LONG[:1], SHORT])

    def run():
        with ThreadPoolExecutor(2) as pool:
            queue = posterior_of(Gated(tmp_path), pool=pool, cache=path).evaluation_queue()
            queue.submit(x)
            while True:
                queue.collect()

    process = multiprocessing.get_context("fork").Process(target=run)
    process.start()
    again = posterior_of(Gated(tmp_path), cache=path)
    stored, key = SimulationCache(path), again.likelihood.simulator.simulation_key
    wait_until(lambda: all(each is not None for each in look_up(stored, key, SHORT[:, :2], 1)))
    process.kill()
    process.join(SECONDS)
    assert process.exitcode == -signal.SIGKILL
    (tmp_path / "go").touch()
    np.testing.assert_array_equal(again(x), posterior_of(Treacherous())(x))
    assert (again.likelihood.simulations, again.likelihood.simulator.disk_hits) == (1, len(SHORT))


@pytest.mark.parametrize("asynchronous", [True, False], ids=["queue", "call"])
def test_an_interrupt_loses_no_run_that_has_ended(asynchronous, tmp_path):
    path = tmp_path / "cache.sqlite"
    with LocalPool(2) as pool:
        posterior = posterior_of(Gated(tmp_path), pool=pool, cache=path)
        stored, key = SimulationCache(path), posterior.likelihood.simulator.simulation_key

        def interrupt():
            wait_until(lambda: all(each is not None for each in look_up(stored, key, SHORT[:, :2], 1)))
            os.kill(os.getpid(), signal.SIGINT)

        x = np.concatenate([LONG[:1], SHORT])
        thread = threading.Thread(target=interrupt)
        thread.start()
        with posterior.evaluation_queue() as queue:
            with pytest.raises(KeyboardInterrupt):
                if asynchronous:
                    tickets, values = queue.submit(x), {}
                    while len(values) < len(x):
                        values.update(queue.collect())
                else:
                    posterior(x)
            thread.join()
            if asynchronous:  # it can go on
                (tmp_path / "go").touch()
                while len(values) < len(x):
                    values.update(queue.collect())
                np.testing.assert_array_equal([values[ticket] for ticket in tickets], posterior(x))
        assert posterior.likelihood.simulations == len(x) - (not asynchronous)


def test_wrong_shapes_are_refused():
    queue = posterior_of(Treacherous()).evaluation_queue()
    with pytest.raises(ValueError, match=r"expected points of shape \(n, 3\); got shape \(3,\)"):
        queue.submit(SHORT[0])
    assert queue.submit(np.empty((0, 3))) == []


def test_without_a_pool_points_that_are_submitted_twice_are_simulated_once():
    posterior = posterior_of(Treacherous())
    x = posterior.sample_prior(6, np.random.default_rng(3))
    with posterior.evaluation_queue() as queue:
        values = collect(queue, queue.submit(x) + queue.submit(x[:4]))
    assert posterior.report()["simulations"] == 6
    expected = posterior.log_prob(x)
    np.testing.assert_array_equal(values, np.concatenate([expected, expected[:4]]))
