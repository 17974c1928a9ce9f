"""A model built and run in OpenSees.

OpenSees holds one model per process, may end that process, and prints a lot. So it lives in a process of its own, where
it is wiped before each run, and is never imported here. Where a run crashes or takes too long, the next one starts in a
new process.
"""

import importlib.util
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any

import numpy as np

from ..signals.channels import Channel
from .function import FunctionModel

__all__ = ["OpenSeesModel"]


class _Wiped:
    """The user's function of OpenSees and of theta, as a function of theta in a clean OpenSees."""

    def __init__(self, build_and_run: Callable[[Any, np.ndarray], Any]) -> None:
        self.build_and_run = build_and_run

    def __call__(self, theta: np.ndarray) -> np.ndarray:
        import openseespy.opensees as ops

        ops.wipe()
        return np.asarray(self.build_and_run(ops, theta), dtype=float)


class OpenSeesModel(FunctionModel):
    """A function that builds an OpenSees model and runs it, as a model.

    Parameters
    ----------
    build_and_run : callable (ops, theta) -> (n_channels, n_steps)
        Given the module ``openseespy.opensees``, wiped, and the parameters (n_parameters,), returns the response in SI.
        Defined at the top level of a module. It should raise where ``ops.analyze`` does not return 0: OpenSees itself
        only prints.
    parameter_names, channels, dt, n_steps : as in `CheckedModel`
    time_limit : float, optional
        A run that takes longer [s] is stopped and has failed.
    memory_limit, version : as in `FunctionModel`

    Raises
    ------
    ValueError
        If openseespy is not installed, or what `FunctionModel` refuses.

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
        version: str | None = None,
    ) -> None:
        if importlib.util.find_spec("openseespy") is None:
            raise ValueError("OpenSeesModel needs OpenSees: pip install openseespy (and Debian's libblas3, liblapack3)")
        if not callable(build_and_run):
            raise ValueError(
                f"OpenSeesModel: expected a function of OpenSees and the parameters; got {build_and_run!r}"
            )
        super().__init__(
            _Wiped(build_and_run),
            parameter_names,
            channels,
            dt,
            n_steps,
            version=version,
            isolated=True,
            time_limit=time_limit,
            memory_limit=memory_limit,
        )

    def _version_of(self, function: Callable) -> list[str]:
        return [*super()._version_of(function.build_and_run), "openseespy", metadata.version("openseespy")]
