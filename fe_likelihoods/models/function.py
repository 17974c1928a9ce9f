"""Model defined by a Python function of the parameters.

A function that may hang, crash or use too much memory can run in a separate process, where such a run is a failed
simulation. The process is reused for the next run, which adds a fraction of a millisecond per run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from ..simulation.by_value import is_worker
from ..simulation.code_digest import describe_code
from ..simulation.sandbox import Sandbox
from .external import UserModel
from .validation import positive_float

__all__ = ["FunctionModel"]

logger = logging.getLogger(__name__)

# fingerprints of functions that have run in this process, and of those that change what they use when they run
_observed: set[str] = set()
# (True: all that they change is known from their code)
_changes_itself: dict[str, bool] = {}


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
        Time step of the response [s]. With a record: a whole multiple of its step, by default that step.
    n_steps : int, optional
        Number of samples of the response. With a record it follows from `dt`.
    record : Record, optional
        Excitation, which the function receives as its second argument. The model can then be simulated under other
        records (`with_record`, ``propagate(..., record=)``, `fragility`).
    path_dependent : bool
        Whether the response to an excitation depends on earlier ones. False for a linear structure: predictions under
        another record then need no `from_state`.
    version : str, optional
        Text that replaces the code in the fingerprint; change it whenever the function computes something else. By
        default the fingerprint contains a digest of the code and of everything it uses
        (`fe_likelihoods.simulation.code_digest`).
    depends_on : sequence, optional
        What the response depends on besides the code, as part of the fingerprint: a Path stands for the content of a
        file or of all files in a folder, any other object for its value, such as ``os.environ.get("SOLVER_MODE")``.
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

    With the excitation as an argument of the function:

    >>> def shaken(theta, record): ...
    >>> model = FunctionModel(shaken, ("stiffness",), (Channel("tip", "displacement", "mm"),), record=eq1)
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], Any],
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
        self.watched_files = tuple(map(str, self._dependencies.paths))
        self._steady_at_start = ""
        self._code_at_start = self._code()
        self._prepare()

    def _prepare(self) -> None:
        self.fingerprint = self._digest(*self._identity(self._code_at_start))
        self._run = self.function if self.record is None else _UnderRecord(self.function, self.record)
        if self.isolated:
            self._run = Sandbox(
                self._run, self.time_limit, self.memory_limit or 0, runs_per_process=self.runs_per_process
            )

    def current_fingerprint(self) -> str:
        """The fingerprint of the function as it is now, computed again.

        If the function itself changes what it uses, such as a counter or a table of earlier results, these values count
        as unchanged: no other change of them can be told from that.
        """
        known = _changes_itself.get(self.fingerprint)
        same = self.version is None and (known is False or (known and self._steady() == self._steady_at_start))
        return self._digest(*self._identity(self._code_at_start if same else self._code()))

    def only_own_changes(self) -> bool:
        """Whether nothing has changed but values that the function may itself change when it runs."""
        same_inputs = self._digest(*self._identity(self._code_at_start)) == self.fingerprint
        return same_inputs and (self.version is not None or self._steady() == self._steady_at_start)

    def accept_own_changes(self) -> None:
        """State that the function has changed what it uses; these values are then not compared any more."""
        if self.isolated or self.version is not None or self.fingerprint in _changes_itself:
            return
        _changes_itself[self.fingerprint] = self._steady() == self._steady_at_start
        logger.info(
            "%s changes what it uses when it runs, such as a counter or a table of earlier results; other changes of "
            "these values are not noticed during a run. version= replaces its digest",
            getattr(self.function, "__qualname__", self.function),
        )

    @property
    def _fingerprinted(self) -> Callable:
        """The function whose code is part of the fingerprint."""
        return self.function

    def _code(self) -> str:
        """Digest of the code, empty if there is a version; ValueError if it has none."""
        if self.version is not None:
            return ""
        try:
            code = describe_code(self._fingerprinted)
        except ValueError as error:
            raise ValueError(
                f"{type(self).__name__}: no digest of the function can be computed; give version=, a text to be "
                f"changed whenever the function changes: {error}"
            ) from error
        self.watched_files = tuple(code.files) + tuple(map(str, self._dependencies.paths))
        self._steady_at_start = self._steady_at_start or code.steady
        return code.digest

    def _steady(self) -> str:
        """Digest of the code as it is now, without the values that it may itself change."""
        return describe_code(self._fingerprinted, strict=False).steady

    def _identity(self, code: str) -> list[Any]:
        """Texts that identify what the function computes."""
        identity = ["code", code] if self.version is None else ["version", str(self.version)]
        return [identity] if self.record is None else [identity, ["record", self.record.fingerprint]]

    def _respond(self, theta: np.ndarray) -> Any:
        if self.isolated or self.version is not None or self.fingerprint in _observed or is_worker():
            return self._run(theta)
        before = self._code_or_error()
        try:
            return self._run(theta)
        finally:
            _observed.add(self.fingerprint)
            if self._code_or_error() != before:
                self.accept_own_changes()

    def _code_or_error(self) -> str:
        try:
            return self._code()
        except ValueError as error:
            return str(error)
