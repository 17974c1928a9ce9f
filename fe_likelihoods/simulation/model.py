"""What a structural model is, and how a batch of its simulations is run.

A model is any object with named parameters, named channels and a method `simulate` that turns one set of parameters
into one response. It says that a simulation cannot be done by raising `SimulationFailed`. Nothing has to be inherited.

Samplers ask for many parameter sets at once. `simulate_batch` and `misfit_batch` answer with the model's own batch
methods where it has them (compiled kernels that share work or threads), else set by set; through a pool, if there is
one, always set by set. They never raise for a simulation that goes wrong: whatever happens to one set of parameters (an
exception, a response that is not finite or has a wrong shape) becomes a reason in words beside a row of NaN, and leaves
the other rows alone.
"""

import logging
import re
from collections.abc import Callable
from functools import partial
from itertools import cycle
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..signals.channels import Channel

__all__ = [
    "MisfitBatch",
    "Model",
    "SimulationBatch",
    "SimulationFailed",
    "Statistic",
    "has_batch_method",
    "misfit_batch",
    "misfit_of_responses",
    "simulate_batch",
    "split_seconds",
]

logger = logging.getLogger(__name__)

Statistic = Callable[[np.ndarray], np.ndarray]
"""Residuals (n_channels, n_steps) to numbers (n_numbers,), the first n_channels of them the sums of squares.

A function of a module, so that it can be sent to workers.
"""

_RESPONSE_VALUES = 2**23  # responses held at once where only their misfit is wanted: 64 MiB


class SimulationFailed(RuntimeError):
    """A simulation that could not be done, for a reason in words (attribute `reason`).

    A reason may end in how long it took, " after 12.3 s": this is told apart (see `split_seconds`).
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = str(reason) or "no reason given"


def split_seconds(reason: str) -> tuple[str, float | None]:
    """A reason without its duration at the end, " after 12.3 s", and the duration [s], None where there is none."""
    found = re.fullmatch(r"(.+) after ([0-9.]+(?:e[-+]?[0-9]+)?) s", reason, re.DOTALL)
    return (found[1], float(found[2])) if found else (reason, None)


class SimulationBatch(NamedTuple):
    """Responses of a batch of parameter sets.

    response : (n, n_channels, n_steps) float, SI; rows of failures are NaN
    reasons : n strings, empty where the simulation succeeded
    """

    response: np.ndarray
    reasons: list[str]


class MisfitBatch(NamedTuple):
    """Misfits of a batch of parameter sets.

    misfit : (n, n_channels) float, sums of squared residuals [SI unit of the channel, squared]; NaN in failed rows.
        Where another statistic of the residuals was asked for, (n, n_numbers)

    reasons : n strings, empty where the simulation succeeded
    """

    misfit: np.ndarray
    reasons: list[str]


class Model(Protocol):
    """What a likelihood needs of a model.

    It may also have ``simulate_batch(thetas) -> SimulationBatch`` and
    ``misfit_batch(thetas, measured) -> MisfitBatch``, which must give for each row what `simulate` gives; and
    ``with_record(record)``, the same model under another excitation, for predictions.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the structural parameters: multiples of nominal values, or SI."""

    @property
    def channels(self) -> tuple[Channel, ...]:
        """What the rows of the response are."""

    @property
    def dt(self) -> float:
        """Time step of the response [s]."""

    @property
    def n_steps(self) -> int:
        """Number of samples of the response."""

    @property
    def fingerprint(self) -> str:
        """Text that changes with anything that changes a response."""

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] at the parameters (n_parameters,); raises `SimulationFailed`."""


def has_batch_method(model: Model) -> bool:
    """Whether a model has a batch method of its own."""
    return hasattr(model, "misfit_batch") or hasattr(model, "simulate_batch")


