"""From a finished run to what one reads: arviz data, a table and a figure of the ladder, a pair plot, a summary.

Samples come in as arrays (n, ndim), ladders from the sampler. matplotlib and arviz are imported where they are used.
"""

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.stats import gaussian_kde

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Summary", "ladder_plot", "ladder_table", "pair_plot", "summary", "to_arviz"]

BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"


class Summary(NamedTuple):
    """Moments of the posterior, one entry a parameter.

    Attributes
    ----------
    names : tuple of str
    mean, sd : (ndim,) float — in the parameters' units.
    cv : (ndim,) float — sd / |mean| [-]; inf where the mean is zero and the sd is not.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    cv: np.ndarray

    def __str__(self) -> str:
        width = max(len("parameter"), *(len(name) for name in self.names))
        rows = [f"{'parameter':<{width}} {'mean':>12} {'sd':>12} {'CV':>10}"]
        for name, mean, sd, cv in zip(*self, strict=True):
            rows.append(f"{name:<{width}} {mean:>12.5g} {sd:>12.4g} {cv:>10.3g}")
        return "\n".join(rows)


def _names(names: Sequence[str] | None, ndim: int) -> tuple[str, ...]:
    names = tuple(f"theta_{i}" for i in range(ndim)) if names is None else tuple(names)
    if len(names) != ndim:
        raise ValueError(f"one name a parameter is needed: {ndim} parameters, {len(names)} names {names}")
    return names


def _samples(samples: np.ndarray) -> np.ndarray:
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) of draws, as get_chain(flat=True) gives; got {samples.shape}"
        )
    return samples


def summary(samples: np.ndarray, names: Sequence[str] | None = None, weights: np.ndarray | None = None) -> Summary:
    """Posterior mean, standard deviation and coefficient of variation.

    Parameters
    ----------
    samples : (n, ndim) float
    names : one name a parameter.
    weights : (n,) float, optional — non-negative, need not sum to one.
    """
    samples = _samples(samples)
    if weights is None:
        weights = np.full(len(samples), 1.0)
    weights = np.asarray(weights, dtype=float)
    if weights.shape != (len(samples),) or not np.all(weights >= 0.0) or not 0.0 < weights.sum() < np.inf:
        raise ValueError(f"weights must be {len(samples)} non-negative numbers with a positive sum")
    weights = weights / weights.sum()
    mean = weights @ samples
    sd = np.sqrt(weights @ (samples - mean) ** 2)
    cv = np.divide(sd, np.abs(mean), out=np.where(sd > 0.0, np.inf, 0.0), where=mean != 0.0)
    return Summary(_names(names, samples.shape[1]), mean, sd, cv)


def to_arviz(sampler: Any, parameter_names: Sequence[str] | None = None) -> Any:
    """arviz data of one run or of several independent ones.

    A chain is an independent run: the walkers of one run share their proposals and ancestors, and are draws of one
    chain. (`arviz.from_emcee` makes every walker a chain.) The log-probability is ``lp`` in ``sample_stats``, whose
    attributes carry ``log_evidence`` and ``log_evidence_error``, one number a run, and ``ladder``: JSON, for each run a
    list of stages.

    Parameters
    ----------
    sampler : a sampler that has run, or a sequence of them with equally long chains; `emcee.EnsembleSampler` too.
    parameter_names : one a parameter; by default those of ``log_prob_fn``, else theta_0, theta_1, ...

    Returns
    -------
    arviz.InferenceData (a DataTree from arviz 1.0 on); ``.to_netcdf(path)`` writes it.
    """
    import inspect

    import arviz

    runs = list(sampler) if isinstance(sampler, Sequence) else [sampler]
    if parameter_names is None:
        parameter_names = getattr(runs[0].log_prob_fn.f, "parameter_names", None)
    names = _names(parameter_names, runs[0].ndim)
    chains = [run.get_chain(flat=True) for run in runs]
    if len({chain.shape for chain in chains}) > 1:
        raise ValueError(f"runs must have chains of one shape to stand side by side; got {[c.shape for c in chains]}")
    draws = np.stack(chains)
    groups = {
        "posterior": {name: draws[:, :, i] for i, name in enumerate(names)},
        "sample_stats": {"lp": np.stack([run.get_log_prob(flat=True) for run in runs])},
    }
    # arviz 1.0 takes the groups as one dictionary, its predecessors as keywords
    by_keyword = "posterior" in inspect.signature(arviz.from_dict).parameters
    data = arviz.from_dict(**groups) if by_keyword else arviz.from_dict(groups)

    if all(getattr(run, "ladder", ()) for run in runs):
        data["sample_stats"].attrs.update(
            log_evidence=np.array([run.log_evidence for run in runs]),
            log_evidence_error=np.array([run.log_evidence_error for run in runs]),
            ladder=json.dumps([[stage._asdict() for stage in run.ladder] for run in runs]),
        )
    return data


def _climbed(sampler: Any) -> tuple:
    if not sampler.ladder:
        raise ValueError("the sampler has no ladder yet: call run_mcmc first")
    return sampler.ladder


def ladder_table(sampler: Any) -> str:
    """The ladder as text: one line a stage, the evidence, and the two estimates it was chosen from."""
    head = f"{'stage':>5} {'beta':>10} {'ESS':>7} {'accept':>7} {'moves':>6} {'distinct':>9} {'dlogZ':>10} "
    rows = [head + f"{'evaluations':>12} {'seconds':>9}"]
    for number, s in enumerate(_climbed(sampler), start=1):
        rows.append(
            f"{number:>5} {s.beta:>10.3e} {s.effective_sample_size:>7.0f} {s.acceptance:>7.3f} {s.moves:>6} "
            f"{s.distinct_ancestors:>9} {s.log_evidence_increment:>10.3f} {s.evaluations:>12} {s.seconds:>9.3g}"
        )
    total = sum(s.evaluations for s in sampler.ladder), sum(s.seconds for s in sampler.ladder)
    rows.append(
        f"log evidence {sampler.log_evidence:.3f} +- {sampler.log_evidence_error:.3f}; "
        f"{total[0]} evaluations in {total[1]:.3g} s"
    )
    check = sampler.log_evidence_check
    if check is not None:
        rows.append(
            f"by the ladder {sampler.log_evidence_ladder:.3f} +- {sampler.ladder[-1].log_evidence_error:.3f}; "
            f"by {check.evaluations} independent draws {check.log_evidence:.3f} +- {check.error:.3f} "
            f"(worth {check.effective_sample_size:.0f}, Pareto shape {check.pareto_shape:.2f})"
        )
    return "\n".join(rows)


def ladder_plot(sampler: Any) -> "Figure":
    """Figure of the climb: beta, effective sample size and distinct points, acceptance and moves against the stage."""
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    stages = _climbed(sampler)
    number = np.arange(1, len(stages) + 1)
    column = {name: np.array([getattr(s, name) for s in stages]) for name in stages[0]._fields}
    figure, (top, middle, bottom) = plt.subplots(3, 1, sharex=True, figsize=(7.0, 7.0), layout="constrained")

    top.semilogy(number, column["beta"], "o-", color=BLUE, markersize=4)
    top.set_ylabel(r"$\beta$ [-]")
    if stages[-1].beta == 1.0:
        top.set_title(
            f"{len(stages)} stages, {column['evaluations'].sum()} evaluations, "
            rf"$\log Z$ = {sampler.log_evidence:.2f} $\pm$ {sampler.log_evidence_error:.2f}",
            fontsize="medium",
        )
    middle.plot(number, column["effective_sample_size"], "o-", color=BLUE, markersize=4, label="effective sample size")
    middle.plot(number, column["distinct_ancestors"], "s--", color=ORANGE, markersize=4, label="distinct survivors")
    middle.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    middle.set_ylim(0, 1.08 * sampler.nwalkers)
    middle.set_ylabel("points")
    middle.legend(frameon=False, fontsize="small", ncols=3, loc="lower left")
    bottom.bar(number, column["moves"], color=GREY, alpha=0.35, width=0.7)
    bottom.set_ylabel("sweeps a stage (bars)")
    bottom.yaxis.set_major_locator(MaxNLocator(integer=True))
    share = bottom.twinx()
    share.plot(number, column["acceptance"], "o-", color=BLUE, markersize=4)
    share.set_ylim(0, 1)
    share.set_ylabel("acceptance [-]", color=BLUE)
    bottom.set_xlabel("stage")
    bottom.set_xlim(0.3, len(stages) + 0.7)
    bottom.xaxis.set_major_locator(MaxNLocator(integer=True))
    for axes in (top, middle):
        axes.grid(alpha=0.25)
    return figure


def _kde(values: np.ndarray) -> gaussian_kde | None:
    """Kernel density of (n,) or (k, n) values; None where they have no spread."""
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
) -> "Figure":
    """Pair plot in the manner of Ramancha et al. (2022), Fig. 4.

    Diagonal: histogram and kernel density, the coefficient of variation on top. Above it the samples, below it
    contours of the kernel density with Pearson's r.

    Parameters
    ----------
    samples : (n, ndim) float
    labels : one a parameter, with its unit.
    truth : (ndim,) float, optional — marked by lines, where the truth is known.
    max_points : int — at most so many samples are drawn, and used for the two-dimensional densities.
    grid : int — points a side of the density grids.
    """
    import matplotlib.pyplot as plt
    from matplotlib.ticker import MaxNLocator

    samples = _samples(samples)
    moments = summary(samples, labels)
    ndim = samples.shape[1]
    shown = samples[np.linspace(0, len(samples) - 1, min(max_points, len(samples))).astype(int)]
    low, high = np.quantile(samples, [0.002, 0.998], axis=0)
    margin = np.where(high > low, 0.12 * (high - low), np.maximum(0.05 * np.abs(low), 1e-12))
    low, high = low - margin, high + margin
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
            if truth is not None:
                ax.axvline(truth[j], color=ORANGE, linewidth=1)
                if i != j:
                    ax.axhline(truth[i], color=ORANGE, linewidth=1)
            _dress(ax, MaxNLocator, bottom=i == ndim - 1, left=j == 0 and i > 0)
            if i == ndim - 1:
                ax.set_xlabel(moments.names[j])
            if j == 0:
                ax.set_ylabel(moments.names[i])
    figure.align_ylabels(axes[:, 0])
    return figure


def _density_contours(ax, x, y, xlim, ylim, grid):
    """Contours that hold 20, 40, 60, 80 and 95 % of the samples."""
    density = _kde(np.stack([x, y])) if np.ptp(x) > 0.0 and np.ptp(y) > 0.0 else None
    if density is None:
        return
    u, v = np.meshgrid(np.linspace(*xlim, grid), np.linspace(*ylim, grid))
    height = density(np.stack([u.ravel(), v.ravel()])).reshape(u.shape)
    levels = np.unique(np.quantile(density(np.stack([x, y])), [0.05, 0.2, 0.4, 0.6, 0.8]))
    shades = [BLUE + f"{alpha:02x}" for alpha in np.linspace(40, 230, len(levels)).astype(int)]
    ax.contourf(u, v, height, [*levels, 2.0 * max(height.max(), levels[-1])], colors=shades)
    ax.contour(u, v, height, levels, colors=BLUE, linewidths=0.5)


def _dress(ax, locator, bottom, left):
    """Few ticks, labelled at the outer edges only."""
    ax.xaxis.set_major_locator(locator(3, prune="both"))
    if ax.get_yticks().size:
        ax.yaxis.set_major_locator(locator(3, prune="both"))
    ax.tick_params(labelsize="x-small", labelbottom=bottom, labelleft=left, length=2.5)
    ax.tick_params(axis="x", labelrotation=35)
    ax.xaxis.get_offset_text().set_fontsize("x-small")
    ax.yaxis.get_offset_text().set_fontsize("x-small")
