"""Figures of structures: the section of a column, sensors, and hysteresis loops.

Values are drawn in the display units of the model. Moments have units of force times length, curvatures one over
length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..models.isolated_bridge import IsolatedBridge
from ..units import from_si
from .style import BLUE, GREY, ORANGE, add_legend, new_axes, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..models.base import History
    from ..models.rc_column import RCColumn

_CORE = "#b9cfe4"


def plot_section(column: RCColumn, axes: Axes | None = None) -> Axes:
    """Plot a circular section to scale: cover, core inside the hoops, mesh of the concrete, and bars.

    The horizontal axis points in the direction of positive displacements, against the coordinate `y` of the fibers.

    Parameters
    ----------
    column : RCColumn
        The column, such as `fe_likelihoods.RCColumn`.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.

    Returns
    -------
    matplotlib Axes
        The axes with the figure.

    Examples
    --------
    >>> axes = plot_section(column)
    """
    from matplotlib.collections import LineCollection, PatchCollection
    from matplotlib.patches import Circle, Patch

    axes = new_axes(axes, (6.4, 6.6))
    unit = _length_unit(column)
    radius, core_radius = (float(from_si(0.5 * d, unit)) for d in (column.diameter, column.core_diameter))
    cover = axes.add_patch(Circle((0.0, 0.0), radius, facecolor="#d7dade", edgecolor="0.35", label="cover concrete"))
    hoops = column.hoops
    ring = (
        f"core concrete, hoops {from_si(hoops.diameter, unit):.3g} {unit} at {from_si(hoops.spacing, unit):.3g} {unit}"
    )
    core = axes.add_patch(Circle((0.0, 0.0), core_radius, facecolor=_CORE, edgecolor=BLUE, linewidth=2.0, label=ring))
    lines = _mesh_lines(column.analysis.mesh, radius)
    axes.add_collection(LineCollection(lines, colors="white", linewidths=0.9))
    mesh = Patch(facecolor=_CORE, edgecolor="white", hatch="|||", label=f"{column.analysis.mesh} strips")
    bars = column.bars
    angles = bars.first_angle + 2.0 * np.pi * np.arange(bars.number) / bars.number
    place = float(from_si(column.bar_circle_radius, unit))
    circles = [Circle((-place * np.cos(a), place * np.sin(a)), from_si(0.5 * bars.diameter, unit)) for a in angles]
    text = f"{bars.number} bars, diameter {from_si(bars.diameter, unit):.3g} {unit}"
    steel = PatchCollection(circles, facecolor=ORANGE, edgecolor="0.25", linewidth=0.7, label=text, zorder=3)
    axes.add_collection(steel)
    axes.set_aspect("equal")
    axes.set(xlim=(-1.06 * radius, 1.06 * radius), ylim=(-1.06 * radius, 1.06 * radius))
    axes.set(xlabel=f"position in the direction of loading [{unit}]", ylabel=f"position across it [{unit}]")
    title = f"diameter {2.0 * radius:.4g} {unit}, clear cover {from_si(column.cover, unit):.3g} {unit}"
    axes.set_title(title, fontsize="medium")
    handles = [cover, core, mesh, steel]
    add_legend(axes, handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    return axes


def plot_sensors(column: RCColumn, axes: Axes | None = None, ranks: Sequence[str] = ()) -> Axes:
    """Plot where the sensors of a column are: its elevation with every channel at its place.

    Parameters
    ----------
    column : RCColumn
        The column; its channels have the names of its outputs.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.
    ranks : sequence of str
        Channels, the best first, such as ``rank_sensors(...).chosen``: they are numbered, and the labels of all other
        channels are left out. Default: labels of all channels.

    Returns
    -------
    matplotlib Axes
        The axes with the figure, in metres.

    Raises
    ------
    ValueError
        If a rank is of no channel.

    Examples
    --------
    >>> axes = plot_sensors(RCColumn.lhpost(record, outputs=("displacement", "strain@0.1:0.5")))
    """
    names, ranks = [channel.name for channel in column.channels], list(ranks)
    if unknown := [name for name in ranks if name not in names]:
        raise ValueError(f"ranks has the unknown channels {', '.join(unknown)}; the channels are {', '.join(names)}")
    axes = new_axes(axes, (6.8, 6.4))
    radius, height = 0.5 * column.diameter, column.height
    _draw_column(axes, column)
    places = sorted((_draw_sensor(axes, column, name, bool(ranks) and name not in ranks) for name in names), key=_rank)
    places = [each for each in places if not ranks or each[2] in ranks]
    ends = _label_heights([z for _, z, _ in places], height)
    for (x, z, name), end in zip(places, ends, strict=True):
        label = f"{ranks.index(name) + 1}. {name}" if ranks else name
        axes.plot([x, 2.4 * radius, 2.8 * radius], [z, end, end], color=GREY, linewidth=0.6, zorder=1)
        axes.text(2.85 * radius, end, label, va="center", fontsize="small")
    axes.set(xlim=(-2.4 * radius, 6.5 * radius), ylim=(-0.07 * height, 1.1 * height))
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    return axes


def _draw_column(axes: Axes, column: RCColumn) -> None:
    from matplotlib.patches import Rectangle

    radius, height = 0.5 * column.diameter, column.height
    axes.add_patch(Rectangle((-radius, 0.0), 2.0 * radius, height, facecolor="#e9ebee", edgecolor="0.5"))
    axes.add_patch(Rectangle((-2.2 * radius, -0.05 * height), 4.4 * radius, 0.05 * height, facecolor="0.6"))
    axes.add_patch(Rectangle((-1.4 * radius, height), 2.8 * radius, 0.06 * height, facecolor="0.8", edgecolor="0.5"))
    axes.hlines(np.unique(column.section_heights), -radius, radius, color="0.65", linestyle=":", linewidth=1.0)
    axes.set(xlabel="position in the direction of loading [m]", ylabel="height above the base [m]")
    axes.set_xticks([-radius, 0.0, radius], [f"{x:.3g}" for x in (-radius, 0.0, radius)])
    axes.set_title("dotted: sections of the elements", fontsize="small")


def _draw_sensor(axes: Axes, column: RCColumn, name: str, faint: bool) -> tuple[float, float, str]:
    """Draw one sensor at its place, faintly or not; return the place at which its label points, and its name."""
    alpha, radius = 0.35 if faint else 1.0, 0.5 * column.diameter
    kind, _, numbers = name.partition("@")
    at_top = kind in ("acceleration", "relative_acceleration", "velocity", "displacement", "force")
    place = [float(number) for number in numbers.split(":")] if numbers else [column.height if at_top else 0.0]
    if kind in ("strain", "bar_stress", "concrete_stress"):
        axes.plot(place[1], place[0], "o", color=ORANGE, markersize=5, zorder=3, alpha=alpha)
        return place[1], place[0], name
    if kind == "curvature":
        axes.plot([-radius, radius], [place[0]] * 2, color=BLUE, linewidth=2.0, zorder=2, alpha=alpha)
        return radius, place[0], name
    if kind == "rotation":
        axes.plot(
            [1.2 * radius] * 2, place, color=ORANGE, marker="_", markersize=9, linewidth=1.6, zorder=2, alpha=alpha
        )
        return 1.2 * radius, 0.5 * (place[0] + place[1]), name
    axes.plot(0.0, place[0], "s", color="0.25", markersize=5, zorder=3, alpha=alpha)
    return 0.0, place[0], name


def _label_heights(heights: list[float], height: float) -> list[float]:
    """Heights of labels, in order, as close to their sensors' heights as an even minimum distance allows."""
    gap = min(height / max(1, len(heights) - 1), 0.05 * height)
    ends: list[float] = []
    for k, z in enumerate(heights):
        lowest = ends[-1] + gap if ends else 0.0
        ends.append(min(max(z, lowest), height - gap * (len(heights) - 1 - k)))
    return ends


