"""Reasons of failed simulations: failures of the model, and faults of the infrastructure.

A reason that is a plain `str` is a failure of the model: an exception, a response with NaN, a wrong shape, the exit
code of a program. It depends on the parameters alone and is stored in a cache on disk. A `TransientReason` is a fault
of the infrastructure: a process that was killed or crashed, a time, memory or output limit, a full disk, a missing
folder or library. The log-likelihood is -inf in this run, but the next run simulates the point again. A `MisfitReason`
depends on the measurements, so it does not apply to other measurements.
"""

import re
import subprocess
from concurrent.futures import BrokenExecutor

from samplers.evaluation.pools import CLOSED

__all__ = [
    "ChangedModel",
    "ClosedPool",
    "MisfitReason",
    "SimulationFailed",
    "TransientReason",
    "UnusableModel",
    "describe_exit",
    "is_transient",
    "reason_of",
    "shortened",
    "text_of",
]

_FAULTS = (OSError, MemoryError, ImportError, BrokenExecutor, subprocess.TimeoutExpired)
_LONGEST_REASON = 2000  # characters


class SimulationFailed(RuntimeError):
    """A simulation that failed.

    `reason` says why, in words; a `TransientReason` if the process was stopped, was killed or crashed. A reason that
    begins with "collapse" says that the structure has collapsed: this is a result, which
    `fe_likelihoods.prediction.fragility.fragility` counts as an exceedance.

    Examples
    --------
    >>> def displacement(theta):
    ...     if theta[0] < 0.5:
    ...         raise SimulationFailed("collapse: the stiffness is below a half")
    ...     return model.simulate([theta[0], 1.0])[1:]
    >>> function = FunctionModel(displacement, ["stiffness"], model.channels[1:], dt=0.05, n_steps=200)
    >>> FELikelihood(function, measurements.select(["displacement"])).log_likelihood([0.4, 0.02])
    -inf
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = (reason if isinstance(reason, str) else str(reason)) or "no reason given"


class UnusableModel(ValueError):
    """A model whose responses cannot be used at any parameters, so that samplers stop (`ends_run`); says what to do."""

    ends_run = True


class ChangedModel(UnusableModel):
    """A model has changed since its fingerprint was computed."""


class ClosedPool(RuntimeError):
    """A pool was closed, or gave up simulations, while a run waited for them: samplers stop (`ends_run`)."""

    ends_run = True

    def __init__(self, text: str = CLOSED) -> None:
        super().__init__(text)


class TransientReason(str):
    """Reason of a failure whose cause is not the model."""


class MisfitReason(str):
    """Reason of a failure that depends on the measurements: the response is usable, its statistics are not."""


def is_transient(error: BaseException) -> bool:
    """Whether an exception is a fault of the infrastructure, such as a full disk, not a failure of the model."""
    if isinstance(error, subprocess.CalledProcessError):
        return error.returncode < 0  # killed by a signal
    return isinstance(error, _FAULTS)


def describe_exit(exit_code: int, who: str) -> str:
    """Description of an exit code, such as "the worker process died (signal 11)"."""
    return f"{who} died (signal {-exit_code})" if exit_code < 0 else f"{who} ended with exit code {exit_code}"


def reason_of(error: BaseException) -> str:
    """Reason of a simulation that raised an exception; a `TransientReason` for faults of the infrastructure."""
    if isinstance(error, SimulationFailed):
        return shortened(error.reason)
    text = shortened(text_of(error))
    return TransientReason(text) if is_transient(error) else text


def text_of(error: BaseException) -> str:
    """Type and text of an exception without addresses of objects, which differ from run to run and say nothing."""
    return re.sub(r" at 0x[0-9a-fA-F]+", "", f"{type(error).__name__}: {error}")


def shortened(reason: str) -> str:
    """The first 2000 characters of a reason, which may be the whole output of a program; its kind is kept."""
    if len(reason) <= _LONGEST_REASON:
        return reason
    return type(reason)(f"{reason[:_LONGEST_REASON]} ...")
