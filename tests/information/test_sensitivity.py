"""Sobol indices by an emulator: the Ishigami function and a g-function, whose indices are known."""

import numpy as np
import pytest
from scipy.stats import norm

from fe_likelihoods import Channel, FunctionModel, SimulationFailed, Uniform, peak, sensitivity
from fe_likelihoods.priors.multivariate import MultivariateNormal

TOP = (Channel("top", "displacement", "m"),)


def model_of(function, d):
    """A model whose response is a number at both of its samples."""
    names = [f"x{i + 1}" for i in range(d)]
    return FunctionModel(lambda theta: np.full((1, 2), function(theta)), names, TOP, 1.0, 2)


def first(response):
    return response[0, 0]


def check(found, first_order, total):
    """Within four standard errors, which are small."""
    assert (np.abs(found.first[0] - first_order) < 4.0 * found.first_error[0] + 0.005).all(), str(found)
    assert (np.abs(found.total[0] - total) < 4.0 * found.total_error[0] + 0.005).all(), str(found)
    assert max(found.first_error.max(), found.total_error.max()) < 0.06, str(found)


def test_ishigami():
    """T. Ishigami, T. Homma (1990), ISUMA, 398-403."""
    a, b = 7.0, 0.1
    model = model_of(lambda x: np.sin(x[0]) + a * np.sin(x[1]) ** 2 + b * x[2] ** 4 * np.sin(x[0]), 3)
    prior = {name: Uniform(-np.pi, np.pi) for name in model.parameter_names}
    found = sensitivity(model, prior, lambda response: [response[0, 0], 3.0 * response[0, 0] + 1.0], simulations=200)
    np.testing.assert_allclose(found.first[1], found.first[0], rtol=1e-6)
    alone = np.array([0.5 * (1.0 + b * np.pi**4 / 5.0) ** 2, a**2 / 8.0, 0.0])
    both = 8.0 * b**2 * np.pi**8 / 225.0
    variance = alone.sum() + both
    check(found, alone / variance, (alone + [both, 0.0, both]) / variance)
    assert found.unexplained[0] < 0.1 and found.simulations == 200
    assert "-0.0" not in str(found)
    assert abs(found.sd[0] ** 2 / variance - 1.0) < 0.3


def test_control_noise_is_not_explained():
    random = np.random.default_rng(1)
    model = model_of(lambda x: x[0] + 3.0 * random.standard_normal(), 2)
    found = sensitivity(model, {"x1": norm(0.0, 1.0), "x2": norm(0.0, 1.0)}, first, simulations=60)
    assert found.unexplained[0] > 0.5


def test_failures_and_errors():
    def fail(x):
        if x[0] > 1.0:
            raise SimulationFailed("no")
        return x[0] + x[1]

    prior = {"x1": norm(0.0, 1.0), "x2": norm(0.0, 1.0)}
    found = sensitivity(model_of(fail, 2), prior, peak("top"), simulations=40)
    assert found.failed == 6  # of the upper 16 %
    with pytest.raises(ValueError, match="at least 20 simulations for 2 parameters; got 5"):
        sensitivity(model_of(fail, 2), prior, first, simulations=5)
    with pytest.raises(ValueError, match="numbers of the response"):
        sensitivity(model_of(fail, 2), prior, "top")
    with pytest.raises(ValueError, match="quantities that vary"):
        sensitivity(model_of(lambda x: 1.0, 2), prior, first, simulations=20)
    with pytest.raises(ValueError, match="x1, x2 have a joint prior"):
        sensitivity(model_of(fail, 2), {("x1", "x2"): MultivariateNormal([0.0, 0.0], np.eye(2))}, first)
