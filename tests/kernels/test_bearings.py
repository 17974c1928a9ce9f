"""Laws of the isolators against their differential equations, closed forms and differences."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fe_likelihoods.kernels import bearings
from fe_likelihoods.kernels.jit import kernel

BEARING = bearings.Slider(0.055, 0.065, 24.0, 0.13e-3)
LAW = bearings.RubberLaw(250.0, 100.0, 150.0, 1500.0, 7500.0, 450.0, 100.0, 250.0, 0.05, 1.2)
C = math.sqrt(0.8)


@kernel
def bouc_wen(increment, z, y, c):
    return bearings.bouc_wen(increment, z, y, c)


@kernel
def regularised(increment, displacement, velocity, z, weight, slider, c, law):
    return bearings.regularised(increment, displacement, velocity, z, weight, slider, c, law)


@kernel
def rubber(displacement, law):
    return bearings.rubber(displacement, law)


@pytest.mark.parametrize("start", [-0.999, -0.5, 0.0, 0.7, 0.999])
@pytest.mark.parametrize("increment", [-4.0, -0.8, -0.01, 0.02, 0.5, 3.0])
@pytest.mark.parametrize("gamma", [0.9, 0.6, 1.0])
def test_z_follows_its_differential_equation(start, increment, gamma):
    """Y Z' = v [1 - Z^2 (gamma sgn(v Z) + 1 - gamma)], at unit speed."""
    direction = math.copysign(1.0, increment)

    def rate(_, z):
        return direction * (1.0 - z**2 * (gamma * np.sign(direction * z) + 1.0 - gamma))

    exact = solve_ivp(rate, (0.0, abs(increment)), [start], rtol=1e-11, atol=1e-13, max_step=0.02).y[0, -1]
    z, slope = bouc_wen(increment * 0.13e-3, start, 0.13e-3, math.sqrt(2.0 * gamma - 1.0))
    assert z == pytest.approx(exact, abs=2e-8)  # the solver does not stop at the kink at zero
    assert slope * 0.13e-3 == pytest.approx(direction * rate(0.0, z), abs=1e-12)


@pytest.mark.parametrize("displacement", [-0.07, -0.055, -0.01, 0.0, 0.03, 0.0601])
@pytest.mark.parametrize("velocity", [-0.3, -0.004, 0.01, 0.25])
def test_derivatives_are_differences(displacement, velocity):

    def force(du, dv):
        return regularised(1e-5 + du, displacement + du, velocity + dv, 0.4, 70e3, BEARING, C, LAW)[0]

    _, stiffness, viscosity, _ = regularised(1e-5, displacement, velocity, 0.4, 70e3, BEARING, C, LAW)
    e = 1e-9
    assert stiffness == pytest.approx((force(e, 0.0) - force(-e, 0.0)) / (2 * e), rel=1e-4, abs=1.0)
    e = 1e-6
    assert viscosity == pytest.approx((force(0.0, e) - force(0.0, -e)) / (2 * e), rel=1e-4, abs=1e-2)


def test_rubber_is_the_polynomial_and_its_tangent_beyond():
    s = np.linspace(-1.2, 1.2, 41)
    force = [rubber(0.05 * x, LAW)[0] for x in s]
    expected = 250 * s**3 + 100 * s**5 + 150 * s**7 + 1500 * s**9 + 7500 * s**11
    np.testing.assert_allclose(force, expected, rtol=1e-12, atol=1e-9)
    np.testing.assert_allclose([rubber(0.05 * x, LAW)[2] for x in s], 450 + 100 * s**2 + 250 * s**4, rtol=1e-12)
    inner, outer = rubber(0.06, LAW), rubber(0.07, LAW)
    assert outer[0] == pytest.approx(inner[0] + inner[1] * 0.01, rel=1e-12)
    assert outer[1] == pytest.approx(inner[1], rel=1e-12)
    assert outer[2] == pytest.approx(inner[2], rel=1e-12)
    assert outer[3] == 0.0
