"""Model defined by a Python function of the parameters.

A function that may hang, crash or use too much memory can run in a separate process, where such a run is a failed
simulation. The process is reused for the next run, which adds a fraction of a millisecond per run.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..signals.channels import Channel
from ..signals.records import Record
from ..signals.sampling import sample_window
from ..simulation.executors import Sandbox
from ..simulation.failure_reasons import UnusableModel
from ..simulation.files import Observed, note
from .user_model import UserModel
from .validation import check_theta, positive_float


class _Bound:
    """Function of theta that calls the user's function with the record and the number of samples, where it has them."""

    def __init__(self, function: Callable[..., Any], record: Record | None, n_steps: int | None) -> None:
        self.function = function
        self.records = () if record is None else (record,)
        self.keywords = {} if n_steps is None else {"n_steps": n_steps}

    def __call__(self, theta: np.ndarray) -> Any:
        return self.function(theta, *self.records, **self.keywords)


def _n_steps_parameter(function: Callable[..., Any]) -> inspect.Parameter | None:
    """The parameter ``n_steps`` of a function; None if it has none, or is a builtin whose parameters are unknown."""
    try:
        return inspect.signature(function).parameters.get("n_steps")
    except (TypeError, ValueError):
        return None


class FunctionModel(UserModel):
    """Python function as a model.

    Parameters
    ----------
    function : callable
        Function of theta (n_parameters,), and of the record if one is given, that returns the response (n_channels,
        n_steps) in SI units. It may raise any exception, preferably `SimulationFailed` with a reason. A pool of
        processes, or `isolated`, receives it with the values that it uses (`fe_likelihoods.simulation.by_value`).
        If it takes ``n_steps``, the model can be shortened (`first`): with ``n_steps=k``, it must return the first k
        samples. The whole response is asked for without ``n_steps`` if that has a default.
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
        Text in the fingerprint; cached simulations are used only if it is the same. Without it, the label of the model
        (`fe_likelihoods.simulation.label`) notices a change in the code, or in what it uses or opens.
    depends_on : sequence, optional
        Files and values that affect the response, as part of the fingerprint: a Path stands for the content of a file
        or folder, any other object for its value, such as ``os.environ.get("SOLVER_MODE")``.
    jacobian : callable, optional
        Function with the arguments of `function` that returns the derivatives (n_parameters, n_channels, n_steps) of
        the response by the parameters, for the search of a guide (`fe_likelihoods.simulation.model.Model`).
    isolated : bool
        Run the function in a separate process. `time_limit` and `runs_per_process` imply it. The function may limit the
        memory of the process, ``resource.setrlimit(resource.RLIMIT_AS, (n, n))`` with n in bytes.
    time_limit : float, optional
        Longest duration of a run [s]; a longer run is stopped and counts as failed.
    runs_per_process : int, optional
        Number of runs after which a new process is started, against memory that compiled code leaks.

    Raises
    ------
    ValueError
        If a function cannot be called, `jacobian` has no ``n_steps`` although `function` has it, a limit is not
        positive, or another argument is wrong.

    Examples
    --------
    >>> def free_vibration(theta):
    ...     return np.exp(-0.3 * time) * np.cos(6.0 * np.sqrt(theta[0]) * time)[np.newaxis]
    >>> top = Channel("top", "displacement", "mm")
    >>> function = FunctionModel(free_vibration, ["stiffness"], [top], dt=0.05, n_steps=200)
    >>> function.simulate([1.1]).shape
    (1, 200)

    With the excitation as an argument of the function, for predictions under other records:

    >>> def at_rest(theta, record):
    ...     return theta[0] * record.acceleration[np.newaxis]
    >>> base = Channel("base", "acceleration", "g")
    >>> function = FunctionModel(at_rest, ["gain"], [base], record=record)
    >>> function.with_record(record.trim(0.0, 5.0)).simulate([1.0]).shape
    (1, 101)
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
        jacobian: Callable[..., Any] | None = None,
        isolated: bool = False,
        time_limit: float | None = None,
        runs_per_process: int | None = None,
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps, depends_on, record, path_dependent)
        kind = type(self).__name__
        if not callable(function):
            raise ValueError(f"{kind}: expected a function of the parameters; got {function!r}")
        if not (jacobian is None or callable(jacobian)):
            raise ValueError(
                f"{kind}: expected jacobian as a function with the arguments of function; got {jacobian!r}"
            )
        self.function, self._jacobian = function, jacobian
        parameter = _n_steps_parameter(self._user_function)
        self._takes_n_steps = parameter is not None
        self._needs_n_steps = parameter is not None and parameter.default is inspect.Parameter.empty
        if self._takes_n_steps and jacobian is not None and _n_steps_parameter(jacobian) is None:
            raise ValueError(
                f"{kind}: expected jacobian with the argument n_steps, as function has it; got {jacobian!r}: add it, "
                "so that derivatives of the first n_steps samples can be asked for"
            )
        self.version = version
        self.time_limit = None if time_limit is None else positive_float(time_limit, f"{kind}: time_limit", "seconds")
        if runs_per_process is not None and (
            isinstance(runs_per_process, bool) or not isinstance(runs_per_process, int) or runs_per_process < 1
        ):
            raise ValueError(f"{kind}: runs_per_process must be None or a positive integer; got {runs_per_process!r}")
        self.runs_per_process = runs_per_process
        self.isolated = bool(isolated) or time_limit is not None or runs_per_process is not None
        self._prepare()

    def _prepare(self, shortened: bool = False) -> None:
        self._shortened = shortened
        stated = [] if self.version is None else [["version", str(self.version)]]
        if self.record is not None:
            stated.append(["record", self.record.fingerprint])
        self.fingerprint = self._digest(*stated)
        self._run = self._runner(self.function)
        self._run_jacobian = None if self._jacobian is None else self._runner(self._jacobian)

    def _runner(self, function: Callable[..., Any]) -> Callable[[np.ndarray], Any]:
        """Function of theta that calls a user's function, in a process of its own if the model is isolated."""
        n_steps = self.n_steps if self._shortened or self._needs_n_steps else None
        if self.record is not None or n_steps is not None:
            function = _Bound(function, self.record, n_steps)
        if not self.isolated:
            return function
        return Sandbox(Observed(function), self.time_limit, self.runs_per_process)

    def code_parts(self) -> dict[str, Any]:
        """User code, for the label of stored simulations."""
        return {"function": self._user_function}

    @property
    def _user_function(self) -> Callable[..., Any]:
        return self.function

    @property
    def jacobian(self) -> Callable[[np.ndarray], Any]:
        """Function of theta that returns the derivatives (n_parameters, n_channels, n_steps) of the response.

        AttributeError if the model was made without.
        """
        if self._run_jacobian is None:
            raise AttributeError(f"{type(self).__name__} was made without jacobian=")
        return self._differentiate

    @property
    def first(self) -> Callable[[float], FunctionModel]:
        """Function of a time [s] that returns the same model up to the sample at this time, or the one before it.

        AttributeError if `function` does not take ``n_steps``.
        """
        if not self._takes_n_steps:
            raise AttributeError(f"the function of this {type(self).__name__} does not take n_steps")
        return self._first

    def _first(self, seconds: float) -> FunctionModel:
        other = copy.copy(self)
        other.n_steps = sample_window("the response", self.n_steps, self.dt, 0.0, seconds).stop
        other._prepare(shortened=True)
        return other

    def _differentiate(self, theta: ArrayLike) -> Any:
        theta = check_theta(theta, self.parameter_names).copy()
        return self._called(self._run_jacobian, theta)

    def _respond(self, theta: np.ndarray) -> Any:
        response = self._called(self._run, theta)
        if self._shortened and np.shape(response) != (len(self.channels), self.n_steps):
            raise UnusableModel(
                f"expected the function to return the first {self.n_steps} samples of {len(self.channels)} channels "
                f"with n_steps={self.n_steps}; got the shape {np.shape(response)}: return the first n_steps samples, "
                "or give the argument n_steps another name"
            )
        return response

    def _called(self, run: Callable[[np.ndarray], Any], theta: np.ndarray) -> Any:
        if not self.isolated:
            return run(theta)
        result, opened = run(theta)
        note(opened)
        return result
