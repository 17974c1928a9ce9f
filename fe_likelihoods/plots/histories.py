"""Figures of records, response spectra, channel histories and residuals, in display units."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np

from ..checks.fit import describe_residuals
from ..noise.residuals import autocorrelation, residual_checks
from ..signals.channels import Channel, Measurements
from ..units import from_si
from .style import (
    BLUE,
    GREY,
    ORANGE,
    add_legend,
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

    from ..signals.records import Record

__all__ = ["plot_histories", "plot_record", "plot_residuals", "plot_spectrum"]

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
