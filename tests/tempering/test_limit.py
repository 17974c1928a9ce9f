"""A limit of simulations: what a run reports where it ends, and how it goes on."""

import json
import re
import warnings

import emcee
import numpy as np
import pytest

from samplers import SMCSampler, TMCMCSampler
from samplers.judgement.verdict import Verdict
from tests.contract.targets import Gaussian
from tests.covering import covering
from tests.tempering.guides import LearningGuide, SearchingGuide
from tests.tempering.test_guided import N, laplace

PATHS = {
    "guide": (SMCSampler, "guide", {}),
    "guide, TMCMC": (TMCMCSampler, "guide", {}),
    "searching guide": (SMCSampler, "search", {}),
    "recycling": (SMCSampler, None, {"recycle": True}),
    "moves": (SMCSampler, None, {"recycle": False}),
    "stretch": (SMCSampler, None, {"moves": emcee.moves.StretchMove()}),
    "TMCMC": (TMCMCSampler, None, {}),
    "leaders": (TMCMCSampler, None, {"chains": "leaders"}),
}


def make(path, limit, file=None, seed=4):
    Sampler, guide, settings = PATHS[path]
    posterior = Gaussian(3, sd=0.05)
    given = {
        None: lambda: None,
        "guide": lambda: laplace(posterior, scale=2.5, guide=LearningGuide),
        "search": lambda: SearchingGuide(posterior),
    }[guide]()
    backend = None if file is None else emcee.backends.HDFBackend(str(file))
    kwargs = {"seed": seed, "guide": given, "max_simulations": limit, "backend": backend, **settings}
    return Sampler(N, 3, posterior, vectorize=True, **kwargs)


def until(sampler, steps):
    """Make the steps that are missing."""
    sampler.run_mcmc(None, steps - sampler.iteration)


