"""Model that is built and run in OpenSees.

OpenSees holds one model per process, may end its process, and prints a lot. It therefore runs in a separate process, is
wiped before each run, and is never imported into the user's process. After a crash or a timeout, the next run starts a
new process. If an analysis does not converge, only the code of ``ops.analyze`` says so (openseespy 3.7.1): the model
stays at the last step that converged, so a script that ignores the code returns a finite and wrong response. A run
whose script has not handled such a code has failed (`_Codes`).
"""

from __future__ import annotations

import functools
import gc
import importlib.util
import types
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from ..simulation.model import SimulationFailed
from .function import FunctionModel


class _Codes:
    """The codes that ``ops.analyze`` returns in one run.

    The run has failed if the script did not look at a code other than 0, if the last call failed, or if the script made
    the loads constant after a call that failed. A script may repeat a step with another algorithm or smaller steps, and
    ``any(codes)`` looks at the first failure and stands for those after it.
    """

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Begin a run."""
        self.values: list[int] = []
        self.ignored: set[int] = set()  # calls that failed, at whose codes the script has not looked
        self.at_load_const: int | None = None  # the call that failed before the loads were made constant

    def analyze(self, function: Callable[..., int], *arguments: Any) -> int:
        """Call ``ops.analyze``; returns its code."""
        code = function(*arguments)
        self.values.append(code)
        if code == 0:
            return code
        self.ignored.add(len(self.values))
        return _Code.of(code, len(self.values), self)

    def load_const(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call ``ops.loadConst``."""
        if self.at_load_const is None and self.values and self.values[-1] != 0:
            self.at_load_const = len(self.values)
        function(*arguments)

    def look(self, call: int) -> None:
        """The script looks at the code of a call."""
        self.ignored = {other for other in self.ignored if other < call}

    @property
    def reason(self) -> str:
        """Why the run has failed; empty if it has not."""
        last = len(self.values) if self.values and self.values[-1] != 0 else None
        failed = min(self.ignored, default=self.at_load_const or last)
        if failed is None:
            return ""
        text = f"ops.analyze returned {self.values[failed - 1]} at call {failed} of {len(self.values)} and the script "
        if self.ignored:
            return f"{text}did not look at it: test each code, and repeat the step in another way or raise an exception"
        if self.at_load_const:
            return f"{text}went on with ops.loadConst: raise an exception where a stage of the loads does not converge"
        return (
            f"{text}ended there. If that means something else than a failed simulation, say so: raise "
            "SimulationFailed('collapse at 12.3 s'); or, if such responses are right, use FunctionModel(isolated=True) "
            "with a function that imports openseespy itself"
        )


class _Code(int):
    """A code of ``ops.analyze`` other than 0, which notes that the script tests it or computes with it.

    Text is not noted: a script that prints the code may go on as if nothing had happened.
    """

    @classmethod
    def of(cls, value: int, call: int, codes: _Codes) -> _Code:
        """A code, the number of its call, and the codes of the run."""
        code = cls(value)
        code.look = functools.partial(codes.look, call)
        return code


def _looking(name: str) -> Callable[..., Any]:
    """A method of int that notes the look."""
    method = getattr(int, name)

    def look(self: _Code, *arguments: Any) -> Any:
        self.look()
        return method(self, *arguments)

    return look


for _name in {*dir(int)} - {*dir(object)} | {"__eq__", "__ne__", "__lt__", "__le__", "__gt__", "__ge__", "__hash__"}:
    if _name.startswith("__"):
        setattr(_Code, _name, _looking(_name))

_codes = _Codes()


def _watch(ops: Any) -> None:
    """Replace two functions of OpenSees, also where the user's code has imported them by name."""
    for name, method in (("analyze", _codes.analyze), ("loadConst", _codes.load_const)):
        function = getattr(ops, name)
        if isinstance(function, functools.partial):
            continue
        holders = gc.get_referrers(function)
        watched = functools.partial(method, function)
        for holder in holders:
            if isinstance(holder, types.CellType):
                holder.cell_contents = watched
            values = holder if isinstance(holder, dict) else getattr(holder, "__dict__", None)
            for key, value in list(values.items()) if isinstance(values, dict) else ():
                if value is function:  # in no inner scope, which would hold it, too
                    values[key] = watched


