"""Samples of the synthetic twins."""

import numpy as np
import pytest
from scipy import stats

from tests.prediction import twins


def test_hyper_samples_of_the_synthetic_twins_are_those_of_the_posterior():
    """Many events of known spread determine median and spread; without events, they are those of the priors."""
    rng = np.random.default_rng(1)
    data = 0.3 + np.hypot(0.2, twins.ERROR) * rng.standard_normal(2000)
    median, spread = twins.hyper_samples(data, rng, 2000).T
    assert np.log(median).mean() == pytest.approx(data.mean(), abs=0.01)
    assert spread.mean() == pytest.approx(np.sqrt(data.var() - twins.ERROR**2), abs=0.01)
    median, spread = twins.hyper_samples(data[:0], rng, 2000).T
    assert stats.kstest(np.log(median), stats.norm(0.0, 0.5).cdf).pvalue > 1e-3
    assert stats.kstest(spread, stats.halfnorm(scale=0.3).cdf).pvalue > 1e-3
