"""Static analysis of a column: gravity, and a lateral displacement imposed at the top.

Newton's method on the equilibrium of forces, K du = load - force(u), with the tangent K. The increment of an imposed
displacement replaces the row of its degree of freedom, and the required force is the restoring force there. A step that
does not converge is repeated with a tolerance a hundred times larger if its iteration has reached this tolerance, then
halved. At the smallest part of a step, fibers next to a stress jump are taken across the jump
(`fiber_section.cross_jumps`). If this does not help, the column may have lost the axial load: after many bars have
fractured, the others yield in compression while the cracks are open. The top is then lowered until the cracks close and
the load is carried again.

``docs/theory/time_integration.rst`` describes the steps and the retries.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .frame import (
    Column,
    Recorder,
    assemble,
    bars_have_fractured,
    commit_sections,
    cross_jumps,
    initialise_column,
    record,
    record_forces,
    recorder,
)
from .jit import kernel
from .linear_solve import copy_matrix, copy_vector, solve_banded

__all__ = [
    "GRAVITY_STEPS",
    "LOOSENING",
    "LOWERING",
    "MAX_CROSSINGS",
    "MAX_LOWERINGS",
    "Iteration",
    "Position",
    "equilibrate",
    "apply_gravity",
    "impose_displacement",
    "lower",
]

GRAVITY_STEPS = 10
LOOSENING = 100.0
"""Factor on the tolerance when a step is repeated."""
MAX_CROSSINGS = 20
"""How often stress jumps may be crossed in one step."""
LOWERING = 1e-5
"""Share of the height by which the top is lowered at a time if the column does not carry the axial load."""
MAX_LOWERINGS = 1000
"""How often the top is lowered in succession before the column counts as collapsed."""
_AT_REST = np.zeros(GRAVITY_STEPS)
_AT_REST.flags.writeable = False  # the type of the targets that models pass; another one would be compiled again


class Iteration(NamedTuple):
    """Settings of Newton's method."""

    tolerance: float  # norm of the last correction [m and rad]
    max_iterations: int  # of one attempt
    halvings: int  # how often a step may be halved


class Position(NamedTuple):
    """Displacements of the structure, with their forces and tangent."""

    u: np.ndarray  # (n,) [m and rad]
    force: np.ndarray  # (n,) restoring [N and N m]
    stiffness: np.ndarray  # (n, n)


@kernel
def equilibrate(column, position, load, imposed, increment, held, tolerance, max_iterations):
    """Iterate to equilibrium with a load, in place.

    Parameters
    ----------
    column : Column
    position : Position
        Consistent on entry, and on return in either case.
    load : ndarray (n,)
        [N and N m]
    imposed : int
        Degree of freedom that moves by `increment`, whatever force it takes; -1 for none.
    increment : float
        [m or rad]
    held : int
        Another degree of freedom, which does not move; -1 for none.
    tolerance : float
        Norm of the last correction [m and rad].
    max_iterations : int

    Returns
    -------
    float
        Smallest norm of a correction that all elements could follow. Below `tolerance`, the position is in equilibrium
        and the fibers are committed. Otherwise nothing has changed, and a tolerance above this norm is reached.
    """
    u, force, stiffness = position.u, position.force, position.stiffness
    n = u.shape[0]
    du, u_before, force_before = column.vectors[0], column.vectors[1], column.vectors[2]
    matrix, stiffness_before = column.matrices[0], column.matrices[1]
    copy_vector(u, u_before)
    copy_vector(force, force_before)
    copy_matrix(stiffness, stiffness_before)
    copy_matrix(column.elements.state, column.state_before)
    step, least = increment, math.inf
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
        if held >= 0:
            for i in range(n):
                matrix[i, held] = 0.0
                matrix[held, i] = 0.0
            matrix[held, held] = 1.0
            du[held] = 0.0
        solve_banded(matrix, du)
        norm = 0.0
        for i in range(n):
            u[i] += du[i]
            norm += du[i] * du[i]
        if not math.isfinite(norm) or not assemble(u, column, force, stiffness, False):
            break
        least = min(least, math.sqrt(norm))
        if least < tolerance:
            commit_sections(column)
            return least
    copy_vector(u_before, u)
    copy_vector(force_before, force)
    copy_matrix(stiffness_before, stiffness)
    copy_matrix(column.state_before, column.elements.state)
    return least


