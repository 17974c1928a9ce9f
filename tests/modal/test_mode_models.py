"""Models that have modes: functions, programs, OpenSees and linear structures give the same modes."""

import pickle
import sys

import numpy as np
import pytest
from scipy import sparse

from fe_likelihoods import (
    Channel,
    ExecutableModel,
    FunctionModes,
    ModalData,
    ModalLikelihood,
    OpenSeesModel,
    ShearFrame,
    SimulationFailed,
)
from fe_likelihoods.modal.mode_models import ABSENT, StructureModes, modal_channels, modal_response, opensees_modes
from tests.opensees_column import require_opensees

FLOORS = {"low": 0, "roof": 2}
FRAME = ShearFrame({"low": 1, "roof": 3}, [1.0] * 3, [1.0] * 3)
THETA = np.array([1.0, 1.2, 0.9])


def matrices(theta):
    above = np.append(theta[1:], 0.0)
    return np.diag(theta + above) - np.diag(theta[1:], 1) - np.diag(theta[1:], -1), np.eye(3)


def thin(theta):
    return tuple(sparse.csr_matrix(each) for each in matrices(theta))


def found_modes(theta):
    response = StructureModes(FRAME).simulate(theta)
    return response[0], response[1:].T


def chain(ops, theta):
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    for node in range(4):
        ops.node(node, 0.0)
    ops.fix(0, 1)
    for storey, stiffness in enumerate(theta):
        ops.mass(storey + 1, 1.0)
        ops.uniaxialMaterial("Elastic", storey, float(stiffness))
        ops.element("zeroLength", storey, storey, storey + 1, "-mat", storey, "-dir", 1)
    return opensees_modes(ops, 2, [(1, 1), (3, 1)])


def same(first, second, rtol=1e-9):
    np.testing.assert_allclose(first[0], second[0], rtol=rtol)
    shapes = [each[1:] * np.sign(each[1]) for each in (first, second)]
    np.testing.assert_allclose(shapes[0], shapes[1], atol=rtol)


def test_matrices_and_modes_are_models():
    expected = StructureModes(FRAME).simulate(THETA)[:, :2]
    assert expected.shape == (3, 2)
    for function, sensors in ((matrices, FLOORS), (thin, FLOORS), (found_modes, tuple(FLOORS))):
        model = FunctionModes(function, ("a", "b", "c"), sensors, 2)
        same(model.simulate(THETA), expected)
        same(pickle.loads(pickle.dumps(model)).simulate(THETA), expected)
        assert [channel.name for channel in model.channels] == ["frequency", "low", "roof"]
        assert model.code_parts()["function"] is function


def test_shapes_in_descending_order_of_frequency_are_sorted():
    response = modal_response([3.0, 1.0, 2.0], [[3, 3], [1, 1], [2, 2]], 2)
    assert response.tolist() == [[1.0, 2.0], [1.0, 2.0], [1.0, 2.0]]


def test_a_structure_has_as_many_modes_as_there_are():
    """More modes than were measured are asked for by default; those that do not exist are never paired."""
    model = FunctionModes(matrices, ("a", "b", "c"), FLOORS)
    response = model.simulate(THETA)
    same(response[:, :3], StructureModes(FRAME).simulate(THETA))
    assert model.n_steps > 3 and (response[0, 3:] >= ABSENT).all() and not response[1:, 3:].any()
    for measured in ([0, 1], [0, 2]):
        for ratio in (response[0, measured[1]] / response[0, 0], 1.01):  # alone, and as a close pair
            frequencies = response[0, 0] * np.array([1.0, ratio])
            data = ModalData(frequencies, response[1:, measured].T, tuple(FLOORS), frequency_cv=0.01, shape_error=0.02)
            assert ModalLikelihood(model, data).predict_modes([THETA]).numbers.tolist() == [[k + 1 for k in measured]]
    alone = ModalLikelihood(model, ModalData([0.1, 0.2, 0.3, 0.4], frequency_cv=0.01))
    with pytest.raises(SimulationFailed, match="the model has 3 modes"):
        alone.model.simulate(THETA)


def test_a_program_writes_a_line_for_each_mode():
    """Frequencies in rad/s in the file are converted."""
    script = "print('1.0 0.5 0.8\\n$stiffness -0.3 0.1', file=open('modes.txt', 'w'))"
    model = ExecutableModel(
        [sys.executable, "-S", "solve.py"],
        {"solve.py": script},
        "modes.txt",
        ("stiffness",),
        modal_channels(["low", "roof"]),
        1.0,
        2,
        time_limit=60.0,
        output_units={"frequency": "rad/s"},
    )
    response = model.simulate([4.0])
    np.testing.assert_allclose(response, [[0.5 / np.pi, 2.0 / np.pi], [0.5, -0.3], [0.8, 0.1]], rtol=1e-15)
    data = ModalData([0.16, 0.62], [[0.5, 0.8], [-0.3, 0.1]], ["low", "roof"], frequency_cv=0.01, shape_error=0.02)
    assert np.isfinite(ModalLikelihood(model, data)([4.0]))


@pytest.mark.slow
def test_opensees_has_the_modes_of_the_frame():
    require_opensees()
    model = OpenSeesModel(chain, ("a", "b", "c"), modal_channels(FLOORS), 1.0, 2)
    same(model.simulate(THETA), StructureModes(FRAME).simulate(THETA)[:, :2], 1e-8)
    with pytest.raises(SimulationFailed, match="expected 2 positive ones"):
        model.simulate([-1.0, 1.0, 1.0])


def test_dampings_are_no_parameters_of_modes():
    grouped = ShearFrame({"low": 1, "roof": 3}, [1.0] * 3, [1.0] * 3, groups=[1, 1, 2])
    model = StructureModes(grouped)
    assert model.parameter_names == ("stiffness_1", "stiffness_2") and model.n_steps == 3
    same(model.simulate([1.0, 0.9]), StructureModes(FRAME).simulate([1.0, 1.0, 0.9]), 1e-12)
    assert StructureModes(FRAME).fingerprint != model.fingerprint


@pytest.mark.parametrize(
    ("returned", "sensors", "text"),
    [
        (np.ones((3, 2)), ["a"], "expected the function to return"),
        ((np.ones(3), np.ones((2, 3))), ["a", "b"], "transpose the shapes"),
        (([1.0, -2.0], np.ones((2, 1))), ["a"], "must be positive"),
        (([1.0, 2.0], np.ones((2, 3))), ["a"], "shape"),
        (([1.0, 2.0], np.ones((2, 1)) * 1j), ["a"], "complex"),
        ((np.eye(2), np.eye(2)), ["a"], "give sensors as a mapping"),
        ((np.eye(2), -np.eye(2)), {"a": 0}, "have a positive mass"),
    ],
)
def test_what_are_no_modes_is_a_failed_simulation(returned, sensors, text):
    with pytest.raises(SimulationFailed, match=text):
        FunctionModes(lambda theta: returned, ("x",), sensors, 2).simulate([1.0])


def test_bad_models_are_refused():
    with pytest.raises(ValueError, match="expected a function"):
        FunctionModes("frame", ("x",), ["a"], 2)
    assert modal_channels([])[0] == Channel("frequency", "frequency", "Hz")
