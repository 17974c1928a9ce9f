"""Predictions under another record: from the virgin structure, or from its state after the calibration record."""

import warnings

import numpy as np
import pytest

from fe_likelihoods import (
    Events,
    IsolatedBridge,
    LinearOscillator,
    LinearStructure,
    Record,
    ShearFrame,
    peak,
    propagate,
)


class Slip:
    """Rigid block with a foundation that slips once the acceleration has exceeded a limit: response = slip so far."""

    parameter_names = ("limit",)

    def __init__(self, record):
        from fe_likelihoods import Channel

        self.channels = (Channel("slip", "displacement", "m"),)
        self.record, self.dt, self.n_steps = record, record.dt, record.n_steps
        self.fingerprint = "slip " + record.fingerprint

    def with_record(self, record):
        return type(self)(record)

    def simulate(self, theta):
        return np.cumsum(np.maximum(np.abs(self.record.acceleration) - theta[0], 0.0))[None]


def last(model, record, rest, theta):
    """Response to the new record of a structure that has been through its own excitation."""
    events = Events([model.record, record], rest)
    return model.with_record(events).simulate(theta)[:, events.windows[1].samples]


def test_state_is_carried_through_or_not(record):
    model, stronger = Slip(record), record.scale(2.0)
    samples = np.array([[0.1], [0.2], [0.2]])
    end = propagate(model, samples, record=stronger, from_state="end", rest=1.0, progress=False)
    virgin = propagate(model, samples, record=stronger, from_state="virgin", progress=False)
    expected = [last(model, stronger, 1.0, theta) for theta in samples]
    np.testing.assert_allclose(end.mean, np.mean(expected, axis=0), rtol=1e-14)
    assert (end.from_state, virgin.from_state) == ("end", "virgin") and "from_state='end'" in repr(end)
    assert end.mean.shape == virgin.mean.shape == (1, record.n_steps) and len(end.time) == record.n_steps
    earlier = np.mean([model.simulate(theta)[0, -1] for theta in samples])
    np.testing.assert_allclose(end.mean, virgin.mean + earlier, rtol=1e-12)
    settings = {"record": stronger, "from_state": "end", "rest": 1.0, "progress": False}
    peaks = propagate(model, samples, quantity=peak("slip"), **settings)
    np.testing.assert_allclose(peaks.values, [each.max() for each in expected])


def test_the_default_is_named_in_a_warning_at_the_line_of_the_user_where_it_matters(record):
    with pytest.warns(UserWarning, match='Slip may depend .* virgin structure.*from_state="end"') as caught:
        prediction = propagate(Slip(record), np.array([[0.1]]), record=record.scale(2.0), progress=False)
    assert prediction.from_state == "virgin" and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = propagate(LinearOscillator(record), np.ones((2, 2)), record=record, progress=False)
        assert found.from_state == "virgin"
        propagate(Slip(record), np.array([[0.1]]), progress=False)
        propagate(Slip(record), np.array([[0.1]]), record=record, from_state="virgin", progress=False)


@pytest.mark.parametrize("every", [1, 4])
def test_the_bridge_keeps_its_components(rng, every):
    def motion(n_steps):
        return Record("table", 0.01, 3.0 * rng.normal(size=n_steps))

    first, second = (motion(41), motion(41)), (motion(30), motion(30))
    bridge = IsolatedBridge(first[0], vertical=first[1], every=every)
    pairs = {"both": second, "horizontal": second[0]}
    for name, record in pairs.items():
        found = propagate(bridge, np.ones((1, 10)), record=record, from_state="end", rest=0.1, progress=False).mean
        n_zeros = 10 if every == 1 else 11  # a sample of the response at the first sample of the new record
        vertical = second[1] if name == "both" else second[1].scale(0.0)
        rest = 0.01 * n_zeros
        joined = first[0].followed_by(second[0], rest), first[1].followed_by(vertical, rest)
        whole = IsolatedBridge(joined[0], vertical=joined[1], every=every).simulate(np.ones(10))
        np.testing.assert_array_equal(found, whole[:, (41 + n_zeros) // every :])
        assert found.shape[1] == bridge.with_record(record).n_steps == (30 - 1) // every + 1
    with pytest.raises(ValueError, match="a horizontal and a vertical Record"):
        bridge.with_record([first[0]])


def test_supports_of_a_linear_structure_follow_each_other(rng):
    motions = [Record("support", 0.02, rng.normal(size=60)) for _ in range(2)]
    frame = ShearFrame({"low": 1, "top": 2}, [1, 1], [900.0, 700.0])
    structure = LinearStructure(frame, motions[0], lead=0.4)
    theta = np.full(len(structure.parameter_names), 0.1)
    end = propagate(structure, theta[None], record=motions[1], from_state="end", rest=0.2, progress=False)
    whole = LinearStructure(frame, motions[0].followed_by(motions[1], 0.2))
    np.testing.assert_allclose(end.mean, whole.simulate(theta)[:, 70 + 20 :], rtol=1e-9, atol=1e-12)


def test_refused_before_any_simulation(record):
    model, samples = Slip(record), np.array([[0.1]])
    cases = {
        'from_state must be "virgin" or "end"; got \'damaged\'': {"record": record, "from_state": "damaged"},
        "starts a new record from the end": {"from_state": "end"},
        "zero or more seconds, got -1.0": {"record": record, "from_state": "end", "rest": -1.0},
        "use Record.resample": {"record": record.resample(0.01), "from_state": "end"},
    }
    model.simulate = None
    for message, settings in cases.items():
        with pytest.raises(ValueError, match=message):
            propagate(model, samples, progress=False, **settings)
    model.record = None
    with pytest.raises(ValueError, match='Slip cannot start from_state="end": it needs its Record'):
        propagate(model, samples, record=record, from_state="end", progress=False)
