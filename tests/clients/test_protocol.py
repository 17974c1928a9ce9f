"""Methods of the posterior for clients: clear errors."""

import numpy as np
import pytest

from .problem import make_posterior


@pytest.fixture
def posterior():
    return make_posterior()


@pytest.mark.parametrize("density", ["log_prob", "log_prior", "log_likelihood"])
@pytest.mark.parametrize("shape", [(), (3,), (2, 5), (1, 2, 4)])
def test_errors_of_wrong_shapes_name_the_parameters(posterior, density, shape):
    with pytest.raises(ValueError, match="4 parameters stiffness, damping, sigma_acceleration, sigma_displacement"):
        getattr(posterior, density)(np.ones(shape))


@pytest.mark.parametrize("u", [[0.5, 0.5, 0.5, 1.01], [0.5, np.nan, 0.5, 0.5], [-0.1, 0.5, 0.5, 0.5]])
def test_points_outside_the_unit_cube_are_refused(posterior, u):
    with pytest.raises(ValueError, match=r"probabilities in \[0, 1\]"):
        posterior.prior_transform(np.array(u))
