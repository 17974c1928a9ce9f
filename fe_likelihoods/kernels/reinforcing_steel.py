"""Reinforcing steel: yield plateau, strain hardening, and reversals along curves of Menegotto and Pinto.

The law works with the natural strain x = ln(1 + eps) and the natural stress s. Arguments and results are engineering
quantities::

    sigma = s/(1 + eps),   d sigma/d eps = (E - s)/(1 + eps)^2

The backbone s_b(x) is odd in x. With z = abs(x)::

    up to a        s = z [(E0-Ep)/(1+q^10)^0.1 + Ep],   q = (E0-Ep) z/f0       elastic range, knee and plateau
    up to shp+d    s = (EhT-Ep)(z-a)^2/(2 (shp+d-a)) + Ep z + f0               transition
    up to up       s = fsh + (z-shp) Eu + (fsu-fsh)(1-w^p),   w = (up-z)/(up-shp)    strain hardening
    beyond         s = fsu + (z-shp) Eu

Between reversals the path is a curve of Menegotto and Pinto (`menegotto_pinto`). A branch number selects the curve.
Branches 1 and 2 are the backbones in tension and compression. Branches 3, 5, 7 ... are the curves of successively
nested reversals whose first goes down from tension; 4, 6, 8 ... are their mirror images. A branch b > 2 keeps its curve
in the slot of level (b+1)//2. Only the rules of the odd branches are written out. An even branch is processed by the
same rules with the signs of all strains and stresses changed.

OpenSees has the same law as its material ReinforcingSteel with default options: no buckling, no fatigue, no isotropic
hardening. `bar_fatigue` adds fatigue. ``docs/theory/reinforcing_steel.rst`` lists all rules.
"""

from __future__ import annotations

import math

from .jit import SUM_REORDERING, kernel
from .menegotto_pinto import EA, N_CURVE, SA, SB, SCH, XA, XB, End, evaluate_curve, fit_curve

__all__ = [
    "N_CONSTANTS",
    "N_STATE",
    "constants",
    "curve_slot",
    "backbone",
    "virgin_stress_tangent",
    "switch_backbone",
    "transition",
    "update",
]

# Layout of the steel constants.
E0, FYP, YP, SHP, FSH, UP, EU, FSU, EH, EP, F0, P, FT, EHT, A_SHIFT, VIRGIN_LIMIT, YIELD_STRAIN = range(17)
N_CONSTANTS = 17

# Layout of one bar's memory: ten scalars, then nine numbers for the curve of each level from 2 to 10.
BRANCH, OP, ON, XMAX, XMIN, XXMAX, XXMIN, RE, XC, SC, CURVES = range(11)
N_STATE = 10 + 9 * N_CURVE

TRANSITION = 0.0002  # strain over which the plateau turns into hardening
TIE = 1e-14  # strains closer than this count as equal
MAX_TRANSITIONS = 40  # from one branch to the next, within one step
NEAR_ZERO = 1e-6  # a bar this close to the origin of its backbone counts as being at the origin [strain]
VIRGIN_Q = 0.6  # largest q for which the series of virgin_stress_tangent are exact to round-off


