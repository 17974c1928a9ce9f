"""The figure of a fit: measurements and the responses of a model before and after an update.

The function draws what it is given, and computes no statistic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..units import from_si
from .style import BLUE, ORANGE, channel_label, marker_of, select_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..signals.channels import Measurements

__all__ = ["draw_fit"]

_SHADES = (ORANGE, BLUE, "#5b8c5a", "#b03a48", "#7b5ea7")
_MEASURED = "0.45"


def draw_fit(
    measurements: Measurements,
    responses: Mapping[str, Measurements],
    errors: Mapping[str, Mapping[str, float]],
    windows: Mapping[str, tuple[float, float]],
    channels: Sequence[str] | None = None,
    time_label: str = "time [s]",
    title: str | None = None,
) -> Figure:
    """Draw one row per channel: the whole history beside each response, then all responses in a window of time.

    `fe_likelihoods.plot_fit` computes errors and windows and calls this function.

    Parameters
    ----------
    measurements : Measurements
        The measured histories.
    responses : mapping of str to Measurements
        Responses by their titles, in the order in which they are drawn.
    errors : mapping of str to mapping of str to float
        Relative root mean square error [-], by title and channel; missing where it is not known.
    windows : mapping of str to (float, float)
        Begin and end of each channel's window [s]; a channel without an entry has no window. Empty: no such column.
    channels : sequence of str, optional
        Names of the channels to draw. Default: all measured channels.
    time_label : str
        Label of the horizontal axes.
    title : str, optional
        Title of the figure. Default: the description of the measurements.

    Returns
    -------
    matplotlib Figure
        With axes of shape (n_channels, n_responses + 1), or (n_channels, n_responses) without windows.

    Raises
    ------
    ValueError
        If a channel is unknown.
    """
    import matplotlib.pyplot as plt

    known = {channel.name: channel for channel in measurements.channels}
    names = select_names(channels, known, list(known))
    n_columns = len(responses) + bool(windows)
    figure, rows = plt.subplots(
        len(names),
        n_columns,
        squeeze=False,
        figsize=(max(4.4 * n_columns, 6.5), 1.0 + 2.1 * len(names)),
        layout="constrained",
    )
    ends = np.array([measurements.times(name)[[0, -1]] for name in names])
    whole = (min(float(ends[:, 0].min()), 0.0), float(ends[:, 1].max()))
    for row, name in zip(rows, names, strict=True):
        channel = known[name]
        times, measured = measurements.times(name), from_si(measurements.channel(name), channel.unit)
        for axes in row:
            style = {"color": _MEASURED, "linewidth": 1.0, "label": "measured"}
            axes.plot(times, measured, marker=marker_of(measured), markersize=2.0, **style)
        for k, (text, response) in enumerate(responses.items()):
            if name not in {c.name for c in response.channels}:
                row[k].set_title(f"{text}: no such channel", fontsize="small")
                continue
            drawn = (response.times(name), from_si(response.channel(name), channel.unit))
            shade = _SHADES[k % len(_SHADES)] if len(responses) > 1 else BLUE
            for axes in (row[k], *row[len(responses) :]):
                axes.plot(*drawn, color=shade, linewidth=0.9, label=text)
            error = errors.get(text, {}).get(name)
            row[k].set_title(text + ("" if error is None else f", RRMSE {_percent(error)} %"), fontsize="small")
        row[0].set_ylabel(channel_label(channel))
        _set_limits(row, whole, windows.get(name), bool(windows))
        for axes in row[1 : len(responses)]:
            axes.sharey(row[0])
            axes.tick_params(labelleft=False)
    for axes in rows[-1]:
        axes.set_xlabel(time_label)
    handles, labels = rows[0, -1].get_legend_handles_labels()
    if not windows:
        shown = [axes.get_legend_handles_labels() for axes in rows[0]]
        entries = dict(zip(sum((s[1] for s in shown), []), sum((s[0] for s in shown), []), strict=True))
        labels, handles = list(entries), list(entries.values())
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False, fontsize="small")
    text = measurements.description if title is None else title
    if text:
        figure.suptitle(text, fontsize="small", wrap=True)
    return figure


def _percent(share: float) -> str:
    """Per cent with one decimal below 10, for example "85" and "3.4"."""
    return f"{100 * share:.1f}" if share < 0.1 else f"{100 * share:.0f}"


def _set_limits(
    row: np.ndarray, whole: tuple[float, float], window: tuple[float, float] | None, with_window: bool
) -> None:
    """Let the histories fill the axes, and mark the window in axes with whole histories."""
    histories = row[:-1] if with_window else row
    for axes in row:
        axes.grid(alpha=0.25)
    for axes in histories:
        axes.set_xlim(*whole)
        if window is not None:
            axes.axvspan(*window, color="0.5", alpha=0.15, linewidth=0.0)
    if with_window:
        row[-1].set_xlim(*(whole if window is None else window))
        row[-1].set_title("" if window is None else "the strongest part (grey on the left)", fontsize="small")
