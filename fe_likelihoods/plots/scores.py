"""Figure of predicted numbers, such as peaks: calibration, intervals, and shares of measured values in them.

A single share of values in an interval says little. The figure shows where measured values are in the predicted
distributions (histogram of the probability integral transform, PIT), and the cost: the width of the intervals, and the
interval score, which adds a penalty for every value outside.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from ..units import from_si
from .style import BLUE, GREY, ORANGE, add_legend, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..prediction.scores import QuantityScores

__all__ = ["plot_scores"]

_BAND = 0.9  # probability of the bands for calibrated predictions
_BINS = 10


def plot_scores(scores: QuantityScores | Mapping[str, QuantityScores]) -> Figure:
    """Plot scores of predicted numbers, such as peaks, of one event or of several.

    Parameters
    ----------
    scores : QuantityScores, or mapping from names of events to them
        Results of `Prediction.score` for numbers, with one level.

    Returns
    -------
    matplotlib Figure
        Three axes. Shares of the PIT in equal parts of 0 to 1, with the band that contains 90 % of the shares of
        calibrated predictions (binomial); median, 50 % and outer interval divided by the measured value, in the order
        of the events; and the shares of measured values in the intervals, with the mean width and score of the outer
        ones.

    Raises
    ------
    ValueError
        If there are no scores, scores are of histories, levels differ, or a measured number is zero.

    Examples
    --------
    >>> peaks = propagate(posterior, samples, quantity=[peak("acceleration"), peak("displacement")], noise=True)
    >>> figure = plot_scores(peaks.score(measurements))
    """
    events = dict(scores) if isinstance(scores, Mapping) else {"": scores}
    levels = {each.level for each in events.values()}
    if len(levels) != 1 or any(hasattr(each, "coverage") for each in events.values()):
        raise ValueError(
            "plot_scores: expected scores of numbers such as peaks, of one event or more, with one level; got "
            f"{[(name, type(each).__name__, getattr(each, 'level', None)) for name, each in events.items()]}"
        )
    rows = sum(len(each.names) for each in events.values())
    size = (11.0, max(3.6, 1.3 + (0.24 if rows <= 30 else 0.15) * rows))
    figure, (axes,) = new_figure(1, 3, size, width_ratios=(1.0, 1.6, 0.8))
    _number_axes(axes, events)
    for each, ratio in ((axes[0], 0.9), (axes[2], 1.2)):  # as tall as they are for few events
        if rows > 12:
            each.set_box_aspect(ratio)
            each.set_anchor("N")
    return figure


def _number_axes(axes: np.ndarray, events: Mapping[str, QuantityScores]) -> None:
    level = next(iter(events.values())).level
    joined = {
        what: np.concatenate([np.asarray(getattr(each, what)) for each in events.values()])
        for what in (
            "measured",
            "median",
            "lower",
            "upper",
            "lower_quartile",
            "upper_quartile",
            "interval_score",
            "pit",
        )
    }
    labels = [_label(event, each, k) for event, each in events.items() for k in range(len(each.names))]
    measured, pit = joined["measured"], joined["pit"]
    if not measured.all():
        raise ValueError(f"plot_scores: intervals are divided by the measured values; zero is among those of {labels}")
    n = len(measured)
    bins = min(_BINS, max(2, n // 3))
    _draw_histogram(axes[0], np.histogram(pit, bins, (0.0, 1.0))[0] / n, n)

    places = np.arange(n)[::-1]
    for ends, width, text in ("", 1.2, f"{level:.0%}"), ("_quartile", 3.5, "50%"):
        left, right = joined[f"lower{ends}"] / measured, joined[f"upper{ends}"] / measured
        axes[1].hlines(places, left, right, color=BLUE, linewidth=width, label=text)
    axes[1].plot(joined["median"] / measured, places, "o", color="white", markeredgecolor=BLUE, markersize=4)
    axes[1].axvline(1.0, color=ORANGE, linewidth=1.0, label="measured")
    axes[1].set_yticks(places, labels, fontsize="x-small")
    axes[1].set_ylim(-0.7, n - 0.3)
    axes[1].set_xlabel("predicted / measured [-]")
    add_legend(axes[1], ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))

    for k, probability in enumerate((0.5, level)):
        low, high = _chance(n, probability)
        axes[2].fill_between([k - 0.4, k + 0.4], low, high, color=GREY, alpha=0.3, linewidth=0.0)
        axes[2].hlines(probability, k - 0.4, k + 0.4, color=GREY, linewidth=1.0)
        axes[2].plot(k, np.mean(np.abs(pit - 0.5) <= 0.5 * probability), "o", color=BLUE)
    size = np.abs(measured)
    width, score = np.mean((joined["upper"] - joined["lower"]) / size), np.mean(joined["interval_score"] / size)
    axes[2].set_title(f"width {width:.2f}, interval score {score:.2f}\nof the measured value", fontsize="small")
    axes[2].set_xticks([0, 1], ["50%", f"{level:.0%}"])
    axes[2].set_xlim(-0.6, 1.6)
    axes[2].set_ylim(-0.03, 1.03)
    axes[2].set(xlabel="interval", ylabel="share of measured values within [-]")


def _label(event: str, scores: QuantityScores, k: int) -> str:
    """Event, quantity and measured value."""
    name = ", ".join(each for each in (event, scores.names[k]) if each)
    unit = scores.units[k]
    value = scores.measured[k] if unit == "SI" else from_si(scores.measured[k], unit)
    return f"{name}: {value:.3g} {unit}"


def _draw_histogram(axes: Axes, shares: np.ndarray, n: int) -> None:
    """Shares of the PIT in equal parts of 0 to 1, and the band of chance for n values."""
    probability = 1.0 / len(shares)
    low, high = _chance(n, probability)
    at = (np.arange(len(shares)) + 0.5) * probability
    axes.bar(at, shares, 0.94 * probability, color=BLUE, alpha=0.75)
    axes.fill_between([0.0, 1.0], low, high, color=GREY, alpha=0.35, linewidth=0.0, label=f"{_BAND:.0%} by chance")
    axes.axhline(probability, color=GREY, linewidth=0.8)
    axes.set(xlim=(0.0, 1.0), xlabel="predicted probability\nbelow measured (PIT)", ylabel="share [-]")
    axes.set_title(f"calibration: {n} value{'s' if n > 1 else ''}", fontsize="medium")
    axes.set_ylim(0.0, 1.18 * max(axes.dataLim.ymax, 1e-9))  # room for a legend of one row above the bars
    add_legend(axes, ncols=2, loc="upper center", columnspacing=1.0, borderaxespad=0.1)


def _chance(n: int, probability: float) -> tuple[float, float]:
    """Ends of the band that contains 90 % of binomial shares of n trials, or more."""
    from scipy.stats import binom  # imported here because it is slow to import

    low, high = binom.ppf([0.5 - 0.5 * _BAND, 0.5 + 0.5 * _BAND], n, probability)
    return low / n, high / n
