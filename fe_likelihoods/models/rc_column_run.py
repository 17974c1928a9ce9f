"""One simulation of the reinforced-concrete column."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..kernels import bar_fatigue
from ..kernels.frame import allocate
from ..kernels.newmark import Dynamics
from ..kernels.static import Iteration
from ..signals.records import Record
from ..units import G0
from .circular_section import gauss_lobatto
from .rc_column_analysis import (
    BaseMotion,
    ColumnHistory,
    ImposedMotion,
    ToRecord,
    check_physical_values,
    checked_history,
    set_materials,
)
from .rc_column_outputs import Output, Recording
from .rc_column_section import ReinforcedSection

__all__ = ["ColumnRun", "PreparedColumn", "prepare_column", "run_column"]


class PreparedColumn(NamedTuple):
    """Inputs of the kernels that are the same for every theta."""

    section: ReinforcedSection
    fibers: dict[str, np.ndarray]
    points: np.ndarray
    weights: np.ndarray
    motion: BaseMotion | ImposedMotion
    outputs: tuple[Output, ...]


class ColumnRun(NamedTuple):
    """Result of one simulation."""

    history: ColumnHistory  # histories of the kernels
    outputs: dict[str, np.ndarray]  # (n_steps,) each, by name


def prepare_column(model: Any, outputs: tuple[Output, ...]) -> PreparedColumn:
    """Inputs of the kernels for a column and its resolved outputs."""
    section = model.section
    core, cover, bars = section.fibers()
    if isinstance(model.loading, Record):
        motion = BaseMotion.of(model.loading, model.substeps)
    else:
        motion = ImposedMotion.of(model.loading, model.max_increment or model.height / 5000.0)
    fibers = dict(core=core, cover=cover, bars=bars)
    return PreparedColumn(section, fibers, *gauss_lobatto(model.n_points), motion, outputs)


def run_column(model: Any, prepared: PreparedColumn, theta: np.ndarray) -> ColumnRun:
    """Simulate for multiples `theta` (n_parameters,) of the nominal parameters.

    Raises SimulationFailed if the parameters describe no structure, the column collapses, or the solution does not
    converge.
    """
    values = model.physical_values(theta)
    check_physical_values(values, model.steel)
    column = allocate(
        n_elements=model.n_elements,
        height=model.height,
        corotational=model.geometry == "corotational",
        element_tolerance=model.element_tolerance,
        points=prepared.points,
        weights=prepared.weights,
        **prepared.fibers,
        penetration=values["penetration"],
        bars_fail=model.fatigue is not None,
    )
    confinement = prepared.section.confinement(values["fc"])
    set_materials(column.sections, values, model.concrete, model.steel, confinement, model.fatigue)
    iteration = Iteration(float(model.tolerance), int(model.max_iterations), int(model.halvings))
    fibers = tuple(dict.fromkeys(output.fiber for output in prepared.outputs if output.fiber is not None))
    recorded = ToRecord(
        any(output.curvature is not None for output in prepared.outputs),
        any(output.motion is not None for output in prepared.outputs),
        fibers,
    )
    own = np.full(model.n_elements, model.column_mass / model.n_elements)  # at the nodes
    own[-1] *= 0.5
    gravity = np.zeros(3 * model.n_elements)
    gravity[1::3] = -own * G0
    gravity[-2] -= model.axial_load if model.axial_load is not None else values["mass"] * G0
    if isinstance(prepared.motion, ImposedMotion):
        analysis = prepared.motion.run(column, gravity, iteration, recorded)
    else:
        own[-1] += values["mass"]
        mass = np.zeros((model.n_elements, 3))
        mass[:, 0], mass[:, 1], mass[-1, 2] = own, own * model.vertical_mass, model.rotational_inertia
        dynamics = Dynamics(
            gravity, mass.ravel(), float(values["a0"]), float(values["a1"]), 0.0, model.collapse_drift * model.height
        )
        analysis = prepared.motion.run(column, dynamics, iteration, recorded)
    rows = dict(zip(analysis.names, analysis.values, strict=True))
    stresses = dict(zip(fibers, analysis.stresses.T, strict=True))
    length = column.length if column.corotational else np.inf
    seen = Recording(rows, analysis.sections, analysis.motion, analysis.ground, stresses, values["penetration"], length)
    outputs = {output.name: output.evaluate(seen) for output in prepared.outputs}
    damage = None
    if model.fatigue is not None:
        damage = column.sections.steel_memory[:, :, bar_fatigue.DAMAGE].max(axis=0)
    history = checked_history(model, model.steel, model.bar_circle_radius, analysis, theta, damage)
    return ColumnRun(history, outputs)
