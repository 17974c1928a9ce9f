"""Sufficient statistics of residuals, which a likelihood needs instead of the response, and counts of samples."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Comparison

Statistic = Callable[..., np.ndarray]
"""Function of residuals (n_channels, n_samples) that returns (n_numbers,), the sums of squares (n_channels,) first.

Residuals of missing samples are NaN; the same samples are missing for all residuals of a likelihood. A function with a
true attribute ``of_response`` also takes the response at the samples (n_channels, n_samples), NaN where one is missing,
as second argument. It must be defined at the top level of a module, so that it can be sent to workers.
"""


def needs_response(statistic: Statistic | None) -> bool:
    """Whether a statistic takes the response as well as the residuals."""
    return bool(getattr(statistic, "of_response", False))


def apply_statistic(statistic: Statistic, residuals: np.ndarray, response: np.ndarray) -> np.ndarray:
    """Numbers (n_numbers,) from a statistic; residuals and response (n_channels, n_samples) are NaN where missing."""
    return statistic(residuals, response) if needs_response(statistic) else statistic(residuals)


def statistic_width(measured: np.ndarray | Comparison, statistic: Statistic | None = None) -> int:
    """How many numbers a statistic returns; by default for the sums of squares."""
    values = measured.values if isinstance(measured, Comparison) else measured
    return len(apply_statistic(sums_of_squares if statistic is None else statistic, values, values))


def sums_of_squares(residuals: np.ndarray) -> np.ndarray:
    """Sums of squares (n_channels,) of residuals (n_channels, n_samples)."""
    return np.square(residuals).sum(axis=-1)


def reduce_response(response: np.ndarray, measured: np.ndarray | Comparison, reduce: Statistic) -> np.ndarray:
    """Statistic `reduce` (n_numbers,) for a response (n_channels, n_steps) [SI]; NaN for a failed simulation."""
    with np.errstate(over="ignore", invalid="ignore"):
        if isinstance(measured, Comparison):
            if not np.isfinite(response).all():  # also where no sample is affected
                return np.full(statistic_width(measured, reduce), np.nan)
            if reduce is sums_of_squares:
                return reduce(measured.known_residuals(response))
            residuals = measured.residuals(response)
            if not needs_response(reduce):
                return reduce(residuals)
            return reduce(residuals, np.where(measured.missing, np.nan, measured.at_samples(response)))
        # contiguous rows, because the order of summation, and so the last bit, must not depend on the array's layout
        residuals = np.ascontiguousarray(response - measured)
        if reduce is not sums_of_squares and np.isnan(residuals).any():
            # a failed simulation: for a statistic, NaN marks a missing sample
            return np.full(statistic_width(measured, reduce), np.nan)
        return apply_statistic(reduce, residuals, np.ascontiguousarray(response))


def name_of_statistic(statistic: Statistic | None) -> str:
    """Text that identifies the statistic of a noise in fingerprints; empty for the sums of squares."""
    if statistic is None:
        return ""
    # an object, such as `EventSums`, is represented by its repr
    return f" {statistic.__module__}.{getattr(statistic, '__qualname__', repr(statistic))}"


def check_statistic(statistic: Statistic | None, measured: np.ndarray | Comparison) -> None:
    """Raise ValueError if samples are missing and the statistic of a noise has no rule for them."""
    if statistic is None or not isinstance(measured, Comparison):
        return
    if not np.isfinite(apply_statistic(statistic, measured.values, measured.values)).all():
        raise ValueError(
            f"samples are missing, and the statistic {statistic!r} of the noise is not finite with residuals of NaN at "
            "these samples; leave such residuals out in the statistic, or use GaussianNoise or AutoregressiveNoise"
        )


def bilinear_form(statistic: Statistic, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The form (k, l, n_numbers) of a quadratic statistic for histories (k, n_channels, n_steps) and (l, ...)."""
    if statistic is sums_of_squares:
        return np.matmul(first.transpose(1, 0, 2), second.transpose(1, 2, 0)).transpose(1, 2, 0)
    rows = []
    for a in first:
        scales = [np.abs(a).max() / (np.abs(b).max() or 1.0) or 1.0 for b in second]
        rows.append([(statistic(a + s * b) - statistic(a - s * b)) / s for s, b in zip(scales, second, strict=True)])
    return 0.25 * np.array(rows)


