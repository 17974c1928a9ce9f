"""Model defined by a Python function of the parameters.

A function that may hang, crash or use too much memory can run in a separate process, where such a run is a failed
simulation. The process is reused for the next run, which adds a fraction of a millisecond per run.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from ..simulation.opened import Observed, note
from ..simulation.sandbox import Sandbox
from .user_model import UserModel
from .validation import positive_float

__all__ = ["FunctionModel"]


class _UnderRecord:
    """Function of theta that calls the user's function with theta and the record."""

    def __init__(self, function: Callable[..., Any], record: Record) -> None:
        self.function, self.record = function, record

    def __call__(self, theta: np.ndarray) -> Any:
        return self.function(theta, self.record)


class FunctionModel(UserModel):
    """Python function as a model.

    Parameters
    ----------
    function : callable
        Function of theta (n_parameters,), and of the record if one is given, that returns the response (n_channels,
        n_steps) in SI units. It may raise any exception, preferably `SimulationFailed` with a reason. A pool of
        processes, or `isolated`, receives it with the values that it uses (`fe_likelihoods.simulation.by_value`).
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float, optional
        Time step of the response [s]; with a record a whole multiple of its step, by default that step.
    n_steps : int, optional
        Number of response samples; with a record it follows from `dt`.
    record : Record, optional
        Excitation, which the function receives as its second argument. The model can then be simulated under other
        records (`with_record`, ``propagate(..., record=)``, `fragility`).
    path_dependent : bool
        Whether the response to an excitation depends on earlier excitations. False for a linear structure: predictions
        under another record then need no `from_state`.
    version : str, optional
        Text in the fingerprint; cached simulations are used only if their text is the same. Without it, the label of
        the model (`fe_likelihoods.simulation.label`) notices a change in the code, or in anything that it uses or
        opens, and stored simulations are used if some of them agree with new simulations.
    depends_on : sequence, optional
        Files and values that affect the response, as part of the fingerprint: a Path stands for the content of a file
        or of all files in a folder, any other object for its value, such as ``os.environ.get("SOLVER_MODE")``.
    isolated : bool
        Run the function in a separate process. Limits and `runs_per_process` imply it.
    time_limit : float, optional
        Longest duration of a run [s]; a longer run is stopped and counts as failed.
    memory_limit : int, optional
        Largest address space of the process [bytes]. Allocations beyond it fail.
    runs_per_process : int, optional
        Number of runs after which the process is replaced by a new one, which limits the memory that compiled code
        leaks; never by default.

    Raises
    ------
    ValueError
        If the function cannot be called, a limit is not positive, or another argument is wrong.

    Examples
    --------
    >>> def cantilever(theta): ...
    >>> model = FunctionModel(cantilever, ("stiffness",), (Channel("tip", "displacement", "mm"),), 0.01, 2000)

    With the excitation as an argument of the function:

    >>> def shaken(theta, record): ...
    >>> model = FunctionModel(shaken, ("stiffness",), (Channel("tip", "displacement", "mm"),), record=eq1)
    """

    def __init__(
        self,
        function: Callable[..., Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float | None = None,
        n_steps: int | None = None,
        *,
        record: Record | None = None,
        path_dependent: bool = True,
        version: str | None = None,
        depends_on: Sequence[Any] = (),
        isolated: bool = False,
        time_limit: float | None = None,
        memory_limit: int | None = None,
        runs_per_process: int | None = None,
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps, depends_on, record, path_dependent)
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
        self._prepare()

    def _prepare(self) -> None:
        stated = [] if self.version is None else [["version", str(self.version)]]
        if self.record is not None:
            stated.append(["record", self.record.fingerprint])
        self.fingerprint = self._digest(*stated)
        self._run = self.function if self.record is None else _UnderRecord(self.function, self.record)
        if self.isolated:
            observed = Observed(self._run)
            self._run = Sandbox(
                observed, self.time_limit, self.memory_limit or 0, runs_per_process=self.runs_per_process
            )

    def code_parts(self) -> dict[str, Any]:
        """User code, for the label of stored simulations."""
        return {"function": self.function}

    def _respond(self, theta: np.ndarray) -> Any:
        if not self.isolated:
            return self._run(theta)
        response, opened = self._run(theta)
        note(opened)
        return response
