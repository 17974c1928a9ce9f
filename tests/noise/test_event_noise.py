"""Measurements of single events, pauses that are not compared, and a level of noise for every event."""

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    Events,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    LinearStructure,
    Measurements,
    Posterior,
    Record,
    ShearFrame,
    SimulationCache,
    TruncatedNormal,
)
from fe_likelihoods.simulation.model import first_part

NAMES = ("stiffness", "damping")


@pytest.fixture
def events(rng):
    return Events([Record(name, 0.02, rng.normal(size=n)) for name, n in (("EQ1", 60), ("EQ2", 50))], rest=1.0)


@pytest.fixture
def model(events):
    return LinearOscillator(events, period=0.5)


@pytest.fixture
def measured(model, events, rng):
    """Measurements of each event, with five times more noise in the second one."""
    response = events.split(model.simulate([1.1, 0.9]))
    levels = {"EQ1": 0.1, "EQ2": 0.5}
    scale = {name: level * np.std(response["EQ1"], axis=1, keepdims=True) for name, level in levels.items()}
    return {
        name: Measurements(model.channels, 0.02, part + scale[name] * rng.normal(size=part.shape))
        for name, part in response.items()
    }


def residuals(model, events, measured, theta):
    response = events.split(model.simulate(theta))
    return {name: measured[name].values - response[name] for name in measured}


def gaussian(errors, sigma):
    return np.sum(-0.5 * np.log(2.0 * np.pi * sigma**2) - 0.5 * (errors / sigma) ** 2)


def test_pauses_are_not_compared(model, events, measured):
    likelihood = FELikelihood(model, measured)
    assert likelihood.parameter_names == (*NAMES, "sigma_acceleration", "sigma_displacement")
    for theta in ([1.0, 1.0], [1.2, 0.7]):
        errors = residuals(model, events, measured, theta)
        for sigma in ([1.0, 0.01], [0.5, 0.02]):
            expected = sum(gaussian(part[row], sigma[row]) for part in errors.values() for row in range(2))
            assert likelihood([*theta, *sigma]) == pytest.approx(expected, rel=1e-12)
    assert np.isnan(events.join(measured).values).sum() == 2 * 50


def test_data_of_an_event_are_the_same_after_another_event_and_alone(model, events, measured):
    alone = {
        name: FELikelihood(model.with_record(record), measured[name])
        for name, record in zip(events.names, events.records, strict=True)
    }
    after = FELikelihood(model, {"EQ2": measured["EQ2"]})
    assert after.data_fingerprint == alone["EQ2"].data_fingerprint != alone["EQ1"].data_fingerprint
    prior = {name: TruncatedNormal(1.0, 0.3) for name in NAMES}
    prior |= {name: HalfNormal(1.0) for name in after.parameter_names[2:]}
    assert Posterior(after, prior).data_fingerprint == Posterior(alone["EQ2"], prior).data_fingerprint
    both = FELikelihood(model, measured, GaussianNoise(model.channels, groups="event"))
    turned = FELikelihood(
        model, {name: each.select(["displacement", "acceleration"]) for name, each in measured.items()}
    )
    assert both.data_fingerprint == turned.data_fingerprint == JointLikelihood(alone).data_fingerprint
    assert both.data_fingerprint not in (after.data_fingerprint, alone["EQ1"].data_fingerprint)


def test_an_event_without_measurement_changes_the_state_only(model, events, measured):
    only = FELikelihood(model, {"EQ2": measured["EQ2"]})
    errors = residuals(model, events, measured, [1.0, 1.0])["EQ2"]
    expected = gaussian(errors[0], 1.0) + gaussian(errors[1], 0.01)
    assert only([1.0, 1.0, 1.0, 0.01]) == pytest.approx(expected, rel=1e-12)
    alone = FELikelihood(model.with_record(events.records[1]), measured["EQ2"])
    assert abs(only([1.0, 0.1, 1.0, 0.01]) - alone([1.0, 0.1, 1.0, 0.01])) > 0.1  # free vibration of the first event


def test_a_level_per_event(model, events, measured):
    likelihood = FELikelihood(model, measured, noise=GaussianNoise(model.channels, groups="event"))
    sigmas = ("acceleration_EQ1", "displacement_EQ1", "acceleration_EQ2", "displacement_EQ2")
    assert likelihood.parameter_names == (*NAMES, *(f"sigma_{name}" for name in sigmas))
    assert likelihood.fast_parameters == (2, 3, 4, 5)
    errors, levels = residuals(model, events, measured, [1.1, 0.9]), {"EQ1": (0.2, 0.002), "EQ2": (0.9, 0.01)}
    expected = sum(gaussian(errors[name][row], levels[name][row]) for name in levels for row in range(2))
    point = [1.1, 0.9, *levels["EQ1"], *levels["EQ2"]]
    assert likelihood(point) == pytest.approx(expected, rel=1e-12)
    equal = FELikelihood(model, measured)  # one level: the same value where the levels are equal
    assert likelihood([1.1, 0.9, 0.3, 0.01, 0.3, 0.01]) == pytest.approx(equal([1.1, 0.9, 0.3, 0.01]), rel=1e-12)
    assert likelihood([1.1, 0.9, 0.3, 0.01, 0.3, 0.0]) == -np.inf and likelihood.simulations == 1
    best = {name: part.std(axis=1) for name, part in errors.items()}
    assert (best["EQ2"] > 3.0 * best["EQ1"]).all()
    sensor = GaussianNoise(model.channels, groups="event", sensor=(0.3, 0.02))
    total = np.hypot([*levels["EQ1"], *levels["EQ2"]], [0.3, 0.02, 0.3, 0.02])
    assert FELikelihood(model, measured, sensor)(point) == pytest.approx(likelihood([1.1, 0.9, *total]), rel=1e-12)


