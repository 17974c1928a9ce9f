"""Laws of the devices between a deck and its piers: sliding bearing, rubber device.

Friction.  The slider carries mu(v) W Z against the motion, with the coefficient of friction of velocity v, ::

    mu(v) = f_min + df (1 - exp(-a |v|))

and Z in [-1, 1] in place of the sign of v. Regularised (Bouc-Wen, exponent 2, A = beta + gamma = 1), Z follows the
displacement U over the yield displacement Y, ::

    Y Z' = v [1 - Z^2 (gamma sgn(v Z) + beta)]

which does not know of rates, so that a monotone increment of U integrates exactly, tanh when Z grows and tan when it
returns. Exact (Coulomb), Z is the sign of v, or any value in [-1, 1] at rest. Elastic-plastic, the slider is a spring
of stiffness f_min W / Y that slides at mu(v) W.

Rubber.  An odd polynomial F(s) of s = U / s_u is the skeleton, an even one D(s) half the distance between the branches
of loading and unloading; the force is F(s) + D(s) Z. Beyond ``|s|`` = s_max the skeleton goes on along its tangent and
D keeps its value.

Source: specs/isolated_bridge.md, section 3; equations (14) and (16) to (18) of the paper on TMCMC.
"""

import math

from .jit import kernel

__all__ = [
    "BOUC_WEN",
    "COULOMB",
    "ELASTIC_PLASTIC",
    "bouc_wen",
    "coulomb",
    "elastic_plastic",
    "friction",
    "regularised",
    "rubber",
]

BOUC_WEN = 0
ELASTIC_PLASTIC = 1
COULOMB = 2


@kernel(inline=True)
def friction(velocity, f_min, df, a):
    """``mu(v) = f_min + df (1 - exp(-a |v|))``: the coefficient and its derivative to v [s/m]."""
    rest = df * math.exp(-a * abs(velocity))
    slope = a * rest
    return f_min + df - rest, slope if velocity >= 0.0 else -slope


@kernel(inline=True)
def bouc_wen(increment, z, yield_displacement, c):
    """Z after a monotone `increment` of displacement, and dZ/dU; c = sqrt(gamma - beta).

    In the direction of motion Z obeys dZ/dx = 1 + c^2 Z^2 below zero and 1 - Z^2 above, with x = ``|U|``/Y.
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
    """F(U) without its linear term, dF/dU, D(U), dD/dU; law = [A3, A5, A7, A9, A11, B0, B2, B4, s_u, s_max]."""
    scale, limit = law[8], law[9]
    s = displacement / scale
    inside = min(max(s, -limit), limit)
    q = inside * inside
    force = inside * q * (law[0] + q * (law[1] + q * (law[2] + q * (law[3] + q * law[4]))))
    stiffness = (
        q * (3.0 * law[0] + q * (5.0 * law[1] + q * (7.0 * law[2] + q * (9.0 * law[3] + q * 11.0 * law[4])))) / scale
    )
    half_loop = law[5] + q * (law[6] + q * law[7])
    slope = inside * (2.0 * law[6] + 4.0 * law[7] * q) / scale
    if s != inside:
        force += stiffness * (displacement - inside * scale)
        slope = 0.0
    return force, stiffness, half_loop, slope


@kernel(inline=True)
def regularised(increment, displacement, velocity, z, weight, bearing, c, law):
    """Bouc-Wen slider and rubber: force, dF/dU, dF/dv, Z; bearing = [f_min, df, a, Y, k0]."""
    z, dz = bouc_wen(increment, z, bearing[3], c)
    mu, dmu = friction(velocity, bearing[0], bearing[1], bearing[2])
    force, stiffness, half_loop, slope = rubber(displacement, law)
    bound = mu * weight + half_loop
    return bound * z + force, bound * dz + stiffness + slope * z, dmu * weight * z, z


@kernel(inline=True)
def elastic_plastic(increment, displacement, velocity, z, weight, bearing, c, law):
    """Slider that is a spring of stiffness k0 up to mu(v) W, and rubber; z is the slider's force [N]."""
    mu, dmu = friction(velocity, bearing[0], bearing[1], bearing[2])
    force, stiffness, half_loop, slope = rubber(displacement, law)
    capacity, dcapacity = mu * weight, dmu * weight
    slider, dslider, dv = z + bearing[4] * increment, bearing[4], 0.0
    share, dshare, share_dv = 0.0, 0.0, 0.0  # of the capacity, and its derivatives to U and v
    if abs(slider) >= capacity:  # also where nothing presses on the bearing
        share = 1.0 if slider > 0.0 else -1.0
        slider, dslider, dv = share * capacity, 0.0, share * dcapacity
    else:
        share, dshare, share_dv = slider / capacity, dslider / capacity, -slider / capacity**2 * dcapacity
    return (
        slider + half_loop * share + force,
        dslider + half_loop * dshare + slope * share + stiffness,
        dv + half_loop * share_dv,
        slider,
    )


@kernel(inline=True)
def coulomb(total, displacement, velocity, pull, weight, bearing, law):
    """Set-valued slider and rubber, at a trial force `total` without the rubber's linear part.

    The force on the set-valued part, tried with `pull` times the velocity, decides: within the bound the bearing
    sticks, beyond it slides. Returns (sticks, force, dF/dU, dF/dv, Z); force and derivatives hold where it slides.
    """
    mu, dmu = friction(velocity, bearing[0], bearing[1], bearing[2])
    force, stiffness, half_loop, slope = rubber(displacement, law)
    at_rest = bearing[0] * weight + half_loop
    trial = total - force + pull * velocity
    if abs(trial) <= at_rest:
        return True, force, 0.0, 0.0, (total - force) / at_rest if at_rest > 0.0 else 0.0
    sign = 1.0 if trial > 0.0 else -1.0
    return False, (mu * weight + half_loop) * sign + force, stiffness + slope * sign, dmu * weight * sign, sign
