"""Optional attributes of samplers and posteriors, read in one place.

The functions of this package accept emcee's own sampler as well as the tempered samplers, and any callable as
log-posterior. Everything that such an object may or may not have is determined here.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "PlainParameter",
    "data_fingerprint_of",
    "described_parameters_of",
    "distributions_of",
    "is_tempered",
    "log_posterior_of",
    "parameter_names_of",
    "prior_of",
    "summary_of",
]


class PlainParameter(NamedTuple):
    """A parameter of which only the name is known; its members are those of ``posterior.parameters``.

    Attributes
    ----------
    name : str
    factor : float
        Unit of the label, in the unit of the samples.
    nominal : float
        NaN: not known.
    """

    name: str
    factor: float = 1.0
    nominal: float = np.nan

    @property
    def label(self) -> str:
        """The name."""
        return self.name


def described_parameters_of(posterior: Any, ndim: int) -> Sequence[Any]:
    """Name, label, unit and nominal value of each of `ndim` parameters of a posterior, or of None.

    Raises
    ------
    ValueError
        If the posterior has another number of parameters.
    """
    names = getattr(posterior, "parameter_names", None)
    described = getattr(posterior, "parameters", None)
    if described is None:
        described = [PlainParameter(str(name)) for name in (names or [f"x{i}" for i in range(ndim)])]
    if len(described) != ndim:
        raise ValueError(
            f"the posterior has {len(described)} parameters ({', '.join(each.name for each in described)}), but the "
            f"samples have {ndim} columns"
        )
    return described


def distributions_of(prior: Any) -> Mapping[str, Any]:
    """Distributions of single parameters by name, with ``logpdf``; those that a prior does not name are left out."""
    return getattr(prior, "distributions", {})


def prior_of(posterior: Any) -> Any:
    """Prior of a posterior, with ``rvs(size, random_state)``; None if it has none."""
    prior = getattr(posterior, "prior", None)
    return prior if hasattr(prior, "rvs") else None


def is_tempered(sampler: Any) -> bool:
    """Whether a sampler is a `samplers.tempered.TemperedSampler`, with a ladder and an evidence."""
    return hasattr(sampler, "ladder")


def parameter_names_of(sampler: Any) -> Sequence[str] | None:
    """Names of the parameters, from the log-posterior that the sampler was given; None if it has no names."""
    return getattr(log_posterior_of(sampler), "parameter_names", None)


def data_fingerprint_of(sampler: Any) -> str | None:
    """Digest of the measurements, from the log-posterior that the sampler was given; None if it has no digest."""
    return getattr(log_posterior_of(sampler), "data_fingerprint", None)


def summary_of(sampler: Any) -> str:
    """The sentence of ``sampler.diagnostics``; empty for another object, or a sampler without a chain."""
    return sampler.diagnostics.summary if is_tempered(sampler) and sampler.ladder and sampler.iteration else ""


def log_posterior_of(sampler: Any) -> Any:
    """The function that the sampler was given (emcee wraps it), or None for an object that is no sampler."""
    return getattr(getattr(sampler, "log_prob_fn", None), "f", None)
