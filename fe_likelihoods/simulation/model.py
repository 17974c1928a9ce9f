"""Protocol of a structural model, and functions that run a batch of its simulations.

`simulate_batch` uses the model's own method of this name if it has one (compiled kernels that share work or threads);
otherwise, and always with a pool, the sets are run one by one. A failing simulation never raises here: an exception, or
a response that is not finite or has a wrong shape, becomes a reason in words and a row of NaN. Ctrl-C and ``sys.exit``
are no failures.
"""

import logging
import sys
from collections.abc import Callable, Sequence
from functools import partial
from itertools import cycle
from typing import Any, NamedTuple, Protocol

import numpy as np

from samplers.interrupts import (
    interrupts,
    interrupts_end_the_run,
    is_worker,
    raise_if_interrupted,
    raise_if_it_ends_the_run,
)

from ..noise.sufficient_statistics import Statistic, reduce_response, statistic_width, sums_of_squares
from ..signals.channels import Channel, Comparison
from .failure_reasons import MisfitReason, SimulationFailed, is_transient, reason_of, shortened
from .files import Observed, Opened, note, working_folder

__all__ = [
    "Model",
    "SimulationBatch",
    "SimulationFailed",
    "derivatives_batch",
    "first_part",
    "gathered",
    "has_jacobian",
    "misfit_of_responses",
    "most_responses",
    "not_finite",
    "real_response",
    "run_each",
    "sent_simulation",
    "simulate_batch",
    "unpack",
]

logger = logging.getLogger(__name__)

_RESPONSE_VALUES = 2**23  # largest number of response values in memory at once: 64 MiB


class SimulationBatch(NamedTuple):
    """Responses for several parameter sets."""

    response: np.ndarray  # (n, n_channels, n_steps) [SI]; NaN where the simulation failed
    reasons: list[str]  # of n failures; empty for successes