@kernel
def constants(fy, fu, es, esh, eps_sh, eps_u, out):
    """Fill `out` with the constants of one steel.

    Parameters
    ----------
    fy, fu : float
        Yield strength and ultimate strength [Pa].
    es, esh : float
        Modulus and modulus at the onset of hardening [Pa].
    eps_sh, eps_u : float
        Engineering strains at the onset of hardening and at `fu`.
    out : ndarray (N_CONSTANTS,)
        Overwritten. Any other consistent stress unit serves as well.
    """
    out[YP] = math.log(1.0 + fy / es)
    out[FYP] = fy * (1.0 + fy / es)
    out[E0] = out[FYP] / out[YP]
    out[SHP] = math.log(1.0 + eps_sh)
    out[FSH] = fy * (1.0 + eps_sh)
    out[UP] = math.log(1.0 + eps_u)
    out[EU] = fu * (1.0 + eps_u)
    out[FSU] = out[EU] - (out[UP] - out[SHP]) * out[EU]
    out[EH] = esh * (1.0 + eps_sh) ** 2 + out[FSH] - out[EU]
    out[EP] = (out[FSH] - out[FYP]) / (out[SHP] - out[YP])
    out[F0] = out[FYP] - out[EP] * out[YP]
    out[P] = out[EH] * (out[UP] - out[SHP]) / (out[FSU] - out[FSH])
    w = (out[UP] - out[SHP] - TRANSITION) / (out[UP] - out[SHP])
    out[FT] = out[FSH] + TRANSITION * out[EU] + (out[FSU] - out[FSH]) * (1.0 - w ** out[P])
    out[EHT] = out[EH] * ((out[FSU] - out[FT]) / (out[FSU] - out[FSH])) ** (1.0 - 1.0 / out[P])
    out[A_SHIFT] = out[SHP] + TRANSITION - 2.0 * (out[FT] - out[FSH]) / out[EHT]
    # A reversal changes the memory where |ln(1+eps)| >= yp; this is the smaller of the two strains.
    out[YIELD_STRAIN] = 1.0 - math.exp(-out[YP])
    # The series below hold up to this strain: q < 0.6 and eps < 0.01.
    out[VIRGIN_LIMIT] = min(VIRGIN_Q * out[F0] / (out[E0] - out[EP]), 0.01)


@kernel
def backbone(x, c):
    """Return natural stress and modulus of the monotonic curve at the natural strain `x`."""
    z = abs(x)
    if z <= c[A_SHIFT]:
        q = (c[E0] - c[EP]) * z / c[F0]
        u = 1.0 + q**10
        root = u**-0.1
        s = z * ((c[E0] - c[EP]) * root + c[EP])
        e = (c[E0] - c[EP]) * root / u + c[EP]
    elif z < c[SHP] + TRANSITION:
        curvature = (c[EHT] - c[EP]) / (c[SHP] + TRANSITION - c[A_SHIFT])
        d = z - c[A_SHIFT]
        s = 0.5 * curvature * d * d + c[EP] * z + c[F0]
        e = curvature * d + c[EP]
    elif z <= c[UP]:
        w = (c[UP] - z) / (c[UP] - c[SHP])
        wp = w ** c[P]
        s = c[FSH] + (z - c[SHP]) * c[EU] + (c[FSU] - c[FSH]) * (1.0 - wp)
        e = c[EH] * wp ** (1.0 - 1.0 / c[P]) + c[EU]
    else:
        s = c[FSU] + (z - c[SHP]) * c[EU]
        e = c[EU]
    return math.copysign(s, x), e


@kernel(inline=True, fastmath=SUM_REORDERING)
def virgin_stress_tangent(eps, e0, ep, f0):
    """Return engineering stress and tangent of the backbone well below yield, from series.

    For ``|eps| < VIRGIN_LIMIT`` the truncated series of ln(1+eps) and (1+q^10)^-0.1 are exact to round-off. They need
    neither a logarithm nor a power, so that a section can evaluate its bars side by side (SIMD).
    """
    e2 = eps * eps
    x = (1.0 / 5.0 - 1.0 / 6.0 * eps) + e2 * (1.0 / 7.0 - 0.125 * eps)
    x = eps * ((1.0 - 0.5 * eps) + e2 * (1.0 / 3.0 - 0.25 * eps) + e2 * e2 * x)
    q = (e0 - ep) / f0 * x
    q2 = q * q
    q4 = q2 * q2
    u = q4 * q4 * q2
    u2 = u * u
    root = (0.0298375 - 0.02446675 * u) + 0.0207967375 * u2
    root = ((1.0 - 0.1 * u) + u2 * (0.055 - 0.0385 * u) + u2 * u2 * root) * (e0 - ep)
    natural_stress = x * (root + ep)
    natural_modulus = root / (1.0 + u) + ep
    inverse = 1.0 / (1.0 + eps)
    return natural_stress * inverse, (natural_modulus - natural_stress) * inverse * inverse


@kernel
def _mirror_branch(b):
    """Return the branch of the other sign: 1 <-> 2, 3 <-> 4, ..."""
    return b + 1 if b % 2 == 1 else b - 1


