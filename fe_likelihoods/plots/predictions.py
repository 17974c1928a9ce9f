"""Figures of predictions: bands of histories, and fragility curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..units import from_si
from .style import (
    BLUE,
    GREY,
    ORANGE,
    add_legend,
    add_legend_row,
    channel_label,
    marker_of,
    new_figure,
    set_time_axis,
    stack_axes,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..prediction.fragility import Fragility
    from ..prediction.prediction import Prediction
    from ..signals.channels import Measurements

__all__ = ["plot_bands", "plot_fragility"]


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
            drawn = {"color": ORANGE, "linewidth": 2.2, "alpha": 0.6, "label": "measured"}
            axes.plot(measurements.times(channel.name), values, marker=marker_of(values), markersize=3.0, **drawn)
        axes.plot(time, from_si(prediction.mean[k], channel.unit), color=BLUE, linewidth=0.8, label="mean")
        axes.set_ylabel(channel_label(channel))
    add_legend_row(rows[0], 3)
    set_time_axis(rows, time[-1])
    return figure


def plot_fragility(fragility: Fragility, label: str = "peak ground acceleration", unit: str | None = "g") -> Figure:
    """Plot the probability of exceedance against intensity: one point with its interval per record, and the curve.

    Parameters
    ----------
    fragility : Fragility
        Result of `fe_likelihoods.fragility`.
    label : str
        Name of the intensity measure.
    unit : str or None
        Unit of the intensity in the figure, a name in `fe_likelihoods.units.UNITS`. None: values are drawn as they
        are, and the label says all.

    Returns
    -------
    matplotlib Figure
        The figure, with one axes.

    Examples
    --------
    >>> motions = [record.scale(factor) for factor in (0.8, 0.9, 1.0, 1.1, 1.2)]
    >>> peaks = [propagate(posterior, samples, quantity=peak("displacement"), record=each) for each in motions]
    >>> strongest = [np.abs(each.acceleration).max() for each in motions]
    >>> ratios = EventRatios([0.93, 1.10, 1.02, 0.99])
    >>> figure = plot_fragility(fragility(peaks, strongest, 8.0, unit="cm", ratios=ratios))
    """

    def shown(values):
        return values if unit is None else from_si(values, unit)

    figure, ((axes,),) = new_figure(1, 1, (6.0, 4.0))
    found = fragility.exceedance
    reach = np.stack([found.probability - found.lower, found.upper - found.probability])
    axes.errorbar(
        shown(fragility.intensity),
        found.probability,
        yerr=np.maximum(reach, 0.0),
        fmt="o",
        color=BLUE,
        markersize=4,
        linewidth=1,
        label="records",
    )
    if fragility.curve is not None:
        curve = fragility.curve
        x = np.geomspace(0.7 * fragility.intensity.min(), 1.2 * fragility.intensity.max(), 200)
        text = f"median {shown(curve.median):.3g}, dispersion {curve.dispersion:.2g}"
        axes.plot(shown(x), curve.probability(x), color=GREY, label=text)
    axes.set_xlabel(label if unit is None else f"{label} [{unit}]")
    axes.set_ylabel("probability of exceedance [-]")
    axes.set_ylim(-0.02, 1.02)
    add_legend(axes)
    return figure