class Model(Protocol):
    """What a likelihood needs of a model.

    A model may also have ``simulate_batch(thetas) -> SimulationBatch``, whose rows must be the results of `simulate`,
    and ``with_record(record)``, which returns the same model under another excitation, for predictions. A part of a
    model with several responses has ``simulate_together(thetas, pool)`` (`fe_likelihoods.models.one_run`). An attribute
    ``time_limit`` is the largest duration of a simulation [s], or None. An attribute ``path_dependent`` is False if the
    response to an excitation does not depend on earlier excitations. Some predictions start from the end of the model's
    excitation. They need a `Record` in the attribute ``record``, with one response sample per sample of the record, or
    a method ``followed_by(record, rest)``. It returns the same model under its excitation, a pause of ``rest`` seconds
    and the new record, whose samples must be the last samples of the response.

    With ``first(seconds)`` a model can be shortened, for searches that start with a short part of the record. It
    returns the same model under the first part of its excitation, with a different fingerprint. The response of the
    short model must equal the first samples of the full response, up to and including the given sample time [s]. A
    model with ``with_record`` and a `Record` in the attribute ``record`` can be shortened without this method
    (`first_part`).

    With ``jacobian(theta) -> (n_parameters, n_channels, n_steps)``, the derivatives of the response [SI] by the
    structural parameters, a guide needs no differences. Each call counts as one simulation of the guide, whatever it
    costs; it is not cached. A shortened model has its own.

    Tables and figures use ``nominal``, the nominal values [SI] by parameter name, where parameters are multiples of
    nominal values; ``nominal_units`` with their units; and ``parameter_units`` with the units of other parameters, in
    words (`fe_likelihoods.likelihood.parameters.describe_parameters`).

    Examples
    --------
    >>> class Pulse:
    ...     parameter_names, channels, dt, n_steps = ("amplitude",), model.channels[1:], 0.05, 200
    ...     fingerprint = "pulse, version 1"
    ...     def simulate(self, theta):
    ...         return theta[0] * np.exp(-time)[np.newaxis]
    >>> own = FELikelihood(Pulse(), measurements.select(["displacement"]))
    >>> own.parameter_names
    ('amplitude', 'sigma_displacement')
    """

    parameter_names: tuple[str, ...]  #: names of the structural parameters: multiples of nominal values, or SI
    channels: tuple[Channel, ...]  #: of the response, one per row
    dt: float  #: time step of the response [s]
    n_steps: int  #: samples of the response
    fingerprint: str  #: differs between models with different responses

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] for parameters (n_parameters,); may raise `SimulationFailed`."""


def has_jacobian(model: Model) -> bool:
    """Whether a model knows the derivatives of its response."""
    return getattr(model, "jacobian", None) is not None


def most_responses(model: Model) -> int:
    """Number of responses that are in memory at once where many are simulated one part after the other."""
    return max(1, _RESPONSE_VALUES // (len(model.channels) * model.n_steps))


def first_part(model: Model, seconds: float) -> Model:
    """The same model under the first part of its excitation, up to the sample time `seconds` [s].

    By the model's method ``first(seconds)``, or by ``with_record`` and a `Record` in its attribute ``record``.
    ValueError if the model has none of these methods, or the time is not within its response.
    """
    if hasattr(model, "first"):
        return model.first(seconds)
    record = getattr(model, "record", None)
    if hasattr(model, "with_record") and hasattr(record, "trim"):
        return model.with_record(record.trim(0.0, seconds))
    raise ValueError(
        f"{type(model).__name__} cannot be shortened: it needs a method first(seconds) that returns the same model "
        "under the first part of its excitation, or a method with_record(record) and its Record in the attribute record"
    )


def simulate_batch(model: Model, thetas: np.ndarray, pool: Any = None) -> SimulationBatch:
    """Responses for many parameter sets (n, n_parameters), the same for every pool to the last bit.

    A pool runs the simulations one by one, even if the model has a batch method (which would run in this process).
    """
    with interrupts_end_the_run():  # not as a decorator, which would be one more frame
        shape = (len(model.channels), model.n_steps)
        if getattr(model, "simulate_together", None) is not None:
            return model.simulate_together(thetas, pool)
        if pool is None and hasattr(model, "simulate_batch"):
            before, known = sys.exception(), interrupts()
            try:
                batch = SimulationBatch(*_checked_batch(model, model.simulate_batch(thetas), (len(thetas), *shape)))
                raise_if_interrupted(known)
                return batch
            except BaseException as error:  # which must not make all parameter sets fail
                raise_if_it_ends_the_run(error, before)
                text = "A batch method of %s failed; its parameter sets are run one by one: %s: %s"
                logger.warning(text, type(model).__name__, type(error).__name__, error)
        return SimulationBatch(*run_each(sent_simulation(model), thetas, shape, pool))


@interrupts_end_the_run()
def derivatives_batch(model: Model, thetas: np.ndarray, pool: Any = None) -> np.ndarray:
    """Derivatives (n, n_parameters, n_channels, n_steps) of the responses, from the model's own ``jacobian``.

    ValueError if ``jacobian`` fails, or returns an array of another shape, or one that is not real or not finite.
    """
    shape = (len(model.parameter_names), len(model.channels), model.n_steps)
    values, reasons = run_each(partial(_attempt, partial(_derivatives, shape), model), thetas, shape, pool)
    for theta, reason in zip(thetas, reasons, strict=True):
        if reason:
            named = ", ".join(f"{name} = {x:.6g}" for name, x in zip(model.parameter_names, theta, strict=True))
            raise ValueError(
                f"expected {type(model).__name__}.jacobian to return finite derivatives of the response by the "
                f"parameters, of shape (n_parameters, n_channels, n_steps) = {shape}; got {reason}, at {named}: "
                "correct it, or leave it out"
            )
    return values


def _derivatives(shape: tuple[int, int, int], model: Any, theta: np.ndarray) -> np.ndarray:
    """Derivatives (n_parameters, n_channels, n_steps) of one response; `SimulationFailed` if they cannot be used."""
    values = np.asarray(model.jacobian(theta.copy()))
    if values.shape != shape or values.dtype.kind not in "fiu":
        raise SimulationFailed(f"the shape {values.shape} and the type {values.dtype}")
    if bad := [name for name, rows in zip(model.parameter_names, values, strict=True) if not np.isfinite(rows).all()]:
        raise SimulationFailed(f"values that are not finite for {', '.join(bad)}")
    return values


def sent_simulation(
    model: Model, measured: np.ndarray | Comparison | None = None, statistic: Statistic | None = None
) -> Callable[[np.ndarray], tuple[np.ndarray | None, str]]:
    """A function that runs one simulation, in this process or in a pool's worker.

    It takes parameters (n_parameters,) and returns the result with an empty reason, or None and the reason of a
    failure. The result is the statistic of the residuals, by default their sums of squares, or the response without
    `measured` (n_channels, n_steps) [SI].
    """
    run = _response if measured is None else partial(_misfit, measured, statistic or sums_of_squares)
    return partial(_attempt, run, model)


def misfit_of_responses(
    model: Model, batch: SimulationBatch, measured: np.ndarray | Comparison, statistic: Statistic | None = None
) -> tuple[np.ndarray, list[str]]:
    """Statistics (n, n_numbers) of given responses, NaN for failures, and reasons; as from `sent_simulation`."""
    outcomes = [
        (None, reason)
        if reason
        else _attempt(partial(_reduced, measured, statistic or sums_of_squares), model, response)
        for response, reason in zip(*batch, strict=True)
    ]
    return gathered(outcomes, (statistic_width(measured, statistic),))


def _response(model: Model, theta: np.ndarray) -> np.ndarray:
    """Response of one simulation; `SimulationFailed` if it has a wrong shape."""
    return real_response(model.simulate(theta.copy()), model.channels, model.n_steps)


def real_response(response: Any, channels: Sequence[Channel], n_steps: int) -> np.ndarray:
    """A model's response as floats (n_channels, n_steps) [SI], which may be infinite or NaN, as where it is masked.

    `SimulationFailed` if it is complex, has another shape, or is not an array of numbers.
    """
    try:
        if np.ma.isMaskedArray(response) or (
            isinstance(response, Sequence) and any(map(np.ma.isMaskedArray, response))
        ):
            response = np.ma.array(response)
            response = response.astype(np.result_type(response.dtype, float)).filled(np.nan)
        response = np.asarray(response)
        if np.iscomplexobj(response):
            rows = response if response.ndim == 2 else np.zeros((0, 0))
            named = [channel.name for channel, row in zip(channels, rows, strict=False) if row.imag.any()]
            which = f"channel {named[0]!r}" if named else f"channels {', '.join(c.name for c in channels)}"
            raise SimulationFailed(
                f"the response of {which} is complex, expected real numbers; return its real part if that is the "
                "response"
            )
        response = response.astype(float)  # a copy: the model may use its array again for the next simulation
    except (TypeError, ValueError) as error:
        raise SimulationFailed(f"the response is not an array of numbers: {error}") from error
    if (got := response.shape) != (expected := (len(channels), n_steps)):
        none = "" if got else ": is it None, because a return is missing?"
        raise SimulationFailed(f"the response has shape {got}, expected (n_channels, n_steps) = {expected}{none}")
    return response


def _misfit(measured: np.ndarray | Comparison, reduce: Statistic, model: Model, theta: np.ndarray) -> np.ndarray:
    response = _response(model, theta)
    if reason := not_finite(model, response):
        raise SimulationFailed(reason)
    return _reduced(measured, reduce, model, response)


def _reduced(measured: np.ndarray | Comparison, reduce: Statistic, _model: Model, response: np.ndarray) -> np.ndarray:
    """Statistic of a response; `SimulationFailed` if it cannot be computed."""
    before = sys.exception()
    try:
        return reduce_response(response, measured, reduce)
    except Exception as error:
        raise_if_it_ends_the_run(error, before)
        raise SimulationFailed(reason_of(error) if is_transient(error) else MisfitReason(reason_of(error))) from error


def not_finite(model: Model, values: np.ndarray) -> str:
    """Reason why one row of responses or misfits is not usable, or an empty string."""
    for channel, value in zip(cycle(model.channels), values, strict=False):  # a statistic repeats the channels
        if not np.isfinite(value).all():
            if value.ndim:
                return f"the response of channel {channel.name!r} is not finite"
            return MisfitReason(f"the misfit of channel {channel.name!r} is not finite")
    return ""


def _attempt(
    run: Callable[[Model, np.ndarray], np.ndarray], model: Model, theta: np.ndarray
) -> tuple[np.ndarray | None, str]:
    """Run one simulation; returns its result and an empty reason, or None and the reason. Called in the worker."""
    before, known = sys.exception(), interrupts()
    try:
        result = run(model, theta)
    except BaseException as error:  # a model may raise anything
        raise_if_it_ends_the_run(error, before)
        raise_if_interrupted(known)
        return None, reason_of(error)
    raise_if_interrupted(known)
    reason = not_finite(model, result)
    return (None, reason) if reason else (result, "")


def run_each(
    run: Callable[[np.ndarray], tuple], thetas: np.ndarray, shape: tuple[int, ...], pool: Any
) -> tuple[np.ndarray, list[str]]:
    """Results (n, *shape) and reasons of simulations that run one by one, in this process or in the pool's workers.

    `run` is a `sent_simulation`, for example.
    """
    if pool is not None:
        found = map(unpack, pool.map(Observed(run, pool.n_workers == 1), list(thetas)))
    elif is_worker():  # of the pool of a sampler
        found = map(Observed(run, False, (b"", working_folder())), thetas)
    else:
        return gathered([run(theta) for theta in thetas], shape)
    outcomes = []
    for outcome, opened in found:
        outcomes.append(outcome)
        note(opened)
    return gathered(outcomes, shape)


def gathered(outcomes: Sequence[tuple], shape: tuple[int, ...]) -> tuple[np.ndarray, list[str]]:
    """Results (n, *shape), NaN for failures, and reasons."""
    values = np.full((len(outcomes), *shape), np.nan)
    for row, (result, _) in zip(values, outcomes, strict=True):
        if result is not None:
            row[...] = result
    return values, [reason for _, reason in outcomes]


def unpack(outcome: tuple) -> tuple[tuple, Opened]:
    """Simulation result from a pool, and what it opened; for a lost worker, the pool reports a result only."""
    return (outcome, {}) if isinstance(outcome[1], str) else outcome


def _checked_batch(model: Model, batch: tuple, shape: tuple[int, ...]) -> tuple[np.ndarray, list[str]]:
    """Result of a model's own batch method, with NaN in the rows that failed; ValueError for a wrong shape."""
    values, reasons = batch
    if np.iscomplexobj(values):
        raise ValueError("expected real numbers, got complex ones")
    values = np.array(values, dtype=float)
    reasons = [shortened(reason if isinstance(reason, str) else str(reason)) for reason in reasons]
    if values.shape != shape or len(reasons) != shape[0]:
        raise ValueError(
            f"expected values of shape {shape} and {shape[0]} reasons, got {values.shape} and {len(reasons)}"
        )
    for row in (~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))).nonzero()[0]:
        reasons[row] = reasons[row] or not_finite(model, values[row])
    values[[bool(reason) for reason in reasons]] = np.nan
    return values, reasons
