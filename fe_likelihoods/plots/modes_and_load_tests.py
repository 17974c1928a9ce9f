"""Figures of data without a time axis: values over load cases or positions, natural frequencies and mode shapes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..units import from_si
from .style import BLUE, GREY, ORANGE, add_figure_legend, channel_label, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..modal.modal_likelihood import PredictedModes
    from ..prediction.prediction import Prediction
    from ..signals.channels import Channel, Measurements

_MOST_BARS = 30  # in one panel
_MOST_MODES = 12  # whose shapes are drawn
_LETTERS = 11  # of small labels side by side in an inch
_WIDTH = 0.6  # of a bar


class _Panel(NamedTuple):
    """Samples that are drawn side by side: rows and columns of values (n_channels, n_points)."""

    label: str
    rows: np.ndarray
    columns: np.ndarray
    names: list[str]


def plot_points(
    measurements: Measurements,
    responses: Mapping[str, np.ndarray] | None = None,
    deviations: np.ndarray | None = None,
    prediction: Prediction | None = None,
) -> Figure:
    """Plot measured values over load cases, positions or other points, with computed values or a prediction.

    Responses (n_channels, n_points) by their titles [SI]: the last one as bars, or as a line over positions, others as
    small marks; or, instead of them, the mean of a prediction with its outermost quantiles. Deviations are standard
    deviations of the measured values [SI]. One axes for each unit, or each channel where points are numbers or many.
    """
    drawn = dict(responses or {})
    reach = None
    if prediction is not None:
        drawn = {"predicted mean": prediction.mean}
        if len(prediction.probabilities) > 1:
            low, high = (prediction.quantile(pick(prediction.probabilities)) for pick in (min, max))
            reach = np.abs(np.stack([low, high]) - prediction.mean)
            low, high = (100.0 * pick(prediction.probabilities) for pick in (min, max))
            drawn = {f"predicted mean, {low:g} to {high:g} %": prediction.mean}
    numeric = all(isinstance(each, int | float) for each in measurements.points)
    panels = _panels(measurements, numeric)
    figure, rows = new_figure(len(panels), 1, (8.0, 1.2 + 2.6 * len(panels)))
    for axes, panel in zip(rows[:, 0], panels, strict=True):
        channel = measurements.channels[panel.rows[0]]

        def shown(values: np.ndarray, panel: _Panel = panel, channel: Channel = channel) -> np.ndarray:
            return from_si(np.asarray(values)[..., panel.rows, panel.columns], channel.unit)

        places = np.array(measurements.points, dtype=float) if numeric else np.arange(len(panel.names))
        for k, (text, values) in enumerate(drawn.items()):
            if k < len(drawn) - 1:
                axes.plot(places, shown(values), "D", color=GREY, markersize=5, fillstyle="none", label=text)
            elif numeric:
                axes.errorbar(places, shown(values), _bars(reach, shown), color=BLUE, marker=".", label=text, capsize=3)
            else:
                axes.bar(places, shown(values), _WIDTH, color=BLUE, alpha=0.35, label=text)
                if reach is not None:
                    axes.errorbar(places, shown(values), shown(reach), fmt="none", ecolor=BLUE, capsize=4)
        error = None if deviations is None else shown(np.broadcast_to(deviations, measurements.values.shape))
        text = "measured" if error is None else "measured, with its standard deviation"
        axes.errorbar(places, shown(measurements.values), error, fmt="o", color=ORANGE, markersize=5, label=text)
        axes.set_ylabel(panel.label)
        axes.axhline(0.0, color="0.75", linewidth=0.7, zorder=0)
        if numeric:
            axes.set_xlabel(measurements.axis)
        else:
            _name(axes, panel.names)
    add_figure_legend(figure, 3)
    if measurements.description:
        figure.suptitle(measurements.description, fontsize="small", wrap=True)
    return figure


def _bars(reach: np.ndarray | None, shown) -> np.ndarray | None:
    return None if reach is None else shown(reach)


def _panels(measurements: Measurements, numeric: bool) -> list[_Panel]:
    """One panel per unit; one per channel where the points are numbers, or many."""
    channels, points = measurements.channels, list(map(str, measurements.points))
    n = len(points)
    units = dict.fromkeys((channel.dimension, channel.unit) for channel in channels)
    groups = [[k for k, channel in enumerate(channels) if (channel.dimension, channel.unit) == unit] for unit in units]
    if numeric or max(map(len, groups)) * n > _MOST_BARS:
        groups = [[k] for k in range(len(channels))]
    panels = []
    for group in groups:
        names = [channels[k].name for k in group]
        texts = [p if len(group) == 1 else name if n == 1 else f"{name}\n{p}" for name in names for p in points]
        label = channel_label(channels[group[0]]) if len(group) == 1 else f"[{channels[group[0]].unit}]"
        panels.append(_Panel(label, np.repeat(group, n), np.tile(np.arange(n), len(group)), texts))
    return panels


def _name(axes: Axes, names: list[str], inches: float = 8.0) -> None:
    """Names below the places of axes that are some inches wide, upright where they are long."""
    upright = sum(max(map(len, name.split("\n"))) + 1 for name in names) > _LETTERS * inches
    axes.set_xticks(np.arange(len(names)), names, rotation=90 if upright else 0, fontsize="small")
    axes.set_xlim(-0.6, len(names) - 0.4)


def plot_modes(
    modes: PredictedModes, before: PredictedModes | None = None, label: str = "posterior with errors, 90 %"
) -> Figure:
    """Plot measured and computed natural frequencies, and the mode shapes at the sensors.

    `modes` are at samples of the posterior, or what `label` says, `before` at draws of the prior. Frequencies are
    multiples of the measured ones, with the errors of a frequency (`PredictedModes.interval`).
    """
    import matplotlib.pyplot as plt

    data = modes.data
    shaped = [k for k in range(data.n_modes) if data.has_shape[:, k].any() and data.n_sensors > 1][:_MOST_MODES]
    columns = min(3, max(len(shaped), 1))
    lines = -(-len(shaped) // columns)
    width = max(4.2 * columns, 7.0)
    figure = plt.figure(figsize=(width, 3.4 + 1.9 * lines), layout="constrained")
    grid = figure.add_gridspec(1 + lines, columns)
    first = figure.add_subplot(grid[0, :])
    places, measured = np.arange(data.n_modes), data.mean_frequencies
    if before is not None:
        middle, reach = _of_frequencies(before, measured)
        first.errorbar(
            places - 0.2,
            middle,
            reach,
            fmt="D",
            color=GREY,
            fillstyle="none",
            label="prior with errors, 90 %",
            capsize=3,
        )
    middle, reach = _of_frequencies(modes, measured)
    first.errorbar(places + 0.2, middle, reach, fmt="s", color=BLUE, markersize=3, label=label, capsize=3)
    errors = data.frequency_errors
    text = "measured" if errors is None else "measured, with its standard deviation"
    for each in data.frequencies / measured:
        first.errorbar(places, each, errors, fmt="o", color=ORANGE, markersize=4, label=text)
    _name(first, [f"mode {number}\n{f:.4g} Hz" for number, f in zip(data.mode_numbers, measured, strict=True)], width)
    first.set_ylabel("computed / measured\nfrequency")
    first.grid(alpha=0.25)
    for place, k in enumerate(shaped):
        axes = figure.add_subplot(grid[1 + place // columns, place % columns])
        middle, reach = _interval(modes.shapes[:, k])
        axes.bar(np.arange(data.n_sensors), middle, _WIDTH, color=BLUE, alpha=0.35, label="computed shape, median")
        axes.errorbar(np.arange(data.n_sensors), middle, reach, fmt="none", ecolor=BLUE, capsize=2)
        error = None if data.shape_error is None else data.shape_error[k]
        sets = data.shapes[data.has_shape[:, k], k]
        for each in sets:
            sign = np.sign(each @ sets[0]) or 1.0
            axes.errorbar(np.arange(data.n_sensors), sign * each, error, fmt="o", color=ORANGE, markersize=4)
        axes.axhline(0.0, color="0.75", linewidth=0.7, zorder=0)
        axes.set_title(
            f"shape of mode {data.mode_numbers[k]}, MAC {np.median(modes.assurance[:, k]):.3f}", fontsize="small"
        )
        _name(axes, list(data.sensors), width / columns)
        axes.tick_params(labelbottom=place + columns >= len(shaped))  # names below the lowest of each column alone
        axes.grid(alpha=0.25)
    add_figure_legend(figure, 4 if columns == 3 else 2)
    return figure


def _of_frequencies(modes: PredictedModes, measured: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Medians (m,) of frequencies as multiples of measured ones, and the distances (2, m) to the ends of 90 %."""
    middle, (low, high) = np.median(modes.frequencies, axis=0), modes.interval()
    return middle / measured, np.stack([middle - low, high - middle]) / measured


def _interval(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Medians (m,) of values (n, m), and the distances (2, m) of the 5 and 95 % quantiles from them."""
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95], axis=0)
    return middle, np.stack([middle - low, high - middle])
