"""The figure of a run: where its evaluations went, its tempering stages and its chain (`plot_run`).

matplotlib is imported inside the functions.
"""

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
    several = len(stages) > 1  # a guide that is enough has a single stage, the result of its rounds
    size = {"figsize": (7.5, 8.8 + 2.0 * several), "layout": "constrained"}
    heights = (0.45, 1, 1, 1, 1)[: 4 + several]
    figure, (top, *ladder, points, evidence, chain) = plt.subplots(4 + several, 1, height_ratios=heights, **size)
    _draw_phases(top, sampler)
    table = np.array([(s.evaluations, *s[:3], s.distinct_ancestors, *s[5:7]) for s in stages]).T
    made, beta, ess, share, distinct, increments, errors = table
    ends = np.cumsum(made)
    for axes in ladder:
        axes.semilogy(ends, beta, "o-", color=BLUE, markersize=4)
        axes.set_ylabel(r"exponent $\beta$ [-]", color=BLUE)
        acceptance = axes.twinx()
        acceptance.plot(ends, share, "s--", color=ORANGE, markersize=4)
        acceptance.set_ylim(0, 1)
        acceptance.set_ylabel("acceptance [-]", color=ORANGE)
    lines = [(ends, ess, np.cumsum(increments), errors, BLUE, "stages")] if several or not rounds else []
    if rounds:
        draws, *others = np.array([(r.draws, r.effective_sample_size, *r[3:5]) for r in rounds]).T
        lines.append((np.cumsum(draws), *others, ORANGE, "rounds of the guide"))
    for at, effective, values, around, colour, name in lines:
        points.plot(at, effective, "o-", color=colour, label=f"effective sample size, {name}", markersize=4, zorder=3)
        style = {"fmt": "o-", "color": colour, "markersize": 4, "capsize": 3}
        evidence.errorbar(at, values, 2.0 * around, label=f"{name}, ± 2 standard errors", **style)
    if several or not rounds:
        points.plot(ends, distinct, "s--", color=BLUE, alpha=0.5, label="distinct points", markersize=4)
    points.axhline(sampler.nwalkers, color=GREY, linewidth=1, linestyle=":", label="walkers")
    points.set(ylim=(0.0, 1.3 * points.get_ylim()[1]), ylabel="number of points")
    evidence.set(xlabel="evaluations of the log-probability", ylabel="log-evidence so far")
    evidence.ticklabel_format(axis="y", useOffset=False)
    for axes in (points, evidence):
        axes.legend(frameon=False, fontsize="small", ncols=3)
    chain.set(xlabel="step at beta = 1", ylabel="log-probability")
    if sampler.iteration > 0:
        levels = np.quantile(np.asarray(sampler.get_log_prob(), dtype=float), [0.05, 0.5, 0.95], axis=1)
        steps = np.arange(1, sampler.iteration + 1)
        chain.fill_between(steps, levels[0], levels[2], color=BLUE, alpha=0.3, linewidth=0.0)
        chain.plot(steps, levels[1], "o-" if len(steps) < 40 else "-", color=BLUE, markersize=3)
        chain.set_title("median and 90 % of the walkers", fontsize="small")
        chain.xaxis.get_major_locator().set_params(integer=True)
    for axes in (*ladder, points, evidence, chain):
        axes.grid(alpha=0.25)
    for axes in (*ladder, points):
        axes.sharex(evidence)
        axes.tick_params(labelbottom=False)
    return figure


def _draw_phases(axes: "Axes", sampler: Any) -> None:
    """One bar with one part per phase, whose length is the number of evaluations; the title has cost and evidence."""
    stages = sampler.ladder
    title = f"{len(stages)} stage{'s' if len(stages) > 1 else ''}, {sampler.evaluations} evaluations, "
    if sampler.ended_at is not None:
        title += f"ended by the limit of simulations at beta = {sampler.ended_at:.3g}"
    elif stages[-1].beta < 1.0:
        title += f"not finished: beta = {stages[-1].beta:.3g}"
    else:
        title += rf"$\log Z$ = {sampler.log_evidence:.2f} $\pm$ {sampler.log_evidence_error:.2g}"
    axes.set_title(title, fontsize="medium")
    annealing = sum(stage.evaluations for stage in stages)
    of_guide = min(sum(each.draws for each in sampler.rounds), annealing)
    check = sampler.log_evidence_check if stages[-1].beta == 1.0 else None
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
