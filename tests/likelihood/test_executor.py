"""Points that threads evaluate: the bits of a call of the posterior, and nothing waits for a long run."""

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
from fe_likelihoods.simulation.failure_reasons import ChangedModel
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


def submit(posterior, x):
    """Futures of points (n, ndim)."""
    executor = posterior.executor()
    return [executor.submit(posterior, row) for row in x]


def values(futures):
    return np.array([future.result(SECONDS) for future in futures])


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
    assert posterior.executor().n_workers in (1, 2, None)
    np.testing.assert_array_equal(values(submit(posterior, x)), expected)
    np.testing.assert_array_equal(values(submit(posterior, x)), expected)  # from memory
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
    np.testing.assert_array_equal(values(submit(again, x)), expected)  # from the disk
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
        executor = posterior.executor()
        long = executor.submit(posterior, LONG[0])
        for row in SHORT[:3]:
            executor.submit(posterior, row).result(SECONDS)
        assert not long.done()
        other = LONG[0] * [1.0, 1.0, 1.1]  # another noise
        same = submit(posterior, [LONG[0], other])
        (tmp_path / "go").touch()
        assert long.result(SECONDS) == same[0].result(SECONDS) == posterior(LONG[0])
        assert same[1].result(SECONDS) == posterior(other) and posterior.likelihood.simulations == 4


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
        assert posterior.executor().n_workers == {2: 3, 1: 2, 0: 1}[sum(pooled)]
        np.testing.assert_array_equal(values(submit(posterior, x)), expected)
    assert posterior.report()["simulations"] == reference.report()["simulations"]


class Changing(Treacherous):
    """A model whose fingerprint can be computed again."""

    factor = 1.0

    def current_fingerprint(self):
        return f"{self.factor}"

    fingerprint = property(current_fingerprint)


def test_a_model_that_has_changed_ends_the_run(monkeypatch):
    monkeypatch.setattr("fe_likelihoods.cache.verification.SHARE_OF_TIME", np.inf)  # compared before every batch
    with ThreadPoolExecutor(2) as pool:
        posterior = posterior_of(Changing(), pool=pool)
        values(submit(posterior, SHORT[:2]))
        posterior.likelihood.model.factor = 2.0
        with pytest.raises(ChangedModel):
            values(submit(posterior, SHORT[2:]))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_killed_process_has_stored_what_has_ended(tmp_path):
    """SIGKILL while one point runs: a later run simulates that point only."""
    path, x = tmp_path / "cache.sqlite", np.concatenate([LONG[:1], SHORT])

    def run():
        with ThreadPoolExecutor(2) as pool:
            values(submit(posterior_of(Gated(tmp_path), pool=pool, cache=path), x))

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


def test_an_interrupt_loses_no_run_that_has_ended(tmp_path):
    path = tmp_path / "cache.sqlite"
    with LocalPool(2) as pool:
        posterior = posterior_of(Gated(tmp_path), pool=pool, cache=path)
        stored, key = SimulationCache(path), posterior.likelihood.simulator.simulation_key

        def interrupt():
            wait_until(lambda: all(each is not None for each in look_up(stored, key, SHORT[:, :2], 1)))
            os.kill(os.getpid(), signal.SIGINT)

        thread = threading.Thread(target=interrupt)
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            posterior(np.concatenate([LONG[:1], SHORT]))
        thread.join()
        assert posterior.likelihood.simulations == len(SHORT)
