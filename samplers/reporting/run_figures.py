"""Figures of a run: the tempering stages (`plot_ladder`), and all that the sampler did (`plot_run`).

matplotlib is imported inside the functions.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .figure_parts import BLUE, GREY, ORANGE
from .summary import finished_ladder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_ladder", "plot_run"]


class _Progress(NamedTuple):
    """What is known after each stage of annealing or each round of a guide; arrays of equal length."""

    label: str
    evaluations: np.ndarray
    effective_sample_size: np.ndarray
    log_evidence: np.ndarray
    error: np.ndarray


def plot_ladder(sampler: Any) -> "Figure":
    """Plot the tempering stages of a run against the evaluations that they needed.

    From above: the exponent beta; the effective sample size and the number of distinct points after the resampling; the
    acceptance, with the number of sweeps as bars that are as wide as their stage needed evaluations; and the
    log-evidence so far, with an error of two standard errors. Each point is a stage. Stages that were read from a file
    without their evaluations are drawn against their number.

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
    column = {name: np.array([getattr(s, name) for s in stages]) for name in stages[0]._fields}
    known = column["evaluations"].sum() > 0
    widths = column["evaluations"] if known else np.ones(len(stages))
    ends = np.cumsum(widths)
    figure, (top, middle, bottom, last) = plt.subplots(4, 1, sharex=True, figsize=(7.5, 8.6), layout="constrained")

    ended = sampler.ended_at is not None  # then the last stage is that of all known points, weighted for beta = 1
    reached = slice(None, -1 if ended else None)
    top.semilogy(ends[reached], column["beta"][reached], "o-", color=BLUE, markersize=4)
    if ended:
        top.semilogy(ends[-1], 1.0, "o", color=BLUE, markerfacecolor="white", markersize=5, label="not reached")
        top.legend(frameon=False, fontsize="small", loc="lower right")
    top.set_ylabel(r"exponent $\beta$ [-]")
    top.set_ylim(min(0.05, 0.5 * column["beta"].min()), 2.0)  # at least a decade, so that decades are labelled
    top.set_title(_headline(sampler), fontsize="medium")
    middle.plot(ends, column["effective_sample_size"], "o-", color=BLUE, markersize=4, label="effective sample size")
    middle.plot(ends, column["distinct_ancestors"], "s--", color=ORANGE, markersize=4, label="distinct points")
    middle.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    # the weighted draws of a guide are more than the walkers that are resampled from them
    middle.set_ylim(0, 1.35 * max(sampler.nwalkers, column["effective_sample_size"].max()))
    middle.set_ylabel("number of points")
    middle.legend(frameon=False, fontsize="small", ncols=3, loc="upper center")
    bottom.bar(ends - widths, column["moves"], widths, align="edge", color=GREY, alpha=0.35, edgecolor="white")
    bottom.set_ylabel("sweeps (bars)")
    bottom.set_ylim(0, 1.05 * max(column["moves"].max(), 1))
    bottom.yaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    share = bottom.twinx()
    share.plot(ends, column["acceptance"], "o-", color=BLUE, markersize=4)
    share.set_ylim(0, 1)
    share.set_ylabel("acceptance [-]", color=BLUE)
    progress = _of_stages(stages, ends)
    _draw_evidence(last, [progress], sampler)
    for axes in (top, middle, bottom, last):
        axes.grid(alpha=0.25)
    last.set_xlabel("evaluations of the log-probability" if known else "stage")
    last.set_xlim(0.0 if known else 0.5, 1.02 * ends[-1] if known else len(stages) + 0.5)
    return figure


def plot_run(sampler: Any) -> "Figure":
    """Plot what a sampler did: where its evaluations went, and what was known after each step.

    From above: the evaluations of each phase (rounds of a guide, tempering stages, check of the evidence, sweeps at
    beta = 1); the effective sample size and the log-evidence after each round and each stage; and the log-probability
    of the walkers at beta = 1, as their median and the range that holds 90 % of them. A run that has converged has a
    level log-probability. The idea is that of the run plot of dynesty [1]_.

    Parameters
    ----------
    sampler : TemperedSampler
        A sampler that has run; with or without a guide, recycling or moves.

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ValueError
        If the sampler has no stages.

    References
    ----------
    .. [1] J. S. Speagle (2020), dynesty: a dynamic nested sampling package for estimating Bayesian posteriors and
       evidences, Monthly Notices of the Royal Astronomical Society 493(3), 3132-3158, doi:10.1093/mnras/staa278.
    """
    import matplotlib.pyplot as plt

    stages = finished_ladder(sampler)
    phases = _phases(sampler)
    ends = np.cumsum([stage.evaluations for stage in stages])
    shown = [_of_stages(stages, ends)]
    if rounds := sampler.rounds:
        if len(stages) == 1:  # the guide was enough: the only stage is the result of its rounds
            shown = []
        draws = np.cumsum([r.draws for r in rounds])
        fields = [np.array([getattr(r, name) for r in rounds]) for name in ("log_evidence", "log_evidence_error")]
        shown.append(
            _Progress("rounds of the guide", draws, np.array([r.effective_sample_size for r in rounds]), *fields)
        )
    figure, (top, middle, evidence, chain) = plt.subplots(
        4, 1, figsize=(7.5, 8.8), layout="constrained", height_ratios=(0.45, 1, 1, 1)
    )
    _draw_phases(top, phases)
    top.set_title(_headline(sampler), fontsize="medium")
    for progress, colour in zip(shown, (BLUE, ORANGE), strict=False):
        middle.plot(
            progress.evaluations,
            progress.effective_sample_size,
            "o-",
            color=colour,
            markersize=4,
            label=progress.label,
        )
    middle.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    middle.set_ylim(bottom=0.0)
    middle.set_ylabel("effective sample size")
    middle.legend(frameon=False, fontsize="small", loc="lower right")
    _draw_evidence(evidence, shown, sampler)
    evidence.set_xlabel("evaluations of the log-probability")
    _draw_chain(chain, sampler)
    for axes in (middle, evidence, chain):
        axes.grid(alpha=0.25)
    middle.sharex(evidence)
    return figure