@kernel
def _mirror(state):
    """Change the sign of every strain and stress in the memory in place, so that tension becomes compression."""
    state[BRANCH] = _mirror_branch(int(state[BRANCH]))
    state[OP], state[ON] = -state[ON], -state[OP]
    state[XMAX], state[XMIN] = -state[XMIN], -state[XMAX]
    state[XXMAX], state[XXMIN] = -state[XXMIN], -state[XXMAX]
    state[RE], state[XC], state[SC] = -state[RE], -state[XC], -state[SC]
    for level in range(9):
        k = CURVES + N_CURVE * level
        state[k + XA], state[k + SA] = -state[k + XA], -state[k + SA]
        state[k + XB], state[k + SB] = -state[k + XB], -state[k + SB]
        state[k + SCH] = -state[k + SCH]


@kernel
def curve_slot(branch):
    """Return the position in the memory of the curve for a branch > 2."""
    return CURVES + N_CURVE * ((branch + 1) // 2 - 2)


@kernel
def _returning_curve(xc, state, c, curve):
    """Write to `curve` the auxiliary curve on which a path that reversed at `xc` on branch 5 returns to branch 3."""
    two, three = state[curve_slot(3) :], state[curve_slot(5) :]
    xa2, xb2, ea2 = two[XA], two[XB], two[EA]
    xa3, xb3 = three[XA], three[XB]
    start = xb3 * (xc - xa3) / (xb3 - xa3) + xa2 * (xb3 - xc) / (xb3 - xa3)
    s_start, _ = backbone(start - state[OP], c)
    s_end, e_end = backbone(xb2 - state[ON], c)
    fit_curve(End(start, s_start, ea2), End(xb2, s_end, e_end), False, c[FYP] / c[E0], curve)


@kernel
def _step(x, tension, state, c):
    """Make one transition of an odd branch at the natural strain `x`; `state` (N_STATE,) changes in place.

    Returns whether no other transition has to follow and, valid only then, natural stress and modulus. `tension` is
    False for an even branch, which is processed as a mirrored odd branch; one rule holds in tension only.
    """
    b = int(state[BRANCH])
    xc, sc = state[XC], state[SC]
    if b == 1:
        e = x - state[OP]
        if x >= xc or 0.0 < e < c[YP]:
            s, modulus = backbone(e, c)
            return True, s, modulus
        if e <= 0.0:
            state[BRANCH] = 2
            return False, 0.0, 0.0
        state[XMAX] = xc - state[OP]
        state[XXMAX] = max(state[XXMAX], xc)
        er = c[E0] * (0.82 + 1.0 / (5.55 + 1000.0 * max(state[XXMAX], -state[XXMIN])))
        curve = state[curve_slot(3) :]
        if e >= c[SHP]:
            m = min(state[XMIN], -c[SHP] - TIE)
            ea = state[OP] + c[SHP] - c[FSH] / c[E0]
            eb = state[OP] + state[XMAX] - sc / c[E0]
            k = math.exp(-state[XMAX] / (5000.0 * c[YP] * c[YP]))
            o = ea * k + eb * (1.0 - k)
            if o > state[ON]:
                m -= o - state[ON]
                state[ON] = o
            s_target, e_target = backbone(m, c)
            x_target = state[ON] + m
            if tension and (s_target - sc) / (x_target - xc) < e_target:
                state[ON] = (s_target - sc) / e_target + xc - m
                x_target = state[ON] + m
            fit_curve(End(xc, sc, er), End(x_target, s_target, e_target), False, c[FYP] / c[E0], curve)
        else:
            r = (state[XMAX] - c[YP]) / (c[SHP] - c[YP])
            m = r * (c[YP] - c[SHP]) - c[YP]
            state[ON] = xc - sc / c[E0]
            s_target, _ = backbone(m, c)
            e_target = 1.0 / (1.0 / c[E0] + r * (1.0 / c[EH] - 1.0 / c[E0]))
            fit_curve(End(xc, sc, er), End(state[ON] + m, s_target, e_target), True, c[FYP] / c[E0], curve)
        state[BRANCH] = 3
        return False, 0.0, 0.0

    curve = state[curve_slot(b) :]
    up = b % 4 == 1
    reached = x >= curve[XB] - TIE if up else x <= curve[XB] + TIE
    reversal = x < xc - TIE if up else x > xc + TIE
    if not reached and not reversal:
        s, modulus = evaluate_curve(x, curve)
        return True, s, modulus
    if reached:
        if b == 3:
            state[BRANCH] = 2
        elif b == 5:
            state[BRANCH] = 1
        elif b == 7:
            _returning_curve(curve[XA], state, c, state[curve_slot(3) :])
            state[BRANCH] = 3
        else:
            state[BRANCH] = b - 4
        return False, 0.0, 0.0

    er = c[E0] * (0.82 + 1.0 / (5.55 + 1000.0 * max(state[XXMAX], -state[XXMIN])))
    if b == 3:
        state[XMIN] = min(state[XMIN], xc - state[ON])
        d = min(max(curve[XA] - xc - c[FYP] / (1.2 * c[E0]), 0.0), c[FYP] / (3.0 * c[E0]))
        s_target, e_target = backbone(state[XMAX] + d, c)
        x_target = state[OP] + state[XMAX] + d
        new = 5
    elif b == 5:
        aside = state[curve_slot(7) :]
        _returning_curve(xc, state, c, aside)
        x_target = curve[XA]
        s_target, e_target = evaluate_curve(x_target, aside)
        new = 7
    elif b == 7:
        x_target = curve[XA]
        s_target, e_target = evaluate_curve(x_target, state[curve_slot(5) :])
        state[RE] = xc
        new = 9
    elif up:
        if b + 4 <= 20:
            state[RE] = curve[XA]
        x_target = state[RE]
        s_target, e_target = evaluate_curve(x_target, state[curve_slot(b - 2) :])
        new = b + 2
    elif b + 2 <= 20:
        x_target = curve[XA]
        s_target, e_target = evaluate_curve(x_target, state[curve_slot(b - 2) :])
        new = b + 2
    else:
        x_target = state[curve_slot(b - 4) :][XA]
        s_target, e_target = evaluate_curve(x_target, state[curve_slot(b - 6) :])
        new = b - 2
    fit_curve(End(xc, sc, er), End(x_target, s_target, e_target), True, c[FYP] / c[E0], state[curve_slot(new) :])
    state[BRANCH] = new
    return False, 0.0, 0.0


@kernel(inline=True)
def transition(x, state, c):
    """Make one transition of any branch at the natural strain `x`; arguments and results as for `_step`."""
    if int(state[BRANCH]) % 2 == 1:
        return _step(x, True, state, c)
    _mirror(state)
    done, s, modulus = _step(-x, False, state, c)
    _mirror(state)
    return done, -s, modulus


@kernel
def update(eps, state, c):
    """Advance the memory of one bar to the strain `eps` in place, and return engineering stress and tangent.

    A trial works on a copy of the committed memory, a commit on the memory itself.
    """
    x = math.log(1.0 + eps) if eps > -0.95 else math.nan
    if state[BRANCH] == 0.0:
        if x == 0.0:
            return 0.0, c[E0]
        state[BRANCH] = 1.0 if x > 0.0 else 2.0
    s, modulus = math.nan, math.nan
    for _ in range(MAX_TRANSITIONS):
        done, s, modulus = transition(x, state, c)
        if done:
            break
    state[XC] = x
    state[SC] = s
    return s / (1.0 + eps), (modulus - s) / ((1.0 + eps) * (1.0 + eps))


@kernel
def switch_backbone(state, c):
    """Move a bar at the origin of its backbone to the other backbone, in place; return 1 if it has moved, else 0.

    After small yielding the backbones in tension and compression have different origins. The law jumps to the other
    backbone when the stress on the present backbone passes zero.
    """
    b = int(state[BRANCH])
    if b != 1 and b != 2 or state[OP] == state[ON]:
        return 0
    origin, other = (state[OP], state[ON]) if b == 1 else (state[ON], state[OP])
    if abs(state[XC] - origin) > NEAR_ZERO:
        return 0
    s, _ = backbone(state[XC] - other, c)
    state[BRANCH] = _mirror_branch(b)
    state[SC] = s
    return 1
