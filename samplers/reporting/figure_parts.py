"""Colours, tick labels and marks that the figures share. matplotlib is imported inside the functions."""

import re
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "BLUE",
    "COLOURS",
    "GREY",
    "ORANGE",
    "RED",
    "legend_lines",
    "mark_value",
    "set_ticks",
    "wrap_label",
]

BLUE = "#1f5a8c"
ORANGE = "#d9822b"
GREY = "#8a8f98"
RED = "#b03a48"
COLOURS = (BLUE, ORANGE, "#5b8c5a", "#7b5ea7", "#3aa0a8", "#6b4a2f")
"""Colours of several samplers; after the last one, the first comes again."""


def wrap_label(label: str, characters: int) -> str:
    """Break a label into lines of a number of characters: before its unit, after underscores and blanks, or anywhere.

    Formulas stay on one line.
    """
    if len(label) <= characters or "$" in label:
        return label
    lines = []
    for part in label.replace(" [", "\n[", 1).split("\n"):
        line = ""
        for piece in re.findall(rf"[^_ ]{{1,{characters - 1}}}[_ ]?|[_ ]", part):
            if line and len(line) + len(piece.rstrip()) > characters:
                lines.append(line.rstrip())
                line = ""
            line += piece
        lines.append(line.rstrip())
    return "\n".join(lines)


def set_ticks(axis, low: float, high: float, number: int = 3, size: float = 7.0) -> None:
    """Set a few ticks with all of their digits, and no offset in a corner of the axes.

    Parameters
    ----------
    axis : matplotlib Axis
    low, high : float
        Limits of the axis.
    number : int
        Largest number of intervals.
    size : float
        Font size [pt].
    """
    from matplotlib.ticker import MaxNLocator, StrMethodFormatter

    axis.set_major_locator(MaxNLocator(number, prune="both", min_n_ticks=2))
    largest = max(abs(low), abs(high))
    digits = int(np.clip(np.ceil(np.log10(largest / (high - low))) + 2, 3, 15)) if high > low and largest > 0.0 else 3
    axis.set_major_formatter(StrMethodFormatter(f"{{x:.{digits}g}}"))
    axis.set_tick_params(labelsize=size, length=2.5)


def mark_value(
    axes: "Axes",
    value: float,
    colour: str,
    style: str = "-",
    level: int = 0,
    label: bool = True,
    vertical: bool = False,
) -> None:
    """Mark a value on one axis by a line, or by an arrow at the edge beyond which it is, with the value.

    Parameters
    ----------
    axes : matplotlib Axes
        Axes whose limits are set.
    value : float
        NaN: no mark.
    colour, style : str
        Of the line.
    level : int
        Number of the mark among those of these axes, so that two arrows are above one another.
    label : bool
        Whether the value is written beside an arrow; without it, there is a line or nothing.
    vertical : bool
        Whether the value belongs to the vertical axis.
    """
    if not np.isfinite(value):
        return
    low, high = axes.get_ylim() if vertical else axes.get_xlim()
    if low <= value <= high:
        line = axes.axhline if vertical else axes.axvline
        line(value, color=colour, linestyle=style, linewidth=1.1)
        return
    if not label or vertical:
        return
    beyond = value > high
    height = 0.92 - 0.14 * level
    tip, tail = (0.995, 0.82) if beyond else (0.005, 0.18)
    arrow = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.1, "shrinkA": 0.0, "shrinkB": 0.0}
    axes.annotate("", (tip, height), (tail, height), xycoords="axes fraction", arrowprops=arrow, annotation_clip=False)
    side = "right" if beyond else "left"
    text = {"ha": side, "va": "center", "fontsize": 7, "color": colour}
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.8}
    place = tail - 0.03 if beyond else tail + 0.03
    axes.text(place, height, f"{value:.4g}", transform=axes.transAxes, bbox=box, **text)


def legend_lines(entries: list[tuple[str, str, str, float]]) -> list:
    """Handles of a legend from pairs of label, colour, line style and width."""
    from matplotlib.lines import Line2D

    return [Line2D([], [], color=c, linestyle=s, linewidth=w, label=label) for label, c, s, w in entries]
