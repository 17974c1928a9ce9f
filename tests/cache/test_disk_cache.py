"""Cache on disk: one simulation serves every noise, sampler and run, and an outdated value is never used."""

import dataclasses
import multiprocessing
import os
import pickle
import signal
import threading
from multiprocessing.pool import ThreadPool

import numpy as np
import pytest

from fe_likelihoods.cache.simulation_cache import SimulationCache
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.priors.distributions import HalfNormal, TruncatedNormal, Uniform
from fe_likelihoods.signals.channels import Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation import label
from tests.cache.stored import look_up, store, stored_outcomes
from tests.lines import Batched, Line

SINE = np.sin(np.arange(50.0))


def likelihood_of(model, cache=None, data=1.0, **kwargs):
    measured = Measurements(model.channels, model.dt, np.full((2, model.n_steps), data))
    return FELikelihood(model, measurements=measured, cache=cache, **kwargs)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "cache.sqlite"


@pytest.fixture
def thetas(rng):
    """Three hundred points, of which about fifty fail."""
    return np.column_stack([rng.normal(size=300), rng.uniform(0.0, 1.2, size=300)])


# hits and misses ------------------------------------------------------------------------------------------------------


def test_another_run_simulates_nothing(path, thetas):
    first = likelihood_of(Line(), path)
    expected = likelihood_of(Line()).misfit(thetas)
    np.testing.assert_array_equal(first.misfit(thetas), expected)
    assert (first.simulations, first.simulator.cache_hits, first.simulator.disk_hits) == (300, 0, 0)
    second = likelihood_of(Line(), path)
    np.testing.assert_array_equal(second.misfit(thetas), expected)
    assert (second.simulations, second.simulator.cache_hits, second.simulator.disk_hits) == (0, 300, 300)
    np.testing.assert_array_equal(second.misfit(thetas), expected)
    assert (second.simulations, second.simulator.cache_hits, second.simulator.disk_hits) == (0, 600, 300)
    assert second.model.runs == second.simulator.verifications == 2 + 3
    assert second.simulator.failures.records == first.simulator.failures.records
    assert second.simulator.failures.reasons == first.simulator.failures.reasons
    info = second.simulator.cache.info()
    assert (info.path, info.simulations, info.responses) == (path, 300, 0)
    assert info.failures == first.simulator.failures.count > 20


def test_a_batch_of_several_queries(path, rng):
    thetas = np.column_stack([rng.normal(size=2345), np.full(2345, 0.5)])
    likelihood_of(Line(), path).misfit(thetas[::2])
    likelihood = likelihood_of(Line(), path)
    np.testing.assert_array_equal(likelihood.misfit(thetas), likelihood_of(Line()).misfit(thetas))
    assert (likelihood.simulations, likelihood.simulator.disk_hits) == (1172, 1173)


# what the key depends on ---------------------------------------------------------------------------------------------


def oscillator(path, **changes):
    options = {"record": SINE, "dt": 0.02, "period": 0.6, "damping": 0.05, "data": 1.0, "channels": None} | changes
    model = LinearOscillator(Record("sine", options["dt"], options["record"]), options["period"], options["damping"])
    values = np.ones((2, 50))
    values[1, 7] = options["data"]
    channels = options["channels"] or model.channels
    return FELikelihood(model, Measurements(channels, model.dt, values), cache=path)


