"""Figures of posterior samples: all pairs of parameters (`plot_corner`) and single parameters (`plot_marginals`).

Both show the prior's density, true and nominal values, and the samples of one or several samplers on common axes.
matplotlib and corner are imported inside the functions.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .drawn_parameters import Drawn, Values, choose_parameters, panel_limits
from .figure_parts import COLOURS, GREY, RED, legend_lines, mark_value, set_ticks, wrap_label

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_corner", "plot_marginals"]

LEVELS = (0.5, 0.9)
FEW_POINTS = 150
"""Fewer distinct samples are drawn as points, since a contour through them shows chance."""
MOST_POINTS = 3000
LARGEST_PANEL = 2.5  # width of a panel of `plot_marginals`, in ranges of the samples
WIDE_PRIOR = 25.0
"""A prior with this many times the posterior's standard deviation is flat at the scale of the posterior."""


def plot_corner(
    samples: np.ndarray | Mapping[str, np.ndarray],
    posterior: Any = None,
    *,
    truths: Values | None = None,
    nominal: Values | None = None,
    prior: bool = True,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    max_parameters: int = 12,
    title: str = "",
) -> "Figure":
    """Plot the posterior of all pairs of parameters, by `corner.hist2d`, with the prior on the diagonal.

    The diagonal has the histogram of each parameter, its mean and standard deviation, and the density of the prior.
    The contours below it hold 50 and 90 % of the samples. Fewer than 150 distinct samples of a sampler are drawn as
    points in all panels, and the samples of a parameter that does not vary in its panels.
    Contours end at a bound of the prior.

    Parameters
    ----------
    samples : array_like, shape (n, ndim), or mapping of str to array_like
        Samples of the posterior, as ``get_chain(flat=True)`` returns; or those of several samplers by their labels, on
        top of one another.
    posterior : Posterior, optional
        Gives units, labels and nominal values (``posterior.parameters``) and the prior (``posterior.prior``). Of a
        function of your own, ``parameter_names`` and ``prior`` are used where it has them.
    truths : sequence of float, shape (ndim,), or mapping of str to float, optional
        True values, where they are known, in the units of the samples; NaN for none. They are red lines. The panels
        are widened by up to half of their size to show a true value; an arrow points to one that is still outside.
    nominal : sequence of float, shape (ndim,), or mapping of str to float, optional
        Values before the update, as grey dashed lines or arrows. Default: those of ``posterior.parameters``; an empty
        mapping for none.
    prior : bool
        Whether the density of the prior is drawn.
    names : sequence of str, optional
        Names of the parameters to draw. Default: all, or the first `max_parameters`.
    labels : sequence of str, shape (ndim,), optional
        Labels of all parameters, instead of those of the posterior.
    max_parameters : int
        Largest number of parameters that are drawn without `names`; the figure says how many are left out.
    title : str
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        With axes of shape (k, k) for k parameters; those above the diagonal are empty.

    Raises
    ------
    ValueError
        If the samples are not finite arrays (n, ndim) with n >= 2, or their number of parameters is not that of the
        posterior, the labels or the values; or if a name is unknown.

    References
    ----------
    Foreman-Mackey, D. (2016), corner.py: Scatterplot matrices in Python, Journal of Open Source Software 1(2), 24,
    doi:10.21105/joss.00024
    """
    drawn = choose_parameters(
        samples,
        posterior,
        truths=truths,
        nominal=nominal,
        prior=prior,
        names=names,
        labels=labels,
        max_parameters=max_parameters,
    )
    k = len(drawn.labels)
    limits = panel_limits(drawn.samples, drawn.truths)
    lines = 0.17 * title.count("\n")  # height of the title below its first line [in]
    figure, axes, panel = _corner_grid(k, 0.6 + lines if title else 0.3)
    small, contours = 7.0 if k > 6 else 8.0, 0
    for i in range(k):
        _draw_diagonal(axes[i, i], drawn, i, limits[i], limits[i], small)
        for j in range(k):
            if j > i:
                axes[i, j].set_axis_off()
                continue
            if j < i:
                contours += _draw_pair(axes[i, j], drawn, j, i, limits)
                set_ticks(axes[i, j].yaxis, *limits[i], size=small)
            set_ticks(axes[i, j].xaxis, *limits[j], size=small)
            axes[i, j].tick_params(labelbottom=i == k - 1, labelleft=j == 0 and i > 0)
            axes[i, j].tick_params(axis="x", labelrotation=40)
    room = int(panel * 72.0 / 5.2)
    texts = [wrap_label(label, max(int(1.3 * room), 4)) for label in drawn.labels]
    longest = max(len(line) for text in texts if "$" not in text for line in [*text.split("\n"), ""])
    size = float(np.clip(9.5 * room / max(longest, 1), 6.0, 9.5))
    for i, text in enumerate(texts):
        axes[-1, i].set_xlabel(text, fontsize=size)
        axes[-1, i].xaxis.set_label_coords(0.5, -0.54 / panel)
        if i:
            axes[i, 0].set_ylabel(text, fontsize=size)
            axes[i, 0].yaxis.set_label_coords(-0.54 / panel, 0.5)
    _add_legend(figure, drawn, k, contours, 0.35 + lines)
    if title:
        figure.suptitle(title, fontsize=11, y=1.0 - 0.12 / figure.get_figheight(), va="top")
    return figure


