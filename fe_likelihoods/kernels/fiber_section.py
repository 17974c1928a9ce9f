"""Axial force and bending moment of a fiber section: core concrete, cover concrete and bars.

Plane sections, eps = e0 - y kappa::

    N = sum(sigma A),   M = -sum(sigma A y)
    k = [[sum(E A), -sum(E A y)], [-sum(E A y), sum(E A y^2)]]

A trial evaluation only reads the memory of the fibers; `commit` advances it. Most fibers of most trials lie within
their memory, where Concrete04 is a choice between three straight lines: these are summed side by side (SIMD), the few
beyond it one after the other. Bars that have never been committed beyond yield leave no trace: their stress is the
backbone's, and well below yield that is a series (`reinforcing_steel.virgin_stress_tangent`), again side by side.

The memory of all sections of a column is held in three arrays:

* ``concrete_memory`` (n_sections, 5, n_concrete): eps_min, eps_max, eps_end, slope, tension slope;
* ``steel_memory`` (n_sections, n_bars, reinforcing_steel.N_STATE);
* ``virgin`` (n_sections,): 1 while no bar of the section has been committed beyond yield, else 0; the memory of the
  bars of a virgin section is not kept up.

Fibers may be filled up with empty ones (no area, on the axis) to whole SIMD registers: a remainder of a few fibers
would cost as much as all others.

References: specs/bridge_column.md, section 4.
"""

from __future__ import annotations

from . import concrete04
from .concrete04 import envelope, unloading
from .jit import SUM_REORDERING, kernel
from .reinforcing_steel import E0 as STEEL_E0
from .reinforcing_steel import EP as STEEL_EP
from .reinforcing_steel import F0 as STEEL_F0
from .reinforcing_steel import (
    VIRGIN_LIMIT,
    YIELD_STRAIN,
    monotonic_stress_tangent,
    stress_tangent,
    switch_backbone,
    update,
    virgin_stress_tangent,
)

__all__ = ["reset", "forces", "commit", "release"]

VERGE = 0.995

_EC = concrete04.EC


@kernel
def reset(core_count, concrete, concrete_memory, steel_memory, virgin):
    """Bring the memory of all sections into the virgin state, in place."""
    steel_memory[:] = 0.0
    virgin[:] = 1.0
    n_sections, _, n = concrete_memory.shape
    for j in range(n_sections):
        for i in range(n):
            ec = concrete[0 if i < core_count else 1, _EC]
            concrete_memory[j, 0, i] = 0.0
            concrete_memory[j, 1, i] = 0.0
            concrete_memory[j, 2, i] = 0.0
            concrete_memory[j, 3, i] = ec
            concrete_memory[j, 4, i] = ec


@kernel(fastmath=SUM_REORDERING)
def _concrete_beyond(e0, kappa, j, core_count, y, area, concrete, concrete_memory):
    """Sums over the concrete fibers beyond their memory only, on the envelope."""
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


@kernel
def _bars_one_by_one(e0, kappa, j, bar_y, bar_area, steel, steel_memory, virgin, trial):
    """Sums over the bars where some are near or beyond yield."""
    n_force, moment, k_axial, k_coupling, k_bending = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(steel_memory.shape[1]):
        yi = bar_y[i]
        if virgin[j] == 1.0:
            stress, tangent = monotonic_stress_tangent(e0 - yi * kappa, steel)
        else:
            stress, tangent = stress_tangent(e0 - yi * kappa, steel_memory[j, i], steel, trial)
        force = stress * bar_area[i]
        ea = tangent * bar_area[i]
        n_force += force
        moment -= force * yi
        k_axial += ea
        k_coupling -= ea * yi
        k_bending += ea * yi * yi
    return n_force, moment, k_axial, k_coupling, k_bending


