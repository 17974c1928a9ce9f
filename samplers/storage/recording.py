"""Recording of an annealing while it runs: wall time, evaluations and storage of its stages."""

import time
from collections.abc import Iterator

from ..tempering.diagnostics import check_evidence, warn
from ..tempering.evidence_check import EvidenceCheck
from ..tempering.population import (
    Doubt,
    GuidedRound,
    GuidedStart,
    Halt,
    Population,
    Report,
    Restart,
    Stage,
)
from ..tempering.results import AnnealingResult
from .checkpoint import Checkpoint
from .evaluation import Evaluator

__all__ = ["record"]


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
