"""The report of a run: well-formed, complete, self-contained, and right in what it says."""

from types import MappingProxyType, SimpleNamespace

import emcee
import matplotlib.pyplot as plt
import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    Events,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    Measurements,
    Posterior,
    Record,
    SimulationFailed,
    TruncatedNormal,
    peak,
    propagate,
    report,
)
from fe_likelihoods.checks.finding import Finding, judge
from fe_likelihoods.checks.result import check_failures, check_result, read_run
from fe_likelihoods.likelihood.fits import compare
from fe_likelihoods.reporting.contents import evidence, moments_of, residual_sentences
from samplers import SamplingWarning, SMCSampler, TMCMCSampler, plot_run
from samplers.estimates.control_variates import SignedSample
from tests.contract.targets import Gaussian
from tests.reporting.report_page import Page, read_page

TIME = 0.02 * np.arange(150)
ODD = 'k<1> & "k2"'  # a name that must be escaped
PRIOR = MappingProxyType(
    {ODD: TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.4), "sigma_top": HalfNormal(0.01)}
)


def free_vibration(theta):
    omega = 2.0 * np.pi * 2.0 * np.sqrt(theta[0])
    if theta[1] > 1.9:
        raise SimulationFailed("too much <damping>")
    return [0.05 * np.exp(-0.02 * theta[1] * omega * TIME) * np.cos(omega * TIME)]


def vibration(description="SYNTHETIC <script>alert(1)</script>", noise=None, prior=PRIOR):
    """Posterior of a free vibration with two structural parameters and one noise level."""
    model = FunctionModel(free_vibration, [ODD, "damping"], [Channel("top", "displacement", "mm")], 0.02, len(TIME))
    noise = 0.002 * np.random.default_rng(1).standard_normal((1, len(TIME))) if noise is None else noise
    measured = Measurements(model.channels, model.dt, model.simulate([1.1, 0.8]) + noise, description)
    return Posterior(FELikelihood(model, measured), dict(prior))


def run(posterior, sampler=SMCSampler, walkers=60, steps=4, **options):
    made = sampler(walkers, posterior.ndim, posterior, vectorize=True, seed=1, **options)
    made.run_mcmc(None, steps)
    return made


def page_of(path) -> Page:
    return read_page(path)


@pytest.fixture(scope="module")
def vibrating():
    posterior = vibration()
    return run(posterior), posterior


@pytest.fixture(scope="module")
def page(vibrating, tmp_path_factory):
    sampler, posterior = vibrating
    path = tmp_path_factory.mktemp("report") / "folder" / "vibration.html"
    prediction = propagate(posterior, sampler.get_chain(flat=True)[-20:], noise=True, progress=False)
    peaks = propagate(posterior, sampler.get_chain(flat=True)[-20:], quantity=peak("top"), progress=False)
    named = {"Free vibration": prediction, "Peaks": peaks}
    measured = {"Free vibration": posterior.likelihood.measurements}
    assert report(sampler, posterior, named, path, measured=measured) == path
    return page_of(path)


def test_the_page_needs_nothing_from_elsewhere(page):
    assert not page.tags & {"script", "iframe", "object", "embed"}
    assert all(address.startswith("data:") for address in page.addresses)
    assert "url(" not in page.style and "@import" not in page.style
    assert "@media print" in page.style
    for png, alt in page.images:
        assert png.startswith(b"\x89PNG") and alt
    assert len(page.images) >= 5


def test_texts_of_users_are_escaped_and_shown(page):
    assert ODD in page.text and "too much <damping>" in page.text and "<script>alert(1)</script>" in page.text


def test_the_table_has_every_parameter_in_the_units_of_a_reader(page, vibrating):
    sampler, posterior = vibrating
    samples, error = sampler.get_chain(flat=True), sampler.mean_error()
    rows = {row[0]: row for row in page.tables[0][1:]}
    assert list(rows) == [ODD, "damping", "sigma_top [mm]"]
    name, prior, mean, mean_error, sd, cv, interval = rows["sigma_top [mm]"]
    assert prior.startswith("HalfNormal, mean 7.979, sd ") and prior.endswith(", above 0")
    assert "Nominal" not in page.tables[0][0]  # no parameter has a nominal value
    assert float(mean) == pytest.approx(1e3 * samples[:, 2].mean(), rel=1e-3)
    assert float(mean_error) == pytest.approx(1e3 * error[2], rel=0.1)
    assert float(sd) == pytest.approx(1e3 * samples[:, 2].std(), rel=1e-2)
    assert float(cv.removesuffix(" %")) == pytest.approx(100 * samples[:, 2].std() / samples[:, 2].mean(), rel=1e-2)
    assert float(interval.split(" to ")[1]) == pytest.approx(1e3 * np.quantile(samples[:, 2], 0.95), rel=1e-3)
    assert rows["damping"][1].startswith("TruncatedNormal, mean 1.00") and rows["damping"][1].endswith(", above 0")


