"""Optional attributes of samplers and posteriors, read in one place.

The functions of this package accept emcee's own sampler as well as the tempered samplers, and any callable as
log-posterior. Everything that such an object may or may not have is determined here.
"""

from collections.abc import Sequence
from typing import Any

__all__ = ["data_fingerprint_of", "is_tempered", "parameter_names_of", "summary_of"]


def is_tempered(sampler: Any) -> bool:
    """Whether a sampler is a `samplers.tempered.TemperedSampler`, with a ladder and an evidence."""
    return hasattr(sampler, "ladder")


def parameter_names_of(sampler: Any) -> Sequence[str] | None:
    """Names of the parameters, from the log-posterior that the sampler was given; None if it has no names."""
    return getattr(_log_posterior(sampler), "parameter_names", None)


def data_fingerprint_of(sampler: Any) -> str | None:
    """Digest of the measurements, from the log-posterior that the sampler was given; None if it has no digest."""
    return getattr(_log_posterior(sampler), "data_fingerprint", None)


def summary_of(sampler: Any) -> str:
    """The sentence of ``sampler.diagnostics``; empty for another object, or a sampler without a chain."""
    return sampler.diagnostics.summary if is_tempered(sampler) and sampler.ladder and sampler.iteration else ""


def _log_posterior(sampler: Any) -> Any:
    """The function that the sampler was given (emcee wraps it), or None for an object that is no sampler."""
    return getattr(getattr(sampler, "log_prob_fn", None), "f", None)
