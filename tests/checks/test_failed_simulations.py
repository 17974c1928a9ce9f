"""What a report says about failed simulations: how many, where, and whether they border on the samples."""

import emcee
import numpy as np
import pytest
from emcee.backends import HDFBackend

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionLikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    SimulationFailed,
    TruncatedNormal,
    report,
)
from fe_likelihoods.checks.result import failures, read_run
from fe_likelihoods.reporting.report import gather
from samplers import SMCSampler
from tests.contract.targets import Gaussian
from tests.reporting.report_page import read_page

TIME = 0.02 * np.arange(150)


def free_vibration(theta, limit=1.1, numbers=False):
    if theta[0] > limit:
        raise SimulationFailed(f"no convergence, residual {theta[0]:.9e}" if numbers else "no convergence")
    omega = 2.0 * np.pi * 2.0 * np.sqrt(theta[0])
    return [0.05 * np.exp(-0.02 * theta[1] * omega * TIME) * np.cos(omega * TIME)]


def posterior_of(truth, function=free_vibration, **options):
    """A model that fails above a stiffness of 1.1, with data of a model that does not."""
    model = FunctionModel(function, ["stiffness", "damping"], [Channel("top", "displacement", "mm")], 0.02, len(TIME))
    noise = 0.002 * np.random.default_rng(1).standard_normal((1, len(TIME)))
    measured = Measurements(model.channels, model.dt, np.array(free_vibration(truth, np.inf)) + noise)
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")} | {"sigma_top": HalfNormal(0.01)}
    return Posterior(FELikelihood(model, measured, **options), prior)


def run(posterior, walkers=60, steps=4, **options):
    made = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=1, **options)
    made.run_mcmc(None, steps)
    return made


def notes_of(contents):
    return {note.kind: note for note in contents["findings"]}


def test_a_run_that_is_piled_up_against_failures_is_not_called_good():
    posterior = posterior_of([1.1003, 0.8])
    sampler = run(posterior)
    contents = gather(read_run(sampler, posterior))
    (row,) = contents["failures"].rows
    assert row[0] == "no convergence"
    assert contents["failures"].count == posterior.report()["failure_count"]
    note = notes_of(contents)["Failures border on the samples"]
    assert note.severity == "wrong" and contents["status"] == "do not use"
    # one place decides: the sampler
    assert sampler.verdict.status == "not usable"
    assert f"{sampler._near.failed} of {sampler._near.evaluated} evaluated points in" in note.text
    assert (
        contents["summary"][0].startswith("Do not use: ") and "failures border on the samples" in contents["summary"][0]
    )


def test_reasons_that_differ_in_their_numbers_are_one_row(tmp_path):
    posterior = posterior_of([1.05, 0.8], lambda theta: free_vibration(theta, numbers=True))
    sampler = run(posterior)
    posterior.likelihood.simulate([[1.1 + 1e-3 * k, 1.0] for k in range(1, 131)])
    text = read_page(report(sampler, posterior, out=tmp_path / "run.html")).text  # it makes simulations as well
    found = failures(read_run(sampler, posterior))
    ((reason, count, example),) = found.rows
    assert (reason, count) == ("no convergence, residual #", found.count)
    assert count == posterior.report()["failure_count"] > 130
    stiffness, damping = np.array([list(each["parameters"].values()) for each in posterior.report()["failures"]]).T
    first = f"{stiffness[0]:.4g}, damping = {damping[0]:.4g}"
    assert example == f"no convergence, residual {stiffness[0]:.9e}: stiffness = {first}"
    assert text.count("no convergence, residual") == 3  # of the finding, and of the row


@pytest.mark.slow
def test_control_failures_far_from_the_samples_are_no_severe_doubt():
    posterior = posterior_of([1.05, 0.8])
    sampler = run(posterior)
    contents = gather(read_run(sampler, posterior))
    assert contents["failures"].count > 10
    assert "Failures border on the samples" not in notes_of(contents)
    assert contents["status"] != "do not use" and sampler.verdict.status != "not usable"


def test_failures_that_are_not_counted_are_not_known(tmp_path):
    posterior = posterior_of([1.0, 0.8])
    sampler = run(posterior)
    assert failures(read_run(sampler, posterior)).count > 0
    elsewhere = failures(read_run(sampler, posterior_of([1.0, 0.8])))
    assert elsewhere.count == 0 and elsewhere.unknown.startswith("Not known")
    target = Gaussian(ndim=2)
    chain = emcee.EnsembleSampler(20, 2, target, vectorize=True)
    chain.run_mcmc(0.7 + 0.1 * np.random.default_rng(3).standard_normal((20, 2)), 30)
    page = read_page(report(chain, out=tmp_path / "plain.html"))
    assert "Not known: neither the sampler nor the log-density counts failures" in page.text
    assert "No simulation failed" not in page.text
    assert "-inf" in failures(read_run(run(target), target)).unknown


