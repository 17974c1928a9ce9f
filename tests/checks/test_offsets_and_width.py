"""Offsets are named, correlated errors widen standard deviations, and a fault before a run is one after it."""

import numpy as np
import pytest

from fe_likelihoods import Channel, Measurements
from fe_likelihoods.checks.finding import judge
from fe_likelihoods.checks.model import check_residuals, check_responses, describe_residuals
from fe_likelihoods.likelihood.fits import Fit
from fe_likelihoods.noise.residuals import residual_checks

TOP, TIME = (Channel("top", "displacement", "mm"),), 0.02 * np.arange(400)
OSCILLATION = 0.05 * np.exp(-0.1 * TIME) * np.cos(6.5 * TIME)


def compared(values, responses, fitted=True):
    measured = Measurements(TOP, 0.02, np.atleast_2d(values))
    responses = np.array(responses)[:, None]
    return Fit("", measured, responses[1:], responses[0]) if fitted else Fit("", measured, responses)


def kinds(found):
    return {each.kind: each.severity for each in found}


@pytest.mark.parametrize(
    "spoiled", [0.005, 0.02 * TIME / 8.0, 0.01 * (TIME / 8.0) ** 2], ids=["offset", "drift", "parabola"]
)
def test_an_offset_or_a_drift_of_a_displacement_is_named(spoiled, rng):
    noise = 0.002 * rng.standard_normal(400)
    (found,) = check_responses([compared(OSCILLATION + noise + spoiled, [OSCILLATION])])
    assert found.kind == "A measurement may have an offset or a drift" and found.numbers["top"] > 0.5


def test_white_errors_and_errors_of_a_model_have_no_offset(rng):
    slower = 0.3 * 0.05 * np.exp(-0.1 * TIME) * np.cos(6.0 * TIME)
    for errors in (
        0.002 * rng.standard_normal(400),
        slower,
        0.01 * np.convolve(rng.standard_normal(430), np.ones(31) / 5, "valid"),
    ):
        assert check_responses([compared(OSCILLATION + errors, [OSCILLATION])]) == []


def test_a_fault_that_draws_show_before_a_run_is_named_after_it():
    """A fit makes up for half of the gain: alone it is better by no factor that is named."""
    draws = [OSCILLATION, 0.9 * OSCILLATION, np.roll(OSCILLATION, 3)]
    measured = 1000.0 * OSCILLATION
    for times, severity in ((1, "care"), (20, "wrong")):  # few draws alone are no proof
        assert kinds(check_responses([compared(measured, times * draws, False)]))["A unit may be wrong"] == severity
        assert kinds(check_responses([compared(measured, [0.99 * measured, *times * draws])])) == {
            "A unit may be wrong": severity
        }
    assert check_responses([compared(OSCILLATION, [0.99 * OSCILLATION, *draws])]) == []


def fits_of(errors, assumed=None):
    counts = None if assumed is None else np.array([assumed])
    measured = Measurements(TOP, 0.02, errors[None])
    return [
        Fit("", measured, np.empty((0, *errors[None].shape)), 0.0 * errors[None], white=errors[None], assumed=counts)
    ]


def test_correlated_errors_are_a_note_with_the_factor_in_the_first_sentence(rng):
    white, slow = rng.standard_normal(4000), np.zeros(4000)
    for i in range(1, 4000):
        slow[i] = 0.9 * slow[i - 1] + white[i]
    assert check_residuals(fits_of(white)) == []
    (found,) = check_residuals(fits_of(slow))
    factor = np.sqrt((1 + 0.9**2) / (1 - 0.9**2))  # n_eff of an AR(1) process
    assert found.severity == "note" and found.numbers["factor"] == pytest.approx(factor, rel=0.15)
    judgement = judge([found])
    assert judgement.status == "use" and judgement.width_factor == found.numbers["factor"]
    assert (
        str(judgement)
        == f"Use: multiply standard deviations by {found.numbers['factor']:.2g}, because errors are correlated."
    )
    assert check_residuals(fits_of(slow, found.numbers["factor"] ** -2 * 4000)) == []
    assert describe_residuals(residual_checks(white[None]))[0].startswith("White: ")
    assert describe_residuals(residual_checks(slow[None]))[0].startswith("Correlated (0.9")
    assert describe_residuals(residual_checks(np.array([[1.0, -2.0]])))[0].startswith("Not checked: 2 samples")
