"""The stated error of an evidence from weights covers, also where the largest weights are rarely drawn."""

import numpy as np
import pytest

from samplers.estimates.importance import evidence_from_weights


def covered(log_weights, true):
    """Share of the rows (n, m) whose log-evidence is within two stated errors, and within two plain errors."""
    found = [evidence_from_weights(row, len(row)) for row in log_weights]
    apart = np.abs(np.array([each.log_evidence for each in found]) - true)
    plain = np.sqrt(1.0 / np.array([each.effective_sample_size for each in found]) - 1.0 / log_weights.shape[1])
    return np.mean(apart < 2.0 * np.array([each.error for each in found])), np.mean(apart < 2.0 * plain)


@pytest.mark.parametrize("sd", [1.0, 1.5, 2.5])
def test_log_normal_weights(sd, rng):
    stated, plain = covered(sd * rng.standard_normal((1000, 250)), 0.5 * sd**2)
    assert stated > 0.9
    assert plain < stated and (sd < 2.0 or plain < 0.8)  # negative control


def test_even_weights_keep_their_error(rng):
    """Student t draws of a normal target: far draws have tiny weights, which do not count."""
    z = rng.standard_t(6.0, size=(1000, 250))
    squared = z**2
    log_weights = -0.5 * squared + 3.5 * np.log1p(squared / 6.0)
    true = np.log(np.mean(np.exp(-0.5 * (t := rng.standard_t(6.0, size=10**6)) ** 2 + 3.5 * np.log1p(t**2 / 6.0))))
    stated, plain = covered(log_weights, true)
    assert stated == pytest.approx(plain, abs=0.01) and 0.93 < stated < 0.97


def test_draws_outside_the_support_and_impossible_weights():
    assert evidence_from_weights(np.full(10, -np.inf), 20).error == np.inf
    half = evidence_from_weights(np.zeros(125), 250)
    assert half.log_evidence == pytest.approx(np.log(0.5)) and half.error == pytest.approx(np.sqrt(1 / 125 - 1 / 250))
    few = evidence_from_weights(np.zeros(25), 250)  # fewer inside than the quantiles need
    assert few.error == pytest.approx(np.sqrt(1 / 25 - 1 / 250))
