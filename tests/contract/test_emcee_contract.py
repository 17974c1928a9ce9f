"""emcee's contract of a sampler: the same tests for its sampler and ours, in memory and in HDF5."""

import inspect
import multiprocessing
import pickle
from concurrent.futures import CancelledError, Future
from multiprocessing.pool import ThreadPool

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.tempered import TemperedSampler
from tests.contract.targets import Gaussian
from tests.covering import covering

N, STEPS = 24, 8
SAMPLERS = [emcee.EnsembleSampler, SMCSampler, TMCMCSampler]
every = pytest.mark.parametrize("Sampler", SAMPLERS, ids=lambda s: s.__name__)
stored = pytest.mark.parametrize(
    ("Sampler", "make_backend"), covering(SAMPLERS, ["memory", "hdf5"], strength=1), indirect=["make_backend"]
)


@pytest.fixture
def make_backend(request, tmp_path):
    """A function that opens the backend, the same one in each call within a test."""
    memory = emcee.backends.Backend()

    def make():
        return memory if request.param == "memory" else emcee.backends.HDFBackend(str(tmp_path / "chain.h5"))

    return make


def start(posterior, seed=1):
    return posterior.sample_prior(N, np.random.default_rng(seed))


def run(Sampler, backend=None, posterior=None, **kwargs):
    posterior = posterior or Gaussian()
    np.random.seed(7)  # noqa: NPY002  emcee takes its state from the global generator
    sampler = Sampler(N, posterior.ndim, posterior, backend=backend, **kwargs)
    sampler.run_mcmc(start(posterior), STEPS)
    return sampler


def parameters(function, keep):
    return [
        (p.name, p.default, p.kind)
        for p in inspect.signature(function).parameters.values()
        if p.kind is not p.KEYWORD_ONLY and p.name in keep
    ]


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler, TemperedSampler])
def test_signatures_are_emcees(Sampler):
    deprecated = {"a", "postargs", "threads", "live_dangerously", "runtime_sortingfn"}
    theirs = inspect.signature(emcee.EnsembleSampler).parameters
    keep = set(theirs) - deprecated
    assert parameters(Sampler, keep) == parameters(emcee.EnsembleSampler, keep)
    ours = inspect.signature(Sampler).parameters
    assert [p.name for p in ours.values() if p.kind is p.POSITIONAL_OR_KEYWORD] == [n for n in theirs if n in keep]
    for name in ("sample", "run_mcmc", "reset", "compute_log_prob", "get_chain", "get_last_sample"):
        mine, yours = getattr(Sampler, name), getattr(emcee.EnsembleSampler, name)
        assert [(p.name, p.default) for p in inspect.signature(mine).parameters.values()] == [
            (p.name, p.default) for p in inspect.signature(yours).parameters.values()
        ], name


@stored
def test_what_is_stored(Sampler, make_backend):
    sampler = run(Sampler, make_backend())
    assert sampler.get_chain().shape == (STEPS, N, 3)
    assert sampler.get_log_prob().shape == (STEPS, N)
    assert sampler.get_chain(flat=True).shape == (STEPS * N, 3)
    assert sampler.get_chain(discard=3).shape == (STEPS - 3, N, 3)
    assert sampler.get_chain(discard=2, thin=2, flat=True).shape == (3 * N, 3)
    assert sampler.get_blobs() is None
    assert sampler.iteration == STEPS
    assert sampler.acceptance_fraction.shape == (N,)
    assert np.all((sampler.acceptance_fraction >= 0) & (sampler.acceptance_fraction <= 1))
    assert sampler.get_autocorr_time(quiet=True).shape == (3,)
    state = sampler.get_last_sample()
    assert np.array_equal(state.coords, sampler.get_chain()[-1])
    assert np.array_equal(state.log_prob, sampler.get_log_prob()[-1])
    chain = sampler.get_chain(flat=True)
    assert np.allclose(sampler.get_log_prob(flat=True), Gaussian()(chain), rtol=1e-13)


@stored
def test_thin_by_and_store(Sampler, make_backend):
    posterior = Gaussian()
    sampler = Sampler(N, 3, posterior, backend=make_backend())
    sampler.run_mcmc(start(posterior), 4, thin_by=3)
    assert sampler.get_chain().shape == (4, N, 3)
    unstored = Sampler(N, 3, posterior)
    assert isinstance(unstored.run_mcmc(start(posterior), 3, store=False), emcee.State)
    with pytest.raises(AttributeError):
        unstored.get_chain()


class Fragile(Gaussian):
    """Raises an exception in a small part of the prior."""

    def __call__(self, x):
        if np.any(x[..., 0] < 0.0) and np.any(x[..., 1] > 0.3):
            raise ZeroDivisionError("no stiffness left")
        return np.where(x[..., 0] < 0.0, -np.inf, super().__call__(x))[()]


class Broken(Gaussian):
    """Raises an exception everywhere."""

    def __call__(self, x):
        raise TypeError("no such argument")


def of_names(x, density=Gaussian(3)):
    return density(np.array([x["x0"], *(x["rest"] if "rest" in x else (x["x1"], x["x2"]))]))


