"""Detects models that change while they are used, as when a value is set between two batches or a file is edited.

Results from two states of a model must not be mixed, neither in memory nor on disk. So the model's label
(`fe_likelihoods.simulation.label`) and fingerprint are compared before and after simulations, in about 1 % of the time.
User code may change values itself, such as a counter or a table of earlier results. Therefore a difference alone is no
error: the first and the latest simulation are repeated, and the model counts as unchanged if the results are the same.
"""

import copy
import time
from typing import NamedTuple

import numpy as np

from ..simulation.faults import ChangedModel
from ..simulation.label import ModelLabel
from ..simulation.model import Model
from .comparison import VerifyingRun, difference_of, is_transient, response_tolerance, simulate_again

__all__ = ["EarlierPoint", "ModelGuard"]

_SHARE_OF_TIME = 0.01  # for comparisons
_NO_TIME = 5e-5  # [s]; a comparison that takes less is always made, since storing a row takes longer
_ROWS_PER_REPETITION = 100  # simulations between two repetitions if only `changing` items have changed


class EarlierPoint(NamedTuple):
    """A simulation that may be repeated."""

    theta: np.ndarray
    misfit: np.ndarray


class ModelGuard:
    """Compares a model with its state at the start.

    Parameters
    ----------
    model : Model
    label : ModelLabel
        Label of the model.

    Attributes
    ----------
    known : ModelLabel
        Label that the model is compared with.
    points : list of EarlierPoint
        The first and the latest successful simulation.
    changing : set of str
        Label items that have changed without an effect on results.
    unchecked : list of (n, n_structural) ndarray
        Parameters simulated since the last comparison.
    compared : int
        Simulations that were repeated.
    """

    def __init__(self, model: Model, label: ModelLabel) -> None:
        self._fingerprint = model.fingerprint
        self.known = copy.copy(label)  # a copy, because the label of stored rows never changes
        self.changing: set[str] = label.changing
        self.compared = 0
        self._begin()

    def _begin(self) -> None:
        self.points: list[EarlierPoint] = []
        self.unchecked: list[np.ndarray] = []
        self._rows_since = 0  # since the last repetition
        self._not_before, self._last_seconds, self._is_due = -np.inf, np.inf, False

    def __getstate__(self) -> tuple:
        return self._fingerprint, self.known, self.changing, self.compared

    def __setstate__(self, state: tuple) -> None:
        self._fingerprint, self.known, self.changing, self.compared = state
        self._begin()

    def before(self, run: VerifyingRun) -> None:
        """Compare before simulations, unless the last comparison was too recent.

        Raises
        ------
        ChangedModel
            If the model has changed; the simulations at `unchecked` may come from either state.
        """
        self._is_due = time.monotonic() >= self._not_before
        if self._is_due:
            self._require_same(run)
            pause = max(0.0, 2.0 * self._last_seconds - _NO_TIME) / _SHARE_OF_TIME
            self._not_before = time.monotonic() + pause

    def after(
        self,
        run: VerifyingRun,
        thetas: np.ndarray,
        misfit: np.ndarray,
        reasons: list[str],
        seconds: float,
        last: bool = True,
    ) -> bool:
        """Compare after simulations if `before` compared and, with a pool, they took long; return whether it compared.

        Parameters
        ----------
        run : VerifyingRun
        thetas : (n, n_structural) float
            Structural parameters.
        misfit : (n, n_numbers) float
            Statistics.
        reasons : list of n str
            Reasons of failures; empty where the simulation succeeded.
        seconds : float
            Wall time [s]; with a pool that runs without interruption, the time since the last comparison.
        last : bool
            Whether no other simulations run. If others run, the model is not compared now.

        Raises
        ------
        ChangedModel
            As for `before`.
        """
        self.unchecked.append(thetas)
        self._rows_since += len(thetas)
        here = run.pool is None
        due = self._is_due and last and (here or _SHARE_OF_TIME * seconds >= self._last_seconds)
        if due:
            self._require_same(run, simulated_here=here)
        succeeded = [row for row, reason in enumerate(reasons) if not reason]
        for row in succeeded[:1] + succeeded[-1:] if not self.unchecked or not self.points else []:
            self.points[1:] = [EarlierPoint(thetas[row].copy(), misfit[row].copy())]
        return due

    def _require_same(self, run: VerifyingRun, simulated_here: bool = False) -> None:
        """Raise `ChangedModel` if the model has changed, except for values that it changes itself."""
        start = time.monotonic()
        same_fingerprint = run.model.fingerprint == self._fingerprint
        changed = self.known.changed(run.model)
        self._last_seconds = time.monotonic() - start
        if same_fingerprint and not changed:
            self.unchecked.clear()
            return
        if same_fingerprint:
            if not self.points and simulated_here:  # the first simulation has changed values that it uses
                self._accept(run.model, changed)
                return
            if changed <= self.changing and (not self.points or self._rows_since < _ROWS_PER_REPETITION):
                return
            if self.points and self._repeat(run):
                self._accept(run.model, changed)
                return
        why = "its fingerprint differs"
        if same_fingerprint:
            why = f"different: {', '.join(sorted(changed)[:3])}"
            why += ", and an earlier simulation gives another result" if self.points else ""
        raise ChangedModel(
            f"the {type(run.model).__name__} has changed since the likelihood was made ({why}): "
            "a value or file that it uses was changed, or another model was set. Its simulations cannot be stored with "
            "the earlier ones. Make a new model and a new likelihood; what varies during a run has to be a parameter"
        )

    def _accept(self, model: Model, changed: set[str]) -> None:
        self.changing |= changed
        self.known.has_changed_itself(changed)
        self.known.renew(model)
        self._rows_since = 0
        self.unchecked.clear()

    def _repeat(self, run: VerifyingRun) -> bool:
        """Whether the repeated simulations give the earlier results, or the model is not repeatable."""
        thetas = np.array([point.theta for point in self.points])

        tolerance = response_tolerance(run.model) if run.tolerance is None else run.tolerance

        def same(earlier: list[np.ndarray]) -> tuple[bool, list[np.ndarray]]:
            new = simulate_again(run, thetas)
            self.compared += len(thetas)
            return all(
                is_transient(other.reason) or (not other.reason and not difference_of(one, other, run, tolerance))
                for one, other in zip(earlier, new, strict=True)
            ), [other.misfit for other in new]

        agrees, new = same([point.misfit for point in self.points])
        agrees = agrees or not same(new)[0]
        return agrees
