"""A column as a chain of force-based elements on a fixed base: restoring forces, tangent and commit.

Nodes are numbered from the base up. Each free node has (ux, uy, theta), so that the degree of freedom 3 (n - 1) is the
lateral displacement at the top of n elements. A `Column` holds everything that one simulation reads and writes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from . import bar_fatigue, concrete04, fiber_section, reinforcing_steel
from .bars import N_PATH
from .beam_column import HEAD, PER_SECTION, Elements, advance, initialise
from .corotational import add_to_stiffness, deformations
from .fiber_section import Sections
from .jit import kernel

__all__ = [
    "Column",
    "Recorder",
    "allocate",
    "initialise_column",
    "assemble",
    "commit_sections",
    "cross_jumps",
    "bars_have_fractured",
    "record",
    "record_forces",
    "recorder",
]

LARGEST_AXIAL_STRAIN = 0.2
"""An element that becomes longer or shorter by more than this share of its length has failed."""

N_VECTORS = 13
N_MATRICES = 4


class Column(NamedTuple):
    """Constants and memory of one column, in any consistent units; the kernels change the arrays in place."""

    length: float  # of one element [m]
    corotational: bool  # False for linear geometry
    sections: Sections  # fibers and their memory
    elements: Elements  # elements and their state
    state_before: np.ndarray  # scratch like elements.state
    vectors: np.ndarray  # (N_VECTORS, n_dof) scratch
    matrices: np.ndarray  # (N_MATRICES, n_dof, n_dof) scratch


class Recorder(NamedTuple):
    """What an analysis writes at its samples besides its history; arrays without samples (0, ...) are not written.

    Motions are displacements [m and rad] and, in dynamic analyses, velocities and accelerations relative to the base.
    """

    sections: np.ndarray  # (n_recorded, n_sections, 2) axial strain and curvature [1/m], from the base up
    motion: np.ndarray  # (n_recorded, 1 or 3, n_dof)
    stresses: np.ndarray  # (n_recorded, n_fibers) [Pa]
    fibers: np.ndarray  # (n_fibers, 2) int, section and number: from 0 concrete fibers, from -1 downwards bars


def recorder(
    column: Column, n_steps: int = 0, *, sections: bool = False, motion: int = 0, fibers: Sequence[Sequence[int]] = ()
) -> Recorder:
    """Return a `Recorder` for `n_steps` samples of the sections, of `motion` rows and of the stresses of `fibers`."""
    return Recorder(
        np.zeros((n_steps if sections else 0, len(column.sections.virgin), 2)),
        np.zeros((n_steps if motion else 0, motion, column.vectors.shape[1])),
        np.zeros((n_steps if len(fibers) else 0, len(fibers))),
        np.array(fibers, dtype=np.int64).reshape(-1, 2),
    )


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
    bars_fail: bool = False,
) -> Column:
    """Return a `Column` with allocated memory, whose material constants are still to be set.

    `points` and `weights` (n_points,) are a Gauss-Lobatto rule on [0, 1]; `core`, `cover` and `bars` (n, 2) have the
    position y [m] and the area [m²] of the fibers. The deformations of the base section continue over the length
    `penetration` [m] below the base (bar strains in the foundation). With `bars_fail`, bars have fatigue, whose
    constants are also still to be set. `element_tolerance` is as in `Elements` [J].
    """
    n_bar_state = bar_fatigue.N_STATE if bars_fail else reinforcing_steel.N_STATE
    concrete = _append_empty_fibers(np.concatenate([core, cover]), 16)
    padded_bars = _append_empty_fibers(bars, 8)
    n_sections = n_elements * len(points)
    n_state = HEAD + PER_SECTION * len(points)
    length = height / n_elements
    tributary = np.tile(np.asarray(weights, dtype=float) * length, (n_elements, 1))
    tributary[0, 0] += penetration
    return Column(
        length=length,
        corotational=bool(corotational),
        sections=Sections(
            core_count=len(core),
            y=np.ascontiguousarray(concrete[:, 0], dtype=float),
            area=np.ascontiguousarray(concrete[:, 1], dtype=float),
            bar_y=np.ascontiguousarray(padded_bars[:, 0], dtype=float),
            bar_area=np.ascontiguousarray(padded_bars[:, 1], dtype=float),
            concrete=np.zeros((2, concrete04.N_CONSTANTS)),
            steel=np.zeros(reinforcing_steel.N_CONSTANTS),
            failure=np.zeros(bar_fatigue.N_FAILURE if bars_fail else 0),
            concrete_memory=np.zeros((n_sections, 5, len(concrete))),
            steel_memory=np.zeros((n_sections, len(bars), n_bar_state)),
            steel_trial=np.zeros((n_sections, len(bars), n_bar_state)),
            paths=np.zeros((n_sections, N_PATH, len(padded_bars))),
            virgin=np.zeros(n_sections),
        ),
        elements=Elements(
            points=np.ascontiguousarray(points, dtype=float),
            tributary=tributary,
            initial_flexibility=np.zeros(3),
            tolerance=float(element_tolerance),
            state=np.zeros((n_elements, n_state)),
            work=np.zeros(n_state),
        ),
        state_before=np.zeros((n_elements, n_state)),
        vectors=np.zeros((N_VECTORS, 3 * n_elements)),
        matrices=np.zeros((N_MATRICES, 3 * n_elements, 3 * n_elements)),
    )


def _append_empty_fibers(fibers: np.ndarray, multiple: int) -> np.ndarray:
    """Append empty fibers to `fibers` (n, 2) up to a multiple that fills SIMD registers."""
    return np.concatenate([fibers, np.zeros((-len(fibers) % multiple, 2))])


@kernel
def initialise_column(column):
    """Make the materials virgin, unload the elements, and write forces and tangent without displacements, in place."""
    sections, elements = column.sections, column.elements
    fiber_section.reset(sections)
    k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0
    for i in range(sections.y.shape[0]):
        ea = sections.concrete[0 if i < sections.core_count else 1, concrete04.EC] * sections.area[i]
        k_axial += ea
        k_coupling -= ea * sections.y[i]
        k_bending += ea * sections.y[i] * sections.y[i]
    for i in range(sections.bar_y.shape[0]):
        ea = sections.steel[reinforcing_steel.E0] * sections.bar_area[i]
        k_axial += ea
        k_coupling -= ea * sections.bar_y[i]
        k_bending += ea * sections.bar_y[i] * sections.bar_y[i]
    d = k_axial * k_bending - k_coupling * k_coupling
    elements.initial_flexibility[0] = k_bending / d
    elements.initial_flexibility[1] = -k_coupling / d
    elements.initial_flexibility[2] = k_axial / d
    for e in range(elements.state.shape[0]):
        initialise(e, elements)
    u, load = column.vectors[4], column.vectors[3]
    for i in range(u.shape[0]):
        u[i] = load[i] = 0.0
    assemble(u, column, column.vectors[5], column.matrices[2], False)


@kernel(inline=True)
def assemble(u, column, force, stiffness, linear):
    """Write the restoring forces (n,) and the tangent (n, n) at the displacements `u` (n,); False if an element fails.

    If `linear`, all sections follow their last tangents. An element that has become a fifth longer or shorter counts as
    failed, whatever its force: otherwise a crushed column could reach equilibrium on its bars at half its length.
    """
    n = u.shape[0]
    state = column.elements.state
    for i in range(n):
        force[i] = 0.0
        for k in range(n):
            stiffness[i, k] = 0.0
    for e in range(state.shape[0]):
        first = 3 * e - 3
        j = first + 3
        dux, duy, theta_i = u[j], u[j + 1], 0.0
        if first >= 0:
            dux -= u[first]
            duy -= u[first + 1]
            theta_i = u[first + 2]
        chord = deformations(dux, duy, theta_i, u[j + 2], column.length, column.corotational)
        if not abs(chord.elongation) < LARGEST_AXIAL_STRAIN * column.length:
            return False
        if not advance(chord.elongation, chord.theta_i, chord.theta_j, e, column.elements, column.sections, linear):
            return False
        add_to_stiffness(first, state[e], chord, column.corotational, force, stiffness)
    return True


@kernel(inline=True)
def commit_sections(column):
    """Advance the memory of every fiber to the strains of the last trial, in place."""
    state = column.elements.state
    n_points = column.elements.points.shape[0]
    for e in range(state.shape[0]):
        for m in range(n_points):
            k = HEAD + PER_SECTION * m
            fiber_section.commit(state[e, k], state[e, k + 1], e * n_points + m, column.sections)


@kernel(inline=True)
def record_forces(column, force, out):
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
def record(column, u, v, a, sample, out):
    """Write one sample of a committed state with the motion u, v, a (n_dof,) to the `Recorder` `out`."""
    state = column.elements.state
    n_points = column.elements.points.shape[0]
    if out.sections.shape[0] > 0:
        for e in range(state.shape[0]):
            for m in range(n_points):
                k = HEAD + PER_SECTION * m
                out.sections[sample, e * n_points + m, 0] = state[e, k]
                out.sections[sample, e * n_points + m, 1] = state[e, k + 1]
    if out.motion.shape[0] > 0:
        for i in range(u.shape[0]):
            out.motion[sample, 0, i] = u[i]
            if out.motion.shape[1] > 1:
                out.motion[sample, 1, i] = v[i]
                out.motion[sample, 2, i] = a[i]
    if out.stresses.shape[0] > 0:
        for i in range(out.fibers.shape[0]):
            j = out.fibers[i, 0]
            k = HEAD + PER_SECTION * (j % n_points)
            e = j // n_points
            stress = fiber_section.fiber_stress(state[e, k], state[e, k + 1], j, out.fibers[i, 1], column.sections)
            out.stresses[sample, i] = stress


@kernel
def cross_jumps(column):
    """Take every fiber that is next to a stress jump across the jump; return the number of fibers moved.

    See `fiber_section.cross_jumps`.
    """
    state = column.elements.state
    n_points = column.elements.points.shape[0]
    count = 0
    for e in range(state.shape[0]):
        for m in range(n_points):
            k = HEAD + PER_SECTION * m
            count += fiber_section.cross_jumps(state[e, k], state[e, k + 1], e * n_points + m, column.sections)
    return count


@kernel
def bars_have_fractured(column):
    """Return whether a bar of any section has fractured; always False for bars that do not fail."""
    memory = column.sections.steel_memory
    if column.sections.failure.shape[0] == 0:
        return False
    for j in range(memory.shape[0]):
        for i in range(memory.shape[1]):
            if memory[j, i, bar_fatigue.FRACTURED] == 1.0:
                return True
    return False
