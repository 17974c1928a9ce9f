"""Figures of a finished run: the tempering stages, and the posterior of pairs of parameters.

matplotlib is imported inside the functions.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import gaussian_kde

from .summary import finished_ladder, summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["ladder_plot", "pair_plot"]

BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"


def ladder_plot(sampler: Any) -> "Figure":
    """Plot the tempering stages of a run.

    The panels show, per stage, the exponent beta; the effective sample size and the number of distinct points after the
    resampling; and the acceptance with the number of sweeps.

    Parameters
    ----------
    sampler : TemperedSampler
        A sampler that has run.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        If the sampler has no stages.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    stages = finished_ladder(sampler)
    number = np.arange(1, len(stages) + 1)
    column = {name: np.array([getattr(s, name) for s in stages]) for name in stages[0]._fields}
    figure, (top, middle, bottom) = plt.subplots(3, 1, sharex=True, figsize=(7.0, 7.0), layout="constrained")

    top.semilogy(number, column["beta"], "o-", color=BLUE, markersize=4)
    top.set_ylabel(r"$\beta$ [-]")
    top.set_ylim(min(0.05, 0.5 * column["beta"].min()), 2.0)  # at least a decade, so that decades are labelled
    if stages[-1].beta == 1.0:
        top.set_title(
            f"{len(stages)} stage{'s' if len(stages) > 1 else ''}, {column['evaluations'].sum()} evaluations, "
            rf"$\log Z$ = {sampler.log_evidence:.2f} $\pm$ {sampler.log_evidence_error:.2f}",
            fontsize="medium",
        )
    middle.plot(number, column["effective_sample_size"], "o-", color=BLUE, markersize=4, label="effective sample size")
    middle.plot(number, column["distinct_ancestors"], "s--", color=ORANGE, markersize=4, label="distinct points")
    middle.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    # the weighted draws of a guide are more than the walkers that are resampled from them
    middle.set_ylim(0, 1.08 * max(sampler.nwalkers, column["effective_sample_size"].max()))
    middle.set_ylabel("points")
    middle.legend(frameon=False, fontsize="small", ncols=3, loc="lower left")
    bottom.bar(number, column["moves"], color=GREY, alpha=0.35, width=0.7)
    bottom.set_ylabel("sweeps per stage (bars)")
    bottom.set_ylim(0, 1.05 * max(column["moves"].max(), 1))
    bottom.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    share = bottom.twinx()
    share.plot(number, column["acceptance"], "o-", color=BLUE, markersize=4)
    share.set_ylim(0, 1)
    share.set_ylabel("acceptance [-]", color=BLUE)
    bottom.set_xlabel("stage")
    bottom.set_xlim(0.3, len(stages) + 0.7)
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    for axes in (top, middle):
        axes.grid(alpha=0.25)
    return figure


def _kde(values: np.ndarray) -> gaussian_kde | None:
    """Kernel density of (n,) or (k, n) values; None if they do not vary."""
    try:
        return gaussian_kde(values)
    except np.linalg.LinAlgError:
        return None


