"""What the samplers add to emcee's contract: ladder, evidence, their storage, errors and warnings."""

import warnings
from pathlib import Path
from types import SimpleNamespace

import emcee
import numpy as np
import pytest

from fe_likelihoods.likelihood.parameters import Parameter
from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
from samplers.reporting.summary import summary
from tests.contract.targets import Box, Gaussian

N = 40


def annealed(posterior=None, nsteps=3, **kwargs):
    posterior = posterior or Gaussian()
    sampler = SMCSampler(N, posterior.ndim, posterior, vectorize=True, **{"seed": 3, **kwargs})
    sampler.run_mcmc(None, nsteps)
    return sampler


# ---------------------------------------------------------------- the ladder


def test_stages_account_for_everything():
    posterior = Gaussian()
    sampler = annealed(posterior, nsteps=0, recycle=False)
    betas = [s.beta for s in sampler.ladder]
    assert betas == sorted(set(betas)) and betas[-1] == 1.0
    check = sampler.log_evidence_check
    assert check.evaluations == N
    asked = sum(s.evaluations for s in sampler.ladder) + N
    assert 0.98 * asked < sampler.evaluations == posterior.calls <= asked  # a point that is proposed again is known
    # the prior is unbounded, so all proposals are evaluated
    assert all(s.evaluations == N * s.moves for s in sampler.ladder[1:])
    assert all(2 <= s.moves <= 7 and 0 < s.acceptance <= 1 for s in sampler.ladder)
    sizes = [4 * N] + [N] * len(sampler.ladder)
    for stage, size in zip(sampler.ladder[:-1], sizes, strict=False):
        assert abs(stage.effective_sample_size / (0.5 * size) - 1) < 1e-4
    assert sampler.ladder[-1].effective_sample_size >= 0.5 * N
    assert sampler.log_evidence_ladder == sum(s.log_evidence_increment for s in sampler.ladder)
    assert sampler.ladder[-1].log_evidence_error > 0
    assert all(s.seconds > 0 for s in sampler.ladder)


def test_recycling_accounts_for_everything():
    posterior = Gaussian(sd=0.02)
    sampler = annealed(posterior, nsteps=0, recycle=True)
    betas = [s.beta for s in sampler.ladder]
    assert betas == sorted(set(betas)) and betas[-1] == 1.0
    assert [s.moves for s in sampler.ladder] == [0] * len(betas)
    check = sampler.log_evidence_check
    assert sum(s.evaluations for s in sampler.ladder) + check.evaluations == sampler.evaluations == posterior.calls
    assert abs(check.log_evidence - posterior.log_evidence) < 4 * check.error
    assert abs(sampler.log_evidence_ladder - posterior.log_evidence) < 4 * sampler.ladder[-1].log_evidence_error
    assert sampler.log_evidence in (check.log_evidence, sampler.log_evidence_ladder)
    assert sampler.evaluations < annealed(Gaussian(sd=0.02), nsteps=0, recycle=False).evaluations


def test_recycling_that_fails_falls_back_to_moves(caplog):
    """A ring in two dimensions and an exponential corner in six, which no mixture fits."""

    def log_likelihood(x):
        ring = -0.5 * ((np.hypot(x[..., 0] - 0.5, x[..., 1] - 0.5) - 0.4) / 0.002) ** 2
        return ring - 400.0 * np.sum(x[..., 2:], axis=-1)

    posterior = Box(np.zeros(8), np.ones(8), log_likelihood)
    with caplog.at_level("INFO", logger="samplers"):
        sampler = annealed(posterior, nsteps=0, recycle=True)
    assert "the result of recycling is not reliable, because" in caplog.text
    assert all(s.moves >= 2 for s in sampler.ladder)
    check = sampler.log_evidence_check
    asked = sum(s.evaluations for s in sampler.ladder) + check.evaluations
    assert 0.98 * asked < sampler.evaluations <= asked


def test_presets_targets_and_moves():
    for preset, rule in ((RAMANCHA_2022_CONSTANT, lambda j: 0.95 * 200), (RAMANCHA_2022_LITERAL, None)):
        posterior = Gaussian(2)
        sampler = SMCSampler(200, 2, posterior, vectorize=True, seed=1, **preset)
        sampler.run_mcmc(None, 0)
        for j, s in enumerate(sampler.ladder[:-1], start=1):
            wanted = rule(j) if rule else max(50.0, 200 * 0.95**j)
            assert s.effective_sample_size == pytest.approx(wanted, rel=1e-4)
            assert s.moves == 10
    assert RAMANCHA_2022_LITERAL["moves"]._root is None  # the sampler works on copies


def test_annealing_is_done_once():
    posterior = Gaussian()
    sampler = annealed(posterior, nsteps=2)
    ladder = sampler.ladder
    state = sampler.run_mcmc(None, 2)
    sampler.run_mcmc(state, 2)
    assert sampler.ladder == ladder
    sampler = annealed(posterior := Gaussian(), nsteps=2)
    last, ladder, calls = sampler.get_last_sample(), sampler.ladder, posterior.calls
    sampler.run_mcmc(last.coords, 2)  # as in older emcee scripts: burn in, then continue from the positions
    assert sampler.ladder == ladder
    assert 0.98 * 2 * N < posterior.calls - calls <= 2 * N  # a point that is proposed again is known
    sampler.reset()
    assert sampler.ladder == ladder == sampler._chain.result.ladder


