"""Fixtures of the tests of figures."""

import matplotlib
import pytest

from fe_likelihoods.signals.records import Record


@pytest.fixture(autouse=True)
def figures_without_a_window():
    matplotlib.use("Agg")


@pytest.fixture
def record(rng):
    return Record("noise", 0.02, rng.normal(size=300))
