"""Bridge sampling against known ratios of normalising constants."""

import numpy as np
import pytest
from scipy import stats

from samplers.estimates.bridge import log_ratio


def test_bridge_between_two_normal_densities_of_different_numbers_of_draws(rng):
    """Unnormalised densities whose constants differ by exp(3) * 2."""
    ratios, errors = [], []
    for _ in range(50):
        draws = 2.0 * rng.standard_normal(500), rng.standard_normal(2000)
        of_upper, of_lower = (3.0 - 0.125 * x**2 + 0.5 * x**2 for x in draws)
        ratio, error = log_ratio(of_upper, of_lower)
        ratios.append(ratio)
        errors.append(error)
    assert abs(np.mean(ratios) - 3.0 - np.log(2.0)) < 4.0 * np.std(ratios, ddof=1) / np.sqrt(50)
    assert np.mean(errors) == pytest.approx(np.std(ratios, ddof=1), rel=0.4)


def test_bridge_between_a_density_and_its_part(rng):
    """A standard normal density and its part above one: the ratio is the probability of that part."""
    upper = np.zeros(2000)
    ratios, errors = [], []
    for _ in range(50):
        lower = np.where(rng.standard_normal(2000) > 1.0, 0.0, -np.inf)
        ratio, error = log_ratio(upper, lower)
        ratios.append(ratio)
        errors.append(error)
    exact = stats.norm.logsf(1.0)
    assert abs(np.mean(ratios) - exact) < 4.0 * np.std(ratios, ddof=1) / np.sqrt(50)
    assert np.mean(errors) == pytest.approx(np.std(ratios, ddof=1), rel=0.4)
    assert np.isnan(log_ratio(upper, np.full(10, -np.inf))[0])
    assert np.isnan(log_ratio(np.full(10, -np.inf), np.zeros(10))[0])  # the upper density is not where its draws are