def _rank(place: tuple[float, float, str]) -> tuple[float, float]:
    """Order of labels from the base up; at the same height, the sensor nearest to the labels comes highest."""
    x, z, _ = place
    return z, x


def plot_hysteresis(model: RCColumn | IsolatedBridge, theta: np.ndarray) -> Figure:
    """Plot the hysteresis loops of a built-in model at `theta`, of which one simulation is run.

    Parameters
    ----------
    model : RCColumn or IsolatedBridge
        For a column, base moment against curvature, and restoring force against displacement of the top. For the
        bridge, isolator force (friction, rubber and dampers) against bearing displacement of both piers.
    theta : ndarray[n_parameters]
        Values of ``model.parameter_names``, in this order.

    Returns
    -------
    matplotlib Figure
        The figure, with two axes.

    Raises
    ------
    SimulationFailed, ValueError
        As ``model.history``.

    Examples
    --------
    >>> figure = plot_hysteresis(column, np.ones(5))
    """
    if isinstance(model, IsolatedBridge):
        outputs = [f"{kind}_{i}" for i in (1, 2) for kind in ("Ub", "Fb")]
        return _bearing_loops(replace(model, every=1, outputs=outputs).simulate(theta))
    return _column_loops(model, model.history(theta))


def _draw_loop(axes: Axes, x: np.ndarray, y: np.ndarray, x_label: str, y_label: str, title: str) -> None:
    """Draw a hysteresis loop, such as force (n_steps,) against displacement, with a dot at its end."""
    for line in (axes.axhline, axes.axvline):
        line(0.0, color="0.75", linewidth=0.7, zorder=0)
    axes.plot(x, y, color=BLUE, linewidth=0.7)
    axes.plot(x[-1], y[-1], "o", color=ORANGE, markersize=4, label="end")
    add_legend(axes, loc="upper left")
    axes.set(xlabel=x_label, ylabel=y_label, title=title)


