"""Asynchronous runs with a guide: killed anywhere they go on, and the record repeats them without a simulation."""

from concurrent.futures import ThreadPoolExecutor

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import Gaussian
from tests.emulation.problems import symmetric
from tests.faults.records import blocks, cut
from tests.simulated_cluster import DelayedPool
from tests.tempering.guides import FixedGuide

N, WORKERS = 40, 12

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


def finished(path, order=0, workers=WORKERS, **settings):
    """A run on two modes, with searches on parts of the record; `order` is the seed of the run lengths."""
    posterior = symmetric()
    likelihood = posterior.likelihood
    likelihood.simulator.pool = pool = DelayedPool(workers, order, likelihood.model.n_steps)
    settings = {"seed": 5, "guide": posterior.guide(4), "asynchronous": True, **settings}
    backend = emcee.backends.HDFBackend(str(path))
    sampler = SMCSampler(N, 2, posterior, vectorize=True, backend=backend, **settings)
    with pool.pool:
        sampler.run_mcmc(None, 1 - sampler.iteration)
    sampler._record.close()
    return sampler, pool


def state_of(sampler):
    """Everything that two runs are compared by."""
    chain = sampler.get_chain().tobytes()
    return chain, sampler.rounds, sampler.log_evidence, sampler.evaluations, sampler.simulations, sampler.verdict


def repeated(path, folder, order):
    """The run of a record without its HDF5 file."""
    cut(path, None, folder / "repeated.h5")
    return finished(folder / "repeated.h5", order)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    return path, *finished(path, order=1)


def test_nothing_is_simulated_twice_and_the_order_of_arrival_decides(whole, tmp_path):
    """The control: other lengths give another run, so that a replay that ignored the order would be noticed."""
    _, sampler, pool = whole
    assert pool.simulations == pytest.approx(sampler.simulations)
    assert state_of(finished(tmp_path / "other.h5", order=2)[0]) != state_of(sampler)


def test_the_record_repeats_a_run_without_a_simulation(whole, tmp_path):
    path, sampler, _ = whole
    again, pool = repeated(path, tmp_path, order=3)
    assert state_of(again) == state_of(sampler) and pool.simulations == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.04, 0.25, 0.5, 0.7, 0.97])
def test_killed_anywhere_a_run_goes_on_and_its_record_repeats_it(whole, tmp_path, share):
    """In the search and in the rounds; continued with other lengths, of which a later replay takes no account."""
    path, sampler, pool = whole
    places = [place for _, place in blocks(path)]
    cut(path, places[int(share * len(places))], tmp_path / "killed.h5")
    resumed, rest = finished(tmp_path / "killed.h5", order=4)
    assert rest.simulations < (1.4 - share) * pool.simulations + WORKERS
    again, nothing = repeated(tmp_path / "killed.h5", tmp_path, order=99)
    assert state_of(again) == state_of(resumed) and nothing.simulations == 0.0


def test_a_limit_counts_what_is_running(tmp_path):
    sampler, pool = finished(tmp_path / "run.h5", order=1, max_simulations=75)
    assert 74.0 < sampler.simulations <= 75.0 and pool.simulations == pytest.approx(sampler.simulations)


def test_what_cannot_be_asynchronous_is_refused():
    posterior = Gaussian(2)
    guide = FixedGuide(posterior, posterior.mean, [np.diag(posterior.sd**2)])
    with pytest.raises(ValueError, match="evaluation_queue"):
        SMCSampler(N, 2, posterior, vectorize=True, guide=guide, asynchronous=True)
    with pytest.raises(TypeError, match="asynchronous"), ThreadPoolExecutor(1) as pool:
        TMCMCSampler(N, 2, posterior, pool=pool, guide=guide, asynchronous=True)
