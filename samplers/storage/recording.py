"""Recording of an annealing while it runs: wall time, evaluations and storage of its stages, and the progress bar."""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from ..tempering.diagnostics import check_evidence, warn
from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import (
    Doubt,
    GuidedRound,
    GuidedStart,
    GuideTick,
    Halt,
    Population,
    Report,
    Restart,
    Stage,
    Sweep,
)
from ..tempering.results import AnnealingResult
from .checkpoint import Checkpoint
from .evaluation import Evaluator

__all__ = ["record", "show_progress"]


def record(
    steps: Iterator[tuple[Population, Report]], evaluator: Evaluator, checkpoint: Checkpoint
) -> Iterator[tuple[AnnealingResult, Population, Report]]:
    """Time and store the stages of an annealing, and warn where its result is doubtful.

    Parameters
    ----------
    steps : iterator of (Population, Report)
        From `samplers.tempering.anneal.anneal`.
    evaluator : Evaluator
        Counts the evaluations.
    checkpoint : Checkpoint
        Stores the stages.

    Yields
    ------
    result : AnnealingResult
        Everything found so far.
    population : Population
        As in `steps`.
    report : Report
        As in `steps`.
    """
    result, seconds, evaluations = AnnealingResult(), time.perf_counter(), evaluator.evaluations
    for population, report in steps:
        if isinstance(report, Stage):
            now = time.perf_counter(), evaluator.evaluations
            stage = report._replace(seconds=now[0] - seconds, evaluations=now[1] - evaluations)
            seconds, evaluations = now
            stage = checkpoint.store_stage(len(result.ladder), stage)
            result = result._replace(ladder=(*result.ladder, stage))
        elif isinstance(report, EvidenceCheck):
            evaluations += report.evaluations  # these belong to no stage
            result = result._replace(check=report)
        elif isinstance(report, Restart):
            result = AnnealingResult(rounds=result.rounds)
        elif isinstance(report, GuidedRound):
            result = result._replace(rounds=(*result.rounds, report))
        elif isinstance(report, GuidedStart):
            result = result._replace(start=report)
        elif isinstance(report, Doubt):
            warn(report.message)
            result = result._replace(doubts=(*result.doubts, report))
        elif isinstance(report, Halt):
            result = result._replace(halt=report)
        if result.finished and population.founders:
            result = result._replace(founders=population.founders[0])
        yield result, population, report
    checkpoint.store_check(result)
    if result.check is not None:
        for doubt in check_evidence(result.log_evidence_ladder, result.ladder[-1].log_evidence_error, result.check):
            warn(doubt.message)
            result = result._replace(doubts=(*result.doubts, doubt))
            yield result, population, doubt


def show_progress(
    bar: Any,
    label: str,
    population: Population,
    tick: Sweep | GuideTick,
    evaluations: int,
    report: Callable[[], Mapping[str, Any]] | None,
) -> None:
    """Advance a progress bar by one sweep, or by one batch of a guide.

    Parameters
    ----------
    bar : tqdm bar, or emcee's silent one
        The bar.
    label : str
        Its description in sweeps; that of a guide is its phase.
    population, tick : Population, Sweep or GuideTick
        What to show.
    evaluations : int
        Number of evaluations so far.
    report : callable, optional
        Method ``report`` of the posterior; its number of simulations is shown, if it has one.
    """
    if not hasattr(bar, "set_postfix"):  # emcee's silent bar has only update
        return
    if isinstance(tick, GuideTick):
        figures = {"simulations": f"{tick.simulations:.6g}"}
        figures["ESS"] = f"{population.effective_sample_size:.0f}/{tick.target}"
        bar.set_description_str(f"guide: {tick.phase}", refresh=False)
        bar.set_postfix(figures, refresh=not tick.finished)  # shown before the first batch, which may take minutes
        if tick.finished:
            bar.update(1)
    else:
        figures = {"beta": f"{population.beta:.3g}", "ESS": f"{population.effective_sample_size:.0f}"}
        figures |= {"acceptance": f"{tick.acceptance:.2f}", "evaluations": str(evaluations)}
        simulations = None if report is None else report().get("simulations")
        if simulations is not None:
            figures["simulations"] = str(simulations)
        bar.set_description_str(label, refresh=False)
        bar.set_postfix(figures, refresh=False)
        bar.update(1)
