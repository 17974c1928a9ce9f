"""What was fingerprinted is what runs: models that changed later, and workers whose code is another one.

A fingerprint is computed when a model is made. Code of the user may use values that change afterwards: an array that is
changed in place, a variable of a module, a file that a program reads. Models with a method ``current_fingerprint()``,
such as `FunctionModel`, can compute it again. It is compared before simulations are stored. Every worker process that
receives a function compares its code, and that of all functions it uses, with the code of the main process.
"""

import logging
import time
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .code_digest import CodeDescription, describe_code
from .faults import ChangedModel
from .fingerprint import state_of_user

__all__ = [
    "ModelGuard",
    "SentCode",
    "SentFunction",
    "SentModel",
    "current_fingerprint",
    "different_in_worker",
    "sent_code",
]

logger = logging.getLogger(__name__)

_SHARE_OF_TIME = 0.01  # for fingerprints that are computed again
_NO_TIME = 5e-5  # [s]; a fingerprint that takes less is always computed again, since storing a row takes longer
_ROWS_PER_REPETITION = 100  # simulations between two repetitions of earlier ones


_compared: set[tuple[str, bool]] = set()  # descriptions of code with which that of this process agrees
_sources: dict[str, bytes] = {}  # digests of source files, as this process has seen them


def current_fingerprint(model: Any) -> str:
    """Fingerprint of a model as it is now, or the attribute ``fingerprint`` if the model cannot compute it again."""
    compute = getattr(model, "current_fingerprint", None)
    return model.fingerprint if compute is None else compute()


class ModelGuard:
    """Compares the fingerprint of a model with that at the start, in about 1 % of the time.

    Code of the user may change values itself, such as a counter, also where the user calls it between two batches. If
    nothing else differs (method ``only_own_changes()`` of the model), earlier points are simulated again, once for 100
    simulations, and the model counts as unchanged if they give the same results.

    Parameters
    ----------
    model : Model

    Attributes
    ----------
    unchecked : list of (n, n_structural) ndarray
        Parameters of the simulations since the last comparison.
    """

    def __init__(self, model: Any) -> None:
        self._fingerprint, self._state = model.fingerprint, state_of_user(model)
        self.unchecked: list[np.ndarray] = []
        self._not_before = -np.inf
        self._is_due = self._has_repeated = False
        self._seconds = np.inf  # of a comparison

    def __getstate__(self) -> dict:
        return self.__dict__ | {"unchecked": [], "_not_before": -np.inf}

    def before(self, model: Any, repeats: Callable[[], bool | None]) -> None:
        """Compare before simulations, unless the last comparison was too short ago.

        Parameters
        ----------
        model : Model
        repeats : callable
            Simulates earlier points again; returns whether their results are the same, None if there are none.

        Raises
        ------
        ChangedModel
            If the model has changed; the simulations at `unchecked` may be those of either model.
        """
        self._is_due = time.monotonic() >= self._not_before
        if self._is_due:
            self._require_same(model, repeats)
            pause = max(0.0, 2.0 * self._seconds - _NO_TIME) / _SHARE_OF_TIME
            self._not_before = time.monotonic() + pause

    def after(
        self,
        model: Any,
        repeats: Callable[[], bool | None],
        thetas: np.ndarray,
        in_process: bool,
        seconds: float,
        last: bool = True,
    ) -> bool:
        """Compare after simulations at `thetas` (n, n_structural), if they were compared before them or took long.

        A model that ran in this process may have changed its own values. It then says so, with its method
        ``accept_own_changes()``, and only its other inputs are compared.

        Parameters
        ----------
        model, repeats
            As for `before`.
        thetas : (n, n_structural) float
            Structural parameters.
        in_process : bool
            Whether the simulations ran in this process.
        seconds : float
            Their wall time [s]; with a pool that runs without interruption, the time since the last comparison.
        last : bool
            Whether no other simulations run. While some do, a comparison before them is no reason for one.

        Returns
        -------
        bool
            Whether the model was compared.

        Raises
        ------
        ChangedModel
            As for `before`.
        """
        self.unchecked.append(thetas)
        if not (self._is_due and last) and (in_process or _SHARE_OF_TIME * seconds < self._seconds):
            return False
        if in_process and self._difference(model) is not None:
            self._state = state_of_user(model)
            if hasattr(model, "accept_own_changes"):
                model.accept_own_changes()
        self._require_same(model, repeats)
        return True

    def _require_same(self, model: Any, repeats: Callable[[], bool | None]) -> None:
        """Raise `ChangedModel` if the model differs in more than values that it may change itself."""
        start = time.monotonic()
        why = self._difference(model)
        self._seconds = time.monotonic() - start
        if why is None:
            self.unchecked.clear()
            return
        if self._state == state_of_user(model) and hasattr(model, "only_own_changes") and model.only_own_changes():
            if self._has_repeated and sum(map(len, self.unchecked)) < _ROWS_PER_REPETITION:
                return
            same = repeats()
            if same is None:  # there is no earlier point
                return
            if same:
                self._has_repeated = True
                self.unchecked.clear()
                return
            why += ", and an earlier simulation gives another result"
        raise ChangedModel(
            f"the {type(model).__name__} has changed since the likelihood was made ({why}): a value or file that it "
            "uses was changed, or another model was set. Its simulations cannot be stored with the earlier ones. Make "
            "a new model and a new likelihood; what varies during a run has to be a parameter. If the model itself "
            "changes a value that does not matter, such as a counter, give it a version="
            f".{getattr(model, 'change_advice', '')}"
        )

    def _difference(self, model: Any) -> str | None:
        """What differs from the model at the start, None if nothing does."""
        try:
            if current_fingerprint(model) != self._fingerprint:
                return "its fingerprint differs"
        except ValueError as error:
            return str(error)
        return None if state_of_user(model) == self._state else "an attribute of its class or object differs"


