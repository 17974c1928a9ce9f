"""Runs with a guide: rounds of weighted draws instead of annealing, and independence sweeps at beta = 1."""

import pickle
import re

import emcee
import numpy as np
import pytest
from scipy import stats

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.estimates.importance import KnownDensity, Round, add_round, pool_rounds, tail_variance
from samplers.estimates.pareto import pareto_shape
from samplers.moves.population_moves import guide_move
from tests.contract.targets import Gaussian
from tests.tempering.guides import DrawsOf, FixedGuide, LearningGuide, SearchingGuide

N = 100


def laplace(posterior, scale=1.0, shift=0.0, guide=FixedGuide, **more):
    """A guide about the mode of a Gaussian target; `scale` and `shift` in units of its standard deviation."""
    covariance = np.diag((scale * posterior.sd) ** 2)
    return guide(posterior, posterior.mean + shift * posterior.sd, [covariance], **more)


def run(posterior, guide, steps=1, Sampler=SMCSampler, nwalkers=N, seed=1, **kwargs):
    sampler = Sampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=seed, guide=guide, **kwargs)
    sampler.run_mcmc(None, steps)
    return sampler


@pytest.mark.parametrize("Sampler", [SMCSampler, TMCMCSampler])
def test_a_good_guide_replaces_the_annealing(Sampler):
    posterior = Gaussian(5, sd=0.02)
    sampler = run(posterior, laplace(posterior), Sampler=Sampler)
    assert posterior.calls == sampler.evaluations == sampler.simulations < 2.6 * N
    assert [stage.beta for stage in sampler.ladder] == [1.0]
    assert sampler.ladder[0].evaluations == sum(r.draws for r in sampler.rounds) < 1.6 * N
    assert abs(sampler.log_evidence - posterior.log_evidence) < 4.0 * sampler.log_evidence_error < 0.3
    chain = sampler.get_chain(flat=True)
    assert chain.shape == (N, 5)
    assert np.all(np.abs(chain.mean(axis=0) - posterior.mean) < 4.0 * sampler.mean_error())
    assert np.all(np.abs(chain.std(axis=0) / posterior.sd - 1.0) < 0.35)


def test_adding_a_constant_adds_it_to_the_evidence():
    runs = [run(Gaussian(offset=c), laplace(Gaussian(offset=c), guide=LearningGuide, scale=2.0)) for c in (0.0, 4096.0)]
    assert np.array_equal(runs[0].get_chain(), runs[1].get_chain())
    assert runs[1].log_evidence - runs[0].log_evidence == pytest.approx(4096.0, abs=1e-9)


def test_the_guide_that_was_given_is_not_changed():
    posterior = Gaussian()
    guide = laplace(posterior, scale=2.0, guide=LearningGuide)
    sampler = run(posterior, guide)
    assert guide.refinements == 0 and sampler.guide.refinements == len(sampler.rounds) - 1 > 0
    again = run(posterior, guide)
    assert np.array_equal(sampler.get_chain(), again.get_chain())


def test_sweeps_of_a_guide_leave_the_posterior_unchanged(rng):
    """Exact draws stay exact, even with a guide that is far too wide and shifted."""
    posterior = Gaussian(2)
    n = 4000
    start = posterior.mean + posterior.sd * rng.standard_normal((n, 2))
    move = guide_move(laplace(posterior, scale=1.5, shift=0.7))
    sampler = emcee.EnsembleSampler(n, 2, posterior, moves=move, vectorize=True)
    sampler.run_mcmc(start, 5)
    z = (sampler.get_chain()[-1] - posterior.mean) / posterior.sd
    assert np.all(np.abs(z.mean(axis=0)) < 4.0 / np.sqrt(n))
    assert np.all(np.abs(z.var(axis=0) - 1.0) < 4.0 * np.sqrt(2.0 / n))


def test_control_a_density_that_is_not_that_of_the_draws_shows(rng):
    """Negative control of the test above: the draws of one guide with the density of another."""
    posterior = Gaussian(2)
    n = 4000
    wrong = laplace(posterior, scale=1.5, shift=0.7)
    wrong.log_density = laplace(posterior, scale=1.5).log_density
    start = posterior.mean + posterior.sd * rng.standard_normal((n, 2))
    sampler = emcee.EnsembleSampler(n, 2, posterior, moves=guide_move(wrong), vectorize=True)
    sampler.run_mcmc(start, 5)
    z = (sampler.get_chain()[-1] - posterior.mean) / posterior.sd
    assert np.any(np.abs(z.mean(axis=0)) > 8.0 / np.sqrt(n))


