"""Comparison of the result of a client with the exact answer, with tolerances from its own standard errors."""

from typing import NamedTuple

import lazy_loader
import numpy as np

from .problem import Exact

arviz = lazy_loader.load("arviz")  # its import takes seconds

STANDARD_ERRORS = 5.0  # of a moment: the errors come from a few hundred draws and are uncertain themselves
EVIDENCE_ERRORS = 4.0


class Found(NamedTuple):
    """Result of a client: moments and their standard errors (4,), in the units of the parameters, and the evidence."""

    mean: np.ndarray
    mean_error: np.ndarray
    sd: np.ndarray
    sd_error: np.ndarray
    log_evidence: float | None = None
    log_evidence_error: float | None = None


def _found(samples, weights, mean_size, square_size, log_evidence=None, log_evidence_error=None) -> Found:
    mean = weights @ samples
    squares = (samples - mean) ** 2
    variance = weights @ squares
    sd = np.sqrt(variance)
    spread = np.sqrt(weights @ (squares - variance) ** 2)
    return Found(
        mean,
        sd / np.sqrt(mean_size),
        sd,
        0.5 * spread / sd / np.sqrt(square_size),
        log_evidence,
        log_evidence_error,
    )


def chains(samples: np.ndarray) -> Found:
    """Result from chains (n_chains, n_draws, 4), with effective sample sizes of values and squares by arviz."""
    mean = samples.mean(axis=(0, 1))
    sizes = [
        np.array([arviz.ess(values[:, :, i], method="mean") for i in range(samples.shape[2])])
        for values in (samples, (samples - mean) ** 2)
    ]
    flat = samples.reshape(-1, samples.shape[2])
    return _found(flat, np.full(len(flat), 1.0 / len(flat)), *sizes)


def weighted(samples: np.ndarray, weights: np.ndarray, log_evidence: float, log_evidence_error: float) -> Found:
    """Result from independent draws (n, 4) with weights (n,), with Kish's effective sample size."""
    weights = weights / weights.sum()
    size = 1.0 / (weights @ weights)
    return _found(samples, weights, size, size, float(log_evidence), float(log_evidence_error))


def replicates(runs: list[Found]) -> Found:
    """Result from independent runs without reliable errors of their own: errors from the scatter of the runs."""
    mean, sd, log_evidence = (np.array([getattr(run, name) for run in runs]) for name in ("mean", "sd", "log_evidence"))
    root = np.sqrt(len(runs))
    return Found(
        mean.mean(axis=0),
        mean.std(axis=0, ddof=1) / root,
        sd.mean(axis=0),
        sd.std(axis=0, ddof=1) / root,
        float(log_evidence.mean()),
        float(log_evidence.std(ddof=1) / root),
    )


def check(found: Found, exact: Exact) -> None:
    """Raise AssertionError unless all errors are within tolerance and the standard errors are small enough."""
    mean, sd = (found.mean - exact.mean) / found.mean_error, (found.sd - exact.sd) / found.sd_error
    assert np.all(found.mean_error < 0.1 * exact.sd), f"too few draws for a comparison: {found}"
    assert np.all(np.abs(mean) < STANDARD_ERRORS), f"means: {mean}"
    assert np.all(np.abs(sd) < STANDARD_ERRORS), f"standard deviations: {sd}"
    if found.log_evidence is not None:
        # a log-evidence that ignores points of probability zero is too large by 0.9, more than four of these errors
        assert 0.0 < found.log_evidence_error < 0.22, f"an evidence without a usable error: {found}"
        error = (found.log_evidence - exact.log_evidence) / found.log_evidence_error
        assert abs(error) < EVIDENCE_ERRORS, f"evidence: {error}"
