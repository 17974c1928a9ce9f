"""A column as a chain of force-based elements on a fixed base: state determination and commit.

Nodes are numbered from the base up; each free node has (ux, uy, theta), so that degree of freedom 3 (n-1) is the
lateral displacement of the top of n elements. All that one simulation reads and writes is in one `Column`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import concrete04, fiber_section, reinforcing_steel
from .beam_column import HEAD, PER_SECTION, advance, initialise
from .corotational import add_to_stiffness, deformations
from .jit import kernel

__all__ = ["Column", "allocate", "initialise_column", "assemble", "commit_sections", "release_sections"]

N_VECTORS = 16
LARGEST_AXIAL_STRAIN = 0.2
N_MATRICES = 5


class Column(NamedTuple):
    """Constants and memory of one column, in any consistent units; the arrays are shared with the kernels."""

    length: float  # of one element
    corotational: bool
    element_tolerance: float  # work of the last compatibility correction [force x length]
    points: np.ndarray  # (n_points,) Gauss-Lobatto points on [0, 1]
    tributary: np.ndarray  # (n_elements, n_points) length that each section stands for
    core_count: int  # the first fibers are of the core
    y: np.ndarray  # (n_concrete,), filled up with empty fibers
    area: np.ndarray  # (n_concrete,)
    bar_y: np.ndarray  # (n_bars,), filled up with empty bars
    bar_area: np.ndarray  # (n_bars,)
    concrete: np.ndarray  # (2, concrete04.N_CONSTANTS): core, cover
    steel: np.ndarray  # (reinforcing_steel.N_CONSTANTS,)
    concrete_memory: np.ndarray  # (n_sections, 5, n_concrete)
    steel_memory: np.ndarray  # (n_sections, n_bars, reinforcing_steel.N_STATE)
    virgin: np.ndarray  # (n_sections,)
    element_state: np.ndarray  # (n_elements, HEAD + PER_SECTION n_points)
    initial_flexibility: np.ndarray  # (3,)
    trial: np.ndarray  # scratch of one bar
    work: np.ndarray  # scratch of one element
    vectors: np.ndarray  # (N_VECTORS, n_dof) scratch of the structure
    matrices: np.ndarray  # (N_MATRICES, n_dof, n_dof)
    element_state_before: np.ndarray  # as element_state


def allocate(
    *,
    n_elements: int,
    height: float,
    corotational: bool,
    element_tolerance: float,
    points: np.ndarray,
    weights: np.ndarray,
    core: np.ndarray,
    cover: np.ndarray,
    bars: np.ndarray,
    penetration: float = 0.0,
) -> Column:
    """A `Column` with its memory allocated and its materials still to be set.

    points, weights : (n_points,) Gauss-Lobatto rule on [0, 1]. core, cover, bars : (n, 2) position y and area of the
    fibers. penetration : length below the base over which the deformations of the base section go on (strain of the
    bars in the foundation). Other arguments as in `Column`.
    """
    concrete = _fill_up(np.concatenate([core, cover]), 16)
    padded_bars = _fill_up(bars, 8)
    n_sections = n_elements * len(points)
    n_state = HEAD + PER_SECTION * len(points)
    length = height / n_elements
    tributary = np.tile(np.asarray(weights, dtype=float) * length, (n_elements, 1))
    tributary[0, 0] += penetration
    return Column(
        length=length,
        corotational=bool(corotational),
        element_tolerance=float(element_tolerance),
        points=np.ascontiguousarray(points, dtype=float),
        tributary=tributary,
        core_count=len(core),
        y=np.ascontiguousarray(concrete[:, 0], dtype=float),
        area=np.ascontiguousarray(concrete[:, 1], dtype=float),
        bar_y=np.ascontiguousarray(padded_bars[:, 0], dtype=float),
        bar_area=np.ascontiguousarray(padded_bars[:, 1], dtype=float),
        concrete=np.zeros((2, concrete04.N_CONSTANTS)),
        steel=np.zeros(reinforcing_steel.N_CONSTANTS),
        concrete_memory=np.zeros((n_sections, 5, len(concrete))),
        steel_memory=np.zeros((n_sections, len(bars), reinforcing_steel.N_STATE)),
        virgin=np.zeros(n_sections),
        element_state=np.zeros((n_elements, n_state)),
        initial_flexibility=np.zeros(3),
        trial=np.zeros(reinforcing_steel.N_STATE),
        work=np.zeros((2, n_state)),
        vectors=np.zeros((N_VECTORS, 3 * n_elements)),
        matrices=np.zeros((N_MATRICES, 3 * n_elements, 3 * n_elements)),
        element_state_before=np.zeros((n_elements, n_state)),
    )


def _fill_up(fibers: np.ndarray, multiple: int) -> np.ndarray:
    """`fibers` (n, 2) with empty ones appended, to a multiple that fills SIMD registers."""
    return np.concatenate([fibers, np.zeros((-len(fibers) % multiple, 2))])


@kernel
def initialise_column(column):
    """Virgin materials, unloaded elements."""
    fiber_section.reset(column.core_count, column.concrete, column.concrete_memory, column.steel_memory, column.virgin)
    k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0
    for i in range(column.y.shape[0]):
        ea = column.concrete[0 if i < column.core_count else 1, concrete04.EC] * column.area[i]
        k_axial += ea
        k_coupling -= ea * column.y[i]
        k_bending += ea * column.y[i] * column.y[i]
    for i in range(column.bar_y.shape[0]):
        ea = column.steel[reinforcing_steel.E0] * column.bar_area[i]
        k_axial += ea
        k_coupling -= ea * column.bar_y[i]
        k_bending += ea * column.bar_y[i] * column.bar_y[i]
    d = k_axial * k_bending - k_coupling * k_coupling
    column.initial_flexibility[0] = k_bending / d
    column.initial_flexibility[1] = -k_coupling / d
    column.initial_flexibility[2] = k_axial / d
    for e in range(column.element_state.shape[0]):
        initialise(column.element_state[e], column.points, column.tributary[e], column.initial_flexibility)


@kernel(inline=True)
def assemble(u, column, force, stiffness):
    """Restoring forces (n,) and tangent (n, n) at the displacements `u` (n,); False when an element fails.

    An element that has become a fifth shorter or longer has lost its meaning, whatever its materials still carry: a
    crushed column would otherwise "find equilibrium" on its bars at half its length.
    """
    n = u.shape[0]
    for i in range(n):
        force[i] = 0.0
        for k in range(n):
            stiffness[i, k] = 0.0
    for e in range(column.element_state.shape[0]):
        first = 3 * e - 3
        j = first + 3
        dux, duy, theta_i = u[j], u[j + 1], 0.0
        if first >= 0:
            dux -= u[first]
            duy -= u[first + 1]
            theta_i = u[first + 2]
        v1, v2, v3, c, s, chord = deformations(dux, duy, theta_i, u[j + 2], column.length, column.corotational)
        if not abs(v1) < LARGEST_AXIAL_STRAIN * column.length:
            return False
        converged = advance(
            v1,
            v2,
            v3,
            e,
            column.element_state,
            column.work,
            column.points,
            column.tributary,
            column.initial_flexibility,
            column.element_tolerance,
            column.core_count,
            column.y,
            column.area,
            column.concrete,
            column.concrete_memory,
            column.bar_y,
            column.bar_area,
            column.steel,
            column.steel_memory,
            column.virgin,
            column.trial,
        )
        if not converged:
            return False
        state = column.element_state
        add_to_stiffness(
            first,
            state[e, 0],
            state[e, 1],
            state[e, 2],
            state[e, 3],
            state[e, 4],
            state[e, 5],
            state[e, 6],
            state[e, 7],
            state[e, 8],
            c,
            s,
            chord,
            column.corotational,
            force,
            stiffness,
        )
    return True


@kernel(inline=True)
def commit_sections(column):
    """Advance the memory of every fiber to the strains of the last trial."""
    n_points = column.points.shape[0]
    for e in range(column.element_state.shape[0]):
        for m in range(n_points):
            k = HEAD + PER_SECTION * m
            fiber_section.commit(
                column.element_state[e, k],
                column.element_state[e, k + 1],
                e * n_points + m,
                column.core_count,
                column.y,
                column.concrete,
                column.concrete_memory,
                column.bar_y,
                column.steel,
                column.steel_memory,
                column.virgin,
            )


@kernel
def release_sections(column):
    """Take every fiber on the verge of a jump of its stress across it (`fiber_section.release`); how many."""
    n_points = column.points.shape[0]
    count = 0
    for e in range(column.element_state.shape[0]):
        for m in range(n_points):
            k = HEAD + PER_SECTION * m
            count += fiber_section.release(
                column.element_state[e, k],
                column.element_state[e, k + 1],
                e * n_points + m,
                column.core_count,
                column.y,
                column.concrete,
                column.concrete_memory,
                column.bar_y,
                column.steel,
                column.steel_memory,
                column.virgin,
            )
    return count
