"""A file is reopened as in emcee: `run_mcmc(None, n)` adds n steps after the last stored one.

Beside the file, our samplers write the record of evaluations, ``<filename>.<group>.record``. What it contains is never
evaluated again: not after a kill, not with a larger limit, not without the file.
"""

from collections import Counter
from contextlib import nullcontext
from functools import cache

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from tests.contract.targets import WithBlobs
from tests.covering import covering

N, NDIM = 40, 3
KINDS = {
    "EnsembleSampler": (emcee.EnsembleSampler, {}),
    "SMCSampler": (SMCSampler, {"recycle": True}),
    "SMCSampler by moves": (SMCSampler, {"recycle": False}),
    "TMCMCSampler": (TMCMCSampler, {}),
}
OURS = [kind for kind in KINDS if kind != "EnsembleSampler"]
SLOW = ("SMCSampler by moves",)  # TMCMCSampler moves as well, among the quick tests
MARKED = [pytest.param(kind, marks=pytest.mark.slow if kind in SLOW else ()) for kind in KINDS]
ONE = ["SMCSampler", *(pytest.param(kind, marks=pytest.mark.slow) for kind in OURS[1:])]
pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")  # 40 walkers are few


class Counted(WithBlobs):
    """Notes the points that it has evaluated; in the call of a number it raises KeyboardInterrupt, or has no value."""

    def __init__(self, fingerprint="counted", interrupt_at=None, spoilt_at=None, **kwargs):
        super().__init__(ndim=NDIM, **kwargs)
        self.evaluated: list[bytes] = []
        self.interrupt_at, self.spoilt_at = interrupt_at, spoilt_at
        if fingerprint is not None:
            self.fingerprint = fingerprint

    def __call__(self, x):
        if len(self.evaluated) == self.interrupt_at:
            self.interrupt_at = None
            raise KeyboardInterrupt
        if len(self.evaluated) == self.spoilt_at:
            self.spoilt_at = None
            return "no number", 0.0
        self.evaluated.append(x.tobytes())
        return super().__call__(x)


def make(kind, path, posterior, seed=7, **changes):
    """A sampler on a file; `seed` is the seed of its first run."""
    Sampler, settings = KINDS[kind]
    np.random.seed(seed)  # noqa: NPY002  all three take their seed from the global generator
    backend = None if path is None else emcee.backends.HDFBackend(str(path))
    return Sampler(N, NDIM, posterior, backend=backend, **settings, **changes)


def begin(sampler, nsteps):
    """The first run on a file, from the same draws of the prior for every sampler."""
    sampler.run_mcmc(np.random.default_rng(1).standard_normal((N, NDIM)), nsteps)
    return sampler


def run(kind, path, *calls, **kwargs):
    """One process that makes some calls of `run_mcmc` on a new file."""
    sampler = begin(make(kind, path, Counted(), **kwargs), calls[0])
    for nsteps in calls[1:]:
        sampler.run_mcmc(None, nsteps)
    return sampler


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory):
    """Like `run`, each made once: the runs without an interruption, which tests only read."""
    return cache(
        lambda kind, *calls, **settings: run(kind, tmp_path_factory.mktemp("whole") / "run.h5", *calls, **settings)
    )


def same(sampler, other):
    """Everything but the wall time is equal to the last bit."""
    for get in ("get_chain", "get_log_prob", "get_blobs"):
        assert np.array_equal(getattr(sampler, get)(), getattr(other, get)()), get
    assert np.array_equal(sampler.backend.accepted, other.backend.accepted)
    for ours, theirs in zip(sampler.backend.random_state, other.backend.random_state, strict=True):
        assert np.all(ours == theirs)
    if hasattr(sampler, "ladder"):
        assert [s._replace(seconds=0) for s in sampler.ladder] == [s._replace(seconds=0) for s in other.ladder]
        assert (sampler.log_evidence, sampler.log_evidence_error) == (other.log_evidence, other.log_evidence_error)
    return True


def evaluated_by(sampler):
    """How often each point was evaluated: a run by moves may propose a point twice."""
    return Counter(sampler.log_prob_fn.f.evaluated)


def record_of(path):
    return path.with_name(f"{path.name}.mcmc.record")


# ---------------------------------------------------------------- emcee's idiom


@pytest.mark.parametrize("kind", MARKED)
def test_steps_are_added_after_the_last_stored_one(kind, tmp_path, whole_run):
    begin(make(kind, tmp_path / "run.h5", Counted()), 3)
    posterior = Counted()
    reopened = make(kind, tmp_path / "run.h5", posterior, seed=8)
    reopened.run_mcmc(None, 4)
    assert reopened.iteration == 7
    assert same(reopened, whole_run(kind, 3, 4))
    assert len(posterior.evaluated) <= 4 * N  # those of the added steps only


def interrupted(kind, path):
    """A run on a file that Ctrl-C has ended in its annealing."""
    sampler = make(kind, path, Counted(interrupt_at=N + 5))
    with pytest.raises(KeyboardInterrupt):
        begin(sampler, 3)
    return sampler


