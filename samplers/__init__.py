"""Tempered ensemble samplers behind emcee's interface.

All public names can be imported from here, ``from samplers import SMCSampler, compare_models``, and are loaded on first
use: importing the package takes about 0.01 s. The names are listed in ``__init__.pyi``, which editors and type
checkers read as well.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
