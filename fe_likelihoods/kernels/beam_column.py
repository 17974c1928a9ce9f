"""Force-based beam-column element: exact equilibrium along the element, compatibility by iteration.

The basic forces Q = (N, Mi, Mj) determine the section forces without approximation, b(xi) Q with N = Q1 and
M = (xi - 1) Q2 + xi Q3. The section deformations e, with section flexibilities f, integrate to the basic deformations::

    v = integral b' e dx,    F = integral b' f b dx,    K = F^-1

The integrals use Gauss-Lobatto points, which include both ends. For new deformations v, the element adds K times the
compatibility residual to Q until the work of this correction is below a tolerance (Neuenhofer & Filippou 1997). Q, K
and the section states are kept from one global iteration to the next.

Softening concrete makes sections locally unstable, and this iteration sometimes fails. The element then tries, in this
order: the initial section flexibilities in every pass; the initial section flexibilities in the first pass only; a
tenth of the increment at a time, up to four times in succession. If all attempts fail, the element reports failure.
``docs/theory/beam_column.rst`` has the equations.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .fiber_section import forces
from .jit import kernel

__all__ = ["HEAD", "PER_SECTION", "Elements", "initialise", "advance"]

# State of one element: Q (3), K = K11 K12 K13 K22 K23 K33 (6), v (3), then e0, kappa, flexibility f11 f12 f22, N and M
# of each section.
HEAD = 12
PER_SECTION = 7

MAX_PASSES = 10
MAX_PASSES_INITIAL = 100
MAX_SUBDIVISIONS = 4
MAX_ATTEMPTS = 130
"""Passes over the sections in all attempts together: one round of the three schemes, and ten more."""
MAX_RISES = 3
"""An attempt has failed when its error has increased tenfold this often: its passes go round in a circle."""


class Elements(NamedTuple):
    """Constants and state of all elements in a column."""

    points: np.ndarray  # (n_points,) Gauss-Lobatto points on [0, 1]
    tributary: np.ndarray  # (n_elements, n_points) length of each section: its weight times the element length [m]
    initial_flexibility: np.ndarray  # (3,) f11, f12, f22 of the virgin section
    tolerance: float  # largest work of the last compatibility correction [J]
    state: np.ndarray  # (n_elements, HEAD + PER_SECTION n_points)
    work: np.ndarray  # (HEAD + PER_SECTION n_points,) scratch


@kernel
def _invert(f11, f12, f13, f22, f23, f33):
    """Invert a symmetric 3 x 3 matrix, given by its upper half; return the upper half of the inverse."""
    c11 = f22 * f33 - f23 * f23
    c12 = f13 * f23 - f12 * f33
    c13 = f12 * f23 - f13 * f22
    d = f11 * c11 + f12 * c12 + f13 * c13
    r = 1.0 / d
    return (
        c11 * r,
        c12 * r,
        c13 * r,
        (f11 * f33 - f13 * f13) * r,
        (f12 * f13 - f11 * f23) * r,
        (f11 * f22 - f12 * f12) * r,
    )


@kernel
def initialise(element, elements):
    """Write the unloaded elastic state of row `element` of the state, in place."""
    state, points, tributary = elements.state[element], elements.points, elements.tributary[element]
    state[:] = 0.0
    a, b, c = elements.initial_flexibility
    f11 = f12 = f13 = f22 = f23 = f33 = 0.0
    for m in range(points.shape[0]):
        xi, w = points[m], tributary[m]
        k = HEAD + PER_SECTION * m
        state[k + 2], state[k + 3], state[k + 4] = a, b, c
        f11 += a * w
        f12 += b * (xi - 1.0) * w
        f13 += b * xi * w
        f22 += c * (xi - 1.0) * (xi - 1.0) * w
        f23 += c * (xi - 1.0) * xi * w
        f33 += c * xi * xi * w
    state[3], state[4], state[5], state[6], state[7], state[8] = _invert(f11, f12, f13, f22, f23, f33)


@kernel(inline=True)
def advance(v1, v2, v3, element, elements, sections, linear):
    """Bring row `element` of the state to the basic deformations (v1, v2, v3), in place; return whether it converged.

    v1 is the elongation [m], v2 and v3 are rotations of the two ends against the chord [rad]. If `linear`, sections
    follow their last tangent, without an evaluation of fibers. On failure the row has the last state that was reached.
    """
    points, tributary, state, work = elements.points, elements.tributary, elements.state, elements.work
    initial_flexibility = elements.initial_flexibility
    n_points = points.shape[0]
    n_state = HEAD + PER_SECTION * n_points
    rest1 = v1 - state[element, 9]
    rest2 = v2 - state[element, 10]
    rest3 = v3 - state[element, 11]
    if math.sqrt(rest1 * rest1 + rest2 * rest2 + rest3 * rest3) <= 2.2e-16:
        return True
    i11, i12, i22 = initial_flexibility[0], initial_flexibility[1], initial_flexibility[2]
    part1, part2, part3 = rest1, rest2, rest3
    scheme = 0
    subdivision = 0
    passes = 0
    rises, last_error = 0, math.inf
    for k in range(n_state):
        work[k] = state[element, k]
    target1, target2, target3 = v1, v2, v3
    work[0] += work[3] * part1 + work[4] * part2 + work[5] * part3
    work[1] += work[4] * part1 + work[6] * part2 + work[7] * part3
    work[2] += work[5] * part1 + work[7] * part2 + work[8] * part3
    # Each turn of this loop is one pass over the sections. Schemes and subdivisions share the loop, so that the inlined
    # code of the section appears once.
    for _ in range(MAX_ATTEMPTS):
        use_initial = scheme == 1 or (scheme == 2 and passes == 0)
        q1, q2, q3 = work[0], work[1], work[2]
        f11 = f12 = f13 = f22 = f23 = f33 = 0.0
        r1, r2, r3 = target1, target2, target3
        for m in range(n_points):
            xi, w = points[m], tributary[element, m]
            k = HEAD + PER_SECTION * m
            a, b, c = work[k + 2], work[k + 3], work[k + 4]
            if use_initial:
                a, b, c = i11, i12, i22
            section_n = q1
            section_m = (xi - 1.0) * q2 + xi * q3
            dn = section_n - work[k + 5]
            dm = section_m - work[k + 6]
            e0 = work[k] + a * dn + b * dm
            kappa = work[k + 1] + b * dn + c * dm
            n, moment = section_n, section_m
            if not linear:
                n, moment, k_axial, k_coupling, k_bending = forces(e0, kappa, element * n_points + m, sections)
                if not use_initial:
                    d = 1.0 / (k_axial * k_bending - k_coupling * k_coupling)
                    a, b, c = k_bending * d, -k_coupling * d, k_axial * d
            work[k] = e0
            work[k + 1] = kappa
            work[k + 2] = a
            work[k + 3] = b
            work[k + 4] = c
            work[k + 5] = n
            work[k + 6] = moment
            dn = section_n - n
            dm = section_m - moment
            g0 = (e0 + a * dn + b * dm) * w
            g1 = (kappa + b * dn + c * dm) * w
            r1 -= g0
            r2 -= (xi - 1.0) * g1
            r3 -= xi * g1
            f11 += a * w
            f12 += b * (xi - 1.0) * w
            f13 += b * xi * w
            f22 += c * (xi - 1.0) * (xi - 1.0) * w
            f23 += c * (xi - 1.0) * xi * w
            f33 += c * xi * xi * w
        k11, k12, k13, k22, k23, k33 = _invert(f11, f12, f13, f22, f23, f33)
        d1 = k11 * r1 + k12 * r2 + k13 * r3
        d2 = k12 * r1 + k22 * r2 + k23 * r3
        d3 = k13 * r1 + k23 * r2 + k33 * r3
        work[0] = q1 + d1
        work[1] = q2 + d2
        work[2] = q3 + d3
        error = abs(r1 * d1 + r2 * d2 + r3 * d3)
        passes += 1
        if error > 10.0 * last_error:
            rises += 1
        last_error = error
        if error < elements.tolerance:
            work[3], work[4], work[5] = k11, k12, k13
            work[6], work[7], work[8] = k22, k23, k33
            work[9], work[10], work[11] = target1, target2, target3
            rest1 -= part1
            rest2 -= part2
            rest3 -= part3
            for k in range(n_state):
                state[element, k] = work[k]
            if subdivision == 0:  # this part was all that remained
                return True
            part1, part2, part3 = rest1, rest2, rest3
            scheme, subdivision = 0, 0
        else:
            limit = MAX_PASSES_INITIAL if scheme == 1 else MAX_PASSES
            if passes < limit and rises < MAX_RISES and math.isfinite(error):
                continue
            if scheme < 2:
                scheme += 1
            else:
                if subdivision == MAX_SUBDIVISIONS:
                    return False
                subdivision += 1
                scheme = 0
                part1, part2, part3 = 0.1 * part1, 0.1 * part2, 0.1 * part3
        # The next attempt starts from the last state that was reached.
        passes, rises, last_error = 0, 0, math.inf
        for k in range(n_state):
            work[k] = state[element, k]
        if subdivision == 0:
            target1, target2, target3 = v1, v2, v3
        else:
            target1, target2, target3 = work[9] + part1, work[10] + part2, work[11] + part3
        work[0] += work[3] * part1 + work[4] * part2 + work[5] * part3
        work[1] += work[4] * part1 + work[6] * part2 + work[7] * part3
        work[2] += work[5] * part1 + work[7] * part2 + work[8] * part3
    return False
