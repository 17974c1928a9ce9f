"""Scripts that run in the process of the tests: an interpreter with this library takes a CPU second to start."""

import logging
import os
import runpy
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np


@contextmanager
def restored_state() -> Iterator[None]:
    """Put back what a script may change in its process; filters of warnings and styles of figures are the defaults."""
    import matplotlib
    from matplotlib import pyplot

    folder, path, arguments, variables = os.getcwd(), sys.path[:], sys.argv[:], dict(os.environ)
    random, interrupt = np.random.get_state(), signal.getsignal(signal.SIGINT)  # noqa: NPY002 - emcee uses it
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    try:
        with warnings.catch_warnings(), matplotlib.rc_context():
            warnings.resetwarnings()  # a script knows nothing of the filters of pytest
            warnings.simplefilter("default")
            matplotlib.rcdefaults()
            matplotlib.use("Agg")
            yield
    finally:
        pyplot.close("all")
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(variables)
        sys.path[:], sys.argv[:] = path, arguments
        np.random.set_state(random)  # noqa: NPY002
        signal.signal(signal.SIGINT, interrupt)
        root.setLevel(level)
        root.handlers[:] = handlers


def run_script(script: Path, *arguments: str, folder: Path | None = None, **environment: str) -> dict[str, Any]:
    """Variables of a script after it has run as ``python script arguments``, in `folder` and with these variables."""
    with restored_state():
        os.environ.update(environment)
        os.chdir(folder or script.parent)
        sys.path.insert(0, str(script.parent))
        sys.argv[:] = [str(script), *arguments]
        before = sys.modules.copy()
        try:
            return runpy.run_path(str(script), run_name="__main__")
        finally:
            for name in sys.modules.keys() - before.keys():
                if Path(getattr(sys.modules[name], "__file__", None) or "/").parent == script.parent:
                    del sys.modules[name]  # the modules beside another script may have the same names
