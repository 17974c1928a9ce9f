"""Units, nominal values and labels of parameters."""

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    problems,
)

CHANNELS = (Channel("top", "displacement", "mm"), Channel("base", "acceleration", "g"))


class Model:
    """Two channels; one parameter with a unit, one multiple of a nominal value, one without either."""

    parameter_names = ("length", "stiffness", "shape")
    channels = CHANNELS
    dt, n_steps, fingerprint = 0.01, 50, "model"
    parameter_units = {"length": "m"}
    nominal = {"stiffness": 2.5e8}
    nominal_units = {"stiffness": "MPa"}

    def simulate(self, theta):
        return np.outer(theta[:2], np.arange(50.0))


def likelihood(noise=None):
    measured = Measurements(CHANNELS, 0.01, np.random.default_rng(0).normal(size=(2, 50)))
    return FELikelihood(Model(), measured, noise)


def test_parameters_have_the_units_of_their_model_and_channels():
    parameters = likelihood().parameters
    labels = [each.label for each in parameters]
    assert labels == ["length [m]", "stiffness [x 250 MPa]", "shape", "sigma_top [mm]", "sigma_base [g]"]
    assert [parameters[3].shown(0.002), *parameters[4].shown([9.80665, 4.903325])] == pytest.approx([2.0, 1.0, 0.5])
    assert [each.nominal == 1.0 for each in parameters] == [False, True, False, False, False]  # NaN


@pytest.mark.parametrize(
    ("noise", "units"),
    [
        (AutoregressiveNoise(CHANNELS), ["mm", "g", "-", "-"]),
        (GaussianNoise(CHANNELS, groups="all", scales=[1.0, 2.0]), ["-"]),
        (None, ["mm", "g"]),
    ],
)
def test_units_of_noise_parameters(noise, units):
    assert [each.unit for each in likelihood(noise).parameters[3:]] == units


def test_names_are_those_of_the_likelihood():
    reduced = likelihood().marginal({"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(1.0)})
    joint = JointLikelihood({"first": likelihood(), "second": likelihood()}, separate=["sigma_top"])
    for each in (reduced, joint):
        assert [parameter.name for parameter in each.parameters] == list(each.parameter_names)
    assert joint.parameters[joint.parameter_names.index("sigma_top_second")].label == "sigma_top_second [mm]"


def test_built_in_problems_are_described():
    column = problems.bridge_column(every=16, duration=10.0)
    # 3320 ksi and 28 400 ksi
    assert [each.label for each in column.parameters][:2] == ["Ec [x 22.89 GPa]", "Es [x 195.8 GPa]"]
    assert all(each.unit for problem in (column, problems.isolated_bridge()) for each in problem.parameters)
