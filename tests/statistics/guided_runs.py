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

__all__ = ["Errors", "Outcome", "compare", "run"]

WALKERS = 100
LIMIT = 3.5  # standard errors beyond which a result is wrong: one of 2000 correct ones
ROUNDING = 0.02  # of log Z, and of a mean in standard deviations of the reference: errors below it do not matter


class Outcome(NamedTuple):
    """Result and cost of a run."""

    log_evidence: float = np.nan  # as reported by the sampler, with its error
    log_evidence_error: float = np.nan
    mean: Any = None  # (ndim,) of the chain, as mean_error and sd
    mean_error: Any = None
    sd: Any = None
    samples: Any = None  # (n, ndim), the chain
    effective_sample_size: float = 0.0  # of the verdict
    simulations: float = 0.0  # of the whole record; parts count as fractions
    weighted: float = 0.0  # simulations before the first sweep, when the posterior is known as weighted draws
    status: str = ""  # of the verdict, as reasons
    reasons: str = ""
    seconds: float = 0.0  # wall time [s]
    overhead: float = 0.0  # CPU time of this process outside simulations [s]
    warnings: tuple[str, ...] = ()  # messages of the sampler
    failed: str = ""  # exception that ended the run, empty if there was none


class Errors(NamedTuple):
    """Errors of a run."""

    log_evidence: float  # absolute error
    log_evidence_z: float  # error in standard errors
    mean: float  # largest error, in standard deviations of the reference
    mean_z: float  # largest error, in standard errors
    sd: float  # largest relative error
    share: float  # largest error of the share of a mode
    wrong: bool  # whether an error exceeds what the run states, whatever its verdict
    # "right", "refused" (the verdict is "not usable"), "WRONG", "no error" (a standard error is infinite or NaN), or
    # the exception that ended the run
    judgement: str


def run(posterior: Any, seed: int, budget: float | None, *, guided: bool = True, **settings: Any) -> Outcome:
    """Run `SMCSampler` with the posterior's guide and a budget of simulations; without, if not `guided`.

    Other arguments of `SMCSampler` are passed on.
    """
    walkers = settings.pop("nwalkers", WALKERS)
    if guided:
        settings |= {"guide": posterior.guide()}
    if budget is not None:
        settings |= {"max_simulations": budget}
    start, cpu = time.perf_counter(), time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            sampler = SMCSampler(walkers, posterior.ndim, posterior, vectorize=True, seed=seed, **settings)
            sampler.run_mcmc(None, 0)
            weighted = float(sampler.verdict.simulations)
            sampler.run_mcmc(None, 1)
        except Exception as error:  # reported in the table
            message = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            return Outcome(failed=message, seconds=time.perf_counter() - start)
    report, verdict = posterior.report(), sampler.verdict
    in_this_process = posterior.likelihood.simulator.pool is None and not getattr(
        posterior.likelihood.model, "isolated", False
    )
    samples = sampler.get_chain(flat=True)
    return Outcome(
        log_evidence=float(sampler.log_evidence),
        log_evidence_error=float(sampler.log_evidence_error),
        mean=samples.mean(axis=0),
        mean_error=sampler.mean_error(),
        sd=samples.std(axis=0),
        samples=samples,
        effective_sample_size=float(verdict.effective_sample_size),
        simulations=float(verdict.simulations),
        weighted=weighted,
        status=verdict.status,
        reasons="; ".join(verdict.reasons),
        seconds=time.perf_counter() - start,
        overhead=max(0.0, time.process_time() - cpu - in_this_process * report["seconds"]),
        warnings=tuple(str(warning.message) for warning in caught if issubclass(warning.category, UserWarning)),
    )


def compare(outcome: Outcome, reference: Any, labels: Callable[[np.ndarray], np.ndarray] | None = None) -> Errors:
    """Errors of a run, and whether they lie within what the run says.

    The reference has log_evidence, mean, sd, shares and, of each, ``..._error``; `labels` is a function of samples (n,
    ndim) that returns the number of the mode (n,).
    """
    if outcome.failed:
        return Errors(*[np.nan] * 6, False, outcome.failed)
    evidence = outcome.log_evidence - reference.log_evidence
    evidence_se = np.hypot(outcome.log_evidence_error, reference.log_evidence_error)
    mean = np.abs(outcome.mean - reference.mean)
    mean_se = np.hypot(outcome.mean_error, reference.mean_error)
    n = min(max(outcome.effective_sample_size, 1.0), len(outcome.samples))
    sd = np.abs(outcome.sd / reference.sd - 1.0)
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
    return Errors(
        float(evidence),
        float(evidence / evidence_se),
        float((mean / reference.sd).max()),
        float((mean / mean_se).max()),
        float(sd.max()),
        float(share),
        bool(wrong),
        judgement,
    )