def simulate_batch(model: Model, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
    """Responses at many parameter sets.

    Parameters
    ----------
    model : Model
    thetas : (n, n_parameters) float
    pool : object with ``map(function, items)``, optional
        Runs the simulations one by one, also where the model has a batch method (which stays in this process); the
        results do not depend on it.

    Returns
    -------
    SimulationBatch
    """
    shape = (len(model.channels), model.n_steps)
    whole = getattr(model, "simulate_batch", None) if pool is None else None
    if whole is not None:
        batch = _run_whole(model, partial(whole, thetas), (len(thetas), *shape))
        if batch is not None:
            return SimulationBatch(*batch)
    return SimulationBatch(*_run_each(_response, model, thetas, shape, pool))


def misfit_batch(
    model: Model, thetas: np.ndarray, measured: np.ndarray, pool: Any = None, statistic: Statistic | None = None
) -> MisfitBatch:
    """Sums of squared residuals, or another statistic of them, at many parameter sets; no response is kept.

    Parameters
    ----------
    model : Model
    thetas : (n, n_parameters) float
    measured : (n_channels, n_steps) float
        Measured response [SI].
    pool : object with ``map(function, items)``, optional
        Runs the simulations one by one, also where the model has a batch method (which stays in this process); the
        results do not depend on it.
    statistic : Statistic, optional
        What is taken of the residuals instead; a model's own ``misfit_batch`` cannot give it and is passed by.

    Returns
    -------
    MisfitBatch
    """
    reduce = _sums_of_squares if statistic is None else statistic
    shape = (len(reduce(measured)),)
    whole = getattr(model, "misfit_batch", None) if pool is None and statistic is None else None
    if whole is not None:
        whole = partial(whole, thetas, measured)
    elif pool is None and hasattr(model, "simulate_batch"):
        whole = partial(_misfit_from_responses, model, thetas, measured, reduce)
    if whole is not None:
        batch = _run_whole(model, whole, (len(thetas), *shape))
        if batch is not None:
            return MisfitBatch(*batch)
    return MisfitBatch(*_run_each(partial(_misfit, measured, reduce), model, thetas, shape, pool))


def misfit_of_responses(
    model: Model, batch: SimulationBatch, measured: np.ndarray, statistic: Statistic | None = None
) -> MisfitBatch:
    """Sums of squared residuals, or another statistic, of responses against `measured` (n_channels, n_steps)."""
    reduce = _sums_of_squares if statistic is None else statistic
    rows = [_reduced(response, measured, reduce) for response in batch.response]
    misfit = np.reshape(rows, (len(rows), len(reduce(measured))))
    reasons = [reason or _not_finite(model, row) for row, reason in zip(misfit, batch.reasons, strict=True)]
    misfit[[bool(reason) for reason in reasons]] = np.nan
    return MisfitBatch(misfit, reasons)


def _sums_of_squares(residuals: np.ndarray) -> np.ndarray:
    return np.square(residuals).sum(axis=-1)


def _reduced(response: np.ndarray, measured: np.ndarray, reduce: Statistic) -> np.ndarray:
    # contiguous rows: the order of summation, hence the last bit, must not depend on who made the array
    residuals = np.ascontiguousarray(response - measured)
    with np.errstate(over="ignore", invalid="ignore"):
        return reduce(residuals)


def _misfit_from_responses(model: Model, thetas: np.ndarray, measured: np.ndarray, reduce: Statistic) -> MisfitBatch:
    misfits, reasons = [], []
    rows = max(1, _RESPONSE_VALUES // measured.size)
    for start in range(0, len(thetas), rows):
        batch = simulate_batch(model, thetas[start : start + rows])
        misfits += [_reduced(response, measured, reduce) for response in batch.response]
        reasons += batch.reasons
    return MisfitBatch(np.reshape(misfits, (len(thetas), len(reduce(measured)))), reasons)


def _response(model: Model, theta: np.ndarray) -> np.ndarray:
    response = np.asarray(model.simulate(theta.copy()), dtype=float)
    expected = (len(model.channels), model.n_steps)
    if response.shape != expected:
        raise SimulationFailed(f"the response has shape {response.shape}, expected (n_channels, n_steps) = {expected}")
    return response


def _misfit(measured: np.ndarray, reduce: Statistic, model: Model, theta: np.ndarray) -> np.ndarray:
    return _reduced(_response(model, theta), measured, reduce)


def _not_finite(model: Model, values: np.ndarray) -> str:
    """Reason why one row of responses or misfits is not usable, or an empty string."""
    for channel, value in zip(cycle(model.channels), values, strict=False):  # several numbers a channel go round
        if not np.isfinite(value).all():
            what = "response" if value.ndim else "misfit"
            return f"the {what} of channel {channel.name!r} is not finite"
    return ""


def _attempt(
    run: Callable[[Model, np.ndarray], np.ndarray], model: Model, theta: np.ndarray
) -> tuple[np.ndarray | None, str]:
    """One simulation: its result and an empty reason, or None and the reason. Runs in the worker."""
    try:
        result = run(model, theta)
    except SimulationFailed as error:
        return None, error.reason
    except Exception as error:  # a black box may raise anything; KeyboardInterrupt is no Exception and passes
        return None, f"{type(error).__name__}: {error}"
    reason = _not_finite(model, result)
    return (None, reason) if reason else (result, "")


def _run_each(
    run: Callable[[Model, np.ndarray], np.ndarray], model: Model, thetas: np.ndarray, shape: tuple[int, ...], pool: Any
) -> tuple[np.ndarray, list[str]]:
    """Simulate set by set, in this process or in the pool's workers."""
    attempt = partial(_attempt, run, model)
    outcomes = list(map(attempt, thetas) if pool is None else pool.map(attempt, list(thetas)))
    values = np.full((len(thetas), *shape), np.nan)
    for row, (result, _) in zip(values, outcomes, strict=True):
        if result is not None:
            row[...] = result
    return values, [reason for _, reason in outcomes]


def _run_whole(
    model: Model, method: Callable[[], tuple], shape: tuple[int, ...]
) -> tuple[np.ndarray, list[str]] | None:
    """Results of a model's own batch method, or None if it broke as a whole and the sets must be run one by one."""
    try:
        values, reasons = method()
        values, reasons = np.array(values, dtype=float), [str(reason) for reason in reasons]
        if values.shape != shape or len(reasons) != shape[0]:
            raise ValueError(
                f"expected values of shape {shape} and {shape[0]} reasons, got {values.shape} and {len(reasons)}"
            )
    except Exception as error:  # one bad set must not take the others with it
        logger.warning(
            "a batch method of %s broke, its sets are run one by one: %s: %s",
            type(model).__name__,
            type(error).__name__,
            error,
        )
        return None
    for row in np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))):
        reasons[row] = reasons[row] or _not_finite(model, values[row])
    values[[bool(reason) for reason in reasons]] = np.nan
    return values, reasons
