"""Durations by the share of the Arias intensity."""

import numpy as np
import pytest

from fe_likelihoods.signals.records import growing_durations

ALTERNATING, PULSE, FIRST = np.tile([1.0, -1.0], 500), np.zeros(100), np.zeros(100)
PULSE[40] = FIRST[0] = 1.0
EARLY, LATE = np.eye(100)[20], 1000.0 * np.eye(100)[60]


@pytest.mark.parametrize(
    ("rows", "dt", "shares", "expected"),
    [
        # n samples of the same size: the share s has passed at sample ceil(s n) - 1
        ([ALTERNATING], 0.01, (0.1, 0.2, 0.45), (0.99, 1.99, 4.49, 9.99)),
        ([1e200 * ALTERNATING], 0.01, (0.1, 0.2, 0.45), (0.99, 1.99, 4.49, 9.99)),
        ([ALTERNATING], 0.01, (0.9, 0.95), (9.99,)),  # too close
        ([PULSE], 0.5, (0.35, 0.75, 0.95), (20.0, 49.5)),
        ([FIRST], 0.5, (0.35, 0.75, 0.95), (49.5,)),
        ([EARLY, LATE, np.zeros(100)], 1.0, (0.4, 0.6), (20.0, 60.0, 99.0)),  # channels count alike
    ],
)
def test_shares_of_accelerations(rows, dt, shares, expected):
    assert growing_durations(np.array(rows), dt, shares) == pytest.approx(expected, rel=1e-12)