@pytest.mark.parametrize("seed", range(5))
def test_a_useless_guide_is_not_usable_and_costs_no_annealing(seed):
    posterior = Gaussian(2)
    with pytest.warns(SamplingWarning, match="The rounds of the guide ended, because .* Run again without a guide"):
        sampler = run(posterior, laplace(posterior, scale=0.2, shift=8.0), seed=seed)
    assert sampler.verdict.status == "not usable" and len(sampler.ladder) == 1
    assert posterior.calls == sampler.simulations == sum(r.draws for r in sampler.rounds)
    with pytest.warns(SamplingWarning, match="The rounds of the guide ended"):
        sampler.run_mcmc(None, 1)
    assert posterior.calls == sampler.simulations


class Uncopied(FixedGuide):
    def fresh(self):
        return self

    def __deepcopy__(self, memo):
        raise TypeError("it holds a lock")


def test_what_a_guide_must_be():
    posterior = Gaussian()

    class Observes(FixedGuide):
        def observe(self, coords, session):
            pass

    guide = Observes(posterior, posterior.mean, [np.diag(posterior.sd**2)])
    with pytest.raises(ValueError, match="pass vectorize=True"):
        SMCSampler(N, 3, posterior, guide=guide)
    with pytest.raises(ValueError, match="derived from samplers.Guide.*got object"):
        SMCSampler(N, 3, posterior, guide=object())
    for name, wrong, match in (
        ("draw", lambda n, random: np.zeros((n, 2)), "must return 30 finite points of 3"),
        ("log_density", lambda x: np.full(len(x), np.nan), "neither NaN nor"),
        ("log_density", lambda x: np.full(len(x), -np.inf), "-inf at 30 of 30 draws"),
    ):
        guide = laplace(posterior)
        setattr(guide, name, wrong)
        with pytest.raises(ValueError, match=match):
            run(posterior, guide)
    guide = laplace(posterior, guide=Uncopied)
    guide.frozen = lambda: guide.log_density  # it does not learn
    run(posterior, guide)


def test_points_are_observed_once_before_they_are_evaluated():
    posterior = Gaussian()

    class Observes(LearningGuide):
        seen = 0

        def observe(self, coords, session):
            assert posterior.calls == self.seen
            self.seen += len(coords)

    posterior.calls = 0
    sampler = run(posterior, laplace(posterior, scale=2.0, guide=Observes), steps=0)
    assert sampler.guide.seen == sampler.evaluations == posterior.calls


def test_points_that_differ_in_fast_parameters_are_one_simulation():
    posterior = Gaussian()
    posterior.fast_parameters = (2,)
    sampler = run(posterior, laplace(posterior), steps=2)
    draws = sum(r.draws for r in sampler.rounds)
    assert sampler.simulations <= draws + 2 * N < sampler.evaluations


def test_guided_runs_are_pickled():
    posterior = Gaussian()
    sampler = run(posterior, laplace(posterior, scale=2.0, guide=LearningGuide))
    again = pickle.loads(pickle.dumps(sampler))
    for s in (sampler, again):
        s.run_mcmc(None, 3)
    assert np.array_equal(sampler.get_chain(), again.get_chain())


def test_the_progress_bar_counts_simulations_draws_and_sweeps(capfd):
    posterior = Gaussian()
    sampler = SMCSampler(N, 3, posterior, vectorize=True, seed=1, guide=SearchingGuide(posterior))
    sampler.run_mcmc(None, 2, progress=True)
    shown = capfd.readouterr().err
    drawn = sampler.simulations_of_guides + sum(found.draws for found in sampler.rounds)
    assert "1/1" in shown  # the draws are the first step
    assert re.search(rf"draws: effective size \d+ of {N} \[[^]]*simulations={drawn:.0f}", shown)


def _rounds(rng, spreads, ndim=3):
    """Rounds of normal draws with standard deviations `spreads` for a standard normal posterior with the evidence 1."""
    rounds = []
    for n, spread in zip((30, 60, 60), spreads, strict=True):
        proposal = stats.multivariate_normal(np.zeros(ndim), spread**2 * np.eye(ndim))
        coords = proposal.rvs(n, random_state=rng).reshape(n, ndim)
        records = np.zeros(n, dtype=[("log_prob", float)])
        records["log_prob"] = stats.multivariate_normal(np.zeros(ndim)).logpdf(coords)
        own = proposal.logpdf(coords)
        log_weights = records["log_prob"] - own
        rounds = add_round(rounds, Round(coords, records, log_weights, None, None, proposal.logpdf, own[:, None]))
    return rounds


def test_rounds_that_each_miss_a_part_have_a_large_error(rng):
    """Three of four intervals each, with constant weights: the spread of the weights alone would be zero."""
    rounds, parts = [], 4
    for missed in range(2):

        def log_density(x, missed=missed):
            return np.where((x[:, 0] >= missed) & (x[:, 0] < missed + parts - 1), -np.log(parts - 1.0), -np.inf)

        coords = rng.uniform(missed, missed + parts - 1, (50, 1))
        records = np.zeros(50, dtype=[("log_prob", float)])
        own = log_density(coords)
        rounds = add_round(rounds, Round(coords, records, -own, None, None, log_density, own[:, None]))
    pooled = pool_rounds(rounds)
    assert abs(pooled.log_evidence - np.log(parts)) < 2.0 * pooled.log_evidence_error < 1.0