def _column_loops(column: RCColumn, history: History) -> Figure:
    """Base moment against curvature, and force against displacement of the top, from the histories [SI]."""
    length, force = _length_unit(column), dict(column.units).get("force", "kN")
    one_length, one_force = 1.0 / from_si(1.0, length), 1.0 / from_si(1.0, force)
    displacement = "displacement" if "displacement" in history.names else "relative displacement"
    figure, ((left, right),) = new_figure(1, 2, (9.6, 4.2))
    curvature, moment = history["base curvature"] * one_length, history["base moment"] / (one_force * one_length)
    _draw_loop(left, curvature, moment, f"curvature [1/{length}]", f"moment [{force} {length}]", "base section")
    moved, restoring = from_si(history[displacement], length), from_si(history["force"], force)
    _draw_loop(right, moved, restoring, f"displacement [{length}]", f"restoring force [{force}]", "top")
    left.ticklabel_format(axis="x", style="sci", scilimits=(-2, 3))
    figure.suptitle(column.loading.name, fontsize="small")
    return figure


def _bearing_loops(histories: np.ndarray) -> Figure:
    """Isolator force against bearing displacement, histories of both in turn for either pier [SI]."""
    figure, (pair,) = new_figure(1, 2, (9.6, 4.2), sharex=True, sharey=True)
    for i, axes in enumerate(pair, 1):
        y_label = "isolator force [kN]" if i == 1 else ""
        moved, force = from_si(histories[2 * i - 2], "mm"), from_si(histories[2 * i - 1], "kN")
        _draw_loop(axes, moved, force, "bearing displacement [mm]", y_label, f"pier {i}")
    return figure


def _length_unit(column: RCColumn) -> str:
    return dict(column.units).get("displacement", "m")


def _mesh_lines(mesh: int, radius: float) -> list[np.ndarray]:
    """Return the chords between the strips, each (2, 2)."""
    edges = np.linspace(-radius, radius, mesh + 1)[1:-1]
    return [np.array([[y, -h], [y, h]]) for y, h in zip(edges, np.sqrt(radius**2 - edges**2), strict=True)]
