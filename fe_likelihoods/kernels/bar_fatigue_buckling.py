"""Failure of reinforcing bars: low-cycle fatigue with fracture, and buckling in compression.

Both multiply the natural stress s of `reinforcing_steel` by a factor and do not change its rules::

    s_bar = phi_f(D) phi_b(x) s

**Fatigue.** Every half cycle adds to Miner's sum D according to Coffin and Manson. The plastic strain of a half cycle
that started at (x0, s0) is what remains of its strain after elastic unloading::

    D = sum (ep/Cf)^(1/alpha),   ep = |x-x0| - |s-s0|/E0
    phi_f = 1 - (Cf/Cd)^(1/alpha) D - max(0, D-1)/0.04,   not below 0

The bar loses strength gradually and fractures at D = 1; its stress goes to zero before D = 1.04. The branches of the
law give the half cycles of rainflow counting: a nested reversal starts a new half cycle one level deeper; a curve that
ends at an earlier reversal closes a loop, after which the interrupted half cycle continues.

**Buckling.** A bar in compression follows the average stress of Dhakal and Maekawa. With the strain z = xr - x from the
unloaded point xr of the largest tensile strain xs, and L/d the ratio of unsupported length to diameter::

    lp = L/d sqrt(fy/100 MPa),   z* = max(55 - 2.3 lp, 7) yp,   phi* = min(alpha_b (1.1 - 0.016 lp), 1)
    up to yp   phi_b = 1
    up to z*   phi_b = 1 - (1-phi*) (z-yp)/(z*-yp)
    beyond     phi_b = (phi* s_b(z*) - 0.02 E0 (z-z*)) / s_b(z)

but phi_b s_b >= 0.2 fy. In tension a buckled bar becomes straight again at the strain xs; until then the factor grows
linearly from its value at the lowest strain. The rules for cycles have not been validated by tests of bars.

``docs/theory/reinforcing_steel.rst`` has the equations and compares them with OpenSees.

References
----------
S. S. Manson, Fatigue: a complex subject - some simple approximations, Experimental Mechanics 5(7), 1965,
doi:10.1007/BF02321056.

J. Brown, S. K. Kunnath, Low-cycle fatigue failure of reinforcing steel bars, ACI Materials Journal 101(6), 2004.

R. P. Dhakal, K. Maekawa, Modeling for postyield buckling of reinforcement, Journal of Structural Engineering 128(9),
2002, doi:10.1061/(ASCE)0733-9445(2002)128:9(1139).

S. K. Kunnath, Y. Heo, J. F. Mohle, Nonlinear uniaxial material model for reinforcing steel bars, Journal of Structural
Engineering 135(4), 2009, doi:10.1061/(ASCE)0733-9445(2009)135:4(335).
"""

from __future__ import annotations

import math

from . import reinforcing_steel
from .jit import kernel
from .menegotto_pinto import SB, XB
from .reinforcing_steel import BRANCH, E0, FYP, MAX_TRANSITIONS, SC, XC, YP, backbone, curve_slot, transition

__all__ = ["N_FAILURE", "N_STATE", "constants", "stress_history", "stress_tangent", "update"]

# Layout of the failure constants of one steel. CF is 0 without fatigue, END 0 without buckling.
CF, POWER, LOSS, END, END_FACTOR, END_STRESS, RESIDUAL = range(7)
N_FAILURE = 7

# Layout of one bar's memory, after the memory of `reinforcing_steel`: five scalars, and for each level of branches the
# start of its half cycle, the damage before it, and the damage that it had done when the path reversed.
DAMAGE, FRACTURED, UNLOADED, STRAIGHT, LOWEST, HALF_CYCLES = range(
    reinforcing_steel.N_STATE, reinforcing_steel.N_STATE + 6
)
START_X, START_S, BEFORE, REVERSED = range(4)
N_LEVELS = 10
N_STATE = HALF_CYCLES + 4 * N_LEVELS

FRACTURE_RANGE = 0.04  # of Miner's sum, over which the stress goes to zero
MPA_100 = 100e6  # unit of the yield strength in the formulas of Dhakal and Maekawa [Pa]


