"""Results of annealing: the stages, the evidence and its error, the founders of the walkers."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .evidence_check import EvidenceCheck
from .population import Doubt, GuidedRound, GuidedStart, Halt, Stage

__all__ = ["AnnealingResult"]


class AnnealingResult(NamedTuple):
    """What annealing has found so far.

    Attributes
    ----------
    ladder : tuple of Stage
        The sequence of tempering stages.
    check : EvidenceCheck, optional
        The independent estimate of the evidence.
    founders : (nwalkers,) int, optional
        Founder of each walker (`samplers.tempering.genealogy`); None where it is not known.
    rounds : tuple of GuidedRound
        Rounds of the guide.
    start : GuidedStart, optional
        What they are worth; None without a guide.
    halt : Halt, optional
        Where the limit of simulations ended the annealing; None if it did not.
    concerns : tuple of str
        Reasons of the guide why parts of the posterior may be missing.
    basis : str
        What the guide's search for parts of the posterior was; empty if it does not say.
    doubts : tuple of Doubt
        What the diagnostics found.
    independent_points : float, optional
        Effective sample size of the walkers when beta = 1 was reached; None for a result that was read from a backend.
    """

    ladder: tuple[Stage, ...] = ()
    check: EvidenceCheck | None = None
    founders: np.ndarray | None = None
    rounds: tuple[GuidedRound, ...] = ()
    start: GuidedStart | None = None
    halt: Halt | None = None
    concerns: tuple[str, ...] = ()
    basis: str = ""
    doubts: tuple[Doubt, ...] = ()
    independent_points: float | None = None

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
        """Log-evidence by tempering: the sum of the increments of all stages."""
        return float(sum(stage.log_evidence_increment for stage in self.require_finished()))

    @property
    def has_better_check(self) -> bool:
        """Whether the check of the evidence is reliable and has a smaller error than the stages."""
        check = self.check
        return check is not None and check.reliable and check.error < self.ladder[-1].log_evidence_error

    @property
    def evidence(self) -> tuple[float, float]:
        """Log-evidence and its standard error.

        Of the estimates by tempering and by the check, the one with the smaller error. If they differ by more than
        three times their joint error, the error is at least half their difference.
        """
        value, error = self.log_evidence_ladder, self.ladder[-1].log_evidence_error
        check = self.check
        if check is None or not check.reliable:
            return value, error
        difference, joint = abs(value - check.log_evidence), np.hypot(error, check.error)
        if check.error < error:
            value, error = check.log_evidence, check.error
        return value, max(error, 0.5 * difference) if difference > 3.0 * joint else error
