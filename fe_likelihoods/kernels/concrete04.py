"""Concrete: Popovics' envelope, Karsan and Jirsa's unloading, exponential tension softening.

Compression is negative. The memory of a fiber is (eps_min, eps_max), the extreme strains committed so far::

    eps < eps_min            sigma = fc eta r / (r - 1 + eta^r)   down to eps_cu, then 0
                             eta = eps/eps_0,  r = Ec/(Ec - fc/eps_0)
    eps_min <= eps < eps_end sigma = slope (eps - eps_end)        unloading towards the plastic strain
    eps_end <= eps < 0       sigma = 0                            open crack that has not closed yet
    0 <= eps <= eps_max      sigma = (sigma_env(eps_max)/eps_max) eps
    eps > eps_max            sigma = Ec eps                                    up to eps_ct = ft/Ec
                             sigma = ft beta^((eps-eps_ct)/(eps_tu-eps_ct))    up to eps_tu, then 0

The stress is a single-valued function of the strain and of the memory. It does not depend on the direction of loading,
and a trial evaluation changes nothing. A section can therefore evaluate its fibers side by side (SIMD).

OpenSees has the same law as its material Concrete04. ``docs/theory/concrete.rst`` derives it.
"""

from __future__ import annotations

import math

from .jit import kernel

__all__ = [
    "N_CONSTANTS",
    "constants",
    "unloading",
    "envelope",
    "stress_tangent",
    "commit",
]

# Layout of the concrete constants.
FC, E0, ECU, EC, FT, ETU, BETA, ESEC, R, ECT, DECAY = range(11)
N_CONSTANTS = 11


@kernel
def constants(fc, e0, ecu, ec, ft, etu, beta, out):
    """Fill `out` with the constants of one concrete.

    Parameters
    ----------
    fc, e0, ecu : float
        Compressive strength [Pa], strain at the strength and crushing strain, all negative.
    ec : float
        Initial modulus [Pa].
    ft : float
        Tensile strength [Pa].
    etu : float
        Strain at which tension ends.
    beta : float
        Share of `ft` that is left at `etu`.
    out : ndarray (N_CONSTANTS,)
        Overwritten. Any other consistent stress unit serves as well.
    """
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
    """Return stress and tangent of the envelope at strain `eps`, in compression or tension."""
    if eps <= 0.0:
        if eps < c[ECU]:
            return 0.0, 0.0
        r = c[R]
        eta = eps / c[E0]
        power = eta * eta if r == 2.0 else eta**r
        if power > 1e150:  # occurs for r = 400 only, where the square of `power` would overflow to NaN
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
    """Return eps_end and slope of unloading from compression, and the secant slope of unloading from tension.

    The plastic strain over eps_0 is 0.145 eta^2 + 0.13 eta for eta < 2, and 0.707 (eta - 2) + 0.834 beyond (Karsan &
    Jirsa 1969). The slope never exceeds Ec.
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
    """Return stress and tangent at the trial strain `eps`.

    The arguments after `eps` are the memory and the values that `unloading` derives from the memory.
    """
    if eps < eps_min or eps > eps_max:
        return envelope(eps, c)
    if eps >= 0.0:  # tested before eps_end, which is positive where Ec < fc/eps_0: tension starts from zero strain
        return tension_slope * eps, tension_slope
    if eps < eps_end:
        return slope * (eps - eps_end), slope
    return 0.0, 0.0


@kernel
def commit(eps, eps_min, eps_max):
    """Return the memory after the strain `eps` has been committed."""
    return min(eps_min, eps), max(eps_max, eps)
