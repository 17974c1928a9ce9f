"""Errors of predicted histories, and the comparison of time steps that comes before."""

import numpy as np
import pytest

from fe_likelihoods.signals.channels import relative_errors
from fe_likelihoods.signals.sampling import same_step


def test_relative_errors_are_their_definition(rng):
    measured, predicted = rng.normal(size=(2, 3, 50))
    expected = [np.linalg.norm(p - m) / np.linalg.norm(m) for p, m in zip(predicted, measured, strict=True)]
    found = relative_errors(predicted - measured, measured)
    np.testing.assert_allclose(found, expected, rtol=1e-13)
    assert relative_errors(predicted[0] - measured[0], measured[0]) == found[0]
    assert relative_errors(0.1 * measured[0], measured[0]) == pytest.approx(0.1)
    assert np.isnan(relative_errors(measured, 0.0 * measured)).all()


def test_steps_are_compared_within_round_off():
    assert same_step(0.1, 0.1 * (1 + 1e-12)) and not same_step(0.1, 0.1 * (1 + 1e-6))
