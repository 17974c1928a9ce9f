"""Static analysis of a column: gravity, and reversed lateral displacement imposed at the top.

Newton on equilibrium with the tangent; where a lateral displacement is imposed, the row of that degree of freedom is
replaced by its increment, and the force it takes is the restoring force there. A step that does not converge is
retried with a tolerance a hundred times looser, then halved, and what was committed before stays.

References: specs/bridge_column.md, sections 1, 8 and 9.
"""

from __future__ import annotations

import math

import numpy as np

from .frame import assemble, commit_sections, initialise_column
from .beam_column import HEAD
from .jit import kernel
from .linear_solve import solve_banded

__all__ = ["GRAVITY_STEPS", "LOOSER", "equilibrate", "apply_gravity", "impose_displacement"]

GRAVITY_STEPS = 10
LOOSER = 100.0


@kernel
def equilibrate(column, u, load, imposed, increment, force, stiffness, tolerance, max_iterations):
    """Newton iterations to equilibrium with `load` (n,), in place; False when they fail, everything put back.

    imposed : degree of freedom that moves by `increment` whatever force it takes, or -1. On entry `force` and
    `stiffness` belong to `u`; on success they belong to the new `u` and the fibers are committed.
    """
    n = u.shape[0]
    u_before = u.copy()
    state_before = column.element_state.copy()
    force_before = force.copy()
    stiffness_before = stiffness.copy()
    matrix = np.empty((n, n))
    du = np.empty(n)
    step = increment
    for _ in range(max_iterations):
        for i in range(n):
            du[i] = load[i] - force[i]
            for k in range(n):
                matrix[i, k] = stiffness[i, k]
        if imposed >= 0:
            for i in range(n):
                du[i] -= matrix[i, imposed] * step
                matrix[i, imposed] = 0.0
                matrix[imposed, i] = 0.0
            matrix[imposed, imposed] = 1.0
            du[imposed] = step
            step = 0.0
        solve_banded(matrix, du)
        norm = 0.0
        for i in range(n):
            u[i] += du[i]
            norm += du[i] * du[i]
        if not math.isfinite(norm) or not assemble(u, column, force, stiffness):
            break
        if math.sqrt(norm) < tolerance:
            commit_sections(column)
            return True
    u[:] = u_before
    column.element_state[:] = state_before
    force[:] = force_before
    stiffness[:] = stiffness_before
    return False


@kernel
def _advance_to(column, u, load, load_step, imposed, increment, force, stiffness, tolerance, max_iterations, halvings):
    """One step of load and of imposed displacement, halved where it does not converge; number of retries, -1 failed."""
    done, part, retries = 0.0, 1.0, 0
    start = load.copy()
    smallest = 0.5**halvings
    while done < 1.0:
        load[:] = start + (done + part) * load_step
        move = part * increment
        if not equilibrate(column, u, load, imposed, move, force, stiffness, tolerance, max_iterations):
            retries += 1
            if not equilibrate(column, u, load, imposed, move, force, stiffness, LOOSER * tolerance, max_iterations):
                part *= 0.5
                if part < smallest:
                    return -1
                continue
        done += part
    return retries


@kernel
def apply_gravity(column, u, gravity, force, stiffness, tolerance, max_iterations, halvings):
    """Virgin column under `gravity` (n,) in ten equal steps; number of retries, or -1 when it failed."""
    initialise_column(column)
    u[:] = 0.0
    assemble(u, column, force, stiffness)
    load = np.zeros_like(gravity)
    total = 0
    for _ in range(GRAVITY_STEPS):
        retries = _advance_to(
            column, u, load, gravity / GRAVITY_STEPS, -1, 0.0, force, stiffness, tolerance, max_iterations, halvings
        )
        if retries < 0:
            return -1
        total += retries
    return total


@kernel
def impose_displacement(column, gravity, targets, tolerance, max_iterations, halvings, history):
    """Gravity, then the lateral displacement of the top through `targets` (n_steps,); 0 or (-1 gravity, k step failed).

    history : (8, n_steps) out: ux, uy, theta of the top, lateral force, and e0, kappa, N, M of the base section.
    Returns (status, retries): status 0 when all went well, -1 when gravity failed, k > 0 when step k failed.
    """
    n = gravity.shape[0]
    u = np.zeros(n)
    force = np.zeros(n)
    stiffness = np.zeros((n, n))
    retries = apply_gravity(column, u, gravity, force, stiffness, tolerance, max_iterations, halvings)
    if retries < 0:
        return -1, 0
    top = n - 3
    load = gravity.copy()
    none = np.zeros(n)
    for step in range(targets.shape[0]):
        increment = targets[step] - u[top]
        if increment != 0.0:
            more = _advance_to(
                column, u, load, none, top, increment, force, stiffness, tolerance, max_iterations, halvings
            )
            if more < 0:
                return step + 1, retries
            retries += more
        history[0, step] = u[top]
        history[1, step] = u[top + 1]
        history[2, step] = u[top + 2]
        history[3, step] = force[top]
        history[4, step] = column.element_state[0, HEAD]
        history[5, step] = column.element_state[0, HEAD + 1]
        history[6, step] = column.element_state[0, HEAD + 5]
        history[7, step] = column.element_state[0, HEAD + 6]
    return 0, retries
