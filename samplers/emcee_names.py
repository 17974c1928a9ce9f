"""Names of emcee, imported without `scipy.stats`, which takes as long to import as all else that a sampler needs.

Only the module of emcee's KDEMove imports it: that module is loaded when the first KDEMove is made.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any

_KDE = "emcee.moves.kde"


class _KDEMove:
    """Makes an `emcee.moves.KDEMove`."""

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        if sys.modules.get(_KDE) is _late:
            del sys.modules[_KDE]
        return import_module(_KDE).KDEMove(*args, **kwargs)


_late = ModuleType(_KDE)
_late.KDEMove = _KDEMove
if "emcee.moves" not in sys.modules:
    sys.modules[_KDE] = _late

from emcee import EnsembleSampler, State  # noqa: E402, F401
from emcee.backends import Backend, HDFBackend  # noqa: E402, F401
from emcee.ensemble import ndarray_to_list_of_dicts, walkers_independent  # noqa: E402, F401
from emcee.model import Model  # noqa: E402, F401
from emcee.moves import DEMove, DESnookerMove, MHMove, Move, RedBlueMove  # noqa: E402, F401
from emcee.pbar import get_progress_bar  # noqa: E402, F401
