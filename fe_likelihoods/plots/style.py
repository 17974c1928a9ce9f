"""Colours, axes and labels that all figures share. matplotlib is imported inside the functions that need it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..signals.channels import Channel

BLUE = "#1f5a8c"
ORANGE = "#d9822b"
GREY = "#8a8f98"
MEASURED = {"color": ORANGE, "linewidth": 2.2, "alpha": 0.6, "label": "measured"}  # seen beside a thin line on it


def new_axes(axes: Axes | None, size: tuple[float, float]) -> Axes:
    """Return `axes`, or the axes of a new figure of `size` [in] if `axes` is None, without a grid."""
    return axes if axes is not None else new_figure(1, 1, size, grid=False)[1][0, 0]


def new_figure(
    rows: int, columns: int, size: tuple[float, float], grid: bool = True, **options: Any
) -> tuple[Figure, np.ndarray]:
    """Return a figure of `size` [in] and its axes (rows, columns), with faint grids."""
    import matplotlib.pyplot as plt

    figure, found = plt.subplots(rows, columns, squeeze=False, figsize=size, layout="constrained", **options)
    for axes in found.flat if grid else ():
        axes.grid(alpha=0.25)
    return figure, found


def stack_axes(n: int) -> tuple[Figure, np.ndarray]:
    """Return a figure with `n` axes above one another that share the horizontal axis, and the axes, shape (n,)."""
    figure, rows = new_figure(n, 1, (8.0, 1.0 + 2.0 * n), sharex=True)
    return figure, rows[:, 0]


def add_legend(place: Axes | Figure, *entries: Any, **options: Any) -> None:
    """Add a legend without a frame, in small letters."""
    place.legend(*entries, frameon=False, fontsize="small", **options)


def add_figure_legend(figure: Figure, n_columns: int) -> None:
    """Add one legend below all axes, with each label once, in the order of the axes."""
    found = [axes.get_legend_handles_labels() for axes in figure.axes]
    unique = {text: handle for handles, texts in found for handle, text in zip(handles, texts, strict=True)}
    add_legend(figure, unique.values(), unique, loc="outside lower center", ncols=n_columns)


def set_time_axis(rows: np.ndarray, end: float) -> None:
    """Label the common horizontal axis of stacked axes and let it run from 0 to `end` [s]."""
    rows[-1].set_xlabel("time [s]")
    rows[-1].set_xlim(0.0, end if end > 0.0 else None)


def add_legend_row(axes: Axes, n_columns: int) -> None:
    """Add a legend of one row at the upper right, and extend the vertical axis so that it covers no curve."""
    add_legend(axes, ncols=n_columns, loc="upper right", borderaxespad=0.1)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))


def marker_of(values: np.ndarray) -> str:
    """Return the marker of a line: a dot if a sample has no neighbour, which a line alone would not show."""
    there = np.concatenate([[False], ~np.isnan(values), [False]])
    return "." if (there[1:-1] & ~there[:-2] & ~there[2:]).any() else ""


def channel_label(channel: Channel) -> str:
    """Return the name of a channel with its display unit."""
    return f"{channel.name} [{channel.unit}]"
