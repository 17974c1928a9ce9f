"""Predictions of measurements whose noise has a level per event."""

import numpy as np
import pytest

from fe_likelihoods import (
    Events,
    FELikelihood,
    GaussianNoise,
    LinearOscillator,
    Measurements,
    Record,
    propagate,
)


@pytest.fixture
def likelihood(rng):
    """Under two events, with a step of measurements of two steps of the model; EQ2 has no displacement."""
    records = [Record(name, 0.02, rng.normal(size=n)) for name, n in (("EQ1", 61), ("EQ2", 51))]
    model = LinearOscillator(Events(records, rest=0.98), period=0.5)
    coarse = {name: LinearOscillator(each).simulate([1, 1])[:, ::2] for name, each in zip("12", records, strict=True)}
    measured = {"EQ1": Measurements(model.channels, 0.04, coarse["1"])}
    measured["EQ2"] = Measurements(model.channels[:1], 0.04, coarse["2"][:1])
    return FELikelihood(model, measured, GaussianNoise(model.channels, groups="event"))


@pytest.fixture
def samples(rng):
    sigmas = np.array([0.1, 0.002, 3.0])  # acceleration and displacement in EQ1, acceleration in EQ2
    return np.hstack([rng.normal(1.0, 0.05, (400, 2)), np.tile([[1.0], [2.0]], (200, 1)) * sigmas])


def test_each_event_has_its_own_level(likelihood, samples):
    assert likelihood.parameter_names[2:] == (
        "sigma_acceleration_EQ1",
        "sigma_displacement_EQ1",
        "sigma_acceleration_EQ2",
    )
    clean, noisy = (propagate(likelihood, samples, noise=noise, seed=1, progress=False) for noise in (False, True))
    expected = np.zeros((2, 61 + 49 + 51))
    for row, steps, column in ((0, slice(0, 61), 2), (1, slice(0, 61), 3), (0, slice(110, 161), 4)):
        expected[row, steps] = np.mean(samples[:, column] ** 2)
    np.testing.assert_allclose(noisy.variance - clean.variance, expected, rtol=1e-9, atol=1e-9 * clean.variance.max())
    quiet = expected == 0.0
    np.testing.assert_array_equal(noisy.quantiles[:, quiet], clean.quantiles[:, quiet])
    width = np.ptp(noisy.quantiles[[0, 2]], axis=0)[0, 130:].mean()
    assert width == pytest.approx(2 * 1.645 * np.sqrt(np.mean(samples[:, 4] ** 2)), rel=0.15)


def test_another_record_has_the_levels_of_a_named_event(likelihood, samples):
    settings = {"record": Record("EQ3", 0.02, np.ones(30)), "from_state": "end", "rest": 1.0, "progress": False}
    clean = propagate(likelihood, samples, **settings)
    noisy = propagate(likelihood, samples, noise="EQ1", **settings)
    added = np.mean(samples[:, 2:4] ** 2, axis=0)[:, None] * np.ones(30)
    np.testing.assert_allclose(noisy.variance - clean.variance, added, rtol=1e-9)
    with pytest.raises(ValueError, match="give the event whose levels hold for it, noise= one of 'EQ1', 'EQ2'"):
        propagate(likelihood, samples, noise=True, **settings)
    with pytest.raises(ValueError, match="noise='EQ3' is no event of the noise; give one of 'EQ1', 'EQ2'"):
        propagate(likelihood, samples, noise="EQ3", **settings)
    with pytest.raises(ValueError, match="channels displacement were not measured in 'EQ2'"):
        propagate(likelihood, samples, noise="EQ2", **settings)


def test_refusals(likelihood, samples):
    with pytest.raises(ValueError, match="needs positive standard deviations"):
        propagate(likelihood, np.abs(samples) * [1, 1, 1, -1, 1], noise=True, progress=False)
    other = FELikelihood(likelihood.model, likelihood.measurements)
    with pytest.raises(ValueError, match="noise='EQ1' names an event, and GaussianNoise has no levels per event"):
        propagate(other, samples[:, :4], noise="EQ1", progress=False)
