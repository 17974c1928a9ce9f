"""Stiffness losses from two calibrations: closed forms, negative controls, unseen stiffnesses, and alarms."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    Record,
    ShearFrame,
    StoredPosterior,
    stiffness_loss,
)
from fe_likelihoods.checks.finding import CARE, Finding
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.priors.multivariate import MultivariateNormal
from tests.emulation.problems import guided

D, SD = 6, 0.02
NAMES = tuple(f"k_{i + 1}" for i in range(D))
KNOWN = {"spread": 0.01, "error": 1.0, "common": 0.03}
CAREFUL = Finding("Few starts", CARE, "The budget ended.")


def prior_of(names=NAMES, log_sd=0.3) -> Prior:
    return Prior({name: LogNormal(1.0, log_sd) for name in names})


def normal_posterior(estimate, covariance, n=20_000, seed=1, log_sd=0.3, names=NAMES) -> StoredPosterior:
    """Posterior of logarithms that were observed with normal errors; its samples have exactly its moments."""
    d = len(estimate)
    precision = np.linalg.inv(covariance)
    posterior = np.linalg.inv(precision + np.eye(d) / log_sd**2)
    z = np.random.default_rng(seed).standard_normal((n, d))
    z = (z - z.mean(axis=0)) @ np.linalg.inv(np.linalg.cholesky(np.cov(z.T, bias=True))).T
    logs = posterior @ precision @ estimate + z @ np.linalg.cholesky(posterior).T
    return StoredPosterior(np.exp(logs), prior_of(names, log_sd))


def correlated(sd=SD, rho=-0.5) -> np.ndarray:
    """Covariance in which neighbours are correlated, as for storeys between sensors."""
    apart = np.abs(np.subtract.outer(np.arange(D), np.arange(D)))
    return sd**2 * np.where(apart == 0, 1.0, np.where(apart == 1, rho, 0.0))


def by_brute_force(difference, covariance, most=3, presence=0.5, damaged=(0.75, 0.25), spread=0.01, common=0.03):
    """Posterior of the sets of damaged stiffnesses: normal densities of the difference of two flat calibrations."""
    share = 1.0 - (1.0 - presence) ** (1.0 / D)
    found = {}
    for m in range(most + 1):
        for members in itertools.combinations(range(D), m):
            hit = np.isin(np.arange(D), members)
            mean = np.where(hit, np.log(damaged[0]), 0.0)
            total = covariance + spread**2 * np.eye(D) + common**2 + np.diag(np.where(hit, damaged[1] ** 2, 0.0))
            chance = share**m * (1.0 - share) ** (D - m)
            found[members] = chance, stats.multivariate_normal(mean, total).pdf(difference)
    some = sum(chance for members, (chance, _) in found.items() if members)
    joint = {
        members: (chance * presence / some if members else 1.0 - presence) * density
        for members, (chance, density) in found.items()
    }
    total = sum(joint.values())
    return {members: each / total for members, each in joint.items()}


def pair(change, seed=0, covariance=None, noise=True, **options):
    """Two calibrations of a structure whose logarithms changed."""
    rng = np.random.default_rng(seed)
    covariance = correlated() if covariance is None else covariance
    start = 0.1 * rng.standard_normal(D)
    factor = np.linalg.cholesky(covariance) * noise
    estimates = [start + k * np.asarray(change) + factor @ rng.standard_normal(D) for k in (0, 1)]
    return [normal_posterior(each, covariance, seed=k, **options) for k, each in enumerate(estimates)], estimates


def quantiles(found) -> np.ndarray:
    return np.quantile(found.loss, (0.05, 0.5, 0.95), axis=0)


# ---------------------------------------------------------------------- closed forms


@pytest.mark.parametrize("change", [np.zeros(D), np.log([1, 1, 0.9, 1, 1, 1]), np.log([1, 0.8, 1, 1, 0.9, 1])])
def test_probabilities_of_sets_are_those_of_normal_densities(change):
    """Wide priors of the stiffnesses before: the difference of the estimates is all that informs about the change."""
    states, estimates = pair(change, seed=3, log_sd=3.0)
    found = stiffness_loss(*states, NAMES, n_draws=40_000, **KNOWN)
    exact = by_brute_force(estimates[1] - estimates[0], 2.0 * correlated())
    for m in range(4):
        probability = sum(each for members, each in exact.items() if len(members) == m)
        error = np.sqrt(probability * (1.0 - probability) / len(found.loss))
        assert (found.count == m).mean() == pytest.approx(probability, abs=4.0 * error + 0.002)
    assert found.status == "use" and (found.error == 1.0).all() and "common factor" in str(found)
    assert found.location().sum() == pytest.approx(found.presence())


def test_losses_given_damage_are_normal_in_the_logarithm():
    """A large loss of one stiffness: its distribution is conjugate, with scatter and common factor."""
    states, estimates = pair(np.log([1, 1, 0.7, 1, 1, 1]), seed=5, log_sd=3.0)
    found = stiffness_loss(*states, NAMES, most=1, n_draws=40_000, **KNOWN)
    assert (found.count == 1).all()
    # ratios r and g of d stiffnesses observed with the covariance of the differences
    mean = np.where(np.arange(D) == 2, np.log(0.75), 0.0)
    own = np.diag(np.where(np.arange(D) == 2, 0.25**2, 0.0) + 0.01**2)
    gain = own @ np.linalg.inv(own + 0.03**2 + 2.0 * correlated())
    expected = mean + gain @ (estimates[1] - estimates[0] - mean)
    sd = np.sqrt(np.diag(own - gain @ own))
    logs = np.log1p(-found.loss)
    np.testing.assert_allclose(logs.mean(axis=0), expected, atol=5.0 * sd.max() / 200.0)
    np.testing.assert_allclose(logs.std(axis=0), sd, rtol=0.02)


def test_the_prior_of_the_calibrations_is_taken_out():
    """The prior counts once: a calibration after the event with another prior gives the same result."""
    (before, after), estimates = pair(np.log([1, 0.85, 1, 1, 1, 1]), seed=2)
    other = normal_posterior(estimates[1], correlated(), seed=1, log_sd=0.15)
    damping = np.random.default_rng(1).lognormal(size=len(other.samples))  # a parameter of this state alone
    prior = Prior({"damping": LogNormal(1.0, 1.0)} | other.prior.distributions)
    other = StoredPosterior(np.column_stack([damping, other.samples]), prior)
    results = [stiffness_loss(before, each, NAMES, **KNOWN) for each in (after, other)]
    np.testing.assert_allclose(results[0].probability(), results[1].probability(), atol=0.01)
    np.testing.assert_allclose(*(quantiles(each) for each in results), atol=0.003)


# ---------------------------------------------------------------------- what must not be found


@pytest.mark.slow
def test_without_a_loss_there_are_no_alarms():
    """Negative control, and its counterpart with a loss: 15 pairs of calibrations, with errors as stated or not."""
    rng = np.random.default_rng(4)
    for factor in (1.0, 3.0):  # true errors over stated errors
        presence = {}
        for loss in (0.0, 0.3):
            found = []
            for seed in range(15):
                change = np.log1p(-loss * (np.arange(D) == seed % D)) + 0.03 * rng.normal() + 0.01 * rng.normal(size=D)
                factors = np.linalg.cholesky(factor**2 * correlated())
                estimates = [k * change + factors @ rng.standard_normal(D) for k in (0, 1)]
                states = [normal_posterior(each, correlated(), n=2000) for each in estimates]
                found.append(stiffness_loss(*states, NAMES, n_draws=1000).presence())
            presence[loss] = np.array(found)
        assert (presence[0.0] > 0.5).sum() <= 1
        assert np.mean(presence[0.3] > 0.5) > (0.95 if factor == 1.0 else 0.7)


def test_stiffnesses_that_the_data_do_not_see_keep_their_prior():
    """Two of six stiffnesses have prior samples before and after; others have lost nothing, or one has."""
    covariance = correlated(rho=0.0)
    covariance[[4, 5], [4, 5]] = 1e6
    blank = stiffness_loss(
        *[StoredPosterior(prior_of().rvs(20_000, random_state=k), prior_of()) for k in (1, 2)], NAMES, n_draws=40_000
    )
    for change in (np.zeros(D), np.log([1, 0.7, 1, 1, 1, 1])):
        states, _ = pair(change, covariance=covariance, noise=False)
        found = stiffness_loss(*states, NAMES, n_draws=40_000, **KNOWN)
        others = stiffness_loss(*states, NAMES[:4], n_draws=40_000, **KNOWN)
        np.testing.assert_allclose(found.probability()[4:], found.probability()[4:].mean(), atol=0.01)
        assert 0.02 < found.probability()[4] < blank.probability()[4] * 1.3
        np.testing.assert_array_less(np.abs(np.median(found.loss, axis=0)[4:]), 0.01)
        assert found.probability()[1] == pytest.approx(others.probability()[1], abs=0.02)
    assert blank.presence() == pytest.approx(0.5 * stats.norm.cdf((np.log(0.9) - np.log(0.75)) / 0.25), abs=0.06)
    assert np.std(np.log(blank.common)) == pytest.approx(0.05, rel=0.03), "the prior"


# ---------------------------------------------------------------------- from data to losses


def building(stiffnesses, seed) -> Posterior:
    """Three storeys, two of them measured, as a function of three stiffness factors."""
    time, motion = 0.02 * np.arange(400), np.random.default_rng(seed).standard_normal(400)
    record = Record("synthetic", 0.02, np.convolve(motion, np.ones(3) / 3.0, mode="same") * np.minimum(1.0, time))
    frame = ShearFrame({"floor": 1, "roof": 3}, [1.0] * 3, [900.0] * 3, groups=[1, 2, 3])
    model = LinearStructure(frame, record)
    clean = model.simulate([*stiffnesses, 0.03])
    noise = 0.05 * clean.std(axis=1, keepdims=True) * np.random.default_rng(seed + 10).standard_normal(clean.shape)
    prior = {name: LogNormal(1.0, 0.2) for name in frame.parameter_names[:3]} | {"damping": LogNormal(0.03, 0.3)}
    prior |= {f"sigma_{channel.name}": HalfNormal(1.0) for channel in model.channels}
    measured = Measurements(model.channels, 0.02, clean + noise)
    return Posterior(FELikelihood(model, measured, GaussianNoise(model.channels)), prior).marginal()


@pytest.fixture(scope="module")
def calibrated():
    """Searches and guided runs of both states; the second storey loses 25 %, all lose 2 % to temperature."""
    posteriors = [building(factors, seed) for seed, factors in enumerate(([1.0, 1.1, 0.9], [0.98, 0.8085, 0.882]))]
    samplers = []
    for posterior in posteriors:
        sampler = guided(posterior, walkers=60)
        samplers.append(sampler)
    return posteriors, samplers


@pytest.mark.slow
def test_searches_and_guided_runs_find_the_storey(calibrated):
    """Laplace approximation, emulated posterior and chain agree on a well-identified posterior."""
    posteriors, samplers = calibrated
    names = posteriors[0].parameter_names[:3]
    runs = [StoredPosterior.from_run(*each) for each in zip(samplers, posteriors, strict=True)]
    searches = [StoredPosterior.from_search(find_modes(each, 3, seed=1), each) for each in posteriors]
    assert len(runs[0].samples) > 10_000 and runs[0].log_evidence == samplers[0].log_evidence
    for states in (runs, searches):
        found = stiffness_loss(*states, names)
        assert found.status == "use" and found.probability()[1] > 0.99 and found.location().argmax() == 1
        assert np.delete(found.probability(), 1).max() < 0.1
        low, _, high = quantiles(found)[:, 1]
        assert low < 0.25 < high
    for run, search in zip(runs, searches, strict=True):
        size = np.exp(run.log_weights)
        mean = size @ run.samples
        # an ascent ends where it would gain less than 0.1 of log-density
        furthest = np.sqrt(2.0 * 0.1) * search.samples.std(axis=0).max()
        np.testing.assert_allclose(search.samples.mean(axis=0), mean, atol=furthest)
        sd = np.sqrt(size @ np.square(run.samples - mean))
        np.testing.assert_allclose(search.samples.std(axis=0), sd, rtol=0.15)


def test_doubted_runs_have_findings_and_doubted_searches_are_refused(calibrated):
    (posterior, _), (sampler, _) = calibrated
    fake = SimpleNamespace(
        verdict=SimpleNamespace(
            status="not usable", findings=(CAREFUL, CAREFUL._replace(severity="note")), effective_sample_size=3.0
        ),
        signed_sample=sampler.signed_sample,
        log_evidence=0.0,
        log_evidence_error=0.1,
        get_chain=sampler.get_chain,
    )
    stored = StoredPosterior.from_run(fake, posterior)
    assert stored.findings == (CAREFUL,) and len(stored.samples) == 60
    search = find_modes(posterior, 2, seed=1)
    assert StoredPosterior.from_search(search, posterior).findings == ()
    (mode,) = search.modes
    for modes, finished in (
        ((mode, mode), True),
        ((mode._replace(converged=False),), True),
        ((mode,), False),
        ((), True),
    ):
        with pytest.raises(ValueError, match=f"found {len(modes)} modes, or ended early"):
            StoredPosterior.from_search(search._replace(modes=modes, finished=finished), posterior)


# ---------------------------------------------------------------------- alarms


def test_findings_of_the_calibrations_are_carried():
    (before, after), _ = pair(np.zeros(D), noise=False)
    assert not stiffness_loss(before, after, NAMES, **KNOWN).findings
    doubted = StoredPosterior(after.samples, after.prior, findings=[CAREFUL])
    found = stiffness_loss(before, doubted, NAMES, **KNOWN)
    assert [each.kind for each in found.findings] == [CAREFUL.kind] and found.status == "use with care"
    assert "CAUTION: Few starts: In the calibration after: The budget ended." in str(found)


def test_few_samples_are_refused():
    (before, after), _ = pair(np.zeros(D), noise=False)
    with pytest.raises(ValueError, match="6 parameters needs at least 30 effective samples; got 29"):
        stiffness_loss(before, StoredPosterior(after.samples[:29], after.prior), NAMES)


def test_contradictions_enlarge_the_errors_and_many_damaged_stiffnesses_are_found():
    rng = np.random.default_rng(0)
    change = 0.3 * rng.standard_normal(D)
    states, _ = pair(change, noise=False)
    assert np.median(stiffness_loss(*states, NAMES, spread=0.01).error) > 2.5
    states, _ = pair(np.log([0.7, 1, 0.7, 0.7, 0.7, 1]), noise=False)
    assert any(each.action == "Increase most." for each in stiffness_loss(*states, NAMES, **KNOWN).findings)
    assert stiffness_loss(*states, NAMES, most=5, **KNOWN).findings == ()


@pytest.mark.parametrize(("factor", "expected"), [(0.95, 0), (0.8, 1), (1.25, 1)])
def test_a_change_of_all_stiffnesses_beyond_the_prior_is_found(factor, expected):
    states, _ = pair(np.full(D, np.log(factor)), noise=False)
    found = stiffness_loss(*states, NAMES, **KNOWN)
    assert [each.kind for each in found.findings] == ["All stiffnesses have changed"] * expected


def test_joint_priors_of_the_stiffnesses():
    """A joint prior in logarithms has no such class: a joint normal prior of small variance is close to one."""
    values = np.random.default_rng(1).multivariate_normal(np.ones(2), 1e-4 * np.eye(2), 20_000)
    prior = Prior({("k_1", "k_2"): MultivariateNormal([1.0, 1.0], [[0.04, 0.02], [0.02, 0.04]])})
    stored = StoredPosterior(values, prior)
    found = stiffness_loss(stored, stored, ["k_1", "k_2"], spread=0.01, error=1.0)
    assert found.presence() < 0.05


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"names": ["k_1"]}, "two or more"),
        ({"names": ["k_1", "none"]}, "no parameters none"),
        ({"presence": 1.0}, "presence between"),
        ({"damaged": HalfNormal(1.0)}, "damaged as a LogNormal"),
        ({"common": 0.0}, "common as a positive"),
        ({"most": 0}, "most of at least 1"),
        ({"spread": -1.0}, "spread as a positive number"),
        ({"error": 0.0}, "error as a positive number"),
    ],
)
def test_wrong_arguments_are_refused(options, message):
    stored = StoredPosterior(prior_of().rvs(100, random_state=1), prior_of())
    with pytest.raises(ValueError, match=message):
        stiffness_loss(stored, stored, **({"names": NAMES} | options))