def _headline(sampler: Any) -> str:
    """Stages, cost and evidence of a run in one line; what is missing of a run that has not finished."""
    stages = sampler.ladder
    number = f"{len(stages)} stage{'s' if len(stages) > 1 else ''}"
    cost = f"{sum(stage.evaluations for stage in stages)} evaluations"
    if sampler.ended_at is not None:
        return f"{number}, {cost}, ended by the limit of simulations at beta = {sampler.ended_at:.3g}"
    if stages[-1].beta < 1.0:
        return f"{number}, {cost}, not finished: beta = {stages[-1].beta:.3g}"
    return f"{number}, {cost}, " + rf"$\log Z$ = {sampler.log_evidence:.2f} $\pm$ {sampler.log_evidence_error:.2f}"


def _of_stages(stages: Any, ends: np.ndarray) -> _Progress:
    return _Progress(
        "tempering stages",
        np.asarray(ends),
        np.array([stage.effective_sample_size for stage in stages]),
        np.cumsum([stage.log_evidence_increment for stage in stages]),
        np.array([stage.log_evidence_error for stage in stages]),
    )


def _phases(sampler: Any) -> list[tuple[str, int]]:
    """Evaluations of the phases of a run: name and number, those without evaluations left out."""
    stages, rounds = sampler.ladder, sampler.rounds
    of_guide = sum(r.draws for r in rounds)
    annealing = sum(stage.evaluations for stage in stages)
    check = sampler.log_evidence_check if stages[-1].beta == 1.0 else None
    of_check = 0 if check is None else check.evaluations
    rest = sampler.evaluations - annealing - of_check
    phases = [
        ("draws of the guide", min(of_guide, annealing)),
        ("tempering", annealing - min(of_guide, annealing)),
        ("check of the evidence", of_check),
        ("sweeps at beta = 1", max(rest, 0)),
    ]
    return [(name, number) for name, number in phases if number > 0]


def _draw_phases(axes: "Axes", phases: list[tuple[str, int]]) -> None:
    """One bar, in parts that are as long as the phases needed evaluations."""
    shades = {"draws of the guide": ORANGE, "tempering": BLUE, "check of the evidence": "#b7c9da"}
    start = 0
    for name, number in phases:
        axes.barh(0, number, left=start, color=shades.get(name, GREY), edgecolor="white", label=f"{name}: {number}")
        start += number
    axes.set(xlim=(0, max(start, 1)), yticks=[], ylim=(-0.5, 1.4))
    axes.legend(frameon=False, fontsize="small", ncols=4, loc="upper center", borderaxespad=0.0, handlelength=1.0)
    for side in ("left", "right", "top"):
        axes.spines[side].set_visible(False)
    axes.set_xlabel("evaluations of the log-probability, by phase")


def _draw_evidence(axes: "Axes", shown: list[_Progress], sampler: Any) -> None:
    """Log-evidence so far, and the result with the check."""
    for progress, colour in zip(shown, (BLUE, ORANGE), strict=False):
        axes.errorbar(
            progress.evaluations,
            progress.log_evidence,
            2.0 * progress.error,
            fmt="o-",
            color=colour,
            markersize=4,
            capsize=3,
            label=f"{progress.label}, ± 2 standard errors",
        )
    if sampler.ladder[-1].beta == 1.0:
        axes.axhline(sampler.log_evidence, color=GREY, linewidth=1, linestyle=":", label="result of the run")
    axes.set_ylabel("log-evidence so far")
    axes.legend(frameon=False, fontsize="small", loc="best")


def _draw_chain(axes: "Axes", sampler: Any) -> None:
    """Log-probability of the walkers at beta = 1."""
    axes.set_xlabel("step at beta = 1")
    axes.set_ylabel("log-probability")
    if sampler.iteration == 0:
        axes.text(0.5, 0.5, "no steps at beta = 1 were made", transform=axes.transAxes, ha="center", va="center")
        return
    values = np.asarray(sampler.get_log_prob(), dtype=float)
    steps = np.arange(1, len(values) + 1)
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95], axis=1)
    if len(values) == 1:
        label = "median and 90 % of the walkers"
        axes.errorbar(steps, middle, [middle - low, high - middle], fmt="o", color=BLUE, capsize=4, label=label)
        axes.set(xticks=[1], xlim=(0.5, 1.5))
    else:
        axes.fill_between(steps, low, high, color=BLUE, alpha=0.2, linewidth=0.0, label="90 % of the walkers")
        axes.plot(steps, middle, "o-" if len(values) < 40 else "-", color=BLUE, markersize=3, label="median")
        axes.xaxis.get_major_locator().set_params(integer=True)
    axes.legend(frameon=False, fontsize="small", ncols=2, loc="lower right")
