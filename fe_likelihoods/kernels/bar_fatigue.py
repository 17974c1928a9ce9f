"""Failure of reinforcing bars: low-cycle fatigue with fracture.

It multiplies the natural stress s of `reinforcing_steel` by a factor and does not change its rules::

    s_bar = phi_f(D) s

Every half cycle adds to Miner's sum D according to Coffin and Manson. The plastic strain of a half cycle
that started at (x0, s0) is what remains of its strain after elastic unloading::

    D = sum (ep/Cf)^(1/alpha),   ep = |x-x0| - |s-s0|/E0
    phi_f = 1 - (Cf/Cd)^(1/alpha) D - max(0, D-1)/0.04,   not below 0

The bar loses strength gradually and fractures at D = 1; its stress goes to zero before D = 1.04. The branches of the
law give the half cycles of rainflow counting: a nested reversal starts a new half cycle one level deeper; a curve that
ends at an earlier reversal closes a loop, after which the interrupted half cycle continues.

``docs/theory/reinforcing_steel.rst`` has the equations and compares them with OpenSees.
"""

from __future__ import annotations

import math

from . import reinforcing_steel
from .jit import kernel
from .menegotto_pinto import SB, XB
from .reinforcing_steel import BRANCH, E0, MAX_TRANSITIONS, SC, XC, curve_slot, transition

__all__ = ["N_FAILURE", "N_STATE", "constants", "update"]

# Layout of the failure constants of one steel.
CF, POWER, LOSS = range(3)
N_FAILURE = 3

# Layout of one bar's memory, after the memory of `reinforcing_steel`: two scalars, and for each level of branches the
# start of its half cycle, the damage before it, and the damage that it had done when the path reversed.
DAMAGE, FRACTURED, HALF_CYCLES = range(reinforcing_steel.N_STATE, reinforcing_steel.N_STATE + 3)
START_X, START_S, BEFORE, REVERSED = range(4)
N_LEVELS = 10
N_STATE = HALF_CYCLES + 4 * N_LEVELS

FRACTURE_RANGE = 0.04  # of Miner's sum, over which the stress goes to zero


@kernel
def constants(cf, alpha, cd, out):
    """Fill `out` with the failure constants of one steel.

    Parameters
    ----------
    cf, alpha, cd : float
        Coefficient and exponent of Coffin and Manson, and coefficient of strength loss.
    out : ndarray (N_FAILURE,)
        Overwritten.
    """
    out[CF] = cf
    out[POWER] = 1.0 / alpha
    out[LOSS] = (cf / cd) ** (1.0 / alpha)


@kernel
def half_cycle_damage(dx, ds, c, f):
    """Return the damage of a half cycle with the natural strain `dx` and stress `ds` from its start, and its slope.

    The slope is the derivative of the damage with respect to the plastic strain.
    """
    plastic = abs(dx) - abs(ds) / c[E0]
    if plastic <= 0.0:
        return 0.0, 0.0
    d = (plastic / f[CF]) ** f[POWER]
    return d, f[POWER] * d / plastic


@kernel
def _half_cycle(level):
    """Return the position of a level's half cycle in the memory."""
    return HALF_CYCLES + 4 * (level - 1)


@kernel
def _count(old, new, xc, sc, state, c, f):
    """Count the half cycles at the transition from the branch `old` to `new`; the committed point is (xc, sc)."""
    level, target = (old + 1) // 2, (new + 1) // 2
    k, m = _half_cycle(level), _half_cycle(target)
    if target == level + 1 or target == level:
        # A reversal starts a half cycle, one level deeper or, on a backbone, at zero stress.
        d, _ = half_cycle_damage(xc - state[k + START_X], sc - state[k + START_S], c, f)
        state[k + REVERSED] = d
        state[m + BEFORE] = state[k + BEFORE] + d
        state[m + START_X], state[m + START_S] = xc, sc
    elif level == 2:
        # A path that leaves one backbone reaches the other backbone: its half cycle continues.
        state[m + START_X], state[m + START_S] = state[k + START_X], state[k + START_S]
        state[m + BEFORE] = state[k + BEFORE]
    elif target == level - 2:
        # A loop is closed: the half cycle that it has interrupted continues.
        curve = state[curve_slot(old) :]
        d, _ = half_cycle_damage(curve[XB] - state[k + START_X], curve[SB] - state[k + START_S], c, f)
        state[m + BEFORE] = state[k + BEFORE] + d - state[m + REVERSED]
    else:
        # The deepest level reverses into the level above it, whose half cycle is forgotten.
        d, _ = half_cycle_damage(xc - state[k + START_X], sc - state[k + START_S], c, f)
        state[m + BEFORE] = state[k + BEFORE] + d
        state[m + START_X], state[m + START_S] = xc, sc


@kernel
def update(eps, state, c, f):
    """Advance the memory of one bar to the strain `eps` in place, and return engineering stress and tangent.

    Parameters
    ----------
    eps : float
        Engineering strain.
    state : ndarray (N_STATE,)
        Memory, zero for a bar that has not been strained.
    c : ndarray (reinforcing_steel.N_CONSTANTS,)
        Constants of the law, in SI units.
    f : ndarray (N_FAILURE,)
        Constants of the failure.

    Returns
    -------
    stress, tangent : float
        [Pa]; zero for a bar that has fractured.
    """
    if state[FRACTURED] == 1.0:
        return 0.0, 0.0
    x = math.log(1.0 + eps) if eps > -0.95 else math.nan
    if state[BRANCH] == 0.0:
        if x == 0.0:
            return 0.0, c[E0]
        state[BRANCH] = 1.0 if x > 0.0 else 2.0
    s, modulus = math.nan, math.nan
    for _ in range(MAX_TRANSITIONS):
        old = int(state[BRANCH])
        done, s, modulus = transition(x, state, c)
        if done:
            break
        _count(old, int(state[BRANCH]), state[XC], state[SC], state, c, f)
    state[XC] = x
    state[SC] = s
    k = _half_cycle((int(state[BRANCH]) + 1) // 2)
    dx, ds = x - state[k + START_X], s - state[k + START_S]
    d, d_slope = half_cycle_damage(dx, ds, c, f)
    total = state[k + BEFORE] + d
    state[DAMAGE] = total
    loss = f[LOSS]
    factor = 1.0 - loss * total
    if total > 1.0:
        factor -= (total - 1.0) / FRACTURE_RANGE
        loss += 1.0 / FRACTURE_RANGE
    if factor <= 0.0:
        state[FRACTURED] = 1.0
        return 0.0, 0.0
    slope = -loss * d_slope * (math.copysign(1.0, dx) - math.copysign(1.0, ds) * modulus / c[E0])
    modulus = factor * modulus + slope * s
    s *= factor
    return s / (1.0 + eps), (modulus - s) / ((1.0 + eps) * (1.0 + eps))
