"""Figures of posterior samples: all pairs of parameters (`plot_corner`) and single parameters (`plot_marginals`).

Units, labels and nominal values come from ``posterior.parameters``; otherwise labels are ``posterior.parameter_names``
or x0, x1, ... matplotlib and corner are imported inside the functions.
"""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["BLUE", "GREY", "ORANGE", "plot_corner", "plot_marginals"]

Values = Sequence[float] | np.ndarray | Mapping[str, float]  # one per parameter (NaN: none), or by name

BLUE = "#1f5a8c"
ORANGE = "#d9822b"
GREY = "#8a8f98"
RED = "#b03a48"
COLOURS = (BLUE, ORANGE, "#5b8c5a", "#7b5ea7", "#3aa0a8", "#6b4a2f")  # of several samplers, repeated after the last
LEVELS = (0.5, 0.9)
FEW_POINTS = 150  # fewer distinct samples are drawn as points, since a contour through them shows chance
MOST_PARAMETERS = 12  # of a corner plot without names
PRIOR_DRAWS = 20_000  # for densities of parameters without a distribution and for the width of a prior
LARGEST_PANEL = 2.5  # largest panel width in `plot_marginals`, as a multiple of the range of the samples


class _Drawn(NamedTuple):
    """The k parameters of a figure; all values in the units of the labels, NaN for a value that is not marked.

    `samples` (n, k) by the label of the sampler; `limits` of the panels (k, 2); `densities` are functions of values
    (m,), none without a prior.
    """

    labels: list[str]
    samples: dict[str, np.ndarray]
    truths: np.ndarray
    nominal: np.ndarray
    densities: list[Callable[[np.ndarray], np.ndarray]]
    prior_draws: np.ndarray | None
    limits: np.ndarray
    note: str

    def shades(self) -> list[tuple[str, str]]:
        """Label and colour of each sampler."""
        return [(label, COLOURS[n % len(COLOURS)]) for n, label in enumerate(self.samples)]

    def fill(self, colour: str) -> dict[str, str]:
        """Style of a histogram: filled for one sampler, outlined for several."""
        if len(self.samples) > 1:
            return {"histtype": "step"}
        return {"histtype": "stepfilled", "fc": colour + "40", "ec": colour}


