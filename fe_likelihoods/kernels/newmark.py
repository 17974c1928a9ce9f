"""Response of a column to base acceleration: Newmark's average acceleration with Newton iterations.

The equation of motion relative to the base, with C = a0 M + a1 Kc and the tangent Kc (geometric part included) of the
last committed step, is::

    M A + C V + p(U) = P - M r ag(t),       gamma = 1/2, beta = 1/4

A step of size h starts from the committed (U, V, A) with U unchanged, V <- -V and A <- -A - 4 V/h. Each iteration
solves (K + 2/h C + 4/h^2 M) dU = residual and sets U += dU, V += 2 dU/h, A += 4 dU/h^2, until ``|dU|`` < tolerance.

A step that fails is repeated with a tolerance a hundred times larger if its iteration has reached this tolerance, then
halved repeatedly (ground acceleration linear within the step), down to h / 2^halvings. If the smallest step fails too,
there may be no equilibrium before some fibers have crossed a stress jump, and these fibers are taken across the jump
(`fiber_section.cross_jumps`). The retries are counted. A step that still fails ends the run, which returns its number.
No step is accepted unconverged.

Energies are summed by the trapezoidal rule. Average acceleration then balances them exactly up to the tolerance:
kinetic + damped + absorbed = input.

``docs/theory/time_integration.rst`` derives the scheme.

References
----------
N. M. Newmark, A method of computation for structural dynamics, Journal of the Engineering Mechanics Division 85(3),
1959, doi:10.1061/JMCEA3.0000098.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .beam_column import HEAD
from .frame import assemble, commit_sections, cross_jumps, record
from .jit import kernel
from .linear_solve import copy_matrix, solve_banded
from .static import LOOSENING, MAX_CROSSINGS, Position, apply_gravity

__all__ = ["HISTORY_ROWS", "Dynamics", "newmark"]

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
    "base shear",
)


class Dynamics(NamedTuple):
    """Loads, inertia and damping of a column."""

    gravity: np.ndarray  # (n_dof,) static load [N and N m]
    mass: np.ndarray  # (n_dof,) diagonal of the mass matrix [kg and kg m²]
    a0: float  # Rayleigh damping: factor of the mass [1/s]
    a1: float  # factor of the committed tangent stiffness [s]
    velocity: float  # initial, of the top along x [m/s]
    collapse: float = math.inf  # lateral displacement of the top [m] beyond which the analysis ends


@kernel(inline=True)
def _record_forces(column, force, out):
    """Write forces to `out` (6,): restoring force at the top, e0, kappa, N and M of the base section, base shear.

    The base shear is the restoring force that the column transmits to its base: no load acts between its ends, so it is
    the sum of the nodal forces `force` (n_dof,) along x.
    """
    state = column.elements.state
    out[0] = force[force.shape[0] - 3]
    out[1] = state[0, HEAD]
    out[2] = state[0, HEAD + 1]
    out[3] = state[0, HEAD + 5]
    out[4] = state[0, HEAD + 6]
    shear = 0.0
    for i in range(0, force.shape[0], 3):
        shear += force[i]
    out[5] = shear


@kernel
def newmark(column, dynamics, ground, dt, every, iteration, history, out):
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
    history : ndarray (13, n_recorded)
        Written; rows as in `HISTORY_ROWS`.
    out : frame.Recorder
        Written at the same samples.

    Returns
    -------
    status : int
        0 on success, -1 when gravity failed, k when step k failed, -1 - k when the column had collapsed after step k.
    retries, iterations : int
    """
    gravity, mass, a0, a1 = dynamics.gravity, dynamics.mass, dynamics.a0, dynamics.a1
    initial_velocity = dynamics.velocity
    tolerance, max_iterations, halvings = iteration.tolerance, iteration.max_iterations, iteration.halvings
    n = gravity.shape[0]
    rows = column.vectors
    u, v, a, force, damping, du = rows[4], rows[5], rows[6], rows[7], rows[8], rows[9]
    u_old, v_old, a_old, force_old, damping_old = rows[10], rows[11], rows[12], rows[13], rows[14]
    # the static steps of gravity use matrices[1] and vectors[:4]
    matrix, stiffness, committed, base = column.matrices[0], column.matrices[2], column.matrices[3], column.matrices[4]
    top = n - 3
    retries = apply_gravity(column, Position(u, force, stiffness), gravity, iteration)
    if retries < 0:
        return -1, 0, 0
    for i in range(n):
        v[i] = 0.0
        a[i] = 0.0
    v[top] = initial_velocity
    copy_matrix(stiffness, committed)  # Kc
    for i in range(n):  # C V at the last committed instant
        damping[i] = a0 * mass[i] * v[i]
        for k in range(n):
            damping[i] += a1 * committed[i, k] * v[k]
    kinetic = supplied = 0.5 * mass[top] * initial_velocity * initial_velocity
    damped = absorbed = 0.0
    history[0, 0] = u[top]
    history[1, 0] = a[top] + ground[0]
    history[2, 0] = u[top + 1]
    history[3, 0] = kinetic
    history[4, 0] = damped
    history[5, 0] = absorbed
    history[6, 0] = supplied
    _record_forces(column, force, history[7:, 0])
    record(column, u, v, a, 0, out)
    smallest = 0.5**halvings
    total_iterations = 0

    for step in range(1, ground.shape[0]):
        done, part, loose, crossings = 0.0, 1.0, False, 0
        while done < 1.0:
            h = part * dt
            at_start = ground[step - 1] + done * (ground[step] - ground[step - 1])
            at_end = ground[step - 1] + (done + part) * (ground[step] - ground[step - 1])
            limit = LOOSENING * tolerance if loose else tolerance
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
            copy_matrix(column.elements.state, column.state_before)

            converged, least = False, math.inf
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
        if abs(u[top]) > dynamics.collapse:
            return -1 - step, retries, total_iterations
        if step % every == 0:
            m = step // every
            history[0, m] = u[top]
            history[1, m] = a[top] + ground[step]
            history[2, m] = u[top + 1]
            history[3, m] = kinetic
            history[4, m] = damped
            history[5, m] = absorbed
            history[6, m] = supplied
            _record_forces(column, force, history[7:, m])
            record(column, u, v, a, m, out)
    return 0, retries, total_iterations
