"""Annealing that starts on a cheaper model: the result is that of the fine model, whatever the cheaper one is."""

import emcee
import numpy as np
import pytest
from scipy import stats

from samplers import SamplingWarning, SMCSampler, TMCMCSampler
from samplers.reporting.summary import ladder_table
from samplers.tempered import TemperedSampler
from tests.contract.targets import Box, Gaussian, WithBlobs
from tests.statistics.test_posteriors import deviations, evidence_deviation, runs, within

SD = 0.01
FINE = Gaussian(7, sd=SD)
CLOSE = Gaussian(7, sd=1.5 * SD, centre=0.7 + 1.5 * SD)


def gaussian_is_right(samplers, posterior=FINE):
    return (
        within(deviations(samplers, posterior.mean), samplers)
        and within(deviations(samplers, posterior.sd**2, lambda x: (x - posterior.mean) ** 2), samplers)
        and within(evidence_deviation(samplers, posterior.log_evidence), samplers)
    )


@pytest.mark.filterwarnings("error::samplers.SamplingWarning")
def test_a_close_coarse_model_saves_evaluations(seed):
    plain, helped = (runs(FINE, seed, count=4, nwalkers=400, nsteps=1, coarse_log_prob_fn=c) for c in (None, CLOSE))
    assert gaussian_is_right(helped)
    on_the_way = [sum(stage.evaluations for s in group for stage in s.ladder[:-1]) for group in (plain, helped)]
    assert 2 * on_the_way[1] < on_the_way[0]
    assert sum(s.evaluations for s in helped) < sum(s.evaluations for s in plain)
    assert all(s.coarse_evaluations == 0 for s in plain)
    errors = np.array([s.log_evidence - FINE.log_evidence for s in helped])
    assert np.all(np.abs(errors) < 4.5 * np.array([s.log_evidence_error for s in helped]))


def test_evaluations_are_counted_apart(seed):
    fine, coarse = Gaussian(3, sd=0.1), Gaussian(3, sd=0.15)
    sampler = runs(fine, seed, count=1, nwalkers=250, coarse_log_prob_fn=coarse)[0]
    assert (sampler.evaluations, sampler.coarse_evaluations) == (fine.calls, coarse.calls)
    in_chain = 4 * 250
    assert sum(s.evaluations for s in sampler.ladder) == fine.calls - in_chain - sampler.log_evidence_check.evaluations
    assert f"{coarse.calls} evaluations of the coarse model" in ladder_table(sampler)


@pytest.mark.slow
def test_a_bent_posterior(seed):
    """x1 follows 2 x0^2; the coarse ridge is wider, and beside it."""

    def ridge(shift, width):
        def log_likelihood(x):
            x = x - shift
            z = np.stack([x[..., 0] / 0.3, (x[..., 1] - 2 * x[..., 0] ** 2) / 0.05, x[..., 2] / 0.1])
            return np.sum(stats.norm.logpdf(z / width), axis=0) - np.log(0.3 * 0.05 * 0.1 * width**3)

        return log_likelihood

    fine, coarse = (Box([-3] * 3, [3] * 3, ridge(*args)) for args in ((0.0, 1.0), (np.array([0.1, 0.1, 0.05]), 1.5)))
    samplers = runs(fine, seed, nwalkers=300, coarse_log_prob_fn=coarse)
    assert within(deviations(samplers, [0.0, 0.18, 0.0]), samplers)
    assert within(deviations(samplers, 0.09, lambda x: x[:, 0] ** 2), samplers)
    assert within(evidence_deviation(samplers, -3 * np.log(6)), samplers)


@pytest.mark.parametrize("coarse_weight", [1.0, pytest.param(0.02, marks=pytest.mark.slow)], ids=["missed", "small"])
def test_a_mode_the_coarse_model_misses(coarse_weight, seed):
    """Two modes, 1:2; the coarse model has the smaller one alone, or nearly so."""
    centres = np.array([[1.0, 1.0, 1.0], [2.0, 1.0, 1.5]])

    def modes(weights):
        def log_likelihood(x):
            parts = [np.sum(stats.norm.logpdf(x, centre, 0.1), axis=-1) for centre in centres]
            with np.errstate(divide="ignore"):
                return np.logaddexp(*(np.log(w) + part for w, part in zip(weights, parts, strict=True)))

        return Box([0] * 3, [3] * 3, log_likelihood)

    coarse = modes([coarse_weight, 1.0 - coarse_weight])
    samplers = runs(modes([1 / 3, 2 / 3]), seed, nwalkers=300, nsteps=2, coarse_log_prob_fn=coarse)
    assert within(deviations(samplers, 2 / 3, lambda x: x[:, 0] > 1.5), samplers)
    assert within(evidence_deviation(samplers, -3 * np.log(3)), samplers)