def plot_corner(
    samples: np.ndarray | Mapping[str, np.ndarray],
    posterior: Any = None,
    *,
    truths: Values | None = None,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    title: str = "",
) -> "Figure":
    """Plot the posterior for all pairs of parameters by `corner.corner`, with the prior on the diagonal.

    See Foreman-Mackey (2016), corner.py, Journal of Open Source Software 1(2), 24, doi:10.21105/joss.00024. The
    contours hold 50 and 90 % of the samples. Fewer than 150 distinct samples from one sampler are drawn as points.

    Parameters
    ----------
    samples : array_like, shape (n, ndim), or mapping of str to array_like
        Samples of the posterior, as ``get_chain(flat=True)`` returns, or samples of several samplers by their labels,
        which are drawn over each other. At least as many samples as parameters.
    posterior : Posterior, optional
        Gives units, labels and nominal values (``posterior.parameters``, as grey dashed lines) and the prior
        (``posterior.prior``). A function of your own may have ``parameter_names`` and ``prior``.
    truths : sequence of float, shape (ndim,), or mapping of str to float, optional
        True values in the units of the samples, as red lines; NaN for none. The panels are widened by up to half their
        size to show a true value; otherwise it is written at the edge.
    names : sequence of str, optional
        Names of the parameters to draw. Default: all, or the first 12; the figure says how many are left out.
    labels : sequence of str, shape (ndim,), optional
        Labels for all parameters, instead of the posterior's labels.
    title : str
        Title of the figure.

    Returns
    -------
    matplotlib.figure.Figure
        With axes of shape (k, k) for k parameters; the axes above the diagonal are empty.

    Examples
    --------
    >>> figure = plot_corner(samples, posterior, names=["stiffness", "damping"])
    """
    import corner
    import matplotlib.pyplot as plt

    drawn = _choose(samples, posterior, truths, labels, names, MOST_PARAMETERS)
    k, several = len(drawn.labels), len(drawn.samples) > 1
    panel = float(np.clip(9.0 / k, 1.1, 2.0))  # [in]
    texts = _wrapped(drawn.labels, int(12.0 * panel))
    left = 0.7 + 0.14 * max(1 + text.count("\n") for text in texts)
    right, top = 0.15, 0.35 + (0.25 + 0.17 * title.count("\n") if title else 0.0)
    width = left + k * panel + right + max(0.0, 3.0 - (k - 1) * panel)  # the legend is beside the first panel
    height = left + k * panel + top
    figure = plt.figure(figsize=(width, height))
    shown_as_points = []
    for label, colour in drawn.shades():
        x = drawn.samples[label]
        few = len(np.unique(x, axis=0)) < FEW_POINTS
        shown_as_points.append(few)
        corner.corner(
            x,
            bins=_bins(x),
            range=[tuple(each) for each in drawn.limits],
            color=colour,
            labels=[""] * k,
            fig=figure,
            max_n_ticks=3,
            hist_kwargs={"density": True, "linewidth": 1.2} | drawn.fill(colour),
            levels=LEVELS,
            smooth=1.0,
            plot_density=False,
            plot_datapoints=few,
            plot_contours=not few,
            fill_contours=not several,
            no_fill_contours=several,  # a white interior would hide the samplers drawn before
            data_kwargs={"ms": 2.5, "alpha": 0.6, "mec": "none"},
            contour_kwargs={"linewidths": 1.1},
            quiet=True,
        )
    for values, colour, dashes in ((drawn.nominal, GREY, "--"), (drawn.truths, RED, "-")):
        corner.overplot_lines(
            figure, [x if np.isfinite(x) else None for x in values], color=colour, linestyle=dashes, linewidth=1.1
        )
    end = left + k * panel
    figure.subplots_adjust(left=left / width, right=end / width, bottom=left / height, top=end / height)
    axes = np.array(figure.axes).reshape(k, k)
    size = 7.0 if k > 6 else 8.0
    for i, text in enumerate(texts):
        _finish_diagonal(axes[i, i], drawn, i, size)
        for axis in (*(each.xaxis for each in axes[i:, i]), *(each.yaxis for each in axes[i, :i])):
            axis.set_ticks(_inner_ticks(drawn.limits[i]))
        axes[-1, i].set_xlabel(text, fontsize=size + 1.0)
        axes[-1, i].xaxis.set_label_coords(0.5, -0.5 / panel)
        _set_digits(axes[-1, i].xaxis, drawn.limits[i], size)
        if i > 0:
            axes[i, 0].set_ylabel(text, fontsize=size + 1.0)
            axes[i, 0].yaxis.set_label_coords(-0.5 / panel, 0.5)
            _set_digits(axes[i, 0].yaxis, drawn.limits[i], size)
    notes = {
        "contours hold 50 and 90 % of the samples": not all(shown_as_points),
        f"points: fewer than {FEW_POINTS} distinct samples": any(shown_as_points),
        "titles: mean ± standard deviation": not several,
        drawn.note: drawn.note,
    }
    legend = figure.legend(
        handles=_legend_handles(drawn),
        loc="upper right",
        fontsize=9.0 if k < 7 else 11.0,
        title="\n".join(text for text, shown in notes.items() if shown),
        title_fontsize=8.0 if k < 7 else 10.0,
        frameon=False,
        alignment="left",
        bbox_to_anchor=(1.0 - 0.1 / width, 1.0 - (top - 0.2 if title else 0.1) / height),
    )
    legend.get_title().set_multialignment("left")
    if title:
        figure.suptitle(title, fontsize=11, y=1.0 - 0.12 / height, va="top")
    return figure


