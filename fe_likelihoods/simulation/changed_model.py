"""What was fingerprinted is what runs: models that changed later, and workers whose code is another one.

A fingerprint is computed when a model is made. Code of the user may use values that change afterwards: an array that is
changed in place, a variable of a module, a file that a program reads. Models with a method ``current_fingerprint()``,
such as `FunctionModel`, can compute it again. It is compared before simulations are stored, and in every worker process
that receives the model.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .code_digest import code_digest
from .faults import ChangedModel

__all__ = ["ModelGuard", "SentFunction", "SentModel", "current_fingerprint"]

_SHARE_OF_TIME = 0.01  # for fingerprints that are computed again
_NO_TIME = 5e-5  # [s]; a fingerprint that takes less is always computed again, since storing a row takes longer


def current_fingerprint(model: Any) -> str:
    """Fingerprint of a model as it is now, or the attribute ``fingerprint`` if the model cannot compute it again."""
    compute = getattr(model, "current_fingerprint", None)
    return model.fingerprint if compute is None else compute()


class ModelGuard:
    """Compares the fingerprint of a model with that at the start, in about 1 % of the time.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    unchecked : list of (n, n_structural) ndarray
        Parameters of the simulations since the last comparison.
    """

    def __init__(self, model: Any) -> None:
        self._fingerprint = model.fingerprint
        self.unchecked: list[np.ndarray] = []
        self._not_before = -np.inf
        self._is_due = False

    def __getstate__(self) -> dict:
        return self.__dict__ | {"unchecked": [], "_not_before": -np.inf}

    def before(self, model: Any) -> None:
        """Compare before simulations, unless the last comparison was too short ago.

        Raises
        ------
        ChangedModel
            If the model has changed; the simulations at `unchecked` may be those of either model.
        """
        start = time.monotonic()
        self._is_due = start >= self._not_before
        if self._is_due:
            self._compare(model)
            now = time.monotonic()
            self._not_before = now + max(0.0, 2.0 * (now - start) - _NO_TIME) / _SHARE_OF_TIME

    def after(self, model: Any, thetas: np.ndarray, in_process: bool) -> None:
        """Compare after simulations at `thetas` (n, n_structural), if they were compared before them.

        A model that ran in this process may have changed its own values. It then says so, with its method
        ``accept_own_changes()``, and only its other inputs are compared.

        Raises
        ------
        ChangedModel
            As for `before`.
        """
        self.unchecked.append(thetas)
        if not self._is_due:
            return
        try:
            self._compare(model)
        except ChangedModel:
            if not in_process or not hasattr(model, "accept_own_changes"):
                raise
            model.accept_own_changes()
            self._compare(model)
        self.unchecked.clear()

    def _compare(self, model: Any) -> None:
        try:
            if current_fingerprint(model) == self._fingerprint:
                return
            why = "its fingerprint differs"
        except ValueError as error:
            why = str(error)
        raise ChangedModel(
            f"the {type(model).__name__} has changed since the likelihood was made ({why}): a value or file that it "
            "uses was changed, or another model was set. Its simulations cannot be stored with the earlier ones. Make "
            "a new model and a new likelihood; what varies during a run has to be a parameter. If the model itself "
            "changes a value that does not matter, such as a counter, give it a version="
            f".{getattr(model, 'change_advice', '')}"
        )


class SentModel:
    """A model that is compared, in the process that receives it, with the one that was sent.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ChangedModel
        When it is unpickled, if its fingerprint in the other process is another one.
    """

    def __init__(self, model: Any) -> None:
        self.model = model

    def __reduce__(self) -> tuple:
        return _receive_model, (self.model, self.model.fingerprint)


def _receive_model(model: Any, fingerprint: str) -> SentModel:
    if hasattr(model, "current_fingerprint"):
        _compare(type(model).__name__, fingerprint, model.current_fingerprint)
    return SentModel(model)


class SentFunction:
    """A function that is compared, in the process that receives it, with the one that was sent.

    Parameters
    ----------
    function : callable
    code : object
        What was fingerprinted: the function, or a part of it.
    digest : str
        `code_digest` of the code when it was fingerprinted; empty for a function with a version of the user.
    """

    def __init__(self, function: Callable, code: Any, digest: str) -> None:
        self.function, self.code, self.digest = function, code, digest
        self.__qualname__ = getattr(code, "__qualname__", type(code).__qualname__)  # for messages

    def __repr__(self) -> str:
        return repr(self.function)

    def __call__(self, item: Any) -> Any:
        return self.function(item)

    def __reduce__(self) -> tuple:
        return _receive_function, (self.function, self.code, self.digest)


def _receive_function(function: Callable, code: Any, digest: str) -> SentFunction:
    if digest:
        _compare(getattr(code, "__qualname__", type(code).__name__), digest, lambda: code_digest(code))
    return SentFunction(function, code, digest)


def _compare(name: str, expected: str, compute: Callable[[], str]) -> None:
    """Raise `ChangedModel` if a fingerprint is another one in this process."""
    try:
        same, why = compute() == expected, "what it uses differs"
    except ValueError as error:
        same, why = False, str(error)
    if not same:
        raise ChangedModel(
            f"{name} is not the same in the worker process ({why}): its source file was edited, or the main process "
            "has changed a variable of a module. Start a new pool and make the model again; set variables where the "
            "module defines them, or pass them in the function's object. If they do not matter, give the model a "
            "version="
        )
