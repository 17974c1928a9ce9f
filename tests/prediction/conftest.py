"""Fixtures of the tests of predictions."""

import numpy as np
import pytest

from fe_likelihoods.signals.records import Record


@pytest.fixture
def record(rng):
    samples = rng.normal(size=50)
    return Record("motion", 0.02, samples / np.abs(samples).max())
