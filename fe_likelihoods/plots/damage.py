"""The figure of damage: a column with the probability of every limit state at every section and side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from .style import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..column_damage.damage import Damage

__all__ = ["plot_damage"]

_COLOURS = ("#eef1f4", "#fbdca6", "#e8893a", "#a81c1c")
"""Colours of the probabilities from 0 to 1."""
_EXTENT = (
    ("peak drift", "peak drift", 100.0, "%"),
    ("residual drift", "residual drift", 100.0, "%"),
    ("dissipated energy", "energy", 1e-3, "kJ"),
    ("Park-Ang index", "Park-Ang index", 1.0, ""),
)
"""Measures that are written beside the columns: name, label, factor, unit."""


def plot_damage(damage: Damage) -> Figure:
    """Draw the column after each event with the probabilities of its limit states.

    Each row is an event and each column a limit state of strains. The two sides of every section are coloured by the
    probability that the limit was exceeded there, with the probability in per cent; the title has the probability that
    it was exceeded anywhere. At the right are the other probabilities, and the quantiles of the measures: the middle
    one of `probabilities` with the range from the lowest to the highest.

    Parameters
    ----------
    damage : Damage
        The result of `fe_likelihoods.damage` for a column.

    Returns
    -------
    matplotlib Figure
        The figure. Heights are to scale, widths are not.

    Raises
    ------
    ValueError
        If there are no limit states of strains.

    Examples
    --------
    >>> from dataclasses import replace
    >>> quiet = record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0)
    >>> complete = RCColumn.lhpost(quiet)
    >>> complete = replace(complete, outputs=damage_outputs(complete))
    >>> predicted = propagate(complete, np.ones((3, 5)), quantity=damage_measures(complete))
    >>> figure = plot_damage(damage(predicted, noise=False))
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    located = list(damage.location)
    if not located:
        raise ValueError(
            "the figure needs probabilities at sections: damage of an RCColumn with the measures 'bar tension' and "
            "'cover compression' and limit states of them; use damage.table() otherwise"
        )
    colours = LinearSegmentedColormap.from_list("probability", _COLOURS)
    widths = [*[1.0] * len(located), 2.2]
    size = (1.5 * sum(widths) + 0.6, 2.75 * len(damage.events) + 1.0)
    figure, panels = new_figure(len(damage.events), len(widths), size, grid=False, width_ratios=widths)
    for event, (row, name) in enumerate(zip(panels, damage.events, strict=True)):
        for axes, state in zip(row, located, strict=False):
            _draw_column(axes, damage, state, event, colours)
        row[0].set_ylabel(f"{name}\nheight [m]")
        _write_extent(row[-1], damage, event, [state for state in damage.presence if state not in located])
    bar = figure.colorbar(
        ScalarMappable(Normalize(0.0, 1.0), colours), ax=panels[:, :-1], location="bottom", aspect=50, pad=0.02
    )
    label = f"probability, from {damage.prediction.effective_sample_size:.0f} effective samples; {damage.uncertainty}"
    bar.set_label(label + (f"\n{damage.failures}" if damage.failures else ""), fontsize=7)
    bar.ax.tick_params(labelsize=7)
    return figure


def _draw_column(axes: Axes, damage: Damage, state: str, event: int, colours) -> None:
    """Draw one column with the probabilities of one limit state after one event."""
    from matplotlib.patches import Rectangle

    height, heights = damage.prediction.quantity.height, damage.prediction.quantity.heights
    probability = damage.location[state].probability[event]
    axes.add_patch(Rectangle((-1.7, -0.06 * height), 3.4, 0.06 * height, facecolor="0.55"))
    axes.add_patch(Rectangle((-1.4, height), 2.8, 0.07 * height, facecolor="0.78", edgecolor="0.5", linewidth=0.6))
    edges = [0.0, *(0.5 * (heights[1:] + heights[:-1])), height]
    for k, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        for side, left in enumerate((-1.0, 0.0)):
            p = float(probability[k, side])
            axes.add_patch(
                Rectangle((left, low), 1.0, high - low, facecolor=colours(p), edgecolor="0.6", linewidth=0.6)
            )
            if p > 0.0:
                ink = "white" if p > 0.6 else "0.1"
                text = _per_cent(p)
                axes.text(left + 0.5, 0.5 * (low + high), text, ha="center", va="center", fontsize=8, color=ink)
    whole = damage.presence[state]
    title = f"{state}\n{_per_cent(float(whole.probability[event]))} %"
    if 0.0 < whole.probability[event] < 1.0:
        title += rf" $\pm$ {100.0 * whole.standard_error[event]:.1f}"
    axes.set_title(title, fontsize=9, fontweight="bold" if whole.probability[event] >= 0.5 else "normal")
    axes.set(xlim=(-1.75, 1.75), ylim=(-0.06 * height, 1.08 * height))
    axes.set_xticks([-0.5, 0.5], ["\N{MINUS SIGN} side", "+ side"], fontsize=7)
    axes.set_yticks(heights, [f"{z:.1f}" for z in heights], fontsize=7)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _per_cent(probability: float) -> str:
    """Return a probability in per cent; 0 and 100 only where none or all of the samples exceed."""
    value = 100.0 * probability
    if 0.0 < value < 1.0:
        return "<1"
    return ">99" if 99.0 < value < 100.0 else f"{value:.0f}"


def _number(value: float) -> str:
    """Return a number with three significant digits and without an exponent, and where it is small a bound of it."""
    if 0.0 < value < 1e-3:
        return "<0.001"
    return np.format_float_positional(value, precision=3, unique=False, fractional=False, trim="-")


def _write_extent(axes: Axes, damage: Damage, event: int, states: Sequence[str]) -> None:
    """Write the probabilities of limit states without a place, and the quantiles of the measures."""
    axes.set_axis_off()
    lines = []
    if damage.prediction.probabilities:
        order = np.argsort(damage.prediction.probabilities)
        low, middle, high = order[0], order[len(order) // 2], order[-1]
        for name, label, factor, unit in _EXTENT:
            if name in damage.extent:
                values = factor * damage.extent[name][:, event]
                text = _number(values[middle]) + (f" {unit}" if unit else "")
                ends = _number(values[low]), _number(values[high])
                between = " to ".join(ends) if ends[0] != ends[1] else ""
                lines.append((label, text, between))
    for state in states:
        lines.append((f"P({state})", f"{_per_cent(float(damage.presence[state].probability[event]))} %", ""))
    for k, (label, text, between) in enumerate(lines):
        y = 0.97 - 0.094 * k
        axes.text(0.0, y, label, transform=axes.transAxes, fontsize=8, va="top")
        axes.text(0.47, y, text, transform=axes.transAxes, fontsize=8, va="top", ha="left", fontweight="bold")
        axes.text(0.74, y - 0.008, between, transform=axes.transAxes, fontsize=6.5, va="top", color="0.35")
