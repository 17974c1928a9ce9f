"""The figure of a fit: measurements and the responses of a model, such as before and after an update."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..signals.comparison import relative_errors
from ..units import from_si
from .style import BLUE, ORANGE, add_figure_legend, channel_label, marker_of, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..signals.channels import Measurements

__all__ = ["plot_fit", "strongest_window"]

_SHADES = (ORANGE, BLUE, "#5b8c5a", "#b03a48", "#7b5ea7")
_MEASURED = "0.45"
_STRONGEST = 5.0  # length of the part that is drawn on a longer scale [s]


def plot_fit(
    measurements: Measurements,
    responses: Mapping[str, np.ndarray] | np.ndarray,
    title: str | None = None,
) -> Figure:
    """Plot measurements with the response of a model, such as before and after an update.

    Each channel has a row: one axes per response with the whole history and the relative root mean square error (RRMSE)
    in the title, then one axes with all responses in the strongest five seconds, unless these are more than two thirds
    of every history.

    Parameters
    ----------
    measurements : Measurements
        The measured histories; ``measurements.select(names)`` has some of them.
    responses : mapping of str to ndarray, or ndarray
        Responses by their titles, with the samples and channels of ``measurements.values`` [SI], such as
        ``measurements.values - likelihood.residuals_of(model.simulate(x))`` for parameters x.
    title : str, optional
        Title of the figure. Default: the description of the measurements.

    Returns
    -------
    matplotlib Figure
        With axes of shape (n_channels, n_responses + 1), or (n_channels, n_responses) without strongest parts.

    Raises
    ------
    ValueError
        If there is no response, or one has another shape than the measurements.

    Examples
    --------
    >>> before = model.simulate([1.0, 1.0])
    >>> after = model.simulate(samples.mean(axis=0)[:2])
    >>> figure = plot_fit(measurements, {"before the update": before, "posterior mean": after})
    """
    given = responses if isinstance(responses, Mapping) else {"model": responses}
    if not given:
        raise ValueError("no response to draw: pass a mapping of titles to responses")
    shown = {str(text): np.asarray(response, dtype=float) for text, response in given.items()}
    for text, response in shown.items():
        if response.shape != np.shape(measurements.values):
            raise ValueError(
                f"response {text!r}: expected the shape of the measured values, {np.shape(measurements.values)}; got "
                f"{response.shape}"
            )
    times_of = {channel.name: measurements.times(channel.name) for channel in measurements.channels}
    windows = {
        name: strongest_window(times, measurements.channel(name), _STRONGEST)
        for name, times in times_of.items()
        if _STRONGEST <= (times[-1] - times[0]) / 1.5
    }
    n_columns = len(shown) + bool(windows)
    size = (max(4.4 * n_columns, 6.5), 1.0 + 2.1 * len(times_of))
    figure, rows = new_figure(len(times_of), n_columns, size)
    whole = min(0.0, *(times[0] for times in times_of.values())), max(times[-1] for times in times_of.values())
    for i, (row, channel) in enumerate(zip(rows, measurements.channels, strict=True)):
        name, window, own = channel.name, windows.get(channel.name), measurements.channel(channel.name)
        measured = from_si(own, channel.unit)
        style = {"color": _MEASURED, "linewidth": 1.0, "label": "measured", "marker": marker_of(measured)}
        for axes in row:
            axes.plot(times_of[name], measured, markersize=2.0, **style)
            axes.set_xlim(*whole)
        for k, (text, response) in enumerate(shown.items()):
            drawn = from_si(response[i], channel.unit)
            shade = _SHADES[k % len(_SHADES)] if len(shown) > 1 else BLUE
            for axes in (row[k], *row[len(shown) :]):
                axes.plot(times_of[name], drawn, color=shade, linewidth=0.9, label=text)
            error = relative_errors(response[i] - own, own)
            row[k].set_title(text + (f", RRMSE {_percent(error)} %" if np.isfinite(error) else ""), fontsize="small")
        row[0].set_ylabel(channel_label(channel))
        for axes in row[1 : len(shown)]:
            axes.sharey(row[0])
            axes.tick_params(labelleft=False)
        for axes in row[: len(shown)] if window else ():
            axes.axvspan(*window, color="0.5", alpha=0.15, linewidth=0.0)
        if window:
            row[-1].set_xlim(*window)
            row[-1].set_title("the strongest part (grey on the left)", fontsize="small")
    for axes in rows[-1]:
        axes.set_xlabel("time [s]")
    add_figure_legend(figure, 4)
    if text := measurements.description if title is None else title:
        figure.suptitle(text, fontsize="small", wrap=True)
    return figure


def _percent(share: float) -> str:
    """Per cent with one decimal below 10, for example "85" and "3.4"."""
    return f"{100 * share:.1f}" if share < 0.1 else f"{100 * share:.0f}"


def strongest_window(times: np.ndarray, values: np.ndarray, length: float) -> tuple[float, float]:
    """Begin and end [s] of the part of this length [s] with the largest sum of squares; `values` (n,) are NaN where
    missing, `times` (n,) [s] have equal steps.
    """
    step = times[1] - times[0]
    size = min(len(times), max(1, round(length / step)))
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values) ** 2)])
    first = int(np.argmax(total[size:] - total[:-size]))
    return float(times[first]), float(times[first] + length)
