"""Other methods of the posterior for clients: starting points, finite densities, and clear errors."""

import numpy as np
import pytest

from fe_likelihoods import Uniform

from .problem import CRITICAL, PRIOR, make_posterior


@pytest.fixture
def posterior():
    return make_posterior()


def test_starts_are_draws_of_the_prior_where_simulations_succeed(posterior):
    starts = posterior.sample_start(2000, 1)
    assert starts.shape == (2000, 4) and np.isfinite(posterior(starts)).all()
    # below critical damping the starts follow the prior: compare with its mean there, from quantiles
    damping = posterior.prior.distributions["damping"]
    quantiles = damping.ppf(np.linspace(0.0, 1.0, 100_001))
    inside = quantiles[quantiles < CRITICAL]
    assert abs(starts[:, 1].mean() - inside.mean()) < 4.0 * inside.std() / np.sqrt(2000)
    np.testing.assert_array_equal(starts[:5], posterior.sample_start(2000, np.random.default_rng(1))[:5])
    np.random.seed(3)  # noqa: NPY002 - None means the global stream
    first = posterior.sample_start(3)
    assert not np.array_equal(first, posterior.sample_start(3))


def test_starts_where_everything_fails_are_refused():
    hopeless = make_posterior(PRIOR | {"damping": Uniform(2.5, 3.0)})
    with pytest.raises(ValueError, match="zero at nearly all draws of the prior"):
        hopeless.sample_start(40)
    assert hopeless.report()["failure_count"] >= 4000


def test_finite_densities_differ_only_where_the_posterior_is_zero(posterior):
    points = np.array([posterior.sample_start(1, 1)[0], [1.0, 3.0, 1.0, 0.01], [9.0, 1.0, 1.0, 0.01], [np.nan] * 4])
    assert np.isfinite(posterior(points)).tolist() == [True, False, False, False]
    finite, negative = posterior.finite_log_likelihood(points), posterior.negative_log_prob(points)
    assert finite[0] == posterior.log_likelihood(points[0]) and np.all(finite[1:] == -1e100)
    assert negative[0] == -posterior(points[0]) and np.all(negative[1:] == 1e100)
    for row, value in zip(points, finite, strict=True):
        assert isinstance(posterior.finite_log_likelihood(row), float)
        assert posterior.finite_log_likelihood(row) == value and isinstance(posterior.negative_log_prob(row), float)


@pytest.mark.parametrize(
    "density", ["log_prob", "log_prior", "log_likelihood", "finite_log_likelihood", "negative_log_prob"]
)
@pytest.mark.parametrize("shape", [(), (3,), (2, 5), (1, 2, 4)])
def test_errors_of_wrong_shapes_name_the_parameters(posterior, density, shape):
    with pytest.raises(ValueError, match="4 parameters stiffness, damping, sigma_acceleration, sigma_displacement"):
        getattr(posterior, density)(np.ones(shape))


@pytest.mark.parametrize("u", [[0.5, 0.5, 0.5, 1.01], [0.5, np.nan, 0.5, 0.5], [-0.1, 0.5, 0.5, 0.5]])
def test_points_outside_the_unit_cube_are_refused(posterior, u):
    with pytest.raises(ValueError, match=r"probabilities in \[0, 1\]"):
        posterior.prior_transform(np.array(u))
