"""Model that is built and run in OpenSees.

OpenSees holds one model per process, may end its process, and prints a lot. It therefore runs in a separate process,
where it is wiped before each run, and is never imported into the user's process. After a run that crashes or takes too
long, the next run starts a new process.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..signals.records import Record
from .function import FunctionModel

__all__ = ["OpenSeesModel"]


class _WithOpenSees:
    """Function of theta, and of a record if there is one, that calls the user's function with a wiped OpenSees."""

    def __init__(self, build_and_run: Callable[..., Any]) -> None:
        self.build_and_run = build_and_run

    def __call__(self, theta: np.ndarray, *record: Record, **n_steps: int) -> Any:
        import openseespy.opensees as ops

        ops.wipe()
        return self.build_and_run(ops, theta, *record, **n_steps)


class OpenSeesModel(FunctionModel):
    """Function that builds and runs an OpenSees model.

    Parameters
    ----------
    build_and_run : callable
        Function of the wiped module ``openseespy.opensees``, of theta (n_parameters,), and of the record if one is
        given, that returns the response (n_channels, n_steps) in SI units. It must be defined at the top level of a
        module. It should raise an exception if ``ops.analyze`` does not return 0, because OpenSees only prints a
        message. With an argument ``n_steps`` the model can be shortened; see `FunctionModel`.
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float, optional
        Time step of the response [s]; with a record a whole multiple of its step, by default that step.
    n_steps : int, optional
        Number of response samples; with a record it follows from `dt`.
    record : Record, optional
        Excitation, which the function receives as its third argument. The model can then be simulated under other
        records (`with_record`, ``propagate(..., record=)``, `fragility`).
    path_dependent : bool
        Whether the response to an excitation depends on earlier excitations. False for a linear structure: predictions
        under another record then need no `from_state`.
    time_limit : float, optional
        Longest duration of a run [s]; a longer run is stopped and counts as failed.
    memory_limit : int, optional
        Largest address space of the process [bytes]. Allocations beyond it fail.
    runs_per_process : int or None
        Number of runs after which the process is replaced by a new one; None for never. OpenSees leaks memory: in
        version 3.7.1, ``ops.eigen`` leaks about 14 kB per run of a model with 90 degrees of freedom.
    version : str, optional
        Text that replaces the code in the fingerprint; see `FunctionModel`.
    depends_on : sequence, optional
        Other files and values that the response depends on, such as ``Path("record.txt")``; see `FunctionModel`.

    Raises
    ------
    ValueError
        If openseespy is not installed, or an argument is wrong (see `FunctionModel`).

    Examples
    --------
    >>> def frame(ops, theta):
    ...     ops.model("basic", "-ndm", 2, "-ndf", 3)
    ...     ...
    >>> model = OpenSeesModel(frame, ("stiffness",), (Channel("top", "displacement", "mm"),), 0.01, 2000)

    With the excitation as an argument of the function, for predictions under other records:

    >>> def shaken_frame(ops, theta, record):
    ...     ops.timeSeries("Path", 1, "-dt", record.dt, "-values", *record.acceleration)
    ...     ...
    >>> model = OpenSeesModel(shaken_frame, ("stiffness",), (Channel("top", "displacement", "mm"),), record=eq1)
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
        memory_limit: int | None = None,
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
            memory_limit=memory_limit,
            runs_per_process=runs_per_process,
        )

    def code_parts(self) -> dict[str, Any]:
        """User code and OpenSees version, for the label of stored simulations."""
        return super().code_parts() | {"openseespy": metadata.version("openseespy")}

    @property
    def _user_function(self) -> Callable[..., Any]:
        return self.function.build_and_run
