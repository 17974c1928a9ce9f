"""Predictions with shares of the response: gaps are as in the calibration; what has no level is refused before it
runs."""

import warnings

import numpy as np
import pytest

from fe_likelihoods import Events, FELikelihood, GaussianNoise, LinearOscillator, Measurements, Record, propagate

DT, WINDOW = 0.02, 0.6
SAMPLES = np.array([[1.0, 1.0, 0.1, 0.1]] * 10)
OPTIONS = {"noise": True, "from_state": "virgin", "progress": False, "calibrated": (), "check": False}


def quake(seed, duration=12.0):
    time = DT * np.arange(round(duration / DT))
    burst = np.exp(-(((time - 0.4 * duration) / (duration / 6.0)) ** 2))
    return Record(f"q{seed}", DT, burst * np.random.default_rng(seed).standard_normal(len(time)))


def noise_for(model, **options):
    deviations = 1e-3 * np.abs(model.simulate([1.0, 1.0])).max(axis=1)
    return GaussianNoise(model.channels, shares_of="response", window=WINDOW, sensor=deviations, **options)


def test_pauses_of_the_calibration_are_no_gap_of_another_record():
    events = Events([quake(1), quake(2)], rest=10.0, names=["a", "b"])
    model = LinearOscillator(events)
    simulated = model.simulate([1.0, 1.0])
    single = {each.name: Measurements(model.channels, DT, simulated[:, each.samples]) for each in events.windows}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        likelihood = FELikelihood(model, single, noise_for(model))
        found = propagate(likelihood, SAMPLES, record=quake(3), **OPTIONS)
    assert found.findings == ()


@pytest.mark.parametrize(
    ("record", "told"),
    [
        (quake(3).resample(0.3), "window of 0.6 s must be at least three steps of 0.3 s"),
        (Events([quake(3), quake(4, 0.08)], rest=3.0, names=["a", "tiny"]), "longer than an event; 'tiny' has 0.06 s"),
    ],
    ids=["coarse", "short"],
)
def test_a_motion_without_levels_is_refused_before_it_is_simulated(record, told, monkeypatch):
    model = LinearOscillator(quake(1))
    measured, noise = Measurements(model.channels, DT, model.simulate([1.0, 1.0])), noise_for(model)
    likelihood = FELikelihood(model, measured, noise)
    monkeypatch.setattr(LinearOscillator, "simulate", lambda self, theta: pytest.fail("simulated"))
    with pytest.raises(ValueError, match=told):
        propagate(likelihood, SAMPLES, record=record, **OPTIONS)
    with pytest.raises(ValueError, match=told):
        noise.under(LinearOscillator(record))