def test_a_run_that_the_limit_ended_was_not_checked():
    posterior = vibration()
    with pytest.warns(SamplingWarning, match="ended the run at beta"):
        sampler = run(posterior, max_simulations=200)
    assert "not checked" in " ".join(evidence(read_run(sampler, posterior)))
    plt.close(plot_run(sampler))


def test_what_a_reader_has_to_know_is_said(page, vibrating):
    sampler, posterior = vibrating
    assert f"{posterior.report()['failure_count']} of" in page.notes["Simulations failed"]
    assert f"{sampler.log_evidence:.2f} ± {sampler.log_evidence_error:.2f}" in page.text
    assert "top: White: no correlation" in page.text
    assert f"Verdict of the sampler: {sampler.verdict.status.capitalize()}" in page.text
    size = f"effective sample size {sampler.verdict.effective_sample_size:.0f}"
    assert size in page.text and "independent ones" not in page.text, "one number, as in the verdict"
    for digest in (posterior.fingerprint, posterior.data_fingerprint, posterior.likelihood.model.fingerprint):
        assert digest in page.text
    assert "SMCSampler( 60, posterior.ndim, posterior, vectorize=True, seed=1, )" in page.text
    assert "Free vibration" in page.text and "Peaks" in page.text and "90 % interval" in page.text
    assert "CRPS" in page.text


def test_the_fit_is_that_of_the_posterior_mean(vibrating):
    sampler, _ = vibrating
    posterior = vibration()  # nothing is cached
    samples = sampler.get_chain(flat=True)
    centre = samples.mean(axis=0)
    (fit,) = compare(posterior, samples, centre)
    made = posterior.report()["simulations"]
    assert made > 2  # before, after, draws of the prior
    mean = posterior.prior.mean()  # a function has no nominal values
    measured = posterior.likelihood.measurements.values
    for point, error in ((mean, fit.channels[0].before), (centre, fit.channels[0].after)):
        residuals = posterior.likelihood.residuals_of(posterior.likelihood.model.simulate(point[:2]))
        assert error == pytest.approx(np.sqrt(np.square(residuals).sum() / np.square(measured).sum()), rel=1e-12)
    np.testing.assert_allclose(fit.residuals, residuals, atol=1e-15)
    compare(posterior, samples, centre)
    assert posterior.report()["simulations"] == made


def test_many_failed_simulations_limit_a_result():
    for count, severity in ((0, []), (4, ["note"]), (30, ["care"])):
        named = check_failures(count, 100, "")
        assert [each.severity for each in named] == severity
        assert all(f"{count} of 100 simulations failed ({count} %)" in each.text for each in named)


def test_moments_are_those_of_the_more_accurate_sample(rng):
    points = rng.standard_normal((20_000, 2))
    signed = SignedSample(points, np.full(20_000, 1.0 / 20_000), np.zeros(20_000, dtype=int), 0.0, 0.0)
    chain, errors = 1.2 * rng.standard_normal((100, 2)), np.full(2, 0.12)
    numbers = {"samples": chain, "mean_error": errors, "sd_error": np.full(2, 0.08)}
    finished = SimpleNamespace(sampler=SimpleNamespace(signed_sample=signed), **numbers)
    _, mean_error, sd, sd_error, _, _, high = moments_of(finished)
    assert sd == pytest.approx(np.ones(2), abs=0.03) and high == pytest.approx(1.645, abs=0.06)
    assert np.all(mean_error < 0.01) and np.all(sd_error < 0.01)
    undetermined = np.where(np.arange(20_000) == 0, -1e3, 1.0) / 20_000  # of a point in a tail
    weights = undetermined / undetermined.sum()
    finished.sampler.signed_sample = signed._replace(coords=np.vstack([[1e3, 0.0], points[1:]]), weights=weights)
    np.testing.assert_array_equal(moments_of(finished)[2], chain.std(axis=0))
    finished.sampler.signed_sample = signed
    errors[1] = 1e-3
    np.testing.assert_array_equal(moments_of(finished)[2], chain.std(axis=0))
    finished.sampler = object()  # emcee's own
    np.testing.assert_array_equal(moments_of(finished)[2], chain.std(axis=0))


