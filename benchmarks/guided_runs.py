"""One run of a sampler with few simulations, and its errors against a reference.

A run is judged by what it says: its errors must lie within its own standard errors (with those of the reference), or
its verdict must be "not usable".
"""

import time
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from samplers import SMCSampler

__all__ = ["Errors", "Outcome", "Reference", "compare", "run"]

LIMIT = 3.5  # standard errors beyond which a result is wrong: one of 2000 correct ones
ROUNDING = 0.02  # of log Z, and of a mean in standard deviations of the reference: errors below it do not matter


class Reference(NamedTuple):
    """Known answer of a posterior, with standard errors."""

    log_evidence: float
    log_evidence_error: float
    mean: Any  # (ndim,), as the next two
    mean_error: Any
    sd: Any
    shares: Any  # (n_modes,), masses of the modes, as the next
    shares_error: Any


class Outcome(NamedTuple):
    """Result and cost of a run."""

    log_evidence: float = np.nan  # as reported by the sampler, with its error
    log_evidence_error: float = np.nan
    mean_error: Any = None  # (ndim,)
    samples: Any = None  # (n, ndim), the chain
    effective_sample_size: float = 0.0  # of the verdict
    simulations: float = 0.0  # of the whole record; parts count as fractions
    weighted: float = 0.0  # simulations before the first sweep, when the posterior is known as weighted draws
    status: str = ""  # of the verdict
    seconds: float = 0.0  # wall time [s]
    failed: str = ""  # exception that ended the run, empty if there was none


class Errors(NamedTuple):
    """Errors of a run."""

    log_evidence: float  # absolute error
    log_evidence_z: float  # error in standard errors
    mean: float  # largest error, in standard deviations of the reference
    sd: float  # largest relative error
    share: float  # largest error of the share of a mode
    judgement: str  # "right", "refused" (the verdict is "not usable"), "WRONG", or "no error" (one is infinite or NaN)


def run(posterior: Any, seed: int, budget: float | None, *, guided: bool = True, nwalkers: int = 100) -> Outcome:
    """Run `SMCSampler` with the posterior's guide and a budget of simulations; without, if not `guided`."""
    settings: dict[str, Any] = {"guide": posterior.guide()} if guided else {}
    if budget is not None:
        settings["max_simulations"] = budget
    start = time.perf_counter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            sampler = SMCSampler(nwalkers, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
            sampler.run_mcmc(None, 0)
            weighted = float(sampler.verdict.simulations)
            sampler.run_mcmc(None, 1)
        except Exception as error:  # reported in the table
            message = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            return Outcome(failed=message, seconds=time.perf_counter() - start)
    return Outcome(
        log_evidence=float(sampler.log_evidence),
        log_evidence_error=float(sampler.log_evidence_error),
        mean_error=sampler.mean_error(),
        samples=sampler.get_chain(flat=True),
        effective_sample_size=float(sampler.verdict.effective_sample_size),
        simulations=float(sampler.verdict.simulations),
        weighted=weighted,
        status=sampler.verdict.status,
        seconds=time.perf_counter() - start,
    )


def compare(outcome: Outcome, reference: Any, labels: Callable[[np.ndarray], np.ndarray] | None = None) -> Errors:
    """Errors of a run that did not fail, and whether they lie within what the run says.

    The reference has the fields of `Reference`; `labels` is a function of samples (n, ndim) that returns the number of
    the mode (n,).
    """
    evidence = outcome.log_evidence - reference.log_evidence
    evidence_se = np.hypot(outcome.log_evidence_error, reference.log_evidence_error)
    mean = np.abs(outcome.samples.mean(axis=0) - reference.mean)
    mean_se = np.hypot(outcome.mean_error, reference.mean_error)
    n = min(max(outcome.effective_sample_size, 1.0), len(outcome.samples))
    sd = np.abs(outcome.samples.std(axis=0) / reference.sd - 1.0)
    share = share_z = 0.0
    if labels is not None:
        found = np.mean(labels(outcome.samples)[:, None] == np.arange(len(reference.shares)), axis=0)
        error = np.hypot(np.sqrt(reference.shares * (1.0 - reference.shares) / n), reference.shares_error)
        differences = np.abs(found - reference.shares)
        share, share_z = differences.max(), (np.maximum(differences - ROUNDING, 0.0) / np.maximum(error, 1e-9)).max()
    wrong = (
        abs(evidence) > LIMIT * evidence_se + ROUNDING
        or np.any(mean > LIMIT * mean_se + ROUNDING * reference.sd)
        or np.any(sd > LIMIT / np.sqrt(n) + 2.0 * ROUNDING)  # also for tails heavier than Gaussian
        or share_z > LIMIT
    )
    judgement = "WRONG" if wrong else "right"
    if not (np.isfinite(evidence_se) and np.isfinite(mean_se).all()):
        judgement = "no error"
    if outcome.status == "not usable":
        judgement = "refused"
    largest = float((mean / reference.sd).max()), float(sd.max()), float(share)
    return Errors(float(evidence), float(evidence / evidence_se), *largest, judgement)
