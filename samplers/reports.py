"""Reports of an annealing while it runs, and the result that they add up to.

`samplers.tempering.anneal.anneal` yields reports, which an `AnnealingResult` collects for `samplers.judgement`.
"""

import sys
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .estimates.control_variates import SignedSample
from .estimates.importance import EvidenceCheck
from .finding import Finding

LIMIT = "The limit of simulations ended the run"  # see `Weighted`
OUR_PACKAGES = ("samplers", "emcee")


class SamplingWarning(UserWarning):
    """The result of a run may be wrong; the message says why and what to do.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings():
    ...     warnings.simplefilter("error", SamplingWarning)  # a doubtful result ends the script
    ...     sampler = SMCSampler(100, posterior.ndim, posterior, vectorize=True, seed=1)
    ...     state = sampler.run_mcmc(None, 1)
    """


def warn(message: str) -> None:
    """Issue a `SamplingWarning` that points at the line of the user's code that called the sampler."""
    level, frame = 1, sys._getframe()
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in OUR_PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, SamplingWarning, stacklevel=level)


class Stage(NamedTuple):
    """A finished tempering stage.

    Examples
    --------
    >>> last = sampler.ladder[-1]
    >>> last.beta
    1.0
    """

    beta: float  #: tempering exponent of the stage, 0 < beta <= 1
    effective_sample_size: float  #: of the incremental weights that led to this stage
    acceptance: float  #: share of accepted proposals in this stage
    moves: int  #: sweeps of the whole ensemble at this beta, without sweeps over fast parameters; 0 for recycling
    distinct_ancestors: int  #: number of distinct points that survived the resampling
    log_evidence_increment: float  #: logarithm of the mean incremental weight
    log_evidence_error: float  #: standard error of the summed increments so far
    #: points for which ``log_prob_fn`` was called, in the first stage with the draws of the prior; sweeps over fast
    #: parameters count, so this can exceed the number of simulations
    evaluations: int = 0
    seconds: float = 0.0  #: wall time of the stage [s]


class Sweep(NamedTuple):
    """One sweep of the ensemble, or one stage of recycling: a tick of the progress bar."""

    acceptance: float  # share of accepted proposals; with recycling, the efficiency of the latest draws


class Restart(NamedTuple):
    """Annealing starts again: the stages reported so far are void, for the reason given."""

    reason: str


class GuideTick(NamedTuple):
    """A tick of the progress bar while a guide is in use."""

    phase: str  # "search", "round 3", or "after round 3" while the guide learns
    simulations: float  # so far; of the search alone in this phase
    target: int  # wanted effective sample size of all rounds; the population has the present one


class GuidedRound(NamedTuple):
    """A round of draws from a guide."""

    draws: int  #: number of draws
    effective_share: float  #: effective sample size of the draws divided by their number
    pareto_shape: float  #: of the largest weights; inf for too few weights
    log_evidence: float  #: of all rounds so far
    log_evidence_error: float  #: standard error of `log_evidence`
    effective_sample_size: float  #: of all rounds so far


class Weighted(NamedTuple):
    """The walkers were resampled from weighted points, and not moved since."""

    points: int  # number of these points; 0 if the annealing was complete, and only moves or a check are missing
    effective_sample_size: float  # of the weights at beta = 1
    pareto_shape: float  # of the largest weights at beta = 1
    beta: float = 1.0  # at which the points were made
    ended: str = ""  # why the run ended before its result was reached; empty if it did not
    guided: bool = False  # whether the points are the draws of a guide


Report = Stage | Sweep | GuideTick | Restart | EvidenceCheck | GuidedRound | SignedSample | Weighted | Finding
# fields of a result that take a report of a kind, or collect them
TAKEN = {EvidenceCheck: "check", SignedSample: "signed", Weighted: "weighted"}
COLLECTED = {Stage: "ladder", GuidedRound: "rounds", Finding: "findings"}


class AnnealingResult(NamedTuple):
    """Result of an annealing so far."""

    ladder: tuple[Stage, ...] = ()
    check: EvidenceCheck | None = None  # independent estimate of the evidence
    founders: np.ndarray | None = None  # (nwalkers,) int, see `samplers.estimates.genealogy`; None if unknown
    parents: np.ndarray | None = None  # (nwalkers,) int, founders by the last resampling alone; None if unknown
    rounds: tuple[GuidedRound, ...] = ()
    signed: SignedSample | None = None  # known and evaluated points of the rounds; None if the guide knows no density
    weighted: Weighted | None = None  # points that the walkers were resampled from, if they were not moved since
    basis: str = ""  # how the guide searched for parts of the posterior; empty if it does not say
    findings: tuple[Finding, ...] = ()  # of the checks and of the guide
    # effective sample size of the walkers when beta = 1 was reached; None for a result read from a backend
    independent_points: float | None = None

    def add(self, report: Report, founders: Sequence[np.ndarray]) -> "AnnealingResult":
        """The result with a further report and the present founders by generations; a finding is a warning as well."""
        result, kind = self, type(report)
        if kind is Restart:
            result = AnnealingResult(rounds=self.rounds)
        elif kind is Finding:
            warn(report.message)
        if kind in TAKEN:
            result = result._replace(**{TAKEN[kind]: report})
        elif kind in COLLECTED:
            result = result._replace(**{COLLECTED[kind]: (*getattr(result, COLLECTED[kind]), report)})
        if result.finished and founders:
            result = result._replace(founders=founders[0], parents=founders[-1])
        return result

    @property
    def ended(self) -> str:
        """Why the run ended before its result was reached; empty if it did not."""
        return "" if self.weighted is None else self.weighted.ended

    @property
    def finished(self) -> bool:
        """Whether beta = 1 has been reached."""
        return bool(self.ladder) and self.ladder[-1].beta == 1.0

    def require_finished(self) -> Sequence[Stage]:
        """The stages, or ValueError before beta = 1 is reached."""
        if not self.finished:
            reached = f"the ladder ends at beta = {self.ladder[-1].beta:.3g}" if self.ladder else "there is no ladder"
            raise ValueError(f"the evidence is known at beta = 1, and {reached}: call run_mcmc first")
        return self.ladder

    @property
    def log_evidence_ladder(self) -> float:
        """Log-evidence by tempering: the sum of the increments over all stages."""
        return float(sum(stage.log_evidence_increment for stage in self.require_finished()))

    @property
    def error_by_resampling(self) -> float:
        """Standard error of the log-evidence that resampling from stage to stage has carried to the shares of modes.

        0 if the walkers were resampled once, from weighted draws of recycling or of a guide: founders show this error.
        """
        earlier = self.ladder[:-1] or self.ladder
        return self.ladder[-1].log_evidence_error if any(stage.moves for stage in earlier) else 0.0

    @property
    def evidence(self) -> tuple[float, float]:
        """Log-evidence and its standard error, by tempering or by the check, whichever has the smaller error.

        If they differ by more than three joint errors, a reliable check that is higher is taken (of 49, it was wrong by
        .06 in the median, the stages by 2.2); if it is lower, the error is at least half the difference.
        """
        value, error = self.log_evidence_ladder, self.ladder[-1].log_evidence_error
        check = self.check
        if check is None or not check.reliable:
            return value, error
        difference, joint = abs(value - check.log_evidence), np.hypot(error, check.error)
        if difference > 3.0 * joint and check.log_evidence > value:
            return check.log_evidence, check.error
        if check.error < error:
            value, error = check.log_evidence, check.error
        return value, max(error, 0.5 * difference) if difference > 3.0 * joint else error
