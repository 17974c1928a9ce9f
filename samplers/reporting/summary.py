"""Results of finished runs as tables: moments of the posterior."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np


def is_tempered(sampler: Any) -> bool:
    """Whether a sampler is a `samplers.tempered.TemperedSampler`, with a ladder and an evidence."""
    return hasattr(sampler, "ladder")


def log_posterior_of(sampler: Any) -> Any:
    """The user's function in a sampler (emcee wraps it); None for an object that is no sampler."""
    return getattr(getattr(sampler, "log_prob_fn", None), "f", None)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table, from its cells: the first column is aligned to the left, others to the right."""
    columns = []
    for column in zip(*rows, strict=True):
        width, side = max(map(len, column)), ">" if columns else "<"
        columns.append([f"{cell:{side}{width}}" for cell in column])
    return ["  ".join(row) for row in zip(*columns, strict=True)]


class Summary(NamedTuple):
    """Moments of the posterior, one entry per parameter. ``str`` gives a table.

    Attributes
    ----------
    names : tuple of str
        Names of the parameters.
    mean, sd : ndarray, shape (ndim,)
        Mean and standard deviation.
    cv : ndarray, shape (ndim,)
        Coefficient of variation ``sd / |mean|`` [-]; inf where the mean is zero and the standard deviation is not.
    mean_error, sd_error : ndarray, shape (ndim,)
        Monte Carlo standard errors of `mean` and `sd`; NaN if they are not known.
    """

    names: tuple[str, ...]
    mean: np.ndarray
    sd: np.ndarray
    cv: np.ndarray
    mean_error: np.ndarray
    sd_error: np.ndarray

    def __str__(self) -> str:
        rows = [("parameter", "mean", "MC error", "sd", "MC error", "CV")]
        columns = self.names, self.mean, self.mean_error, self.sd, self.sd_error, self.cv
        for name, *values in zip(*columns, strict=True):
            cells = (f"{x:{form}}" for x, form in zip(values, (".5g", ".2g", ".4g", ".2g", ".3g"), strict=True))
            rows.append((name, *("-" if cell == "nan" else cell for cell in cells)))
        return "\n".join(aligned(rows))

    __repr__ = __str__


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
) -> Summary:
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
    Summary

    Examples
    --------
    >>> print(summary(samples, posterior.parameter_names))  # doctest: +SAMPLED
    parameter              mean  MC error         sd  MC error       CV
    stiffness            1.1022         -   0.002393         -  0.00217
    damping             0.86008         -    0.02466         -   0.0287
    sigma_acceleration  0.46343         -     0.0243         -   0.0524
    sigma_displacement  0.01823         -  0.0009417         -   0.0517
    """
    samples = np.asarray(samples, dtype=float)
    if samples.ndim != 2 or len(samples) < 2:
        raise ValueError(
            f"samples must be an array (n, ndim) with n >= 2, as get_chain(flat=True) returns; got {samples.shape}"
        )
    errors = []
    for name, given in (("mean_error", mean_error), ("sd_error", sd_error)):
        error = np.full(samples.shape[1], np.nan) if given is None else np.asarray(given, dtype=float)
        if error.shape != samples.shape[1:] or np.any(error < 0.0):
            raise ValueError(f"{name} must be {samples.shape[1]} numbers, each non-negative or NaN; got {given}")
        errors.append(error)
    mean, sd = samples.mean(axis=0), samples.std(axis=0)
    cv = np.divide(sd, np.abs(mean), out=np.where(sd > 0.0, np.inf, 0.0), where=mean != 0.0)
    return Summary(names_of_parameters(names, samples.shape[1]), mean, sd, cv, *errors)
