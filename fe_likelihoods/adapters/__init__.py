"""Adapters for Bayesian clients that need objects of their own classes, and a server for clients elsewhere.

Most clients accept a function: pass the posterior or a bound method (``docs/clients.rst``). bilby and PyMC each have
one function here, which translates the priors and passes the likelihood as a black box; a client is imported inside it.
Clients in other languages and processes call the server of `serve` (UM-Bridge).
"""

from ..models.umbridge import serve
from .bilby import to_bilby
from .pymc import to_pymc

__all__ = ["serve", "to_bilby", "to_pymc"]
