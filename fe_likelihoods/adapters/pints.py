"""A posterior as a `pints.LogPosterior`: a log-likelihood and a log-prior in the classes of pints."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import numpy as np

from ..probability.posterior import Posterior

if TYPE_CHECKING:
    import pints

__all__ = ["to_pints"]


def to_pints(posterior: Posterior) -> pints.LogPosterior:
    """The posterior for the Markov chains and the optimisers of pints.

    Priors are those of the posterior itself, not translated. No gradients: the methods of pints that need
    ``evaluateS1`` (MALA, Hamiltonian) refuse it. For an evidence take another client: the ellipsoidal nested sampling
    of pints 0.6.1 draws uniformly in parameter space, whatever the prior, and its evidence is wrong unless they are
    all uniform.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    pints.LogPosterior
        It pickles, and so do its ``log_likelihood()`` and its ``log_prior()``.

    Examples
    --------
    >>> starts = posterior.sample_start(4)
    >>> controller = pints.MCMCController(to_pints(posterior), 4, list(starts), method=pints.DifferentialEvolutionMCMC)
    >>> chains = controller.run()
    """
    return _classes()["LogPosterior"](posterior)


def _make(name: str, posterior: Posterior) -> object:
    """What a pickle calls: the classes are made at run time, so their instances are too."""
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
            return np.array([d.moments[0] for d in self.posterior.prior.distributions.values()])

        def sample(self, n: int = 1) -> np.ndarray:
            return self.posterior.sample_prior(n)

    class LogPosterior(OfPosterior, pints.LogPosterior):
        def __init__(self, posterior: Posterior) -> None:
            super().__init__(LogLikelihood(posterior), LogPrior(posterior))
            self.posterior = posterior

    return {part.__name__: part for part in (LogPosterior, LogLikelihood, LogPrior)}
