"""Functions that each worker process receives once, through a private file; later tasks contain only their digest.

Workers on other machines, which do not find the file, get the function together with the items.
"""

import os
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from samplers.interrupts import Ended, interrupts_end_the_run

from .by_value import Pickled, Recent

__all__ = ["FunctionReference", "Missing", "PrivateFiles", "loaded_functions"]


class Missing(NamedTuple):
    """Reply of a worker that does not have the function."""


def _called(function: Callable, item: Any) -> Any:
    """The result of a function for an item, or `Ended`: raised in a pool, it would end processes of the pool."""
    try:
        with interrupts_end_the_run():
            return function(item)
    except (KeyboardInterrupt, SystemExit) as error:
        return Ended(error)


class PrivateFiles:
    """One pool's most recent functions, in files that only this user can read and that this process deletes."""

    def __init__(self) -> None:
        self._files = Recent()
        self._lock = threading.Lock()

    def path(self, function: Pickled) -> str:
        """Path of the file with a function."""
        with self._lock:
            file = self._files.use(function.key)
            if file is None:
                linux = sys.platform == "linux"
                file = tempfile.TemporaryFile() if linux else tempfile.NamedTemporaryFile(prefix="fe_likelihoods_")
                file.write(function.payload)
                file.flush()
                self._files.keep(function.key, file, len(function.payload))
            return f"/proc/{os.getpid()}/fd/{file.fileno()}" if sys.platform == "linux" else file.name


class FunctionReference:
    """A function that is pickled as a reference: its digest and the path of a file with the pickled function.

    Called in this process, it calls the function. In another process it becomes a `_LoadedFunction`.
    """

    def __init__(self, function: Callable, files: PrivateFiles) -> None:
        self._function, self._files = function, files
        self._pickled: Pickled | None = None
        self._lock = threading.Lock()

    def __call__(self, item: Any) -> Any:
        return _called(self._function, item)

    def pickle(self) -> Pickled:
        """The function in its state at the first call of this method; ValueError if it cannot be pickled."""
        with self._lock:  # pools pickle in their own threads, often once per item
            if self._pickled is None:
                self._pickled = Pickled.of(self._function)
            return self._pickled

    def __reduce__(self) -> tuple:
        pickled = self.pickle()
        return _LoadedFunction, (pickled.key, self._files.path(pickled))

    def carried(self) -> "_LoadedFunction":
        """The function itself, for workers that cannot read the file."""
        return _LoadedFunction(*self.pickle()[::-1])


loaded_functions = Recent()  # `Arrived` by key
_loading = threading.Lock()


class _LoadedFunction:
    """A `FunctionReference` in a worker process, which loads the function once and keeps the most recent ones."""

    def __init__(self, key: bytes, source: str | bytes) -> None:
        self._parts = key, source

    def __reduce__(self) -> tuple:
        return type(self), self._parts

    def __call__(self, item: Any) -> Any:
        key, source = self._parts
        with _loading:
            function = loaded_functions.use(key)
            if function is None:
                try:
                    payload = source if isinstance(source, bytes) else Path(source).read_bytes()
                except OSError:
                    return Missing()
                pickled = Pickled(payload, key)
                if not pickled.is_whole() and not isinstance(source, bytes):  # a file of another machine
                    return Missing()
                function = pickled.load()
                loaded_functions.keep(key, function, len(payload))
        return _called(function, item)
