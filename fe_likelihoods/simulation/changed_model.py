"""What was fingerprinted is what runs: models that changed later.

A fingerprint is computed when a model is made. Code of the user may use values that change afterwards: an array that is
changed in place, a variable of a module, a file that a program reads. Models with a method ``current_fingerprint()``,
such as `FunctionModel`, can compute it again. It is compared before simulations are stored.
"""

import logging
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .faults import ChangedModel
from .fingerprint import state_of_user

__all__ = [
    "ModelGuard",
    "current_fingerprint",
]

logger = logging.getLogger(__name__)

_SHARE_OF_TIME = 0.01  # for fingerprints that are computed again
_NO_TIME = 5e-5  # [s]; a fingerprint that takes less is always computed again, since storing a row takes longer
_ROWS_PER_REPETITION = 100  # simulations between two repetitions of earlier ones


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
