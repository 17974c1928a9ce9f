"""Moments of the posterior as a table, and what a sampler tells about itself."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas


def is_tempered(sampler: Any) -> bool:
    """Whether a sampler is a `samplers.tempered.TemperedSampler`, with a ladder and an evidence."""
    return hasattr(sampler, "ladder")


def log_posterior_of(sampler: Any) -> Any:
    """The user's function in a sampler (emcee wraps it); None for an object that is no sampler."""
    return getattr(getattr(sampler, "log_prob_fn", None), "f", None)


def names_of_parameters(names: Sequence[str] | None, ndim: int) -> tuple[str, ...]:
    """The given names, or theta_0, theta_1, ...; ValueError if there is not one per parameter."""
    names = tuple(names or (f"theta_{i}" for i in range(ndim)))
    if len(names) != ndim:
        raise ValueError(f"expected one name per parameter: {ndim} parameters, but {len(names)} names {names}")
    return names


def summary(
    samples: np.ndarray,
    names: Sequence[str] | None = None,
    mean_error: np.ndarray | None = None,
    sd_error: np.ndarray | None = None,
) -> "pandas.DataFrame":
    """Posterior mean, standard deviation, their Monte Carlo errors, and coefficient of variation.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    names : sequence of str, optional
        One name per parameter; theta_0, theta_1, ... by default.
    mean_error, sd_error : array_like, shape (ndim,), optional
        Standard errors of mean and standard deviation, from ``sampler.mean_error()`` and ``sampler.sd_error()``, since
        copies made by resampling are correlated; NaN where they are unknown.

    Returns
    -------
    pandas.DataFrame
        A row per parameter: ``mean`` and ``mean_error``, ``sd`` and ``sd_error``, and the coefficient of variation
        ``cv``, standard deviation / magnitude of the mean [-].

    Examples
    --------
    >>> print(summary(samples, posterior.parameter_names))  # doctest: +SAMPLED
                            mean  mean_error        sd  sd_error        cv
    stiffness           1.102246         NaN  0.002427       NaN  0.002202
    damping             0.857993         NaN  0.022188       NaN  0.025860
    sigma_acceleration  0.461220         NaN  0.022175       NaN  0.048078
    sigma_displacement  0.018123         NaN  0.000849       NaN  0.046850
    """
    import pandas  # slow to import

    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got {samples.shape}"
        )
    mean, sd = samples.mean(axis=0), samples.std(axis=0)
    errors = (np.nan if error is None else error for error in (mean_error, sd_error))
    columns = dict(zip(("mean", "sd", "mean_error", "sd_error"), (mean, sd, *errors), strict=True))
    found = pandas.DataFrame(columns, index=names_of_parameters(names, samples.shape[1]))
    found["cv"] = found["sd"] / found["mean"].abs()
    return found[["mean", "mean_error", "sd", "sd_error", "cv"]]
