"""Rounds of a guide go on while its known density grows."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from samplers.estimates.importance import KnownDensity
from samplers.judgement.rounds import grown


def normals(shares, centres):
    """Mixture of normal distributions of one parameter."""

    def log_density(x):
        return np.log(
            sum(share * stats.norm.pdf(x[:, 0], centre) for share, centre in zip(shares, centres, strict=True))
        )

    return KnownDensity(log_density, np.zeros((1, 1)), np.ones(1), 0.0)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2])
def test_the_share_that_a_density_did_not_have_before(share):
    """Draws of the part that both have tell the share of the part that only the latest one has."""
    draws = np.random.default_rng(1).standard_normal((100, 1))
    pooled = SimpleNamespace(coords=draws, log_weights=np.where(draws[:, 0] > 2.0, -np.inf, 0.0))
    before, latest = normals([1.0], [0.0]), normals([1.0 - share, share], [0.0, 30.0])
    assert grown(pooled, before, latest) == pytest.approx(share, abs=1e-9)
    assert grown(pooled, latest, before) == pytest.approx(0.0, abs=1e-9)  # a density that has shrunk
    assert grown(pooled, None, latest) == grown(pooled, before, None) == 0.0
