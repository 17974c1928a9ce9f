"""Asynchronous runs: killed anywhere, they go on; the record repeats them to the last bit without an evaluation."""

from concurrent.futures import ThreadPoolExecutor

import emcee
import numpy as np
import pytest

from samplers import SMCSampler
from tests.contract.targets import Gaussian, WithBlobs
from tests.faults.records import blocks, cut
from tests.simulated_cluster import SimulatedCluster

N, NDIM, STEPS = 40, 2, 2
COMPARED = 2  # evaluations by which a new sampler compares the posterior with that of the file

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


class Fragile(WithBlobs):
    """Blobs, and NaN for some points."""

    def __call__(self, x):
        values = super().__call__(x)
        values[x[:, 1] > 1.5, 0] = np.nan
        return values


def make(path, workers=5, order=0, **settings):
    """A sampler with a file; `order` is the seed of the run lengths, and so of the order of arrival."""
    lengths = np.random.default_rng(order)
    cluster = SimulatedCluster(Fragile(ndim=NDIM, sd=0.05), workers, lambda x: lengths.exponential(size=len(x)))
    backend = emcee.backends.HDFBackend(str(path))
    settings = {"seed": 5, "recycle": True, "asynchronous": True, **settings}
    return SMCSampler(N, NDIM, cluster, vectorize=True, backend=backend, **settings), cluster


def finished(path, **settings):
    sampler, cluster = make(path, **settings)
    sampler.run_mcmc(None, STEPS - sampler.iteration)
    sampler._record.close()
    return sampler, cluster


def state_of(sampler):
    """Everything that two runs are compared by."""
    ladder = [stage._replace(seconds=0) for stage in sampler.ladder]
    failures = sorted((failure["parameters"].tobytes(), failure["reason"]) for failure in sampler.failures)
    blobs = sampler.get_blobs().tobytes()
    return sampler.get_chain().tobytes(), blobs, ladder, sampler.log_evidence, sampler.evaluations, failures


def repeated(path, folder, order):
    """The run of a record without its HDF5 file, and the number of evaluations that it took."""
    copy = folder / "repeated.h5"
    cut(path, None, copy)
    return finished(copy, order=order)


def test_a_run_depends_on_the_order_of_arrival_and_on_nothing_else(tmp_path):
    """The control: other lengths give another chain, so that a replay that ignored the order would be noticed."""
    chains = [finished(tmp_path / f"{i}.h5", order=order)[0].get_chain() for i, order in enumerate((1, 1, 2))]
    assert np.array_equal(chains[0], chains[1]) and not np.array_equal(chains[0], chains[2])


@pytest.mark.parametrize("every", [65, pytest.param(13, marks=pytest.mark.slow)])
def test_killed_anywhere_a_run_goes_on_and_its_record_repeats_it(every, tmp_path):
    """Cut after some of the blocks, and continued with other lengths: nothing known is evaluated again."""
    whole, cluster = finished(tmp_path / "whole.h5", order=1)
    assert whole.failures and cluster.evaluations == whole.evaluations
    places = [place for _, place in blocks(tmp_path / "whole.h5")][::every]
    assert len(places) > 65 // every
    for number, place in enumerate(places):
        path = tmp_path / "killed.h5"
        cut(tmp_path / "whole.h5", place, path)
        resumed, cluster = finished(path, order=number)
        again, nothing = repeated(path, tmp_path, order=99)
        assert state_of(again) == state_of(resumed) and nothing.evaluations <= COMPARED
    assert state_of(repeated(tmp_path / "whole.h5", tmp_path, order=98)[0]) == state_of(whole)


def test_threads_take_single_points():
    """The result is that of the posterior."""
    posterior = Gaussian(NDIM, sd=0.05)
    with ThreadPoolExecutor(2) as pool:
        sampler = SMCSampler(N, NDIM, posterior, pool=pool, seed=3, recycle=True, asynchronous=True)
        sampler.run_mcmc(None, 1)
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4 * sampler.log_evidence_error
    mean, sd = sampler.get_chain(flat=True).mean(axis=0), posterior.sd / np.sqrt(N)
    assert np.all(np.abs(mean - posterior.mean) < 4 * sd)


def test_a_limit_of_simulations_counts_points_that_are_running(tmp_path):
    """No more than the limit is submitted, all of that is used, and a larger limit goes on."""
    sampler, cluster = make(tmp_path / "run.h5", max_simulations=150)
    sampler.run_mcmc(None, 1)
    assert cluster.evaluations == 150 == sampler.simulations
    more, further = make(tmp_path / "run.h5", max_simulations=5000, order=3)
    more.run_mcmc(None, 1)
    assert more.verdict.status != "not usable" and further.evaluations <= COMPARED + more.evaluations - 150


def test_what_cannot_be_asynchronous_is_refused():
    posterior = Gaussian(NDIM)
    with pytest.raises(ValueError, match="evaluation_queue"):
        SMCSampler(300, NDIM, posterior, vectorize=True, asynchronous=True)
    with pytest.raises(ValueError, match="moves wait"), ThreadPoolExecutor(1) as pool:
        SMCSampler(N, NDIM, posterior, pool=pool, recycle=False, asynchronous=True)
    with pytest.raises(ValueError, match="True or False"):
        SMCSampler(300, NDIM, posterior, vectorize=True, asynchronous=1)
