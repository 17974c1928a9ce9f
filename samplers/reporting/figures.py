"""Figures of posterior samples (`plot_corner`, `plot_marginals`) and of a run (`plot_run`).

Units, labels and nominal values come from ``posterior.parameters``; otherwise labels are ``posterior.parameter_names``
or x0, x1, ... matplotlib and corner are imported inside the functions.
"""

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .summary import is_tempered

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BLUE = "#1f5a8c"
ORANGE = "#d9822b"
GREY = "#8a8f98"
RED = "#b03a48"
HISTOGRAM = {"density": True, "histtype": "stepfilled", "fc": BLUE + "40", "ec": BLUE, "label": "posterior"}
LEVELS = (0.5, 0.9)
FEW_POINTS = 150  # fewer distinct samples are drawn as points, since a contour through them shows chance
MOST_PARAMETERS = 12  # of a corner plot without var_names
PRIOR_DRAWS = 20_000  # for densities of parameters without a distribution and for the range of a prior
LARGEST_PANEL = 2.5  # largest panel width in `plot_marginals`, as a multiple of the range of the samples


class _Drawn(NamedTuple):
    """The k parameters of a figure; all values in the units of the labels, NaN for a value that is not marked."""

    labels: list[str]
    samples: np.ndarray  # (n, k)
    truths: np.ndarray
    nominal: np.ndarray
    densities: list[Callable[[np.ndarray], np.ndarray]]  # of values (m,); none without a prior
    prior_draws: np.ndarray | None  # (m, k)
    limits: np.ndarray  # (k, 2) of the panels
    note: str


def plot_corner(
    samples: np.ndarray,
    posterior: Any = None,
    *,
    truths: Sequence[float] | None = None,
    var_names: Sequence[str] | None = None,
) -> "Figure":
    """Plot the posterior for all pairs of parameters by `corner.corner`, with the prior on the diagonal.

    See Foreman-Mackey (2016), corner.py, Journal of Open Source Software 1(2), 24, doi:10.21105/joss.00024. The
    contours hold 50 and 90 % of the samples. Fewer than 150 distinct samples are drawn as points.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior, as ``get_chain(flat=True)`` returns, at least as many as parameters.
    posterior : Posterior, optional
        Gives units, labels and nominal values (``posterior.parameters``, as grey dashed lines) and the prior
        (``posterior.prior``). An object of your own may have ``parameter_names`` and ``prior``.
    truths : sequence of float, shape (ndim,), optional
        True values in the units of the samples, as red lines; NaN for none. The panels are widened to show a true or
        nominal value if that is near.
    var_names : sequence of str, optional
        Parameters to draw, in this order. Default: all, or the first 12; the figure says how many are left out.

    Returns
    -------
    matplotlib.figure.Figure
        With axes of shape (k, k) for k parameters; the axes above the diagonal are empty.

    Examples
    --------
    >>> figure = plot_corner(samples, posterior, var_names=["stiffness", "damping"])
    """
    import corner  # imports arviz
    import matplotlib.pyplot as plt

    drawn = _choose(samples, posterior, truths, var_names, MOST_PARAMETERS)
    k, few = len(drawn.labels), len(np.unique(drawn.samples, axis=0)) < FEW_POINTS
    size = float(np.clip(1.8 * k + 1.5, 4.5, 16.0))  # [in]
    top = 0.4 if k > 1 else 1.3  # margin [in], with the legend above a single panel
    figure = plt.figure(figsize=(size, size))
    with plt.rc_context({"axes.formatter.useoffset": False, "font.size": 8.0}):
        corner.corner(
            drawn.samples,
            bins=_bins(drawn.samples),
            range=[tuple(each) for each in drawn.limits],
            color=BLUE,
            labels=[label.replace(" [", "\n[") for label in drawn.labels],
            fig=figure,
            labelpad=0.6 * k / (size - top - 1.1) - 0.3,  # 0.6 in from the axes, beside rotated numbers
            max_n_ticks=4,
            hist_kwargs=HISTOGRAM,
            levels=LEVELS,
            smooth=1.0,
            plot_density=False,
            plot_datapoints=few,
            data_kwargs={"ms": 4.0, "alpha": 0.7},
            plot_contours=not few,
            fill_contours=True,
            quiet=True,
        )
    figure.subplots_adjust(left=1.1 / size, bottom=1.1 / size, top=1.0 - top / size)
    grid = np.array(figure.axes).reshape(k, k)
    for i, limits in enumerate(drawn.limits):
        ticks = grid[-1, i].get_xticks()
        ticks = ticks[np.abs(ticks - limits.mean()) < 0.4 * np.ptp(limits)]  # numbers at an edge touch the next panel's
        plt.setp(grid[i:, i], xticks=ticks)
        plt.setp(grid[i, :i], yticks=ticks)
        _finish_panel(grid[i:, i], drawn, i, row=grid[i, :i])
    note = f"points: fewer than {FEW_POINTS} samples" if few else "contours hold 50 and 90 % of the samples"
    _add_legend(figure, loc="upper right", title=note + drawn.note)
    return figure