class _WithOpenSees:
    """Function of theta, and of a record if there is one, that calls the user's function with a wiped OpenSees.

    `SimulationFailed` if an analysis failed and the function returned a response all the same.
    """

    def __init__(self, build_and_run: Callable[..., Any]) -> None:
        self.build_and_run = build_and_run

    def __call__(self, theta: np.ndarray, *record: Record, **n_steps: int) -> Any:
        import openseespy.opensees as ops

        _watch(ops)
        ops.wipe()
        _codes.begin()
        response = self.build_and_run(ops, theta, *record, **n_steps)
        if _codes.reason:
            raise SimulationFailed(_codes.reason)
        return response


class OpenSeesModel(FunctionModel):
    """Function that builds and runs an OpenSees model.

    ``ops.analyze`` returns a code other than 0 if the analysis does not converge, and OpenSees only prints a message.
    The simulation has failed, with this reason, if the function returns a response although

    * it did not look at such a code: no test, comparison or arithmetic, now or later; printing is no look;
    * or the last call of ``ops.analyze`` failed;
    * or a call failed, and the next one came after ``ops.loadConst``, which ends a stage of the loads.

    So the function may repeat a step that failed with another algorithm, or in smaller steps. It should raise an
    exception where this does not help, such as ``SimulationFailed("collapse at 12.3 s")`` (`fragility` counts
    collapses). If the response of an analysis that stopped is right, use `FunctionModel` with ``isolated=True``, and a
    function that imports openseespy itself.

    Parameters
    ----------
    build_and_run : callable
        Function of the wiped module ``openseespy.opensees``, of theta (n_parameters,), and of the record if one is
        given, that returns the response (n_channels, n_steps) in SI units. It must be defined at the top level of a
        module. With an argument ``n_steps`` the model can be shortened; see `FunctionModel`.
    parameter_names, channels, dt, n_steps, record, path_dependent, time_limit, version, depends_on
        As for `FunctionModel`; the function receives a record as its third argument.
    runs_per_process : int or None
        Number of runs after which the process is replaced by a new one; None for never. OpenSees leaks memory: in
        version 3.7.1, ``ops.eigen`` leaks about 14 kB per run of a model with 90 degrees of freedom.

    Raises
    ------
    ValueError
        If openseespy is not installed, or an argument is wrong (see `FunctionModel`).

    Examples
    --------
    >>> def bar(ops, theta):  # in a module of your own
    ...     ops.model("basic", "-ndm", 1, "-ndf", 1)
    ...     ...  # nodes, elements, loads, and ops.analyze
    ...     return [[ops.nodeDisp(2, 1)]]
    >>> opensees = OpenSeesModel(bar, ["stiffness"], [Channel("top", "displacement", "mm")], dt=0.01, n_steps=1)
    """

    def __init__(
        self,
        build_and_run: Callable[..., Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float | None = None,
        n_steps: int | None = None,
        *,
        record: Record | None = None,
        path_dependent: bool = True,
        time_limit: float | None = None,
        runs_per_process: int | None = 1000,
        version: str | None = None,
        depends_on: Sequence[Any] = (),
    ) -> None:
        if importlib.util.find_spec("openseespy") is None:
            raise ValueError(
                "OpenSeesModel needs OpenSees: pip install openseespy (on Debian also libblas3 and liblapack3)"
            )
        if not callable(build_and_run):
            raise ValueError(
                f"OpenSeesModel: expected a function of OpenSees and the parameters; got {build_and_run!r}"
            )
        super().__init__(
            _WithOpenSees(build_and_run),
            parameter_names,
            channels,
            dt,
            n_steps,
            record=record,
            path_dependent=path_dependent,
            version=version,
            depends_on=depends_on,
            isolated=True,
            time_limit=time_limit,
            runs_per_process=runs_per_process,
        )

    def code_parts(self) -> dict[str, Any]:
        """User code and OpenSees version, for the label of stored simulations."""
        checked = "a code of analyze that the function has not handled is a failure"  # unlike in version 0.2
        return super().code_parts() | {"openseespy": metadata.version("openseespy"), "codes": checked}

    @property
    def _user_function(self) -> Callable[..., Any]:
        return self.function.build_and_run
