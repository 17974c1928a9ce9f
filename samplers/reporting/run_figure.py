"""The figure of a run: where its evaluations went, its tempering stages and its chain (`plot_run`).

matplotlib is imported inside the functions.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from .figures import BLUE, GREY, ORANGE
from .summary import finished_ladder

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_run"]


def plot_run(sampler: Any) -> "Figure":
    """Plot what a sampler did: where its evaluations went, and what was known after each step.

    From above: the evaluations of each phase (rounds of a guide, tempering stages, check of the evidence, sweeps at
    beta = 1); the exponent beta and the acceptance of each stage, if there are several; the effective sample size and
    the number of distinct points; the log-evidence with two standard errors, after each round of a guide and each
    stage; and the log-probability of the walkers at beta = 1, as median and 90 % range. The log-probability of a
    converged run has no trend. The idea is from the run plot of dynesty (Speagle 2020, Monthly Notices of the Royal
    Astronomical Society 493(3), doi:10.1093/mnras/staa278).

    `sampler` is a tempered sampler that has run; ValueError if it has no stages.

    Examples
    --------
    >>> figure = plot_run(sampler)
    """
    import matplotlib.pyplot as plt

    stages, rounds = finished_ladder(sampler), sampler.rounds
    stage = {name: np.array([getattr(each, name) for each in stages]) for name in stages[0]._fields}
    ends = np.cumsum(stage["evaluations"])
    several = len(stages) > 1  # a guide that is enough has a single stage, the result of its rounds
    size = {"figsize": (7.5, 8.8 + 2.0 * several), "layout": "constrained"}
    heights = (0.45, 1, 1, 1, 1)[: 4 + several]
    figure, (top, *ladder, points, evidence, chain) = plt.subplots(4 + several, 1, height_ratios=heights, **size)
    _draw_phases(top, sampler)
    top.set_title(_headline(sampler), fontsize="medium")
    for axes in ladder:
        _draw_ladder(axes, sampler, stage, ends)
    style = {"markersize": 4}
    if several or not rounds:
        points.plot(ends, stage["effective_sample_size"], "o-", color=BLUE, label="effective sample size", **style)
        points.plot(ends, stage["distinct_ancestors"], "s--", color=BLUE, alpha=0.5, label="distinct points", **style)
        log_evidence = np.cumsum(stage["log_evidence_increment"])
        _draw_evidence(evidence, ends, log_evidence, stage["log_evidence_error"], BLUE, "stages")
    if rounds:
        draws, effective, value, error = (
            np.array([getattr(each, name) for each in rounds])
            for name in ("draws", "effective_sample_size", "log_evidence", "log_evidence_error")
        )
        points.plot(np.cumsum(draws), effective, "o-", color=ORANGE, label="effective sample size, guide", **style)
        _draw_evidence(evidence, np.cumsum(draws), value, error, ORANGE, "rounds of the guide")
    points.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    points.set_ylim(0.0, 1.3 * points.get_ylim()[1])
    points.set_ylabel("number of points")
    points.legend(frameon=False, fontsize="small", ncols=4, loc="upper center")
    if stages[-1].beta == 1.0:
        evidence.axhline(sampler.log_evidence, color=GREY, linewidth=1, linestyle=":", label="result of the run")
    evidence.set_xlabel("evaluations of the log-probability")
    evidence.set_ylabel("log-evidence so far")
    evidence.ticklabel_format(axis="y", useOffset=False)
    evidence.legend(frameon=False, fontsize="small", loc="best")
    _draw_chain(chain, sampler)
    for axes in (*ladder, points, evidence, chain):
        axes.grid(alpha=0.25)
    for axes in (*ladder, points):
        axes.sharex(evidence)
        axes.tick_params(labelbottom=False)
    return figure


def _headline(sampler: Any) -> str:
    """Stages, cost and evidence of a run in one line, or how far an unfinished run has come."""
    stages = sampler.ladder
    number = f"{len(stages)} stage{'s' if len(stages) > 1 else ''}"
    cost = f"{sampler.evaluations} evaluations"
    if sampler.ended_at is not None:
        return f"{number}, {cost}, ended by the limit of simulations at beta = {sampler.ended_at:.3g}"
    if stages[-1].beta < 1.0:
        return f"{number}, {cost}, not finished: beta = {stages[-1].beta:.3g}"
    return f"{number}, {cost}, " + rf"$\log Z$ = {sampler.log_evidence:.2f} $\pm$ {sampler.log_evidence_error:.2g}"


def _draw_phases(axes: "Axes", sampler: Any) -> None:
    """One bar with one part per phase, whose length is the number of evaluations."""
    annealing = sum(stage.evaluations for stage in sampler.ladder)
    of_guide = min(sum(each.draws for each in sampler.rounds), annealing)
    check = sampler.log_evidence_check if sampler.ladder[-1].beta == 1.0 else None
    of_check = 0 if check is None else check.evaluations
    phases = (
        ("draws of the guide", of_guide, ORANGE),
        ("tempering", annealing - of_guide, BLUE),
        ("check of the evidence", of_check, "#b7c9da"),
        ("sweeps at beta = 1", sampler.evaluations - annealing - of_check, GREY),
    )
    start = 0
    for name, number, colour in phases:
        if number > 0:
            axes.barh(0, number, left=start, color=colour, edgecolor="white", label=f"{name}: {number}")
            start += number
    axes.set(xlim=(0, max(start, 1)), yticks=[], ylim=(-0.5, 1.4))
    axes.legend(frameon=False, fontsize="small", ncols=4, loc="upper center", borderaxespad=0.0, handlelength=1.0)
    axes.spines[["left", "right", "top"]].set_visible(False)
    axes.set_xlabel("evaluations of the log-probability, by phase")


def _draw_ladder(axes: "Axes", sampler: Any, stage: Mapping[str, np.ndarray], ends: np.ndarray) -> None:
    """Exponent beta and acceptance of the stages."""
    ended = sampler.ended_at is not None  # then the last stage has all known points, weighted for beta = 1
    reached = slice(None, -1 if ended else None)
    axes.semilogy(ends[reached], stage["beta"][reached], "o-", color=BLUE, markersize=4)
    if ended:
        axes.semilogy(ends[-1], 1.0, "o", color=BLUE, markerfacecolor="white", markersize=5, label="not reached")
        axes.legend(frameon=False, fontsize="small", loc="lower right")
    axes.set_ylabel(r"exponent $\beta$ [-]", color=BLUE)
    axes.set_ylim(min(0.05, 0.5 * stage["beta"].min()), 2.0)  # at least a decade, so that decades are labelled
    acceptance = axes.twinx()
    acceptance.plot(ends, stage["acceptance"], "s--", color=ORANGE, markersize=4)
    acceptance.set_ylim(0, 1)
    acceptance.set_ylabel("acceptance [-]", color=ORANGE)


def _draw_evidence(
    axes: "Axes", ends: np.ndarray, values: np.ndarray, errors: np.ndarray, colour: str, name: str
) -> None:
    """Log-evidence after each stage or round."""
    label = f"{name}, ± 2 standard errors"
    axes.errorbar(ends, values, 2.0 * errors, fmt="o-", color=colour, markersize=4, capsize=3, label=label)


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
