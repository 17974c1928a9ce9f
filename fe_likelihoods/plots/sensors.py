"""The figure of a ranking of sensors: information of each, and what is left of a target."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .style import BLUE, GREY, ORANGE, add_legend, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..information.sensors import SensorRanking


def plot_ranking(ranking: SensorRanking) -> Figure:
    """Plot the chosen sensors in rows, the best first, with standard errors.

    Grey bars are the information of a sensor alone, blue ones what it adds to the sensors above it. With a target, a
    second column has the share of the target's variance that is left with the sensors down to each row.

    Parameters
    ----------
    ranking : SensorRanking

    Returns
    -------
    matplotlib Figure
        With one or two axes.

    Examples
    --------
    >>> figure = plot_ranking(rank_sensors(model, prior, draws=20))
    """
    with_target = bool(np.isfinite(ranking.target_left).all())
    size = (10.0 if with_target else 6.5, 1.4 + 0.45 * len(ranking.chosen))
    figure, axes = new_figure(1, 1 + with_target, size, sharey=True)
    rows, places = np.arange(len(ranking.chosen)), [ranking.candidates.index(name) for name in ranking.chosen]
    first = axes[0, 0]
    alone = ranking.alone[places], ranking.errors["alone"][places]
    first.barh(rows, alone[0], 0.8, xerr=alone[1], color=GREY, alpha=0.5, label="alone")
    first.barh(rows, ranking.gains, 0.45, xerr=ranking.errors["gains"], color=BLUE, label="added to those above")
    first.set_yticks(rows, ranking.chosen)
    first.invert_yaxis()
    first.set_xlabel("expected information, ± standard error [nat]")
    add_legend(figure, loc="outside upper center", ncols=2)
    if with_target:
        share, error = 100.0 * ranking.target_left, 100.0 * ranking.errors["target_left"]
        axes[0, 1].errorbar(share, rows, xerr=error, color=ORANGE, marker="o", capsize=3.0)
        axes[0, 1].set_xlabel("variance of the target that is left, ± standard error [%]")
        axes[0, 1].set_xlim(0.0, None)
    return figure