def test_rounds_with_different_means_have_the_error_of_their_spread(rng):
    """Constant weights in each of three rounds: the error is that between rounds and the error of the known density."""
    rounds, levels, known = [], np.array([0.0, 0.1, 0.3]), KnownDensity(None, None, None, 0.2)
    for level in levels:
        records = np.full(50, level).astype([("log_prob", float)])
        own = {"log_density": lambda x: np.zeros(len(x)), "log_densities": np.zeros((50, 1))}
        rounds = add_round(rounds, Round(rng.uniform(size=(50, 1)), records, np.full(50, level), known, **own))
    parts = np.exp(levels) / np.exp(levels).sum()
    pooled = pool_rounds(rounds)
    assert pooled.log_evidence == pytest.approx(np.log(np.exp(levels).mean()))
    assert pooled.log_evidence_error == pytest.approx(np.linalg.norm([*(parts - 1.0 / 3.0), 0.2]))


@pytest.mark.parametrize("spreads", [(1.3, 1.2, 1.1), (3.0, 1.5, 1.2), (0.2, 2.0, 1.2)])
def test_the_evidence_of_rounds_is_unbiased_and_its_error_covers(spreads, rng):
    """Also where the first draws are far too narrow, and would have made the evidence too small alone."""
    values, covered = [], []
    for _ in range(300):
        pooled = pool_rounds(_rounds(rng, spreads))
        values.append(np.exp(pooled.log_evidence))
        assert np.exp(pooled.log_weights).sum() == pytest.approx(values[-1])
        covered.append(abs(pooled.log_evidence) < 2.0 * pooled.log_evidence_error)
    error = np.std(values) / np.sqrt(len(values))
    assert abs(np.mean(values) - 1.0) < 4.0 * error + 0.002
    assert np.mean(covered) > 0.9


def test_the_shape_of_the_tail_counts_only_where_the_tail_does():
    """Equal weights with tiny heavy-tailed errors have no tail; the same errors at full size do."""
    errors = np.random.default_rng(1).pareto(1.0, 300)
    assert pareto_shape(np.log1p(1e-4 * errors)) == 0.0
    assert tail_variance(np.log1p(1e-4 * errors)) == 0.0
    assert pareto_shape(np.log1p(errors)) > 0.7
    heavy = np.log1p(np.random.default_rng(1).pareto(2.0, 300))
    shape, excess = pareto_shape(heavy), np.exp(heavy).max() / np.exp(heavy).sum()
    assert 0.2 < shape < 0.8 and tail_variance(heavy) == pytest.approx((shape / (1.0 - shape) * excess) ** 2)
    assert pareto_shape(np.zeros(300)) == 0.0
    assert pareto_shape(np.zeros(3)) == np.inf


class PartlyImpossible(Gaussian):
    """A share of the parameter space has zero likelihood, as where simulations fail."""

    def __init__(self, share, ndim=2, sd=0.3):
        super().__init__(ndim, sd)
        self.share, self.points = share, set()

    def __call__(self, x):
        rows = np.atleast_2d(x)
        self.points.update(row.tobytes() for row in rows)
        chance = np.array([np.random.default_rng(np.abs(row.view(np.int64))).uniform() for row in rows])
        values = np.where(chance < self.share, -np.inf, super().__call__(rows))
        return values if np.ndim(x) == 2 else values[0]


def test_a_model_that_always_fails_is_noticed_soon():
    posterior = PartlyImpossible(1.0)
    with pytest.raises(ValueError, match="none of 55 draws of the guide has a finite log-probability: check the model"):
        run(posterior, DrawsOf(posterior.sample_prior, posterior.log_prior))
    assert len(posterior.points) == 55


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
@pytest.mark.parametrize("share", [0.2, pytest.param(0.9, marks=pytest.mark.slow)])
def test_a_model_that_often_fails_is_sampled(share):
    """Control: 20 % or 90 % of all points are impossible; the run ends with an answer, in each of ten cases."""
    for seed in range(10):
        posterior = PartlyImpossible(share)
        sampler = run(posterior, DrawsOf(posterior.sample_prior, posterior.log_prior), seed=seed)
        assert np.all(np.isfinite(sampler.get_log_prob()))
        error = sampler.log_evidence - (posterior.log_evidence + np.log(1.0 - share))
        assert abs(error) < 5.0 * sampler.log_evidence_error + 0.1 or sampler.verdict.status == "not usable"
        assert not sampler.failure_count
