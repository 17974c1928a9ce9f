"""Force laws of the devices between a deck and its piers: sliding bearing and rubber restoring-force device.

Friction. The slider resists the motion with mu(v) W Z, where the friction coefficient depends on the velocity v::

    mu(v) = f_min + df (1 - exp(-a |v|))

and Z in [-1, 1] replaces the sign of v. There are two laws for Z.

* Regularised (Bouc-Wen with exponent 2 and A = beta + gamma = 1): Z follows the displacement U over the yield
  displacement Y, ``Y Z' = v [1 - Z^2 (gamma sgn(v Z) + beta)]``. This equation is rate-independent, so that a monotone
  increment of U integrates exactly: tanh while Z grows, tan while it returns.
* Exact (Coulomb): Z is the sign of v, or any value in [-1, 1] at rest.

Rubber. With s = U / s_u, an odd polynomial F(s) is the skeleton, and an even polynomial D(s) is half the distance
between the loading and unloading branches::

    F_r = F(s) + D(s) Z,    F = sum A_n s^n (n = 1, 3 ... 11),    D = sum B_m s^m (m = 0, 2, 4)

Beyond ``|s|`` = s_max the skeleton continues along its tangent and D keeps its value.
``docs/theory/isolated_bridge.rst`` has all equations.
"""

import math
from typing import NamedTuple

from .jit import kernel

__all__ = [
    "BOUC_WEN",
    "COULOMB",
    "RubberLaw",
    "Slider",
    "bouc_wen",
    "coulomb",
    "friction",
    "regularised",
    "rubber",
]

BOUC_WEN = 0
COULOMB = 1


class Slider(NamedTuple):
    """Constants of one sliding bearing."""

    f_min: float  # friction coefficient at rest
    df: float  # its increase at high velocity
    a: float  # rate of this increase [s/m]
    yield_displacement: float  # Y [m]


class RubberLaw(NamedTuple):
    """Constants of a rubber device, without the linear term of its skeleton.

    a3 ... a11 are coefficients of the skeleton [N], b0, b2 and b4 of half the distance between the branches [N].
    """

    a3: float
    a5: float
    a7: float
    a9: float
    a11: float
    b0: float
    b2: float
    b4: float
    scale: float  # s_u [m]
    limit: float  # s_max


@kernel(inline=True)
def friction(velocity, slider):
    """Return the friction coefficient at `velocity` [m/s] and its derivative with respect to the velocity [s/m]."""
    rest = slider.df * math.exp(-slider.a * abs(velocity))
    slope = slider.a * rest
    return slider.f_min + slider.df - rest, slope if velocity >= 0.0 else -slope


@kernel(inline=True)
def bouc_wen(increment, z, yield_displacement, c):
    """Return Z after a monotone `increment` of the displacement [m], and dZ/dU [1/m].

    With Z counted in the direction of motion and x = ``|U|``/Y, dZ/dx is 1 + c^2 Z^2 below zero and 1 - Z^2 above,
    where c = sqrt(gamma - beta).
    """
    sign = 1.0 if increment >= 0.0 else -1.0
    x = abs(increment) / yield_displacement
    z = sign * z
    if z < 0.0:
        angle = math.atan(c * z)
        to_zero = -angle / c
        if x <= to_zero:
            t = math.tan(c * x + angle)
            return sign * t / c, (1.0 + t * t) / yield_displacement
        x -= to_zero
        z = 0.0
    decay = math.exp(-2.0 * x)
    t = (1.0 - decay) / (1.0 + decay)  # tanh x
    z = (z + t) / (1.0 + z * t)
    return sign * z, (1.0 - z * z) / yield_displacement


@kernel(inline=True)
def rubber(displacement, law):
    """Return F [N] without its linear term, dF/dU [N/m], D [N] and dD/dU [N/m] at the `displacement` U [m]."""
    scale, limit = law.scale, law.limit
    s = displacement / scale
    inside = min(max(s, -limit), limit)
    q = inside * inside
    force = inside * q * (law.a3 + q * (law.a5 + q * (law.a7 + q * (law.a9 + q * law.a11))))
    stiffness = (
        q * (3.0 * law.a3 + q * (5.0 * law.a5 + q * (7.0 * law.a7 + q * (9.0 * law.a9 + q * 11.0 * law.a11)))) / scale
    )
    half_loop = law.b0 + q * (law.b2 + q * law.b4)
    slope = inside * (2.0 * law.b2 + 4.0 * law.b4 * q) / scale
    if s != inside:
        force += stiffness * (displacement - inside * scale)
        slope = 0.0
    return force, stiffness, half_loop, slope


@kernel(inline=True)
def regularised(increment, displacement, velocity, z, weight, slider, c, law):
    """Return force [N], dF/dU [N/m], dF/dv [N s/m] and Z of a Bouc-Wen slider and a rubber device.

    Parameters
    ----------
    increment : float
        Displacement increment since `z` [m].
    displacement, velocity : float
        Bearing displacement [m] and velocity [m/s] at the end of the increment.
    z : float
        Z before the increment.
    weight : float
        Normal load [N].
    slider : Slider
    c : float
        sqrt(gamma - beta).
    law : RubberLaw
    """
    z, dz = bouc_wen(increment, z, slider.yield_displacement, c)
    mu, dmu = friction(velocity, slider)
    force, stiffness, half_loop, slope = rubber(displacement, law)
    bound = mu * weight + half_loop
    return bound * z + force, bound * dz + stiffness + slope * z, dmu * weight * z, z


@kernel(inline=True)
def coulomb(total, displacement, velocity, pull, weight, slider, law):
    """Evaluate a set-valued slider and a rubber device at a trial force.

    The trial force of the set-valued part plus `pull` times the velocity decides: the bearing sticks while this sum is
    within the bound at rest, and slides beyond.

    Parameters
    ----------
    total : float
        Trial force, without the linear part of the rubber [N].
    displacement, velocity : float
        Bearing displacement [m] and velocity [m/s].
    pull : float
        Positive factor that turns a velocity into a force [N s/m].
    weight : float
        Normal load [N].
    slider : Slider
    law : RubberLaw

    Returns
    -------
    sticks : bool
    force, stiffness, viscosity : float
        F [N], dF/dU [N/m] and dF/dv [N s/m], valid where the bearing slides.
    z : float
    """
    mu, dmu = friction(velocity, slider)
    force, stiffness, half_loop, slope = rubber(displacement, law)
    at_rest = slider.f_min * weight + half_loop
    trial = total - force + pull * velocity
    if abs(trial) <= at_rest:
        return True, force, 0.0, 0.0, (total - force) / at_rest if at_rest > 0.0 else 0.0
    sign = 1.0 if trial > 0.0 else -1.0
    return False, (mu * weight + half_loop) * sign + force, stiffness + slope * sign, dmu * weight * sign, sign
