"""Asynchronous runs: killed anywhere, they go on; the record repeats them to the last bit without an evaluation."""

from concurrent.futures import ThreadPoolExecutor

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import Gaussian, WithBlobs
from tests.faults.records import blocks, cut, points_of
from tests.faults.resumable_run import outcome
from tests.simulated_cluster import SimulatedCluster
from tests.tempering.guides import FixedGuide

N, NDIM = 40, 2
COMPARED = 2  # evaluations by which a new sampler compares the posterior with that of the file
STEPS = 2

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


class Fragile(WithBlobs):
    """Blobs, and NaN for some points."""

    def __call__(self, x):
        values = super().__call__(x)
        values[..., 0] = np.where(x[..., 1] > 1.5, np.nan, values[..., 0])
        return values


def finished(path, order=0, **settings):
    """A run on a file, and what it has evaluated; `order` is the seed of the run lengths, and so of the arrivals."""
    settings = {"seed": 5, "asynchronous": True, "backend": emcee.backends.HDFBackend(str(path)), **settings}
    lengths = np.random.default_rng(order)
    posterior, cluster = Fragile(ndim=NDIM, sd=0.05), SimulatedCluster(5, lambda x: lengths.exponential())
    sampler = SMCSampler(N, NDIM, posterior, pool=cluster, recycle=True, **settings)
    sampler.run_mcmc(None, STEPS - sampler.iteration)
    sampler._record.close()
    return sampler, posterior.calls


def repeated(path, folder, order=99):
    """The run of a record without its HDF5 file."""
    cut(path, None, folder / "repeated.h5")
    return finished(folder / "repeated.h5", order)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run.h5"
    return path, *finished(path, order=1)


def test_the_order_of_arrival_decides_and_the_record_repeats_it_without_an_evaluation(whole, tmp_path):
    """The control: other lengths give another run, so that a replay that ignored the order would be noticed."""
    path, sampler, made = whole
    assert made == pytest.approx(sampler.simulations) and sampler.failures
    assert outcome(finished(tmp_path / "other.h5", order=2)[0]) != outcome(sampler)
    again, nothing = repeated(path, tmp_path)
    assert outcome(again) == outcome(sampler) and nothing <= COMPARED


@pytest.mark.parametrize(
    "share", [0.5, *(pytest.param(share, marks=pytest.mark.slow) for share in (0.04, 0.25, 0.7, 0.97))]
)
def test_killed_anywhere_a_run_goes_on_and_its_record_repeats_it(whole, tmp_path, share):
    """Continued with other lengths, of which a later replay takes no account."""
    path, *_ = whole
    places = [place for _, place in blocks(path)]
    cut(path, places[int(share * len(places))], tmp_path / "killed.h5")
    known = len(points_of(tmp_path / "killed.h5"))
    resumed, rest = finished(tmp_path / "killed.h5", order=4)
    assert rest <= resumed.evaluations - known + COMPARED
    again, nothing = repeated(tmp_path / "killed.h5", tmp_path)
    assert outcome(again) == outcome(resumed) and nothing <= COMPARED


def test_a_limit_counts_what_is_running(tmp_path):
    """No more than the limit is submitted, all of that is used, and a larger limit goes on."""
    sampler, made = finished(tmp_path / "run.h5", order=1, max_simulations=150)
    assert 149.0 < sampler.simulations <= 150 and made == pytest.approx(sampler.simulations)
    more, further = finished(tmp_path / "run.h5", order=3, max_simulations=5000)
    assert more.verdict.status != "not usable" and further <= COMPARED + more.evaluations - 150


class Ends(Gaussian):
    """Raises an exception at one of its evaluations; notes the points."""

    fingerprint = "of this target"  # a run that is continued need not compare values

    def __init__(self, kind=None):
        super().__init__(NDIM, sd=0.05)
        self.kind, self.evaluated = kind, []

    def __call__(self, x):
        if self.kind is not None and len(self.evaluated) == 2 * N:
            error = self.kind("changed")
            error.ends_run = True
            raise error
        value = super().__call__(x)
        self.evaluated.append(np.asarray(x).tobytes())
        return value


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_points_beside_one_that_ends_the_run_are_kept(kind, tmp_path):
    """A worker that raises what is no failure of a point ends the run; all others that have ended are not repeated."""
    path, posterior, again = tmp_path / "run.h5", Ends(kind), Ends()

    def run(posterior):
        backend = emcee.backends.HDFBackend(str(path))
        with ThreadPoolExecutor(3) as pool:
            settings = {"pool": pool, "backend": backend, "seed": 5, "recycle": True, "asynchronous": True}
            sampler = SMCSampler(N, NDIM, posterior, **settings)
            sampler.run_mcmc(None, 1)
        return sampler

    with pytest.raises(kind, match="changed"):
        run(posterior)
    known = points_of(path)
    assert 2 * N - 3 <= len(known) and set(known) <= set(posterior.evaluated)
    sampler = run(again)
    assert not set(again.evaluated) & set(known)
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4 * sampler.log_evidence_error


POSTERIOR = Gaussian(NDIM)
GUIDE = FixedGuide(POSTERIOR, POSTERIOR.mean, [np.diag(POSTERIOR.sd**2)])


@pytest.mark.parametrize(
    ("Sampler", "settings", "error", "word"),
    [
        (SMCSampler, {"pool": 1, "vectorize": True}, ValueError, "one by one: pass a posterior"),
        (SMCSampler, {"pool": 1, "guide": GUIDE}, ValueError, "guides wait"),
        (SMCSampler, {"pool": 1, "recycle": False}, ValueError, "moves and guides wait"),
        (SMCSampler, {"vectorize": True, "asynchronous": 1}, ValueError, "True or False"),
        (TMCMCSampler, {"pool": 1, "guide": GUIDE}, ValueError, "asynchronous"),
    ],
)
def test_what_cannot_be_asynchronous_is_refused(Sampler, settings, error, word):
    with pytest.raises(error, match=word), ThreadPoolExecutor(1) as pool:
        given = {"asynchronous": True, **settings} | ({"pool": pool} if "pool" in settings else {})
        Sampler(300, NDIM, POSTERIOR, **given)
