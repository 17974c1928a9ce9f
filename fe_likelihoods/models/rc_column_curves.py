"""Curves of a reinforced-concrete column: stress-strain curves of its materials, moment-curvature curve of its section.

They show the behaviour of the laws at given parameters, before the column is simulated. `fe_likelihoods.plot_material`
and `fe_likelihoods.plot_moment_curvature` draw them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from ..kernels import bar_fatigue, concrete04, reinforcing_steel
from ..kernels.fiber_section import Sections
from ..kernels.frame import allocate
from ..simulation.model import SimulationFailed
from ..units import G0
from .circular_section import gauss_lobatto
from .rc_column import RCColumn
from .rc_column_analysis import check_physical_values, set_materials
from .validation import check_theta, invalid

__all__ = ["MaterialCurve", "MomentCurvature", "material_curves", "moment_curvature"]

_LARGEST_STRAIN = 0.2
_MAX_HALVINGS = 12
_POINTS = 200  # samples from one reversal to the next


class MaterialCurve(NamedTuple):
    """Stress of a material under a history of strain.

    Attributes
    ----------
    name : str
        "core concrete", "cover concrete" or "steel".
    strain : ndarray[n]
        Strain, positive in tension.
    stress : ndarray[n]
        Stress, positive in tension [Pa].
    """

    name: str
    strain: np.ndarray
    stress: np.ndarray


class MomentCurvature(NamedTuple):
    """Moment of a section under a history of curvature and a constant axial force.

    Attributes
    ----------
    curvature : ndarray[n]
        Curvature, positive where the column bends towards positive displacements [1/m].
    moment : ndarray[n]
        Bending moment, with the sign of the curvature in the elastic range [N m].
    axial_strain : ndarray[n]
        Strain at the axis, positive in tension.
    axial_force : float
        Axial force, positive in tension [N].
    """

    curvature: np.ndarray
    moment: np.ndarray
    axial_strain: np.ndarray
    axial_force: float


def material_curves(
    column: RCColumn,
    theta: np.ndarray,
    *,
    concrete: Sequence[float] | None = None,
    steel: Sequence[float] | None = None,
) -> tuple[MaterialCurve, MaterialCurve, MaterialCurve]:
    """Compute the stress of core concrete, cover concrete and steel under cyclic strains.

    Parameters
    ----------
    column : RCColumn
        The column.
    theta : ndarray[n_parameters]
        Multiples of its nominal parameters.
    concrete, steel : sequence of float, optional
        Strains at which the loading reverses, in order; it starts at zero and is linear between them. Default: cycles
        of the concrete to 0.25, 0.5, 1 and 1.5 times the strain at the confined strength, with cracks between them, and
        of the steel to 0.4, 1, 2 and 3 times the strain at the onset of hardening.

    Returns
    -------
    tuple of MaterialCurve
        Curves of core concrete, cover concrete and steel.

    Raises
    ------
    SimulationFailed
        If the parameters describe no column.
    ValueError
        If the strains are not finite numbers, or not below 0.9.

    Examples
    --------
    >>> core, cover, steel = material_curves(column, np.ones(5))
    >>> [round(float(curve.stress.min()) / 1e6, 1) for curve in (core, cover)]  # confined and unconfined strength [MPa]
    [-52.3, -42.1]
    """
    sections, values = _sections(column, theta)
    core_peak = -sections.concrete[0, concrete04.E0]
    crack = 5.0 * values["ft"] / values["Ec"]
    if concrete is None:
        concrete = [strain for level in (0.25, 0.5, 1.0, 1.5) for strain in (-level * core_peak, crack)]
    if steel is None:
        steel = [sign * level * column.steel.hardening_strain for level in (0.4, 1.0, 2.0, 3.0) for sign in (1.0, -1.0)]
    curves = []
    path = _path("concrete", concrete)
    for name, constants in zip(("core concrete", "cover concrete"), sections.concrete, strict=True):
        stress = np.empty_like(path)
        concrete04.stress_history(path, constants, stress)
        curves.append(MaterialCurve(name, path, stress))
    path = _path("steel", steel)
    stress = np.empty_like(path)
    _bar_stress(path, np.zeros(len(sections.trial)), sections, stress)
    return (*curves, MaterialCurve("steel", path, stress))


def moment_curvature(
    column: RCColumn, theta: np.ndarray, curvature: np.ndarray, *, axial_force: float | None = None
) -> MomentCurvature:
    """Compute the moment in a column's section under a history of curvature.

    Parameters
    ----------
    column : RCColumn
        The column.
    theta : ndarray[n_parameters]
        Multiples of its nominal parameters.
    curvature : ndarray[n]
        Curvatures, in order, after the axial force has been applied [1/m].
    axial_force : float, optional
        Constant axial force, positive in tension [N]. Default: the gravity load of the column, in compression.

    Returns
    -------
    MomentCurvature

    Raises
    ------
    SimulationFailed
        If the parameters describe no column, or the section cannot carry the axial force at a curvature.
    ValueError
        If the curvatures are not a vector of finite numbers.

    Examples
    --------
    >>> curves = moment_curvature(column, np.ones(5), np.linspace(0.0, 0.03, 50))
    >>> round(float(curves.moment.max()) / 1e6, 2)  # MN m
    5.49
    """
    sections, values = _sections(column, theta)
    curvature = np.array(curvature, dtype=float)
    if curvature.ndim != 1 or curvature.size == 0 or not np.isfinite(curvature).all():
        raise invalid("a vector of finite curvatures [1/m]", curvature, "such as np.linspace(0.0, 0.05, 200)")
    if axial_force is None:
        axial_force = -(column.axial_load if column.axial_load is not None else values["mass"] * G0)
    section = _Section(sections)
    tolerance = 1e-9 * values["fc"] * float(sections.area.sum())
    reached = 0.0
    strain, moment = np.empty_like(curvature), np.empty_like(curvature)
    section.balance(0.0, axial_force, tolerance)
    for k, target in enumerate(curvature):
        while reached != target:
            reached = section.approach(reached, target, axial_force, tolerance)
        strain[k], moment[k] = section.axial_strain, section.moment(target)
    return MomentCurvature(curvature, moment, strain, float(axial_force))


class _Section:
    """Fibers of one section with their memory, virgin at first; positions are in the direction of loading."""

    def __init__(self, sections: Sections) -> None:
        core, n_bars = sections.core_count, sections.steel_memory.shape[1]
        self.concrete = [
            (-sections.y[part], sections.area[part], constants, np.zeros((len(sections.y[part]), 2)))
            for part, constants in zip((slice(None, core), slice(core, None)), sections.concrete, strict=True)
        ]
        self.bar_x, self.bar_area = -sections.bar_y[:n_bars], sections.bar_area[:n_bars]
        self.sections, self.bars = sections, np.zeros((n_bars, len(sections.trial)))
        self.axial_strain = 0.0

    def forces(self, axial_strain: float, curvature: float, bars: np.ndarray) -> tuple[float, float]:
        """Axial force [N] and moment [N m]; advances the memory `bars`, a copy for a trial."""
        force = moment = 0.0
        for x, area, constants, memory in self.concrete:
            stress = np.empty_like(x)
            concrete04.fiber_stresses(axial_strain - x * curvature, memory, constants, stress)
            force += float((stress * area).sum())
            moment -= float((stress * area * x).sum())
        stress = np.empty(1)
        for x, area, memory in zip(self.bar_x, self.bar_area, bars, strict=True):
            _bar_stress(np.array([axial_strain - x * curvature]), memory, self.sections, stress)
            force += float(stress[0] * area)
            moment -= float(stress[0] * area * x)
        return force, moment

    def moment(self, curvature: float) -> float:
        """Moment [N m] at the last axial strain."""
        return self.forces(self.axial_strain, curvature, self.bars.copy())[1]

    def balance(self, curvature: float, axial_force: float, tolerance: float) -> None:
        """Find the axial strain at a curvature and commit the fibers; SimulationFailed if there is none."""

        def excess(strain: float) -> float:
            return self.forces(strain, curvature, self.bars.copy())[0] - axial_force

        start, width = self.axial_strain, 1e-6
        sign = -1.0 if excess(start) > 0.0 else 1.0  # the force grows with the strain
        low, high = start, start + sign * width
        while sign * excess(high) < 0.0:
            width *= 2.0
            low, high = high, start + sign * width
            if width > _LARGEST_STRAIN:
                raise _failure(axial_force, curvature)
        found = brentq(excess, low, high, xtol=1e-16)
        if not abs(excess(found)) <= tolerance:  # a jump of the stress, such as from crushed cover
            raise _failure(axial_force, curvature)
        self.axial_strain = found
        self.forces(found, curvature, self.bars)
        for x, _, _, memory in self.concrete:
            strain = found - x * curvature
            np.minimum(memory[:, 0], strain, out=memory[:, 0])
            np.maximum(memory[:, 1], strain, out=memory[:, 1])

    def approach(self, reached: float, target: float, axial_force: float, tolerance: float) -> float:
        """Go from the curvature `reached` to `target`, or in halved steps towards it; return the curvature."""
        part = target
        for _ in range(_MAX_HALVINGS):
            try:
                self.balance(part, axial_force, tolerance)
            except SimulationFailed:
                part = 0.5 * (reached + part)
            else:
                return part
        raise _failure(axial_force, target)


def _failure(axial_force: float, curvature: float) -> SimulationFailed:
    return SimulationFailed(
        f"the section cannot carry the axial force {axial_force:.4g} N at the curvature {curvature:.4g} 1/m"
    )


def _sections(column: RCColumn, theta: np.ndarray) -> tuple[Sections, dict[str, float]]:
    """Sections of `column` with their materials, and its physical parameters."""
    values = column.physical_values(check_theta(theta, column.parameters))
    check_physical_values(values, column.steel)
    core, cover, bars = column.section.fibers()
    points, weights = gauss_lobatto(2)
    sections = allocate(
        n_elements=1,
        height=column.height,
        corotational=False,
        element_tolerance=column.element_tolerance,
        points=points,
        weights=weights,
        core=core,
        cover=cover,
        bars=bars,
        bars_fail=column.fatigue is not None,
    ).sections
    confinement = column.section.confinement(values["fc"])
    set_materials(sections, values, column.concrete, column.steel, confinement, column.fatigue)
    return sections, values


def _bar_stress(strain: np.ndarray, memory: np.ndarray, sections: Sections, stress: np.ndarray) -> None:
    """Take one bar through `strain`, write its `stress`, and advance its `memory`."""
    if sections.failure.size:
        bar_fatigue.stress_history(strain, memory, sections.steel, sections.failure, stress)
    else:
        reinforcing_steel.stress_history(strain, memory, sections.steel, stress)


def _path(name: str, reversals: Sequence[float]) -> np.ndarray:
    """Strains from zero through `reversals`, linear between them."""
    ends = np.array([0.0, *np.ravel(reversals)], dtype=float)
    if len(ends) < 2 or not np.isfinite(ends).all() or np.abs(ends).max() >= 0.9:
        raise invalid(f"strains of the {name} between -0.9 and 0.9", reversals, "give strains, not per cent")
    return np.interp(np.arange((len(ends) - 1) * _POINTS + 1) / _POINTS, np.arange(len(ends)), ends)
