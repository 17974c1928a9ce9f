"""Analysis of the reinforced-concrete column: material constants of the kernels, and the two kinds of excitation.

A base acceleration is integrated by Newmark's method (`fe_likelihoods.kernels.newmark`), an imposed displacement of the
top is solved as a sequence of static steps (`fe_likelihoods.kernels.static`). Both start from the gravity load.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..kernels import bar_fatigue, concrete04, reinforcing_steel
from ..kernels.fiber_section import Sections
from ..kernels.frame import Column, recorder
from ..kernels.newmark import HISTORY_ROWS, Dynamics, newmark
from ..kernels.static import Iteration, impose_displacement
from ..signals.records import DisplacementHistory, Record
from ..simulation.model import SimulationFailed
from .base import BuiltInModel, History, remark_on_range
from .circular_section import Confinement
from .rc_column_parts import Concrete, LowCycleFatigue, Steel, hardening_fault
from .validation import check_values, invalid

__all__ = [
    "Analysis",
    "BaseMotion",
    "ColumnHistory",
    "ImposedMotion",
    "ToRecord",
    "check_loading",
    "check_physical_values",
    "checked_history",
    "expect_fracture",
    "set_materials",
]


LARGEST_DRIFT = 0.5
"""Largest imposed displacement by the height; tested columns have failed at 0.05 to 0.15."""

LOST_BARS = 0.5
"""Share of the bar area in a section: with more fractured bars, a column without equilibrium has collapsed."""

_MAY_BE_ZERO = ("a0", "a1", "ft", "penetration")

IMPOSED_ROWS = (
    "displacement",
    "vertical displacement",
    "rotation",
    "force",
    "base axial strain",
    "base curvature",
    "base axial force",
    "base moment",
    "base shear",
)


@dataclass(frozen=True)
class ColumnHistory(History):
    """Time histories of one simulation of the column [SI].

    Above 1, `beyond_range` means that the steel law was continued along its tangent where real bars fracture; this
    warns once per model, also for simulations from a cache on disk. `bar_damage` is Miner's sum of each bar of
    ``model.section.fibers()[2]`` at the last sample, in its worst section: a bar has fractured above 1; two bars at the
    same position count as one. `lowerings` counts how often the column could not carry the axial load at an imposed
    displacement, and its top came down until the cracks were closed (``docs/theory/time_integration.rst``); 0 under a
    base acceleration.
    """

    retries: int  # steps repeated with half their size
    beyond_range: float  # largest strain of a bar in the base section / ultimate strain of the steel
    bar_damage: np.ndarray | None = None  # (n_bars,); None without fatigue
    lowerings: int = 0


class ToRecord(NamedTuple):
    """What an analysis shall record besides its rows."""

    sections: bool = False  # deformations of all sections
    motion: bool = False  # motion of all nodes
    fibers: tuple[tuple[int, int], ...] = ()  # section and number of fibers, for stresses (`Recorder`)


class Analysis(NamedTuple):
    """Result of one analysis; what was not recorded has no steps, (0, ...)."""

    names: tuple[str, ...]
    values: np.ndarray  # (n_rows, n_steps), the rows of `names`
    retries: int  # steps repeated with half their size
    sections: np.ndarray  # (n_steps, n_sections, 2) axial strain and curvature [1/m], from the base up
    motion: np.ndarray  # (n_steps, 1 or 3, n_dof) of the nodes relative to the base
    stresses: np.ndarray  # (n_steps, n_fibers) of the recorded fibers [Pa]
    ground: np.ndarray | None = None  # (n_steps,) base acceleration [m/s²]
    lowerings: int = 0  # as of `ColumnHistory`


class BaseMotion(NamedTuple):
    """Base acceleration, interpolated to the integration steps."""

    acceleration: np.ndarray  # (n_substeps + 1,) at the integration steps [m/s²]
    dt: float  # integration step [s]
    substeps: int  # integration steps per sample of the response
    n_steps: int  # response samples

    @classmethod
    def of(cls, record: Record, substeps: int) -> BaseMotion:
        """Motion of a record, linear between its samples."""
        instants = np.arange((record.n_steps - 1) * substeps + 1) / substeps
        acceleration = np.interp(instants, np.arange(record.n_steps), record.acceleration)
        return cls(acceleration, record.dt / substeps, substeps, record.n_steps)

    def run(self, column: Column, dynamics: Dynamics, iteration: Iteration, recorded: ToRecord) -> Analysis:
        """Integrate the equations of motion to `HISTORY_ROWS`; SimulationFailed at collapse, or without convergence."""
        history = np.zeros((len(HISTORY_ROWS), self.n_steps))
        out = recorder(
            column, self.n_steps, sections=recorded.sections, motion=3 * recorded.motion, fibers=recorded.fibers
        )
        loading = self.acceleration, self.dt, self.substeps
        status, retries, _ = newmark(column, dynamics, *loading, iteration, history, out)
        if status < -1:
            raise SimulationFailed(
                f"collapse: at t = {-(status + 1) * self.dt:.4g} s, the displacement of the top exceeded the limit of "
                f"{dynamics.collapse:.4g} m (collapse_drift)"
            )
        if status:
            at = f" (t = {status * self.dt:.4g} s)"
            raise SimulationFailed(_reason(status, len(self.acceleration), at, iteration.halvings, column.sections))
        ground = self.acceleration[:: self.substeps]
        return Analysis(HISTORY_ROWS, history, retries, _by_section(out.sections), out.motion, out.stresses, ground)


class ImposedMotion(NamedTuple):
    """Lateral displacement imposed on the top."""

    targets: np.ndarray  # (n_increments,) displacements in their order [m]
    kept: np.ndarray  # (n_steps,) indices of the targets that are samples of the response

    @classmethod
    def of(cls, history: DisplacementHistory, max_increment: float) -> ImposedMotion:
        """Motion of a displacement history in increments of at most `max_increment` [m]."""
        finer = history.subdivide(max_increment)
        return cls(np.asarray(finer.history.displacement), np.asarray(finer.indices))

    def run(self, column: Column, gravity: np.ndarray, iteration: Iteration, recorded: ToRecord) -> Analysis:
        """Solve the static equilibrium at each target, as `IMPOSED_ROWS`; SimulationFailed without convergence."""
        history = np.zeros((len(IMPOSED_ROWS), len(self.targets)))
        n = len(self.targets)
        out = recorder(column, n, sections=recorded.sections, motion=int(recorded.motion), fibers=recorded.fibers)
        status, retries, lowerings = impose_displacement(column, gravity, self.targets, iteration, history, out)
        if status:
            raise SimulationFailed(_reason(status, len(self.targets), "", iteration.halvings, column.sections))
        kept = [each[self.kept] if len(each) else each for each in (out.sections, out.motion, out.stresses)]
        return Analysis(IMPOSED_ROWS, history[:, self.kept], retries, *kept, None, lowerings)


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


def check_physical_values(values: dict[str, float], steel: Steel) -> None:
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


def checked_history(
    model: BuiltInModel,
    steel: Steel,
    bar_radius: float,
    analysis: Analysis,
    theta: np.ndarray,
    bar_damage: np.ndarray | None = None,
) -> ColumnHistory:
    """History of a simulation; warns once per model if bars exceed the strain at which real bars fracture.

    There is no warning if a bar has fractured in the simulation.
    """
    strain, curvature = (analysis.values[analysis.names.index(f"base {row}")] for row in ("axial strain", "curvature"))
    limit = steel.ultimate_strain
    beyond = float((np.abs(strain) + bar_radius * np.abs(curvature)).max()) / limit
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
    return ColumnHistory(analysis.names, analysis.values, analysis.retries, beyond, bar_damage, analysis.lowerings)


def expect_fracture(model: BuiltInModel) -> None:
    """Give no warning if bars of this model exceed the strain at which real bars fracture: it is pushed to failure."""
    remark_on_range(model, "")


def set_materials(
    sections: Sections,
    values: dict[str, float],
    concrete: Concrete,
    steel: Steel,
    confinement: Confinement,
    fatigue: LowCycleFatigue | None = None,
) -> None:
    """Write the constants of core, cover and bars at the physical parameter `values` [SI] into `sections`."""
    fc, ec, ft = values["fc"], values["Ec"], values["ft"]
    peak = concrete.peak_strain if concrete.peak_strain is not None else 2.0 * fc / ec
    core_peak = peak * confinement.strain_ratio
    core_ultimate = max(confinement.ultimate_strain, 1.05 * core_peak)
    cover_ultimate = max(concrete.ultimate_strain, 1.5 * peak)
    tension = (ec, ft, ft / ec + concrete.softening_strain, concrete.softening_ratio)
    core, cover = sections.concrete
    concrete04.constants(-fc * confinement.strength_ratio, -core_peak, -core_ultimate, *tension, core)
    concrete04.constants(-fc, -peak, -cover_ultimate, *tension, cover)
    reinforcing_steel.constants(
        values["fy"],
        values["fu"],
        values["Es"],
        values["Esh"],
        steel.hardening_strain,
        steel.ultimate_strain,
        sections.steel,
    )
    if fatigue is not None:
        bar_fatigue.constants(values["Cf"], fatigue.alpha, values["Cd"], sections.failure)


def _by_section(sections: np.ndarray) -> np.ndarray:
    """The same array with the samples of a section side by side in memory: hundreds of sensors are read faster."""
    return np.ascontiguousarray(sections.transpose(1, 2, 0)).transpose(2, 0, 1)


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
    if lost > LOST_BARS:
        reason = f"collapse: {reason}"
    return f"{reason}; bars with {lost:.0%} of the area of all bars in a section had fractured before"
