"""Tails of importance weights: known shapes, and the same numbers as arviz."""

import numpy as np
import pytest
from scipy import stats

from samplers.estimates.pareto import pareto_shape


def test_pareto_shape_of_known_tails(rng):
    assert pareto_shape(np.log(rng.pareto(1.0 / 0.8, 20_000))) == pytest.approx(0.8, abs=0.15)
    assert pareto_shape(np.log(rng.exponential(size=20_000))) == pytest.approx(0.0, abs=0.15)
    assert pareto_shape(np.zeros(24)) == np.inf  # too few weights


def test_shape_is_that_of_arviz(rng):
    psislw = getattr(pytest.importorskip("arviz"), "psislw", None)
    if psislw is None:
        pytest.skip("this arviz has no psislw")
    for power in (0.5, 0.7, 0.9):  # below, the tail is less than 5 % of the sum
        log_weights = power * rng.exponential(size=2000)  # weights with a Pareto tail of this shape
        assert pareto_shape(log_weights) == pytest.approx(float(psislw(log_weights)[1]), abs=0.02)


def test_shape_of_normal_weights(rng):
    """Draws of N(0, 1) weighted to N(0, 1.3^2): a tail of 1 - 1 / 1.69 = 0.41."""
    x = rng.standard_normal((200, 1000))
    log_weights = stats.norm(0.0, 1.3).logpdf(x) - stats.norm.logpdf(x)
    assert np.median([pareto_shape(each) for each in log_weights]) == pytest.approx(0.41, abs=0.1)