def check_quadratic(statistic: Statistic, residuals: np.ndarray) -> None:
    """Raise ValueError if a statistic is not quadratic in the residuals (n_channels, n_steps)."""
    both = np.stack([residuals, np.roll(residuals, residuals.shape[-1] // 3, axis=-1)])
    form = bilinear_form(statistic, both, both)
    direct, combined = statistic(both[0] + 0.5 * both[1]), form[0, 0] + form[0, 1] + 0.25 * form[1, 1]
    if not np.allclose(direct, combined, rtol=1e-6, atol=1e-6 * np.abs(direct).max()):
        raise ValueError(
            f"the statistic {statistic!r} of the noise is not quadratic in the residuals, so the posterior cannot be "
            "emulated from responses: use GaussianNoise, AutoregressiveNoise, or a sampler without a guide"
        )


class SampleCounts(NamedTuple):
    """Numbers of samples and of the distances between them, for measurements with missing samples."""

    samples: np.ndarray  # (n_channels,) without missing ones
    gaps: np.ndarray  # (n_gaps,) distinct distances between samples in all channels, ascending [steps]; 1: none missing
    transitions: np.ndarray  # (n_gaps, n_channels), how often each distance occurs


def count_samples(values: np.ndarray) -> int | SampleCounts:
    """Count samples (n_channels, n_steps): the number of steps if no sample is missing (NaN), else `SampleCounts`."""
    if not np.isnan(values).any():
        return values.shape[1]
    places = [np.flatnonzero(there) for there in ~np.isnan(values)]
    gaps = distinct_gaps(places)
    transitions = [np.bincount(np.searchsorted(gaps, np.diff(one)), minlength=len(gaps)) for one in places]
    return SampleCounts(np.array([len(one) for one in places]), gaps, np.array(transitions, dtype=int).T)


def distinct_gaps(places: Sequence[np.ndarray]) -> np.ndarray:
    """The field `gaps` of `SampleCounts`, shape (n_gaps,), from the sample places in each channel."""
    return np.flatnonzero(np.bincount(np.concatenate([np.diff(one) for one in places])))


def samples_per_channel(n_samples: int | SampleCounts) -> int | np.ndarray:
    """Number of samples per channel: one number for all channels, or (n_channels,) where samples are missing."""
    return n_samples.samples if isinstance(n_samples, SampleCounts) else n_samples


def relative_changes(
    earlier: np.ndarray, later: np.ndarray, norm: np.ndarray, of_response: bool, rounding: float
) -> np.ndarray:
    """Changes (n_numbers,) of a response, relative to its `norm` (n_channels,), which explain those of a statistic.

    Further numbers than the sums of squares have the channel order and the scale of the sums, and contain sums of
    squared responses if `of_response`. If a response with norm r changes by t r, the sum of squared residuals s^2
    changes by at most 2 s t r + (t r)^2, and so does a sum over products of two residuals of the channel; a sum of
    squared responses by at most 2 r t r + (t r)^2. Changes of `rounding` times s^2 do not count.
    """
    n, channels = len(norm), np.arange(len(earlier)) % len(norm)
    s, r = np.sqrt(np.minimum(earlier[:n], later[:n]))[channels], norm[channels]
    if of_response:
        s[n:] = r[n:]
    difference = np.where(np.abs(earlier - later) <= rounding * s**2, 0.0, np.abs(earlier - later))
    with np.errstate(divide="ignore", invalid="ignore"):
        # the positive root of (t r)^2 + 2 s (t r) = difference, in a form without cancellation
        return np.where(difference == 0.0, 0.0, difference / (s + np.sqrt(s**2 + difference)) / r)
