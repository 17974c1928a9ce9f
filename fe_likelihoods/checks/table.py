"""The table of the parameters: prior, posterior with its errors, nominal and true value, in the units of a reader."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..likelihood.parameters import Parameter
from ..priors.priors import Prior
from .run import FinishedRun

__all__ = ["Moments", "ParameterRow", "moments_of", "parameter_rows", "rows_of"]


class Moments(NamedTuple):
    """Means and standard deviations, their Monte Carlo errors, 5 %, 50 % and 95 % quantiles (ndim,)."""

    mean: np.ndarray
    mean_error: np.ndarray
    sd: np.ndarray
    sd_error: np.ndarray
    low: np.ndarray
    median: np.ndarray
    high: np.ndarray

    @classmethod
    def of_samples(cls, samples: np.ndarray, mean_error: np.ndarray, sd_error: np.ndarray) -> "Moments":
        """Moments of samples (n, ndim)."""
        quantiles = np.quantile(samples, [0.05, 0.5, 0.95], axis=0)
        return cls(samples.mean(axis=0), mean_error, samples.std(axis=0), sd_error, *quantiles)


def moments_of(run: FinishedRun) -> Moments:
    """Moments of the chain, or of the signed sample of a run with a guide if that is the more accurate sample.

    It has smaller errors of all means, and determines all standard deviations.
    """
    signed = getattr(run.sampler, "signed_sample", None)
    if signed is not None:
        mean, sd = signed.expectation(), signed.standard_deviation()
        if np.all(mean.error < run.mean_error) and np.all(sd.value > 0.0):
            quantiles = (signed.quantile(probability).value for probability in (0.05, 0.5, 0.95))
            return Moments(*mean, *sd, *quantiles)
    return Moments.of_samples(run.samples, run.mean_error, run.sd_error)


class ParameterRow(NamedTuple):
    """One parameter, all values in the unit of its label; texts are empty and numbers NaN where they are not known."""

    name: str
    label: str  # name with unit
    unit: str
    prior: str  # in words
    prior_mean: float
    prior_sd: float
    mean: float
    mean_error: float  # Monte Carlo standard error
    sd: float
    cv: float  # coefficient of variation [-]; NaN for a mean of zero
    low: float  # 5 % quantile
    high: float  # 95 % quantile
    nominal: float
    truth: float
    lower: float  # bound of the prior; infinite where there is none or it is not known
    upper: float  # bound of the prior; infinite where there is none or it is not known

    def widened(self, factor: float) -> float:
        """Standard deviation if the data are worth fewer independent samples, by the square of a factor.

        The precision of the data, which is the precision beyond the prior's, is divided by the square.
        """
        if not self.sd > 0.0:
            return self.sd
        prior = 1.0 / self.prior_sd**2 if self.prior_sd > 0.0 else 0.0
        data = max(1.0 / self.sd**2 - prior, 0.0)
        return max(self.sd, (prior + data / factor**2) ** -0.5)


def parameter_rows(run: FinishedRun) -> list[ParameterRow]:
    """One row per parameter, in the order of the chain."""
    return rows_of(run.parameters, run.prior, moments_of(run), run.truth)


def rows_of(
    parameters: Sequence[Parameter], prior: Prior | None, moments: Moments, truth: np.ndarray
) -> list[ParameterRow]:
    """One row for each parameter; errors of the means and true values (ndim,) may be NaN."""
    mean, mean_error, sd, _, low, _, high = moments
    rows, known = [], [] if prior is None else prior.table()[1]
    for i, parameter in enumerate(parameters):
        family, *of_prior = ("", np.nan, np.nan, -np.inf, np.inf) if prior is None else known[i][1:]
        prior_mean, prior_sd, lower, upper = (float(each) for each in parameter.shown(of_prior))
        numbers = parameter.shown([mean[i], mean_error[i], sd[i], low[i], high[i], parameter.nominal, truth[i]])
        *of_posterior, lowest, highest, nominal, true = (float(each) for each in numbers)
        cv = float(sd[i] / abs(mean[i])) if mean[i] else np.nan
        unit = parameter.label.removeprefix(parameter.name).strip()
        family = family.split("(")[0]
        moments_of_prior = "" if family == "Uniform" else f", mean {prior_mean:.4g}, sd {prior_sd:.3g}"
        text = f"{family}{moments_of_prior}{_limits(lower, upper)}" if family else ""
        shown = text, prior_mean, prior_sd, *of_posterior, cv, lowest, highest, nominal, true, lower, upper
        rows.append(ParameterRow(parameter.name, parameter.label, unit, *shown))
    return rows


def _limits(lower: float, upper: float) -> str:
    if np.isfinite(lower) and np.isfinite(upper):
        return f", from {lower:.4g} to {upper:.4g}"
    return f", above {lower:.4g}" if np.isfinite(lower) else f", below {upper:.4g}" if np.isfinite(upper) else ""