def test_a_state_with_log_prob_saves_evaluations():
    posterior, spared = Gaussian(), Gaussian()
    draws = posterior.sample_prior(N, np.random.default_rng(0))
    chains = []
    for target, start in ((posterior, draws), (spared, emcee.State(draws, log_prob=posterior(draws)))):
        sampler = SMCSampler(N, 3, target, vectorize=True, seed=1)
        sampler.run_mcmc(start, 1)
        chains.append(sampler.get_chain())
    assert np.array_equal(*chains) and spared.calls == posterior.calls - 2 * N


def test_samplers_without_a_seed_have_different_streams():
    np.random.seed(5)  # noqa: NPY002
    first, second = annealed(seed=None).get_chain(), annealed(seed=None).get_chain()
    assert not np.array_equal(first, second)
    np.random.seed(5)  # noqa: NPY002
    assert np.array_equal(annealed(seed=None).get_chain(), first)


def test_published_tmcmc_grows_chains_from_leaders():
    posterior = Gaussian(2)
    sampler = TMCMCSampler(200, 2, posterior, vectorize=True, seed=1, **CHING_CHEN_2007)
    sampler.run_mcmc(None, 0)
    for stage in sampler.ladder:
        assert stage.moves == 1
        assert stage.evaluations <= 200 * (2 if stage is sampler.ladder[0] else 1)
    for stage in sampler.ladder[:-1]:  # a coefficient of variation of one
        assert 200 / stage.effective_sample_size - 1 == pytest.approx(1.0, rel=1e-3)
    burnt = TMCMCSampler(
        200, 2, Gaussian(2), vectorize=True, seed=1, **{**CHING_CHEN_2007, "burn_in": 5, "max_correlation": 1.0}
    )
    burnt.run_mcmc(None, 0)
    assert {s.moves for s in burnt.ladder} == {6}
    stage = burnt.ladder[2]
    assert 5 * stage.distinct_ancestors + 200 <= stage.evaluations < 6 * 200


# ---------------------------------------------------------------- errors, warnings


def test_no_evidence_before_a_run():
    sampler = SMCSampler(N, 3, Gaussian())
    assert sampler.ladder == ()
    for name in ("log_evidence", "log_evidence_error"):
        with pytest.raises(ValueError, match="call run_mcmc first"):
            getattr(sampler, name)


BOX = Box([0, 0], [1, 1], lambda x: 0.0 * x[..., 0])
INSIDE = BOX.sample_prior(N, np.random.default_rng(0))


def changed(row, value):
    """The starting points with another point."""
    points = INSIDE.copy()
    points[row] = value
    return points


@pytest.mark.parametrize(
    ("log_prob", "start", "arguments", "message"),
    [
        (BOX, changed(7, 2.0), {}, "1 of 40 initial points lie outside the prior's support"),
        (BOX, INSIDE[:-1], {}, "incompatible input dimensions"),
        (BOX, np.ones((N, 2)), {}, "condition number"),
        (BOX, changed(3, [np.nan, 0.5]), {}, "condition number"),
        (Box([0, 0], [1, 1], lambda x: -np.inf), INSIDE, {}, "no point of the population has a finite log-likelihood"),
        (BOX, INSIDE, {"thin_by": 0}, "thinning"),
        (BOX, INSIDE, {"iterations": None}, "iterations"),
        (lambda x: 0.0, INSIDE, {}, "log_prior_fn"),
        (0.0, INSIDE, {}, "callable"),
        (BOX.__call__, None, {"log_prior_fn": BOX.log_prior}, "sample_prior"),
        (BOX, INSIDE, {"nwalkers": 3}, "at least 2 ndim walkers"),
    ],
)
def test_impossible_problems_and_starts(log_prob, start, arguments, message):
    made = {name: arguments.pop(name) for name in ("nwalkers", "log_prior_fn") if name in (arguments := {**arguments})}
    with pytest.raises(ValueError, match=message):
        sampler = SMCSampler(made.pop("nwalkers", N), 2, log_prob, **made)
        next(sampler.sample(start, **arguments))


def test_a_chain_of_another_sampler_is_no_start():
    posterior, backend = Gaussian(), emcee.backends.Backend()
    emcee.EnsembleSampler(N, 3, posterior, backend=backend).run_mcmc(
        posterior.sample_prior(N, np.random.default_rng(0)), 3
    )
    with pytest.raises(ValueError, match="not annealed"):
        SMCSampler(N, 3, posterior, backend=backend).run_mcmc(None, 1)