def halted(sampler, steps):
    """The limit ends a call: with a warning, unless the result is converged already."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        until(sampler, steps)
    warned = [re.search("max_simulations=.* (ended the run|allowed)", str(each.message)) for each in caught]
    said = " ".join(str(each.message) for each in caught)
    assert all(said.count(each.text) <= 1 for each in sampler.verdict.findings)
    assert any(warned) == (sampler.verdict.status != "converged")


def same(sampler, whole):
    assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert np.array_equal(sampler.get_log_prob(), whole.get_log_prob())
    assert np.array_equal(sampler.backend.accepted, whole.backend.accepted)
    assert np.array_equal(sampler.random_state[1], whole.random_state[1])
    assert [s._replace(seconds=0) for s in sampler.ladder] == [s._replace(seconds=0) for s in whole.ladder]
    assert (sampler.log_evidence, sampler.log_evidence_error) == (whole.log_evidence, whole.log_evidence_error)
    assert sampler.simulations == whole.simulations
    assert sampler.verdict == whole.verdict
    return True


@pytest.mark.parametrize(("path", "where"), covering(PATHS, ["new process", "memory", "file"], strength=1))
def test_a_run_that_goes_on_is_the_long_run(path, where, tmp_path):
    """Several limits, one after the other; the last one is never reached."""
    whole = make(path, None)
    until(whole, 6)
    total = whole.simulations
    file = None if where == "memory" else tmp_path / "run.h5"
    sampler = make(path, 0.15 * total, file)
    for share in (0.15, 0.4, 0.4, 0.7, 0.93):
        limit = share * total
        if where == "new process":
            sampler._record.close()
            sampler = make(path, limit, file, seed=4 if share == 0.15 else 77)
        sampler.max_simulations = limit
        halted(sampler, 6)
        assert sampler.simulations <= limit
        assert 1 <= sampler.iteration < 6
        assert sampler.get_chain().shape == (sampler.iteration, N, 3)
        assert np.all(np.isfinite(sampler.get_log_prob()))
        assert np.isfinite(sampler.log_evidence) and sampler.verdict.status in ("usable", "not usable", "converged")
        assert sampler.verdict.simulations == sampler.simulations
    made = sampler.log_prob_fn.f.calls
    if where == "new process":
        sampler._record.close()
        sampler = make(path, total, file, seed=77)
    sampler.max_simulations = total
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*max_simulations")  # an annealing that is made again warns again
        until(sampler, 6)
    assert same(sampler, whole)
    if where != "new process" and path != "searching guide":
        assert sampler.log_prob_fn.f.calls <= whole.log_prob_fn.f.calls and made > 0
    for s in (sampler, whole):
        s.max_simulations = None
        s.run_mcmc(None, 2)
    assert np.array_equal(sampler.get_chain(), whole.get_chain())


def test_steps_that_fit_are_kept():
    sampler = make("guide", None)
    until(sampler, 0)
    annealing = sampler.simulations
    sampler = make("guide", annealing + 2.5 * N)
    halted(sampler, 5)
    assert sampler.iteration == 3 and sampler.simulations == annealing + 2 * N  # the draws are the first step
    sampler = make("guide", annealing + 0.5 * N)
    halted(sampler, 5)
    assert sampler.iteration == 1 and sampler.simulations == annealing
    assert sampler.verdict.status == "converged"
    assert "4 of the steps at beta = 1 were not made" in str(sampler.verdict)


class Recorded(Gaussian):
    """Keeps the points that were evaluated, as a model that counts its runs."""

    def __init__(self, points, **target):
        super().__init__(**target)
        self.points = points

    def __call__(self, x):
        self.points.update(row.tobytes() for row in np.atleast_2d(x))
        return super().__call__(x)


class TwiceSearchingGuide(SearchingGuide):
    """A search that leaves the random numbers alone: what is drawn after a cut search is drawn again later."""

    def search(self, session):
        state = session.random.get_state()
        session.random.seed(len(self.found))
        yield from super().search(session)
        session.random.set_state(state)


@pytest.mark.parametrize("guide", [SearchingGuide, TwiceSearchingGuide])
@pytest.mark.parametrize("where", ["memory", "file"])
def test_the_count_is_that_of_the_model(guide, where, tmp_path):
    """Whatever the limits before: a search is cut twice, then rounds, then sweeps."""

    def make(points, limit, seed=4):
        posterior = Recorded(points, ndim=3, sd=0.05)
        backend = None if where == "memory" else emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
        return SMCSampler(
            N, 3, posterior, vectorize=True, seed=seed, guide=guide(posterior), max_simulations=limit, backend=backend
        )

    whole = make(set(), None)
    until(whole, 2)
    chain, evidence, total = whole.get_chain(), whole.log_evidence, whole.simulations
    assert total == len(whole.log_prob_fn.f.points)
    if where == "file":
        whole._record.close()
        (tmp_path / "run.h5").unlink()
        (tmp_path / "run.h5.mcmc.record").unlink()
    points = set()
    sampler, counted = make(points, 13), []
    for limit in (13, 22, 60, 150, None):
        if where == "file":
            sampler._record.close()
            sampler = make(points, limit, seed=4 + len(points))
        sampler.max_simulations = limit
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            until(sampler, 2)
        assert sampler.simulations == sampler.verdict.simulations == len(points) <= (limit or np.inf)
        counted.append(len(points))
    assert counted[:2] == [13, 22] and sampler.verdict.status == "converged"
    # draws after a cut search that the long run does not make are not lost from the count
    assert counted[-1] == total if guide is TwiceSearchingGuide else counted[-1] > total
    assert np.array_equal(sampler.get_chain(), chain) and sampler.log_evidence == evidence


@pytest.mark.parametrize(
    ("path", "first"),
    covering(["searching guide", "recycling", "moves"], ["limited", "killed", "finished"], strength=1),
)
def test_a_smaller_limit_keeps_what_was_made(path, first, tmp_path):
    """Simulations in the file cost nothing."""
    file = tmp_path / "run.h5"
    whole = make(path, None, tmp_path / "whole.h5")
    until(whole, 2)
    limit = np.ceil(0.6 * whole.simulations)
    sampler = make(path, None if first == "finished" else limit, file)
    if first == "finished":
        until(sampler, 2)
    else:
        halted(sampler, 2)
    chain, evidence, made = sampler.get_chain(), sampler.log_evidence, sampler.simulations
    sampler._record.close()
    if first == "killed":
        file.unlink()
    sampler = make(path, 10, file, seed=77)
    halted(sampler, 3)
    assert sampler.simulations == sampler.verdict.simulations == made
    assert sampler.log_prob_fn.f.calls <= N + 1  # to check that the posterior is the same
    assert sampler.log_evidence == evidence
    assert np.array_equal(sampler.get_chain()[: len(chain)], chain)
    assert len(sampler.get_chain()) == len(chain)  # no copy is stored in place of a step that the limit does not allow
    assert sampler.max_simulations == 10
    sampler._record.close()
    sampler = make(path, None, file, seed=78)
    until(sampler, 2)
    if first == "finished":
        until(whole, 2)
    assert np.array_equal(sampler.get_chain(), whole.get_chain()) and sampler.simulations == whole.simulations


def test_nothing_known_is_an_error_that_keeps_what_was_made():
    sampler = make("searching guide", 20)
    with pytest.raises(ValueError, match="there is nothing to report"):
        make("searching guide", 0.5).run_mcmc(None, 1)
    halted(sampler, 1)
    assert sampler.simulations == 20 and sampler.verdict.status == "not usable"
    assert "the search was not finished" in str(sampler.verdict)


@pytest.mark.parametrize("where", ["memory", "file"])
def test_a_run_goes_on_after_this_error(where, tmp_path):
    whole = make("searching guide", None)
    whole.run_mcmc(None, 2)
    sampler = make("searching guide", 0.5, None if where == "memory" else tmp_path / "run.h5")
    for limit in (0.5, 0.9):
        sampler.max_simulations = limit
        with pytest.raises(ValueError, match="after 0 evaluated points.*simulations made so far are kept.$"):
            sampler.run_mcmc(None, 2)
    sampler.max_simulations = 24
    with pytest.raises(ValueError, match="finite log-probability, besides 24 simulations of the search by the guide"):
        sampler.run_mcmc(None, 2)
    sampler.max_simulations = None
    sampler.run_mcmc(None, 2)
    assert same(sampler, whole)


def test_the_verdict_is_stored_with_the_chain(tmp_path):
    sampler = make("guide", 60, tmp_path / "run.h5")
    with pytest.raises(ValueError, match="no verdict before a run"):
        sampler.verdict  # noqa: B018
    halted(sampler, 2)
    sampler._record.close()
    again = make("guide", 60, tmp_path / "run.h5")
    assert again.verdict == sampler.verdict and isinstance(again.verdict, Verdict)
    assert json.dumps(again.verdict)
    found = (
        r"Usable: effective sample size \d+ \(of 60 weighted points, resampled to 100 walkers\) from 60 simulations\."
    )
    assert re.match(found, str(again.verdict))


@pytest.mark.parametrize("limit", [0, -5, True, "many", np.nan])
def test_impossible_limits(limit):
    with pytest.raises(ValueError, match="max_simulations must be a positive number"):
        make("moves", limit)


def test_no_step_is_stored_where_none_was_wanted():
    sampler = make("guide", 40)
    halted(sampler, 0)
    assert sampler.iteration == 0 and sampler.verdict.status != "converged"
    sampler.max_simulations = 10_000
    until(sampler, 3)
    whole = make("guide", None)
    until(whole, 3)
    assert same(sampler, whole)
