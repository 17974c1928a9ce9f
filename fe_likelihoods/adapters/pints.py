"""Adapter for pints: a `pints.LogPosterior` made of a log-likelihood and a log-prior."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from ..likelihood.posterior import Posterior

if TYPE_CHECKING:
    import pints

__all__ = ["to_pints"]


def to_pints(posterior: Posterior) -> pints.LogPosterior:
    """Convert a posterior for the Markov chains and optimisers of pints.

    The priors of the posterior are used directly. There are no gradients, so the methods of pints that need
    ``evaluateS1`` (MALA, Hamiltonian Monte Carlo) cannot be used. Use another client for the evidence: the ellipsoidal
    nested sampling of pints 0.6.1 draws uniformly in parameter space for any prior, so its evidence is wrong unless all
    priors are uniform.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    pints.LogPosterior
        It can be pickled, and so can its ``log_likelihood()`` and its ``log_prior()``.

    Examples
    --------
    >>> starts = posterior.sample_start(4)
    >>> controller = pints.MCMCController(to_pints(posterior), 4, list(starts), method=pints.DifferentialEvolutionMCMC)
    >>> chains = controller.run()
    """
    return _classes()["LogPosterior"](posterior)


def _make(name: str, posterior: Posterior) -> object:
    """Construct one of the classes; pickles refer to this function because the classes are created at run time."""
    return _classes()[name](posterior)


@functools.cache
def _classes() -> dict[str, type]:
    import pints

    class OfPosterior:
        posterior: Posterior

        def __reduce__(self) -> tuple:
            return _make, (type(self).__name__, self.posterior)

        def n_parameters(self) -> int:
            return self.posterior.ndim

    class LogLikelihood(OfPosterior, pints.LogLikelihood):
        def __init__(self, posterior: Posterior) -> None:
            super().__init__()
            self.posterior = posterior

        def __call__(self, x: np.ndarray) -> float:
            return self.posterior.log_likelihood(x)

    class LogPrior(OfPosterior, pints.LogPrior):
        def __init__(self, posterior: Posterior) -> None:
            super().__init__()
            self.posterior = posterior

        def __call__(self, x: np.ndarray) -> float:
            return self.posterior.log_prior(x)

        def icdf(self, p: np.ndarray) -> np.ndarray:
            return self.posterior.prior_transform(p)

        def mean(self) -> np.ndarray:
            return self.posterior.prior.mean()

        def sample(self, n: int = 1) -> np.ndarray:
            return self.posterior.sample_prior(n)

    class LogPosterior(OfPosterior, pints.LogPosterior):
        def __init__(self, posterior: Posterior) -> None:
            super().__init__(LogLikelihood(posterior), LogPrior(posterior))
            self.posterior = posterior

    return {part.__name__: part for part in (LogPosterior, LogLikelihood, LogPrior)}