@pytest.mark.parametrize(
    "vectorize, answer, message",
    [
        (False, None, "must return a number"),
        (False, "-3.5", "must return a number"),
        (False, np.zeros(0), "one number per point"),
        (False, 1j, "one number per point"),
        (False, np.inf, r"\+inf"),
        (True, None, "NoneType"),
        (True, 0.0, "vectorize=False"),
        (True, "text", "str"),
        (True, np.zeros(7), "40 numbers for 40 points; got 7"),
        (True, np.full(N, "a"), "must return a number"),
    ],
)
def test_wrong_answers_of_log_prob_fn(vectorize, answer, message):
    posterior = Gaussian()
    if vectorize is False and isinstance(answer, np.ndarray):
        answer = [answer]
    sampler = SMCSampler(N, 3, lambda x: answer, vectorize=vectorize, log_prior_fn=posterior.log_prior)
    with pytest.raises(ValueError, match=message):
        sampler.run_mcmc(posterior.sample_prior(N, np.random.default_rng(0)), 1)


def test_nan_counts_as_a_failure_and_is_reported():
    def log_likelihood(x):
        return np.where(x[..., 0] < 0.25, np.nan, -x[..., 1])

    posterior = Box([0, 0], [1, 1], log_likelihood)
    sampler = SMCSampler(N, 2, posterior, vectorize=True, seed=1)
    with pytest.warns(SamplingWarning, match="evaluations failed and count as impossible") as caught:
        sampler.run_mcmc(None, 5)
    assert sampler.failure_count > 0
    assert f"{sampler.failure_count} evaluations failed" in str(caught[0].message)
    assert f"{sampler.failure_count} x log_prob_fn returned NaN" in str(caught[0].message)
    assert all(failure["parameters"][0] < 0.25 for failure in sampler.failures)
    chain = sampler.get_chain(flat=True)
    assert chain[:, 0].min() >= 0.25
    assert np.all(np.isfinite(sampler.get_log_prob()))


def test_collapse_is_reported():
    with pytest.warns(SamplingWarning) as caught:
        posterior = Gaussian()
        SMCSampler(N, 3, posterior, vectorize=True, seed=1, moves=emcee.moves.GaussianMove(1e6)).run_mcmc(None, 1)
    messages = [str(w.message) for w in caught]
    for said in ("importance sampling from the final points gives", "standard error of the log-evidence"):
        assert sum(said in message for message in messages) == 1  # each reason once, for any number of stages
    with pytest.warns(SamplingWarning, match="estimates of the evidence|log-evidence"):
        posterior = Gaussian(sd=1e-3)
        SMCSampler(N, 3, posterior, vectorize=True, seed=1, ess_ratio=0.03, recycle=False).run_mcmc(None, 1)


def warnings_of(Sampler, posterior, nwalkers=200, **settings):
    """Messages of the warnings of one run."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        Sampler(nwalkers, posterior.ndim, posterior, vectorize=True, **{"seed": 1, **settings}).run_mcmc(None, 1)
    return [str(warning.message) for warning in caught]


def test_warnings_point_at_the_line_that_ran_the_sampler():
    """Whichever part of the sampler issues them, from within emcee or a generator."""

    def log_likelihood(x):
        return np.where(x[..., 0] < 0.25, np.nan, -x[..., 1])

    failing, lines = SMCSampler(N, 2, Box([0, 0], [1, 1], log_likelihood), vectorize=True, seed=1), []
    stuck = SMCSampler(N, 3, Gaussian(), vectorize=True, seed=1, moves=emcee.moves.GaussianMove(1e6))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", SamplingWarning)
        for sampler in (failing, stuck):
            sampler.run_mcmc(None, 1)  # the line
            lines += [(warning.filename, warning.lineno) for warning in caught]
    (place,) = set(lines)
    assert place[0] == __file__ and Path(__file__).read_text().splitlines()[place[1] - 1].endswith("# the line")


# ---------------------------------------------------------------- reporting


def test_summary_with_errors_of_mean_and_standard_deviation():
    sampler = annealed()
    result = summary(sampler.get_chain(flat=True), None, sampler.mean_error(), sampler.sd_error())
    assert np.array_equal(result["mean_error"], sampler.mean_error())
    assert np.array_equal(result["sd_error"], sampler.sd_error())
    np.testing.assert_allclose(result["cv"], result["sd"] / np.abs(sampler.get_chain(flat=True).mean(axis=0)))
    for error in (sampler.mean_error, sampler.sd_error):
        with pytest.raises(ValueError, match="below the number of stored steps; got discard=99"):
            error(discard=99)
    parameters = [Parameter("k"), Parameter("c", "-"), Parameter("sigma_top", "mm", 1e-3)]
    shown = summary(sampler.get_chain(flat=True), parameters, sampler.mean_error())
    assert list(shown.index) == ["k", "c [-]", "sigma_top [mm]"] and "sd_error" not in shown
    for name in ("mean", "sd", "mean_error"):
        np.testing.assert_allclose(shown[name], result[name] * [1.0, 1.0, 1e3])
    posterior = SimpleNamespace(parameters=parameters)
    assert summary(sampler.get_chain(flat=True), posterior, sampler.mean_error()).equals(shown)
    with pytest.raises(ValueError, match="does not match length of index"):
        summary(sampler.get_chain(flat=True), mean_error=[0.1, 0.1])
