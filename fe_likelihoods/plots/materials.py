"""Figures of materials and sections: stress against strain, moment against curvature."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from ..units import from_si
from .style import BLUE, GREY, ORANGE, new_axes

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
    axes = _with_origin(new_axes(axes, (5.4, 4.0)))
    for curve, colour in zip(curves, _cycle(len(curves)), strict=True):
        stress = from_si(curve.stress, stress_unit, "stress")
        axes.plot(100.0 * curve.strain, stress, color=colour, linewidth=1.1, label=curve.name)
    axes.set(xlabel="strain [%]", ylabel=f"stress [{stress_unit}]")
    axes.legend(frameon=False, fontsize="small")
    return axes


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
    axes = _with_origin(new_axes(axes, (5.4, 4.0)))
    for (name, curve), colour in zip(many.items(), _cycle(len(many)), strict=True):
        force = f"axial force {1e-3 * curve.axial_force:.5g} kN"
        label = f"{name}, {force}" if name else force
        axes.plot(curve.curvature, 1e-3 * curve.moment, color=colour, linewidth=1.3, label=label)
    axes.set(xlabel="curvature [1/m]", ylabel="moment [kN m]")
    axes.legend(frameon=False, fontsize="small", loc="best")
    return axes


def _with_origin(axes: Axes) -> Axes:
    for line in (axes.axhline, axes.axvline):
        line(0.0, color="0.75", linewidth=0.7, zorder=0)
    axes.grid(alpha=0.25)
    return axes


def _cycle(n: int) -> list[str]:
    return [_COLOURS[i % len(_COLOURS)] for i in range(n)]
