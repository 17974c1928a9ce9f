"""Findings about modes: each fault is named, and right data are not."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import FunctionModes, LogNormal, ModalData, ModalLikelihood, Posterior, ShearFrame
from fe_likelihoods.checks.result import check_model
from fe_likelihoods.modal.mode_models import StructureModes
from tests.checks.fitted import check_fit, fitted

FLOORS = {f"floor {i}": i for i in (1, 2, 3, 4)}
FRAME = ShearFrame(FLOORS, [20e3] * 4, [30e6] * 4)
NAMES = [f"stiffness_{i}" for i in (1, 2, 3, 4)]
PRIOR = {name: LogNormal(1.0, 0.2) for name in NAMES}
UNIT = "A unit may be wrong"
KNOWN = {"frequency_cv": 0.005, "shape_error": 0.02}


def identified(seed, modes=(1, 2, 3), cv=0.005, error=0.02, **options):
    """Synthetic modes of a frame from the prior, with their stated errors."""
    rng = np.random.default_rng(seed)
    response = StructureModes(FRAME).simulate(np.exp(0.2 * rng.normal(size=4)))[:, [mode - 1 for mode in modes]]
    shapes = response[1:].T / np.linalg.norm(response[1:], axis=0)[:, None]
    shapes = rng.choice([-3.0, 0.2], (len(modes), 1)) * (shapes + error * rng.normal(size=shapes.shape))
    return ModalData(response[0] * (1.0 + cv * rng.normal(size=len(modes))), shapes, tuple(FLOORS), **options)


def changed(data, frequencies=1.0, shapes=None):
    shapes = data.shapes[0] if shapes is None else shapes
    return ModalData(data.frequencies * frequencies, shapes, data.sensors, frequency_cv=0.005, shape_error=0.02)


def kinds(posterior, samples=None):
    return [each.kind for each in check_fit(posterior, samples)]


def before(data, model=FRAME, prior=PRIOR):
    return kinds(Posterior(ModalLikelihood(model, data), prior))


def test_right_data_are_not_blamed():
    assert not [found for seed in range(8) for found in before(identified(seed, **KNOWN))]


@pytest.mark.parametrize(
    ("factor", "text"), [(2 * np.pi, "as with rad/s read as Hz"), (1000**-0.5, "as with a mass in t")]
)
def test_units_are_named(factor, text):
    for seed in range(5):
        posterior = Posterior(ModalLikelihood(FRAME, changed(identified(seed), factor)), PRIOR)
        (found,) = check_fit(posterior)
        assert (found.kind, found.severity) == ("A unit may be wrong", "wrong") and text in found.text
        assert found.kind in [each.kind for each in check_model(posterior).findings]


@pytest.mark.parametrize(
    ("gain", "order", "wanted"),
    [
        (-1.0, [0, 1, 2, 3], "A sign may be wrong: floor 4:"),
        (1.0, [0, 3, 2, 1], "Channels may be swapped: floor 2 and floor 4:"),
    ],
)
def test_faults_of_sensors_are_named(gain, order, wanted):
    """With the right names, except where a fault changes the shapes as another one does."""
    named = 0
    for seed in range(4):
        data = identified(seed)
        shapes = (data.shapes[0] * [1.0, 1.0, 1.0, gain])[:, order]
        found = check_fit(Posterior(ModalLikelihood(FRAME, changed(data, shapes=shapes)), PRIOR))
        named += any(str(each).startswith(wanted) for each in found)
    assert named >= 3


def test_a_mode_that_was_identified_twice_is_named():
    for seed in range(5):
        data = identified(seed)
        shapes = data.shapes[0][[0, 1, 0]] + 0.01 * np.random.default_rng(seed).normal(size=(3, 4))
        assert before(changed(data, [1.0, 1.0, 0.8], shapes)) == ["A mode has no counterpart"]


def test_a_mode_that_the_model_lacks_is_no_fault_of_a_sensor():
    def lowest(theta):
        response = StructureModes(FRAME).simulate(theta)[:, :3]
        return response[0], response[1:].T

    model = FunctionModes(lowest, tuple(PRIOR), tuple(FLOORS))
    for seed in range(5):
        data = identified(seed, (1, 2, 4))
        data = ModalData(data.frequencies, data.shapes[0], data.sensors, **KNOWN)
        (found,) = check_fit(Posterior(ModalLikelihood(model, data), PRIOR))
        assert found.kind == "A mode has no counterpart"
        assert "measured mode 3" in found.text and "select([1, 2])" in found.action


def test_a_fault_that_is_named_before_a_run_is_named_after_it():
    """Parameters make up for a part of it; a unit is found beside a sensor."""
    data, sign = identified(0), "A sign may be wrong"
    for factor, wanted in ((1.0, {sign}), (2 * np.pi, {sign, UNIT})):
        shapes = data.shapes[0] * [1.0, 1.0, 1.0, -1.0]
        posterior = Posterior(ModalLikelihood(FRAME, changed(data, factor, shapes)), PRIOR)
        for samples in (None, fitted(posterior)):
            found = check_fit(posterior, samples)
            assert {each.kind for each in found if each.severity == "wrong"} == wanted, factor
            assert any(each.kind == sign and each.text.startswith("floor 4:") for each in found)


def test_values_far_beyond_their_stated_errors_are_not_used():
    """With right errors nothing is named; with five times as large ones nearly all are."""
    wrong = [0, 0]
    for seed in range(3):
        for k, times in enumerate((1.0, 5.0)):
            data = identified(seed, cv=times * 0.005, error=times * 0.02, **KNOWN)
            posterior = Posterior(ModalLikelihood(FRAME, data), PRIOR)
            found = check_fit(posterior, fitted(posterior))
            assert k or not found
            wrong[k] += any(each.severity == "wrong" and "The largest: the " in each.action for each in found)
    assert wrong[1] >= 2


def test_the_set_of_a_wrong_number_is_named():
    sets = [identified(1) for _ in range(4)]
    frequencies, shapes = (np.concatenate([getattr(each, name) for each in sets]) for name in ("frequencies", "shapes"))
    frequencies[2, 1] *= 1.1
    posterior = Posterior(ModalLikelihood(FRAME, ModalData(frequencies, shapes, tuple(FLOORS), **KNOWN)), PRIOR)
    (found,) = [each for each in check_fit(posterior, fitted(posterior)) if "stated errors" in each.kind]
    assert "The largest: the frequency of mode 2" in found.action and " in set 3" in found.action


def test_errors_that_are_numbers_among_the_priors_are_checked_as_those_of_the_data():
    data = identified(1)
    wrong = replace(data, frequencies=data.frequencies * [[1.0, 1.1, 1.0]])
    known = Posterior(ModalLikelihood(FRAME, replace(wrong, **KNOWN)), PRIOR)
    numbers = PRIOR | {"frequency_error": KNOWN["frequency_cv"], "shape_error": KNOWN["shape_error"]}
    posterior = Posterior(ModalLikelihood(FRAME, wrong), numbers)
    samples = fitted(known)
    assert kinds(posterior) == kinds(known) and kinds(posterior, samples) == kinds(known, samples) != []
