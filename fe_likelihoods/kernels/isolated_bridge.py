"""Two isolators on a linear structure, integrated by an exponential method.

All linear parts (structure, damping, Maxwell dampers, linear term of the rubber) form x' = A x + b a_g + B F, where F
are the remaining forces of the two isolators. With a_g and F linear within a step, the step is exact::

    x_{n+1} = Phi x_n + G0 a_n + G1 a_{n+1} + H0 F_n + H1 F_{n+1}

This is an exponential integrator with a first-order hold. The linear part is stable for steps of any length. F_{n+1}
has to satisfy the laws of `bearings` at the bearing displacements and velocities y = Q x_{n+1}; Newton's method solves
these two equations.

The set-valued law of Coulomb needs several kinds of steps (`StepMatrices`). A step in which a bearing begins or ceases
to stick is halved until the instant is known within h/64.

The recursion is written for r_n = x_n - H1 F_n, so that one step is one product::

    [r_{n+1}, Q r_{n+1}] = T [r_n, a_n, a_{n+1}, F_n],     the columns of T for F_n contain Phi H1 + H0

``docs/theory/time_integration.rst`` derives the scheme, ``docs/theory/isolated_bridge.rst`` the equations of motion.
"""

from typing import NamedTuple

import numpy as np

from .bearings import BOUC_WEN, COULOMB, RubberLaw, Slider, coulomb, regularised
from .jit import kernel

__all__ = ["N_OUT", "N_STATES", "Isolators", "StepMatrices", "step_isolated"]

N_STATES = 12
"""Displacements (5), velocities (5), damper forces (2)."""
N_OUT = 16
"""Columns of the output: the state, the isolator forces F (2), Z (2)."""


class StepMatrices(NamedTuple):
    """Matrices of the linear part for one kind of step or several.

    One kind is the step h with F linear in time. Several kinds are those of Coulomb's law: for each of the steps h,
    h/2, h/4 and so on four kinds, with F constant at both bearings, linear at the first, linear at the second, and
    linear at both. Row j of T transposed holds the contribution of input j of (r, a_n, a_{n+1}, F) to r and Q r.
    """

    transposed: np.ndarray  # (n_kinds, 16, 16)
    end: np.ndarray  # (n_kinds, 12, 2) H1
    compliance: np.ndarray  # (n_kinds, 4, 2) Q H1, bearing displacements and velocities under F_{n+1}


class Isolators(NamedTuple):
    """Nonlinear laws of the isolators at the two piers."""

    sliders: tuple[Slider, Slider]
    rubber: RubberLaw  # the same at both piers
    c: float  # sqrt(gamma - beta) of the Bouc-Wen law
    form: int  # `BOUC_WEN` or `COULOMB`


@kernel(inline=True)
def _mode(z):
    """Return -1, 0 or 1: whether a bearing with the value `z` of Coulomb's law slides backwards, sticks or slides."""
    return -1 if z <= -1.0 else (1 if z >= 1.0 else 0)


@kernel(inline=True)
def _changes(before, after, size, last_size):
    """Return whether a bearing changes between sticking and sliding within a step, from its values of Z.

    The force of a bearing that sticks is the mean over the step. At the end of the step it is extrapolated from the
    mean, or from the end of sliding, before.
    """
    mode = _mode(before)
    if _mode(after) != mode:
        return True
    if mode != 0:
        return False
    return abs(after + (after - before) * size / (last_size + size)) > 1.0


@kernel(inline=True)
def _change_kind(r, f0, f1, end, other):
    """Write r of another kind of step: x does not change."""
    for i in range(12):
        r[i] += (end[i, 0] - other[i, 0]) * f0 + (end[i, 1] - other[i, 1]) * f1


