"""Bilinear forms of statistics, against the statistics themselves."""

import numpy as np
import pytest

from fe_likelihoods.emulation.quadratic import bilinear_form, check_quadratic
from fe_likelihoods.noise.residuals import lag_one_sums
from fe_likelihoods.noise.statistics import sums_of_squares


@pytest.mark.parametrize("statistic", [sums_of_squares, lag_one_sums])
def test_statistics_of_combinations_follow_from_the_bilinear_form(statistic):
    rng = np.random.default_rng(1)
    histories = rng.standard_normal((4, 2, 50)) * np.array([1.0, 1e-3, 1e4, 1.0])[:, None, None]
    factors = np.array([0.3, -200.0, 1e-4, 1.5])
    form = bilinear_form(statistic, histories)
    direct = statistic(np.einsum("k,kct->ct", factors, histories))
    np.testing.assert_allclose(np.einsum("k,l,kla->a", factors, factors, form), direct, rtol=1e-9)
    np.testing.assert_allclose(bilinear_form(statistic, histories, histories[:2]), form[:, :2], rtol=1e-9, atol=1e-9)
    check_quadratic(statistic, histories[0])


def test_a_statistic_that_is_not_quadratic_is_refused():
    def largest(residuals):
        return np.abs(residuals).max(axis=1)

    with pytest.raises(ValueError, match="not quadratic"):
        check_quadratic(largest, np.random.default_rng(1).standard_normal((2, 50)))
