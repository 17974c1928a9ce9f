"""Likelihood of modes: its density, derivatives, caches, what is refused, and what is remarked on."""

import numpy as np
import pytest
from scipy.stats import norm

from fe_likelihoods import (
    Channel,
    FunctionModes,
    LinearStructure,
    LogNormal,
    ModalData,
    ModalLikelihood,
    ModalModel,
    Posterior,
    Record,
    ShearFrame,
    SimulationCache,
    Uniform,
    check_data,
)
from fe_likelihoods.modal.mode_models import StructureModes
from fe_likelihoods.models.undamped_modes import undamped_modes
from fe_likelihoods.simulation.label import ModelLabel

FLOORS = {"floor 1": 1, "floor 2": 2, "floor 3": 3, "roof": 4}
FRAME = ShearFrame(FLOORS, [1.0, 1.1, 0.9, 1.0], [900.0] * 4)
PRIOR = {f"stiffness_{i}": LogNormal(1.0, 0.3) for i in range(1, 5)}


def identified(truth, modes, rng, cv=0.01, error=0.03, n_sets=1, **options):
    """Synthetic identifications of some modes of the frame, with arbitrary scales and signs."""
    response = StructureModes(FRAME).simulate(truth)[:, [mode - 1 for mode in modes]]
    shapes = response[1:].T / np.linalg.norm(response[1:], axis=0)[:, None]
    shape = (n_sets, len(modes))
    factors = rng.uniform(0.3, 3.0, shape) * rng.choice([-1.0, 1.0], shape)
    return ModalData(
        response[0] * (1.0 + cv * rng.normal(size=shape)),
        factors[..., None] * (shapes + error * rng.normal(size=(*shape, len(FLOORS)))),
        tuple(FLOORS),
        mode_numbers=modes,
        **options,
    )


def independent(theta, data, cv, sigma):
    """Log-likelihood of single modes, written out."""
    storeys = 900.0 * np.asarray(theta)
    stiffness = np.diag(storeys + [*storeys[1:], 0.0]) - np.diag(storeys[1:], 1) - np.diag(storeys[1:], -1)
    frequencies, shapes = undamped_modes(stiffness, np.diag(FRAME.masses))
    total = 0.0
    for k in range(data.n_sets):
        for j, number in enumerate(data.mode_numbers):
            total += norm.logpdf(frequencies[number - 1] / data.frequencies[k, j], 1.0, cv)
            mac = (shapes[number - 1] @ data.shapes[k, j]) ** 2 / (shapes[number - 1] @ shapes[number - 1])
            total += 3 * norm.logpdf(0.0, 0.0, sigma) - 0.5 * (1.0 - mac) / sigma**2
    return total


def test_the_density_of_known_and_unknown_errors(rng):
    data = identified([1.0, 0.9, 1.1, 1.0], [3, 1], rng, n_sets=2)
    likelihood = ModalLikelihood(FRAME, data)
    assert likelihood.parameter_names == (*PRIOR, "frequency_error", "shape_error")
    theta = np.array([1.02, 0.95, 1.05, 0.98])
    expected = independent(theta, data, np.hypot(0.02, 1e-4), np.hypot(0.04, 1e-3))
    assert likelihood([*theta, 0.02, 0.04]) == pytest.approx(expected, rel=1e-12)
    known = ModalLikelihood(FRAME, identified([1, 1, 1, 1], [1], rng, frequency_cv=0.01, shape_error=0.02))
    assert known.parameter_names == tuple(PRIOR)
    assert known(theta) == pytest.approx(independent(theta, known.model.data, 0.01, 0.02), rel=1e-12)
    both = ModalLikelihood(FRAME, known.model.data, "common")
    assert both([*theta, 0.02]) == pytest.approx(independent(theta, known.model.data, 0.0005**0.5, 0.02), rel=1e-12)
    prior = PRIOR | {"frequency_error": LogNormal(0.01, 0.5), "shape_error": 0.04}
    posterior = Posterior(likelihood, prior)
    assert posterior.log_likelihood([*theta, 0.02]) == pytest.approx(expected, rel=1e-12)
    assert posterior.likelihood.predict_modes([*theta, 0.02]).numbers.tolist() == [[3, 1]]
    each = ModalLikelihood(FRAME, data, "mode", "mode")
    assert each.parameter_names[4:] == ("frequency_error_3", "frequency_error_1", "shape_error_3", "shape_error_1")
    assert each([*theta, 0.02, 0.02, 0.04, 0.04]) == pytest.approx(expected, rel=1e-12)
    assert likelihood([*theta, 0.0, 0.04]) == likelihood([*theta, 0.02, -1.0]) == -np.inf


