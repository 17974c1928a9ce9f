"""Response of a column to base acceleration: Newmark's average acceleration with Newton iterations.

The equation of motion relative to the base, with C = a0 M + a1 Kc and the tangent Kc (geometric part included) of the
last committed step, is::

    M A + C V + p(U) = P - M r ag(t),       gamma = 1/2, beta = 1/4

A step of size h starts from the committed (U, V, A) with U unchanged, V <- -V and A <- -A - 4 V/h. Each iteration
solves (K + 2/h C + 4/h^2 M) dU = residual and sets U += dU, V += 2 dU/h, A += 4 dU/h^2, until ``|dU|`` < tolerance.
After a later dU below a hundredth of the tolerance, the sections follow their tangents and no fiber is evaluated.

A step that fails is repeated with a tolerance a hundred times larger if its iteration has reached this tolerance, then
halved repeatedly (ground acceleration linear within the step), down to h / 2^halvings. If the smallest step fails too,
there may be no equilibrium before some fibers have crossed a stress jump, and these fibers are taken across the jump
(`fiber_section.cross_jumps`). The retries are counted. A step that still fails ends the run, which returns its number.
No step is accepted unconverged.

``docs/theory/time_integration.rst`` derives the scheme.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .frame import Column, Recorder, assemble, commit_sections, cross_jumps, record, record_forces
from .jit import kernel
from .linear_solve import copy_matrix, solve_banded
from .static import LOOSENING, MAX_CROSSINGS, Iteration, apply_gravity

__all__ = ["HISTORY_ROWS", "Dynamics", "newmark"]

HISTORY_ROWS = (
    "relative displacement",
    "absolute acceleration",
    "vertical displacement",
    "force",
    "base axial strain",
    "base curvature",
    "base axial force",
    "base moment",
    "base shear",
)


class Dynamics(NamedTuple):
    """Loads, inertia and damping of a column."""

    gravity: np.ndarray  # (n_dof,) static load [N and N m]
    mass: np.ndarray  # (n_dof,) diagonal of the mass matrix [kg and kg m²]
    a0: float  # Rayleigh damping: factor of the mass [1/s]
    a1: float  # factor of the committed tangent stiffness [s]
    collapse: float = math.inf  # lateral displacement of the top [m] beyond which the analysis ends


@kernel
def _integrate(column, dynamics, ground, dt, every, iteration, history, out):
    """Integrate from equilibrium under gravity; arguments and result as for `newmark`."""
    gravity, mass, a0, a1 = dynamics.gravity, dynamics.mass, dynamics.a0, dynamics.a1
    tolerance, max_iterations, halvings = iteration.tolerance, iteration.max_iterations, iteration.halvings
    n = gravity.shape[0]
    rows = column.vectors
    u, force, v, a, du = rows[4], rows[5], rows[6], rows[7], rows[8]
    u_old, v_old, a_old, force_old = rows[9], rows[10], rows[11], rows[12]
    matrix, stiffness, committed = column.matrices[0], column.matrices[2], column.matrices[3]
    top = n - 3
    for i in range(n):
        v[i] = 0.0
        a[i] = 0.0
    copy_matrix(stiffness, committed)  # Kc
    history[0, 0] = u[top]
    history[1, 0] = a[top] + ground[0]
    history[2, 0] = u[top + 1]
    record_forces(column, force, history[3:, 0])
    record(column, u, v, a, 0, out)
    smallest = 0.5**halvings
    retries = 0

    for step in range(1, ground.shape[0]):
        done, part, loose, crossings = 0.0, 1.0, False, 0
        while done < 1.0:
            h = part * dt
            at_end = ground[step - 1] + (done + part) * (ground[step] - ground[step - 1])
            limit = LOOSENING * tolerance if loose else tolerance
            for i in range(n):
                u_old[i] = u[i]
                v_old[i] = v[i]
                a_old[i] = a[i]
                force_old[i] = force[i]
                v[i] = -v_old[i]
                a[i] = -a_old[i] - 4.0 / h * v_old[i]
            copy_matrix(column.elements.state, column.state_before)

            converged, least = False, math.inf
            for count in range(max_iterations):
                for i in range(n):
                    r = gravity[i] - force[i] - mass[i] * (a[i] + a0 * v[i])
                    for k in range(n):
                        r -= a1 * committed[i, k] * v[k]
                        matrix[i, k] = stiffness[i, k] + 2.0 / h * a1 * committed[i, k]
                    matrix[i, i] += (2.0 / h * a0 + 4.0 / (h * h)) * mass[i]
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
                linear = count > 0 and LOOSENING * math.sqrt(norm) < limit
                if not assemble(u, column, force, stiffness, linear):
                    break
                least = min(least, math.sqrt(norm))
                if least < limit:
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
                copy_matrix(column.state_before, column.elements.state)
                # The repetition takes the same path: it converges where this one was below the larger tolerance.
                if not loose and least < LOOSENING * tolerance:
                    loose = True
                    continue
                loose = False
                part *= 0.5
                if part < smallest:
                    crossings += 1
                    if crossings > MAX_CROSSINGS or cross_jumps(column) == 0:
                        return step, retries
                    part = 1.0 - done
                continue

            commit_sections(column)
            copy_matrix(stiffness, committed)
            done += part
            loose = False
        if abs(u[top]) > dynamics.collapse:
            return -1 - step, retries
        if step % every == 0:
            m = step // every
            history[0, m] = u[top]
            history[1, m] = a[top] + ground[step]
            history[2, m] = u[top + 1]
            record_forces(column, force, history[3:, m])
            record(column, u, v, a, m, out)
    return 0, retries


def newmark(
    column: Column,
    dynamics: Dynamics,
    ground: np.ndarray,
    dt: float,
    every: int,
    iteration: Iteration,
    history: np.ndarray,
    out: Recorder,
) -> tuple[int, int]:
    """Apply gravity, then the base acceleration `ground` along x.

    Parameters
    ----------
    column : Column
    dynamics : Dynamics
    ground : ndarray (n_steps,)
        Base acceleration [m/s²].
    dt : float
        Step [s].
    every : int
        One sample in `every` steps is recorded.
    iteration : static.Iteration
    history : ndarray (9, n_recorded)
        Written; rows as in `HISTORY_ROWS`.
    out : frame.Recorder
        Written at the same samples.

    Returns
    -------
    status : int
        0 on success, -1 when gravity failed, k when step k failed, -1 - k when the column had collapsed after step k.
    retries : int
    """
    retries = apply_gravity(column, dynamics.gravity, iteration)
    if retries < 0:
        return -1, 0
    status, more = _integrate(column, dynamics, ground, dt, every, iteration, history, out)
    return status, retries + more
