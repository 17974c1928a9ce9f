"""OpenSees models: accurate, repeatable, run in a separate process, restarted after a crash."""

import importlib.util
import sys

import numpy as np
import pytest

from fe_likelihoods import LinearOscillator, OpenSeesModel, Record, SimulationFailed
from fe_likelihoods.simulation.label import ModelLabel
from fe_likelihoods.simulation.local_pool import LocalPool
from fe_likelihoods.simulation.model import simulate_batch, split_seconds
from tests.opensees_column import require_opensees
from tests.opensees_oscillator import CHANNELS, DAMPING, PERIOD, Oscillator

NAMES = ("stiffness", "damping")
DT, N_STEPS = 0.02, 200


@pytest.fixture(scope="module")
def record():
    require_opensees()
    acceleration = np.random.default_rng(4).normal(size=N_STEPS)
    acceleration[0] = 0.0
    return Record("noise", DT, acceleration)


def model_of(record, substeps, **options):
    function = Oscillator(record.acceleration, DT, substeps)
    return OpenSeesModel(function, NAMES, CHANNELS, DT, N_STEPS, **options)


@pytest.fixture(scope="module")
def model(record):
    return model_of(record, 5, time_limit=2.0)


def test_converges_to_the_exact_response_with_second_order(record):
    theta = np.array([1.2, 0.8])
    exact = LinearOscillator(record, PERIOD, DAMPING).simulate(theta)
    scale = np.abs(exact).max(axis=1)
    errors = []
    for substeps in (5, 10, 20):
        response = model_of(record, substeps).simulate(theta)
        errors.append(np.abs(response - exact).max(axis=1) / scale)
    # average acceleration elongates the period by the fraction (omega h)^2 / 12: 2e-5 with the smallest step
    assert (errors[-1] < 1e-3).all()
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 2.0, atol=0.1)


def test_runs_are_independent(model, record):
    loaded_before = "openseespy.opensees" in sys.modules
    theta, other = np.array([1.2, 0.8]), np.array([0.4, 2.0])
    first = model.simulate(theta)
    model.simulate(other)
    np.testing.assert_array_equal(model.simulate(theta), first)
    np.testing.assert_array_equal(model_of(record, 5).simulate(theta), first)  # in a new process
    assert ("openseespy.opensees" in sys.modules) == loaded_before


def test_the_run_after_a_failure_is_not_affected(model):
    expected = model.simulate([1.0, 1.0])
    reasons = {
        9.0: "the worker process died (signal 6)",
        10.0: "stopped at the time limit of 2 s",
        11.0: "RuntimeError: OpenSees did not converge at step 1",
        np.nan: "",
    }
    for stiffness, reason in reasons.items():
        with pytest.raises(SimulationFailed) as caught:
            model.simulate([stiffness, 1.0])
        text, seconds = split_seconds(caught.value.reason)
        assert text.startswith(reason)
        assert seconds is not None
        np.testing.assert_array_equal(model.simulate([1.0, 1.0]), expected)


def test_same_bits_in_two_workers(model, rng):
    thetas = rng.uniform(0.5, 1.5, size=(6, 2))
    expected = [model.simulate(theta) for theta in thetas]
    with LocalPool(2) as pool:
        batch = simulate_batch(model, thetas, pool)
    assert batch.reasons == [""] * 6
    np.testing.assert_array_equal(batch.response, expected)


def test_label_depends_on_the_function_and_its_data(model, record):
    """The record is a value of the function here, and nothing that the model declares."""
    others = model_of(record, 5), model_of(record, 6), model_of(record.scale(2.0), 5)
    assert {other.fingerprint for other in others} == {model.fingerprint}
    label, *labels = (ModelLabel(each).code for each in (model, *others))
    assert [other == label for other in labels] == [True, False, False]


def test_an_analysis_that_stops_after_a_number_of_samples(record):
    def shaken(ops, theta, n_steps=N_STEPS):
        return Oscillator(record.acceleration[:n_steps], DT, 5)(ops, theta)

    model = OpenSeesModel(shaken, NAMES, CHANNELS, DT, N_STEPS)
    part = model.first(1.0)
    assert part.n_steps == 51 and part.fingerprint != model.fingerprint
    # the path of this excitation ends with the part: round-off of the clock interpolates between other values
    np.testing.assert_allclose(part.simulate([1.2, 0.8]), model.simulate([1.2, 0.8])[:, :51], rtol=0, atol=1e-9)
    assert not hasattr(model_of(record, 5), "first")


def test_wrong_arguments_are_rejected(record, monkeypatch):
    with pytest.raises(ValueError, match="expected a function of OpenSees"):
        OpenSeesModel(3, NAMES, CHANNELS, DT, N_STEPS)
    with pytest.raises(ValueError, match="time_limit must be a positive number"):
        model_of(record, 5, time_limit=-1.0)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match="pip install openseespy"):
        model_of(record, 5)
