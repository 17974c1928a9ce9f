"""The model of a simulator: whether it is still the same, and which stored simulations are its own."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ..cache.comparison import VerifyingRun
from ..cache.guard import EarlierPoint, ModelGuard
from ..cache.simulation_cache import SimulationCache
from ..cache.verification import VerifiedCache
from ..noise.statistics import Statistic
from ..simulation.label import ModelLabel
from ..simulation.model import Model
from ..simulation.opened import Opened

__all__ = ["CheckedModel"]


class CheckedModel:
    """A model's label, the comparisons that show whether the model has changed, and its rows in the cache on disk.

    Parameters
    ----------
    model : Model
    statistic : Statistic or None
        Statistic of the residuals, whose code belongs to the label.
    cache : SimulationCache or None
    pool : executor or None
        Where the simulations run.

    Attributes
    ----------
    rows : VerifiedCache or None
        Rows of the model in the cache on disk, which are verified before they are used.
    has_results : bool
        Whether results of the model are known in this process.
    """

    def __init__(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None, pool: Any) -> None:
        self.has_results = False
        self._begin(model, statistic, cache, pool)

    def _begin(self, model: Model, statistic: Statistic | None, cache: SimulationCache | None, pool: Any) -> None:
        label = ModelLabel(model, statistic)
        self.rows = None if cache is None else VerifiedCache(cache, model, pool, label)
        self._label = label if self.rows is None else self.rows.label  # an equal one, which likelihoods share
        self._guard = ModelGuard(model, self._label)

    def __getstate__(self) -> dict:
        return self.__dict__ | {"has_results": False}

    @property
    def label(self) -> ModelLabel:
        """Label of the model, shared by likelihoods with the same model and file."""
        return self._label if self.rows is None else self.rows.label

    @property
    def compared(self) -> int:
        """Number of earlier simulations that were compared with a new one."""
        return self._guard.compared + (0 if self.rows is None else self.rows.compared)

    @property
    def unchecked(self) -> list[np.ndarray]:
        """Parameters (n, n_structural) of the simulations since the last comparison of the model."""
        return self._guard.unchecked

    def complete(self, opened: Opened | None) -> None:
        """Add the files that simulations opened to the model's label."""
        if self.rows is None:
            self._label.add(opened)
        else:
            self.rows.complete(opened)

    def share_trust(self, other: "CheckedModel") -> None:
        """Trust rows that another simulator has verified or stored, unless its code differs."""
        if self.rows is not None and other.rows is not None:
            self.rows.share_trust(other.rows)

    def before(self, run: VerifyingRun, earlier: Callable[[], list[EarlierPoint]]) -> None:
        """Compare the model before simulations, if that is due.

        Parameters
        ----------
        run : VerifyingRun
        earlier : callable
            Returns a known simulation that can be run again, if the model has run none in this process.

        Raises
        ------
        ChangedModel
            If the model has changed; the simulations at `unchecked` may be from before or after the change.
        """
        self._know_more()
        if not self._guard.points:
            if self.has_results:  # only rows of the disk are known
                self._guard.points += earlier()
            else:
                self._label_again(run)
        self._guard.before(run)

    def after(
        self, run: VerifyingRun, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], seconds: float, last: bool
    ) -> bool:
        """Compare the model after simulations, if that is due; see `ModelGuard.after`."""
        self._know_more()
        return self._guard.after(run, thetas, misfit, reasons, seconds, last)

    def _know_more(self) -> None:
        """Include what later simulations have opened and changed in the comparison."""
        self._guard.known.add(self.label.opened)
        self._guard.changing |= self.label.changing

    def _label_again(self, run: VerifyingRun) -> None:
        """Label the model as it is now, if it has changed since the likelihood was made and nothing was used yet."""
        if self._guard.known.changed(run.model) <= self._guard.changing:
            self._guard.known.renew(run.model)
        else:
            cache = None if self.rows is None else self.rows.cache
            self._begin(run.model, run.statistic, cache, run.pool)
