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
    names: Any = None,
    mean_error: np.ndarray | None = None,
    sd_error: np.ndarray | None = None,
) -> "pandas.DataFrame":
    """Posterior mean, standard deviation, their Monte Carlo errors, and coefficient of variation.

    Parameters
    ----------
    samples : array_like, shape (n, ndim)
        Samples of the posterior.
    names : sequence of str, or a posterior, optional
        One name per parameter; theta_0, theta_1, ... by default. With a posterior, or its ``parameters``, all are in
        the units of the parameters, which the rows name.
    mean_error, sd_error : array_like, shape (ndim,), optional
        Standard errors of mean and standard deviation, from ``sampler.mean_error()`` and ``sampler.sd_error()``, since
        copies made by resampling are correlated.

    Returns
    -------
    pandas.DataFrame
        A row per parameter: ``mean`` and ``sd``, each followed by its error if given, and the coefficient of variation
        ``cv``, standard deviation / magnitude of the mean [-].

    Examples
    --------
    >>> print(summary(samples, posterior))  # doctest: +SAMPLED
                                mean        sd        cv
    stiffness [x nominal]   1.102246  0.002427  0.002202
    damping [x nominal]     0.857993  0.022188  0.025860
    sigma_acceleration [g]  0.047031  0.002261  0.048078
    sigma_displacement [cm] 1.812300  0.084900  0.046850
    """
    import pandas  # slow to import

    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got {samples.shape}"
        )
    names = names_of_parameters(getattr(names, "parameters", names), samples.shape[1])
    columns = {"mean": samples.mean(axis=0), "mean_error": mean_error, "sd": samples.std(axis=0), "sd_error": sd_error}
    columns = {name: each for name, each in columns.items() if each is not None}
    found = pandas.DataFrame(columns, [getattr(each, "label", each) for each in names], dtype=float)
    found = found.div([getattr(each, "factor", 1.0) for each in names], axis=0)
    return found.assign(cv=found["sd"] / found["mean"].abs())
