"""From the displacements of an upright beam's ends to its basic deformations and back (corotational or linear).

Basic deformations v = (elongation, theta_i, theta_j) are what remains after the rigid motion of the chord is taken
away; p = T' Q are the end forces, T = dv/du, and the stiffness is T'KT + Kg with the geometric part Kg = dT'/du Q.
In a column the undeformed chord points along global +Y, so that local x = +Y and local y = -X. Both rows of T that
belong to rotations share their translational part, and the translations of the two ends enter with opposite signs:
one 2-vector each for the chord (`axial`) and for its normal (`normal`) holds all of T.

The linear variant is the same with the direction and length of the undeformed chord and no Kg.

References: specs/bridge_column.md, section 6.
"""

from __future__ import annotations

import math

from .jit import kernel

__all__ = ["deformations", "add_to_stiffness"]


@kernel
def deformations(dux, duy, theta_i, theta_j, length, corotational):
    """Basic deformations, direction cosines (c, s) of the chord against +Y and its length.

    dux, duy : displacements of end J minus those of end I.
    """
    if not corotational:
        alpha = -dux / length
        return duy, theta_i - alpha, theta_j - alpha, 1.0, 0.0, length
    lx = length + duy
    ly = -dux
    chord = math.sqrt(lx * lx + ly * ly)
    alpha = math.atan2(ly, lx)
    # chord - length without cancellation
    elongation = (2.0 * length * duy + duy * duy + ly * ly) / (chord + length)
    return elongation, theta_i - alpha, theta_j - alpha, lx / chord, ly / chord, chord


@kernel(inline=True)
def add_to_stiffness(
    first, q1, q2, q3, k11, k12, k13, k22, k23, k33, c, s, chord, corotational, force, stiffness
):  # fmt: skip
    """Add the end forces and the tangent of one element to the structure, in place.

    `first` is the degree of freedom of end I's ux (-3 at the fixed base: only end J is free). (q1, q2, q3) and k are
    the basic forces and stiffness.
    """
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