@pytest.mark.parametrize(("kind", "finished"), covering(list(KINDS), [True, False], strength=1))
def test_reset_of_the_backend_begins_anew(kind, finished, tmp_path):
    """Also with another posterior and another seed, which a file that is not reset would refuse or ignore."""
    path = tmp_path / "run.h5"
    begin(make(kind, path, Counted()), 3) if finished else interrupted(kind, path)
    other = {"posterior": Counted("other", centre=0.3), "seed": 9}
    emcee.backends.HDFBackend(str(path)).reset(N, NDIM)
    anew = begin(make(kind, path, **other), 2)
    assert anew.iteration == 2
    other["posterior"] = Counted("other", centre=0.3)
    new = begin(make(kind, tmp_path / "new.h5", **other), 2)
    assert same(anew, new)
    if kind != "EnsembleSampler":
        assert (anew.evaluations, anew.simulations) == (new.evaluations, new.simulations)
        assert same(make(kind, path, Counted("other", centre=0.3)), new)


@pytest.mark.parametrize(("kind", "finished", "in_file"), covering(OURS, [True, False], [True, False], strength=1))
def test_other_draws_need_a_new_sampler(kind, finished, in_file, tmp_path):
    sampler = make(kind, tmp_path / "run.h5" if in_file else None, Counted(interrupt_at=None if finished else N + 5))
    with nullcontext() if finished else pytest.raises(KeyboardInterrupt):
        begin(sampler, 3)
    sampler.reset()
    with pytest.raises(ValueError, match="not annealed from these points" if finished else "from other draws of the"):
        sampler.run_mcmc(np.random.default_rng(2).standard_normal((N, NDIM)), 2)
    sampler.run_mcmc(None, 2)
    assert sampler.iteration == 2


@pytest.mark.parametrize("kind", ONE)
def test_a_lost_record_is_said(kind, tmp_path):
    path = tmp_path / "run.h5"
    begin(make(kind, path, Counted()), 2)
    record_of(path).unlink()
    with pytest.raises(ValueError, match="run.h5.mcmc.record, is missing or empty: put it back"):
        begin(make(kind, path, Counted()), 2)


@pytest.mark.parametrize("kind", ONE)
def test_a_reset_goes_on_with_the_last_state_or_the_same_draws(kind, tmp_path, whole_run):
    whole = whole_run(kind, 2, 2)
    for given in (None, "state", "draws"):
        sampler = begin(make(kind, tmp_path / f"{given}.h5", Counted()), 2)
        last = sampler.get_last_sample()
        sampler.reset()
        draws = np.random.default_rng(1).standard_normal((N, NDIM))
        sampler.run_mcmc({None: None, "state": last, "draws": draws}[given], 2)
        assert np.array_equal(sampler.get_chain(), whole.get_chain()[2:])


@pytest.mark.parametrize("kind", ONE)
def test_reset_of_the_backend_of_a_living_sampler(kind, tmp_path, whole_run):
    """The chain goes on as after a reset of the sampler, and its file can be opened again."""
    sampler = begin(make(kind, tmp_path / "run.h5", Counted()), 2)
    sampler.backend.reset(N, NDIM)
    sampler.run_mcmc(None, 2)
    assert np.array_equal(sampler.get_chain(), whole_run(kind, 2, 2).get_chain()[2:])
    posterior = Counted()
    again = make(kind, tmp_path / "run.h5", posterior)
    again.run_mcmc(None, 0)
    assert same(again, sampler) and not posterior.evaluated


@pytest.mark.parametrize("kind", OURS)
def test_another_function_on_a_backend_in_memory_is_refused(kind):
    Sampler, settings = KINDS[kind]
    backend, draws = emcee.backends.Backend(), np.random.default_rng(1).standard_normal((N, NDIM))
    Sampler(N, NDIM, Counted(None), backend=backend, **settings).run_mcmc(draws, 2)
    other = Sampler(N, NDIM, Counted(None, centre=0.3), backend=backend, **settings)
    with pytest.raises(ValueError, match="the backend in memory contains another run"):
        other.run_mcmc(None, 1)


# ---------------------------------------------------------------- limits and interrupts


