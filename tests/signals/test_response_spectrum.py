"""The response spectrum against closed forms: harmonic motion, a pulse, and the limits of short and long periods."""

import math

import numpy as np
import pytest

from fe_likelihoods.signals.records import Record
from fe_likelihoods.signals.response_spectrum import respond


@pytest.fixture
def noise(rng):
    return Record("noise", 0.02, rng.normal(size=500) * np.hanning(500))


def test_undamped_oscillator_under_a_pulse_peaks_in_free_vibration():
    """Ground acceleration a during a time t < T/2: SD = 2 a/omega^2 sin(omega t/2), in the free vibration after it."""
    dt, n, height = 0.001, 100, 3.0
    record = Record("pulse", dt, np.full(n + 1, height))  # the acceleration returns to zero within one step
    periods = np.array([0.5, 1.0, 2.0])
    omega = 2 * math.pi / periods
    expected = 2 * height / omega**2 * np.sin(omega * n * dt / 2)
    spectrum = record.spectrum(periods, 0.0)
    np.testing.assert_allclose(spectrum.displacement, expected, rtol=0.01)
    during = [np.abs(respond(record.acceleration, dt, w, 0.0).displacement).max() for w in omega]
    assert np.all(spectrum.displacement > 1.5 * np.array(during)), "the peak is in the free vibration"


def test_stiff_and_soft_oscillators(noise):
    """A stiff oscillator follows the ground: omega^2 SD is the peak acceleration. A soft one stays at rest."""
    record = Record("without last velocity", noise.dt, noise.acceleration - noise.acceleration.mean())
    spectrum = record.spectrum([0.002, 5000.0], 0.05)
    assert spectrum.pseudo_acceleration[0] == pytest.approx(np.abs(record.acceleration).max(), rel=0.01)
    # Motion of the ground in closed form, for an acceleration of straight lines.
    a, dt = record.acceleration, record.dt
    velocity = np.concatenate([[0.0], np.cumsum(0.5 * dt * (a[:-1] + a[1:]))])
    ground = np.concatenate([[0.0], np.cumsum(dt * velocity[:-1] + dt**2 * (a[:-1] / 3 + a[1:] / 6))])
    assert spectrum.displacement[1] == pytest.approx(np.abs(ground).max(), rel=0.01)


def test_peaks_are_those_of_a_much_finer_record(noise):
    """A record is a straight line between its samples, so that a finer step gives the same peaks."""
    periods = np.geomspace(0.01, 3.0, 12)
    coarse, fine = (record.spectrum(periods, 0.02) for record in (noise, noise.resample(noise.dt / 8)))
    np.testing.assert_allclose(coarse.displacement, fine.displacement, rtol=3.2e-3)
    at_samples = [
        np.abs(respond(noise.acceleration, noise.dt, 2 * math.pi / T, 0.02).displacement).max() for T in periods
    ]
    assert np.max(1.0 - at_samples / fine.displacement) > 0.02, "control: the samples of the record miss peaks"


@pytest.mark.parametrize(
    ("periods", "damping_ratio", "message"),
    [
        ([0.0, 1.0], 0.05, "periods: expected positive"),
        ([], 0.05, "periods: expected positive"),
        ([0.001], 0.05, r"at least 0.002 s, 0.1 steps of the motion"),
        ([1.0], 1.0, r"expected a number in \[0, 1\) \(0.05 is 5 %\), got 1.0"),
    ],
)
def test_refused(noise, periods, damping_ratio, message):
    with pytest.raises(ValueError, match=message):
        noise.spectrum(periods, damping_ratio)
