"""Figure of predicted numbers, such as peaks: intervals, and shares of measured values in them.

Shares say whether predictions are calibrated; the cost is the width of the intervals, and the interval score, which
adds a penalty for every value outside.
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

_BAND = 0.9  # probability of the bands for calibrated predictions


def plot_scores(scores: QuantityScores | Mapping[str, QuantityScores]) -> Figure:
    """Plot scores of predicted numbers, such as peaks, of one event or of several.

    Parameters
    ----------
    scores : QuantityScores, or mapping from names of events to them
        Results of `Prediction.score` for numbers, with one `interval_probability`.

    Returns
    -------
    matplotlib Figure
        Two axes: median, 50 % and outer interval divided by the measured value, in the order of the events; and the
        shares of measured values in the intervals, with the band that contains 90 % of the shares of calibrated
        predictions (binomial), and the mean width and score of the outer intervals.

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
    probabilities = {each.interval_probability for each in events.values()}
    if len(probabilities) != 1 or any(hasattr(each, "coverage") for each in events.values()):
        raise ValueError(
            "plot_scores: expected scores of numbers such as peaks, of one event or more, with one probability; got "
            f"{[(name, getattr(each, 'interval_probability', None)) for name, each in events.items()]}"
        )
    rows = sum(len(each.names) for each in events.values())
    size = (8.0, max(3.6, 1.3 + (0.24 if rows <= 30 else 0.15) * rows))
    figure, ((intervals, shares),) = new_figure(1, 2, size, width_ratios=(2.0, 1.0))
    _draw(intervals, shares, events)
    if rows > 12:  # as tall as it is for few events
        shares.set_box_aspect(1.2)
        shares.set_anchor("N")
    return figure


def _draw(intervals: Axes, shares: Axes, events: Mapping[str, QuantityScores]) -> None:
    probability = next(iter(events.values())).interval_probability
    names = "measured", "median", "lower", "upper", "lower_quartile", "upper_quartile", "interval_score", "pit"
    joined = {name: np.concatenate([np.asarray(getattr(each, name)) for each in events.values()]) for name in names}
    labels = [_label(event, each, k) for event, each in events.items() for k in range(len(each.names))]
    measured, pit = joined["measured"], joined["pit"]
    if not measured.all():
        raise ValueError(f"plot_scores: intervals are divided by the measured values; zero is among {labels}")
    n = len(measured)
    places = np.arange(n)[::-1]
    for ends, width, text in ("", 1.2, f"{probability:.0%}"), ("_quartile", 3.5, "50%"):
        left, right = joined[f"lower{ends}"] / measured, joined[f"upper{ends}"] / measured
        intervals.hlines(places, left, right, color=BLUE, linewidth=width, label=text)
    intervals.plot(joined["median"] / measured, places, "o", color="white", markeredgecolor=BLUE, markersize=4)
    intervals.axvline(1.0, color=ORANGE, linewidth=1.0, label="measured")
    intervals.set_yticks(places, labels, fontsize="x-small")
    intervals.set_ylim(-0.7, n - 0.3)
    intervals.set_xlabel("predicted / measured [-]")
    add_legend(intervals, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0))

    for k, p in enumerate((0.5, probability)):
        low, high = _chance(n, p)
        shares.fill_between([k - 0.4, k + 0.4], low, high, color=GREY, alpha=0.3, linewidth=0.0)
        shares.hlines(p, k - 0.4, k + 0.4, color=GREY, linewidth=1.0)
        shares.plot(k, np.mean(np.abs(pit - 0.5) <= 0.5 * p), "o", color=BLUE)
    size = np.abs(measured)
    width, score = np.mean((joined["upper"] - joined["lower"]) / size), np.mean(joined["interval_score"] / size)
    shares.set_title(f"width {width:.2f}, interval score {score:.2f}\nof the measured value", fontsize="small")
    shares.set_xticks([0, 1], ["50%", f"{probability:.0%}"])
    shares.set_xlim(-0.6, 1.6)
    shares.set_ylim(-0.03, 1.03)
    shares.set(xlabel="interval", ylabel="share of measured values within [-]")


def _label(event: str, scores: QuantityScores, k: int) -> str:
    """Event, quantity and measured value."""
    name = ", ".join(each for each in (event, scores.names[k]) if each)
    unit = scores.units[k]
    value = scores.measured[k] if unit == "SI" else from_si(scores.measured[k], unit)
    return f"{name}: {value:.3g} {unit}"


def _chance(n: int, probability: float) -> tuple[float, float]:
    """Ends of the band that contains 90 % of binomial shares of n trials, or more."""
    from scipy.stats import binom  # imported here because it is slow to import

    low, high = binom.ppf([0.5 - 0.5 * _BAND, 0.5 + 0.5 * _BAND], n, probability)
    return low / n, high / n
