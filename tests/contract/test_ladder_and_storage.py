"""What the samplers add to emcee's contract: ladder, evidence, their storage, errors and warnings."""

import warnings
from pathlib import Path

import emcee
import numpy as np
import pytest

from samplers import SamplingWarning, SMCSampler, TemperedSampler, TMCMCSampler
from samplers.moves.population_moves import RandomWalkMove
from samplers.presets import CHING_CHEN_2007, RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL
from samplers.reporting.arviz_data import to_arviz
from samplers.reporting.run_figure import plot_run
from samplers.reporting.summary import comparison_table, ladder_table, summary
from samplers.reports import AnnealingResult
from samplers.resampling import stratified
from samplers.settings import Settings
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
    assert all(
        s.evaluations == N * s.moves for s in sampler.ladder[1:]
    )  # the prior is unbounded, so all proposals are evaluated
    assert all(2 <= s.moves <= 7 and 0 < s.acceptance <= 1 for s in sampler.ladder)
    assert all(abs(s.effective_sample_size / (0.5 * N) - 1) < 1e-4 for s in sampler.ladder[:-1])
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


@pytest.mark.parametrize("recycle", [False, True])
def test_without_a_check(recycle):
    sampler = annealed(check_draws=0, recycle=recycle)
    assert sampler.log_evidence_check is None
    assert sampler.log_evidence == sampler.log_evidence_ladder
    assert sampler.log_evidence_error == sampler.ladder[-1].log_evidence_error


def test_two_estimates_that_disagree_widen_the_error_unless_the_higher_one_is_trusted():
    sampler = annealed()
    check = sampler.log_evidence_check
    check = check._replace(log_evidence=check.log_evidence - 10.0, error=0.01, pareto_shape=0.1)
    log_evidence, error = AnnealingResult(sampler.ladder, check).evidence
    assert log_evidence == check.log_evidence
    assert error == pytest.approx(5.0, abs=1.0)
    higher = check._replace(log_evidence=check.log_evidence + 20.0, error=0.3)
    assert AnnealingResult(sampler.ladder, higher).evidence == (higher.log_evidence, 0.3)
    unreliable = AnnealingResult(sampler.ladder, check._replace(pareto_shape=0.9))
    assert unreliable.evidence[0] == sampler.log_evidence_ladder


@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_recycling_needs_walkers():
    """By default, since with few walkers a mode can be lost unnoticed."""
    posterior = Gaussian()
    assert [SMCSampler(n, 3, posterior).settings.recycle for n in (149, 150)] == [False, True]
    assert SMCSampler(N, 3, posterior, recycle=True).settings.recycle
    assert not SMCSampler(500, 3, posterior, moves=emcee.moves.StretchMove()).settings.recycle


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


@pytest.mark.parametrize("resampling", ["multinomial", "residual", "stratified", "systematic", stratified])
def test_resampling_by_name_or_function(resampling):
    assert annealed(resampling=resampling).ladder[-1].beta == 1.0


def test_annealing_is_done_once():
    posterior = Gaussian()
    sampler = annealed(posterior, nsteps=2)
    ladder = sampler.ladder
    state = sampler.run_mcmc(None, 2)
    sampler.run_mcmc(state, 2)
    other = posterior.sample_prior(N, np.random.default_rng(5))
    sampler.run_mcmc(other, 0)  # coordinates other than the last: draws of the prior, annealed again
    assert sampler.ladder != ladder
    sampler = annealed(posterior := Gaussian(), nsteps=2)
    last, ladder, calls = sampler.get_last_sample(), sampler.ladder, posterior.calls
    sampler.run_mcmc(last.coords, 2)  # as in older emcee scripts: burn in, then continue from the positions
    assert sampler.ladder == ladder
    assert posterior.calls == calls + 2 * N
    sampler.reset()
    assert sampler.ladder == ladder == sampler._output.result.ladder


def test_annealing_without_steps_then_steps():
    sampler = annealed(nsteps=0)
    ladder = sampler.ladder
    assert isinstance(sampler.run_mcmc(None, 2), emcee.State)
    assert sampler.ladder == ladder
    assert sampler.iteration == 2


