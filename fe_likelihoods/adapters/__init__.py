"""Adapters for Bayesian clients that need objects of their own classes, and a server for clients elsewhere.

Most clients accept a function, so the posterior or one of its bound methods is passed to them directly
(``docs/clients.rst``). bilby and PyMC need objects of their own classes. Each has one function here, which translates
the priors and passes the likelihood as a black box. A client is imported inside its function, so this package can be
imported without it. Clients in other languages and processes call the server of `serve` (UM-Bridge).
"""

from .bilby import to_bilby
from .pymc import to_pymc
from .umbridge import serve

__all__ = ["serve", "to_bilby", "to_pymc"]
