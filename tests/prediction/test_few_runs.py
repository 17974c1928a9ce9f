"""Predictions from few simulations and a known posterior: exact moments, stated errors, and a negative control."""

import numpy as np
import pytest

from fe_likelihoods import Channel, FunctionModel, SimulationFailed, peak, propagate_few
from samplers.estimates.control_variates import SignedSample
from tests.statistics.hard_posteriors import hash_uniform

NAMES = "a", "b", "c"
MEAN, SD = np.array([1.0, 2.0, -1.0]), np.array([0.1, 0.2, 0.3])


def model_of(function):
    """Model whose response has one channel with three equal samples."""
    return FunctionModel(
        lambda theta: np.full((1, 3), function(theta)),
        NAMES,
        [Channel("top", "displacement", "m")],
        0.1,
        3,
        version="1",
    )


@pytest.fixture(scope="module")
def sample() -> SignedSample:
    """A normal density without correction: every expectation is known."""
    coords = MEAN + SD * np.random.default_rng(0).standard_normal((10_000, 3))
    weights = np.full(len(coords), 1.0 / len(coords))
    return SignedSample(coords, weights, np.zeros(len(coords), dtype=int), 0.0, 0.01)


def first(response):
    return response[0, 0]


def test_a_linear_quantity_is_known_from_thirty_simulations(sample):
    slopes = np.array([3.0, -1.0, 2.0])
    model = model_of(lambda theta: theta @ slopes)
    found = propagate_few(model, sample, quantity=first, quantiles=(0.05, 0.95), progress=False)
    sd = np.linalg.norm(slopes * SD)
    assert found.mean == pytest.approx(sample.coords.mean(axis=0) @ slopes, abs=1e-4 * sd)
    assert abs(found.sd - sd) < 4.0 * sd / np.sqrt(2 * 10_000)
    np.testing.assert_allclose(found.quantiles, slopes @ MEAN + sd * np.array([-1.645, 1.645]), atol=0.06 * sd)
    assert found.n_samples == 30 and len(found.values) == 30
    assert found.effective_sample_size > 5_000  # the sample has 10 000 points
    assert "30 samples" in str(found) and not found.findings


@pytest.mark.slow
def test_stated_errors_hold_for_a_curved_quantity(sample):
    model = model_of(lambda theta: np.exp(theta[0] + theta[1]) + theta[2] ** 2)
    exact = np.exp(3.0 + 0.5 * (SD[:2] ** 2).sum()) + MEAN[2] ** 2 + SD[2] ** 2
    values = np.exp(sample.coords[:, 0] + sample.coords[:, 1]) + sample.coords[:, 2] ** 2
    truth = np.array([exact, *np.quantile(values, [0.05, 0.95])])
    scores, errors = [], []
    for seed in range(30):
        found = propagate_few(model, sample, quantity=first, quantiles=(0.05, 0.95), seed=seed, progress=False)
        stated = np.array([found.standard_error, *found.quantile_error])
        scores.append((np.array([found.mean, *found.quantiles]) - truth) / stated)
        errors.append((found.mean - exact) / values.std())
    assert np.sqrt(np.mean(np.square(errors))) < 0.25 / np.sqrt(30)  # independent draws: 1 / sqrt(30)
    assert np.mean(np.abs(scores) < 2.0) > 0.9


@pytest.mark.slow
def test_a_quantity_without_structure_gains_nothing_and_says_so(sample):
    model = model_of(lambda theta: hash_uniform(theta[None])[0])
    found = [propagate_few(model, sample, quantity=first, seed=seed, progress=False) for seed in range(20)]
    scores = np.array([(each.mean - 0.5) / each.standard_error for each in found])
    assert np.mean(np.abs(scores) < 2.0) >= 0.85
    assert np.median([each.effective_sample_size for each in found]) < 40
    assert all(any("unexplained" in one.text for one in each.findings) for each in found)


def test_equal_values_have_a_finding(sample):
    found = propagate_few(model_of(lambda theta: max(theta[0], 5.0)), sample, quantity=first, progress=False)
    assert found.mean == pytest.approx(5.0) and found.effective_sample_size == 30
    assert any("values of a number are equal" in each.text for each in found.findings)


def test_several_numbers_and_failures(sample):
    def function(theta):
        if theta[0] > 1.15:
            raise SimulationFailed("too stiff")
        return theta[1]

    found = propagate_few(
        model_of(function),
        sample,
        quantity=lambda response: response[0, 0] * np.array([1.0, 2.0]),
        simulations=60,
        progress=False,
    )
    assert found.mean.shape == (2,) and found.quantiles.shape == (3, 2) and found.n_failed > 0
    assert found.n_samples == 60 - found.n_failed
    np.testing.assert_allclose(found.mean[1], 2.0 * found.mean[0])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sample": None}, "signed_sample"),
        ({"sample": np.ones((40, 3))}, "signed_sample"),
        ({"simulations": 12}, "at least 20 simulations"),
        ({"noise": True}, "without noise"),
        ({"quantity": "top"}, "not histories"),
        ({"quantity": {"p": peak("top")}}, "one quantity"),
    ],
)
def test_wrong_inputs_are_refused_before_a_simulation(sample, changes, message):
    def function(theta):
        raise AssertionError("simulated")

    arguments = {"sample": sample, "quantity": peak("top"), "progress": False} | changes
    with pytest.raises(ValueError, match=message):
        propagate_few(model_of(function), arguments.pop("sample"), **arguments)
