"""Figures of materials and sections: stress against strain, moment against curvature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING

from ..units import from_si
from .style import BLUE, GREY, ORANGE, add_legend, new_axes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..models.rc_column_curves import MaterialCurve, MomentCurvature

__all__ = ["plot_material", "plot_moment_curvature"]

_COLOURS = (BLUE, ORANGE, GREY, "#4c8c4a", "#8c4a6e")


def plot_material(*curves: MaterialCurve, axes: Axes | None = None, stress_unit: str = "MPa") -> Axes:
    """Plot stress against strain of one or more materials.

    Parameters
    ----------
    *curves : MaterialCurve
        The curves, such as the results of `fe_likelihoods.material_curves`.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.
    stress_unit : str
        Unit of the stress; strains are in per cent.

    Returns
    -------
    matplotlib Axes
        The axes with the figure.

    Raises
    ------
    ValueError
        If there is no curve, or a unit is unknown or of another quantity.

    Examples
    --------
    >>> core, cover, steel = material_curves(column, np.ones(5))
    >>> axes = plot_material(core, cover)
    """
    if not curves:
        raise ValueError("expected one or more curves; got none; give the results of material_curves(column, theta)")
    lines = [(100.0 * curve.strain, from_si(curve.stress, stress_unit, "stress"), curve.name) for curve in curves]
    return _loops(axes, lines, "strain [%]", f"stress [{stress_unit}]")


def plot_moment_curvature(curves: MomentCurvature | Mapping[str, MomentCurvature], axes: Axes | None = None) -> Axes:
    """Plot moment [kN m] against curvature [1/m] of one or more sections.

    Parameters
    ----------
    curves : MomentCurvature, or a mapping from labels to them
        The curves, such as the result of `fe_likelihoods.moment_curvature`.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.

    Returns
    -------
    matplotlib Axes
        The axes with the figure. The labels have the axial force, positive in tension.

    Examples
    --------
    >>> axes = plot_moment_curvature(moment_curvature(column, np.ones(5), np.linspace(0.0, 0.03, 50)))
    """
    many = dict(curves) if isinstance(curves, Mapping) else {"": curves}
    lines = []
    for name, curve in many.items():
        force = f"axial force {1e-3 * curve.axial_force:.5g} kN"
        lines.append((curve.curvature, 1e-3 * curve.moment, f"{name}, {force}" if name else force))
    return _loops(axes, lines, "curvature [1/m]", "moment [kN m]")


def _loops(axes: Axes | None, lines: Sequence[tuple], xlabel: str, ylabel: str) -> Axes:
    """Plot lines (x, y, label) about the origin."""
    axes = new_axes(axes, (5.4, 4.0))
    for line in (axes.axhline, axes.axvline):
        line(0.0, color="0.75", linewidth=0.7, zorder=0)
    axes.grid(alpha=0.25)
    for (x, y, label), colour in zip(lines, cycle(_COLOURS), strict=False):
        axes.plot(x, y, color=colour, linewidth=1.2, label=label)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    add_legend(axes)
    return axes
