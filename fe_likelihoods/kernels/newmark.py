"""Response of a column to base acceleration: Newmark's average acceleration with Newton iterations.

Equation of motion relative to the base, C = a0 M + a1 Kc with the tangent Kc (geometric part included) of the last
committed step::

    M A + C V + p(U) = P - M r ag(t),       gamma = 1/2, beta = 1/4

From the committed (U, V, A) a step of size h starts with U unchanged, V <- -V, A <- -A - 4 V/h, and each iteration
solves (K + 2/h C + 4/h^2 M) dU = residual, then U += dU, V += 2 dU/h, A += 4 dU/h^2, until ``|dU|`` < tolerance.

A step that fails is retried with a tolerance a hundred times looser, then halved (ground acceleration linear within the
step), again and again down to h / 2^halvings. Where that fails too, fibers on the verge of a jump of their stress are
taken across it (`fiber_section.release`), as there may be no equilibrium before they are. The retries are counted, and
a step that still fails ends the run with its number. Nothing is ever carried on unconverged.

Energy is summed by the trapezoidal rule, with which average acceleration balances exactly up to the tolerance:
kinetic + damped + absorbed = input.

References: Newmark (1959), J. Eng. Mech. Div. ASCE 85(EM3); specs/bridge_column.md, sections 7 and 9.
"""

from __future__ import annotations

import math

from .beam_column import HEAD
from .frame import assemble, commit_sections, release_sections
from .jit import kernel
from .linear_solve import copy_matrix, solve_banded
from .static import LOOSER, MAX_RELEASES, apply_gravity

__all__ = ["HISTORY_ROWS", "newmark"]

HISTORY_ROWS = (
    "relative displacement",
    "absolute acceleration",
    "vertical displacement",
    "kinetic energy",
    "damped energy",
    "absorbed energy",
    "input energy",
    "force",
    "base axial strain",
    "base curvature",
    "base axial force",
    "base moment",
)


@kernel(inline=True)
def _record_forces(column, force, out):
    """Restoring force of the top, and e0, kappa, N, M of the base section, into `out` (5,)."""
    out[0] = force
    out[1] = column.element_state[0, HEAD]
    out[2] = column.element_state[0, HEAD + 1]
    out[3] = column.element_state[0, HEAD + 5]
    out[4] = column.element_state[0, HEAD + 6]