def plot_marginals(
    samples: np.ndarray | Mapping[str, np.ndarray],
    posterior: Any = None,
    *,
    truths: Values | None = None,
    labels: Sequence[str] | None = None,
    title: str = "",
) -> "Figure":
    """Plot the prior and posterior density of each parameter, which shows what the data have changed.

    A panel shows the prior, but is at most 2.5 times as wide as the range of the samples. If the prior is wider, the
    title says by how much.

    Parameters and errors as for `plot_corner`. All parameters are drawn, in one axes each.

    Examples
    --------
    >>> figure = plot_marginals(samples, posterior)
    """
    import matplotlib.pyplot as plt

    drawn = _choose(samples, posterior, truths, labels)
    k = len(drawn.labels)
    columns = min(4, k)
    rows = -(-k // columns)
    figure = plt.figure(figsize=(max(2.7 * columns, 4.0), 2.25 * rows + 0.5), layout="constrained")
    for i, label in enumerate(drawn.labels):
        axes, limits, note = figure.add_subplot(rows, columns, i + 1), drawn.limits[i], ""
        spread = max(float(x[:, i].std()) for x in drawn.samples.values())
        for name, colour in drawn.shades():
            x, fill = drawn.samples[name], drawn.fill(colour)
            axes.hist(x[:, i], _bins(x), range=tuple(limits), density=True, linewidth=1.2, color=colour, **fill)
        axes.set_ylim(0.0, 1.1 * axes.dataLim.y1)
        if drawn.prior_draws is not None and spread > 1e-12 * np.abs(limits).max():
            prior = np.quantile(drawn.prior_draws[:, i], [0.005, 0.995])
            room = 0.5 * (LARGEST_PANEL - 1.0) * (limits[1] - limits[0])
            whole = limits[0] - room <= prior[0] and prior[1] <= limits[1] + room
            note = "" if whole else f"prior {float(f'{drawn.prior_draws[:, i].std() / spread:.2g}'):.0f} times wider"
            drawn.limits[i] = [
                min(limits[0], max(prior[0], limits[0] - room)),
                max(limits[1], min(prior[1], limits[1] + room)),
            ]
        axes.set(xlim=tuple(drawn.limits[i]), yticks=[])
        for value, colour, dashes in ((drawn.nominal[i], GREY, "--"), (drawn.truths[i], RED, "-")):
            axes.axvline(value, color=colour, linestyle=dashes, linewidth=1.1)
        _finish_diagonal(axes, drawn, i, 8.0)
        axes.set_title("\n".join(text for text in (axes.get_title(), note) if text), fontsize=8.0, pad=4)
        axes.set_xlabel(label, fontsize=9.5)
        axes.xaxis.set_major_locator(plt.MaxNLocator(4, prune="both", min_n_ticks=2))
        _set_digits(axes.xaxis, drawn.limits[i], 8.0)
    figure.legend(handles=_legend_handles(drawn), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    if title:
        figure.suptitle(title, fontsize=11)
    return figure


def _choose(
    samples: Any,
    posterior: Any,
    truths: Values | None,
    labels: Sequence[str] | None,
    names: Sequence[str] | None = None,
    most: int | None = None,
) -> _Drawn:
    """Check the arguments of a figure, and convert what it shows to the units of its labels."""
    given = samples if isinstance(samples, Mapping) else {"": samples}
    if not given:
        raise ValueError("no samples to draw: pass an array (n, ndim), or a mapping of labels to such arrays")
    arrays = {str(label): _checked(x, label) for label, x in given.items()}
    widths = {label: x.shape[1] for label, x in arrays.items()}
    if len(set(widths.values())) > 1:
        raise ValueError(f"all samples must have the same parameters; the numbers of columns are {widths}")
    ndim = next(iter(widths.values()))
    parameters = _parameters_of(posterior, ndim)
    if labels is not None and len(labels) != ndim:
        raise ValueError(f"expected one label for each of {ndim} parameters; got {len(labels)}: {list(labels)}")
    known = list(labels) if labels is not None and posterior is None else [each.name for each in parameters]
    wanted, note = known[:most] if names is None else names, ""
    if names is None and len(wanted) < ndim:
        note = f"the first {most} of {ndim} parameters; names= chooses others"
    unknown = [name for name in wanted if name not in known]
    if unknown or not len(wanted):
        what = f"unknown: {', '.join(map(str, unknown))}" if unknown else "got none"
        raise ValueError(f"names must be some of the parameters {', '.join(known)}; {what}")
    columns = [known.index(name) for name in wanted]
    factors = np.array([parameters[i].factor for i in columns])
    arrays = {label: x[:, columns] / factors for label, x in arrays.items()}
    nominal = np.array([parameters[i].nominal for i in columns], dtype=float) / factors
    truths = _true_values(truths, known)[columns] / factors
    densities, draws = _priors(posterior, wanted, columns, factors)
    return _Drawn(
        [parameters[i].label if labels is None else labels[i] for i in columns],
        arrays,
        truths,
        nominal,
        densities,
        draws,
        _limits(arrays, truths),
        note,
    )


def _parameters_of(posterior: Any, ndim: int) -> Sequence[Any]:
    """Name, label, unit (``factor``) and nominal value for each of `ndim` parameters; ValueError for another number."""
    described = getattr(posterior, "parameters", None)
    if described is None:
        names = getattr(posterior, "parameter_names", None) or [f"x{i}" for i in range(ndim)]
        described = [SimpleNamespace(name=str(name), label=str(name), factor=1.0, nominal=np.nan) for name in names]
    if len(described) != ndim:
        raise ValueError(
            f"the posterior has {len(described)} parameters ({', '.join(each.name for each in described)}), but the "
            f"samples have {ndim} columns"
        )
    return described


def _checked(samples: Any, label: str) -> np.ndarray:
    samples, where = np.asarray(samples, dtype=float), f" of {label!r}" if label else ""
    if samples.ndim != 2 or len(samples) < 2 or not 1 <= samples.shape[1] <= len(samples):
        raise ValueError(
            f"samples{where} must be an array (n, ndim) with n >= 2 and n >= ndim, as get_chain(flat=True) returns; "
            f"got {samples.shape}"
        )
    if not np.isfinite(samples).all():
        bad = np.count_nonzero(~np.isfinite(samples).all(axis=1))
        raise ValueError(f"samples{where} must be finite; {bad} of {len(samples)} rows are not: leave these rows out")
    return samples


def _true_values(given: Values | None, known: list[str]) -> np.ndarray:
    """True values to mark, one per parameter, NaN for none."""
    if given is None or isinstance(given, Mapping):
        given = given or {}
        if unknown := [name for name in given if name not in known]:
            raise ValueError(f"truths: unknown parameters {', '.join(unknown)}; known are {', '.join(known)}")
        given = [given.get(name) for name in known]
    values = np.array([np.nan if value is None else value for value in given], dtype=float)
    if values.shape != (len(known),):
        raise ValueError(
            f"truths must have one value for each of {len(known)} parameters (NaN for no mark), or be a mapping of "
            f"names to values; got shape {values.shape}"
        )
    return values


def _priors(posterior: Any, names: Sequence[str], columns: list[int], factors: np.ndarray) -> tuple[list, Any]:
    """Prior densities of the parameters, estimated from draws if ``prior.distributions`` has none, and draws (n, k)."""
    from scipy.stats import gaussian_kde

    prior = getattr(posterior, "prior", None)
    if not hasattr(prior, "rvs"):
        return [], None
    draws = np.asarray(prior.rvs(PRIOR_DRAWS, 0), dtype=float)[:, columns] / factors  # a seed: always the same figure
    distributions = getattr(prior, "distributions", {})

    def density(i: int) -> Callable[[np.ndarray], np.ndarray]:
        if (distribution := distributions.get(names[i])) is not None:
            return lambda values: np.exp(distribution.logpdf(values * factors[i])) * factors[i]
        return gaussian_kde(draws[:, i]) if np.ptp(draws[:, i]) > 0.0 else np.zeros_like

    return [density(i) for i in range(len(columns))], draws


def _limits(samples: Mapping[str, np.ndarray], truths: np.ndarray) -> np.ndarray:
    """Limits (k, 2) of the panels: the range of the samples, widened by up to half its size to show a true value."""
    quantiles = np.array([np.quantile(x, [0.002, 0.998], axis=0) for x in samples.values()])
    low, high = quantiles[:, 0].min(axis=0), quantiles[:, 1].max(axis=0)
    size = high - low
    near = (truths > low - 0.5 * size) & (truths < high + 0.5 * size)
    low, high = np.where(near, np.fmin(low, truths), low), np.where(near, np.fmax(high, truths), high)
    varies = high - low > 1e-12 * np.maximum(np.abs(low), np.abs(high))
    space = np.where(varies, 0.12 * (high - low), np.maximum(0.05 * np.abs(low), 1e-12))
    return np.column_stack([low - space, high + space])


def _bins(x: np.ndarray) -> int:
    """Number of bins for a histogram of samples (n, k), some of which are copies."""
    return int(np.clip(np.sqrt(len(np.unique(x[:, 0]))), 12, 36))


def _finish_diagonal(axes: "Axes", drawn: _Drawn, i: int, size: float) -> None:
    """Prior density, values outside the panel, and mean and standard deviation of one parameter."""
    low, high = drawn.limits[i]
    highest = 1.1 * max(patch.get_xy()[:, 1].max() for patch in axes.patches)  # corner's limit is of the last sampler
    if drawn.densities:
        places = np.linspace(low, high, 200)
        density = drawn.densities[i](places)
        axes.plot(places, density, color="0.25", linestyle=":", linewidth=1.4)
        highest = max(highest, min(1.1 * density[np.isfinite(density)].max(initial=0.0), 3.0 * highest))
    marks = [(drawn.nominal[i], GREY), (drawn.truths[i], RED)]
    outside = [mark for mark in marks if mark[0] < low or mark[0] > high]
    axes.set_ylim(0.0, highest * (1.0 + 0.2 * len(outside)))
    for row, (value, colour) in enumerate(outside):
        text, side, x = (f"← {value:.4g}", "left", 0.03) if value < low else (f"{value:.4g} →", "right", 0.97)
        axes.text(x, 0.97 - 0.16 * row, text, ha=side, va="top", fontsize=7, color=colour, transform=axes.transAxes)
    if len(drawn.samples) > 1:
        return
    (x,) = drawn.samples.values()
    mean, deviation = float(x[:, i].mean()), float(x[:, i].std())
    if deviation <= 1e-12 * abs(mean):
        text = f"{mean:.4g}, does not vary"
    elif 1e-3 <= max(abs(mean), deviation) < 1e5:
        decimals = max(0, 1 - int(np.floor(np.log10(deviation))))
        text = f"{mean:.{decimals}f} ± {deviation:.{decimals}f}"
    else:
        text = f"{mean:.4g} ± {deviation:.2g}"
    axes.set_title(text, fontsize=size, pad=3)


def _inner_ticks(limits: np.ndarray) -> np.ndarray:
    """Two or three round values away from the edges of a panel, so that no label meets one of the next panel."""
    from matplotlib.ticker import MaxNLocator

    low, high = limits + 0.08 * np.array([1.0, -1.0]) * np.ptp(limits)
    candidates = (MaxNLocator(n).tick_values(low, high) for n in (3, 4, 5, 6, 8))
    found = [ticks[(ticks >= low) & (ticks <= high)] for ticks in candidates]
    return next((ticks for ticks in found if len(ticks) > 1), found[-1])


def _set_digits(axis: Any, limits: np.ndarray, size: float) -> None:
    """Write ticks with all digits, instead of an offset in a corner of the axes."""
    from matplotlib.ticker import StrMethodFormatter

    digits = int(np.clip(np.ceil(np.log10(np.abs(limits).max() / np.ptp(limits))) + 2, 3, 15))
    axis.set_major_formatter(StrMethodFormatter(f"{{x:.{digits}g}}"))
    axis.set_tick_params(labelsize=size, length=2.5)


def _wrapped(labels: Sequence[str], characters: int) -> list[str]:
    """Labels in lines of limited length, broken before units and after underscores; formulas are not broken."""

    def wrap(text: str) -> str:
        lines = text.replace("_", "_ ").replace(" [", "\n[", 1).split("\n")
        return "\n".join("\n".join(textwrap.wrap(line, characters)) for line in lines).replace("_ ", "_")

    return [text if "$" in text or len(text) <= characters else wrap(text) for text in labels]


def _legend_handles(drawn: _Drawn) -> list:
    """Lines of the legend: samplers, prior, nominal and true values, as far as they are drawn."""
    from matplotlib.lines import Line2D

    entries = [(label or "posterior", colour, "-") for label, colour in drawn.shades()]
    entries += [("prior", "0.25", ":")] if drawn.densities else []
    entries += [("nominal value", GREY, "--")] if np.isfinite(drawn.nominal).any() else []
    entries += [("true value", RED, "-")] if np.isfinite(drawn.truths).any() else []
    return [Line2D([], [], color=c, linestyle=s, linewidth=1.4, label=label) for label, c, s in entries]