@pytest.mark.slow
def test_samplers_without_a_ladder_and_functions_without_data_are_reported(tmp_path):
    target = Gaussian(ndim=2)
    sampler = emcee.EnsembleSampler(20, 2, lambda x, factor: factor * target(x), vectorize=True, args=(1.0,))
    sampler.run_mcmc(0.7 + 0.1 * np.random.default_rng(3).standard_normal((20, 2)), 60)
    page = page_of(report(sampler, out=tmp_path / "a.html", discard=10))
    assert [row[0] for row in page.tables[0][1:]] == ["x0", "x1"]
    assert "gives no evidence" in page.text and "function of the user's own" in page.text
    assert "EnsembleSampler(20, posterior.ndim, posterior, args=args, vectorize=True)" in page.text
    assert "The chain is short" in page.notes
    unnamed = page_of(report(sampler, lambda x: 0.0, out=tmp_path / "b.html", names=["a", "b"]))
    assert [row[0] for row in unnamed.tables[0][1:]] == ["a", "b"]
    tempered = run(Gaussian(ndim=2), TMCMCSampler)
    other = page_of(report(tempered, out=tmp_path / "c.html"))
    assert "and the residuals" not in other.text + page.text
    assert f"{tempered.log_evidence:.2f} ±" in other.text


def test_every_data_set_and_every_event_has_its_block():
    motion = np.sin(np.arange(200) * 0.31) * np.hanning(200)
    first, second = Record("EQ1", 0.02, motion), Record("EQ2", 0.02, 2.0 * motion)
    events = LinearOscillator(Events([first, second], rest=1.0), period=0.7)
    short = LinearOscillator(first, period=0.4)
    likelihoods = {}
    for key, model in (("a & b", events), ("short", short)):
        noise = 0.02 * np.random.default_rng(4).standard_normal((2, model.n_steps))
        clean = model.simulate([1.1, 0.9])
        likelihoods[key] = FELikelihood(model, Measurements(model.channels, model.dt, clean + noise * [[1.0], [0.01]]))
    joint = JointLikelihood(likelihoods)
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
    prior |= {"sigma_acceleration": HalfNormal(0.1), "sigma_displacement": HalfNormal(0.01)}
    posterior = Posterior(joint, prior)
    samples = run(posterior).get_chain(flat=True)
    fits = compare(posterior, samples, samples.mean(axis=0))
    assert [fit.title for fit in fits] == ["a & b, EQ1", "a & b, EQ2", "short"]
    assert not any(fit.after is None for fit in fits)
    for fit, n in zip(fits, (200, 200, 200), strict=True):
        assert [each.samples for each in fit.channels] == [n, n]
        assert all(each.after < each.before for each in fit.channels)
    assert [fit.measurements.start for fit in fits] == pytest.approx([0.0, 5.0, 0.0])
    assert residual_sentences(fits)[2].startswith("acceleration (a & b, EQ2): ")


def test_what_does_not_fit_is_refused_before_anything_is_written(vibrating, tmp_path):
    sampler, posterior = vibrating
    out = tmp_path / "none.html"
    for arguments, options, message in (
        ((posterior, sampler), {}, "needs a sampler that has run"),
        ((SMCSampler(20, 3, posterior), posterior), {}, "call run_mcmc|Call run_mcmc"),
        ((sampler, Gaussian(ndim=2)), {}, "the chain has 3 parameters"),
        ((sampler, posterior, "bands"), {}, "result of propagate"),
    ):
        with pytest.raises(ValueError, match=message):
            report(*arguments, out=out, **options)
    assert not out.exists()


def test_the_most_severe_finding_decides_and_is_the_first_sentence(page, vibrating):
    remark, care, wrong = (Finding(f"{w.capitalize()} thing", w, "Why.", "What.") for w in ("note", "care", "wrong"))
    assert str(judge([])) == "Use." and str(judge([remark])) == "Use."
    assert str(judge([remark, care])) == "Use with care: care thing."
    follows = "fix this first, 1 other finding may follow from it"
    assert str(judge([care, remark, wrong, wrong])) == f"Do not use: wrong thing; {follows}."
    assert judge([remark, wrong, care]).findings == (wrong, care, remark)
    sampler, posterior = vibrating
    judgement = check_result(sampler, posterior)
    assert {finding.kind for finding in judgement.findings} >= set(page.notes)
    assert str(judgement) in page.text and judgement.status in page.text
    (other,) = (each for each in judgement.findings if each.kind == "Another event differs")
    assert other.numbers["damping"] > 1.0 and "For another event the standard deviations are too small" in page.text