def pair_plot(
    samples: np.ndarray,
    labels: Sequence[str] | None = None,
    truth: Sequence[float] | None = None,
    max_points: int = 2000,
    grid: int = 60,
    nominal: Sequence[float] | None = None,
) -> "Figure":
    """Plot the posterior of all pairs of parameters, in the style of Ramancha et al. (2022), Fig. 4.

    The diagonal shows the histogram and the kernel density, with the coefficient of variation as title; the upper
    triangle shows the samples; the lower triangle shows contours of the kernel density that hold 20, 40, 60, 80 and
    95 % of the samples, with Pearson's correlation coefficient r.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    labels : sequence of str, optional
        One label per parameter, with its unit.
    truth : sequence of float, shape (ndim,), optional
        True parameters, where they are known, marked by lines. The panels are those of the samples, widened by up to
        half of their size to show a true value near them. A value that is still outside is an arrow at the edge, with
        the value on the diagonal. NaN: no mark.
    max_points : int
        Largest number of samples that are plotted and used for the two-dimensional densities.
    grid : int
        Number of points per side of the grids of the densities.
    nominal : sequence of float, shape (ndim,), optional
        Values before the update, marked in grey in the same way, without widening the panels.

    Returns
    -------
    matplotlib.figure.Figure

    References
    ----------
    Ramancha, M. K., Astroza, R., Conte, J. P., Restrepo, J. I. & Todd, M. D. (2022), Bayesian nonlinear finite element
    model updating of a full-scale bridge-column using sequential Monte Carlo
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    moments = summary(samples, labels)
    samples = np.asarray(samples, dtype=float)
    ndim = samples.shape[1]
    shown = samples[np.linspace(0, len(samples) - 1, min(max_points, len(samples))).astype(int)]
    low, high = np.quantile(samples, [0.002, 0.998], axis=0)
    if truth is not None:
        low, high = _widened(low, high, np.asarray(truth, dtype=float))
    margin = np.where(high > low, 0.12 * (high - low), np.maximum(0.05 * np.abs(low), 1e-12))
    low, high = low - margin, high + margin
    marked = [(values, colour) for values, colour in ((nominal, GREY), (truth, ORANGE)) if values is not None]
    size = max(4.0, 1.5 * ndim + 0.8)
    figure, axes = plt.subplots(ndim, ndim, figsize=(size, size), squeeze=False, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)

    for i in range(ndim):
        for j in range(ndim):
            ax = axes[i, j]
            x, y = samples[:, j], samples[:, i]
            ax.set_xlim(low[j], high[j])
            if i == j:
                ax.hist(x, bins=40, range=(low[j], high[j]), density=True, color=BLUE, alpha=0.3)
                density = _kde(x)
                if density is not None:
                    t = np.linspace(low[j], high[j], 200)
                    ax.plot(t, density(t), color=BLUE, linewidth=1.4)
                ax.set_title(f"CV = {moments.cv[j]:.2e}", fontsize="small", pad=3)
                ax.set_yticks([])
            else:
                ax.set_ylim(low[i], high[i])
            if i < j:
                ax.plot(shown[:, j], shown[:, i], ".", color=BLUE, markersize=2, alpha=0.35, markeredgewidth=0)
            elif i > j:
                _density_contours(ax, shown[:, j], shown[:, i], (low[j], high[j]), (low[i], high[i]), grid)
                if np.ptp(x) > 0.0 and np.ptp(y) > 0.0:
                    r = np.corrcoef(x, y)[0, 1]
                    ax.text(0.05, 0.95, f"r = {r:.2f}", transform=ax.transAxes, va="top", fontsize="small")
            for level, (values, colour) in enumerate(marked):
                _mark(ax, values[j], low[j], high[j], colour, label=i == j, level=level)
                if i != j:
                    _mark(ax, values[i], low[i], high[i], colour, vertical=True)
            _format_axes(ax, MaxNLocator, bottom=i == ndim - 1, left=j == 0 and i > 0)
            if i == ndim - 1:
                ax.set_xlabel(moments.names[j])
            if j == 0:
                ax.set_ylabel(moments.names[i])
    figure.align_ylabels(axes[:, 0])
    return figure


def _widened(low: np.ndarray, high: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Limits that contain the true values, where these are within half of the size of the panel from it."""
    near = (truth > low - 0.5 * (high - low)) & (truth < high + 0.5 * (high - low))
    return np.where(near, np.fmin(low, truth), low), np.where(near, np.fmax(high, truth), high)


def _mark(ax, value, low, high, colour, label=False, vertical=False, level=0):
    """Mark a value on one axis by a line, or by an arrow at the edge beyond which it is, on request with the value."""
    if not np.isfinite(value):
        return
    if low < value < high:
        (ax.axhline if vertical else ax.axvline)(value, color=colour, linewidth=1)
        return
    end, start = (0.99, 0.80) if value >= high else (0.01, 0.20)
    across = 0.90 - 0.22 * level if label else (0.94 if value >= high else 0.30) if vertical else 0.06
    tip, tail = ((across, end), (across, start)) if vertical else ((end, across), (start, across))
    style = {"arrowstyle": "-|>", "color": colour, "linewidth": 1.0, "shrinkA": 0.0, "shrinkB": 0.0}
    ax.annotate("", tip, tail, xycoords="axes fraction", arrowprops=style, annotation_clip=False)
    if label:
        side = "right" if value >= high else "left"
        place = (start - 0.04 if side == "right" else start + 0.04, across)
        text = {"ha": side, "va": "center", "fontsize": "x-small", "color": colour}
        ax.text(*place, f"{value:.4g}", transform=ax.transAxes, **text)


def _density_contours(ax, x, y, xlim, ylim, grid):
    """Draw contours that hold 20, 40, 60, 80 and 95 % of the samples."""
    density = _kde(np.stack([x, y])) if np.ptp(x) > 0.0 and np.ptp(y) > 0.0 else None
    if density is None:
        return
    u, v = np.meshgrid(np.linspace(*xlim, grid), np.linspace(*ylim, grid))
    height = density(np.stack([u.ravel(), v.ravel()])).reshape(u.shape)
    levels = np.unique(np.quantile(density(np.stack([x, y])), [0.05, 0.2, 0.4, 0.6, 0.8]))
    shades = [BLUE + f"{alpha:02x}" for alpha in np.linspace(40, 230, len(levels)).astype(int)]
    ax.contourf(u, v, height, [*levels, 2.0 * max(height.max(), levels[-1])], colors=shades)
    ax.contour(u, v, height, levels, colors=BLUE, linewidths=0.5)


def _format_axes(ax, locator, bottom, left):
    """Set few ticks, with labels on the outer axes only."""
    ax.xaxis.set_major_locator(locator(3, prune="both"))
    if ax.get_yticks().size:
        ax.yaxis.set_major_locator(locator(3, prune="both"))
    ax.tick_params(labelsize="x-small", labelbottom=bottom, labelleft=left, length=2.5)
    ax.tick_params(axis="x", labelrotation=35)
    ax.xaxis.get_offset_text().set_fontsize("x-small")
    ax.yaxis.get_offset_text().set_fontsize("x-small")
