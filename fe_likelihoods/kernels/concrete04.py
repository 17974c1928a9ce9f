"""Popovics concrete with Karsan-Jirsa unloading and exponential tension softening (OpenSees ``Concrete04``).

The law, compression negative, with memory (eps_min, eps_max), the extreme strains committed so far::

    eps < eps_min            sigma = fc eta r / (r - 1 + eta^r)   down to eps_cu, then 0
                             eta = eps/eps_0,  r = Ec/(Ec - fc/eps_0)
    eps_min <= eps < eps_end sigma = slope (eps - eps_end)        unloading towards the plastic strain
    eps_end <= eps < 0       sigma = 0                            crack closing
    0 <= eps <= eps_max      sigma = (sigma_env(eps_max)/eps_max) eps
    eps > eps_max            sigma = Ec eps                                    up to eps_ct = ft/Ec
                             sigma = ft beta^((eps-eps_ct)/(eps_tu-eps_ct))    up to eps_tu, then 0

The stress is a single-valued function of the strain and of the two numbers of memory: it does not depend on the
direction of loading, and a trial evaluation leaves no trace. That is what lets a section evaluate its fibers
side by side.

References
----------
Popovics (1973), Cem. Concr. Res. 3(5); Karsan & Jirsa (1969), J. Struct. Div. ASCE 95(12).
The rules as reproduced here: specs/bridge_column.md, section 2.
"""

from __future__ import annotations

import math

from .jit import kernel

__all__ = ["N_CONSTANTS", "constants", "unloading", "envelope", "stress_tangent", "commit"]

# Layout of the constants of one concrete.
FC, E0, ECU, EC, FT, ETU, BETA, ESEC, R, ECT, DECAY = range(11)
N_CONSTANTS = 11


@kernel
def constants(fc, e0, ecu, ec, ft, etu, beta, out):
    """Fill `out` (N_CONSTANTS,) from the seven material constants (fc, e0, ecu < 0; any consistent units)."""
    e_secant = fc / e0
    out[FC] = fc
    out[E0] = e0
    out[ECU] = ecu
    out[EC] = ec
    out[FT] = ft
    out[ETU] = etu
    out[BETA] = beta
    out[ESEC] = e_secant
    out[R] = 400.0 if e_secant >= ec else ec / (ec - e_secant)
    out[ECT] = ft / ec
    out[DECAY] = math.log(beta) / (etu - ft / ec)


@kernel
def envelope(eps, c):
    """Stress and tangent of the virgin material at strain `eps`, compression or tension."""
    if eps <= 0.0:
        if eps < c[ECU]:
            return 0.0, 0.0
        r = c[R]
        eta = eps / c[E0]
        power = eta * eta if r == 2.0 else eta**r
        if power > 1e150:  # far down the r = 400 branch: its square would overflow to nan
            return 0.0, 0.0
        d = r - 1.0 + power
        return c[FC] * eta * r / d, c[ESEC] * r * (r - 1.0) * (1.0 - power) / (d * d)
    if eps <= c[ECT]:
        return c[EC] * eps, c[EC]
    if eps <= c[ETU]:
        s = c[FT] * math.exp(c[DECAY] * (eps - c[ECT]))
        return s, s * c[DECAY]
    return 0.0, 0.0


@kernel
def unloading(eps_min, eps_max, c):
    """What follows from the memory: eps_end and slope of compressive unloading, secant slope of tensile unloading.

    Karsan & Jirsa's plastic strain ratio = .145 eta^2 + .13 eta (eta < 2), .707 (eta - 2) + .834 beyond; the slope is
    never steeper than Ec.
    """
    ec = c[EC]
    eps_end, slope, tension_slope = 0.0, ec, ec
    if eps_min < 0.0:
        eta = max(eps_min, c[ECU]) / c[E0]
        ratio = 0.145 * eta * eta + 0.13 * eta if eta < 2.0 else 0.707 * (eta - 2.0) + 0.834
        plastic = ratio * c[E0]
        stress, _ = envelope(eps_min, c)
        d = eps_min - plastic
        e = stress / ec
        if d > -2.2e-16:
            eps_end, slope = plastic, ec
        elif d <= e:
            eps_end, slope = plastic, stress / d
        else:
            eps_end, slope = eps_min - e, ec
    if eps_max > 0.0:
        stress, _ = envelope(eps_max, c)
        tension_slope = stress / eps_max
    return eps_end, slope, tension_slope


@kernel
def stress_tangent(eps, eps_min, eps_max, eps_end, slope, tension_slope, c):
    """Stress and tangent at a trial strain, memory and what `unloading` made of it given."""
    if eps < eps_min or eps > eps_max:
        return envelope(eps, c)
    if eps >= 0.0:  # also where eps_end > 0 (Ec below the secant fc/eps_0): tension starts from zero strain
        return tension_slope * eps, tension_slope
    if eps < eps_end:
        return slope * (eps - eps_end), slope
    return 0.0, 0.0


@kernel
def commit(eps, eps_min, eps_max):
    """Memory after the strain `eps` has been committed."""
    return min(eps_min, eps), max(eps_max, eps)
