"""Residuals of known origin: their correlation, effective number of samples and checks."""

import math

import numpy as np
import pytest
from scipy import signal

from fe_likelihoods.noise.residuals import (
    autocorrelation,
    effective_samples,
    innovations,
    residual_checks,
)

N = 4000


def autoregressive(rng, rho, n=N, n_channels=1):
    z = rng.standard_normal((n_channels, n))
    z[:, 1:] *= math.sqrt(1.0 - rho**2)
    return signal.lfilter([1.0], [1.0, -rho], z, axis=1)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9, -0.9])
def test_effective_samples_of_autoregressive_errors(rng, rho):
    """n (1 - rho^2) / (1 + rho^2), for both signs of rho; the mean of 200 series is accurate to a few percent."""
    found = effective_samples(autoregressive(rng, rho, n_channels=200)).mean()
    assert found == pytest.approx(N * (1.0 - rho**2) / (1.0 + rho**2), rel=0.06)


def test_innovations_of_autoregressive_errors_are_white(rng):
    errors = 3.0 * autoregressive(rng, 0.9)
    new = innovations(errors, [0.9])
    assert new.shape == (1, N - 1)
    assert new.std() == pytest.approx(3.0, rel=4.0 / math.sqrt(2 * N))
    assert residual_checks(errors).white[0] < 1e-10 < 1e-3 < residual_checks(new).white[0]
    with pytest.raises(ValueError, match="correlation between -1 and 1 for each of 1 channels"):
        innovations(errors, [1.0])


def test_checks_detect_correlation_and_heavy_tails(rng):
    """Under the hypothesis the probabilities are uniform: of 400, the share below 0.1 is within its binomial error."""
    white = residual_checks(rng.standard_normal((400, 500)))
    correlated = residual_checks(autoregressive(rng, 0.9, n=2000, n_channels=400))
    error = math.sqrt(0.1 * 0.9 / 400)
    assert abs(np.mean(white.white < 0.1) - 0.1) < 4.0 * error
    assert abs(np.mean(white.normal < 0.1) - 0.1) < 4.0 * error
    assert np.mean(correlated.white < 1e-6) == 1.0
    assert np.mean(correlated.normal < 0.1) < 0.25  # correlated errors are normal
    heavy = residual_checks(rng.standard_t(3, size=(50, 1000)))
    assert np.mean(heavy.normal < 0.01) > 0.95
    np.testing.assert_allclose(correlated.lag_one, 0.9, atol=0.06)


@pytest.mark.parametrize("function", [autocorrelation, effective_samples, residual_checks])
def test_invalid_residuals_are_refused(function):
    for residuals, message in (
        (np.ones(5), "shape"),
        (np.ones((1, 1)), "two samples"),
        (np.full((1, 5), np.nan), "finite"),
        (np.array([[1.0, 2.0], [0.0, 0.0]]), r"channels \[1\] are all zero"),
    ):
        with pytest.raises(ValueError, match=message):
            function(residuals)