def prior_of_names(x):
    return of_names(x, Gaussian(3).log_prior)


@every
@pytest.mark.parametrize("names", [["x0", "x1", "x2"], {"x0": 0, "rest": [1, 2]}], ids=["list", "groups"])
def test_parameter_names(Sampler, names):
    extra = {} if Sampler is emcee.EnsembleSampler else {"log_prior_fn": prior_of_names}
    sampler = Sampler(N, 3, of_names, parameter_names=names, **extra)
    sampler.run_mcmc(start(Gaussian()), STEPS)
    assert np.allclose(sampler.get_log_prob(flat=True), Gaussian()(sampler.get_chain(flat=True)))


@every
def test_seed_pool_and_vectorize_give_the_same_chain(Sampler):
    chain = run(Sampler).get_chain()
    assert np.array_equal(run(Sampler).get_chain(), chain)
    assert np.array_equal(run(Sampler, vectorize=True).get_chain(), chain)
    for workers in (1, 3):
        with ThreadPool(workers) as pool:
            assert np.array_equal(run(Sampler, pool=pool).get_chain(), chain)


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_a_pool_of_processes(Sampler):
    """The same chain, and an exception in a worker affects one point only."""
    chain = run(Sampler).get_chain()
    fragile = Fragile()
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert np.array_equal(run(Sampler, pool=pool).get_chain(), chain)
        with pytest.warns(SamplingWarning, match="ZeroDivisionError: no stiffness left"):
            sampler = run(Sampler, pool=pool, posterior=fragile)
    assert sampler.failure_count > 0 and sampler.get_chain()[..., 0].min() > 0
    with pytest.warns(SamplingWarning, match="ZeroDivisionError: no stiffness left"):
        alone = run(Sampler, posterior=fragile)
    assert np.array_equal(alone.get_chain(), sampler.get_chain())
    with pytest.warns(SamplingWarning):
        batched = run(Sampler, posterior=fragile, vectorize=True)
    assert np.array_equal(batched.get_chain(), sampler.get_chain())


class Closed:
    """A pool that is closed while it has points."""

    n_workers = 2

    def map(self, function, items):
        raise CancelledError

    def submit(self, function, item):
        (future := Future()).cancel()
        return future


@pytest.mark.parametrize("settings", [{}, {"recycle": True, "asynchronous": True}], ids=["moves", "asynchronous"])
def test_a_pool_that_is_closed_during_a_run(settings):
    with pytest.raises(RuntimeError, match="the pool was closed.*run again with an open pool"):
        run(SMCSampler, pool=Closed(), **settings)


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_a_broken_function_stops_with_its_reason(Sampler):
    with pytest.raises(RuntimeError, match="all 96 evaluations of a batch failed.*TypeError: no such argument"):
        run(Sampler, posterior=Broken())


@stored
def test_pickle(Sampler, make_backend, monkeypatch):
    monkeypatch.setattr("samplers.tempered.KEPT_POINTS", 2 * N)
    with ThreadPool(1) as pool:
        sampler = run(Sampler, make_backend(), pool=pool)
        if Sampler is not emcee.EnsembleSampler:  # emcee's pickling removes the pool from the living sampler
            pickle.dumps(sampler)
            assert sampler.pool is pool
        sampler.pool = None
        copy = pickle.loads(pickle.dumps(sampler))
        assert copy.pool is None
        assert np.array_equal(copy.get_chain(), sampler.get_chain())
        if isinstance(sampler.backend, emcee.backends.HDFBackend):
            return  # both would write to the same file
        first, second = sampler.run_mcmc(None, 3), copy.run_mcmc(None, 3)
        assert np.array_equal(first.coords, second.coords)
        if Sampler is not emcee.EnsembleSampler:
            assert copy.ladder == sampler.ladder and len(copy._record.latest(1000).coords) < 3 * N


@every
def test_arviz_from_emcee(Sampler):
    import arviz

    sampler = run(Sampler)
    data = arviz.from_emcee(sampler, var_names=sampler.log_prob_fn.f.parameter_names)
    assert dict(data["posterior"]["x1"].sizes) == {"chain": N, "draw": STEPS}  # arviz 1 has draws first


@every
def test_progress_bar(Sampler, capfd):
    pytest.importorskip("tqdm")
    posterior = Gaussian()
    Sampler(N, 3, posterior).run_mcmc(start(posterior), 3, progress=True)
    shown = capfd.readouterr().err
    assert "3/3" in shown
    if Sampler is not emcee.EnsembleSampler:
        for word in ("beta=1", "ESS=", "acceptance="):
            assert word in shown, word
    Sampler(N, 3, posterior).run_mcmc(start(posterior), 3)
    assert capfd.readouterr().err == ""


@stored
def test_random_state(Sampler, make_backend):
    sampler = run(Sampler, make_backend())
    kept = sampler.random_state
    state = sampler.get_last_sample()
    for ours, stored in zip(kept, state.random_state, strict=True):
        assert np.all(ours == stored)
    first = sampler.run_mcmc(state, 2, store=False).coords
    sampler.random_state = kept
    assert np.array_equal(sampler.run_mcmc(state, 2, store=False).coords, first)
