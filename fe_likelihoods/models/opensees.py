"""Model that is built and run in OpenSees.

OpenSees holds one model per process, may end its process, and prints a lot. It therefore runs in a separate process,
where it is wiped before each run, and is never imported into the process of the user. After a run that crashes or takes
too long, the next run starts a new process.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from ..signals.channels import Channel
from .function import FunctionModel

__all__ = ["OpenSeesModel"]


class _WithOpenSees:
    """Function of theta that calls the user's function with a wiped OpenSees."""

    def __init__(self, build_and_run: Callable[[Any, np.ndarray], Any]) -> None:
        self.build_and_run = build_and_run

    def __call__(self, theta: np.ndarray) -> Any:
        import openseespy.opensees as ops

        ops.wipe()
        return self.build_and_run(ops, theta)


class OpenSeesModel(FunctionModel):
    """Function that builds and runs an OpenSees model.

    Parameters
    ----------
    build_and_run : callable
        Function of the wiped module ``openseespy.opensees`` and of theta (n_parameters,) that returns the response
        (n_channels, n_steps) in SI units. It must be defined at the top level of a module. It should raise an exception
        if ``ops.analyze`` does not return 0, because OpenSees itself only prints a message.
    parameter_names : sequence of str
        Names of the structural parameters, in the order of theta.
    channels : sequence of Channel
        Channels of the response, in the order of its rows.
    dt : float
        Time step of the response [s].
    n_steps : int
        Number of samples of the response.
    time_limit : float, optional
        Longest duration of a run [s]. A longer run is stopped and counts as failed.
    memory_limit : int, optional
        Largest address space of the process [bytes]. Allocations beyond it fail.
    runs_per_process : int or None
        Number of runs after which the process is replaced by a new one; None for never. OpenSees leaks memory: in
        version 3.7.1, ``ops.eigen`` leaks about 14 kB per run of a model of 90 degrees of freedom.
    version : str, optional
        Text that replaces the code in the fingerprint; see `FunctionModel`.
    depends_on : sequence, optional
        Files and values that the response depends on besides the code, such as ``Path("record.txt")``; see
        `FunctionModel`.

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
    """

    def __init__(
        self,
        build_and_run: Callable[[Any, np.ndarray], Any],
        parameter_names: Sequence[str],
        channels: Sequence[Channel],
        dt: float,
        n_steps: int,
        *,
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
            version=version,
            depends_on=depends_on,
            isolated=True,
            time_limit=time_limit,
            memory_limit=memory_limit,
            runs_per_process=runs_per_process,
        )

    @property
    def _fingerprinted(self) -> Callable:
        return self.function.build_and_run

    def _identity(self, code: str) -> list[Any]:
        return [*super()._identity(code), "openseespy", metadata.version("openseespy")]
