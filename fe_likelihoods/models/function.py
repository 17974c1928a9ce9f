"""Model defined by a Python function of the parameters.

A function that may hang, crash or use too much memory can run in a separate process, where such a run is a failed
simulation. The process is reused for the next run, which adds a fraction of a millisecond per run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.code_digest import code_digest
from ..simulation.sandbox import Sandbox
from .external import ExternalModel
from .validation import positive_float

__all__ = ["FunctionModel"]


class FunctionModel(ExternalModel):
    """Python function as a model.

    Parameters
    ----------
    function : callable
        Function of theta (n_parameters,) that returns the response (n_channels, n_steps) in SI units. It may raise any
        exception, preferably `SimulationFailed` with a reason. For a pool of processes, or with `isolated`, it must be
        picklable: defined at the top level of a module.
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float
        Time step of the response [s].
    n_steps : int
        Number of samples of the response.
    version : str, optional
        Text that replaces the code in the fingerprint; change it whenever the function computes something else. By
        default the fingerprint contains a digest of the code and of everything it uses
        (`fe_likelihoods.simulation.code_digest`).
    isolated : bool
        Run the function in a separate process. A setting below implies it.
    time_limit : float, optional
        Longest duration of a run [s]. A longer run is stopped and counts as failed.
    memory_limit : int, optional
        Largest address space of the process [bytes]. Allocations beyond it fail.
    runs_per_process : int, optional
        Number of runs after which the process is replaced by a new one, which limits the memory that compiled code
        leaks; never by default.

    Raises
    ------
    ValueError
        If the function cannot be called, a limit is not positive, no stable digest of the code can be computed and
        `version` is not given, or another argument is wrong.

    Examples
    --------
    >>> def cantilever(theta): ...
    >>> model = FunctionModel(cantilever, ("stiffness",), (Channel("tip", "displacement", "mm"),), 0.01, 2000)
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int,
        *,
        version: str | None = None,
        isolated: bool = False,
        time_limit: float | None = None,
        memory_limit: int | None = None,
        runs_per_process: int | None = None,
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps)
        kind = type(self).__name__
        if not callable(function):
            raise ValueError(f"{kind}: expected a function of the parameters; got {function!r}")
        self.function = function
        self.version = version
        self.time_limit = None if time_limit is None else positive_float(time_limit, f"{kind}: time_limit", "seconds")
        self.memory_limit = (
            None if memory_limit is None else int(positive_float(memory_limit, f"{kind}: memory_limit", "bytes"))
        )
        if runs_per_process is not None and (
            isinstance(runs_per_process, bool) or not isinstance(runs_per_process, int) or runs_per_process < 1
        ):
            raise ValueError(f"{kind}: runs_per_process must be None or a positive integer; got {runs_per_process!r}")
        self.runs_per_process = runs_per_process
        settings = (time_limit, memory_limit, runs_per_process)
        self.isolated = bool(isolated) or any(setting is not None for setting in settings)
        self.fingerprint = self._digest(self._version_of(function))
        self._run = function
        if self.isolated:
            self._run = Sandbox(
                function, self.time_limit, self.memory_limit or 0, runs_per_process=self.runs_per_process
            )

    def _version_of(self, function: Callable) -> list[str]:
        """Texts that identify what the function computes."""
        if self.version is not None:
            return ["version", str(self.version)]
        try:
            return ["code", code_digest(function)]
        except ValueError as error:
            raise ValueError(
                f"{type(self).__name__}: no digest of the function can be computed; give version=, a text to be "
                f"changed whenever the function changes: {error}"
            ) from error

    def _respond(self, theta: np.ndarray) -> Any:
        return self._run(theta)