def test_every_error_is_served_by_one_simulation(rng, tmp_path):
    data = identified([1.0, 0.9, 1.1, 1.0], [1, 2], rng)
    likelihood = ModalLikelihood(FRAME, data, cache=SimulationCache(tmp_path / "modes.db"))
    points = np.column_stack([np.ones((50, 4)), rng.uniform(0.001, 0.1, (50, 2))])
    values = likelihood(points)
    assert likelihood.simulations == 1 and np.isfinite(values).all() and len(set(values)) == 50
    assert likelihood.simulator.n_numbers == 6
    again = ModalLikelihood(FRAME, data, "mode", cache=SimulationCache(tmp_path / "modes.db"))
    assert np.isfinite(again([1, 1, 1, 1, 0.01, 0.02, 0.03])) and again.disk_hits == 1


def test_a_covariance_of_the_frequencies(rng):
    from scipy.stats import multivariate_normal

    data = identified([1.0, 0.9, 1.1, 1.0], [1, 2], rng, shape_error=0.03)
    covariance = np.array([[4e-4, 3e-4], [3e-4, 1e-3]])
    correlated = ModalData(
        data.frequencies, data.shapes, data.sensors, covariance=covariance, shape_error=0.03, mode_numbers=[1, 2]
    )
    alone = ModalLikelihood(FRAME, data)
    theta = np.array([1.02, 0.95, 1.05, 0.98])
    found = StructureModes(FRAME).simulate(theta)[0, :2]
    measured, cv = data.frequencies[0], 0.01
    shapes_only = alone([*theta, cv]) - norm.logpdf(found / measured, 1.0, np.hypot(cv, 1e-4)).sum()
    relative = covariance / np.outer(measured, measured)
    expected = shapes_only + multivariate_normal.logpdf(found / measured - 1.0, None, relative)
    assert ModalLikelihood(FRAME, correlated)(theta) == pytest.approx(expected, rel=1e-9)


def test_student_errors_have_the_density_of_scipy(rng):
    from scipy.stats import multivariate_t, t

    theta = np.array([1.02, 0.95, 1.05, 0.98])
    data = identified([1.0, 0.9, 1.1, 1.0], [3, 1], rng, n_sets=2)
    frequencies = data.frequencies.copy()
    frequencies[1, 0] = np.nan
    shapes = np.where(np.isnan(frequencies)[:, :, None], np.nan, data.shapes)
    data = ModalData(frequencies, shapes, data.sensors, mode_numbers=[3, 1])
    likelihood = ModalLikelihood(FRAME, data).with_noise(ModalLikelihood(FRAME, data, student_t=4).noise)
    computed = StructureModes(FRAME).simulate(theta)[:, [2, 0]]
    c, sigma, expected = np.hypot(0.02, 1e-4), np.hypot(0.04, 1e-3), 0.0
    for k, j in ((0, 0), (0, 1), (1, 1)):
        expected += t.logpdf(computed[0, j] / frequencies[k, j] - 1.0, 4, scale=c)
        mac = (computed[1:, j] @ shapes[k, j]) ** 2 / (computed[1:, j] @ computed[1:, j])
        expected += multivariate_t.logpdf([np.sqrt(1.0 - mac), 0.0, 0.0], np.zeros(3), sigma**2 * np.eye(3), 4)
    assert likelihood([*theta, 0.02, 0.04]) == pytest.approx(expected, rel=1e-10)
    predicted = likelihood.predict_modes([[*theta, 0.02, 0.04]] * 50)
    half = 0.5 * np.diff(predicted.interval(0.9), axis=0)[0] / predicted.frequencies[0]
    np.testing.assert_allclose(half, t.ppf(0.95, 4) * 0.02, rtol=0.05)
    with pytest.raises(ValueError, match="degrees of freedom above 2"):
        ModalLikelihood(FRAME, data, student_t=1)


def test_frequencies_of_several_days_have_a_common_temperature_slope(rng):
    truth, slope = np.array([1.0, 0.9, 1.1, 1.0]), -2e-3
    temperatures = np.array([-5.0, 5.0, 12.0, 25.0, 33.0])
    data = identified(truth, [1, 2, 3], rng, cv=0.002, error=0.02, n_sets=5)
    frequencies = data.frequencies * (1.0 + slope * (temperatures - 20.0))[:, None]
    known = {"temperatures": temperatures, "frequency_cv": 0.002, "shape_error": 0.02}
    data = ModalData(frequencies, data.shapes, data.sensors, **known)
    likelihood = ModalLikelihood(FRAME, data)
    assert likelihood.parameter_names == (*PRIOR, "temperature_slope")
    at_zero = likelihood.model.simulate([*truth, slope])
    ratios = at_zero.reshape(3, 5, 5)[:, :, 0].T * frequencies
    expected = StructureModes(FRAME).simulate(truth)[0, :3] * (1.0 + slope * (temperatures - 20.0))[:, None]
    np.testing.assert_allclose(ratios, expected, rtol=1e-12)
    posterior = Posterior(likelihood, PRIOR | {"temperature_slope": Uniform(-0.01, 0.01)})
    mean = ModalLikelihood(FRAME, data.mean())
    assert mean.model.data.temperatures == pytest.approx(14.0)
    assert posterior.parameters[4].label == "temperature_slope [1/K]"
    predicted = likelihood.predict_modes([[*truth, slope]])  # at the mean temperature
    np.testing.assert_allclose(predicted.frequencies[0], expected.mean(axis=0), rtol=1e-12)


