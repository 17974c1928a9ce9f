"""The posterior in the words of clients that have a class of their own for it.

Most clients take a function, so they take the posterior or its bound methods as they are. bilby, PyMC, pints and
nautilus (where it is to name the parameters) want objects of their own: each has one function here, which maps the
priors to the client's and leaves the likelihood a black box. A client is imported when its function is called, so
none of them is needed to import this package.
"""

from .bilby import to_bilby
from .nautilus import nautilus_prior
from .pints import to_pints
from .pymc import to_pymc

__all__ = ["nautilus_prior", "to_bilby", "to_pints", "to_pymc"]
