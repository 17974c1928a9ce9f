"""The isolated bridge against an independent implementation for `solve_ivp`, which shares no code with the library.

The record is filtered white noise.
"""

import numpy as np
import pytest
from scipy.signal import cont2discrete, lfilter

from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.signals.records import Record
from tests.scipy_bridge import CHANNELS, Definition, peak_errors, solve

DT = 0.005
PARAMETERS = {"nominal": np.ones(10), "other": np.array([0.76, 0.6, 0.93, 1.13, 1.34, 1.03, 0.83, 0.76, 1.22, 1.49])}
KINDS = ("Ub", "Fb", "drift", "shear", "acc_p", "Ud", "acc_d")


def noise(seed, peak):
    """Return 3 s of noise through a Kanai-Tajimi filter (5 Hz, damping ratio 0.3), growing during half a second."""
    time = np.arange(601) * DT
    frequency, damping = 2.0 * np.pi * 5.0, 0.3
    soil = ([2.0 * damping * frequency, frequency**2], [1.0, 2.0 * damping * frequency, frequency**2])
    numerator, denominator, _ = cont2discrete(soil, DT, "bilinear")
    shaken = lfilter(numerator.ravel(), denominator, np.random.default_rng(seed).standard_normal(time.size))
    shaken *= np.minimum(1.0, time / 0.5)
    return peak * shaken / np.abs(shaken).max()


GROUND, VERTICAL = noise(7, 5.5), noise(8, 3.0)


def ours(theta, **options):
    return IsolatedBridge(**{"record": Record("noise", DT, GROUND), "outputs": CHANNELS} | options).simulate(theta)


def by_kind(response, reference):
    """Return the largest peak error among the channels of each kind."""
    errors = dict(zip(CHANNELS, peak_errors(response, reference).tolist(), strict=True))
    return {kind: max(value for channel, value in errors.items() if channel.startswith(kind)) for kind in KINDS}


def too_large(errors, **bounds):
    assert set(bounds) == set(KINDS)
    return {kind: f"{value:.1e} > {bounds[kind]:.1e}" for kind, value in errors.items() if not value < bounds[kind]}


@pytest.fixture(scope="module")
def smooth():
    return {name: solve(Definition().at(theta), GROUND, DT) for name, theta in PARAMETERS.items()}


# --- the library compared with it ---

SECOND_ORDER = (3.0, 6.0)  # factor by which halving the step reduces an error
# limits for the default step of 0.25 ms, about three times the measured errors
SMOOTH = dict(Ub=4e-6, Fb=2e-4, drift=1.5e-5, shear=5e-5, acc_p=6e-4, Ud=2e-6, acc_d=1.5e-4)


@pytest.mark.parametrize("name", PARAMETERS)
def test_smooth_law_against_solve_ivp(smooth, name):
    theta = PARAMETERS[name]
    errors = by_kind(ours(theta), smooth[name])
    assert not too_large(errors, **SMOOTH)
    coarse = peak_errors(ours(theta, step=5e-4), smooth[name]).mean()
    assert SECOND_ORDER[0] < coarse / peak_errors(ours(theta), smooth[name]).mean() < SECOND_ORDER[1]


def test_vertical_motion_against_solve_ivp():
    reference = solve(Definition(), GROUND, DT, vertical=VERTICAL)
    response = ours(PARAMETERS["nominal"], vertical=Record("up", DT, VERTICAL))
    assert not too_large(by_kind(response, reference), **SMOOTH)


def test_uplift_between_samples_against_solve_ivp():
    """The load on a bearing is zero exactly while the table falls faster than gravity, also between two samples."""
    falling = -1.3 * 9.81 * VERTICAL[:301] / VERTICAL[:301].max()
    beyond = falling < -9.81
    assert 3 <= beyond.sum() and np.sum(np.diff(beyond)) >= 4  # it begins and ends between samples, several times
    motion = Record("up", DT, falling)
    reference = solve(Definition(), GROUND[:301], DT, vertical=falling, method="DOP853", tolerance=1e-8)
    response = ours(PARAMETERS["nominal"], record=Record("short", DT, GROUND[:301]), vertical=motion)
    assert not too_large(by_kind(response, reference), **{kind: 2.0 * bound for kind, bound in SMOOTH.items()})


@pytest.mark.parametrize("place", range(10))
def test_a_wrong_parameter_is_detected(smooth, place):
    """Control: an error of one per cent in any of the ten parameters exceeds the bounds."""
    errors = by_kind(ours(PARAMETERS["nominal"] + 0.01 * np.eye(10)[place]), smooth["nominal"])
    assert too_large(errors, **SMOOTH)