@pytest.mark.parametrize("kind", ["single", "sets", "pair", "modal model", "temperatures"])
def test_derivatives_agree_with_differences(kind, rng):
    frame, theta = FRAME, np.array([1.0, 0.9, 1.1, 1.0])
    data = identified(theta, [3, 1], rng, n_sets=2 if kind == "sets" else 1)
    if kind == "pair":
        shapes = StructureModes(FRAME).simulate(theta)[1:, :2].T + 0.03 * rng.normal(size=(2, 4))
        data = ModalData([3.0, 3.02], shapes, tuple(FLOORS))
    if kind == "modal model":
        frame, theta = ModalModel(list(FLOORS), 2), np.array([1.0, 3.0, *rng.normal(size=8)])
        data = ModalData([1.0, 3.1], rng.normal(size=(2, 4)), tuple(FLOORS))
    if kind == "temperatures":
        data = ModalData(np.tile(data.frequencies, (2, 1)), None, temperatures=[-5.0, 30.0], mode_numbers=[3, 1])
    model = ModalLikelihood(frame, data).model
    names = [name for name in frame.parameter_names if not name.startswith("damping")]
    if kind == "temperatures":
        names, theta = [*names, "temperature_slope"], np.append(theta, -0.001)
    assert list(model.parameter_names) == names and hasattr(model, "jacobian")
    found = model.jacobian(theta)
    for p, unit in enumerate(np.eye(len(theta))):
        difference = (model.simulate(theta + 1e-6 * unit) - model.simulate(theta - 1e-6 * unit)) / 2e-6
        np.testing.assert_allclose(found[p], difference, atol=1e-6 * max(1.0, abs(difference).max()))


def test_frequencies_alone_are_paired_by_number():
    data = ModalData([2.0, 8.0], frequency_cv=0.01, mode_numbers=[1, 3])
    likelihood = ModalLikelihood(
        FunctionModes(lambda theta: (theta * [1.0, 2.0, 4.0], np.empty((3, 0))), ("f",), (), 3), data
    )
    assert likelihood.parameter_names == ("f",)
    assert likelihood([2.02]) == pytest.approx(2 * norm.logpdf(0.01, 0.0, 0.01))
    predicted = likelihood.predict_modes([[2.0]])
    assert np.isnan(predicted.assurance).all() and [row[5] for row in predicted.rows()] == ["MAC", "-", "-"]
    assert np.diff(predicted.interval(0.9), axis=0)[0] == pytest.approx(
        2 * 1.645 * 0.01 * np.array([2.0, 8.0]), rel=0.1
    )
    assert not check_data(likelihood.measurements)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda data: ModalLikelihood(FRAME, "modes"), "expected ModalData"),
        (lambda data: ModalLikelihood(ShearFrame({"roof": 4}, [1] * 4, [1] * 4), data), "has no sensors floor 1"),
        (
            lambda data: ModalLikelihood(FunctionModes(len, ("a",), tuple(FLOORS), 2), data),
            "has 2 modes, and 3 were measured",
        ),
        (
            lambda data: ModalLikelihood(FRAME, data, frequency_error="each"),
            'shape_error must be "common" or "mode"',
        ),
        (lambda data: ModalLikelihood(FRAME, data, shape_error=0.02), "numbers in the mapping of priors"),
        (lambda data: ModalLikelihood(FRAME, data).predict_modes(np.ones((1, 3))), "shape"),
        (
            lambda data: ModalLikelihood(LinearStructure(FRAME, Record("m", 0.1, np.ones(5))).structure, data).first(1),
            "cannot be shortened",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make, text, rng):
    with pytest.raises(ValueError, match=text):
        make(identified(np.ones(4), [1, 2, 3], rng))


def test_a_model_without_modes_is_refused(rng):
    from fe_likelihoods import FunctionModel

    model = FunctionModel(lambda theta: np.zeros((1, 3)), ("a",), (Channel("u", "displacement", "m"),), 1.0, 3)
    with pytest.raises(ValueError, match="whose first channel is a frequency"):
        ModalLikelihood(model, identified(np.ones(4), [1], rng))


def test_the_user_s_code_is_known_within_the_paired_modes():
    """Else a cache of their predictions would return predictions of other code."""
    functions = (
        (lambda theta: (theta * [1.0, 2.0], np.empty((2, 0)))),
        (lambda theta: (theta * [1.0, 3.0], np.empty((2, 0)))),
    )
    for data in (ModalData([2.0, 4.0]), ModalData([2.0, 4.0], temperatures=5.0)):
        labels = {ModelLabel(ModalLikelihood(FunctionModes(each, ("f",), ()), data).model).code for each in functions}
        assert len(labels) == 2
    assert not hasattr(ModalLikelihood(FRAME, ModalData([2.0, 4.0])).model, "code_parts")