def plot_marginals(samples: np.ndarray, posterior: Any = None, *, truths: Sequence[float] | None = None) -> "Figure":
    """Plot the prior and posterior density of each parameter, which shows what the data have changed.

    A panel shows the prior, but is at most 2.5 times as wide as the range of the samples. If the prior is wider, the
    title says by how much.

    Parameters and errors as for `plot_corner`. All parameters are drawn, in one axes each.

    Examples
    --------
    >>> figure = plot_marginals(samples, posterior)
    """
    import matplotlib.pyplot as plt

    drawn = _choose(samples, posterior, truths)
    columns = min(4, len(drawn.labels))
    rows = -(-len(drawn.labels) // columns)
    figure = plt.figure(figsize=(max(2.7 * columns, 4.0), 2.25 * rows + 0.5), layout="constrained")
    for i, label in enumerate(drawn.labels):
        axes, note = figure.add_subplot(rows, columns, i + 1, xlabel=label, yticks=[]), ""
        low, high = drawn.limits[i]
        axes.hist(drawn.samples[:, i], _bins(drawn.samples), range=(low, high), **HISTOGRAM)
        if drawn.prior_draws is not None:
            draws, spread = drawn.prior_draws[:, i], float(drawn.samples[:, i].std())
            room, prior = 0.5 * (LARGEST_PANEL - 1.0) * (high - low), np.quantile(draws, [0.005, 0.995])
            if (prior[0] < low - room or prior[1] > high + room) and spread > 1e-12 * abs(high):
                note = f"\nprior {float(f'{draws.std() / spread:.2g}'):.0f} times wider"
            low, high = min(low, max(prior[0], low - room)), max(high, min(prior[1], high + room))
        drawn.limits[i] = low, high
        axes.set_xlim(low, high)
        _finish_panel([axes], drawn, i, note)
        axes.xaxis.set_major_locator(plt.MaxNLocator(4))
        axes.ticklabel_format(useOffset=False)
    _add_legend(figure, loc="outside lower center", ncols=4, fontsize=9)
    return figure


def _choose(
    samples: Any, posterior: Any, truths: Any, names: Sequence[str] | None = None, most: int | None = None
) -> _Drawn:
    """Check the arguments of a figure, and convert what it shows to the units of its labels."""
    if posterior is not None and not hasattr(posterior, "parameter_names"):
        raise ValueError(f"posterior must have parameter_names (var_names= chooses parameters); got {posterior!r}")
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2 or not 1 <= samples.shape[1] <= len(samples):
        raise ValueError(f"samples must be an array (n, ndim) with n >= 2 and n >= ndim; got {samples.shape}")
    if bad := np.count_nonzero(~np.isfinite(samples).all(axis=1)):
        raise ValueError(f"samples must be finite; {bad} of {len(samples)} rows are not: leave these rows out")
    ndim, parameters = samples.shape[1], getattr(posterior, "parameters", None)
    if parameters is None:
        known = getattr(posterior, "parameter_names", None) or [f"x{i}" for i in range(ndim)]
        parameters = [SimpleNamespace(name=str(name), label=str(name), factor=1.0, nominal=np.nan) for name in known]
    known = [each.name for each in parameters]
    if len(known) != ndim:
        raise ValueError(
            f"the posterior has {len(known)} parameters ({', '.join(known)}), but the samples have {ndim} columns"
        )
    wanted = known[:most] if names is None else names
    note = f"\nthe first {most} of {ndim} parameters; see var_names=" if names is None and len(wanted) < ndim else ""
    if not len(wanted) or not set(wanted) <= set(known):
        raise ValueError(f"var_names must be some of the parameters {', '.join(known)}; got {wanted!r}")
    columns = [known.index(name) for name in wanted]
    shown = [parameters[i] for i in columns]
    factors = np.array([each.factor for each in shown])
    samples = samples[:, columns] / factors
    nominal = np.array([each.nominal for each in shown], dtype=float) / factors
    truths = np.full(ndim, np.nan) if truths is None else np.array(truths, dtype=float)
    if truths.shape != (ndim,):
        raise ValueError(f"truths must have one value for each of {ndim} parameters (NaN for no mark); got {truths}")
    truths = truths[columns] / factors
    limits = _limits(samples, np.stack([truths, nominal]))
    priors = _priors(posterior, wanted, columns, factors)
    return _Drawn([each.label for each in shown], samples, truths, nominal, *priors, limits, note)


def _priors(posterior: Any, names: Sequence[str], columns: list[int], factors: np.ndarray) -> tuple[list, Any]:
    """Prior densities of the parameters, from draws if ``prior.distributions`` has none, and draws (n, k)."""
    prior = getattr(posterior, "prior", None)
    if not hasattr(prior, "rvs"):
        return [], None
    draws = np.asarray(prior.rvs(PRIOR_DRAWS, 0), dtype=float)[:, columns] / factors  # a seed: always the same figure
    distributions = getattr(prior, "distributions", {})

    def density(i: int) -> Callable[[np.ndarray], np.ndarray]:
        if (distribution := distributions.get(names[i])) is not None:
            return lambda values: np.exp(distribution.logpdf(values * factors[i])) * factors[i]
        from scipy.stats import gaussian_kde  # slow to import

        return gaussian_kde(draws[:, i]) if np.ptp(draws[:, i]) > 0.0 else np.zeros_like

    return [density(i) for i in range(len(columns))], draws


def _limits(samples: np.ndarray, marks: np.ndarray) -> np.ndarray:
    """Limits (k, 2) of the panels: the range of the samples, wider by up to half its size for marks (m, k)."""
    low, high = np.quantile(samples, [0.002, 0.998], axis=0)
    near = np.where((marks > low - 0.5 * (high - low)) & (marks < high + 0.5 * (high - low)), marks, np.nan)
    low, high = np.fmin(low, np.fmin.reduce(near)), np.fmax(high, np.fmax.reduce(near))
    varies = high - low > 1e-12 * np.maximum(np.abs(low), np.abs(high))
    space = np.where(varies, 0.12 * (high - low), np.maximum(0.05 * np.abs(low), 1e-12))
    return np.column_stack([low - space, high + space])


def _bins(x: np.ndarray) -> int:
    """Number of bins for a histogram of samples (n, k), some of which are copies."""
    return int(np.clip(np.sqrt(len(np.unique(x[:, 0]))), 12, 36))


def _finish_panel(column: "Sequence[Axes]", drawn: _Drawn, i: int, note: str = "", row: "Sequence[Axes]" = ()) -> None:
    """Marks of one parameter in its column and row, and its prior density and moments in the first axes of the column.

    Marks outside the panel are part of the title.
    """
    axes, (low, high) = column[0], drawn.limits[i]
    highest = 1.1 * max(patch.get_xy()[:, 1].max() for patch in axes.patches)
    if drawn.densities:
        places = np.linspace(low, high, 200)
        density = drawn.densities[i](places)
        axes.plot(places, density, color="0.25", linestyle=":", linewidth=1.4, label="prior")
        highest = max(highest, min(1.1 * density[np.isfinite(density)].max(initial=0.0), 3.0 * highest))
    axes.set_ylim(0.0, highest)
    for values, name, *style in ((drawn.nominal, "nominal", GREY, "--"), (drawn.truths, "true", RED, "-")):
        value, style = values[i], dict(zip(("color", "linestyle"), style, strict=True), linewidth=1.1)
        for each in column if np.isfinite(value) else ():
            each.axvline(value, label=f"{name} value", **style)
        for each in row if np.isfinite(value) else ():
            each.axhline(value, **style)
        if value < low or value > high:
            note += f"\n{name}: {value:.4g}"
    mean, deviation = float(drawn.samples[:, i].mean()), float(drawn.samples[:, i].std())
    decimals = max(0, 1 - int(np.floor(np.log10(max(deviation, 1e-8)))))
    axes.set_title(f"{mean:.{decimals}f} ± {deviation:.{decimals}f}{note}", fontsize=8.0)


def _add_legend(figure: "Figure", **options: Any) -> None:
    """A legend of what is drawn, with each label once."""
    found = [axes.get_legend_handles_labels() for axes in figure.axes]
    entries = {label: handle for each in found for handle, label in zip(*each, strict=True)}
    figure.legend(entries.values(), entries, frameon=False, **options)


def plot_run(sampler: Any) -> "Figure":
    """Plot what a sampler did: what was known after each step, against the evaluations; the title has the simulations.

    From above: the exponent beta and the acceptance of each stage, if there are several; the effective sample size; the
    log-evidence with two standard errors, after each round of a guide and each stage; and the log-probability of the
    walkers at beta = 1, as median and 90 % range, if there are several steps. In a converged run it has no trend. The
    idea is from the run plot of dynesty (Speagle 2020, Monthly Notices of the Royal Astronomical Society 493(3),
    doi:10.1093/mnras/staa278).

    `sampler` is a tempered sampler that has run; ValueError if it has no stages.

    Examples
    --------
    >>> figure = plot_run(sampler)
    """
    import matplotlib.pyplot as plt

    if not (is_tempered(sampler) and sampler.ladder):
        raise ValueError(
            "plot_run draws the stages of an SMCSampler or TMCMCSampler that has run: call run_mcmc first; got "
            f"{type(sampler).__name__}"
        )
    stages, rounds = sampler.ladder, sampler.rounds
    several = len(stages) > 1  # a guide that is enough has a single stage, the result of its rounds
    steps = np.arange(1, sampler.iteration + 1)
    n = 2 + several + (len(steps) > 1)
    figure, panels = plt.subplots(n, 1, figsize=(7.5, 2.2 * n + 1.0), layout="constrained")
    ladder, (points, evidence, *chain) = panels[:several], panels[several:]
    title = f"{sampler.simulations:.0f} simulations"
    made, beta, ess, share, increments, errors = np.array([(s.evaluations, *s[:3], *s[5:7]) for s in stages]).T
    ends = np.cumsum(made)
    for axes in ladder:
        axes.semilogy(ends, beta, "o-", color=BLUE, label="exponent β", markersize=4)
        axes.semilogy(ends, share, "s--", color=ORANGE, label="acceptance", markersize=4)
        axes.set_ylabel("β, acceptance [-]")
    lines = [(ends, ess, np.cumsum(increments), errors, BLUE, "stages")] if several or not rounds else []
    if rounds:
        draws, *others = np.array([(r.draws, r.effective_sample_size, *r[3:5]) for r in rounds]).T
        lines.append((np.cumsum(draws), *others, ORANGE, "rounds of the guide"))
    for at, effective, values, around, colour, name in lines:
        points.plot(at, effective, "o-", color=colour, label=f"effective sample size, {name}", markersize=4, zorder=3)
        style = {"fmt": "o-", "color": colour, "markersize": 4, "capsize": 3}
        evidence.errorbar(at, values, 2.0 * around, label=f"{name}, ± 2 standard errors", **style)
    points.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    points.set(ylim=(0.0, 1.3 * points.get_ylim()[1]), ylabel="number of points")
    if stages[-1].beta == 1.0:
        title += f", log Z = {sampler.log_evidence:.2f} ± {sampler.log_evidence_error:.2g}"
        evidence.axhline(sampler.log_evidence, color=GREY, linewidth=1, linestyle=":", label="result")
    figure.suptitle(title, fontsize="medium")
    before = f", after {sampler.simulations_of_guides:.0f} simulations by the guide" if rounds else ""
    evidence.set(xlabel=f"evaluations of the log-probability{before}", ylabel="log-evidence so far")
    evidence.ticklabel_format(axis="y", useOffset=False)
    for axes in chain:
        levels = np.quantile(np.asarray(sampler.get_log_prob(), dtype=float), [0.05, 0.5, 0.95], axis=1)
        axes.set(xlabel="step at beta = 1", ylabel="log-probability")
        axes.fill_between(steps, levels[0], levels[2], color=BLUE, alpha=0.3, linewidth=0.0)
        axes.plot(steps, levels[1], "o-", color=BLUE, markersize=3, label="median and 90 % of the walkers")
        axes.xaxis.get_major_locator().set_params(integer=True)
    for axes in panels:
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize="small", ncols=3)
    for axes in (*ladder, points):
        axes.sharex(evidence)
        axes.tick_params(labelbottom=False)
    return figure
