"""The model of a simulator: whether it is still the same, and which stored simulations are its own.

Results from two states of a model must not be mixed, as when a value is set between two batches or a file is edited. So
fingerprint, code, values and opened files are compared before and after simulations, in about 1 % of the time. User
code may change values itself, such as a counter. Therefore a difference alone is no error: the first and the latest
simulation are repeated, and the model counts as unchanged if the results are the same.
"""

import os
import time
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from ..cache.comparison import VerifyingRun, difference_of, simulate_again
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import VerifiedCache
from ..noise.statistics import Statistic
from ..simulation.by_value import is_arriving
from ..simulation.faults import ChangedModel, TransientReason
from ..simulation.label import ModelLabel
from ..simulation.model import Model

__all__ = ["CheckedModel"]

_SHARE_OF_TIME = 0.01  # for comparisons
_NO_TIME = 5e-5  # [s]; a comparison that takes less is always made, since storing a row takes longer
_FINGERPRINT = "its fingerprint"
_ROWS_PER_REPETITION = 100  # simulations between two repetitions if only items have changed that simulations change
_OF_A_PROCESS = ("environment ", "library", "package ", "python")  # label items that may differ between processes


class CheckedModel:
    """A model's label, the comparisons that show whether the model has changed, and its rows in the cache on disk.

    The label contains the statistic's code. `rows` are verified before they are used, `has_results` says whether
    results are known in this process, and `unchecked` has the parameters (n, n_structural) simulated since the last
    comparison.
    """

    def __init__(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None, pool: Any) -> None:
        self._set_up(model, statistic, cache, pool)

    def _set_up(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None, pool: Any) -> None:
        self._label = ModelLabel(model, statistic)
        self.rows = None if cache is None else VerifiedCache(cache, pool, self._label, model)
        self._known = self.label.items | self.label.opened.items() | {_FINGERPRINT: model.fingerprint}
        self._repeated = 0
        self._begin()

    def _begin(self) -> None:
        self.has_results = False
        self.unchecked: list[np.ndarray] = []
        self._points: list[tuple[np.ndarray, np.ndarray]] = []  # first and latest success: parameters, statistics
        self._not_before, self._last_seconds, self._is_due = -np.inf, np.inf, False
        self._seconds = 0.0  # of simulations since the last comparison
        self._was_sent = False  # from another process, by a pool whose workers import the code

    def __getstate__(self) -> tuple:
        return self.rows, self._label, self._known, self._repeated, os.getpid()

    def __setstate__(self, state: tuple) -> None:
        self.rows, self._label, self._known, self._repeated, pid = state
        self._begin()
        self._was_sent = pid != os.getpid() and not is_arriving()  # by value

    @property
    def label(self) -> ModelLabel:
        """Label of the model; likelihoods that share a trust in rows have one."""
        return self._label if self.rows is None else self.rows.label

    @property
    def compared(self) -> int:
        """Number of earlier simulations that were compared with a new one."""
        return self._repeated + (0 if self.rows is None else self.rows.compared)

    def share_trust(self, other: "CheckedModel") -> None:
        """Trust rows that another simulator has verified or stored, unless its code differs."""
        if self.rows is not None and other.rows is not None:
            self.rows.share_trust(other.rows)

    def before(self, run: VerifyingRun, earlier: Callable[[], list]) -> None:
        """Compare the model before simulations, unless the last comparison was too recent.

        `earlier` returns a known simulation, parameters and statistics, to repeat if this process has run none. Raises
        `ChangedModel`; the simulations at `unchecked` may be from before or after the change.
        """
        if not self._points and not self.has_results:
            start, changed = time.monotonic(), self._changed(run.model, run.fingerprint)
            self._renew(changed)
            if not changed.keys() <= self.label.changing:  # nothing was used yet: the model is labelled as it is now
                self._require_what_was_sent(run.model, changed)
                self._set_up(run.model, run.statistic, None if self.rows is None else self.rows.cache, run.pool)
            self._is_due, self._last_seconds = True, time.monotonic() - start
            return
        self._points = self._points or earlier()
        self._is_due = time.monotonic() >= self._not_before
        if self._is_due:
            self._require_same(run, run.fingerprint)
            pause = max(0.0, 2.0 * self._last_seconds - _NO_TIME) / _SHARE_OF_TIME
            self._not_before = time.monotonic() + pause

    def after(
        self, run: VerifyingRun, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], seconds: float, last: bool
    ) -> bool:
        """Compare the model after simulations, if `before` did and, with a pool, they took long; whether it compared.

        Not while others run (`last` is false). `seconds` is the wall time. Raises `ChangedModel`, as `before`.
        """
        self.unchecked.append(thetas)
        self._seconds += seconds
        here = run.pool is None
        due = self._is_due and last and (here or _SHARE_OF_TIME * self._seconds >= self._last_seconds)
        succeeded = [row for row, reason in enumerate(reasons) if not reason]
        points = [(thetas[row].copy(), misfit[row].copy()) for row in succeeded[:1] + succeeded[-1:]]
        if not here and not self._points:
            self._points = points  # threads share the model, which may have changed itself: these can be repeated
        if due and (here or self._points):
            self._require_same(run, run.model.fingerprint, simulated_here=here)
        if points and (not self.unchecked or not self._points):
            self._points = [(self._points or points)[0], points[-1]]
        return due

    def _require_what_was_sent(self, model: Model, changed: Collection[str]) -> None:
        """Raise `ChangedModel` if this object was pickled in another process, where the code has other values."""
        found = sorted(name for name in set(changed) - self.label.changing if not name.startswith(_OF_A_PROCESS))
        if self._was_sent and found:
            raise ChangedModel(
                f"the {type(model).__name__} in this process is not the one that was sent ({', '.join(found[:3])} "
                "differ): a module that is imported here has other contents or values than where the likelihood was "
                "made. Give the pool to the likelihood, FELikelihood(..., pool=...), which sends code and values, or "
                "make a new likelihood"
            )

    def _changed(self, model: Model, fingerprint: str) -> dict[str, str | None]:
        """Present digests of what has changed, None if it is gone; a file counts from when a simulation opened it."""
        known = self.label.opened.items() | self._known
        now = self.label.present(model) | {_FINGERPRINT: fingerprint}
        return {name: now.get(name) for name in known.keys() | now.keys() if known.get(name) != now.get(name)}

    def _renew(self, changed: Mapping[str, str | None]) -> None:
        # the same objects where nothing has changed, so that pickles stay small
        self._known = {name: digest for name, digest in (self._known | changed).items() if digest is not None}

    def _require_same(self, run: VerifyingRun, fingerprint: str, simulated_here: bool = False) -> None:
        """Raise `ChangedModel` if the model has changed, except for values that it changes itself."""
        start, changed = time.monotonic(), self._changed(run.model, fingerprint)
        self._last_seconds = time.monotonic() - start
        if changed:
            usual = changed.keys() <= self.label.changing
            if usual and self._points and sum(map(len, self.unchecked)) < _ROWS_PER_REPETITION:
                return
            same = _FINGERPRINT not in changed
            if same:  # the first simulation here may have changed values that it uses
                same = self._repeat(run) if self._points else usual or simulated_here
            if not same:
                why = f"different: {', '.join(sorted(changed)[:3])}"
                if self._points and _FINGERPRINT not in changed:
                    why += ", and an earlier simulation gives another result"
                raise ChangedModel(
                    f"the {type(run.model).__name__} has changed since the likelihood was made ({why}): "
                    "a value or file that it uses was changed, or another model was set. Its simulations cannot be "
                    "stored with the earlier ones. Make a new model and a new likelihood; what varies during a run has "
                    "to be a parameter"
                )
            self.label.has_changed_itself(changed)
            self._renew(self._changed(run.model, run.model.fingerprint))
        self.unchecked.clear()
        self._last_seconds, self._seconds = time.monotonic() - start, 0.0

    def _repeat(self, run: VerifyingRun) -> bool:
        """Whether the repeated simulations give the earlier results, or the model is not repeatable."""
        thetas = np.array([theta for theta, _ in self._points])

        def same_as(earlier: list[np.ndarray]) -> tuple[bool, list[np.ndarray]]:
            new = simulate_again(run, thetas)
            self._repeated += len(thetas)
            pairs = zip(earlier, new, strict=True)
            agree = (
                isinstance(n.reason, TransientReason) or not (n.reason or difference_of(e, n, run, run.accepted))
                for e, n in pairs
            )
            return all(agree), [each.misfit for each in new]

        same, repeated = same_as([misfit for _, misfit in self._points])
        return same or not same_as(repeated)[0]