@kernel
def lower(column, position, load, imposed, iteration):
    """Lower the top until the column carries the axial load again, in place; the imposed displacement is held.

    Each position on the way is an equilibrium with a smaller axial load, and the fibers are committed there. The load
    comes down slowly, without the inertia of a fall. False if no bar has fractured, if the first lowered position
    carries the load (which was not lost then), or if it is never carried again: the column then stays where it is.
    """
    vertical = imposed + 1
    if load[vertical] == 0.0 or not bars_have_fractured(column):
        return False
    downwards = math.copysign(1.0, load[vertical])
    move = downwards * LOWERING * column.length * column.elements.state.shape[0]
    tolerance, max_iterations = LOOSENING * iteration.tolerance, iteration.max_iterations
    for count in range(MAX_LOWERINGS):
        if equilibrate(column, position, load, vertical, move, imposed, tolerance, max_iterations) >= tolerance:
            return False
        if downwards * position.force[vertical] >= downwards * load[vertical]:
            if count == 0:
                return False
            return equilibrate(column, position, load, imposed, 0.0, -1, tolerance, max_iterations) < tolerance
    return False


@kernel
def _static_steps(column, total, share, imposed, targets, iteration, history, out):
    """Add `share` of the load `total` (n,) at each target, in halved steps if they do not converge.

    The degree of freedom `imposed` moves to the targets from an equilibrium. With -1, none moves, the column is made
    virgin first, and nothing is recorded. Other arguments and result are as in `impose_displacement`.
    """
    if imposed < 0:
        initialise_column(column)
    load, u, force = column.vectors[3], column.vectors[4], column.vectors[5]
    position = Position(u, force, column.matrices[2])
    smallest, max_iterations = 0.5**iteration.halvings, iteration.max_iterations
    retries, lowerings = 0, 0
    for step in range(targets.shape[0]):
        increment = targets[step] - u[imposed] if imposed >= 0 else 0.0
        done, part, crossings = 0.0, 1.0, 0
        while done < 1.0 and (imposed < 0 or increment != 0.0):
            for i in range(load.shape[0]):
                load[i] += part * share * total[i]
            move = part * increment
            tolerance = iteration.tolerance
            reached = equilibrate(column, position, load, imposed, move, -1, tolerance, max_iterations)
            if reached >= tolerance:
                retries += 1
                tolerance *= LOOSENING
                if reached < tolerance:
                    reached = equilibrate(column, position, load, imposed, move, -1, tolerance, max_iterations)
            if reached < tolerance:
                done += part
                continue
            for i in range(load.shape[0]):
                load[i] -= part * share * total[i]
            part *= 0.5
            if part < smallest:
                crossings += 1
                if crossings > MAX_CROSSINGS:
                    return step + 1, retries, lowerings
                if cross_jumps(column) == 0:
                    if imposed < 0 or not lower(column, position, load, imposed, iteration):
                        return step + 1, retries, lowerings
                    lowerings += 1
                part = 1.0 - done
        if imposed >= 0:
            history[0, step] = u[imposed]
            history[1, step] = u[imposed + 1]
            history[2, step] = u[imposed + 2]
            record_forces(column, force, history[3:, step])
            record(column, u, u, u, step, out)
    return 0, retries, lowerings


def apply_gravity(column: Column, gravity: np.ndarray, iteration: Iteration) -> int:
    """Make the column virgin and apply the load `gravity` (n,) [N and N m] in ten equal steps.

    Returns the number of retries, or -1 on failure. Displacements, forces and tangent are in ``column.vectors[4]``,
    ``column.vectors[5]`` and ``column.matrices[2]``.
    """
    nothing = np.zeros((9, 0)), recorder(column)
    status, retries, _ = _static_steps(column, gravity, 1.0 / GRAVITY_STEPS, -1, _AT_REST, iteration, *nothing)
    return -1 if status else retries


def impose_displacement(
    column: Column,
    gravity: np.ndarray,
    targets: np.ndarray,
    iteration: Iteration,
    history: np.ndarray,
    out: Recorder,
) -> tuple[int, int, int]:
    """Apply gravity, then move the top laterally through `targets`.

    Parameters
    ----------
    column : Column
    gravity : ndarray (n,)
        Load [N and N m].
    targets : ndarray (n_steps,)
        Lateral displacement of the top [m].
    iteration : Iteration
    history : ndarray (9, n_steps)
        Written: ux, uy and theta of the top, then `frame.record_forces`.
    out : frame.Recorder
        Written at the same steps, without velocities and accelerations.

    Returns
    -------
    status : int
        0 on success, -1 when gravity failed, k > 0 when step k failed.
    retries : int
    lowerings : int
        How often the top was lowered until the axial load was carried again.
    """
    retries = apply_gravity(column, gravity, iteration)
    if retries < 0:
        return -1, 0, 0
    found = _static_steps(column, gravity, 0.0, len(gravity) - 3, targets, iteration, history, out)
    return found[0], retries + found[1], found[2]
