"""Adapter for bilby: a likelihood of named parameters and a dictionary of priors, as `bilby.run_sampler` needs them.

The priors are instances of bilby's own classes, so bilby can save, load and plot its results as usual. bilby computes
distribution functions by differences of error functions, which lose all digits for a truncation far from the mean.
Each translated prior is therefore compared with the original one before it is returned.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..likelihood.posterior import Posterior
from ..priors.distributions import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform

if TYPE_CHECKING:
    import bilby

# Probabilities at which translated priors are compared with the original ones, and the largest difference of quantiles
# (in standard deviations) and of log densities.
_LEVELS = np.linspace(0.001, 0.999, 21)
_TOLERANCE = 1e-7


class BilbyProblem(NamedTuple):
    """The first two arguments of `bilby.run_sampler`: a likelihood (can be pickled) and priors in parameter order."""

    likelihood: bilby.Likelihood
    priors: bilby.core.prior.PriorDict


def to_bilby(posterior: Posterior) -> BilbyProblem:
    """Convert a posterior for bilby.

    The likelihood is zero outside the prior support of `posterior`, even if other priors are passed to bilby. A
    likelihood of zero is returned as a log-likelihood of -1e100. bilby would replace a live point with an infinite
    log-likelihood, and its evidence would be too large: it would lack the logarithm of the prior probability that a
    simulation succeeds.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    BilbyProblem
        The likelihood (it can be pickled, also with the start method spawn) and the priors.

    Raises
    ------
    ValueError
        If bilby has no equivalent of a prior in the posterior.

    Examples
    --------
    >>> from fe_likelihoods.adapters import to_bilby
    >>> likelihood, priors = to_bilby(posterior)
    >>> list(priors)
    ['stiffness', 'damping', 'sigma_acceleration', 'sigma_displacement']
    """
    import bilby

    translated = {name: _translated(name, d) for name, d in posterior.prior.distributions.items()}
    return BilbyProblem(_likelihood_class()(posterior), bilby.core.prior.PriorDict(translated))


def _make_likelihood(posterior: Posterior) -> bilby.Likelihood:
    """Construct the likelihood; pickles refer to this function because the class is created at run time."""
    return _likelihood_class()(posterior)


@functools.cache
def _likelihood_class() -> type:
    import bilby

    class BlackBoxLikelihood(bilby.Likelihood):
        def __init__(self, posterior: Posterior) -> None:
            super().__init__()
            self.posterior = posterior

        def __reduce__(self) -> tuple:
            return _make_likelihood, (self.posterior,)

        def log_likelihood(self, parameters: Mapping[str, float]) -> float:
            names = self.posterior.parameter_names
            missing = [name for name in names if name not in parameters]
            if missing:
                raise ValueError(
                    f"the likelihood needs the parameters {', '.join(names)}, but bilby's parameters lack "
                    f"{', '.join(missing)}: keep the names of the priors that to_bilby returned, and fix a parameter "
                    "with a DeltaFunction"
                )
            # other names are ignored: bilby's conversions may have added parameters
            value = self.posterior.log_likelihood(np.array([parameters[name] for name in names], dtype=float))
            return max(value, -1e100)  # bilby would replace a point of -inf by another draw of the prior

    return BlackBoxLikelihood


def _translated(name: str, distribution: Distribution) -> bilby.core.prior.Prior:
    """Return bilby's prior that is equal to `distribution`, or raise ValueError."""
    from bilby.core import prior

    # the exact type: a derived class is a different distribution
    kind = type(distribution)
    if kind is TruncatedNormal:
        translated = prior.TruncatedNormal(distribution.mean, distribution.sd, *distribution.bounds, name=name)
    elif kind is HalfNormal:
        translated = prior.HalfNormal(distribution.sd, name=name)
    elif kind is Uniform:
        translated = prior.Uniform(*distribution.bounds, name=name)
    elif kind is LogNormal:
        translated = prior.LogNormal(math.log(distribution.median), distribution.log_sd, name=name)
    else:
        raise ValueError(
            f"to_bilby supports TruncatedNormal, HalfNormal, Uniform and LogNormal; {name!r} is a {kind.__name__}: "
            "replace it by one of them"
        )
    ours = distribution.ppf(_LEVELS)
    with np.errstate(all="ignore"):
        quantiles = np.abs(translated.rescale(_LEVELS) - ours) / distribution.moments[1]
        densities = np.abs(np.log(translated.prob(ours)) - distribution.logpdf(ours))
    if not max(quantiles.max(), densities.max()) < _TOLERANCE:
        raise ValueError(
            f"bilby's prior for {name!r} differs from {distribution!r} by {quantiles.max():.2g} standard deviations in "
            f"a quantile and {densities.max():.2g} in a log density, because the bounds truncate it too far from its "
            "mean for bilby's arithmetic: move the mean towards the bounds or increase the standard deviation"
        )
    return translated
