"""Faults of data are found among responses of other parameters, and good fits are left alone."""

import math

import numpy as np
import pytest

from fe_likelihoods import Channel, LinearOscillator, Measurements
from fe_likelihoods.checks.faults import describe_unit, find_faults
from fe_likelihoods.problems import table_motion

MOTION = table_motion().trim(0.0, 10.0).resample(0.02)
MODEL = LinearOscillator(MOTION, 0.8)
RNG = np.random.default_rng(5)
RESPONSES = np.stack([MODEL.simulate(theta) for theta in RNG.uniform(0.4, 1.8, (40, 2))])
TRUE = MODEL.simulate([1.1, 0.9])
LATE = 5  # steps of 0.02 s


def measured(values, share=0.1):
    """Measurements with errors that are correlated from sample to sample and have a share of the level."""
    noise = np.apply_along_axis(
        np.convolve, 1, np.random.default_rng(3).standard_normal(TRUE.shape), np.ones(5), "same"
    )
    level = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
    return Measurements(MODEL.channels, MODEL.dt, values + share * level * noise / noise.std())


def later(values, steps):
    return np.concatenate([np.zeros((len(values), steps)), values[:, :-steps]], axis=1)


@pytest.mark.parametrize("share", [0.02, 0.15])
def test_a_good_fit_has_no_fault(share):
    assert find_faults(measured(TRUE, share), RESPONSES) == ()


@pytest.mark.parametrize("factor", [1000.0, 1e-3, 9.80665, 1.0 / 9.80665])
def test_units_of_all_and_of_one_channel_are_named(factor):
    (fault,) = find_faults(measured(factor * TRUE), RESPONSES)
    assert fault.kind == "factor" and fault.names == ("acceleration", "displacement")
    assert fault.value == pytest.approx(factor, rel=0.1) and fault.after < 0.3
    (fault,) = find_faults(measured(TRUE * [[factor], [1.0]]), RESPONSES)
    assert (fault.kind, fault.names) == ("factor", ("acceleration",))
    assert describe_unit(fault.value, "acceleration")


@pytest.mark.parametrize(
    ("factor", "dimension", "unit", "expected"),
    [
        (947.0, "displacement", "mm", "mm read as m or um read as mm"),
        (1.0 / 1020.0, "displacement", "", "m read as mm"),
        (9.95, "acceleration", "g", "m/s2 read as g"),
        (980.0, "acceleration", "g", "mm/s2 read as m/s2 or cm/s2 read as g or mg read as g"),
        (9.6, "displacement", "mm", "m/s2 and g of the base motion or mm read as cm"),
        (0.102, "force", "kN", "m/s2 and g of the base motion"),
        (0.396, "displacement", "in", "in read as cm"),
        (1000.0, "force", "kN", "N read as kN"),
        (2.08, "acceleration", "g", ""),
        (2.0, "force", "kN", ""),
    ],
)
def test_a_factor_is_named_after_units_of_the_channel(factor, dimension, unit, expected):
    assert describe_unit(factor, dimension, unit) == expected


def test_signs_lags_and_exchanged_channels_are_named():
    (fault,) = find_faults(measured(-TRUE), RESPONSES)
    assert fault.kind == "sign" and math.isnan(fault.value)
    (fault,) = find_faults(measured(TRUE * [[1.0], [-1.0]]), RESPONSES)
    assert (fault.kind, fault.names) == ("sign", ("displacement",))
    (fault,) = find_faults(measured(later(TRUE, LATE)), RESPONSES)
    assert fault.kind == "lag" and len(fault.names) == 2 and fault.value == pytest.approx(0.1, abs=0.021)
    early = np.concatenate([TRUE[:, LATE:], np.full((2, LATE), np.nan)], axis=1)
    (fault,) = find_faults(measured(np.nan_to_num(early)), RESPONSES)
    assert fault.kind == "lag" and fault.value == pytest.approx(-0.1, abs=0.021)
    two = [MODEL.channels[0], MODEL.channels[0].__class__("other", MODEL.channels[0].quantity, "g")]
    pairs = np.stack([RESPONSES[:, 0], np.roll(RESPONSES[:, 0], 60, axis=-1)], axis=1)
    values = np.stack([np.roll(TRUE[0], 60), TRUE[0]])
    (fault,) = find_faults(Measurements(two, MODEL.dt, values), pairs)
    assert fault.kind == "swap" and fault.names == ("acceleration", "other")
    exchanged = RESPONSES[:, ::-1] * [[100.0], [0.01]]  # m/s², and cm in the output of a program
    (fault,) = find_faults(measured(TRUE), exchanged)
    assert fault.kind == "swap" and fault.after < 0.2


def test_channels_may_have_other_spellings_of_their_units():
    channels = [Channel("a", "acceleration", "m/s²"), Channel("d", "displacement", "µm")]
    assert find_faults(Measurements(channels, MODEL.dt, TRUE), RESPONSES) == ()


def test_two_faults_are_found_one_after_the_other():
    faults = find_faults(measured(9.80665 * TRUE * [[1.0], [-1.0]]), RESPONSES)
    assert {fault.kind for fault in faults} == {"factor", "sign"}


def test_missing_samples_and_failed_responses_are_left_out():
    values = -TRUE.copy()
    values[0, 100:160] = np.nan
    responses = RESPONSES.copy()
    responses[3] = np.nan
    gaps = Measurements(MODEL.channels, MODEL.dt, values)
    assert [fault.kind for fault in find_faults(gaps, responses)] == ["sign"]
    assert find_faults(gaps, responses[3:4]) == ()