@kernel
def constants(steel, fy, cf, alpha, cd, slenderness, alpha_b, out):
    """Fill `out` with the failure constants of one steel.

    Parameters
    ----------
    steel : ndarray (reinforcing_steel.N_CONSTANTS,)
        Constants of the law, in SI units.
    fy : float
        Yield strength [Pa].
    cf, alpha, cd : float
        Coefficient and exponent of Coffin and Manson, and coefficient of strength loss; no fatigue if `cf` is 0.
    slenderness : float
        Unsupported length of the bar divided by its diameter; no buckling if it is 0.
    alpha_b : float
        Factor of the stress at the end of the first branch after buckling: 1 for steel that hardens, 0.75 for steel
        that does not.
    out : ndarray (N_FAILURE,)
        Overwritten.
    """
    for i in range(N_FAILURE):
        out[i] = 0.0
    if cf > 0.0:
        out[CF] = cf
        out[POWER] = 1.0 / alpha
        out[LOSS] = (cf / cd) ** (1.0 / alpha)
    if slenderness > 0.0:
        lp = slenderness * math.sqrt(fy / MPA_100)
        out[END] = max(55.0 - 2.3 * lp, 7.0) * steel[YP]
        out[RESIDUAL] = 0.2 * steel[FYP]
        s, _ = backbone(out[END], steel)
        out[END_FACTOR] = max(min(alpha_b * (1.1 - 0.016 * lp), 1.0), out[RESIDUAL] / s)
        out[END_STRESS] = out[END_FACTOR] * s


@kernel
def half_cycle_damage(dx, ds, c, f):
    """Return the damage of a half cycle with the natural strain `dx` and stress `ds` from its start.

    Returns
    -------
    damage : float
    slope : float
        Derivative of the damage with respect to the plastic strain.
    """
    plastic = abs(dx) - abs(ds) / c[E0]
    if plastic <= 0.0:
        return 0.0, 0.0
    d = (plastic / f[CF]) ** f[POWER]
    return d, f[POWER] * d / plastic


@kernel
def buckling_factor(z, c, f):
    """Return the factor of a bar at the compressive strain `z` from its unloaded point, and the factor's derivative."""
    if z <= c[YP]:
        return 1.0, 0.0
    if z <= f[END]:
        slope = -(1.0 - f[END_FACTOR]) / (f[END] - c[YP])
        return 1.0 + slope * (z - c[YP]), slope
    s, modulus = backbone(z, c)
    stress = f[END_STRESS] - 0.02 * c[E0] * (z - f[END])
    slope = -0.02 * c[E0]
    if stress < f[RESIDUAL]:
        stress, slope = f[RESIDUAL], 0.0
    return stress / s, (slope - stress * modulus / s) / s


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
        if f[CF] > 0.0:
            _count(old, int(state[BRANCH]), state[XC], state[SC], state, c, f)
    state[XC] = x
    state[SC] = s
    factor, slope = 1.0, 0.0
    if f[CF] > 0.0:
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
    if f[END] > 0.0:
        buckled, by_x = 1.0, 0.0
        if s < 0.0:
            buckled, by_z = buckling_factor(state[UNLOADED] - x, c, f)
            by_x = -by_z
            state[LOWEST] = min(state[LOWEST], x)
        elif x >= state[STRAIGHT]:
            state[STRAIGHT] = x
            state[LOWEST] = x
            state[UNLOADED] = x - s / c[E0]
        else:
            lowest, _ = buckling_factor(state[UNLOADED] - state[LOWEST], c, f)
            by_x = (1.0 - lowest) / (state[STRAIGHT] - state[LOWEST]) if lowest < 1.0 else 0.0
            buckled = 1.0 - by_x * (state[STRAIGHT] - x)
        slope = slope * buckled + factor * by_x
        factor *= buckled
    modulus = factor * modulus + slope * s
    s *= factor
    return s / (1.0 + eps), (modulus - s) / ((1.0 + eps) * (1.0 + eps))


@kernel
def stress_tangent(eps, state, c, f, trial):
    """Return engineering stress and tangent at the trial strain `eps` without changing `state`.

    `trial` (N_STATE,) is scratch; the other arguments are as for `update`.
    """
    for i in range(N_STATE):
        trial[i] = state[i]
    return update(eps, trial, c, f)


@kernel
def stress_history(strain, state, c, f, stress):
    """Take one bar through `strain` (n,), write its engineering `stress` (n,), and advance its memory in place."""
    for i in range(strain.shape[0]):
        stress[i], _ = update(strain[i], state, c, f)