@kernel
def step_isolated(matrices, isolators, ground, weights, n_sub, tolerance, max_iterations, work, out):
    """Integrate from rest.

    Parameters
    ----------
    matrices : StepMatrices
    isolators : Isolators
    ground : ndarray (n_steps,)
        Base acceleration at the samples of the record, linear between them [m/s²].
    weights : ndarray (n_steps, 2)
        Load on the bearings at the samples, linear between them [N]. While it is negative, the bearing carries no load.
    n_sub : int
        Integration steps per step of the record, without halved steps.
    tolerance : float
        Largest last correction of F [N].
    max_iterations : int
        Newton iterations per step.
    work : ndarray (2, 16)
        Scratch.
    out : ndarray (n_steps, 16)
        Written: state, F and Z at the samples of the record.

    Returns
    -------
    status : int
        0, or the number (from 1) of the step that did not converge or is not finite, halved steps not counted.
    """
    step_matrices, ends, compliances = matrices.transposed, matrices.end, matrices.compliance
    n_halvings = max(0, step_matrices.shape[0] // 4 - 1)
    kind = 0  # of the step to which r belongs
    slider0, slider1 = isolators.sliders
    c, law, form = isolators.c, isolators.rubber, isolators.form
    u, r = work[0], work[1]
    out[0, :] = 0.0
    u[:] = 0.0
    f0 = f1 = before0 = before1 = 0.0  # F at the last two instants
    z0 = z1 = 0.0
    d0 = d1 = 0.0  # bearing displacements
    total = n_sub << n_halvings
    for k in range(ground.size - 1):
        position, halvings = 0, 0  # in the sample interval, in steps of the smallest size; of the present step
        last_size = 1 << n_halvings
        while position < total:
            # F is linear in time while a bearing slides, and constant while it sticks or at the instant of a change
            wanted = 0
            if form == COULOMB:
                wanted = 4 * halvings
                if halvings < n_halvings:
                    wanted += (1 if _mode(z0) != 0 else 0) + (2 if _mode(z1) != 0 else 0)
            if wanted != kind:
                _change_kind(u, f0, f1, ends[kind], ends[wanted])
                kind = wanted
            step_matrix, compliance = step_matrices[kind], compliances[kind]
            c00, c01, c10, c11 = compliance[0, 0], compliance[0, 1], compliance[1, 0], compliance[1, 1]
            s00, s01, s10, s11 = compliance[2, 0], compliance[2, 1], compliance[3, 0], compliance[3, 1]
            # factor that turns a velocity into a force: the change of F that changes v by one within the step
            pull0, pull1 = 1.0 / abs(s00), 1.0 / abs(s11)
            size = 1 << (n_halvings - halvings)
            at, to = position / total, (position + size) / total
            u[12] = ground[k] + (ground[k + 1] - ground[k]) * at
            u[13] = ground[k] + (ground[k + 1] - ground[k]) * to
            u[14], u[15] = f0, f1
            # limited at this instant, not at the samples: between samples of opposite sign it is zero for a part
            w0 = max(0.0, weights[k, 0] + (weights[k + 1, 0] - weights[k, 0]) * to)
            w1 = max(0.0, weights[k, 1] + (weights[k + 1, 1] - weights[k, 1]) * to)
            for i in range(16):
                r[i] = 0.0
            for j in range(0, 16, 4):
                u0, u1, u2, u3 = u[j], u[j + 1], u[j + 2], u[j + 3]
                for i in range(16):
                    r[i] += (step_matrix[j, i] * u0 + step_matrix[j + 1, i] * u1) + (
                        step_matrix[j + 2, i] * u2 + step_matrix[j + 3, i] * u3
                    )
            b0, b1, b2, b3 = r[12], r[13], r[14], r[15]
            n0, n1 = 2.0 * f0 - before0, 2.0 * f1 - before1  # linear extrapolation as the first guess
            change = np.inf
            iteration = 0
            y0 = y1 = g0 = g1 = 0.0
            while not change <= tolerance and iteration < max_iterations:
                iteration += 1
                y0, y1 = b0 + c00 * n0 + c01 * n1, b1 + c10 * n0 + c11 * n1
                v0, v1 = b2 + s00 * n0 + s01 * n1, b3 + s10 * n0 + s11 * n1
                stick0 = stick1 = False
                if form == BOUC_WEN:
                    p0, k0, m0, g0 = regularised(y0 - d0, y0, v0, z0, w0, slider0, c, law)
                    p1, k1, m1, g1 = regularised(y1 - d1, y1, v1, z1, w1, slider1, c, law)
                else:
                    stick0, p0, k0, m0, g0 = coulomb(n0, y0, v0, pull0, w0, slider0, law)
                    stick1, p1, k1, m1, g1 = coulomb(n1, y1, v1, pull1, w1, slider1, law)
                # residual F - law(y(F)), or v(F) where a bearing sticks, and its derivatives
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
            converged = change <= tolerance
            if halvings < n_halvings:
                # half of a step in which a bearing begins or ceases to stick
                if not converged or _changes(z0, g0, size, last_size) or _changes(z1, g1, size, last_size):
                    halvings += 1
                    continue
            if not converged:
                return k * n_sub + (position >> n_halvings) + 1
            position += size
            last_size = size
            # Z and its displacement are both kept from before the last correction, so that they stay consistent
            d0, d1, z0, z1 = y0, y1, g0, g1
            before0, before1 = f0, f1
            f0, f1 = n0, n1
            for i in range(12):
                u[i] = r[i]
            while halvings > 0 and position % (1 << (n_halvings - halvings + 1)) == 0:
                halvings -= 1
        if kind != 0:
            _change_kind(u, f0, f1, ends[kind], ends[0])
            kind = 0
        for i in range(12):
            out[k + 1, i] = u[i] + ends[0, i, 0] * f0 + ends[0, i, 1] * f1
        out[k + 1, 12], out[k + 1, 13] = f0, f1
        out[k + 1, 14], out[k + 1, 15] = z0, z1
    return 0
