"""Points that are simulated again when values of a model have changed that its own code may change, such as a counter.

Values of that kind may also have been changed by somebody else. Therefore the first and the latest simulated point of a
likelihood are simulated again, in the same way, and compared with the earlier results.
"""

import time

import numpy as np

from .cache_rows import StoredSimulation
from .disk_cache import SimulationCache
from .faults import TransientReason
from .model import misfit_batch
from .residual_statistics import needs_response
from .tolerance import largest_difference, response_tolerance
from .verification import VerifyingRun

__all__ = ["RepeatedPoints"]


class RepeatedPoints:
    """The first and the latest successful simulation of a likelihood.

    Attributes
    ----------
    compared : int
        Simulations that were compared with an earlier one.
    seconds : float
        Their wall time [s].
    """

    def __init__(self) -> None:
        self._points: list[StoredSimulation] = []
        self.compared, self.seconds = 0, 0.0

    def __getstate__(self) -> dict:
        return self.__dict__ | {"_points": []}

    def add(self, thetas: np.ndarray, misfit: np.ndarray, reasons: list[str], unchanged: bool) -> None:
        """Keep the first and the last success of a batch, the last one only if the model is known to be unchanged.

        Parameters
        ----------
        thetas : (n, n_structural) float
            Structural parameters.
        misfit : (n, n_numbers) float
            Statistics.
        reasons : list of n str
            Reasons of failures; empty where the simulation succeeded.
        unchanged : bool
            Whether the model did not differ at the last comparison.
        """
        succeeded = [row for row, reason in enumerate(reasons) if not reason]
        for row in succeeded[:1] + succeeded[-1:] if unchanged or not self._points else []:
            self._points[1:] = [StoredSimulation(thetas[row].copy(), misfit[row].copy(), "")]

    def agree(self, run: VerifyingRun, cache: SimulationCache | None) -> bool | None:
        """Whether new simulations at these points give the earlier results; None if there are no points.

        A difference does not count if a third simulation differs again: such a model is not repeatable.

        Parameters
        ----------
        run : VerifyingRun
        cache : SimulationCache or None
            Its tolerance applies.
        """
        if not self._points:
            return None
        tolerance = None if cache is None else cache.tolerance
        tolerance = response_tolerance(run.model) if tolerance is None else tolerance
        start = time.perf_counter()
        thetas = np.array([point.theta for point in self._points])

        def simulated() -> list[StoredSimulation]:
            misfit, reasons = misfit_batch(run.model, thetas, run.measured, run.pool, run.statistic)
            self.compared += len(thetas)
            return list(map(StoredSimulation, thetas, misfit, reasons))

        def same(one: list[StoredSimulation], other: list[StoredSimulation]) -> bool:
            return all(_is_same(*pair, run, tolerance) for pair in zip(one, other, strict=True))

        new = simulated()
        result = same(self._points, new) or not same(new, simulated())
        self.seconds += time.perf_counter() - start
        return result


def _is_same(one: StoredSimulation, other: StoredSimulation, run: VerifyingRun, tolerance: float) -> bool:
    if any(isinstance(point.reason, TransientReason) for point in (one, other)):
        return True
    if one.reason or other.reason:
        return bool(one.reason and other.reason)
    of_response = needs_response(run.statistic)
    return largest_difference(one.misfit, other.misfit, run.measured, tolerance, of_response) is None
