"""One simulation of the reinforced-concrete column: constants of the materials, excitation, reasons of failures.

A base acceleration is integrated by Newmark's method (`fe_likelihoods.kernels.newmark`), an imposed displacement of the
top is solved as a sequence of static steps (`fe_likelihoods.kernels.static`). Both start from the gravity load.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ..kernels import bar_fatigue, concrete04, reinforcing_steel
from ..kernels.fiber_section import Sections
from ..kernels.frame import Column, allocate, recorder
from ..kernels.newmark import HISTORY_ROWS, Dynamics, newmark
from ..kernels.static import Iteration, impose_displacement
from ..signals.records import DisplacementHistory, Record
from ..simulation.model import SimulationFailed
from ..units import G0
from .base import BuiltInModel, History, remark_on_range
from .rc_column_materials import hardening_fault
from .rc_column_outputs import Output, Recording
from .rc_column_section import gauss_lobatto
from .validation import check_values, invalid

LARGEST_DRIFT = 0.5
"""Largest imposed displacement by the height; tested columns have failed at 0.05 to 0.15."""
MAX_ITERATIONS, HALVINGS = 20, 10  # of Newton's method per attempt, and how often a step may be halved
ELEMENT_TOLERANCE = 1e-10  # work of the last correction of an element [J]

_MAY_BE_ZERO = ("a0", "a1", "ft", "penetration")
_IMPOSED_ROWS = (
    *("displacement", "vertical displacement", "rotation", "force", "base axial strain", "base curvature"),
    *("base axial force", "base moment", "base shear"),
)


@dataclass(frozen=True)
class ColumnHistory(History):
    """Time histories of one simulation of the column [SI].

    Above 1, `beyond_range` means that the steel law was continued along its tangent where real bars fracture; this
    warns once per model, also for simulations from a cache on disk. `bar_damage` is Miner's sum of each bar of
    ``model.section.fibers()[2]`` at the last sample, in its worst section: a bar has fractured above 1; two bars at the
    same position count as one.
    """

    retries: int  # steps repeated with half their size
    beyond_range: float  # largest strain of a bar in the base section / ultimate strain of the steel
    bar_damage: np.ndarray | None = None  # (n_bars,); None without fatigue


class PreparedColumn(NamedTuple):
    """Inputs of the kernels that are the same for every theta."""

    excitation: np.ndarray  # base accelerations at the integration steps [m/s²], or displacements of the top [m]
    kept: np.ndarray  # (n_steps,) which of them are samples of the response
    outputs: tuple[Output, ...]

    @classmethod
    def of(cls, model: Any, outputs: tuple[Output, ...]) -> PreparedColumn:
        """Inputs for a column and its resolved outputs; both kinds of loading are linear between their samples."""
        loading = model.loading
        if isinstance(loading, Record):
            instants = np.arange((loading.n_steps - 1) * model.analysis.substeps + 1) / model.analysis.substeps
            acceleration = np.interp(instants, np.arange(loading.n_steps), loading.acceleration)
            return cls(acceleration, np.arange(0, len(instants), model.analysis.substeps), outputs)
        finer, kept = loading.subdivide(model.analysis.max_increment or model.height / 5000.0)
        return cls(finer.displacement, kept, outputs)


def check_loading(loading: object, height: float) -> None:
    """Raise ValueError for a loading of another type, and for displacements that are not in metres."""
    if not isinstance(loading, Record | DisplacementHistory):
        raise invalid(
            "a Record or a DisplacementHistory as loading",
            type(loading).__name__,
            "read a Record with fe_likelihoods.read_record",
        )
    if isinstance(loading, DisplacementHistory):
        largest = float(np.abs(loading.displacement).max())
        if largest > LARGEST_DRIFT * height:
            raise ValueError(
                f"expected displacements of the top in m, up to half the height of {height:g} m; got {largest:g} m in "
                f"{loading.name!r}, a drift of {largest / height:.3g}; convert other units with to_si, as in "
                "to_si(values, 'mm')"
            )


def make_column(model: Any, theta: np.ndarray, n_elements: int, n_points: int) -> tuple[Column, dict[str, float]]:
    """Column with its materials for multiples `theta` of the nominal parameters, and its physical parameters [SI].

    Raises SimulationFailed if the parameters describe no column.
    """
    values = model.physical_values(theta)
    _check_physical_values(values, model.steel)
    points, weights = gauss_lobatto(n_points)
    core, cover, bars = model.section.fibers()
    column = allocate(
        n_elements=n_elements,
        height=model.height,
        corotational=model.analysis.geometry == "corotational",
        element_tolerance=ELEMENT_TOLERANCE,
        points=points,
        weights=weights,
        core=core,
        cover=cover,
        bars=bars,
        penetration=values["penetration"],
        bars_fail=model.fatigue is not None,
    )
    _set_materials(column.sections, values, model)
    return column, values


def run_column(model: Any, prepared: PreparedColumn, theta: np.ndarray) -> tuple[ColumnHistory, dict[str, np.ndarray]]:
    """Histories of the kernels, and the outputs (n_steps,) by name, for multiples `theta` of the nominal parameters.

    Raises SimulationFailed if the parameters describe no structure, the column collapses, or the solution does not
    converge.
    """
    column, values = make_column(model, theta, model.analysis.n_elements, model.analysis.n_points)
    shaken, excitation, kept = isinstance(model.loading, Record), prepared.excitation, prepared.kept
    fibers = tuple(dict.fromkeys(output.fiber for output in prepared.outputs if output.fiber is not None))
    names = HISTORY_ROWS if shaken else _IMPOSED_ROWS
    history = np.zeros((len(names), len(kept) if shaken else len(excitation)))
    out = recorder(
        column,
        history.shape[1],
        sections=any(output.curvature is not None for output in prepared.outputs),
        motion=(3 if shaken else 1) * any(output.motion is not None for output in prepared.outputs),
        fibers=fibers,
    )
    iteration = Iteration(float(model.analysis.tolerance), MAX_ITERATIONS, HALVINGS)
    own = np.full(model.analysis.n_elements, model.column_mass / model.analysis.n_elements)  # at the nodes
    own[-1] *= 0.5
    gravity = np.zeros(3 * model.analysis.n_elements)
    gravity[1::3] = -own * G0
    gravity[-2] -= model.axial_load if model.axial_load is not None else values["mass"] * G0
    if shaken:
        own[-1] += values["mass"]
        mass = np.zeros((model.analysis.n_elements, 3))
        mass[:, 0], mass[:, 1], mass[-1, 2] = own, own, model.rotational_inertia
        dt, limit = model.dt / model.analysis.substeps, model.analysis.collapse_drift * model.height
        dynamics = Dynamics(gravity, mass.ravel(), float(values["a0"]), float(values["a1"]), limit)
        status, retries = newmark(column, dynamics, excitation, dt, model.analysis.substeps, iteration, history, out)
        if status < -1:
            raise SimulationFailed(
                f"collapse: at t = {-(status + 1) * dt:.4g} s, the displacement of the top exceeded the limit of "
                f"{limit:.4g} m (collapse_drift)"
            )
        at = f" (t = {status * dt:.4g} s)"
        rows, sections, motion, stresses = history, out.sections, out.motion, out.stresses
    else:
        status, retries, _ = impose_displacement(column, gravity, excitation, iteration, history, out)
        at, rows = "", history[:, kept]
        sections, motion, stresses = (x[kept] if len(x) else x for x in (out.sections, out.motion, out.stresses))
    if status:
        raise SimulationFailed(_reason(status, len(excitation), at, HALVINGS, column.sections))
    # the samples of a section are put side by side in memory: hundreds of sensors are read faster
    seen = Recording(
        dict(zip(names, rows, strict=True)),
        np.ascontiguousarray(sections.transpose(1, 2, 0)).transpose(2, 0, 1),
        motion,
        excitation[kept],
        dict(zip(fibers, stresses.T, strict=True)),
        values["penetration"],
        column.length if column.corotational else np.inf,
    )
    outputs = {output.name: output.evaluate(seen) for output in prepared.outputs}
    damage = None
    if model.fatigue is not None:
        damage = column.sections.steel_memory[:, :, bar_fatigue.DAMAGE].max(axis=0)
    beyond = _strain_beyond_range(model, seen.rows, theta, damage)
    return ColumnHistory(names, rows, retries, beyond, damage), outputs


def _check_physical_values(values: dict[str, float], steel: Any) -> None:
    """Raise SimulationFailed for physical parameter `values` [SI] that describe no column."""
    check_values(values, _MAY_BE_ZERO)
    fc = values["fc"]
    if values["ft"] >= fc:
        raise SimulationFailed(
            f"the concrete is stronger in tension than in compression: ft = {values['ft']:.4g} Pa is not below "
            f"fc = {fc:.4g} Pa"
        )
    if values["Ec"] <= fc:
        raise SimulationFailed(
            f"the concrete would reach its strength at a strain above 1: Ec = {values['Ec']:.4g} Pa is not above "
            f"fc = {fc:.4g} Pa"
        )
    if values["fy"] / values["Es"] >= steel.hardening_strain:
        raise SimulationFailed(
            "the steel has no yield plateau: fy/Es is not below the strain at the onset of hardening"
        )
    if values["fu"] <= values["fy"]:
        raise SimulationFailed(
            f"the steel has no hardening: fu = {values['fu']:.4g} Pa is not above fy = {values['fy']:.4g} Pa"
        )
    if values.get("Cd", np.inf) < values.get("Cf", 0.0):
        raise SimulationFailed(
            f"bars without strength before they fracture: Cd = {values['Cd']:.4g} is below Cf = {values['Cf']:.4g}"
        )
    strains = steel.hardening_strain, steel.ultimate_strain
    fault = hardening_fault(values["fy"], values["fu"], values["Es"], values["Esh"], *strains)
    if fault:
        raise SimulationFailed(f"the steel has no hardening branch: {fault}")


def _strain_beyond_range(
    model: Any, rows: dict[str, np.ndarray], theta: np.ndarray, bar_damage: np.ndarray | None
) -> float:
    """Largest strain of a bar at the base by the strain at which real bars fracture; above 1 it warns once per model.

    There is no warning if a bar has fractured in the simulation.
    """
    limit = model.steel.ultimate_strain
    strain = np.abs(rows["base axial strain"]) + model.bar_circle_radius * np.abs(rows["base curvature"])
    beyond = float(strain.max()) / limit
    if beyond > 1.0 and (bar_damage is None or bar_damage.max() < 1.0):
        advice = "Use RCColumn(..., fatigue=LowCycleFatigue()) for bars that lose strength and fracture"
        if bar_damage is not None:
            advice = "Use a smaller cf of LowCycleFatigue, with which they fracture at this strain"
        at = dict(zip(model.parameters, theta.tolist(), strict=True))
        remark_on_range(
            model,
            f"a bar strain of {beyond * limit:.3g} at the base exceeds the ultimate strain of the steel, {limit:.3g}, "
            f"at which bars fracture; the law was continued along its tangent, at {at}. {advice}, "
            "or a weaker loading. This model gives no further warnings: check history(theta).beyond_range",
        )
    return beyond


def expect_fracture(model: BuiltInModel) -> None:
    """Give no warning if bars of this model exceed the strain at which real bars fracture: it is pushed to failure."""
    remark_on_range(model, "")


def _set_materials(sections: Sections, values: dict[str, float], model: Any) -> None:
    """Write the constants of core, cover and bars at the physical parameter `values` [SI] into `sections`."""
    fc, ec, ft = values["fc"], values["Ec"], values["ft"]
    concrete, steel, confinement = model.concrete, model.steel, model.section.confinement(fc)
    peak = concrete.peak_strain if concrete.peak_strain is not None else 2.0 * fc / ec
    core_peak = peak * confinement.strain_ratio
    core_ultimate = max(confinement.ultimate_strain, 1.05 * core_peak)
    cover_ultimate = max(concrete.ultimate_strain, 1.5 * peak)
    tension = (ec, ft, ft / ec + concrete.softening_strain, concrete.softening_ratio)
    core, cover = sections.concrete
    concrete04.constants(-fc * confinement.strength_ratio, -core_peak, -core_ultimate, *tension, core)
    concrete04.constants(-fc, -peak, -cover_ultimate, *tension, cover)
    moduli = (values[name] for name in ("fy", "fu", "Es", "Esh"))
    reinforcing_steel.constants(*moduli, steel.hardening_strain, steel.ultimate_strain, sections.steel)
    if model.fatigue is not None:
        bar_fatigue.constants(values["Cf"], model.fatigue.alpha, values["Cd"], sections.failure)


def _reason(status: int, n_steps: int, at: str, halvings: int, sections: Sections) -> str:
    if status < 0:
        return "the gravity load did not converge: the section cannot carry it at these parameters"
    reason = f"step {status} of {n_steps}{at} did not converge, halved {halvings} times"
    if sections.failure.shape[0] == 0:
        return reason
    broken = sections.steel_memory[:, :, bar_fatigue.FRACTURED]
    lost = float((broken @ sections.bar_area[: broken.shape[1]]).max()) / float(sections.bar_area.sum())
    if lost == 0.0:
        return reason
    if lost > 1.0 - lost:  # with more broken than left, a column without equilibrium has collapsed
        reason = f"collapse: {reason}"
    return f"{reason}; bars with {lost:.0%} of the area of all bars in a section had fractured before"
