"""Structural finite-element models as black-box log-likelihoods.

All public names can be imported from here, ``from fe_likelihoods import Record, FELikelihood, Posterior``, and are
loaded on first use: importing the package takes about 0.01 s. The names are listed in ``__init__.pyi``, which editors
and type checkers read as well. Other modules are imported by their names, as in ``import fe_likelihoods.units``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