def test_a_state_with_log_prob_saves_evaluations():
    posterior = Gaussian()
    draws = posterior.sample_prior(N, np.random.default_rng(0))
    plain = SMCSampler(N, 3, posterior, vectorize=True, seed=1)
    plain.run_mcmc(draws, 1)
    spared = SMCSampler(N, 3, posterior, vectorize=True, seed=1)
    spared.run_mcmc(emcee.State(draws, log_prob=posterior(draws)), 1)
    assert np.array_equal(plain.get_chain(), spared.get_chain())
    assert spared.report()["new_evaluations"] == plain.report()["new_evaluations"] - N


def test_samplers_without_a_seed_have_different_streams():
    np.random.seed(5)  # noqa: NPY002
    first, second = annealed(seed=None).get_chain(), annealed(seed=None).get_chain()
    assert not np.array_equal(first, second)
    np.random.seed(5)  # noqa: NPY002
    assert np.array_equal(annealed(seed=None).get_chain(), first)


def test_a_finished_run_is_not_seeded_again(tmp_path):
    backend = emcee.backends.HDFBackend(str(tmp_path / "a.h5"))
    sampler = annealed(backend=backend)
    again = SMCSampler(N, 3, Gaussian(), backend=backend, vectorize=True, seed=3)
    for ours, theirs in zip(again.random_state, sampler.random_state, strict=True):
        assert np.all(ours == theirs)


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


def test_points_of_a_chain_follow_each_other():
    """Every point of the new population is one step away from the previous point of its chain."""
    from samplers.tempering.leaders import grow_chains
    from samplers.tempering.mutation import MoveSchedule
    from samplers.tempering.population import Population

    random = np.random.RandomState(0)
    ancestors = np.sort(random.randint(5, size=30))[random.permutation(30)]
    founders = 100.0 * random.standard_normal((5, 2))
    records = np.zeros(30, dtype=[("log_prob", float), ("log_prior", float)])

    class Flat:
        """A density that is the same everywhere."""

        map = map

        def evaluate(self, coords):
            return np.zeros(len(coords), dtype=records.dtype)

    move = RandomWalkMove(scale=1.0)
    move.calibrate(random.standard_normal((100, 2)), np.full(100, 0.01))
    population = Population(1.0, founders[ancestors], records, 30.0)
    settings = Settings(chains="leaders", burn_in=0)
    steps = grow_chains(population, ancestors, Flat(), random, MoveSchedule([move], [1.0]), settings)
    *_, (last, sweep) = steps
    assert sweep.acceptance == 1.0
    grown = last.coords
    assert len(np.unique(grown, axis=0)) == 30
    for leader in range(5):
        chain = np.concatenate([founders[leader : leader + 1], grown[ancestors == leader]])
        assert np.max(np.abs(np.diff(chain, axis=0))) < 6.0  # the founders are hundreds apart


# ---------------------------------------------------------------- storage


def test_ladder_beside_the_chain(tmp_path):
    import h5py

    path = str(tmp_path / "run.h5")
    sampler = annealed(backend=emcee.backends.HDFBackend(path, name="column"))
    with h5py.File(path) as file:
        assert {"tempering", "chain"} <= set(file["column"]) and "nothing" not in file
        assert file["column/chain"].shape == (3, N, 3)
    again = SMCSampler(N, 3, Gaussian(), backend=emcee.backends.HDFBackend(path, name="column"), vectorize=True)
    assert again.ladder == sampler.ladder
    assert again.log_evidence_check == sampler.log_evidence_check is not None
    assert (again.log_evidence, again.log_evidence_error) == (sampler.log_evidence, sampler.log_evidence_error)
    again.run_mcmc(None, 2)
    assert again.iteration == 5 and again.ladder == sampler.ladder


def test_a_new_annealing_replaces_the_ladder(tmp_path):
    backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
    sampler = annealed(Gaussian(sd=0.01), backend=backend)
    long = len(sampler.ladder)
    backend.reset(N, 3)
    sampler = SMCSampler(N, 3, Gaussian(sd=0.5), backend=backend, vectorize=True)
    sampler.run_mcmc(Gaussian().sample_prior(N, np.random.default_rng(0)), 1)
    assert SMCSampler(N, 3, Gaussian(sd=0.5), backend=backend, vectorize=True).ladder == sampler.ladder
    assert len(sampler.ladder) < long


