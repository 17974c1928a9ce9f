"""Transformation between the end displacements of an upright beam and its basic deformations.

The basic deformations v = (elongation, theta_i, theta_j) remain when the rigid motion of the chord is removed from the
displacements u of both ends. The end forces are p = T' Q with T = dv/du, and the stiffness is T'KT + Kg with the
geometric part Kg = dT'/du Q::

    lx = L + d_uy,   ly = -d_ux,   Ln = sqrt(lx^2 + ly^2),   c = lx/Ln,   s = ly/Ln,   alpha = atan2(ly, lx)
    v = (Ln - L, theta_i - alpha, theta_j - alpha)

The undeformed chord of a column points along global +Y, so that local x = +Y and local y = -X. The two rotational rows
of T have the same translational part, and the translations of the two ends enter with opposite signs. Two vectors
therefore hold all of T: one along the chord (ax, ay) and one along its normal (nx, ny).

The linear variant uses the direction and the length of the undeformed chord and no Kg.
``docs/theory/beam_column.rst`` derives the matrices.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .jit import kernel

__all__ = ["Chord", "deformations", "add_to_stiffness"]


class Chord(NamedTuple):
    """Deformations and chord of one element."""

    elongation: float  # [m]
    theta_i: float  # rotation of an end against the chord [rad]
    theta_j: float  # [rad]
    c: float  # direction cosines of the chord against +Y
    s: float
    length: float  # of the deformed chord, or of the undeformed chord in the linear variant [m]


@kernel
def deformations(dux, duy, theta_i, theta_j, length, corotational):
    """Return the `Chord` of an element.

    Parameters
    ----------
    dux, duy : float
        Displacements of end J relative to end I [m].
    theta_i, theta_j : float
        Rotations of the ends [rad].
    length : float
        Length of the undeformed element [m].
    corotational : bool
        False for the linear variant.
    """
    if not corotational:
        alpha = -dux / length
        return Chord(duy, theta_i - alpha, theta_j - alpha, 1.0, 0.0, length)
    lx = length + duy
    ly = -dux
    chord = math.sqrt(lx * lx + ly * ly)
    alpha = math.atan2(ly, lx)
    # chord - length, written without cancellation
    elongation = (2.0 * length * duy + duy * duy + ly * ly) / (chord + length)
    return Chord(elongation, theta_i - alpha, theta_j - alpha, lx / chord, ly / chord, chord)


@kernel(inline=True)
def add_to_stiffness(first, basic, direction, corotational, force, stiffness):
    """Add the end forces and the tangent of one element to `force` (n,) and `stiffness` (n, n) of the structure, in
    place.

    `first` is the number of the degree of freedom ux at end I; -3 at the fixed base, where only end J is free. The
    geometric stiffness is added if `corotational`. `basic` begins like a row of `beam_column.Elements.state`: axial
    force [N] and end moments [N m], and the upper half of their derivatives by elongation [m] and rotations [rad].
    """
    q1, q2, q3 = basic[0], basic[1], basic[2]
    k11, k12, k13, k22, k23, k33 = basic[3], basic[4], basic[5], basic[6], basic[7], basic[8]
    c, s, chord = direction.c, direction.s, direction.length
    ax, ay = -s, c
    nx, ny = c / chord, s / chord
    axial_i = k12
    normal_i = k22 + k23
    axial_j = k13
    normal_j = k23 + k33
    a = k12 + k13
    b = k22 + 2.0 * k23 + k33
    xx = k11 * ax * ax + 2.0 * a * ax * nx + b * nx * nx
    xy = k11 * ax * ay + a * (ax * ny + nx * ay) + b * nx * ny
    yy = k11 * ay * ay + 2.0 * a * ay * ny + b * ny * ny
    if corotational:
        g = q1 / chord
        h = (q2 + q3) / (chord * chord)
        # local (x, y) = global (uy, -ux)
        xx += g * c * c + h * 2.0 * c * s
        xy += g * c * s - h * (c * c - s * s)
        yy += g * s * s - h * 2.0 * c * s
    xi = ax * axial_i + nx * normal_i
    yi = ay * axial_i + ny * normal_i
    xj = ax * axial_j + nx * normal_j
    yj = ay * axial_j + ny * normal_j
    px = ax * q1 + nx * (q2 + q3)
    py = ay * q1 + ny * (q2 + q3)

    j = first + 3
    force[j] += px
    force[j + 1] += py
    force[j + 2] += q3
    stiffness[j, j] += xx
    stiffness[j, j + 1] += xy
    stiffness[j, j + 2] += xj
    stiffness[j + 1, j] += xy
    stiffness[j + 1, j + 1] += yy
    stiffness[j + 1, j + 2] += yj
    stiffness[j + 2, j] += xj
    stiffness[j + 2, j + 1] += yj
    stiffness[j + 2, j + 2] += k33
    if first >= 0:
        i = first
        force[i] -= px
        force[i + 1] -= py
        force[i + 2] += q2
        stiffness[i, i] += xx
        stiffness[i, i + 1] += xy
        stiffness[i, i + 2] -= xi
        stiffness[i + 1, i] += xy
        stiffness[i + 1, i + 1] += yy
        stiffness[i + 1, i + 2] -= yi
        stiffness[i + 2, i] -= xi
        stiffness[i + 2, i + 1] -= yi
        stiffness[i + 2, i + 2] += k22
        stiffness[i, j] -= xx
        stiffness[i, j + 1] -= xy
        stiffness[i, j + 2] -= xj
        stiffness[i + 1, j] -= xy
        stiffness[i + 1, j + 1] -= yy
        stiffness[i + 1, j + 2] -= yj
        stiffness[i + 2, j] += xi
        stiffness[i + 2, j + 1] += yi
        stiffness[i + 2, j + 2] += k23
        stiffness[j, i] -= xx
        stiffness[j + 1, i] -= xy
        stiffness[j + 2, i] -= xj
        stiffness[j, i + 1] -= xy
        stiffness[j + 1, i + 1] -= yy
        stiffness[j + 2, i + 1] -= yj
        stiffness[j, i + 2] += xi
        stiffness[j + 1, i + 2] += yi
        stiffness[j + 2, i + 2] += k23
