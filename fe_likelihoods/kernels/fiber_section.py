"""Axial force and bending moment of a fiber section: core concrete, cover concrete and bars.

Plane sections stay plane, eps = e0 - y kappa::

    N = sum(sigma A),   M = -sum(sigma A y)
    k = [[sum(E A), -sum(E A y)], [-sum(E A y), sum(E A y^2)]]

A trial evaluation only reads the memory of the fibers; `commit` advances it. In most trials most fibers stay within the
strains that they have reached before, where the stress of concrete follows one of three straight lines. These fibers
are summed side by side (SIMD); the few other fibers are evaluated one after the other on the envelope. Bars that have
never been committed beyond yield have no memory: their stress follows the backbone. Well below yield the backbone is a
series (`reinforcing_steel.virgin_stress_tangent`), which is also evaluated side by side.

Empty fibers (no area, at y = 0) may be appended to fill whole SIMD registers. Without them the remaining few fibers
would take as long as all others. ``docs/theory/fiber_section.rst`` has the equations and the mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from . import bar_fatigue, concrete04
from .bars import bar_stress, commit_bars, initialise_bars, sum_bars, switch_backbones
from .concrete04 import envelope, unloading
from .jit import SUM_REORDERING, kernel
from .reinforcing_steel import E0 as STEEL_E0
from .reinforcing_steel import EP as STEEL_EP
from .reinforcing_steel import F0 as STEEL_F0
from .reinforcing_steel import VIRGIN_LIMIT, YIELD_STRAIN, virgin_stress_tangent

__all__ = ["Sections", "reset", "forces", "commit", "cross_jumps", "fiber_stress"]

NEAR_JUMP = 0.995
"""A fiber is next to a jump from this share of the jump strain (concrete) or of the damage at fracture (bars)."""

_EC = concrete04.EC


class Sections(NamedTuple):
    """Fibers of a section, and the memory of all sections with these fibers.

    Arrays of fibers have empty fibers appended. The bar memory of a virgin section is not kept up to date.
    """

    core_count: int  # the first concrete fibers belong to the core, the others to the cover
    y: np.ndarray  # (n_concrete,) [m]
    area: np.ndarray  # (n_concrete,) [m²]
    bar_y: np.ndarray  # (n_bars or more,) [m]
    bar_area: np.ndarray  # (n_bars or more,) [m²]
    concrete: np.ndarray  # (2, concrete04.N_CONSTANTS) of core and cover
    steel: np.ndarray  # (reinforcing_steel.N_CONSTANTS,)
    failure: np.ndarray  # (bar_fatigue.N_FAILURE,), or (0,) for bars that do not fail
    concrete_memory: np.ndarray  # (n_sections, 5, n_concrete) eps_min, eps_max, eps_end, slope, tension slope
    steel_memory: np.ndarray  # (n_sections, n_bars, N_STATE of reinforcing_steel or bar_fatigue)
    steel_trial: np.ndarray  # like steel_memory, after the last trial that left the curve of a bar
    paths: np.ndarray  # (n_sections, N_PATH, n_bars or more) curves of the bars (`bars`)
    virgin: np.ndarray  # (n_sections,) 1 while no bar has been committed beyond yield, else 0


@kernel
def reset(sections):
    """Make the memory of all sections virgin, in place."""
    concrete_memory = sections.concrete_memory
    sections.steel_memory[:] = 0.0
    sections.virgin[:] = 1.0
    n_sections, _, n = concrete_memory.shape
    for j in range(n_sections):
        initialise_bars(sections.steel_memory[j], sections.paths[j], sections.steel)
        for i in range(n):
            ec = sections.concrete[0 if i < sections.core_count else 1, _EC]
            concrete_memory[j, 0, i] = 0.0
            concrete_memory[j, 1, i] = 0.0
            concrete_memory[j, 2, i] = 0.0
            concrete_memory[j, 3, i] = ec
            concrete_memory[j, 4, i] = ec


@kernel(fastmath=SUM_REORDERING)
def _sum_envelope(e0, kappa, j, core_count, y, area, concrete, concrete_memory):
    """Sum over the concrete fibers beyond their extreme strains, which are on the envelope."""
    n_force, moment, k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(y.shape[0]):
        yi = y[i]
        eps = e0 - yi * kappa
        if eps < concrete_memory[j, 0, i] or eps > concrete_memory[j, 1, i]:
            stress, tangent = envelope(eps, concrete[0 if i < core_count else 1])
            force = stress * area[i]
            ea = tangent * area[i]
            n_force += force
            moment -= force * yi
            k_axial += ea
            k_coupling -= ea * yi
            k_bending += ea * yi * yi
    return n_force, moment, k_axial, k_coupling, k_bending


@kernel(inline=True, fastmath=SUM_REORDERING)
def forces(e0, kappa, j, sections):
    """Return N [N], M [N m] and the tangent of section `j` at a trial strain.

    The strain is `e0` at y = 0 with the curvature `kappa` [1/m]; the tangent is dN/de0 [N], dN/dkappa = dM/de0 [N m]
    and dM/dkappa [N m²].
    """
    y, area, concrete_memory = sections.y, sections.area, sections.concrete_memory
    bar_y, bar_area, steel = sections.bar_y, sections.bar_area, sections.steel
    n_force = 0.0
    moment = 0.0
    k_axial = 0.0
    k_coupling = 0.0
    k_bending = 0.0
    beyond = 0.0
    # All loads precede the choices, so that the compiler makes masks of them and no branches: this halves the time.
    for i in range(y.shape[0]):
        yi = y[i]
        eps = e0 - yi * kappa
        eps_min = concrete_memory[j, 0, i]
        eps_max = concrete_memory[j, 1, i]
        eps_end = concrete_memory[j, 2, i]
        slope = concrete_memory[j, 3, i]
        tension_slope = concrete_memory[j, 4, i]
        fiber_area = area[i]
        is_beyond = 1.0 if eps < eps_min else 0.0
        is_beyond = 1.0 if eps > eps_max else is_beyond
        tangent = slope if eps < eps_end else 0.0
        tangent = tension_slope if eps >= 0.0 else tangent
        origin = 0.0 if eps >= 0.0 else eps_end
        ea = (1.0 - is_beyond) * tangent * fiber_area
        force = ea * (eps - origin)
        beyond += is_beyond
        n_force += force
        moment -= force * yi
        k_axial += ea
        k_coupling -= ea * yi
        k_bending += ea * yi * yi
    if beyond > 0.0:
        a, b, c, d, e = _sum_envelope(e0, kappa, j, sections.core_count, y, area, sections.concrete, concrete_memory)
        n_force += a
        moment += b
        k_axial += c
        k_coupling += d
        k_bending += e

    if sections.virgin[j] == 1.0:
        bars_n = 0.0
        bars_m = 0.0
        bars_axial = 0.0
        bars_coupling = 0.0
        bars_bending = 0.0
        limit = steel[VIRGIN_LIMIT]
        s_e0, s_ep, s_f0 = steel[STEEL_E0], steel[STEEL_EP], steel[STEEL_F0]
        beyond = 0.0
        for i in range(bar_y.shape[0]):
            yi = bar_y[i]
            bar = bar_area[i]
            eps = e0 - yi * kappa
            beyond += 1.0 if abs(eps) > limit else 0.0
            stress, tangent = virgin_stress_tangent(eps, s_e0, s_ep, s_f0)
            ea = tangent * bar
            force = stress * bar
            bars_n += force
            bars_m -= force * yi
            bars_axial += ea
            bars_coupling -= ea * yi
            bars_bending += ea * yi * yi
        if beyond == 0.0:
            return (
                n_force + bars_n,
                moment + bars_m,
                k_axial + bars_axial,
                k_coupling + bars_coupling,
                k_bending + bars_bending,
            )
    memory, trial, path = sections.steel_memory[j], sections.steel_trial[j], sections.paths[j]
    a, b, c, d, e = sum_bars(e0, kappa, bar_y, bar_area, memory, trial, steel, sections.failure, path)
    return n_force + a, moment + b, k_axial + c, k_coupling + d, k_bending + e


@kernel
def _commit_concrete(e0, kappa, j, core_count, y, concrete, concrete_memory):
    """Advance the memory of the concrete fibers beyond their extreme strains."""
    for i in range(y.shape[0]):
        eps = e0 - y[i] * kappa
        if eps < concrete_memory[j, 0, i] or eps > concrete_memory[j, 1, i]:
            eps_min, eps_max = concrete04.commit(eps, concrete_memory[j, 0, i], concrete_memory[j, 1, i])
            eps_end, slope, tension_slope = unloading(eps_min, eps_max, concrete[0 if i < core_count else 1])
            concrete_memory[j, 0, i] = eps_min
            concrete_memory[j, 1, i] = eps_max
            concrete_memory[j, 2, i] = eps_end
            concrete_memory[j, 3, i] = slope
            concrete_memory[j, 4, i] = tension_slope


@kernel(inline=True, fastmath=SUM_REORDERING)
def commit(e0, kappa, j, sections):
    """Advance the memory of section `j` to the strains of (e0, kappa), in place."""
    y, bar_y, steel, virgin = sections.y, sections.bar_y, sections.steel, sections.virgin
    concrete_memory = sections.concrete_memory
    beyond = 0.0
    for i in range(y.shape[0]):
        eps = e0 - y[i] * kappa
        eps_min = concrete_memory[j, 0, i]
        eps_max = concrete_memory[j, 1, i]
        is_beyond = 1.0 if eps < eps_min else 0.0
        beyond += 1.0 if eps > eps_max else is_beyond
    if beyond > 0.0:
        _commit_concrete(e0, kappa, j, sections.core_count, y, sections.concrete, concrete_memory)
    beyond = 1.0
    if virgin[j] == 1.0:
        beyond = 0.0
        limit = steel[YIELD_STRAIN]
        for i in range(bar_y.shape[0]):
            beyond += 1.0 if abs(e0 - bar_y[i] * kappa) >= limit else 0.0
    if beyond > 0.0:
        virgin[j] = 0.0
        memory, trial, path = sections.steel_memory[j], sections.steel_trial[j], sections.paths[j]
        commit_bars(e0, kappa, bar_y, memory, trial, steel, sections.failure, path)


@kernel
def cross_jumps(e0, kappa, j, sections):
    """Take the fibers of section `j` that are next to a stress jump across it, in place; return how many were moved.

    The laws have jumps. Concrete loses its stress at once at eps_cu and at eps_tu, and a bar whose two backbones have
    different origins changes from one to the other at zero stress (`reinforcing_steel.switch_backbone`). If the jump
    drives the fiber back, there is equilibrium neither before nor after the jump, however small the step is. A bar that
    fractures (`bar_fatigue`) loses its stress over a small strain, which acts like a jump if the column springs back by
    more than this strain. None of the four jumps can be undone, so a fiber next to a jump is taken across it.
    """
    y, concrete, concrete_memory = sections.y, sections.concrete, sections.concrete_memory
    count = 0
    for i in range(y.shape[0]):
        c = concrete[0 if i < sections.core_count else 1]
        eps = e0 - y[i] * kappa
        eps_min, eps_max = concrete_memory[j, 0, i], concrete_memory[j, 1, i]
        if eps_min >= c[concrete04.ECU] and eps <= NEAR_JUMP * c[concrete04.ECU]:
            eps_min = (1.0 + 1e-9) * c[concrete04.ECU]
        elif eps_max <= c[concrete04.ETU] and eps >= NEAR_JUMP * c[concrete04.ETU] and c[concrete04.FT] > 0.0:
            eps_max = (1.0 + 1e-9) * c[concrete04.ETU]
        else:
            continue
        eps_end, slope, tension_slope = unloading(eps_min, eps_max, c)
        concrete_memory[j, 0, i] = eps_min
        concrete_memory[j, 1, i] = eps_max
        concrete_memory[j, 2, i] = eps_end
        concrete_memory[j, 3, i] = slope
        concrete_memory[j, 4, i] = tension_slope
        count += 1
    if sections.virgin[j] == 0.0:
        count += switch_backbones(sections.steel_memory[j], sections.steel, sections.failure, sections.paths[j])
        if sections.failure.shape[0] > 0:
            for i in range(sections.steel_memory.shape[1]):
                bar = sections.steel_memory[j, i]
                if bar[bar_fatigue.DAMAGE] >= NEAR_JUMP and bar[bar_fatigue.FRACTURED] == 0.0:
                    bar[bar_fatigue.FRACTURED] = 1.0
                    count += 1
    return count


@kernel
def fiber_stress(e0, kappa, j, i, sections):
    """Return the stress [Pa] of one fiber of section `j` at a strain; bar k has the number i = -1 - k."""
    if i < 0:
        k = -1 - i
        strain, memory, trial = e0 - sections.bar_y[k] * kappa, sections.steel_memory[j, k], sections.steel_trial[j, k]
        return bar_stress(strain, memory, trial, sections.steel, sections.failure, sections.paths[j], k)[0]
    memory, constants = sections.concrete_memory[j], sections.concrete[0 if i < sections.core_count else 1]
    extremes = memory[0, i], memory[1, i], memory[2, i], memory[3, i], memory[4, i]
    return concrete04.stress_tangent(e0 - sections.y[i] * kappa, *extremes, constants)[0]