def _corner_grid(k: int, top: float) -> tuple["Figure", np.ndarray, float]:
    """A figure with square panels below a margin [in], its axes (k, k), and the size of a panel [in]."""
    import matplotlib.pyplot as plt

    panel = float(np.clip(9.0 / k, 1.05, 2.0))
    gap = 0.24 if k < 7 else 0.2
    left, bottom, right = 0.95, 0.95, 0.15
    inner = k * panel + (k - 1) * gap
    legend = max(0.0, 3.0 - (inner - panel))  # room for the legend, beside the only panel of the first row
    width, height = left + inner + right + legend, bottom + inner + top
    grid = {"left": left / width, "right": (left + inner) / width, "bottom": bottom / height}
    grid |= {"top": 1.0 - top / height, "wspace": gap / panel, "hspace": gap / panel}
    figure, axes = plt.subplots(k, k, squeeze=False, figsize=(width, height), gridspec_kw=grid)
    return figure, axes, panel


def _shades(drawn: Drawn) -> list[tuple[str, str, np.ndarray]]:
    """Label, colour and samples of each sampler."""
    return [(label, COLOURS[n % len(COLOURS)], x) for n, (label, x) in enumerate(drawn.samples.items())]


def _is_constant(values: np.ndarray) -> bool:
    """Whether values (n,) are equal, up to round-off."""
    return bool(np.ptp(values) <= 1e-12 * np.abs(values).max())


def _bins(x: np.ndarray) -> int:
    """Number of bins of a histogram of samples (n, k), of which some are copies."""
    return int(np.clip(np.sqrt(len(np.unique(x[:, 0]))), 12, 36))


def _draw_diagonal(axes: "Axes", drawn: Drawn, i: int, limits: np.ndarray, filled: np.ndarray, size: float) -> None:
    """Histograms between the limits `filled`, the prior and the marks of one parameter."""
    highest = 0.0
    several = len(drawn.samples) > 1
    for _, colour, x in _shades(drawn):
        fill = {"histtype": "stepfilled", "facecolor": colour + "40", "edgecolor": colour}
        style = {"histtype": "step", "color": colour} if several else fill
        density, _, _ = axes.hist(x[:, i], bins=_bins(x), range=tuple(filled), density=True, linewidth=1.2, **style)
        highest = max(highest, density.max())
    if drawn.prior is not None:
        places = np.linspace(*limits, 200)
        prior = drawn.prior.density(i, places)
        axes.plot(places, prior, color="0.25", linestyle=":", linewidth=1.4)
        finite = prior[np.isfinite(prior)]
        highest = max(highest, min(finite.max(initial=0.0), 3.0 * highest))
    outside = [v for v in (drawn.nominal[i], drawn.truths[i]) if v < limits[0] or v > limits[1]]
    room = 1.12 + 0.2 * len(outside)  # for the arrows, which are above the histograms
    axes.set(xlim=tuple(limits), ylim=(0.0, room * highest), yticks=[])
    mark_value(axes, drawn.nominal[i], GREY, "--", level=0)
    mark_value(axes, drawn.truths[i], RED, level=len(outside) - 1)
    if not several:
        (x,) = drawn.samples.values()
        axes.set_title(_mean_and_deviation(x[:, i]), fontsize=size, pad=3)


