"""Colours, axes and labels that all figures share. matplotlib is imported inside the functions that need it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..signals.channels import Channel

__all__ = [
    "BLUE",
    "GREY",
    "ORANGE",
    "add_legend_row",
    "channel_label",
    "marker_of",
    "new_axes",
    "select_names",
    "set_time_axis",
    "stack_axes",
]

BLUE = "#1f5a8c"
ORANGE = "#d9822b"
GREY = "#8a8f98"


def new_axes(axes: Axes | None, size: tuple[float, float]) -> Axes:
    """Return `axes`, or the axes of a new figure of `size` [in] if `axes` is None."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(figsize=size, layout="constrained")
    return axes


def stack_axes(n: int) -> tuple[Figure, np.ndarray]:
    """Return a figure with `n` axes above one another that share the horizontal axis, and the axes, shape (n,)."""
    import matplotlib.pyplot as plt

    figure, rows = plt.subplots(n, 1, sharex=True, squeeze=False, figsize=(8.0, 1.0 + 2.0 * n), layout="constrained")
    return figure, rows[:, 0]


def set_time_axis(rows: np.ndarray, end: float, label: str = "time [s]") -> None:
    """Label the common horizontal axis of stacked axes and let it run from 0 to `end`."""
    rows[-1].set_xlabel(label)
    rows[-1].set_xlim(0.0, end if end > 0.0 else None)


def add_legend_row(axes: Axes, n_columns: int) -> None:
    """Add a legend of one row at the upper right, and extend the vertical axis so that it covers no curve."""
    axes.legend(frameon=False, fontsize="small", ncols=n_columns, loc="upper right", borderaxespad=0.1)
    low, high = axes.get_ylim()
    axes.set_ylim(low, high + 0.22 * (high - low))


def marker_of(values: np.ndarray) -> str:
    """Return the marker of a line: a dot if a sample has no neighbour, which a line alone would not show."""
    there = np.concatenate([[False], ~np.isnan(values), [False]])
    return "." if (there[1:-1] & ~there[:-2] & ~there[2:]).any() else ""


def channel_label(channel: Channel) -> str:
    """Return the name of a channel with its display unit."""
    return f"{channel.name} [{channel.unit}]"


def select_names(channels: Sequence[str] | None, known: Sequence[str], default: list[str]) -> list[str]:
    """Return the names of the channels to draw, or raise ValueError if one of them is unknown."""
    names = default if channels is None else [channels] if isinstance(channels, str) else list(channels)
    if not names or set(names) - set(known):
        raise ValueError(f"channels must be some of {', '.join(known)}; got {names}")
    return names
