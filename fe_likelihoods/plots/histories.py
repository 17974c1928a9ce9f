"""Figures against time in display units: records, channels, residuals, measured with simulated responses, bands.

Beside the records are their response spectra.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from ..checks.model import describe_residuals
from ..noise.residuals import autocorrelation, residual_checks
from ..signals.channels import Channel, Measurements, relative_errors
from ..units import from_si
from .style import (
    BLUE,
    GREY,
    MEASURED,
    ORANGE,
    add_figure_legend,
    add_legend,
    add_legend_row,
    channel_label,
    marker_of,
    new_axes,
    new_figure,
    set_time_axis,
    stack_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..prediction.prediction import Prediction
    from ..signals.channels import Measurements
    from ..signals.records import Record

_SHADES = (BLUE, ORANGE, "#5b8c5a", "#b03a48", GREY)


def plot_record(record: Record, axes: Axes | None = None) -> Axes:
    """Plot ground acceleration [g] against time, with a mark at the peak.

    Parameters
    ----------
    record : Record
        The ground motion, such as `fe_likelihoods.Record`.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.

    Returns
    -------
    matplotlib Axes
        The axes with the figure.

    Examples
    --------
    >>> axes = plot_record(record)
    """
    shown = from_si(record.acceleration, "g")
    axes = new_axes(axes, (8.0, 2.6))
    peak = int(np.argmax(np.abs(shown)))
    axes.plot(record.time, shown, color=BLUE, linewidth=0.7)
    label = f"peak {abs(shown[peak]):.3g} g at {record.time[peak]:.4g} s"
    axes.plot(record.time[peak], shown[peak], "o", color=ORANGE, markersize=6, fillstyle="none", label=label)
    axes.set(xlabel="time [s]", ylabel="ground acceleration [g]", title=record.name)
    axes.set_xlim(0.0, record.duration)
    # The extra room below is for the legend, which would cover the peak if it were above.
    reach = 1.1 * np.abs(shown).max() or 1.0
    axes.set_ylim(-1.35 * reach, reach)
    add_legend(axes, loc="lower right")
    axes.grid(alpha=0.25)
    return axes


def plot_spectrum(
    record: Record,
    periods: Sequence[float] | np.ndarray | None = None,
    damping_ratios: Sequence[float] = (0.02, 0.05, 0.1),
    axes: Axes | None = None,
) -> Axes:
    """Plot response spectra (pseudo-acceleration) of a record against period, one line per damping ratio.

    Parameters
    ----------
    record : Record
        The ground motion.
    periods : (n_periods,) array_like, optional
        Undamped periods [s], see `Record.spectrum`.
    damping_ratios : sequence of float
        Fractions of critical damping, one line each.
    axes : matplotlib Axes, optional
        Where to draw. Default: a new figure.

    Returns
    -------
    matplotlib Axes
        The axes with the figure.

    Raises
    ------
    ValueError
        If there is no damping ratio, and as `Record.spectrum`.

    Examples
    --------
    >>> axes = plot_spectrum(record, np.geomspace(0.1, 3.0, 50), damping_ratios=[0.05])
    """
    if not len(damping_ratios):
        raise ValueError(f"expected one damping ratio or more; got {damping_ratios!r}")
    spectra = [record.spectrum(periods, ratio) for ratio in damping_ratios]
    axes = new_axes(axes, (6.0, 3.8))
    for i, spectrum in enumerate(spectra):
        values, label = from_si(spectrum.pseudo_acceleration, "g"), f"{100 * spectrum.damping_ratio:g} %"
        axes.plot(spectrum.periods, values, color=_SHADES[i % len(_SHADES)], linewidth=1.3, label=label)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="period [s]", ylabel="pseudo-acceleration [g]", title=record.name)
    axes.set_xlim(min(s.periods.min() for s in spectra), max(s.periods.max() for s in spectra))
    axes.set_ylim(bottom=0.0)
    add_legend(axes, title="damping ratio", title_fontsize="small")
    axes.grid(alpha=0.25, which="both")
    return axes


def plot_histories(measurements: Measurements) -> Figure:
    """Plot the histories of channels above one another; `plot_fit` compares measurements with responses.

    Parameters
    ----------
    measurements : Measurements
        The histories, measured or simulated.

    Returns
    -------
    matplotlib Figure
        The figure, one axes per channel.

    Examples
    --------
    >>> figure = plot_histories(measurements.select(["displacement"]))
    """
    figure, rows = stack_axes(len(measurements.channels))
    for axes, channel in zip(rows, measurements.channels, strict=True):
        values = from_si(measurements.channel(channel.name), channel.unit)
        style = {"color": BLUE, "linewidth": 0.8, "marker": marker_of(values), "markersize": 2.0}
        axes.plot(measurements.times(channel.name), values, **style)
        axes.set_ylabel(channel_label(channel))
    set_time_axis(rows, max(measurements.times(each.name)[-1] for each in measurements.channels))
    if measurements.description:
        figure.suptitle(measurements.description, fontsize="small", wrap=True)
    return figure


def plot_residuals(residuals: np.ndarray, channels: Sequence[Channel], dt: float) -> Figure:
    """Plot residuals against time, their autocorrelation and their normal quantiles, one row per channel.

    For white residuals, 95 % of the autocorrelation coefficients are in the shaded band. The quantiles of normal
    residuals follow the straight line. The text above each row says what `residual_checks` has found.

    Parameters
    ----------
    residuals : ndarray, shape (n_channels, n_steps)
        Measured minus simulated response [SI], such as the result of `FELikelihood.residuals`.
    channels : sequence of Channel
        The channels, one per row of `residuals`.
    dt : float
        Time step [s].

    Returns
    -------
    matplotlib Figure
        The figure, with axes of shape (n_channels, 3).

    Raises
    ------
    ValueError
        If the number of channels differs from the number of rows, or the residuals have another shape, fewer than two
        samples, non-finite values, or only zeros in a channel.

    Examples
    --------
    >>> figure = plot_residuals(likelihood.residuals_of(model.simulate([1.1, 0.9])), model.channels, model.dt)
    """
    from scipy.special import ndtri

    checks = residual_checks(residuals, channels if len(channels) == len(residuals) else ())
    told, correlation = describe_residuals(checks), autocorrelation(residuals)
    n_channels, n = correlation.shape
    if len(channels) != n_channels:
        raise ValueError(f"expected one channel for each row of residuals; got {len(channels)} and {n_channels} rows")
    figure, rows = new_figure(n_channels, 3, (12.0, 1.0 + 2.5 * n_channels), width_ratios=(2, 1, 1))
    for k, (history, lags, quantiles) in enumerate(rows):
        values = from_si(np.asarray(residuals[k], dtype=float), channels[k].unit)
        history.plot(np.arange(n) * dt, values, color=BLUE, linewidth=0.7, marker=marker_of(values), markersize=2.0)
        values = np.sort(values[~np.isnan(values)])
        samples = len(values)
        normal = ndtri((np.arange(samples) + 0.5) / samples)
        history.set_ylabel(channel_label(channels[k]))
        history.set_title(fill(told[k], 80), fontsize="small", loc="left")
        # Beyond about ten correlation times the estimated autocorrelation is noise.
        shown = min(n, 20 + int(10.0 * samples / checks.n_effective[k]))
        band = 1.96 / np.sqrt(samples)
        lags.fill_between([0.0, (shown - 1) * dt], -band, band, color=GREY, alpha=0.3)
        lags.set_ylabel("autocorrelation [-]")
        lags.plot(np.arange(shown) * dt, correlation[k, :shown], color=BLUE, linewidth=0.9)
        lags.set_title(
            f"lag-one correlation {checks.lag_one[k]:.2f}\n{checks.n_effective[k]:.0f} effective samples of {samples}",
            fontsize="small",
        )
        quantiles.set_title("line: normal", fontsize="small")
        quantiles.plot(normal, values.mean() + values.std() * normal, color=GREY, linewidth=0.9)
        quantiles.plot(normal, values, ".", color=BLUE, markersize=2)
    for axes, text in zip(rows[-1], ("time [s]", "lag [s]", "quantile of a standard normal [-]"), strict=True):
        axes.set_xlabel(text)
    return figure


_OF_RESPONSES = (GREY, BLUE, "#5b8c5a", "#b03a48", "#7b5ea7")
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
        for axes in row:
            axes.plot(times_of[name], measured, marker=marker_of(measured), markersize=3.0, **MEASURED)
            axes.set_xlim(*whole)
        for k, (text, response) in enumerate(shown.items()):
            drawn = from_si(response[i], channel.unit)
            shade = _OF_RESPONSES[k % len(_OF_RESPONSES)] if len(shown) > 1 else BLUE
            for axes in (row[k], *row[len(shown) :]):
                axes.plot(times_of[name], drawn, color=shade, linewidth=1.0, label=text)
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


def plot_bands(prediction: Prediction, measurements: Measurements | None = None) -> Figure:
    """Plot the mean of predicted histories, the band between the outermost quantiles, and measurements.

    Parameters
    ----------
    prediction : Prediction
        Prediction of histories, such as the result of `fe_likelihoods.propagate`.
    measurements : Measurements, optional
        Measurements, drawn at their own times. Channels that were not measured are drawn without measurements.

    Returns
    -------
    matplotlib Figure
        The figure, one axes per channel.

    Raises
    ------
    ValueError
        If the prediction has no histories.

    Examples
    --------
    >>> figure = plot_bands(prediction, measurements)
    >>> figure.savefig("bands.png")
    """
    time = prediction.time
    measured = () if measurements is None else {channel.name for channel in measurements.channels}
    low, high = (min(prediction.probabilities), max(prediction.probabilities)) if prediction.probabilities else (0, 0)

    figure, rows = stack_axes(len(prediction.channels))
    for k, (axes, channel) in enumerate(zip(rows, prediction.channels, strict=True)):
        if low < high:
            band = [from_si(prediction.quantile(p)[k], channel.unit) for p in (low, high)]
            label = f"{100 * low:g}-{100 * high:g} %" + (" with noise" if prediction.noise else "")
            axes.fill_between(time, *band, color=BLUE, alpha=0.3, linewidth=0.0, label=label)
        if channel.name in measured:
            values = from_si(measurements.channel(channel.name), channel.unit)
            axes.plot(measurements.times(channel.name), values, marker=marker_of(values), markersize=3.0, **MEASURED)
        axes.plot(time, from_si(prediction.mean[k], channel.unit), color=BLUE, linewidth=0.8, label="mean")
        axes.set_ylabel(channel_label(channel))
    add_legend_row(rows[0], 3)
    set_time_axis(rows, time[-1])
    return figure