def _mean_and_deviation(values: np.ndarray) -> str:
    """Mean and standard deviation with two digits of the latter."""
    mean, deviation = float(values.mean()), float(values.std())
    if _is_constant(values):
        return f"{values[0]:.4g}, does not vary"
    largest = max(abs(mean), deviation)
    exponent = int(np.floor(np.log10(largest)))
    power = exponent if not -3 <= exponent <= 4 else 0
    decimals = max(0, 1 - int(np.floor(np.log10(deviation))) + power)
    text = f"{mean / 10.0**power:.{decimals}f} ± {deviation / 10.0**power:.{decimals}f}"
    return f"({text})e{power}" if power else text


def _draw_pair(axes: "Axes", drawn: Drawn, j: int, i: int, limits: np.ndarray) -> int:
    """Draw contours or points of two parameters; return the number of samplers with contours."""
    from corner import hist2d

    contours = 0
    for _, colour, x in _shades(drawn):
        pair = x[:, [j, i]]
        if _are_few(x) or _is_constant(pair[:, 0]) or _is_constant(pair[:, 1]):
            shown = pair[:: max(1, len(pair) // MOST_POINTS)]
            axes.plot(shown[:, 0], shown[:, 1], ".", color=colour, markersize=4, alpha=0.6, markeredgewidth=0)
            continue
        contours += 1
        ranges = _inside_bounds(drawn, limits, [j, i])
        hist2d(
            pair[:, 0],
            pair[:, 1],
            ax=axes,
            bins=_bins(pair),
            range=[tuple(each) for each in ranges],
            levels=LEVELS,
            smooth=1.0,
            color=colour,
            plot_datapoints=False,
            plot_density=False,
            fill_contours=len(drawn.samples) == 1,
            no_fill_contours=len(drawn.samples) > 1,  # a white interior would hide the samplers drawn before
            contour_kwargs={"linewidths": 1.1},
            quiet=True,
        )
        _clip(axes, ranges)
    axes.set(xlim=tuple(limits[j]), ylim=tuple(limits[i]))
    for values, colour, style in ((drawn.nominal, GREY, "--"), (drawn.truths, RED, "-")):
        mark_value(axes, values[j], colour, style, label=False)
        mark_value(axes, values[i], colour, style, label=False, vertical=True)
    return contours


def _inside_bounds(drawn: Drawn, limits: np.ndarray, pair: list[int]) -> np.ndarray:
    """Limits (2, 2) of a pair of parameters, which end at the bounds of the prior."""
    if drawn.prior is None:
        return limits[pair]
    low, high = drawn.prior.bounds()[pair].T
    lowest, highest = np.min([[x[:, pair].min(0), -x[:, pair].max(0)] for x in drawn.samples.values()], axis=0)
    first = np.maximum(limits[pair, 0], np.where(low <= lowest, low, -np.inf))  # bounds may be those of another prior
    last = np.minimum(limits[pair, 1], np.where(high >= -highest, high, np.inf))
    return np.column_stack([first, last])


def _clip(axes: "Axes", ranges: np.ndarray) -> None:
    """Hide what the smoothing has drawn outside of a rectangle (2, 2)."""
    from matplotlib.patches import Rectangle

    (left, right), (bottom, top) = ranges
    for collection in axes.collections:
        collection.set_clip_path(Rectangle((left, bottom), right - left, top - bottom, transform=axes.transData))


def _are_few(x: np.ndarray) -> bool:
    """Whether samples (n, k) are drawn as points in all panels."""
    return len(np.unique(x, axis=0)) < FEW_POINTS


def _add_legend(figure: "Figure", drawn: Drawn, k: int, contours: int, below: float) -> None:
    """Explain the lines in the upper right corner, which has no panels, `below` the top [in]."""
    notes = ["contours hold 50 and 90 % of the samples"] if contours else []
    if any(_are_few(x) for x in drawn.samples.values()):
        notes.append(f"points: fewer than {FEW_POINTS} distinct samples")
    if len(drawn.samples) == 1:
        notes.append("titles: mean ± standard deviation")
    notes += [drawn.note] if drawn.note else []
    size = 9.0 if k < 7 else 11.0
    legend = figure.legend(
        handles=_legend_handles(drawn, _prior_label(drawn)),
        loc="upper right",
        fontsize=size,
        title="\n".join(notes),
        title_fontsize=size - 1.0,
        frameon=False,
        bbox_to_anchor=(1.0 - 0.1 / figure.get_figwidth(), 1.0 - below / figure.get_figheight()),
    )
    legend.get_title().set_multialignment("left")
    legend._legend_box.align = "left"


def _legend_handles(drawn: Drawn, prior_label: str) -> list:
    """Lines of the legend: samplers, prior, nominal and true values, as far as they are drawn."""
    entries = [(label or "posterior", colour, "-", 1.6) for label, colour, _ in _shades(drawn)]
    if drawn.prior is not None:
        entries.append((prior_label, "0.25", ":", 1.4))
    if np.isfinite(drawn.nominal).any():
        entries.append(("nominal value", GREY, "--", 1.1))
    if np.isfinite(drawn.truths).any():
        entries.append(("true value", RED, "-", 1.1))
    return legend_lines(entries)


def _prior_label(drawn: Drawn) -> str:
    """The prior in the legend, with a remark where its density is too low to be seen."""
    if drawn.prior is None:
        return ""
    spread = np.max([x.std(axis=0) for x in drawn.samples.values()], axis=0)
    flat = [drawn.prior.spread(i) > WIDE_PRIOR * s for i, s in enumerate(spread)]
    if not any(flat):
        return "prior"
    return "prior (much wider: near zero" + (")" if all(flat) else " in some panels)")


def plot_marginals(
    samples: np.ndarray | Mapping[str, np.ndarray],
    posterior: Any = None,
    *,
    truths: Values | None = None,
    nominal: Values | None = None,
    prior: bool = True,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    columns: int = 4,
    title: str = "",
) -> "Figure":
    """Plot prior and posterior density of each parameter: what the data have changed.

    A panel shows the prior, but is at most 2.5 times as wide as the range of the samples. Where the prior is wider,
    the title says by how much.

    Parameters
    ----------
    samples : array_like, shape (n, ndim), or mapping of str to array_like
        As for `plot_corner`.
    posterior, truths, nominal, prior, names, labels, title
        As for `plot_corner`. All parameters are drawn.
    columns : int
        Number of panels beside one another.

    Returns
    -------
    matplotlib.figure.Figure
        With one axes per parameter.

    Raises
    ------
    ValueError
        As `plot_corner`; and if `columns` is not positive.
    """
    import matplotlib.pyplot as plt

    if columns < 1:
        raise ValueError(f"columns must be 1 or more; got {columns}")
    drawn = choose_parameters(
        samples, posterior, truths=truths, nominal=nominal, prior=prior, names=names, labels=labels
    )
    k = len(drawn.labels)
    columns = min(columns, k)
    rows = -(-k // columns)
    figure = plt.figure(figsize=(max(2.7 * columns, 4.0), 2.25 * rows + 0.5), layout="constrained")
    limits = panel_limits(drawn.samples, drawn.truths)
    for i, label in enumerate(drawn.labels):
        axes = figure.add_subplot(rows, columns, i + 1)
        shown, note = _marginal_limits(drawn, i, limits[i])
        _draw_diagonal(axes, drawn, i, shown, limits[i], 8.0)
        title_of_panel = [axes.get_title(), note]
        axes.set_title("\n".join(text for text in title_of_panel if text), fontsize=8.0, pad=4)
        set_ticks(axes.xaxis, *shown, number=4, size=8.0)
        axes.set_xlabel(wrap_label(label, 40), fontsize=9.5)
    handles = _legend_handles(drawn, "prior")
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def _spread(drawn: Drawn, i: int) -> float:
    """Largest standard deviation of a parameter among the samplers; 0 if it does not vary."""
    return max(0.0 if _is_constant(x[:, i]) else float(x[:, i].std()) for x in drawn.samples.values())


def _marginal_limits(drawn: Drawn, i: int, limits: np.ndarray) -> tuple[np.ndarray, str]:
    """Limits of a panel: the prior, but at most 2.5 times the posterior; and a remark if the prior is wider."""
    spread = _spread(drawn, i)
    if drawn.prior is None or spread == 0.0:
        return limits, ""
    first, last = np.quantile(drawn.prior.draws[:, i], [0.005, 0.995])
    room = 0.5 * (LARGEST_PANEL - 1.0) * (limits[1] - limits[0])
    low, high = max(first, limits[0] - room), min(last, limits[1] + room)
    ratio = drawn.prior.spread(i) / spread
    whole = low == first and high == last
    shown = np.array([min(low, limits[0]), max(high, limits[1])])
    return shown, "" if whole else f"prior {float(f'{ratio:.2g}'):.0f} times wider"
