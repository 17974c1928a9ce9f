"""What a model can show of itself: its response beside the data, its section, its hysteresis loops.

Each function draws what a model or its history holds; those models have methods of one line that call them. Histories
and single loops are drawn by `fe_likelihoods.plots.histories`. Everything is in the display units of the channels; a moment is
in units of force times length, a curvature in one over length.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..models.rc_column_parts import Patches
from ..signals.channels import Measurements
from ..signals.records import Record
from ..units import from_si
from .histories import BLUE, ORANGE, plot_histories, plot_loop

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..models.isolated_bridge import BridgeHistory
    from ..models.rc_column import ColumnHistory, RCColumn
    from ..simulation.model import Model

__all__ = ["plot_bearing_loops", "plot_column_loops", "plot_response", "plot_section"]

_CORE = "#b9cfe4"


def plot_response(model: Model, theta: np.ndarray, measurements: Measurements | None = None) -> Figure:
    """Response of a model at one set of parameters, channel by channel, and what was measured.

    Parameters
    ----------
    model : Model
        Any with `channels`, `dt` and `simulate`.
    theta : (n_parameters,) float
    measurements : Measurements, optional
        Drawn below the response; its channels are those that are shown.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    SimulationFailed
        As ``model.simulate``.
    ValueError
        If the measurements name a channel of the model that measures something else.
    """
    response = Measurements(model.channels, model.dt, model.simulate(theta))
    shaken = isinstance(getattr(model, "loading", None), Record | None)
    return plot_histories(measurements, response, time_label="time [s]" if shaken else "step")


def plot_section(column: RCColumn, axes: Axes | None = None) -> Axes:
    """Circular section: cover, core inside the hoops, mesh of the concrete, and bars, to scale.

    The direction of loading is horizontal: positions on that axis are the `y` of the fibers.

    Parameters
    ----------
    column : RCColumn
    axes : matplotlib Axes, optional
        Where to draw; by default a new figure.

    Returns
    -------
    matplotlib Axes
    """
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection, PatchCollection
    from matplotlib.patches import Circle, Patch

    if axes is None:
        _, axes = plt.subplots(figsize=(6.4, 6.6), layout="constrained")
    unit = _length_unit(column)
    radius, core_radius = (float(from_si(0.5 * d, unit)) for d in (column.diameter, column.core_diameter))
    cover = axes.add_patch(Circle((0.0, 0.0), radius, facecolor="#d7dade", edgecolor="0.35", label="cover concrete"))
    hoops = column.hoops
    ring = f"core concrete, in hoops of {from_si(hoops.diameter, unit):.3g} {unit} every "
    ring += f"{from_si(hoops.spacing, unit):.3g} {unit}"
    core = axes.add_patch(Circle((0.0, 0.0), core_radius, facecolor=_CORE, edgecolor=BLUE, linewidth=2.0, label=ring))
    kind = "rings and wedges" if isinstance(column.mesh, Patches) else f"{column.mesh} strips"
    lines = _mesh_lines(column.mesh, radius, core_radius)
    axes.add_collection(LineCollection(lines, colors="white", linewidths=0.9))
    mesh = Patch(facecolor=_CORE, edgecolor="white", hatch="|||", label=kind)
    bars = column.bars
    angles = bars.first_angle + 2.0 * np.pi * np.arange(bars.number) / bars.number
    place = float(from_si(column._bar_radius, unit))
    circles = [Circle((place * np.cos(a), place * np.sin(a)), from_si(0.5 * bars.diameter, unit)) for a in angles]
    text = f"{bars.number} bars of {from_si(bars.diameter, unit):.3g} {unit}"
    steel = PatchCollection(circles, facecolor=ORANGE, edgecolor="0.25", linewidth=0.7, label=text, zorder=3)
    axes.add_collection(steel)
    axes.set_aspect("equal")
    axes.set(xlim=(-1.06 * radius, 1.06 * radius), ylim=(-1.06 * radius, 1.06 * radius))
    axes.set(xlabel=f"position in the direction of loading [{unit}]", ylabel=f"across it [{unit}]")
    title = f"diameter {2.0 * radius:.4g} {unit}, clear cover {from_si(column.cover, unit):.3g} {unit}"
    axes.set_title(title, fontsize="medium")
    handles = [cover, core, mesh, steel]
    axes.legend(
        handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), frameon=False, fontsize="small", ncols=2
    )
    return axes


def plot_column_loops(column: RCColumn, history: ColumnHistory) -> Figure:
    """Base moment against curvature, and restoring force against displacement of the top.

    Parameters
    ----------
    column : RCColumn
        For its display units.
    history : ColumnHistory
        Of ``column.history(theta)``, under base acceleration or imposed displacement.

    Returns
    -------
    matplotlib Figure
    """
    import matplotlib.pyplot as plt

    length, force = _length_unit(column), dict(column.units).get("force", "kN")
    one_length, one_force = 1.0 / from_si(1.0, length), 1.0 / from_si(1.0, force)
    displacement = "displacement" if "displacement" in history.names else "relative displacement"
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.6, 4.2), layout="constrained")
    plot_loop(
        history["base curvature"] * one_length,
        history["base moment"] / (one_force * one_length),
        left,
        x_label=f"curvature [1/{length}]",
        y_label=f"moment [{force} {length}]",
        title="base section",
    )
    plot_loop(
        from_si(history[displacement], length),
        from_si(history["force"], force),
        right,
        x_label=f"displacement [{length}]",
        y_label=f"restoring force [{force}]",
        title="top",
    )
    left.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3))
    figure.suptitle(column.loading.name, fontsize="small")
    return figure


def plot_bearing_loops(history: BridgeHistory) -> Figure:
    """Isolator force (friction, rubber and dampers) against bearing displacement, at both piers on common axes.

    Parameters
    ----------
    history : BridgeHistory
        Of ``bridge.history(theta)``.

    Returns
    -------
    matplotlib Figure
    """
    import matplotlib.pyplot as plt

    figure, pair = plt.subplots(1, 2, figsize=(9.6, 4.2), sharex=True, sharey=True, layout="constrained")
    for i, axes in enumerate(pair, 1):
        plot_loop(
            from_si(history[f"Ub_{i}"], "mm"),
            from_si(history[f"Fb_{i}"], "kN"),
            axes,
            x_label="bearing displacement [mm]",
            y_label="isolator force [kN]" if i == 1 else "",
            title=f"pier {i}",
        )
    return figure


def _length_unit(column: RCColumn) -> str:
    return dict(column.units).get("displacement", "m")


def _mesh_lines(mesh: int | Patches, radius: float, core_radius: float) -> list[np.ndarray]:
    """Lines between fibers, each (n, 2): chords of the strips, or circles and radii of the patches."""
    if not isinstance(mesh, Patches):
        edges = np.linspace(-radius, radius, mesh + 1)[1:-1]
        return [np.array([[y, -h], [y, h]]) for y, h in zip(edges, np.sqrt(radius**2 - edges**2), strict=True)]
    around = np.linspace(0.0, 2.0 * np.pi, 200)
    rings = [*np.linspace(0.0, core_radius, mesh.core_rings + 1)[1:-1]]
    rings += [*np.linspace(core_radius, radius, mesh.cover_rings + 1)[1:-1]]
    lines = [r * np.column_stack([np.cos(around), np.sin(around)]) for r in rings]
    angles = 2.0 * np.pi * np.arange(mesh.wedges) / mesh.wedges
    return lines + [np.array([[0.0, 0.0], [radius * np.cos(a), radius * np.sin(a)]]) for a in angles]
