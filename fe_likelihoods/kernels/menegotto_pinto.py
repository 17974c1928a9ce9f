"""Menegotto-Pinto curve: the path of reinforcing steel between two reversals, in natural coordinates.

A curve goes from (xa, sa) with slope Ea to (xb, sb) with slope Eb::

    s = sa + Ea (x-xa) [Q - (Q-1)/(1+t^R)^(1/R)],   t = |Ea (x-xa)/(s_ch-sa)|
    R = 18 (fyp/E0)^(1/3) (1 - 4 |xb-xa|)

Q and s_ch make it end at (xb, sb) with slope Eb. They follow from the root A in (0, 1) of ::

    g(A) = Eb - Es (1-A^(R+1))/(1-A) + Ea A (1-A^R)/(1-A),   Es = (sb-sa)/(xb-xa)
    Q = (Es/Ea - A)/(1-A),   s_ch = sa + Ea (xb-xa) A/(1-A^R)^(1/R)

``docs/theory/reinforcing_steel.rst`` has the limiting cases.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .elementary import exp, log
from .jit import kernel

__all__ = ["N_CURVE", "End", "evaluate", "evaluate_curve", "fit_curve", "rate_of"]

# Layout of one curve.
XA, SA, EA, XB, SB, EB, RR, QQ, SCH = range(9)
N_CURVE = 9


class End(NamedTuple):
    """End of a curve: natural strain, natural stress [Pa] and slope [Pa]."""

    x: float
    s: float
    e: float


@kernel
def _fit_residual(a, r, ea, eb, es):
    """Return g(A) of the fit, which is zero if the curve ends at (xb, sb) with slope Eb."""
    return eb - es * (1.0 - a ** (r + 1.0)) / (1.0 - a) + ea * a * (1.0 - a**r) / (1.0 - a)


@kernel
def _fit_root(r, ea, eb, es, r_min):
    """Return the root A in (0, 1) of `_fit_residual`.

    The search stops when A changes by less than 1e-4, so its steps affect the last digits of the stress. They follow
    OpenSees, which computed the stress histories of the tests.
    """
    alpha = 0.01
    upper = _fit_residual(1.0 - alpha, r, ea, eb, es)
    for _ in range(60):
        if _fit_residual(alpha, r, ea, eb, es) * upper <= 0.0:
            break
        alpha *= 0.5
        upper = _fit_residual(1.0 - alpha, r, ea, eb, es)
    a = min(r_min / r, 0.999999)
    for _ in range(200):
        if _fit_residual(a, r, ea, eb, es) * upper < 0.0 and a > 0.0:
            a = math.sqrt(a)
        else:
            break
    for _ in range(100):
        step = min(0.49 * (1.0 - a), a / 10.0)
        if a + step >= 1.0:
            step = (1.0 - a) / 10.0
        residual = _fit_residual(a, r, ea, eb, es)
        if residual == 0.0:
            return a
        slope = (_fit_residual(a + step, r, ea, eb, es) - _fit_residual(a - step, r, ea, eb, es)) / (2.0 * step)
        new = a - residual / slope
        new = min(new, 0.99999999)
        if abs(new - a) < 1e-4:
            return abs(new)
        if new <= 0.0:
            new = 0.5 * a
        a = new
    return a


@kernel
def fit_curve(start, end, clip, yield_strain, curve):
    """Fit the curve between two ends.

    Parameters
    ----------
    start, end : End
    clip : bool
        Move an end slope that is on the wrong side of the chord slope to its other side.
    yield_strain : float
        Natural strain fyp/E0, which sets the curvature.
    curve : ndarray (N_CURVE,)
        Written.
    """
    xa, sa, ea = start.x, start.s, start.e
    xb, sb, eb = end.x, end.s, end.e
    es = (sb - sa) / (xb - xa) if xb != xa else ea
    if clip:
        if es < eb:
            eb = 0.999 * es
        if es > ea:
            ea = 1.001 * es
    r = 18.0 * yield_strain ** (1.0 / 3.0) * (1.0 - 4.0 * abs(xb - xa))
    q, sch = 1.0, sb
    if eb != es and abs(xb - xa) >= 1e-7:
        if es == ea:
            r_min, a = 0.0, 0.99999999
        else:
            r_min = max(0.0, (eb - es) / (es - ea))
            if r <= r_min:
                r = r_min + 0.01
            # If the chord slope is not between the end slopes, there is no curve: A = 0 gives a straight line.
            a = _fit_root(r, ea, eb, es, r_min) if r_min > 0.0 else 0.0
        q = (es / ea - a) / (1.0 - a)
        sch = sa + ea * (xb - xa) * a / (1.0 - a**r) ** (1.0 / r)
    curve[XA], curve[SA], curve[EA] = xa, sa, ea
    curve[XB], curve[SB], curve[EB] = xb, sb, eb
    curve[RR], curve[QQ], curve[SCH] = r, q, sch


@kernel
def evaluate_curve(x, curve):
    """Return natural stress and modulus of a curve at the natural strain `x`."""
    ea, q, r = curve[EA], curve[QQ], curve[RR]
    dx = x - curve[XA]
    if dx == 0.0:
        return curve[SA], ea
    t = abs(ea * dx / (curve[SCH] - curve[SA]))
    # (1 + t^R)^(1/R) and t^R/(1 + t^R). Where the clip makes Ea, Es and Eb nearly equal, R reaches 1e13 and t^R would
    # overflow to NaN.
    power = t**r
    if power < 1e100:
        root = (1.0 + power) ** (1.0 / r)
        weight = power / (1.0 + power)
    else:
        root, weight = t, 1.0
    s = curve[SA] + ea * dx * (q - (q - 1.0) / root)
    chord = (s - curve[SA]) / dx
    if r > 100.0:
        return s, ea
    return s, chord - (chord - q * ea) * weight


@kernel(inline=True, fastmath={"contract"})
def evaluate(x, xa, sa, ea, rate, q, r):
    """Return natural stress and modulus at the natural strain `x` of the curve with t = rate abs(x-xa).

    It equals `evaluate_curve` to round-off, without a branch or a call, so that a section evaluates its bars side by
    side (SIMD). The memory of a bar follows `evaluate_curve`: where round-off decides about a reversal, OpenSees has
    the same functions of the C library.
    """
    dx = x - xa
    t = rate * abs(dx)
    log_t = log(t if t > 1e-200 else 1e-200)
    y = r * log_t
    # Where the clip makes Ea, Es and Eb nearly equal, R reaches 1e13: beyond t^R = e^200, (1+t^R)^(1/R) is t.
    large = y > 200.0
    y = 200.0 if large else y
    y = y if y > -690.0 else -690.0
    power = exp(y)
    one = 1.0 + power
    z = log(one) / r
    chord = ea * (q - (q - 1.0) * exp(-log_t if large else -z))
    modulus = chord - (chord - q * ea) * (power / one)
    return sa + chord * dx, ea if r > 100.0 else modulus


@kernel
def rate_of(curve):
    """Return t / abs(x-xa) of a curve, at most 1e200: a curve that ends where it starts has an infinite rate."""
    return min(abs(curve[EA] / (curve[SCH] - curve[SA])), 1e200)