@pytest.mark.parametrize(
    "change",
    [
        {"record": np.where(np.arange(50) == 30, np.nextafter(SINE, 2.0), SINE)},
        {"dt": 0.02 * (1 + 1e-15)},
        {"period": np.nextafter(0.6, 1.0)},
        {"damping": np.nextafter(0.05, 1.0)},
        {"data": np.nextafter(1.0, 2.0)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_change_of_anything_the_misfit_depends_on_needs_a_simulation(path, change):
    theta = [[1.1, 0.9]]
    oscillator(path).misfit(theta)
    changed = oscillator(path, **change)
    np.testing.assert_array_equal(changed.misfit(theta), oscillator(None, **change).misfit(theta))
    assert (changed.simulations, changed.simulator.disk_hits) == (1, 0)
    again = oscillator(path)
    again.misfit(theta)
    assert (again.simulations, again.simulator.disk_hits) == (0, 1)


def test_other_code_of_the_library_is_verified_and_adopted(path, monkeypatch, rng):
    thetas = rng.uniform(0.5, 1.5, size=(80, 2))
    oscillator(path).misfit(thetas)
    monkeypatch.setattr(label, "sources_digest", lambda: b"other code")
    same = oscillator(path)
    same.misfit(thetas)
    assert (same.simulations, same.simulator.disk_hits, same.simulator.verifications) == (0, 80, 59)


def test_noise_prior_and_display_units_change_nothing(path):
    x = np.array([[1.1, 0.9, 0.2, 0.005], [0.8, 1.3, 0.1, 0.001]])
    names = ("stiffness", "damping", "sigma_acceleration", "sigma_displacement")
    wide = [TruncatedNormal(1.0, 0.3), TruncatedNormal(1.0, 0.6), HalfNormal(0.3), HalfNormal(0.005)]
    narrow = [Uniform(0.5, 2.0), Uniform(0.0, 2.0), HalfNormal(3.0), Uniform(0.0, 1.0)]
    Posterior(oscillator(path), dict(zip(names, wide, strict=True))).log_prob(x)
    other = Posterior(oscillator(path), dict(zip(names, narrow, strict=True)))
    other.log_prob(x * [1.0, 1.0, 2.0, 3.0])
    assert other.report()["simulations"] == 0
    assert (other.report()["cache_hits"], other.report()["disk_hits"]) == (2, 2)
    channels = tuple(dataclasses.replace(c, unit={"g": "m/s2", "cm": "in"}[c.unit]) for c in LinearOscillator.channels)
    shown = oscillator(path, channels=channels)
    shown.misfit(x[:, :2])
    assert shown.simulations == 0


# failures, bounds, other files ----------------------------------------------------------------------------------------


def test_a_success_replaces_a_failure(path):
    theta, cache = np.array([[0.0, 0.5]]), SimulationCache(path)
    for reason, known in (("fails", ["fails"]), ("", np.ones((1, 2)))):
        store(cache, "f", theta, np.ones((1, 2)), [reason])
        np.testing.assert_array_equal(look_up(SimulationCache(path), "f", theta, 2), known)


def test_reasons_of_any_kind(path):
    cache = SimulationCache(path)
    reasons = ["x" * 10_000, "nul \0 byte", "lone surrogate \udc80", ""]
    thetas = np.arange(8.0).reshape(4, 2)
    store(cache, "f", thetas, np.full((4, 2), np.nan), reasons)
    *found, last = look_up(SimulationCache(path), "f", thetas, 2)
    assert found == ["x" * 2000 + " ...", "nul \0 byte", "lone surrogate \\udc80"] and np.isnan(last).all()


def test_forget_deletes_the_simulations_of_one_model(path, thetas):
    keep, forgotten = oscillator(path), likelihood_of(Line(), SimulationCache(path, responses=True))
    keep.misfit([[1.1, 0.9]])
    forgotten.misfit(thetas)
    stored = forgotten.simulator.cache.info()
    assert (
        forgotten.simulator.cache.forget(*forgotten.simulator.cache_keys)
        == stored.simulations - 1 + stored.responses + stored.failures
    )
    assert (forgotten.simulator.cache.info().simulations, forgotten.simulator.cache.info().responses) == (1, 0)
    again = oscillator(path)
    again.misfit([[1.1, 0.9]])
    assert again.simulator.disk_hits == 1


REFUSED = {
    "max_response_bytes": (0, -1, 2.5, None, True),
    "tolerance": (-1e-9, np.nan, np.inf),
    "memory_rows": (-1, 2.5, None, True),
    "memory_bytes": (-1, 1.5, None, True),
}


@pytest.mark.parametrize("option", REFUSED)
def test_impossible_options_are_refused(path, option):
    for value in REFUSED[option]:
        with pytest.raises(ValueError, match=f"{option} must be"):
            if option.startswith("memory"):
                likelihood_of(Line(), **{option: value})
            else:
                SimulationCache(path, **{option: value})
    assert not path.exists()


# chunks ---------------------------------------------------------------------------------------------------------------


def test_finished_chunks_of_an_interrupted_batch_are_stored(path, rng, monkeypatch):
    monkeypatch.setattr("fe_likelihoods.likelihood.simulator._SECONDS_PER_CHUNK", 0.0)

    class Interrupted(Line):
        def simulate(self, theta):
            if self.runs == 7:
                signal.raise_signal(signal.SIGINT)
            return super().simulate(theta)

    thetas = rng.normal(size=(20, 2)) * [1.0, 0.1]
    likelihood = likelihood_of(Interrupted(), path)
    with pytest.raises(KeyboardInterrupt):
        likelihood.misfit(thetas)
    again = likelihood_of(Interrupted(), path)
    again.model.runs = 8
    again.misfit(thetas)
    assert (likelihood.simulations, again.simulator.disk_hits, again.simulations) == (7, 7, 13)


# processes and threads ------------------------------------------------------------------------------------------------


def test_forks_while_threads_write(path, rng):
    """A lock held by another thread, or an inherited connection, would block or break the child."""
    if not hasattr(os, "fork"):
        pytest.skip("NO fork ON THIS SYSTEM")
    cache = SimulationCache(path)
    stop = threading.Event()

    def write():
        own = np.random.default_rng(1)
        while not stop.is_set():
            thetas = own.normal(size=(20, 2))
            store(cache, "f", thetas, thetas, [""] * 20)

    thread = threading.Thread(target=write)
    thread.start()
    context = multiprocessing.get_context("fork")
    try:
        for i in range(5):
            thetas = rng.normal(size=(5, 2))
            process = context.Process(target=store, args=(cache, f"child {i}", thetas, thetas, [""] * 5))
            process.start()
            process.join(60)
            assert process.exitcode == 0
            np.testing.assert_array_equal(look_up(cache, f"child {i}", thetas, 2), thetas)
    finally:
        stop.set()
        thread.join()
    assert cache.file.connection().execute("PRAGMA integrity_check").fetchall() == [(b"ok",)]


def test_threads_share_a_cache(path, rng):
    likelihood = likelihood_of(Line(), path, memory_rows=50)
    thetas = rng.normal(size=(60, 2)) * [1.0, 0.3]
    expected = likelihood_of(Line()).misfit(thetas)
    batches = [np.arange(start, start + 20) % 60 for start in range(0, 400, 7)]
    with ThreadPool(4) as pool:
        results = pool.map(lambda rows: likelihood.misfit(thetas[rows]), batches)
    for rows, misfit in zip(batches, results, strict=True):
        np.testing.assert_array_equal(misfit, expected[rows])
    assert likelihood.simulator.cache.info().simulations == 60


def test_pickles_by_path(tmp_path, monkeypatch, thetas):
    monkeypatch.chdir(tmp_path)
    cache = SimulationCache("relative.sqlite", max_response_bytes=1000, tolerance=1e-6)
    likelihood = likelihood_of(Line(), cache, memory_rows=0)
    likelihood.misfit(thetas)
    data = pickle.dumps(likelihood)
    assert len(data) < 6500
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    copy = pickle.loads(data)
    assert copy.simulator.cache.path == tmp_path / "relative.sqlite"
    settings = copy.simulator.cache
    assert (settings.max_response_bytes, settings.tolerance) == (1000, 1e-6)
    copy.misfit(thetas)
    assert (copy.simulations, copy.simulator.disk_hits) == (likelihood.simulations, 300)


# responses ------------------------------------------------------------------------------------------------------------


def test_responses_are_bounded(path, rng):
    bytes_each = 2 * 8 * 8
    cache = SimulationCache(path, responses=True, max_response_bytes=10 * bytes_each)
    thetas = rng.normal(size=(25, 2)) * [1.0, 0.1]
    likelihood = likelihood_of(Batched(np.inf), cache)
    likelihood.misfit(thetas[:14])
    likelihood.misfit(thetas[14:])
    assert (cache.info().responses, cache.info().response_bytes) == (10, 10 * bytes_each)
    kept = [response is not None for response in stored_outcomes(cache, Batched(np.inf), thetas)]
    assert kept == [False] * 15 + [True] * 10
    assert cache.info().simulations == 25
