"""The figure of a fit: measurements and the responses of a model, such as before and after an update."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..signals.channels import Measurements
from ..units import from_si
from .style import BLUE, ORANGE, channel_label, marker_of, select_names

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_fit", "strongest_window"]

_SHADES = (ORANGE, BLUE, "#5b8c5a", "#b03a48", "#7b5ea7")
_MEASURED = "0.45"


def plot_fit(
    measurements: Measurements,
    responses: Mapping[str, Measurements | np.ndarray] | Measurements | np.ndarray,
    channels: Sequence[str] | None = None,
    *,
    window: float | None = 5.0,
    time_label: str = "time [s]",
    title: str | None = None,
) -> Figure:
    """Plot measurements with the response of a model, such as before and after an update.

    Each channel has a row: one axes per response with the whole history and the relative root mean square error (RRMSE)
    in the title, then one axes with all responses in the strongest five seconds.

    Parameters
    ----------
    measurements : Measurements
        The measured histories.
    responses : mapping of str to (Measurements or ndarray), or one of these
        Responses by their titles. An array has the shape, samples and channels of ``measurements.values`` [SI], such as
        ``measurements.values - posterior.likelihood.residuals(x)`` for parameters x.
    channels : sequence of str, optional
        Names of the channels to draw. Default: all.
    window : float, optional
        Length [s] of the strongest part, which is shown again on a longer scale. It is not shown for None or more than
        two thirds of the history.
    time_label : str
        Label of the horizontal axes, for example "step" for a test without time.
    title : str, optional
        Title of the figure. Default: the description of the measurements.

    Returns
    -------
    matplotlib Figure
        With axes of shape (n_channels, n_responses + 1), or (n_channels, n_responses) without strongest parts.

    Raises
    ------
    ValueError
        If there is no response, an array has another shape than the measurements, a channel is unknown, or `window` is
        not positive.

    Examples
    --------
    >>> before = model.simulate([1.0, 1.0])
    >>> after = model.simulate(samples.mean(axis=0)[:2])
    >>> figure = plot_fit(measurements, {"before the update": before, "posterior mean": after})
    """
    if window is not None and not window > 0.0:
        raise ValueError(f"window must be a positive number of seconds or None; got {window!r}")
    given = responses if isinstance(responses, Mapping) else {"model": responses}
    if not given:
        raise ValueError("no response to draw: pass a mapping of titles to responses")
    shown = {str(text): _as_measurements(measurements, response, text) for text, response in given.items()}
    errors = {text: measurements.rrmse_of(response) for text, response in shown.items()}
    windows = {}
    for channel in measurements.channels if window is not None else ():
        times = measurements.times(channel.name)
        if window <= (times[-1] - times[0]) / 1.5:
            windows[channel.name] = strongest_window(times, measurements.channel(channel.name), window)
    if channels is not None:
        wanted = [channels] if isinstance(channels, str) else channels
        windows = {name: windows[name] for name in wanted if name in windows}
    return _draw(measurements, shown, errors, windows, channels, time_label, title)


def _draw(
    measurements: Measurements,
    responses: Mapping[str, Measurements],
    errors: Mapping[str, Mapping[str, float]],
    windows: Mapping[str, tuple[float, float]],
    channels: Sequence[str] | None,
    time_label: str,
    title: str | None,
) -> Figure:
    """One row per channel; errors [-] by title and channel, windows (begin, end) [s] by channel."""
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


def strongest_window(times: np.ndarray, values: np.ndarray, length: float) -> tuple[float, float]:
    """Begin and end [s] of the part of this length [s] with the largest sum of squares; `values` (n,) are NaN where
    missing, `times` (n,) [s] have equal steps.
    """
    step = times[1] - times[0]
    size = min(len(times), max(1, round(length / step)))
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values) ** 2)])
    first = int(np.argmax(total[size:] - total[:-size]))
    return float(times[first]), float(times[first] + length)


def _as_measurements(measurements: Measurements, response: Measurements | np.ndarray, text: str) -> Measurements:
    if isinstance(response, Measurements):
        return response
    values = np.asarray(response, dtype=float)
    if values.shape != np.shape(measurements.values):
        raise ValueError(
            f"response {text!r}: an array must have the shape of the measured values, {np.shape(measurements.values)}; "
            f"got {values.shape}. Pass Measurements for a response with other channels or times"
        )
    return replace(measurements, values=values, description="")