class SentModel:
    """A model that is compared, in the process that receives it, with the one that was sent.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ChangedModel
        When it is unpickled, if its code or the files that it depends on are others in the other process.
    """

    def __init__(self, model: Any) -> None:
        self.model = model

    def __reduce__(self) -> tuple:
        return _receive_model, (self.model, self.model.fingerprint)


def _receive_model(model: Any, fingerprint: str) -> SentModel:
    if hasattr(model, "compare_with_sender"):
        model.compare_with_sender()
    elif hasattr(model, "current_fingerprint"):
        try:
            same, why = model.current_fingerprint() == fingerprint, "what it uses differs"
        except ValueError as error:
            same, why = False, str(error)
        if not same:
            raise different_in_worker(type(model).__name__, why)
    return SentModel(model)


class SentCode(NamedTuple):
    """Code of a function in the process that has made the model.

    Attributes
    ----------
    description : CodeDescription
    sources : dict of str to bytes
        Digests of the source files, per path, when the model was made.
    """

    description: CodeDescription
    sources: dict[str, bytes]

    def compare(self, code: Any, compare_values: bool) -> None:
        """Compare with the code in this process, once for each description.

        Values, such as a counter, a table of earlier results or the time of the start, may differ between processes.
        Values that differ because a source file was edited may not.

        Parameters
        ----------
        code : object
            The function in this process.
        compare_values : bool
            Whether to log a warning if values differ.

        Raises
        ------
        ChangedModel
            If the bytecode differs, or values differ and so do source files.
        """
        sent, name = self.description, getattr(code, "__qualname__", type(code).__qualname__)
        if (sent.digest, compare_values) in _compared:
            return
        sources = {file: _source(file, again=False) for file in self.sources}  # as imported just now, or earlier
        here = describe_code(code, strict=False)
        if here.digest != sent.digest:
            for function in sent.code.keys() & here.code.keys():
                one, other = sent.code[function], here.code[function]
                if not (one <= other or other <= one):
                    raise different_in_worker(name, f"the code of {function} differs")
            common = sent.values.keys() & here.values.keys()
            differing = sorted(value for value in common if sent.values[value] != here.values[value])
            for file in self.sources.keys() & set(here.files):
                if self.sources[file] != sources[file]:
                    raise different_in_worker(
                        name, f"{', '.join(differing[:5]) or 'a value'} differs, and so does {file}"
                    )
            if compare_values:
                logger.warning(
                    "%s: values in this worker process are not those of the main process: %s. The worker uses its own. "
                    "If the response depends on them, set them where the module defines them, or pass them in the "
                    "function's object",
                    name,
                    ", ".join(differing[:5]) or "those of objects that the function uses",
                )
        _compared.add((sent.digest, compare_values))


def sent_code(code: Any, description: CodeDescription | None = None) -> SentCode:
    """What a worker process compares with its own code.

    Parameters
    ----------
    code : object
        The function.
    description : CodeDescription, optional
        Of the function, without exceptions for objects that have no stable digest.
    """
    description = describe_code(code, strict=False) if description is None else description
    sources = {file: _source(file, again=True) for file in description.files}
    return SentCode(description, {file: digest for file, digest in sources.items() if digest})


def _source(file: str, again: bool) -> bytes:
    """Digest of a source file when it was first seen in this process, or now; empty if it cannot be read."""
    if again or file not in _sources:
        try:
            _sources[file] = blake2b(Path(file).read_bytes(), digest_size=16).digest()
        except OSError:
            _sources[file] = b""
    return _sources[file]


class SentFunction:
    """A function that is compared, in the process that receives it, with the one that was sent.

    Parameters
    ----------
    function : callable
    code : object
        What was fingerprinted: the function, or a part of it.
    sent : SentCode
        The code when the model was made.
    compare_values : bool
        As for `SentCode.compare`.
    """

    def __init__(self, function: Callable, code: Any, sent: SentCode, compare_values: bool) -> None:
        self.function, self.code, self.sent, self.compare_values = function, code, sent, compare_values
        self.__qualname__ = getattr(code, "__qualname__", type(code).__qualname__)  # for messages

    def __repr__(self) -> str:
        return repr(self.function)

    def __call__(self, item: Any) -> Any:
        return self.function(item)

    def __reduce__(self) -> tuple:
        return _receive_function, (self.function, self.code, self.sent, self.compare_values)


def _receive_function(function: Callable, code: Any, sent: SentCode, compare_values: bool) -> SentFunction:
    sent.compare(code, compare_values)
    return SentFunction(function, code, sent, compare_values)


def different_in_worker(name: str, why: str) -> ChangedModel:
    """The error with which a worker process refuses a model."""
    return ChangedModel(
        f"{name} is not the same in the worker process ({why}): its source file was edited, or the worker process has "
        "imported an earlier version. Start a new pool and make the model again"
    )
