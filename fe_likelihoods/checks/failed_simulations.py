"""Failed simulations of a run: how many, why, and whether near the samples.

Failures are counted where simulations are counted: in the likelihood, with the simulations of the first parts of the
record that a guide makes, or in the sampler for a log-density of the user's own.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np

from samplers.judgement.failures import NearFailures, failures_near

from ..likelihood.failure_log import reason_without_numbers
from ..likelihood.likelihood import FELikelihood
from .run import FinishedRun

__all__ = ["Failure", "Failures", "failures"]


class Failure(NamedTuple):
    """Failures for one reason."""

    reason: str  # with "#" for numbers
    count: int
    example: str  # parameters of one failure, after its reason where `reason` has "#"


class Failures(NamedTuple):
    """All failures, with the number of attempts; `near` are those on which a tempered sampler's verdict depends."""

    rows: tuple[Failure, ...]  # by reason, the most frequent first
    count: int
    attempts: int
    unknown: str = ""  # what is not known about them
    near: NearFailures = NearFailures(0, 0)  # among the posterior samples, and all evaluated points there

    @property
    def sentence(self) -> str:
        """The sentence for a report without a table of failures."""
        return self.unknown or "No simulation failed."


class _Source(NamedTuple):
    """Failed and successful points of one model, in some columns of the chain."""

    columns: np.ndarray
    failed: np.ndarray
    reasons: list[str]
    succeeded: np.ndarray
    counts: Counter


def failures(run: FinishedRun) -> Failures:
    """Failed simulations by reason, the most frequent first, with the parameters at which they happened."""
    if run.likelihood is None:
        return _of_function(run)
    parts = run.likelihood.parts()
    sources = [_of_likelihood(*part) for part in parts]
    attempts = sum(each.simulator.failures.outcomes for part, _ in parts for each in (part, *part.shortened))
    here = all(_was_here(run, part, source) for (part, _), source in zip(parts, sources, strict=True))
    unknown = "Not known: simulations of this run were made in another process, or are no longer in memory."
    return _joined(run, sources, attempts, "" if here else unknown)


def _of_likelihood(likelihood: FELikelihood, columns: np.ndarray) -> _Source:
    names, logs = likelihood.model.parameter_names, [likelihood, *likelihood.shortened]
    records = [record for each in logs for record in each.simulator.failures.records]
    return _Source(
        np.asarray(columns)[: len(names)],
        np.array([[record["parameters"][name] for name in names] for record in records]).reshape(-1, len(names)),
        [record["reason"] for record in records],
        likelihood.simulator.memory_cache.successes(len(names)),
        sum((each.simulator.failures.reasons for each in logs), Counter()),
    )


def _of_function(run: FinishedRun) -> Failures:
    if not run.tempered:
        return Failures((), 0, 0, "Not known: neither the sampler nor the log-density counts failures.")
    sampler, ndim = run.sampler, run.samples.shape[1]
    failed = np.array([each["parameters"] for each in sampler.failures], dtype=float).reshape(-1, ndim)
    reasons = [each["reason"] for each in sampler.failures]
    draws = np.empty((0, ndim)) if sampler.prior_draws is None else sampler.prior_draws
    succeeded = np.concatenate([draws[~_are_among(draws, failed)], run.samples])
    unknown = "No evaluation raised an error or returned NaN; whether -inf stands for a failed simulation is not known."
    source = _Source(np.arange(ndim), failed, reasons, succeeded, Counter(reasons))
    return _joined(run, [source], sampler.evaluations, unknown, sampler.failure_count)


def _joined(
    run: FinishedRun, sources: list[_Source], attempts: int, unknown: str, count: int | None = None
) -> Failures:
    rows = sorted((row for source in sources for row in _by_reason(run, source)), key=lambda row: -row.count)
    count = sum(row.count for row in rows) if count is None else count
    near = None if run.verdict is None else run.verdict.near_failures  # as judged by the sampler, else as known here
    if near is None:
        known = [failures_near(run.samples[:, each.columns], each.failed, each.succeeded) for each in sources]
        near = max(known, key=lambda each: each.failed)
    return Failures(tuple(rows), count, max(attempts, count), unknown, near)


def _by_reason(run: FinishedRun, source: _Source) -> list[Failure]:
    """Failures of one model; reasons that differ in their numbers only are one."""
    counts, examples = Counter(), dict[str, str]()
    for text, count in source.counts.items():
        counts[reason_without_numbers(text)] += count
    for text, point in zip(source.reasons, source.failed, strict=True):
        reason = reason_without_numbers(text)
        named = zip(source.columns, point, strict=True)
        shown = ", ".join(f"{run.names[column]} = {value:.4g}" for column, value in named)
        examples.setdefault(reason, shown if text == reason else f"{text}: {shown}")
    return [Failure(reason, count, examples.get(reason, "")) for reason, count in counts.items()]


def _are_among(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Whether each of the points (n, k) is one of the others (m, k), to the last bit: (n,) bool."""
    known = {row.tobytes() for row in np.ascontiguousarray(others) + 0.0}
    return np.array([row.tobytes() in known for row in np.ascontiguousarray(points) + 0.0], dtype=bool)


def _was_here(run: FinishedRun, likelihood: FELikelihood, source: _Source) -> bool:
    """Whether this process simulated, read or recalled as many points as there are samples."""
    return likelihood.simulator.failures.outcomes >= len(np.unique(run.samples[:, source.columns], axis=0))