@kernel
def newmark(
    column, gravity, mass, a0, a1, ground, dt, tolerance, max_iterations, halvings, every, initial_velocity, history
):
    """Gravity, then base acceleration `ground` (n,) at steps of `dt` along x.

    gravity, mass : (n_dof,) static load and diagonal mass. every : one sample in `every` steps is kept.
    initial_velocity : of the top, along x. history : (12, n_kept) out, rows as HISTORY_ROWS.
    Returns (status, retries, iterations): status 0 when all went well, -1 when gravity failed, k when step k failed.
    """
    n = gravity.shape[0]
    rows = column.vectors
    u, v, a, force, damping, du = rows[4], rows[5], rows[6], rows[7], rows[8], rows[9]
    u_old, v_old, a_old, force_old, damping_old = rows[10], rows[11], rows[12], rows[13], rows[14]
    # matrices[1] and vectors[:4] are scratch of the static steps of gravity
    matrix, stiffness, committed, base = column.matrices[0], column.matrices[2], column.matrices[3], column.matrices[4]
    retries = apply_gravity(column, u, gravity, force, stiffness, tolerance, max_iterations, halvings)
    if retries < 0:
        return -1, 0, 0
    top = n - 3
    for i in range(n):
        v[i] = 0.0
        a[i] = 0.0
    v[top] = initial_velocity
    copy_matrix(stiffness, committed)  # Kc
    for i in range(n):  # C V at the last committed instant
        damping[i] = a0 * mass[i] * v[i]
        for k in range(n):
            damping[i] += a1 * committed[i, k] * v[k]
    smallest = 0.5**halvings
    total_iterations = 0
    damped = 0.0
    absorbed = 0.0
    supplied = 0.0
    kinetic = 0.5 * mass[top] * initial_velocity * initial_velocity
    supplied = kinetic
    history[0, 0] = u[top]
    history[1, 0] = a[top] + ground[0]
    history[2, 0] = u[top + 1]
    history[3, 0] = kinetic
    history[4, 0] = 0.0
    history[5, 0] = 0.0
    history[6, 0] = supplied
    _record_forces(column, force[top], history[7:, 0])

    for step in range(1, ground.shape[0]):
        done, part, loose, releases = 0.0, 1.0, False, 0
        while done < 1.0:
            h = part * dt
            at_start = ground[step - 1] + done * (ground[step] - ground[step - 1])
            at_end = ground[step - 1] + (done + part) * (ground[step] - ground[step - 1])
            limit = LOOSER * tolerance if loose else tolerance
            for i in range(n):
                u_old[i] = u[i]
                v_old[i] = v[i]
                a_old[i] = a[i]
                force_old[i] = force[i]
                damping_old[i] = damping[i]
                v[i] = -v_old[i]
                a[i] = -a_old[i] - 4.0 / h * v_old[i]
                for k in range(n):
                    base[i, k] = 2.0 / h * a1 * committed[i, k]
                base[i, i] += (2.0 / h * a0 + 4.0 / (h * h)) * mass[i]
            copy_matrix(column.element_state, column.element_state_before)

            converged = False
            for _ in range(max_iterations):
                total_iterations += 1
                for i in range(n):
                    r = gravity[i] - force[i] - mass[i] * (a[i] + a0 * v[i])
                    for k in range(n):
                        r -= a1 * committed[i, k] * v[k]
                        matrix[i, k] = stiffness[i, k] + base[i, k]
                    if i % 3 == 0:
                        r -= mass[i] * at_end
                    du[i] = r
                solve_banded(matrix, du)
                norm = 0.0
                for i in range(n):
                    u[i] += du[i]
                    v[i] += 2.0 / h * du[i]
                    a[i] += 4.0 / (h * h) * du[i]
                    norm += du[i] * du[i]
                if not math.isfinite(norm):
                    break
                if not assemble(u, column, force, stiffness):
                    break
                if math.sqrt(norm) < limit:
                    converged = True
                    break

            if not converged:
                retries += 1
                for i in range(n):
                    u[i] = u_old[i]
                    v[i] = v_old[i]
                    a[i] = a_old[i]
                    force[i] = force_old[i]
                copy_matrix(committed, stiffness)
                copy_matrix(column.element_state_before, column.element_state)
                if not loose:
                    loose = True
                    continue
                loose = False
                part *= 0.5
                if part < smallest:
                    releases += 1
                    if releases > MAX_RELEASES or release_sections(column) == 0:
                        return step, retries, total_iterations
                    part = 1.0 - done
                continue

            kinetic = 0.0
            for i in range(n):
                damping[i] = a0 * mass[i] * v[i]
                for k in range(n):
                    damping[i] += a1 * committed[i, k] * v[k]
                moved = u[i] - u_old[i]
                kinetic += 0.5 * mass[i] * v[i] * v[i]
                damped += 0.5 * (damping_old[i] + damping[i]) * moved
                absorbed += (0.5 * (force_old[i] + force[i]) - gravity[i]) * moved
                if i % 3 == 0:
                    supplied -= 0.5 * mass[i] * (at_start + at_end) * moved
            commit_sections(column)
            copy_matrix(stiffness, committed)
            done += part
            loose = False
        if step % every == 0:
            m = step // every
            history[0, m] = u[top]
            history[1, m] = a[top] + ground[step]
            history[2, m] = u[top + 1]
            history[3, m] = kinetic
            history[4, m] = damped
            history[5, m] = absorbed
            history[6, m] = supplied
            _record_forces(column, force[top], history[7:, m])
    return 0, retries, total_iterations
