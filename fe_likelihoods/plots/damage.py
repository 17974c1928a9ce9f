"""The figure of damage: a column with the probability of every limit state at every section and side."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .style import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..column_damage.damage import Damage

_COLOURS = ("#eef1f4", "#fbdca6", "#e8893a", "#a81c1c")
"""Colours of the probabilities from 0 to 1."""


def plot_damage(damage: Damage) -> Figure:
    """Draw the column after each event with the probabilities of its limit states.

    Each row is an event and each column a limit state of strains. The two sides of every section are coloured by the
    probability that the limit was exceeded there, with the probability in per cent; the title has the probability that
    it was exceeded anywhere. `Damage.table` has the other probabilities and the quantiles of the measures.

    Parameters
    ----------
    damage : Damage
        The result of `fe_likelihoods.damage` for a column.

    Returns
    -------
    matplotlib Figure
        The figure. Heights are to scale, widths are not.

    Raises
    ------
    ValueError
        If there are no limit states of strains.

    Examples
    --------
    >>> from dataclasses import replace
    >>> quiet = record.followed_by(Record("rest", record.dt, [0.0, 0.0]), rest=20.0)
    >>> complete = RCColumn.lhpost(quiet)
    >>> complete = replace(complete, outputs=damage_outputs(complete))
    >>> predicted = propagate(complete, np.ones((3, 5)), quantity=damage_measures(complete))
    >>> figure = plot_damage(damage(predicted, noise=False))
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    located = list(damage.location)
    if not located:
        raise ValueError(
            "the figure needs probabilities at sections: damage of an RCColumn with the measures 'bar tension' and "
            "'cover compression' and limit states of them; use damage.table() otherwise"
        )
    colours = LinearSegmentedColormap.from_list("probability", _COLOURS)
    size = (max(1.5 * len(located) + 0.6, 4.5), 2.75 * len(damage.events) + 1.0)
    figure, panels = new_figure(len(damage.events), len(located), size, grid=False)
    for event, (row, name) in enumerate(zip(panels, damage.events, strict=True)):
        for axes, state in zip(row, located, strict=True):
            _draw_column(axes, damage, state, event, colours)
        row[0].set_ylabel(f"{name}\nheight [m]")
    bar = figure.colorbar(
        ScalarMappable(Normalize(0.0, 1.0), colours), ax=panels, location="bottom", aspect=50, pad=0.02
    )
    label = f"probability, from {damage.prediction.effective_sample_size:.0f} effective samples;\n{damage.uncertainty}"
    bar.set_label(label + (f"\n{damage.failures}" if damage.failures else ""), fontsize=7)
    bar.ax.tick_params(labelsize=7)
    return figure


def _draw_column(axes: Axes, damage: Damage, state: str, event: int, colours) -> None:
    """Draw one column with the probabilities of one limit state after one event."""
    from matplotlib.patches import Rectangle

    height, heights = damage.prediction.quantity.height, damage.prediction.quantity.heights
    probability = damage.location[state].probability[event]
    axes.add_patch(Rectangle((-1.7, -0.06 * height), 3.4, 0.06 * height, facecolor="0.55"))
    axes.add_patch(Rectangle((-1.4, height), 2.8, 0.07 * height, facecolor="0.78", edgecolor="0.5", linewidth=0.6))
    edges = [0.0, *(0.5 * (heights[1:] + heights[:-1])), height]
    for k, (low, high) in enumerate(zip(edges[:-1], edges[1:], strict=True)):
        for side, left in enumerate((-1.0, 0.0)):
            p = float(probability[k, side])
            axes.add_patch(
                Rectangle((left, low), 1.0, high - low, facecolor=colours(p), edgecolor="0.6", linewidth=0.6)
            )
            if p > 0.0:
                ink = "white" if p > 0.6 else "0.1"
                text = _per_cent(p)
                axes.text(left + 0.5, 0.5 * (low + high), text, ha="center", va="center", fontsize=8, color=ink)
    whole = damage.presence[state]
    title = f"{state}\n{_per_cent(float(whole.probability[event]))} %"
    if 0.0 < whole.probability[event] < 1.0:
        title += f" ± {100.0 * whole.standard_error[event]:.1f}"
    axes.set_title(title, fontsize=9, fontweight="bold" if whole.probability[event] >= 0.5 else "normal")
    axes.set(xlim=(-1.75, 1.75), ylim=(-0.06 * height, 1.08 * height))
    axes.set_xticks([-0.5, 0.5], ["\N{MINUS SIGN} side", "+ side"], fontsize=7)
    axes.set_yticks(heights, [f"{z:.1f}" for z in heights], fontsize=7)
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _per_cent(probability: float) -> str:
    """Return a probability in per cent; 0 and 100 only where none or all of the samples exceed."""
    value = 100.0 * probability
    if 0.0 < value < 1.0:
        return "<1"
    return ">99" if 99.0 < value < 100.0 else f"{value:.0f}"