@pytest.mark.parametrize(
    ("what", "kind", "place", "reopened"),
    covering(["interrupt_at", "spoilt_at"], OURS, ["start", "annealing", "at beta = 1"], [False, True]),
)
def test_an_interrupt_or_an_error_and_then_the_same_call(what, kind, place, reopened, tmp_path, whole_run):
    """An interrupt loses no evaluated point; the batch that contains an error is evaluated again, nothing before it."""
    annealing = whole_run(kind, 0).evaluations
    whole = whole_run(kind, 4)
    at = {"start": N // 2, "annealing": annealing // 2 + 5, "at beta = 1": annealing + int(1.5 * N)}[place]
    posterior = Counted(**{what: at})
    sampler = make(kind, tmp_path / "run.h5", posterior)
    with pytest.raises(KeyboardInterrupt if what == "interrupt_at" else ValueError, match="^$|must return a number"):
        begin(sampler, 4)
    assert what == "spoilt_at" or len(posterior.evaluated) == at
    made = sampler.iteration
    assert made == (1 if place == "at beta = 1" else 0)
    if reopened:
        sampler = make(kind, tmp_path / "run.h5", posterior)
    sampler.run_mcmc(None, 4 - made)
    assert same(sampler, whole)
    assert (evaluated_by(sampler) - evaluated_by(whole)).total() <= (0 if what == "interrupt_at" else 4 * N)


# ---------------------------------------------------------------- what is refused, and errors


@pytest.mark.parametrize("kind", ONE)
def test_a_run_that_was_cut_short_refuses_other_draws(kind, tmp_path, whole_run):
    path = tmp_path / "run.h5"
    annealing = whole_run(kind, 0).evaluations
    with pytest.raises(KeyboardInterrupt):
        begin(make(kind, path, Counted(interrupt_at=annealing // 2)), 2)
    other = np.random.default_rng(2).standard_normal((N, NDIM))
    with pytest.raises(ValueError, match="a run from other draws of the prior: pass None"):
        make(kind, path, Counted()).run_mcmc(other, 2)
    again = make(kind, path, Counted())
    again.run_mcmc(None, 2)
    assert same(again, whole_run(kind, 2))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"kind": "TMCMCSampler"}, "sampler was SMCSampler, is TMCMCSampler"),
        ({"nwalkers": N + 2}, f"a run of {N} walkers in {NDIM} dimensions; got nwalkers={N + 2}"),
        ({"recycle": False}, "recycle was True, is False"),
    ],
    ids=str,
)
def test_another_sampler_is_refused_in_words_of_the_user(changes, message, tmp_path):
    begin(make("SMCSampler", tmp_path / "run.h5", Counted()), 1)
    backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
    settings = {"nwalkers": N, "kind": "SMCSampler", "recycle": True} | changes
    Sampler, nwalkers = KINDS[settings.pop("kind")][0], settings.pop("nwalkers")
    settings = settings if Sampler is SMCSampler else {}
    with pytest.raises(ValueError, match=message):
        Sampler(nwalkers, NDIM, Counted(), backend=backend, **settings).run_mcmc(None, 1)


def test_a_log_prior_of_another_convention_is_named(tmp_path):
    def of_one_point(x):
        return -0.5 * x @ x if x[0] > -9.0 else -np.inf  # an error for a batch of points

    sampler = SMCSampler(N, NDIM, lambda x: -(x[:, 0] ** 2), vectorize=True, log_prior_fn=of_one_point)
    with pytest.raises(ValueError, match=r"log_prior_fn failed with .* an array \(n, ndim\) of points"):
        sampler.run_mcmc(np.random.default_rng(1).standard_normal((N, NDIM)), 1)


@pytest.mark.parametrize("kind", ONE)
def test_a_file_that_is_only_read(kind, tmp_path):
    whole = begin(make(kind, tmp_path / "run.h5", Counted()), 2)
    before = sorted((path.name, path.read_bytes()) for path in tmp_path.iterdir())
    backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"), read_only=True)
    sampler = KINDS[kind][0](N, NDIM, Counted(), backend=backend, **KINDS[kind][1])
    assert sampler.ladder == whole.ladder and sampler.log_evidence == whole.log_evidence
    assert np.array_equal(sampler.get_chain(), whole.get_chain()) and sampler.verdict == whole.verdict
    sampler.run_mcmc(None, 1, store=False)
    assert sorted((path.name, path.read_bytes()) for path in tmp_path.iterdir()) == before


# ---------------------------------------------------------------- idioms of emcee's users


@pytest.mark.parametrize(("kind", "steps"), covering(OURS, [0, 2], strength=1))
def test_a_run_with_other_bits_goes_on_from_its_population(kind, steps, tmp_path):
    """Another processor computes other bits; here, a proposal is changed in its last one. Nothing is evaluated anew."""
    first = begin(make(kind, tmp_path / "run.h5", Counted()), steps)
    last, posterior = first.run_mcmc(None, 0), Counted()
    again = make(kind, tmp_path / "run.h5", posterior)
    again._record.start = again._record.start._replace(coords=np.nextafter(again._record.start.coords, 9.0))
    with pytest.warns(SamplingWarning, match="computes other bits"):
        again.run_mcmc(None, 0)
    assert not posterior.evaluated and again.iteration == steps
    assert np.array_equal(again.run_mcmc(None, 0).coords, last.coords)
    assert [s._replace(seconds=0) for s in again.ladder] == [s._replace(seconds=0) for s in first.ladder]
    assert again.log_evidence == first.log_evidence and again.verdict == first.verdict
    assert np.array_equal(again.random_state[1], first.random_state[1])
    again.run_mcmc(None, 2)
    assert again.iteration == steps + 2 and len(posterior.evaluated) <= 2 * N