class Interrupted(Gaussian):
    """Raises an error after a number of calls."""

    def __init__(self, error, after, **kwargs):
        super().__init__(**kwargs)
        self.error, self.after = error, after

    def __call__(self, x):
        if self.calls > self.after:
            raise self.error
        return super().__call__(x)


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("solver died")])
def test_an_exception_leaves_the_finished_stages(tmp_path, error):
    backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
    posterior = Interrupted(error, after=8 * N, sd=0.01)
    sampler = SMCSampler(N, 3, posterior, backend=backend, vectorize=True, seed=2)
    with pytest.raises(type(error)):
        sampler.run_mcmc(None, 5)
    assert 0 < len(sampler.ladder) and sampler.ladder[-1].beta < 1
    with pytest.raises(ValueError, match="the ladder ends at beta"):
        _ = sampler.log_evidence
    posterior.after = np.inf
    sampler.run_mcmc(None, 1)
    assert sampler.ladder[-1].beta == 1 and sampler.iteration == 1


# ---------------------------------------------------------------- errors, warnings


def test_no_evidence_before_a_run():
    sampler = SMCSampler(N, 3, Gaussian())
    assert sampler.ladder == ()
    for name in ("log_evidence", "log_evidence_error"):
        with pytest.raises(ValueError, match="call run_mcmc first"):
            getattr(sampler, name)


@pytest.mark.parametrize(
    "settings",
    [
        {"ess_ratio": 0.0},
        {"ess_ratio": 1.0},
        {"ess_ratio": np.nan},
        {"ess_rule": "sometimes"},
        {"ess_floor": N},
        {"ess_floor": -1.0},
        {"resampling": "wheel"},
        {"min_moves": 0},
        {"min_moves": 5, "max_moves": 4},
        {"max_correlation": 0.0},
        {"check_draws": -1},
        {"fast_sweeps": -1},
        {"fast_sweeps": 1.5},
    ],
    ids=str,
)
def test_impossible_settings(settings):
    with pytest.raises(ValueError, match=next(iter(settings)).replace("min_moves", "moves")):
        SMCSampler(N, 3, Gaussian(), **settings)


