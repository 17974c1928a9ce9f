"""Adapter for nautilus: the prior as a `nautilus.Prior`, with named parameters."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..likelihood.posterior import Posterior

if TYPE_CHECKING:
    import nautilus

__all__ = ["nautilus_prior"]


def nautilus_prior(posterior: Posterior) -> nautilus.Prior:
    """Convert the prior of a posterior for nautilus, with the names and the order of the parameters.

    With this prior, nautilus calls the likelihood with a dictionary, which ``posterior.log_likelihood`` accepts. No
    adapter is needed for parameters without names: ``nautilus.Sampler(posterior.prior_transform,
    posterior.log_likelihood, n_dim=posterior.ndim, vectorized=True)``.

    Parameters
    ----------
    posterior : Posterior
        The posterior.

    Returns
    -------
    nautilus.Prior

    Raises
    ------
    ValueError
        If parameters have a joint prior distribution.

    Examples
    --------
    >>> sampler = nautilus.Sampler(nautilus_prior(posterior), posterior.log_likelihood, vectorized=True)
    >>> sampler.run()
    """
    for name, distribution in posterior.prior.distributions.items():
        if isinstance(name, tuple):
            raise ValueError(
                f"nautilus_prior needs independent parameters; {', '.join(name)} have a {type(distribution).__name__}: "
                "use nautilus.Sampler(posterior.prior_transform, posterior.log_likelihood, n_dim=posterior.ndim)"
            )
    import nautilus

    prior = nautilus.Prior()
    for name, distribution in posterior.prior.distributions.items():
        prior.add_parameter(name, distribution)
    return prior
