"""The prior of a posterior as a `nautilus.Prior`, which names the parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..probability.posterior import Posterior

if TYPE_CHECKING:
    import nautilus

__all__ = ["nautilus_prior"]


def nautilus_prior(posterior: Posterior) -> nautilus.Prior:
    """The posterior's prior for nautilus, parameters under their names and in their order.

    With this prior nautilus hands the likelihood a dictionary, which the posterior understands. Without names no
    adapter is needed: ``nautilus.Sampler(posterior.prior_transform, posterior.log_likelihood, n_dim=posterior.ndim,
    vectorized=True)``.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    nautilus.Prior

    Examples
    --------
    >>> sampler = nautilus.Sampler(nautilus_prior(posterior), posterior.log_likelihood, vectorized=True)
    >>> sampler.run()
    """
    import nautilus

    prior = nautilus.Prior()
    for name, distribution in posterior.prior.distributions.items():
        prior.add_parameter(name, distribution)
    return prior
