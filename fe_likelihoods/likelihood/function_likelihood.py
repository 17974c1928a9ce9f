"""Log-likelihood of one's own, without a model: for priors, samplers, reports and clients of this package."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from samplers.interrupts import raise_if_it_ends_the_run

from ..priors.points import as_points
from ..simulation.failure_reasons import reason_of
from ..simulation.label import items_of
from .failure_log import FailureLog
from .parameters import Parameter, parameter_of
from .sum_of_data_sets import COUNTS, SumOfDataSets

__all__ = ["FunctionLikelihood"]


class FunctionLikelihood(SumOfDataSets):
    """Any log-likelihood of named parameters, as a likelihood of a `Posterior`.

    Samplers, `to_arviz`, tables, figures and the adapters take the posterior. What needs a model or its responses does
    not: guides, `Posterior.mode`, predictions and the report of a run.

    Parameters
    ----------
    function : callable
        ``function(theta) -> float``, or ``function(thetas) -> (n,)`` with `vectorize`. NaN, inf and exceptions are
        failures, counted with their parameters: the log-likelihood is -inf there. -inf is no failure.
    parameter_names : sequence of str
        Names of the parameters in theta.
    vectorize : bool
        Whether the function takes points (n, ndim), as in emcee.

    Attributes
    ----------
    parameter_units, nominal, nominal_units : dict of str to str, float and str
        To be set for labels, by the name of the parameter, as those of a model: units of the samples in words, and
        nominal values [SI] of which samples are multiples, with the units in which these are shown.

    Raises
    ------
    ValueError
        If the function cannot be called, or the names are missing, repeated or not text.

    Examples
    --------
    >>> own = FunctionLikelihood(lambda theta: -0.5 * np.sum((theta - 1.0) ** 2), ["k", "c"])
    >>> both = Posterior(own, {"k": LogNormal(1.0, 0.3), "c": LogNormal(1.0, 0.3)})
    >>> own.parameter_units = {"k": "kN/m"}
    >>> [parameter.label for parameter in both.parameters]
    ['k [kN/m]', 'c']
    """

    fast_parameters = ()
    likelihoods = {}

    def __init__(
        self,
        function: Callable,
        parameter_names: Sequence[str],
        vectorize: bool = False,
    ) -> None:
        names = () if isinstance(parameter_names, str) else tuple(parameter_names)
        if not callable(function):
            raise ValueError(f"FunctionLikelihood: expected a function of the parameters; got {function!r}")
        if not names or len(set(names)) != len(names) or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"FunctionLikelihood: expected different names of parameters; got {parameter_names!r}")
        self.function, self.parameter_names, self.vectorize = function, names, vectorize
        self.parameter_units, self.nominal, self.nominal_units = {}, {}, {}
        self._failures = FailureLog(names)
        self._evaluations = 0

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Names, units and nominal values of the parameters."""
        return tuple(parameter_of(self, name) for name in self.parameter_names)

    def log_likelihood(self, x: Any, inside: Any = True) -> np.ndarray | float:
        """Log-likelihood (n,) of points (n, ndim), or a float; -inf where the function fails and not `inside`."""
        points = as_points(x, self.parameter_names)
        rows = np.atleast_2d(points)
        total = np.full(len(rows), -np.inf)
        left = np.flatnonzero(np.isfinite(rows).all(axis=1) & inside)
        if len(left):
            self._evaluations += len(left)
            total[left] = self._evaluated(rows[left])
        return total if points.ndim == 2 else float(total[0])

    def _evaluated(self, rows: np.ndarray) -> np.ndarray:
        """Values (n,) of rows (n, ndim); failures are counted."""
        values, reasons = np.full(len(rows), -np.inf), [""] * len(rows)
        for where in [slice(None)] if self.vectorize else range(len(rows)):
            try:
                values[where] = self.function(rows[where].copy())
            except Exception as error:
                raise_if_it_ends_the_run(error)
                if self.vectorize:  # one of them failed: not known which
                    raise
                reasons[where] = str(reason_of(error))
        for row in np.flatnonzero(np.isnan(values) | (values == np.inf)):
            reasons[row], values[row] = f"the log-likelihood is {values[row]}", -np.inf
        self._failures.count_outcomes(rows, reasons)
        return values

    def failures_at(self, x: Any) -> list[str]:
        """Reasons of failures at points evaluated in this process."""
        return [self._failures.reason_at(row) for row in np.atleast_2d(as_points(x, self.parameter_names))]

    def recall_failures(self, x: Any, reasons: Sequence[str]) -> None:
        """Count failures of an earlier process, see `Posterior.recall_failures`."""
        self._failures.count_outcomes(np.atleast_2d(as_points(x, self.parameter_names)), reasons)

    def possible(self, rows: np.ndarray) -> np.ndarray:
        """Whether each of the points (n, ndim) is finite."""
        return np.isfinite(rows).all(axis=1)

    def density_parts(self) -> list[str]:
        """Texts that identify the density: names, and code and values of the function."""
        items = items_of({"function": self.function})
        return [*self.parameter_names, *(f"{name} {digest}" for name, digest in sorted(items.items()))]

    def report(self) -> dict:
        """Counts of evaluations and failures, see `Posterior.report`."""
        return dict.fromkeys(COUNTS, 0) | {"simulations": self._evaluations} | self._failures.report()
