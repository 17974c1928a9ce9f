"""The model of a simulator: whether it is still the same, and which stored simulations are its own.

Results from two states of a model must not be mixed, as when a value is set between two batches or a file is edited. So
fingerprint, code, values and opened files are compared after simulations, in about 1 % of the time. User code may
change values itself, such as a counter. Therefore a difference alone is no error: the first and the latest simulation
are repeated, and the model counts as unchanged if the results are the same.
"""

import os
import time
from collections.abc import Callable

import numpy as np

from ..cache.comparison import VerifyingRun, difference_in_words, simulate_again
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

    def __init__(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None) -> None:
        self._set_up(model, statistic, cache)

    def _set_up(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None) -> None:
        self._label = ModelLabel(model, statistic)
        self.rows = None if cache is None else VerifiedCache(cache, self._label)
        self._known: dict[str, str | None] = self.label.items | {_FINGERPRINT: model.fingerprint}
        self._repeated = 0
        self._begin()

    def _begin(self) -> None:
        self.has_results = False
        self.unchecked: list[np.ndarray] = []
        self._points: list[tuple[np.ndarray, np.ndarray]] = []  # first and latest success: parameters, statistics
        self._not_before = 0.0  # time of the next comparison [s]
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

    def before(self, run: VerifyingRun) -> None:
        """Label the model as it is now, if nothing was simulated or used yet.

        Raises `ChangedModel` if this object was pickled in another process, where the code has other values.
        """
        if self._points or self.has_results:
            return
        changed = self._changed(run) - self.label.changing
        found = sorted(name for name in changed if not name.startswith(_OF_A_PROCESS))
        if self._was_sent and found:
            raise ChangedModel(
                f"the {type(run.model).__name__} in this process is not the one that was sent ({', '.join(found[:3])} "
                "differ): a module that is imported here has other contents or values than where the likelihood was "
                "made. Give the pool to the likelihood, FELikelihood(..., pool=...), which sends code and values, or "
                "make a new likelihood"
            )
        if changed:
            self._set_up(run.model, run.statistic, None if self.rows is None else self.rows.cache)

    def after(
        self,
        run: VerifyingRun,
        thetas: np.ndarray,
        misfit: np.ndarray,
        reasons: list[str],
        earlier: Callable[[], list[tuple[np.ndarray, np.ndarray]]],
    ) -> None:
        """Compare the model after simulations, unless the last comparison was too recent.

        `earlier` returns a known simulation, parameters and statistics, to repeat if this object has seen none. Raises
        `ChangedModel`; the simulations at `unchecked` may be from before or after the change.
        """
        self.unchecked.append(thetas)
        succeeded = [row for row, reason in enumerate(reasons) if not reason]
        points = [(thetas[row].copy(), misfit[row].copy()) for row in succeeded[:1] + succeeded[-1:]]
        known = self._points or earlier()
        self._points = (known or points)[:1] + points[-1:]
        if self._points and time.monotonic() >= self._not_before:
            start = time.monotonic()
            self._require_same(run, is_first=not known and run.pool is None)
            now = time.monotonic()
            self._not_before = now + max(0.0, now - start - _NO_TIME) / _SHARE_OF_TIME

    def _changed(self, run: VerifyingRun) -> set[str]:
        """Names of what has changed; a file counts from when a simulation opened it."""
        known = self.label.opened.items() | self._known
        now = self.label.present(run.model) | {_FINGERPRINT: run.model.fingerprint}
        return {name for name in known.keys() | now.keys() if known.get(name) != now.get(name)}

    def _require_same(self, run: VerifyingRun, is_first: bool) -> None:
        """Raise `ChangedModel` if the model has changed, except for values that it changes itself, as the first may."""
        changed = self._changed(run)
        if changed:
            if changed <= self.label.changing and sum(map(len, self.unchecked)) < _ROWS_PER_REPETITION:
                return
            is_other = _FINGERPRINT in changed
            if is_other or not (is_first or self._repeats(run)):
                why = f"different: {', '.join(sorted(changed)[:3])}"
                why += "" if is_other else ", and an earlier simulation gives another result"
                raise ChangedModel(
                    f"the {type(run.model).__name__} has changed since the likelihood was made ({why}): "
                    "a value or file that it uses was changed, or another model was set. Its simulations cannot be "
                    "stored with the earlier ones. Make a new model and a new likelihood; what varies during a run has "
                    "to be a parameter"
                )
            self.label.has_changed_itself(changed)
            now = self.label.present(run.model)
            # the same objects where nothing has changed, so that pickles stay small
            self._known |= {name: now.get(name) for name in changed}
        self.unchecked.clear()

    def _repeats(self, run: VerifyingRun) -> bool:
        """Whether the repeated simulations give the earlier results, or the model is not repeatable."""
        thetas = np.array([theta for theta, _ in self._points])

        def same_as(earlier: list[np.ndarray]) -> tuple[bool, list[np.ndarray]]:
            new = simulate_again(run, thetas, self.label)
            self._repeated += len(thetas)
            return all(
                isinstance(each.reason, TransientReason) or not difference_in_words(before, "", each, run)[0]
                for before, each in zip(earlier, new, strict=True)
            ), [each.misfit for each in new]

        same, repeated = same_as([misfit for _, misfit in self._points])
        return same or not same_as(repeated)[0]
