"""Findings about load tests: swapped channels, wrong units and signs; right ones are not named."""

import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, LogNormal, Posterior, check_result
from fe_likelihoods.modal.load_cases import LoadTest
from samplers import SMCSampler
from tests.checks.fitted import check_fit

SPAN, TRUCK, EI, N = 24.0, 200e3, 2e9, 48  # m, N, N m2, integration points
AT, CASES = (6.0, 12.0, 18.0), (4.0, 8.0, 13.0, 16.0, 20.0)  # m
CHANNELS = [Channel(f"at {x:g} m", "displacement", "mm") for x in AT]
ERRORS = {channel.name: 1e-4 for channel in CHANNELS}


def deflections(theta):
    """Of a girder whose halves have two stiffnesses, by the unit load theorem."""
    s = (np.arange(N) + 0.5) * SPAN / N
    moments = np.array([np.minimum(s * (1.0 - a / SPAN), a * (1.0 - s / SPAN)) for a in (*AT, *CASES)])
    flexibility = SPAN / N / (EI * np.where(s < 0.5 * SPAN, theta[0], theta[1]))
    return -TRUCK * (moments[: len(AT)] * flexibility) @ moments[len(AT) :].T


def findings(change, seed, known):
    """Before a run, and after it with samples about the mean of the prior."""
    rng = np.random.default_rng(seed)
    values = change(deflections(np.exp(0.2 * rng.normal(size=2))) + 1e-4 * rng.normal(size=(len(AT), len(CASES))))
    test = LoadTest(CHANNELS, [f"truck at {x:g} m" for x in CASES], values, errors=ERRORS if known else None)
    noise = test.known if known else {f"sigma_{name}": LogNormal(error, 0.5) for name, error in ERRORS.items()}
    prior = {f"stiffness_{i}": LogNormal(1.0, 0.2) for i in (1, 2)}
    posterior = Posterior(FELikelihood(test.model(deflections, tuple(prior)), test.measurements), prior | noise)
    samples = posterior.prior.mean() * (1.0 + 0.01 * rng.normal(size=(100, posterior.ndim)))
    return check_fit(posterior), check_fit(posterior, samples)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(
    ("kind", "words", "change"),
    [
        ("", "", lambda y: y),
        ("Channels may be swapped", "at 6 m and at 12 m", lambda y: y[[1, 0, 2]]),
        ("A unit may be wrong", "m read as mm", lambda y: 1e-3 * y),
        ("A sign may be wrong", "at 6 m", lambda y: y * [[-1.0], [1.0], [1.0]]),
    ],
)
def test_each_fault_is_named_before_a_run(kind, words, change, known):
    for seed in range(5):
        found, after = findings(change, seed, known)
        assert [each.kind for each in found] == [kind] * bool(kind), seed
        assert set(found) <= set(after)
        assert all(words in each.text and each.severity == "wrong" for each in found)


def test_values_far_beyond_their_stated_errors_are_named_after_a_run():
    rng, samples = np.random.default_rng(2), 1.0 + 0.003 * np.random.default_rng(3).normal(size=(100, 2))
    for times, named in ((1.0, False), (5.0, True)):
        values = deflections(np.ones(2)) + times * 1e-4 * rng.normal(size=(len(AT), len(CASES)))
        test = LoadTest(CHANNELS, [f"truck at {x:g} m" for x in CASES], values, errors=ERRORS)
        prior = {f"stiffness_{i}": LogNormal(1.0, 0.2) for i in (1, 2)}
        likelihood = FELikelihood(test.model(deflections, tuple(prior)), test.measurements)
        found = check_fit(Posterior(likelihood, prior | test.known), samples)
        assert [each.kind for each in found] == ["Values differ more than their stated errors"] * named


def test_the_fit_of_a_bent_ridge_is_on_the_ridge():
    """Deflections of springs in series tell a sum of reciprocals; at the means of the stiffnesses it is another one."""

    def top(theta):
        return np.full((1, 2), (1e-3 / theta).sum())

    test = LoadTest([Channel("top", "displacement", "mm")], ["1", "2"], top(np.ones(6)), errors={"top": 2e-5})
    prior = {f"stiffness_{i}": LogNormal(1.0, 0.2) for i in range(6)}
    posterior = Posterior(FELikelihood(test.model(top, tuple(prior)), test.measurements), prior | test.known)
    sampler = SMCSampler(100, 6, posterior, vectorize=True, seed=1, guide=posterior.guide())
    sampler.run_mcmc(None, 1)
    far = top(sampler.get_chain(flat=True).mean(axis=0)) - test.measurements.values
    assert np.abs(far).min() > 4.0 * 2e-5
    judgement = check_result(sampler)
    assert judgement.status == "use", str(judgement.findings)
