"""Expected scatter between events: sensitivities, and residuals at another phase, in closed form."""

import numpy as np
import pytest

from fe_likelihoods.population.event_scatter import log_variance, remainder_variance, spread_rows

PHASES = 2.0 * np.pi * np.arange(16) / 16
TURNS = 2.0 * np.pi * np.arange(400) / 100  # four periods
NAMES = ["frequency_1", "frequency_2", "share", "damping"]


def numbers(response):
    """Amplitude by the mean square, and the energy."""
    square = np.mean(np.square(response))
    return np.array([np.sqrt(2.0 * square), square])


def test_parameters_of_one_kind_change_together():
    rows = spread_rows([1.0, 2.0, 0.5, 0.1], NAMES, {"frequency": 0.1, "stiffness": 0.2, "damping": 0.5})
    up, down = np.exp(0.1), np.exp(-0.1)
    np.testing.assert_allclose(rows[0], [1.0, 2.0, 0.5, 0.1])
    np.testing.assert_allclose(rows[1:3], [[up, 2.0 * up, 0.5, 0.1], [down, 2.0 * down, 0.5, 0.1]])
    np.testing.assert_allclose(rows[3:, 3], 0.1 * np.exp([0.5, -0.5]))
    assert len(rows) == 5 and len(spread_rows([1.0], ["share"], {"frequency": 0.1})) == 1


def test_the_variance_of_a_power_law_is_exact_and_a_failed_simulation_is_replaced_by_its_opposite():
    rows = spread_rows([1.0, 2.0, 0.5, 0.1], NAMES, {"frequency": 0.1, "damping": 0.5})
    values = rows[:, 0] ** 2 * rows[:, 3] ** -0.3
    expected = (2.0 * 0.1) ** 2 + (0.3 * 0.5) ** 2
    assert log_variance(values) == pytest.approx(expected)
    values[2] = np.nan  # failed
    assert log_variance(values) == pytest.approx(expected)
    values[4] = -1.0  # no logarithm
    assert log_variance(values) == pytest.approx(expected)
    values[1] = np.nan  # nothing is known of the frequency
    assert log_variance(values) == pytest.approx((0.3 * 0.5) ** 2)
    assert log_variance(values[:1]) == 0.0


@pytest.mark.parametrize("share", (0.1, 0.5))
def test_residuals_meet_the_response_at_every_phase(share):
    """A harmonic and a residual of its frequency: the law of cosines."""
    responses = np.sin(TURNS)[None, None]
    found = remainder_variance(numbers, responses, share * np.cos(TURNS)[None], 0.05)
    of_square = np.log(1.0 + share**2 + 2.0 * share * np.cos(PHASES)).var()
    np.testing.assert_allclose(found, [0.25 * of_square + 0.05**2, of_square + 0.1**2], rtol=1e-6)
    np.testing.assert_allclose(remainder_variance(numbers, responses, None, 0.05), [0.05**2, 0.1**2])


def test_what_the_parameters_explain_is_no_remainder():
    """A residual from a slightly wrong frequency is left out, another one is not, also where samples are missing."""
    responses = np.array([np.sin(factor * TURNS)[None] for factor in (1.0, 1.01, 0.99)])
    of_frequency = 0.2 * (responses[1] - responses[2])
    other = 0.1 * np.cos(3.0 * TURNS)[None]
    both = remainder_variance(numbers, responses, of_frequency + other, 0.0)
    np.testing.assert_allclose(both, remainder_variance(numbers, responses[:1], other, 0.0), rtol=0.05, atol=1e-6)
    assert (remainder_variance(numbers, responses[:1], of_frequency, 0.0) > 1e-4).all()  # control
    gaps = of_frequency.copy()
    gaps[:, :50] = np.nan
    assert (remainder_variance(numbers, responses, gaps, 0.0) < 1e-12).all()