def test_first_part_cache_and_guide(model, measured, tmp_path):
    cache = SimulationCache(tmp_path / "cache.db")
    likelihood = FELikelihood(model, measured, noise=GaussianNoise(model.channels, groups="event"), cache=cache)
    point = [1.0, 1.0, 0.3, 0.01, 0.5, 0.02]
    value = likelihood(point)
    again = FELikelihood(model, measured, noise=GaussianNoise(model.channels, groups="event"), cache=cache)
    assert again(point) == value and again.simulator.disk_hits == 1
    assert FELikelihood(model, measured, cache=cache).density_parts() != again.density_parts()
    part = likelihood.first(0.5)  # within the first event
    only = FELikelihood(first_part(model, 0.5), measured["EQ1"].trim(0.0, 0.5), GaussianNoise(model.channels))
    assert part(point) == pytest.approx(only(point[:4]), rel=1e-12)
    prior = {name: TruncatedNormal(1.0, 0.3) for name in NAMES}
    prior |= {name: HalfNormal(1.0) for name in likelihood.parameter_names[2:]}
    posterior = Posterior(likelihood, prior)
    assert Posterior(again, prior).fingerprint == posterior.fingerprint
    assert posterior.guide() is not None


def test_bad_input_is_refused_before_anything_is_simulated(model, events, measured):
    channel = (Channel("displacement", "acceleration", "g"),)
    cases = {
        "no event 'EQ3'; the events are EQ1, EQ2": {"EQ3": measured["EQ1"]},
        "expected Measurements for one or more of EQ1, EQ2": {},
        "measurements of 'EQ2': expected one time step": measured | {"EQ2": measured["EQ2"].decimate(2)},
        "event from 0, its first sample, to 0.98 s, got measurements from 0 to 1.18 s": {"EQ2": measured["EQ1"]},
        r"the event from 0, .*from -0.02 to .*\.trim\(start, stop\)": {"EQ1": measured["EQ1"].shift(-0.02)},
        "'EQ2': .*got measurements from -1.2 to": {"EQ2": measured["EQ2"].shift(-1.2)},
        "expected a first sample at a multiple": {"EQ2": Measurements(channel, 0.04 * 1.5, np.ones((1, 3)))},
        "rename one of them": measured | {"EQ2": Measurements(channel, 0.02, np.ones((1, 5)))},
    }
    for message, wrong in cases.items():
        with pytest.raises(ValueError, match=message):
            FELikelihood(model, wrong)
    whole = Measurements(model.channels, 0.02, model.simulate([1.0, 1.0]))
    with pytest.raises(ValueError, match="100 measured samples are outside of every event, the first at 1.2 s"):
        FELikelihood(model, whole, noise=GaussianNoise(model.channels, groups="event"))
    for wrong in ("per event", GaussianNoise):
        with pytest.raises(ValueError, match="noise must be a noise, such as .*got .*(per event|class)"):
            FELikelihood(model, whole, noise=wrong)
    turned = whole.select(["displacement", "acceleration"])
    with pytest.raises(ValueError, match="expected measurements of acceleration, displacement; got displacement"):
        GaussianNoise(model.channels, groups="all").with_measurements(turned)
    plain = LinearOscillator(events.trim(0.0, 1.0))
    for arguments in ((measured,), (whole, GaussianNoise(plain.channels, groups="event"))):
        with pytest.raises(ValueError, match="expected a model whose excitation is Events"):
            FELikelihood(plain, *arguments)


def test_response_that_begins_after_a_lead_is_refused(events, rng):
    frame = ShearFrame({"low": 1, "top": 2}, [1, 1], [900.0, 700.0])
    structure = LinearStructure(frame, events, lead=0.4)
    data = {"EQ2": Measurements(structure.channels, 0.02, rng.normal(size=(2, 50)))}
    for noise in (None, GaussianNoise(structure.channels, groups="event")):
        with pytest.raises(ValueError, match="got LinearStructure without 0.4 s; leave out its lead, and put NaN"):
            FELikelihood(structure, data, noise)
    assert FELikelihood(LinearStructure(frame, events), data).n_samples.samples.tolist() == [50, 50]
