"""The table of the parameters: prior, posterior with its errors, nominal and true value, in the units of a reader."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..likelihood.parameters import Parameter
from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform
from ..priors.priors import Prior
from .run import FinishedRun

__all__ = ["Moments", "ParameterRow", "describe_prior", "moments_of", "parameter_rows", "rows_of"]


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
    parameters: Sequence[Parameter],
    prior: Prior | None,
    moments: Moments,
    truth: np.ndarray,
) -> list[ParameterRow]:
    """One row for each parameter; errors of the means and true values (ndim,) may be NaN."""
    mean, mean_error, sd, _, low, _, high = moments
    rows, known = [], [] if prior is None else prior.table()[1]
    for i, parameter in enumerate(parameters):
        text, of_prior, bounds = "", (np.nan, np.nan), (-np.inf, np.inf)
        if prior is not None:
            text = _words_of(prior, parameter.name, parameter.factor)
            of_prior, bounds = known[i][2:4], known[i][4:6]
        numbers = mean[i], mean_error[i], sd[i]
        shown = [float(each) for each in parameter.shown([*of_prior, *numbers])]
        others = [float(each) for each in parameter.shown([low[i], high[i], parameter.nominal, truth[i], *bounds])]
        cv = float(sd[i] / abs(mean[i])) if mean[i] else np.nan
        unit = parameter.label.removeprefix(parameter.name).strip()
        rows.append(ParameterRow(parameter.name, parameter.label, unit, text, *shown, cv, *others))
    return rows


def _words_of(prior: Prior, name: str, factor: float) -> str:
    for key, distribution in prior.distributions.items():
        if key == name:
            return describe_prior(distribution, factor)
        if isinstance(key, tuple) and name in key:
            return f"{type(distribution).__name__}, jointly with {', '.join(other for other in key if other != name)}"
    return ""


def describe_prior(distribution: Distribution, factor: float = 1.0) -> str:
    """A distribution in words: "normal (1, 0.25), above 0"; `factor` is the text's unit in the distribution's unit."""
    if isinstance(distribution, TruncatedNormal):
        text = f"normal, mean {distribution.mean / factor:.4g}, sd {distribution.sd / factor:.4g}"
        return text + _limits(distribution, factor)
    if isinstance(distribution, HalfNormal):
        return f"half-normal, scale {distribution.sd / factor:.4g}"
    if isinstance(distribution, Uniform):
        return f"uniform from {distribution.low / factor:.4g} to {distribution.high / factor:.4g}"
    if isinstance(distribution, LogNormal):
        return f"lognormal, median {distribution.median / factor:.4g}, sd of the logarithm {distribution.log_sd:.3g}"
    mean, sd = distribution.moments
    return f"{_name(distribution)}, mean {mean / factor:.4g}, sd {sd / factor:.4g}" + _limits(distribution, factor)


def _name(distribution: Distribution) -> str:
    frozen = getattr(distribution, "frozen", None)
    return type(distribution).__name__ if frozen is None else f"{frozen.dist.name} (scipy)"


def _limits(distribution: Distribution, factor: float) -> str:
    lower, upper = (bound / factor for bound in distribution.bounds)
    if np.isfinite(lower) and np.isfinite(upper):
        return f", between {lower:.4g} and {upper:.4g}"
    if np.isfinite(lower):
        return f", above {lower:.4g}"
    return f", below {upper:.4g}" if np.isfinite(upper) else ""