@kernel(inline=True, fastmath=SUM_REORDERING)
def forces(
    e0,
    kappa,
    j,
    core_count,
    y,
    area,
    concrete,
    concrete_memory,
    bar_y,
    bar_area,
    steel,
    steel_memory,
    virgin,
    trial,
):
    """Axial force, moment and the three tangents (axial, coupling, bending) of section `j` at a trial strain.

    y, area : (n_concrete,) fibers, the first `core_count` of the core. concrete : (2, concrete04.N_CONSTANTS) core and
    cover. bar_y, bar_area : (n_bars or more,), filled up with empty bars. steel : (reinforcing_steel.N_CONSTANTS,).
    trial : scratch (reinforcing_steel.N_STATE,).
    """
    n_force = 0.0
    moment = 0.0
    k_axial = 0.0
    k_coupling = 0.0
    k_bending = 0.0
    beyond = 0.0
    # Every load stands before the choices, so that they become masks and not branches: half the time.
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
        a, b, c, d, e = _concrete_beyond(e0, kappa, j, core_count, y, area, concrete, concrete_memory)
        n_force += a
        moment += b
        k_axial += c
        k_coupling += d
        k_bending += e

    if virgin[j] == 1.0:
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
    a, b, c, d, e = _bars_one_by_one(e0, kappa, j, bar_y, bar_area, steel, steel_memory, virgin, trial)
    return n_force + a, moment + b, k_axial + c, k_coupling + d, k_bending + e


@kernel
def _commit_concrete(e0, kappa, j, core_count, y, concrete, concrete_memory):
    """Advance the memory of the concrete fibers beyond it."""
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


@kernel
def _commit_bars(e0, kappa, j, bar_y, steel, steel_memory, virgin):
    """Advance the memory of the bars of a section that is committed beyond yield, or has been before."""
    if virgin[j] == 1.0:
        virgin[j] = 0.0
        steel_memory[j] = 0.0
    for i in range(steel_memory.shape[1]):
        update(e0 - bar_y[i] * kappa, steel_memory[j, i], steel)


@kernel(inline=True, fastmath=SUM_REORDERING)
def commit(e0, kappa, j, core_count, y, concrete, concrete_memory, bar_y, steel, steel_memory, virgin):
    """Advance the memory of section `j` to the strains of (e0, kappa), in place."""
    beyond = 0.0
    for i in range(y.shape[0]):
        eps = e0 - y[i] * kappa
        eps_min = concrete_memory[j, 0, i]
        eps_max = concrete_memory[j, 1, i]
        is_beyond = 1.0 if eps < eps_min else 0.0
        beyond += 1.0 if eps > eps_max else is_beyond
    if beyond > 0.0:
        _commit_concrete(e0, kappa, j, core_count, y, concrete, concrete_memory)
    beyond = 1.0
    if virgin[j] == 1.0:
        beyond = 0.0
        limit = steel[YIELD_STRAIN]
        for i in range(bar_y.shape[0]):
            beyond += 1.0 if abs(e0 - bar_y[i] * kappa) >= limit else 0.0
    if beyond > 0.0:
        _commit_bars(e0, kappa, j, bar_y, steel, steel_memory, virgin)


@kernel
def release(e0, kappa, j, core_count, y, concrete, concrete_memory, bar_y, steel, steel_memory, virgin):
    """Take the fibers of section `j` that stand on the verge of a jump of their stress across it; how many.

    The laws have jumps: concrete loses its stress at once at eps_cu and at eps_tu, and a bar whose two backbones have
    different origins changes from one to the other at zero stress (`reinforcing_steel.switch_backbone`). Where the
    jump itself takes the fiber back, there is equilibrium neither before nor after it, however small the step. All
    three jumps are for good, so a fiber that stands there is taken across. `VERGE` is the share of the strain from
    which on concrete counts as there.
    """
    count = 0
    for i in range(y.shape[0]):
        c = concrete[0 if i < core_count else 1]
        eps = e0 - y[i] * kappa
        eps_min, eps_max = concrete_memory[j, 0, i], concrete_memory[j, 1, i]
        if eps_min >= c[concrete04.ECU] and eps <= VERGE * c[concrete04.ECU]:
            eps_min = (1.0 + 1e-9) * c[concrete04.ECU]
        elif eps_max <= c[concrete04.ETU] and eps >= VERGE * c[concrete04.ETU] and c[concrete04.FT] > 0.0:
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
    if virgin[j] == 0.0:
        for i in range(steel_memory.shape[1]):
            count += switch_backbone(steel_memory[j, i], steel)
    return count