@pytest.mark.parametrize("what", ["model", "models", "function"])
def test_a_reopened_run_counts_the_failures_of_its_record(what, tmp_path):
    def opened():
        prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
        likelihood = posterior_of([1.0, 0.8]).likelihood
        if what == "models":
            likelihood = JointLikelihood({"one": likelihood, "two": posterior_of([1.0, 0.8]).likelihood})
        if what == "function":
            likelihood = FunctionLikelihood(
                lambda x: np.nan if x[0] > 1.1 else -5.0 * np.sum((x - 1.0) ** 2), list(prior)
            )
        else:
            prior["sigma_top"] = HalfNormal(0.01)
        posterior, backend = Posterior(likelihood, prior), HDFBackend(tmp_path / "run.h5")
        return posterior, SMCSampler(
            20, posterior.ndim, posterior, vectorize=True, seed=1, max_moves=3, backend=backend
        )

    posterior, sampler = opened()
    sampler.run_mcmc(None, 1)
    count, before = posterior.report()["failure_count"], failures(read_run(sampler, posterior))
    again, reopened = opened()
    said = f" {count} of {reopened.simulations:.0f} simulations failed"
    assert count > 3 and said in reopened.describe()
    reopened.run_mcmc(None, 0)
    report = again.report()
    assert report["simulations"] == 0 and said in reopened.describe()
    assert report["failure_count"] == count and report["failures"] == posterior.report()["failures"]
    found = failures(read_run(reopened, again))
    assert (found.count, found.attempts, found.unknown) == (before.count, before.attempts, before.unknown)
    assert [row[0] for row in found.rows] == [row[0] for row in before.rows]


def test_runs_on_one_posterior_count_their_own_failures():
    """Other runs of the same posterior had been counted as well; the verdict and `failures` had named none."""
    posterior, counts = posterior_of([1.0, 0.8]), []
    for seed in (1, 2):
        before = posterior.report()["failure_count"]
        sampler = SMCSampler(20, posterior.ndim, posterior, vectorize=True, seed=seed, max_moves=3)
        sampler.run_mcmc(None, 1)
        counts.append(posterior.report()["failure_count"] - before)
        assert f"{counts[-1]} of {sampler.simulations:.0f} simulations failed" in str(sampler.verdict)
        assert len(sampler.failures) >= counts[-1] > 5
        assert all(posterior(each["parameters"]) == -np.inf and each["reason"] for each in sampler.failures[:3])


@pytest.mark.parametrize("memory_rows", [0, 10, 100_000])
def test_failed_simulations_are_counted_however_few_are_in_memory(memory_rows):
    """Reasons left the memory with the simulations; points that share a simulation had made the share smaller."""
    posterior = posterior_of([1.0, 0.8], memory_rows=memory_rows)
    sampler = run(posterior, steps=1, recycle=False)  # moves share simulations
    reasons = {tuple(each["parameters"][:2]): each["reason"] for each in sampler.failures}
    assert len(reasons) > 20 and set(reasons.values()) == {"no convergence"}
    assert sampler.simulations < 0.5 * sampler.evaluations
    assert f"; {len(reasons)} of {sampler.simulations:.0f} simulations failed (" in sampler.describe()
    assert memory_rows < 1000 or len(reasons) == posterior.report()["failure_count"]


def test_a_run_that_ended_before_its_first_evaluation_goes_on(tmp_path):
    def log_prob(theta):
        if not (tmp_path / "go").exists():
            raise KeyboardInterrupt
        return -5.0 * np.sum((theta - 1.0) ** 2)

    def opened():
        prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
        posterior, backend = (
            Posterior(FunctionLikelihood(log_prob, list(prior)), prior),
            HDFBackend(tmp_path / "run.h5"),
        )
        return SMCSampler(20, 2, posterior, vectorize=True, seed=1, max_moves=3, backend=backend)

    with pytest.raises(KeyboardInterrupt):
        opened().run_mcmc(None, 1)
    (tmp_path / "go").touch()
    sampler = opened()
    sampler.run_mcmc(None, 1)
    assert sampler.iteration == 1 and sampler.evaluations > 0


def test_failures_in_the_first_parts_of_the_record_count():
    posterior = posterior_of([1.0, 0.8])
    sampler = run(posterior, steps=1)
    known = failures(read_run(sampler, posterior))
    posterior.likelihood.shortened.append(posterior_of([1.0, 0.8]).likelihood)
    posterior.likelihood.shortened[0].simulate([[1.2, 0.8], [1.0, 0.8]])
    with_parts = failures(read_run(sampler, posterior))
    assert (with_parts.count, with_parts.attempts) == (known.count + 1, known.attempts + 2)


def test_a_run_without_a_result_leads_to_no_conclusion():
    posterior = posterior_of([1.0, 0.8])
    chain = emcee.EnsembleSampler(24, 3, posterior, vectorize=True)
    chain.run_mcmc([1.0, 0.8, 0.002] * (1.0 + 0.01 * np.random.default_rng(1).standard_normal((24, 3))), 10)
    finished = read_run(chain, posterior)
    contents = gather(finished)
    titles = notes_of(contents).keys()
    assert titles.isdisjoint({"Not informed by the data", "The errors are correlated"})
    assert "Nothing can be said about the parameters yet" in contents["summary"][2] and not contents["residuals"]
    assert "The chain is short" in titles
