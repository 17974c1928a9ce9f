"""Two isolators on a linear structure, stepped by exponentials.

Everything linear (structure, damping, Maxwell dampers, the rubber's linear term) goes into x' = A x + b a_g + B F,
with F the remaining forces of the two isolators. Between two instants a_g and F are straight lines, so that ::

    x_{n+1} = Phi x_n + G0 a_n + G1 a_{n+1} + H0 F_n + H1 F_{n+1}

exactly (exponential integrator of first-order hold: no step is too long for the linear part). F_{n+1} is what the laws
of `bearings` give at the bearing displacements and velocities y = Q x_{n+1}, two equations in two unknowns for Newton.

The state is kept without its last term, r_n = x_n - H1 F_n: then one step is one product ::

    [r_{n+1}, Q r_{n+1}] = T [r_n, a_n, a_{n+1}, F_n],     T's columns of F: Phi H1 + H0

Source: specs/isolated_bridge.md, section 7; Hochbruck & Ostermann, Exponential integrators, Acta Numerica 19 (2010).
"""

import numpy as np

from .bearings import BOUC_WEN, ELASTIC_PLASTIC, coulomb, elastic_plastic, regularised
from .jit import kernel

__all__ = ["N_OUT", "N_STATES", "step_isolated"]

N_STATES = 12
"""Displacements (5), velocities (5), damper forces (2)."""
N_OUT = 16
"""Rows of the output: the state, the isolators' forces F (2), Z (2)."""


@kernel
def step_isolated(
    step_matrix, end, compliance, ground, weights, n_sub, bearing, c, law, form, tolerance, max_iterations, work, out
):
    """Integrate from rest.

    Parameters
    ----------
    step_matrix : (16, 16) float
        T, transposed: row j holds what input j (r, a_n, a_{n+1}, F) gives to r and Q r.
    end : (12, 2) float
        H1.
    compliance : (4, 2) float
        Q H1: bearing displacements and velocities under F_{n+1}.
    ground : (n_steps,) float
        Base acceleration at the samples of the record [m/s2]; straight lines between.
    weights : (n_steps, 2) float
        Normal load on the bearings at the samples [N].
    n_sub : int
        Steps in one step of the record.
    bearing : (2, 5) float
        f_min [-], df [-], a [s/m], Y [m] and k0 [N/m] of each slider.
    c : float
        sqrt(gamma - beta) of the Bouc-Wen law.
    law : (10,) float
        Rubber, as in `bearings.rubber`.
    form : int
        BOUC_WEN, ELASTIC_PLASTIC, else COULOMB.
    tolerance : float
        Of the last correction of F [N].
    max_iterations : int
        Of Newton.
    work : (2, 16) float
        Memory.
    out : (n_steps, 16) float
        Filled: state, F, Z at the samples of the record.

    Returns
    -------
    (int, int) : 0, or the number of the step (from 1) that did not converge or is not finite; Newton iterations in all.
    """
    u, r = work[0], work[1]
    for i in range(16):
        u[i] = 0.0
        out[0, i] = 0.0
    f0 = f1 = before0 = before1 = 0.0  # F at the last two instants
    z0 = z1 = 0.0
    d0 = d1 = 0.0  # bearing displacements
    c00, c01, c10, c11 = compliance[0, 0], compliance[0, 1], compliance[1, 0], compliance[1, 1]
    s00, s01, s10, s11 = compliance[2, 0], compliance[2, 1], compliance[3, 0], compliance[3, 1]
    # a pull that makes force and velocity alike: the force that the step's compliance takes to change v
    pull0, pull1 = 1.0 / abs(s00), 1.0 / abs(s11)
    iterations = 0
    for k in range(ground.size - 1):
        for sub in range(n_sub):
            at, to = sub / n_sub, (sub + 1) / n_sub
            u[12] = ground[k] + (ground[k + 1] - ground[k]) * at
            u[13] = ground[k] + (ground[k + 1] - ground[k]) * to
            u[14], u[15] = f0, f1
            w0 = weights[k, 0] + (weights[k + 1, 0] - weights[k, 0]) * to
            w1 = weights[k, 1] + (weights[k + 1, 1] - weights[k, 1]) * to
            for i in range(16):
                r[i] = 0.0
            for j in range(0, 16, 4):
                u0, u1, u2, u3 = u[j], u[j + 1], u[j + 2], u[j + 3]
                for i in range(16):
                    r[i] += (step_matrix[j, i] * u0 + step_matrix[j + 1, i] * u1) + (
                        step_matrix[j + 2, i] * u2 + step_matrix[j + 3, i] * u3
                    )
            b0, b1, b2, b3 = r[12], r[13], r[14], r[15]
            n0, n1 = 2.0 * f0 - before0, 2.0 * f1 - before1  # where a straight line leads
            change = np.inf
            iteration = 0
            y0 = y1 = g0 = g1 = 0.0
            while not change <= tolerance:
                if iteration == max_iterations:
                    return k * n_sub + sub + 1, iterations
                iteration += 1
                y0, y1 = b0 + c00 * n0 + c01 * n1, b1 + c10 * n0 + c11 * n1
                v0, v1 = b2 + s00 * n0 + s01 * n1, b3 + s10 * n0 + s11 * n1
                stick0 = stick1 = False
                if form == BOUC_WEN:
                    p0, k0, m0, g0 = regularised(y0 - d0, y0, v0, z0, w0, bearing[0], c, law)
                    p1, k1, m1, g1 = regularised(y1 - d1, y1, v1, z1, w1, bearing[1], c, law)
                elif form == ELASTIC_PLASTIC:
                    p0, k0, m0, g0 = elastic_plastic(y0 - d0, y0, v0, z0, w0, bearing[0], c, law)
                    p1, k1, m1, g1 = elastic_plastic(y1 - d1, y1, v1, z1, w1, bearing[1], c, law)
                else:
                    stick0, p0, k0, m0, g0 = coulomb(n0, y0, v0, pull0, w0, bearing[0], law)
                    stick1, p1, k1, m1, g1 = coulomb(n1, y1, v1, pull1, w1, bearing[1], law)
                # residual and its derivative: F - law(y(F)), or v(F) where a bearing sticks
                if stick0:
                    e0, j00, j01 = v0 * pull0, s00 * pull0, s01 * pull0
                else:
                    e0, j00, j01 = n0 - p0, 1.0 - k0 * c00 - m0 * s00, -k0 * c01 - m0 * s01
                if stick1:
                    e1, j10, j11 = v1 * pull1, s10 * pull1, s11 * pull1
                else:
                    e1, j10, j11 = n1 - p1, -k1 * c10 - m1 * s10, 1.0 - k1 * c11 - m1 * s11
                determinant = j00 * j11 - j01 * j10
                x0 = (e0 * j11 - e1 * j01) / determinant
                x1 = (e1 * j00 - e0 * j10) / determinant
                n0 -= x0
                n1 -= x1
                change = max(abs(x0), abs(x1)) if x0 == x0 and x1 == x1 else np.nan
            iterations += iteration
            # Z and the displacement that it belongs to, both before the last correction: they must not drift apart
            d0, d1, z0, z1 = y0, y1, g0, g1
            before0, before1 = f0, f1
            f0, f1 = n0, n1
            for i in range(12):
                u[i] = r[i]
        for i in range(12):
            out[k + 1, i] = u[i] + end[i, 0] * f0 + end[i, 1] * f1
        out[k + 1, 12], out[k + 1, 13] = f0, f1
        out[k + 1, 14], out[k + 1, 15] = z0, z1
    return 0, iterations
