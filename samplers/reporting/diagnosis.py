"""Diagnostics of a finished run: what it found, whether its parts agree, and what it cannot know."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..tempering.genealogy import worst_effective_sample_size
from ..tempering.modes import Mode, find_modes
from ..tempering.results import AnnealingResult
from ..tempering.verdict import Verdict

__all__ = ["Diagnostics", "EvidenceEstimate", "diagnose"]


class EvidenceEstimate(NamedTuple):
    """One of the estimates of the evidence in a run.

    Attributes
    ----------
    source : {"stages", "check", "guide"}
        The tempering stages (or, with recycling, all evaluated points), fresh draws after the annealing, or the draws
        of a guide.
    log_evidence, error : float
        Log-evidence and its standard error.
    reliable : bool
        Whether the weights are even enough for the error to be meaningful.
    """

    source: str
    log_evidence: float
    error: float
    reliable: bool


class Diagnostics(NamedTuple):
    """What a run found, whether its parts agree, and what it cannot know. ``str`` gives some lines.

    Attributes
    ----------
    status : {"converged", "usable", "not usable", "not known"}
        As in `samplers.Verdict`; "not known" for a chain without a stored verdict.
    doubts : tuple of str
        The reasons of the verdict.
    modes : tuple of Mode
        Modes in which the run has points, with shares and their standard errors, the largest first.
    evidences : tuple of EvidenceEstimate
        The independent estimates of the evidence.
    pareto_shape : float, optional
        Largest Pareto shape of the weights of the check, and of the draws of a guide; None without either. The weights
        of a shape above 0.7 have no useful mean.
    effective_sample_size : float
        Of the chain, for the linear combination of the parameters where it is smallest
        (`samplers.tempering.genealogy.worst_effective_sample_size`).
    founders : int, optional
        Number of independent points that the walkers descend from; None if the record of the resampling is lost.
    largest_family : float, optional
        Largest share of the walkers that descend from one point; None if that is not known.
    evaluations, failures : int
        Evaluations of this object, and how many of them failed.
    unknown : tuple of str
        What the run cannot know.
    """

    status: str
    doubts: tuple[str, ...]
    modes: tuple[Mode, ...]
    evidences: tuple[EvidenceEstimate, ...]
    pareto_shape: float | None
    effective_sample_size: float
    founders: int | None
    largest_family: float | None
    evaluations: int
    failures: int
    unknown: tuple[str, ...]

    @property
    def evidence_difference(self) -> float:
        """Largest difference between two estimates of the log-evidence; 0 with one estimate only."""
        values = [estimate.log_evidence for estimate in self.evidences]
        return max(values) - min(values) if len(values) > 1 else 0.0

    @property
    def summary(self) -> str:
        """One sentence."""
        if len(self.modes) == 1:
            found = "one mode"
        else:
            shares = ", ".join(f"{mode.share:.2f} +- {mode.share_error:.2g}" for mode in self.modes)
            found = f"{len(self.modes)} modes with shares {shares}"
        estimates = ", ".join(
            f"{estimate.source} {estimate.log_evidence:.2f} +- {estimate.error:.2g}"
            + ("" if estimate.reliable else " (uneven weights)")
            for estimate in self.evidences
        )
        parts = [
            found,
            f"log-evidence by {estimates}",
            f"effective sample size {self.effective_sample_size:.0f} in the worst direction",
            f"{self.failures} of {self.evaluations} evaluations failed" if self.failures else "no failures",
        ]
        return f"{self.status.capitalize()}: {'; '.join(parts)}."

    def __str__(self) -> str:
        lines = [self.summary]
        lines += [f"doubt: {doubt}" for doubt in self.doubts]
        if self.pareto_shape is not None:
            lines.append(f"largest Pareto shape of the weights: {self.pareto_shape:.2f} (above 0.7: no useful mean)")
        if self.founders is not None:
            lines.append(
                f"the walkers descend from {self.founders} points, {100.0 * self.largest_family:.2g} % of them from one"
            )
        lines += [f"not known: {each}" for each in self.unknown]
        return "\n".join(lines)


def diagnose(
    chain: np.ndarray, result: AnnealingResult, verdict: Verdict | None, evaluations: int, failures: int
) -> Diagnostics:
    """Diagnostics of a chain at beta = 1.

    Parameters
    ----------
    chain : (nsteps, nwalkers, ndim) float
        Positions of the walkers, at least one step.
    result : AnnealingResult
        What the annealing has found.
    verdict : Verdict, optional
        The verdict, if there is one.
    evaluations, failures : int
        Evaluations, and how many failed.

    Returns
    -------
    Diagnostics
    """
    result.require_finished()
    nwalkers = chain.shape[1]
    founders = np.arange(nwalkers) if result.founders is None else result.founders
    families = None if result.founders is None else np.unique(result.founders, return_counts=True)[1]
    shapes = [] if result.check is None else [result.check.pareto_shape]
    if result.start is not None and result.start.used:
        shapes.append(result.start.pareto_shape)
    return Diagnostics(
        status="not known" if verdict is None else verdict.status,
        doubts=() if verdict is None else verdict.reasons,
        modes=find_modes(chain, founders),
        evidences=tuple(_evidences(result)),
        pareto_shape=max(shapes) if shapes else None,
        effective_sample_size=worst_effective_sample_size(chain, founders),
        founders=None if families is None else len(families),
        largest_family=None if families is None else float(families.max() / nwalkers),
        evaluations=evaluations,
        failures=failures,
        unknown=tuple(_unknown(result, failures, nwalkers)),
    )


def _evidences(result: AnnealingResult) -> Sequence[EvidenceEstimate]:
    """The estimates of the evidence that a run has made."""
    found = [EvidenceEstimate("stages", result.log_evidence_ladder, result.ladder[-1].log_evidence_error, True)]
    check = result.check
    if check is not None:
        found.append(EvidenceEstimate("check", check.log_evidence, check.error, check.reliable))
    if result.rounds and result.start is not None and not result.start.used:
        last = result.rounds[-1]
        found.append(EvidenceEstimate("guide", last.log_evidence, last.log_evidence_error, False))
    return found


def _unknown(result: AnnealingResult, failures: int, nwalkers: int) -> Sequence[str]:
    """What a run cannot know."""
    missing = [
        f"modes that none of the points came near, above all modes much narrower than those found and modes in a part "
        f"of the prior that holds less than about {3.0 / nwalkers:.2g} of its probability (3 / walkers); a run with "
        "another seed and more walkers is the test"
    ]
    if result.check is None:
        missing.append("whether the evidence is right, since there was no check by independent draws")
    if result.founders is None:
        missing.append(
            "which walkers are copies, since the chain was read from a file: errors and effective sample size treat "
            "them as independent"
        )
    if failures:
        missing.append("the posterior where evaluations failed, which counts as impossible")
    return missing
