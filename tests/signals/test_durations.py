"""Durations by the share of the Arias intensity."""

import numpy as np
import pytest

from fe_likelihoods.signals.durations import growing_durations


def test_shares_of_a_constant_acceleration():
    # n samples of the same size: the share s has passed at sample ceil(s n) - 1
    acceleration = np.tile([1.0, -1.0], 500)
    durations = growing_durations(acceleration, 0.01, (0.1, 0.2, 0.45))
    np.testing.assert_allclose(durations, [0.99, 1.99, 4.49, 9.99], rtol=1e-12)
    assert durations == growing_durations(1e200 * acceleration, 0.01, (0.1, 0.2, 0.45))
    assert all(isinstance(seconds, float) for seconds in durations)


def test_durations_that_are_too_close_are_left_out():
    acceleration = np.ones(1000)
    durations = growing_durations(acceleration, 0.01, np.linspace(0.1, 0.95, 18))
    assert durations[-1] == pytest.approx(9.99)
    assert (np.array(durations[1:]) / durations[:-1] >= 1.3).all()
    assert len(durations) > 5
    assert growing_durations(acceleration, 0.01, (0.9, 0.95)) == (durations[-1],)


def test_a_pulse_and_a_record_without_a_first_part():
    pulse = np.zeros(100)
    pulse[40] = 2.0
    assert growing_durations(pulse, 0.5) == (20.0, 49.5)
    pulse[:] = 0.0
    pulse[0] = 1.0
    assert growing_durations(pulse, 0.5) == (49.5,)


def test_channels_count_alike():
    early, late = np.zeros(100), np.zeros(100)
    early[20], late[60] = 1.0, 1000.0
    both = np.stack([early, late, np.zeros(100)])
    assert growing_durations(both, 1.0, (0.4, 0.6)) == (20.0, 60.0, 99.0)


@pytest.mark.parametrize(
    ("acceleration", "settings", "message"),
    [
        (np.zeros(10), {}, "not all zero"),
        (np.ones(1), {}, "two or more samples"),
        (np.full(10, np.nan), {}, "finite"),
        (np.ones((2, 3, 4)), {}, "n_channels, n_steps"),
        (np.ones(10), {"shares": (0.5, 0.4)}, "increase between 0 and 1"),
        (np.ones(10), {"shares": (0.5, 1.0)}, "increase between 0 and 1"),
    ],
)
def test_invalid_arguments(acceleration, settings, message):
    with pytest.raises(ValueError, match=message):
        growing_durations(acceleration, 0.01, **settings)
