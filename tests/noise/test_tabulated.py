"""The tabulated likelihood of white noise with integrated levels, against quadrature."""

import numpy as np
import pytest

from fe_likelihoods import Channel, GaussianNoise, HalfNormal, LogNormal, Uniform
from fe_likelihoods.noise.marginal import MarginalNoise
from fe_likelihoods.noise.tabulated import tabulated


@pytest.mark.parametrize("n", [10, 300, 10_000, 3_000_000])
def test_it_is_the_quadrature(n):
    """Also at a bound of the prior, in any order of requests, and where a table would be too long."""
    channels = tuple(Channel(name, "displacement", "m") for name in "abcd")
    priors = [HalfNormal(0.5), LogNormal(0.1, 1.0), Uniform(0.05, 0.2), HalfNormal(0.5)]
    names = [f"sigma_{channel.name}" for channel in channels]
    noise = MarginalNoise(GaussianNoise(channels), dict(zip(names, priors, strict=True)))
    function, random = tabulated(noise), np.random.default_rng(n)
    for centre, width in ((0.1, 3.0 / np.sqrt(n)), (0.2, 3.0 / np.sqrt(n)), (0.1, 1.0), (1e-6, 0.1), (1.0, 100.0)):
        squares = n * np.square(centre * np.exp(width * random.uniform(-1.0, 1.0, (50, 4))))
        expected = noise.log_likelihood(squares, n)
        found = function(squares, n)
        assert np.abs(found - expected).max() < 1e-6 + 1e-10 * np.abs(expected).max()
    odd = np.array([[0.0, 1.0, 1.0, 1.0], [np.nan, 1.0, 1.0, 1.0], [1e300, 1.0, 1.0, 1.0], [np.inf, 1.0, 1.0, 1.0]])
    np.testing.assert_allclose(function(odd, n), noise.log_likelihood(odd, n), rtol=1e-10)
