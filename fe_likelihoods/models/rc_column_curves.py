"""Curves of a reinforced-concrete column: stress-strain curves of its materials, moment-curvature curve of its section.

They show the behaviour of the laws at given parameters, before the column is simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..kernels import bar_fatigue, concrete04, reinforcing_steel
from ..kernels.fiber_section import Sections, commit, forces, reset
from ..simulation.model import SimulationFailed
from ..units import G0
from .rc_column import RCColumn
from .rc_column_analysis import make_column
from .validation import check_theta, invalid

_LARGEST_STRAIN = 0.2
_MAX_HALVINGS = 12
_POINTS = 200  # samples from one reversal to the next


class MaterialCurve(NamedTuple):
    """Stress of a material under a history of strain, both positive in tension."""

    name: str  # "core concrete", "cover concrete" or "steel"
    strain: np.ndarray  # (n,)
    stress: np.ndarray  # (n,) [Pa]


class MomentCurvature(NamedTuple):
    """Moment of a section under a history of curvature and a constant axial force."""

    curvature: np.ndarray  # (n,) positive where the column bends towards positive displacements [1/m]
    moment: np.ndarray  # (n,) with the sign of the curvature in the elastic range [N m]
    axial_force: float  # positive in tension [N]


def material_curves(
    column: RCColumn, theta: np.ndarray, strains: Sequence[float] | None = None
) -> tuple[MaterialCurve, MaterialCurve, MaterialCurve]:
    """Compute the stress of core concrete, cover concrete and steel under cyclic strains.

    Parameters
    ----------
    column, theta
        The column, and multiples (n_parameters,) of its nominal parameters.
    strains : sequence of float, optional
        Strains at which the loading reverses, in order; it starts at zero and is linear between them. Default: cycles
        of the concrete to 0.25, 0.5, 1 and 1.5 times the strain at the confined strength, with cracks between them, and
        of the steel to 0.4, 1, 2 and 3 times the strain at the onset of hardening.

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
    made, values = make_column(column, check_theta(theta, column.parameters), 1, 2)
    sections = made.sections
    peak, crack = sections.concrete[0, concrete04.E0], 5.0 * values["ft"] / values["Ec"]
    hardening = column.steel.hardening_strain
    path = _path(strains, [strain for level in (0.25, 0.5, 1.0, 1.5) for strain in (level * peak, crack)])
    curves = [
        MaterialCurve(f"{part} concrete", path, _concrete_stress(path, constants))
        for part, constants in zip(("core", "cover"), sections.concrete, strict=True)
    ]
    path = _path(strains, [sign * level * hardening for level in (0.4, 1.0, 2.0, 3.0) for sign in (1.0, -1.0)])
    memory, more = np.zeros(sections.steel_memory.shape[-1]), [sections.failure] if sections.failure.size else []
    update = bar_fatigue.update if more else reinforcing_steel.update
    stress = np.array([update(strain, memory, sections.steel, *more)[0] for strain in path])
    return (*curves, MaterialCurve("steel", path, stress))


def _concrete_stress(path: np.ndarray, constants: np.ndarray) -> np.ndarray:
    """Stress (n,) of a virgin concrete fiber under strains (n,)."""
    low, high, stress = 0.0, 0.0, []
    for strain in path.tolist():
        memory = concrete04.unloading(low, high, constants)
        stress.append(concrete04.stress_tangent(strain, low, high, *memory, constants)[0])
        low, high = min(low, strain), max(high, strain)
    return np.array(stress)


def moment_curvature(
    column: RCColumn, theta: np.ndarray, curvature: np.ndarray, *, axial_force: float | None = None
) -> MomentCurvature:
    """Compute the moment in a column's section under a history of curvature.

    Parameters
    ----------
    column, theta
        The column, and multiples (n_parameters,) of its nominal parameters.
    curvature : ndarray[n]
        Curvatures, in order, after the axial force has been applied [1/m].
    axial_force : float, optional
        Constant axial force, positive in tension [N]. Default: the gravity load of the column, in compression.

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
    made, values = make_column(column, check_theta(theta, column.parameters), 1, 2)
    sections = made.sections
    curvature = np.array(curvature, dtype=float)
    if curvature.ndim != 1 or curvature.size == 0 or not np.isfinite(curvature).all():
        raise invalid("a vector of finite curvatures [1/m]", curvature, "such as np.linspace(0.0, 0.05, 200)")
    if axial_force is None:
        axial_force = -(column.axial_load if column.axial_load is not None else values["mass"] * G0)
    tolerance = 1e-9 * values["fc"] * float(sections.area.sum())
    moment = np.empty_like(curvature)
    reset(sections)
    axial = _advance(sections, 0.0, 0.0, 0.0, axial_force, tolerance, 0)
    for k, target in enumerate(curvature):
        start = curvature[k - 1] if k else 0.0
        axial = _advance(sections, axial, start, target, axial_force, tolerance, _MAX_HALVINGS)
        moment[k] = -forces(axial, -target, 0, sections)[1]
    return MomentCurvature(curvature, moment, float(axial_force))


def _advance(
    sections: Sections, axial: float, start: float, end: float, axial_force: float, tolerance: float, halvings: int
) -> float:
    """Go from one curvature to another, in halves if need be, and commit the fibers; return the axial strain there."""
    found = _balance(sections, axial, end, axial_force, tolerance)
    if found is not None:
        commit(found, -end, 0, sections)  # the second axis of the element points against the direction of loading
        return found
    if not halvings:
        raise SimulationFailed(
            f"the section cannot carry the axial force {axial_force:.4g} N at the curvature {end:.4g} 1/m"
        )
    middle = 0.5 * (start + end)
    axial = _advance(sections, axial, start, middle, axial_force, tolerance, halvings - 1)
    return _advance(sections, axial, middle, end, axial_force, tolerance, halvings - 1)


def _balance(sections: Sections, start: float, curvature: float, axial_force: float, tolerance: float) -> float | None:
    """Axial strain at a curvature and an axial force, sought from `start`; None if there is no equilibrium."""
    from scipy.optimize import brentq  # slow to import

    def excess(strain: float) -> float:
        return forces(strain, -curvature, 0, sections)[0] - axial_force

    width = 1e-6
    sign = -1.0 if excess(start) > 0.0 else 1.0  # the force grows with the strain
    low, high = start, start + sign * width
    while sign * excess(high) < 0.0:
        width *= 2.0
        low, high = high, start + sign * width
        if width > _LARGEST_STRAIN:
            return None
    found = brentq(excess, low, high, xtol=1e-16)
    return found if abs(excess(found)) <= tolerance else None  # else a jump of the stress, such as from crushed cover


def _path(given: Sequence[float] | None, default: Sequence[float]) -> np.ndarray:
    """Strains from zero through the reversals of the loading, linear between them."""
    ends = np.array([0.0, *np.ravel(default if given is None else given)], dtype=float)
    if len(ends) < 2 or not np.isfinite(ends).all() or np.abs(ends).max() >= 0.9:
        raise invalid("strains between -0.9 and 0.9", given, "give strains, not per cent")
    return np.interp(np.arange((len(ends) - 1) * _POINTS + 1) / _POINTS, np.arange(len(ends)), ends)