@pytest.mark.parametrize("distance", [10, pytest.param(50, marks=pytest.mark.slow)])
def test_a_coarse_model_far_away(distance, seed):
    """It is of no use, says so, and does no harm."""
    coarse = Gaussian(7, sd=SD, centre=0.7 + distance * SD)
    with pytest.warns(SamplingWarning, match="the coarse posterior is .*far"):
        samplers = runs(FINE, seed, count=4, nwalkers=300, nsteps=1, coarse_log_prob_fn=coarse)
    assert gaussian_is_right(samplers)


class Broken(Gaussian):
    def __call__(self, x):
        raise RuntimeError("no licence")


@pytest.mark.parametrize(
    "coarse",
    [Broken(3), lambda x: np.full(len(x), -np.inf), lambda x: np.full(len(x), np.nan)],
    ids=["raises", "-inf", "nan"],
)
def test_a_coarse_model_that_fails(coarse, seed, caplog):
    posterior = Gaussian(3)
    with pytest.warns(SamplingWarning, match="annealing on the coarse model failed"):
        samplers = runs(posterior, seed, count=4, nwalkers=250, nsteps=1, coarse_log_prob_fn=coarse)
    assert gaussian_is_right(samplers, posterior)
    assert all(s.failure_count == 0 for s in samplers)
    assert ("no licence" in caplog.text) == isinstance(coarse, Broken)


def test_a_constant_in_the_coarse_likelihood_changes_no_draw(seed):
    plain, shifted = (
        runs(Gaussian(3), seed, count=1, nwalkers=250, coarse_log_prob_fn=Gaussian(3, sd=0.2, offset=c))[0]
        for c in (0.0, -5000.0)
    )
    assert np.array_equal(plain.get_chain(), shifted.get_chain())
    assert plain.log_evidence == shifted.log_evidence


def test_points_one_by_one_and_blobs(seed):
    """The coarse model is called in the same way as the fine one; its blobs are not kept."""
    batch, single = (
        SMCSampler(250, 3, WithBlobs(), vectorize=vectorize, seed=seed, coarse_log_prob_fn=WithBlobs(sd=0.2))
        for vectorize in (True, False)
    )
    for sampler in (batch, single):
        sampler.run_mcmc(None, 2)
        chain, blobs = sampler.get_chain(), sampler.get_blobs()
        assert np.allclose(blobs[..., 0], np.sum(chain**2, axis=-1))
    assert np.allclose(batch.get_chain(), single.get_chain())


def test_what_cannot_work_is_refused():
    posterior = Gaussian(3)
    for Sampler, n, settings, message in (
        (SMCSampler, 100, {}, "SMCSampler with 100 walkers: use more walkers or pass recycle=True"),
        (SMCSampler, 300, {"recycle": False}, "walkers and recycle=False: use more walkers or pass recycle=True"),
        (SMCSampler, 300, {"moves": emcee.moves.StretchMove()}, "pass recycle=True .* no moves given"),
        (TemperedSampler, 300, {}, "TemperedSampler with 300 walkers: pass recycle=True"),
        (TMCMCSampler, 300, {}, "TMCMCSampler does not recycle: use SMCSampler"),
    ):
        with pytest.raises(ValueError, match=f"coarse_log_prob_fn needs recycling, .*{message}"):
            Sampler(n, 3, posterior, vectorize=True, coarse_log_prob_fn=posterior, **settings)
    with pytest.raises(ValueError, match="coarse_log_prob_fn must be callable"):
        SMCSampler(300, 3, posterior, vectorize=True, coarse_log_prob_fn=3.0)


# ---------------------------------------------------------------- going on with a killed run


def on_file(path, seed=5, **changes):
    kwargs = {"coarse_log_prob_fn": Gaussian(3, sd=0.2), "vectorize": True, "seed": seed} | changes
    return SMCSampler(250, 3, Gaussian(3), backend=emcee.backends.HDFBackend(str(path)), **kwargs)


def test_a_run_goes_on(tmp_path):
    """Equal to the last bit; the fine model is not evaluated again, the coarse annealing is repeated."""
    path = tmp_path / "run.h5"
    whole = on_file(path)
    whole.run_mcmc(None, 3)
    whole.backend.close()
    journal = path.with_name(path.name + ".mcmc.journal")
    journal.write_bytes(journal.read_bytes()[: int(0.3 * journal.stat().st_size)])
    sampler = on_file(path, seed=99)
    sampler.run_mcmc(None, 3)
    assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert sampler.log_evidence == whole.log_evidence
    assert sampler.coarse_evaluations == whole.coarse_evaluations
    assert sampler.log_prob_fn.f.calls < 0.8 * whole.log_prob_fn.f.calls


@pytest.mark.parametrize("then", ["none", "another"])
def test_another_coarse_model_is_refused(then, tmp_path):
    class Known(Gaussian):
        fingerprint = "another"

    on_file(tmp_path / "run.h5").run_mcmc(None, 1)
    other = on_file(tmp_path / "run.h5", coarse_log_prob_fn=None if then == "none" else Known(3))
    with pytest.raises(ValueError, match="coarse_log_prob_fn was"):
        other.run_mcmc(None, 1)
