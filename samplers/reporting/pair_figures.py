"""The posterior of all pairs of parameters, in the form of the published study of the bridge column (`plot_pairs`).

matplotlib is imported inside the functions.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import gaussian_kde

from .drawn_parameters import Values, choose_parameters, panel_limits
from .figure_parts import BLUE, GREY, RED, mark_value, set_ticks, wrap_label
from .summary import summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_pairs"]


def _kde(values: np.ndarray) -> gaussian_kde | None:
    """Kernel density of (n,) or (k, n) values; None if they do not vary."""
    try:
        return gaussian_kde(values)
    except np.linalg.LinAlgError:
        return None


def plot_pairs(
    samples: np.ndarray,
    posterior: Any = None,
    *,
    truths: Values | None = None,
    nominal: Values | None = None,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    max_points: int = 2000,
    grid: int = 60,
) -> "Figure":
    """Plot the posterior of all pairs of parameters, in the style of Ramancha et al. (2022), Fig. 4.

    The diagonal shows the histogram and the kernel density, with the coefficient of variation as title; the upper
    triangle shows the samples; the lower triangle shows contours of the kernel density that hold 20, 40, 60, 80 and
    95 % of the samples, with Pearson's correlation coefficient r. `samplers.plot_corner` shows the prior as well, and
    several samplers.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    posterior, truths, nominal, names, labels
        As for `samplers.plot_corner`. True values are red, nominal values grey.
    max_points : int
        Largest number of samples that are plotted and used for the two-dimensional densities.
    grid : int
        Number of points per side of the grids of the densities.

    Returns
    -------
    matplotlib.figure.Figure
        With axes of shape (k, k) for k parameters.

    Raises
    ------
    ValueError
        As `samplers.plot_corner`.

    References
    ----------
    Ramancha, M. K., Astroza, R., Conte, J. P., Restrepo, J. I. & Todd, M. D. (2022), Bayesian nonlinear finite element
    model updating of a full-scale bridge-column using sequential Monte Carlo
    """
    import matplotlib.pyplot as plt

    drawn = choose_parameters(
        np.asarray(samples, dtype=float),
        posterior,
        truths=truths,
        nominal=nominal,
        prior=False,
        names=names,
        labels=labels,
    )
    (samples,) = drawn.samples.values()
    moments = summary(samples, drawn.labels)
    k = len(drawn.labels)
    shown = samples[np.linspace(0, len(samples) - 1, min(max_points, len(samples))).astype(int)]
    limits = panel_limits(drawn.samples, drawn.truths)
    size = max(4.0, 1.5 * k + 0.8)
    figure, axes = plt.subplots(k, k, figsize=(size, size), squeeze=False, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.02, hspace=0.02)

    for i in range(k):
        for j in range(k):
            ax = axes[i, j]
            x, y = samples[:, j], samples[:, i]
            if i == j:
                ax.hist(x, bins=40, range=tuple(limits[j]), density=True, color=BLUE, alpha=0.3)
                density = _kde(x)
                if density is not None:
                    t = np.linspace(*limits[j], 200)
                    ax.plot(t, density(t), color=BLUE, linewidth=1.4)
                ax.set_title(f"CV = {moments.cv[j]:.2e}", fontsize="small", pad=3)
                ax.set_yticks([])
            elif i < j:
                ax.plot(shown[:, j], shown[:, i], ".", color=BLUE, markersize=2, alpha=0.35, markeredgewidth=0)
            else:
                _density_contours(ax, shown[:, j], shown[:, i], limits[j], limits[i], grid)
                if np.ptp(x) > 0.0 and np.ptp(y) > 0.0:
                    r = np.corrcoef(x, y)[0, 1]
                    ax.text(0.05, 0.95, f"r = {r:.2f}", transform=ax.transAxes, va="top", fontsize="small")
            ax.set_xlim(limits[j])
            set_ticks(ax.xaxis, *limits[j])
            if i != j:
                ax.set_ylim(limits[i])
                set_ticks(ax.yaxis, *limits[i])
            _mark(ax, drawn.nominal, drawn.truths, i, j)
            ax.tick_params(labelbottom=i == k - 1, labelleft=j == 0 and i > 0)
            ax.tick_params(axis="x", labelrotation=35)
            if i == k - 1:
                ax.set_xlabel(wrap_label(drawn.labels[j], 21), fontsize=9)
            if j == 0:
                ax.set_ylabel(wrap_label(drawn.labels[i], 21), fontsize=9)
    figure.align_ylabels(axes[:, 0])
    return figure


def _mark(ax: "Axes", nominal: np.ndarray, truths: np.ndarray, i: int, j: int) -> None:
    """Mark the values of the panel of row i and column j; arrows and their values are on the diagonal."""
    for level, (values, colour) in enumerate(((nominal, GREY), (truths, RED))):
        mark_value(ax, values[j], colour, level=level, label=i == j)
        if i != j:
            mark_value(ax, values[i], colour, vertical=True)


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
