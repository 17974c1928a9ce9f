"""Recording of an annealing: its reports are added to its result, with wall times and numbers of evaluations."""

import time

import numpy as np

from ..estimates.control_variates import SignedSample
from ..estimates.importance import EvidenceCheck
from ..finding import Finding
from ..judgement.checks import check_evidence
from ..judgement.clusters import find_clusters
from ..reports import AnnealingResult, EarlyStop, GuidedRound, GuidedStart, Report, Restart, Stage, warn
from .population import Density, Population

__all__ = ["Recording", "check_end"]

# fields of a result that take a report of a kind, or collect them
TAKEN = {EvidenceCheck: "check", GuidedStart: "start", SignedSample: "signed", EarlyStop: "early_stop"}
COLLECTED = {Stage: "ladder", GuidedRound: "rounds", Finding: "findings"}


class Recording:
    """The result of an annealing so far; the density counts the evaluations."""

    def __init__(self, density: Density):
        self.result, self._density = AnnealingResult(), density
        self._seconds, self._evaluations = time.perf_counter(), density.evaluations

    def add(self, population: Population, report: Report) -> AnnealingResult:
        """The result with a report of `samplers.tempering.anneal.anneal`; a finding is a warning as well."""
        result, kind = self.result, type(report)
        if kind is Stage:
            now = time.perf_counter(), self._density.evaluations
            report = report._replace(seconds=now[0] - self._seconds, evaluations=now[1] - self._evaluations)
            self._seconds, self._evaluations = now
        elif kind is EvidenceCheck:
            self._evaluations += report.evaluations  # these belong to no stage
        elif kind is Restart:
            result = AnnealingResult(rounds=result.rounds)
        elif kind is Finding:
            warn(report.message)
        if kind in TAKEN:
            result = result._replace(**{TAKEN[kind]: report})
        elif kind in COLLECTED:
            result = result._replace(**{COLLECTED[kind]: (*getattr(result, COLLECTED[kind]), report)})
        if result.finished and population.founders:
            result = result._replace(founders=population.founders[0], parents=population.founders[-1])
        self.result = result
        return result


def check_end(result: AnnealingResult, coords: np.ndarray) -> list[Finding]:
    """Findings about the estimates of the evidence at the end, with the final points (n, ndim)."""
    stop = result.early_stop
    if stop is not None and not stop.complete:
        return []  # its points are judged by their weights
    each = np.arange(len(coords))
    founders = each if result.founders is None else result.founders
    error = result.ladder[-1].log_evidence_error

    def share_error() -> float:
        # as if no point had crossed between modes after the last resampling: the limit was counted with such errors
        return max(mode.share_error for mode in find_clusters(coords[None], founders, each, error))

    return check_evidence(result.log_evidence_ladder, error, result.check, share_error)
