"""Functions that are sent to each worker process of a pool once, through a private file, and then named by a digest."""

import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from .faults import ChangedModel, raise_if_refused
from .processes import PickledFunction

__all__ = ["MAX_LOADED_FUNCTIONS", "FunctionReference", "Missing", "Unusable", "loaded_functions"]

MAX_LOADED_FUNCTIONS = 8


class Missing(NamedTuple):
    """Reply of a worker that does not have the function."""


class Unusable(NamedTuple):
    """Reply of a worker that has the function but cannot load it, with the reason."""

    reason: str

    @property
    def error(self) -> Exception:
        """The error for it: `ChangedModel` if the worker has refused the function, else RuntimeError."""
        try:
            raise_if_refused(self.reason)
        except ChangedModel as error:
            return error
        return RuntimeError(
            f"a worker cannot load the model: {self.reason}. Define its classes and functions in modules that the "
            "workers can import"
        )


class FunctionReference:
    """A function that is pickled as a reference: its digest and the path of a file with the pickled function.

    Called in this process, it calls the function. In another process it becomes a `_LoadedFunction`.

    Parameters
    ----------
    function : callable
    folder : Path
        Temporary folder for the file.
    carried : bool
        Whether the pickled function itself is part of the reference, for workers that cannot read the file.
    """

    def __init__(self, function: Callable, folder: Path, carried: bool = False) -> None:
        self._function, self._folder, self._carried = function, folder, carried
        self._lock = threading.Lock()
        self._parts: tuple | None = None

    def __call__(self, item: Any) -> Any:
        return self._function(item)

    def __reduce__(self) -> tuple:
        with self._lock:  # pools pickle in threads of their own, often once per item
            if self._parts is None:
                pickled = PickledFunction.of(self._function)
                path = self._folder / pickled.key.hex()
                if not self._carried and not path.exists():
                    part = path.with_suffix(f".{threading.get_ident()}")
                    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
                        file.write(pickled.payload)
                    part.replace(path)
                self._parts = pickled.key, str(path), pickled.payload if self._carried else b""
        return _LoadedFunction, self._parts


loaded_functions: OrderedDict[bytes, Callable] = OrderedDict()
_loading = threading.Lock()


class _LoadedFunction:
    """A `FunctionReference` in a worker process, which loads the function once and keeps the most recent ones."""

    def __init__(self, key: bytes, path: str, payload: bytes) -> None:
        self._parts = key, path, payload

    def __reduce__(self) -> tuple:
        return type(self), self._parts

    def __call__(self, item: Any) -> Any:
        key, path, payload = self._parts
        with _loading:
            function = loaded_functions.get(key)
            if function is None:
                try:
                    pickled = PickledFunction(payload or Path(path).read_bytes(), key)
                except OSError:
                    return Missing()
                try:
                    function = pickled.load()
                except Exception as error:
                    return Unusable(f"{type(error).__name__}: {error}")
                loaded_functions[key] = function
            loaded_functions.move_to_end(key)
            while len(loaded_functions) > MAX_LOADED_FUNCTIONS:
                loaded_functions.popitem(last=False)
        return function(item)