@pytest.mark.parametrize(
    "settings",
    [{"coefficient_of_variation": 0.0}, {"coefficient_of_variation": np.inf}, {"chains": "long"}, {"burn_in": -1}],
)
def test_impossible_settings_of_tmcmc(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        TMCMCSampler(N, 3, Gaussian(), **settings)


def test_impossible_problems():
    posterior = Gaussian()
    with pytest.raises(ValueError, match="at least 2 ndim walkers"):
        SMCSampler(5, 3, posterior)
    with pytest.raises(ValueError, match="log_prior_fn"):
        SMCSampler(N, 3, lambda x: 0.0)
    with pytest.raises(ValueError, match="callable"):
        SMCSampler(N, 3, 0.0, log_prior_fn=posterior.log_prior)
    unsampled = SMCSampler(N, 3, posterior.__call__, log_prior_fn=posterior.log_prior)
    with pytest.raises(ValueError, match="sample_prior"):
        unsampled.run_mcmc(None, 1)
    assert posterior.calls == 0


def test_impossible_starts():
    box = Box([0, 0], [1, 1], lambda x: 0.0 * x[..., 0])
    inside = box.sample_prior(N, np.random.default_rng(0))
    outside = inside.copy()
    outside[7] = 2.0
    nan = inside.copy()
    nan[3, 0] = np.nan
    for start, message in (
        (outside, r"1 of 40 initial points lie outside the prior's support"),
        (inside[:-1], "incompatible input dimensions"),
        (np.ones((N, 2)), "condition number"),
        (nan, "condition number"),
    ):
        with pytest.raises(ValueError, match=message):
            SMCSampler(N, 2, box).run_mcmc(start, 1)
    with pytest.raises(ValueError, match="no point of the population has a finite log-likelihood"):
        SMCSampler(N, 2, Box([0, 0], [1, 1], lambda x: -np.inf)).run_mcmc(inside, 1)
    with pytest.raises(ValueError, match="iterations"):
        next(SMCSampler(N, 2, box).sample(inside, iterations=None))
    with pytest.raises(ValueError, match="thinning"):
        SMCSampler(N, 2, box).run_mcmc(inside, 1, thin_by=0)


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


def test_nothing_is_evaluated_outside_the_prior():
    seen = []

    def log_likelihood(x):
        seen.append(np.array(x))
        return -50.0 * np.sum(x, axis=-1)  # piles up at the corner

    annealed(Box([0, 0], [1, 1], log_likelihood))
    seen = np.concatenate(seen)
    assert seen.min() >= 0 and seen.max() <= 1


def test_collapse_is_reported():
    with pytest.warns(SamplingWarning) as caught:
        posterior = Gaussian()
        SMCSampler(N, 3, posterior, vectorize=True, seed=1, moves=emcee.moves.GaussianMove(1e6)).run_mcmc(None, 1)
    messages = [str(w.message) for w in caught]
    assert len(messages) == 4  # each reason once, for any number of stages
    assert "were accepted, so the points did not move" in messages[0]
    assert "survived the resampling" in messages[1]
    assert "the weights of the second estimate are uneven" in messages[2]
    assert "standard error of the log-evidence" in messages[3]
    with pytest.warns(SamplingWarning, match="distinct points of 40 survived"):
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


def test_moves_too_short_are_reported():
    """The published steps of TMCMC leave points near their resampled start; ten full steps of a random walk do not."""
    found = [m for m in warnings_of(TMCMCSampler, Gaussian(2), **CHING_CHEN_2007) if "still correlated" in m]
    assert len(found) == 1 and "0.9" in found[0]
    for preset in (RAMANCHA_2022_CONSTANT, RAMANCHA_2022_LITERAL, {}, {"recycle": False}):
        assert not [m for m in warnings_of(SMCSampler, Gaussian(3), **preset) if "still correlated" in m]
    burnt = {**CHING_CHEN_2007, "moves": RandomWalkMove(), "burn_in": 15}
    assert not [m for m in warnings_of(TMCMCSampler, Gaussian(2), **burnt) if "still correlated" in m]


# ---------------------------------------------------------------- reporting


def test_to_arviz_writes_netcdf(tmp_path):
    import json

    import arviz

    runs = [annealed(seed=s) for s in (1, 2)]
    data = to_arviz(runs)
    assert data["posterior"]["x2"].shape == (2, 3 * N)
    in_order = np.sort(data["posterior"]["x2"][1])  # the draws are those of the chain, in another order
    assert np.array_equal(in_order, np.sort(runs[1].get_chain(flat=True)[:, 2]))
    data.to_netcdf(str(tmp_path / "run.nc"))
    stored = arviz.from_netcdf(str(tmp_path / "run.nc"))["sample_stats"]
    step, walker = (np.asarray(stored[name][0]) for name in ("step", "walker"))
    assert np.array_equal(stored["lp"][0], runs[0].get_log_prob()[step, walker])
    assert np.array_equal(data["posterior"]["x2"][0], runs[0].get_chain()[step, walker, 2])
    assert np.allclose(stored.attrs["log_evidence"], [run.log_evidence for run in runs])
    assert [row["beta"] for row in json.loads(stored.attrs["ladder"])[0]] == [s.beta for s in runs[0].ladder]
    plain = emcee.EnsembleSampler(N, 3, Gaussian())
    plain.run_mcmc(Gaussian().sample_prior(N, np.random.default_rng(0)), 2)
    assert to_arviz(plain, parameter_names=["a", "b", "c"])["posterior"]["a"].shape == (1, 2 * N)
    with pytest.raises(ValueError, match="one name per parameter"):
        to_arviz(plain, parameter_names=["a"])


def test_table_and_figures():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    sampler = annealed()
    table = ladder_table(sampler).splitlines()
    assert len(table) == len(sampler.ladder) + 4
    assert f"{sampler.log_evidence:.3f}" in table[-3]
    assert f"{sampler.log_evidence_ladder:.3f}" in table[-2]
    assert f"{sampler.log_evidence_check.log_evidence:.3f}" in table[-2]
    assert table[-1] == sampler.verdict.summary
    figure = plot_run(sampler)
    assert len(figure.axes[1].lines[0].get_xdata()) == len(sampler.ladder)
    plt.close("all")
    with pytest.raises(ValueError, match="call run_mcmc first"):
        plot_run(SMCSampler(N, 3, Gaussian()))


def test_summary_with_weights():
    values = np.array([[0.0, 1.0], [2.0, 1.0], [9.0, 1.0]])
    result = summary(values, ["a", "b"], weights=[1, 1, 0])
    assert np.array_equal(result.mean, [1, 1]) and np.array_equal(result.sd, [1, 0])
    assert np.array_equal(result.cv, [1, 0])
    assert str(result).splitlines()[1].split() == ["a", "1", "-", "1", "-", "1"]
    for weights in ([1, 1], [0, 0, 0], [1, -1, 1]):
        with pytest.raises(ValueError, match="weights"):
            summary(values, weights=weights)


def test_summary_with_errors_of_mean_and_standard_deviation():
    sampler = annealed()
    result = summary(sampler.get_chain(flat=True), None, None, sampler.mean_error(), sampler.sd_error())
    assert np.array_equal(result.mean_error, sampler.mean_error())
    assert np.array_equal(result.sd_error, sampler.sd_error())
    rows = str(result).splitlines()
    assert rows[0].count("MC error") == 2
    assert [rows[3].split()[column] for column in (2, 4)] == [
        f"{e[2]:.2g}" for e in (result.mean_error, result.sd_error)
    ]
    for error in (sampler.mean_error, sampler.sd_error):
        with pytest.raises(ValueError, match=f"{error.__name__}: .* the number of stored steps; got discard=99"):
            error(discard=99)
    for name in ("mean_error", "sd_error"):
        with pytest.raises(ValueError, match=f"{name} must be 3"):
            summary(sampler.get_chain(flat=True), **{name: [0.1, 0.1]})


def test_samplers_side_by_side():
    posterior = Gaussian()
    tmcmc = TMCMCSampler(N, 3, posterior, vectorize=True, seed=1)
    tmcmc.run_mcmc(None, 4)
    plain = emcee.EnsembleSampler(N, 3, posterior, vectorize=True)
    plain.random_state = np.random.RandomState(1).get_state()
    plain.run_mcmc(posterior.sample_prior(N, np.random.default_rng(0)), 600)
    samplers = {"SMC": annealed(), "TMCMC": tmcmc, "emcee": plain}
    table = comparison_table(samplers, seconds={"emcee": 12.5}, discard=100)
    assert table.names == tuple(samplers)
    assert table.evaluations == (samplers["SMC"].evaluations, tmcmc.evaluations, 600 * N)
    assert 0 < table.seconds[0] == samplers["SMC"].seconds and table.seconds[2] == 12.5
    assert sum(s.seconds for s in tmcmc.ladder) < tmcmc.seconds < 60
    worst = (tmcmc.get_chain(flat=True).std(axis=0) / tmcmc.mean_error()).min() ** 2
    assert table.effective_sample_size[1] == pytest.approx(worst)
    assert N / 3 < worst < 8 * N
    # the autocorrelation time of the stretch move in three dimensions is some 30 to 50 sweeps
    assert 500 * N / 80 < table.effective_sample_size[2] < 500 * N / 15
    assert table.log_evidence == (samplers["SMC"].log_evidence, tmcmc.log_evidence, None)
    rows = str(table).splitlines()
    assert len(rows) == 4 and len({len(row) for row in rows}) == 1
    assert rows[3].split()[0] == "emcee" and rows[3].split()[-1] == "-"
    assert str(comparison_table({"emcee": plain})).splitlines()[1].split()[2] == "-"
    with pytest.raises(ValueError, match="seconds are given"):
        comparison_table(samplers, seconds={"dynesty": 1.0})
    again = SMCSampler(N, 3, posterior, backend=tmcmc.backend)
    for nothing in (again, SMCSampler(N, 3, posterior)):
        with pytest.raises(ValueError, match="has made no chain in this process"):
            comparison_table({"nothing": nothing})


def test_the_base_class_samples():
    posterior = Gaussian()
    sampler = TemperedSampler(N, 3, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 2)
    assert sampler.ladder[-1].beta == 1
