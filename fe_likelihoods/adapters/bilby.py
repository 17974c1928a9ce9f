"""A posterior as what `bilby.run_sampler` asks for: a likelihood of named parameters and a dictionary of priors.

bilby's own classes of priors are used, not wrappers of ours, so that its results are saved, loaded and plotted as any
other. Their distribution functions are computed by differences of error functions, which a truncation far from the
mean exhausts, so every translated prior is compared with the original before it is handed out.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..probability.posterior import Posterior
from ..probability.priors import Distribution, HalfNormal, LogNormal, TruncatedNormal, Uniform

if TYPE_CHECKING:
    import bilby

__all__ = ["BilbyProblem", "to_bilby"]

_LEVELS = np.linspace(0.001, 0.999, 21)
_TOLERANCE = 1e-7  # of quantiles in sd, and of logarithms of densities


class BilbyProblem(NamedTuple):
    """What `bilby.run_sampler` takes first: the likelihood and the priors."""

    likelihood: bilby.Likelihood
    priors: bilby.core.prior.PriorDict


def to_bilby(posterior: Posterior) -> BilbyProblem:
    """The posterior for bilby.

    The likelihood stays zero outside the support of the posterior's own prior, whatever the priors given to bilby.
    Zero is here a log-likelihood of -1e100: of an infinite one bilby draws the live point again, and the evidence would
    be too large by the share of the prior in which simulations fail.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    BilbyProblem
        The likelihood (it pickles, under spawn too) and the priors, in the order of the parameters.

    Raises
    ------
    ValueError
        If bilby has no prior equal to one of the posterior's.

    Examples
    --------
    >>> likelihood, priors = to_bilby(posterior)
    >>> result = bilby.run_sampler(likelihood, priors, sampler="dynesty", nlive=500)
    """
    import bilby

    translated = {name: _translated(name, d) for name, d in posterior.prior.distributions.items()}
    return BilbyProblem(_likelihood_class()(posterior), bilby.core.prior.PriorDict(translated))


def _make_likelihood(posterior: Posterior) -> bilby.Likelihood:
    """What a pickle calls: the class is made at run time, so its instances are too."""
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
                    f"the likelihood needs {', '.join(names)}; bilby's parameters lack {', '.join(missing)}: keep "
                    "the names of to_bilby's priors, and fix a parameter with a DeltaFunction"
                )
            # bilby's own conversions may have added others
            return self.posterior.finite_log_likelihood(np.array([parameters[name] for name in names], dtype=float))

    return BlackBoxLikelihood


def _translated(name: str, distribution: Distribution) -> bilby.core.prior.Prior:
    """bilby's prior equal to `distribution`, or ValueError."""
    from bilby.core import prior

    # the type itself: a class derived from one of these is another distribution
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
            f"to_bilby knows TruncatedNormal, HalfNormal, Uniform and LogNormal; {name!r} is a {kind.__name__}: "
            "replace it by one of them"
        )
    ours = distribution.ppf(_LEVELS)
    with np.errstate(all="ignore"):
        quantiles = np.abs(translated.rescale(_LEVELS) - ours) / distribution.moments[1]
        densities = np.abs(np.log(translated.prob(ours)) - distribution.logpdf(ours))
    if not max(quantiles.max(), densities.max()) < _TOLERANCE:
        raise ValueError(
            f"bilby's prior for {name!r} differs from {distribution!r}, by {quantiles.max():.2g} sd in a quantile and "
            f"{densities.max():.2g} in a log-density: its bounds leave too little of the distribution for bilby's "
            "arithmetic; move the mean towards the bounds or raise the sd"
        )
    return translated
