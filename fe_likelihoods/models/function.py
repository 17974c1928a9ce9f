"""A model that is any Python function of the parameters.

The function may be trusted or not. One that may hang, crash or eat the memory runs in a process of its own, where that
is a failed simulation like any other; the process is kept for the next run, so that this costs a fraction of a
millisecond a run.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ..signals.channels import Channel
from ..simulation.code_digest import code_digest
from ..simulation.sandbox import Sandbox
from .external import CheckedModel, positive

__all__ = ["FunctionModel"]


class FunctionModel(CheckedModel):
    """A Python function as a model.

    Parameters
    ----------
    function : callable theta -> (n_channels, n_steps)
        Of the parameters (n_parameters,); returns the response in SI. It may raise what it likes, best
        `SimulationFailed` with a reason. For a pool of processes, or isolated, it must be picklable: defined at the top
        level of a module.
    parameter_names, channels, dt, n_steps : as in `CheckedModel`
    version : str, optional
        Takes the place of the code in the fingerprint: change it whenever the function computes something else. By
        default a digest of the code is taken, and of all that it uses (see `fe_likelihoods.simulation.code_digest`).
    isolated : bool
        Run in a process of its own; limits below imply it.
    time_limit : float, optional
        A run that takes longer [s] is stopped and has failed.
    memory_limit : int, optional
        The most address space of the process [bytes]: beyond it allocations fail.

    Raises
    ------
    ValueError
        If the function cannot be called, a limit is not positive, there is no stable digest of the code and no version,
        or what `CheckedModel` refuses.

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
    ) -> None:
        super().__init__(parameter_names, channels, dt, n_steps)
        kind = type(self).__name__
        if not callable(function):
            raise ValueError(f"{kind}: expected a function of the parameters; got {function!r}")
        self.function = function
        self.version = version
        self.time_limit = None if time_limit is None else positive(time_limit, f"{kind}: time_limit", "seconds")
        self.memory_limit = (
            None if memory_limit is None else int(positive(memory_limit, f"{kind}: memory_limit", "bytes"))
        )
        self.isolated = bool(isolated) or time_limit is not None or memory_limit is not None
        self.fingerprint = self._digest(self._version_of(function))
        self._run = Sandbox(function, self.time_limit, self.memory_limit or 0) if self.isolated else function

    def _version_of(self, function: Callable) -> list[str]:
        if self.version is not None:
            return ["version", str(self.version)]
        try:
            return ["code", code_digest(function)]
        except ValueError as error:
            raise ValueError(
                f"{type(self).__name__}: the fingerprint needs version= here, a text to be changed with the function: "
                f"{error}"
            ) from error

    def _respond(self, theta: np.ndarray) -> Any:
        return self._run(theta)
