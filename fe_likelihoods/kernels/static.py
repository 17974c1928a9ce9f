"""Static analysis of a column: gravity, and reversed lateral displacement imposed at the top.

Newton on equilibrium with the tangent; where a lateral displacement is imposed, the row of that degree of freedom is
replaced by its increment, and the force it takes is the restoring force there. A step that does not converge is
retried with a tolerance a hundred times looser, then halved, and what was committed before stays; at the smallest part,
fibers on the verge of a jump of their stress are taken across it (`fiber_section.release`).

References: specs/bridge_column.md, sections 1, 8 and 9.
"""

from __future__ import annotations

import math

from .beam_column import HEAD
from .frame import assemble, commit_sections, initialise_column, release_sections
from .jit import kernel
from .linear_solve import copy_matrix, copy_vector, solve_banded

__all__ = ["GRAVITY_STEPS", "LOOSER", "MAX_RELEASES", "equilibrate", "apply_gravity", "impose_displacement"]

GRAVITY_STEPS = 10
LOOSER = 100.0
MAX_RELEASES = 20


@kernel
def equilibrate(column, u, load, imposed, increment, force, stiffness, tolerance, max_iterations):
    """Newton iterations to equilibrium with `load` (n,), in place; False when they fail, everything put back.

    imposed : degree of freedom that moves by `increment` whatever force it takes, or -1. On entry `force` and
    `stiffness` belong to `u`; on success they belong to the new `u` and the fibers are committed.
    """
    n = u.shape[0]
    du, u_before, force_before = column.vectors[0], column.vectors[1], column.vectors[2]
    matrix, stiffness_before = column.matrices[0], column.matrices[1]
    copy_vector(u, u_before)
    copy_vector(force, force_before)
    copy_matrix(stiffness, stiffness_before)
    copy_matrix(column.element_state, column.element_state_before)
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
    copy_vector(u_before, u)
    copy_vector(force_before, force)
    copy_matrix(stiffness_before, stiffness)
    copy_matrix(column.element_state_before, column.element_state)
    return False


@kernel
def _advance_to(
    column, u, load, total, share, imposed, increment, force, stiffness, tolerance, max_iterations, halvings
):
    """Add `share` of the load `total` and an imposed displacement, halved where it does not converge.

    Returns the number of retries, or -1 when it failed.
    """
    done, part, retries, releases = 0.0, 1.0, 0, 0
    smallest = 0.5**halvings
    while done < 1.0:
        for i in range(u.shape[0]):
            load[i] += part * share * total[i]
        move = part * increment
        converged = equilibrate(column, u, load, imposed, move, force, stiffness, tolerance, max_iterations)
        if not converged:
            retries += 1
            converged = equilibrate(
                column, u, load, imposed, move, force, stiffness, LOOSER * tolerance, max_iterations
            )
        if converged:
            done += part
            continue
        for i in range(u.shape[0]):
            load[i] -= part * share * total[i]
        part *= 0.5
        if part < smallest:
            releases += 1
            if releases > MAX_RELEASES or release_sections(column) == 0:
                return -1
            part = 1.0 - done
    return retries


@kernel
def apply_gravity(column, u, gravity, force, stiffness, tolerance, max_iterations, halvings):
    """Virgin column under `gravity` (n,) in ten equal steps; number of retries, or -1 when it failed."""
    initialise_column(column)
    load = column.vectors[3]
    for i in range(u.shape[0]):
        u[i] = 0.0
        load[i] = 0.0
    assemble(u, column, force, stiffness)
    total = 0
    for _ in range(GRAVITY_STEPS):
        retries = _advance_to(
            column,
            u,
            load,
            gravity,
            1.0 / GRAVITY_STEPS,
            -1,
            0.0,
            force,
            stiffness,
            tolerance,
            max_iterations,
            halvings,
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
    u, force, load = column.vectors[4], column.vectors[5], column.vectors[3]
    stiffness = column.matrices[2]
    retries = apply_gravity(column, u, gravity, force, stiffness, tolerance, max_iterations, halvings)
    if retries < 0:
        return -1, 0
    top = gravity.shape[0] - 3
    for step in range(targets.shape[0]):
        increment = targets[step] - u[top]
        if increment != 0.0:
            more = _advance_to(
                column,
                u,
                load,
                gravity,
                0.0,
                top,
                increment,
                force,
                stiffness,
                tolerance,
                max_iterations,
                halvings,
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
