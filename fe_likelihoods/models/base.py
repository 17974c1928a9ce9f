"""Base classes for the models of this package.

`StructuralModel` checks the shape of the parameters. `BuiltInModel` adds what the built-in structures share: parameters
that are multiples of nominal values, a fingerprint computed from the arguments, and batches on threads. Models of your
own need neither: any object with the attributes of `fe_likelihoods.simulation.model.Model` is a model.
"""

from __future__ import annotations

import hashlib
import logging
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..signals.channels import Channel
from ..signals.records import DisplacementHistory, Record
from ..signals.sampling import array_digest
from ..simulation.by_value import is_of_user
from ..simulation.model import SimulationBatch, SimulationFailed
from .validation import check_theta, check_thetas, invalid

logger = logging.getLogger(__name__)


def digest(*parts: str) -> str:
    """Hexadecimal digest of texts, in order."""
    return hashlib.blake2b("|".join(parts).encode(), digest_size=16).hexdigest()


def code_within(model: Any) -> dict[str, Any]:
    """User code of a model that another one contains, as ``code_parts()`` of that one; empty if there is none."""
    own = {"model": model} if is_of_user(type(model).__module__) else {}
    return own | (model.code_parts() if hasattr(model, "code_parts") else {})


@dataclass(frozen=True)
class History:
    """Named time histories of one simulation, for plots and checks; ``history[name]`` returns one row."""

    names: tuple[str, ...]
    values: np.ndarray  # (n_rows, n_steps) [SI]

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self.names:
            raise invalid(f"the name of a history out of {self.names}", name, "the attribute names lists them")
        return self.values[self.names.index(name)]


class StructuralModel:
    """Base class for all models of this package; a subclass defines `_respond`.

    `path_dependent`: whether a response depends on earlier excitations. False for linear structures, whose free
    vibration decays.
    """

    parameter_names: tuple[str, ...]
    channels: tuple[Channel, ...]
    dt: float
    n_steps: int
    path_dependent: bool = True

    def simulate(self, theta: ArrayLike) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] at the parameters `theta` (n_parameters,).

        SimulationFailed if they describe no structure, or the solution does not converge; ValueError for another shape.
        """
        return self._respond(check_theta(theta, self.parameter_names))

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class BuiltInModel(StructuralModel):
    """Base class for frozen dataclasses that describe a structure with nominal values and simulate it by kernels.

    A subclass has the field `parameters`, the property `nominal`, and defines `_prepare`, the work that is the same for
    every theta, and `_respond`, which uses its result, `_prepared`. Kernels release the interpreter lock, so that
    simulations may run at once in this process.
    """

    parameters: tuple[str, ...]
    nominal_units: ClassVar[dict[str, str]] = {}  # in which the nominal values are shown, by parameter
    _display_fields: ClassVar[tuple[str, ...]] = ("outputs", "unit", "units")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the elements in theta, which are multiples of the values in `nominal`."""
        return self.parameters

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        raise NotImplementedError

    @cached_property
    def fingerprint(self) -> str:
        """Digest of the declared arguments and the excitation; the code of this library is not part of it."""
        parts = [type(self).__name__, repr([channel.name for channel in self.channels])]
        for field in fields(self):
            if field.name not in self._display_fields:
                parts.append(f"{field.name}={_text(getattr(self, field.name))}")
        return digest(*parts)

    @property
    def range_remark(self) -> str:
        """Text of the warning about a simulation beyond the range of the laws; empty if there was none."""
        return vars(self).get("_remark", "")

    def physical_values(self, theta: np.ndarray) -> dict[str, float]:
        """Physical values [SI] of all parameters at the multiples `theta` (n_parameters,) of the nominal values."""
        values = self.nominal
        for name, multiple in zip(self.parameters, theta.tolist(), strict=True):
            values[name] *= multiple
        return values

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Simulate rows of `thetas` (n, n_parameters) on as many threads as numba uses; rows that failed are NaN, with
        reasons.
        """
        import numba  # slow to import

        thetas = check_thetas(thetas, self.parameter_names)
        _ = self._prepared  # computed here, so that not every thread computes it
        response = np.full((len(thetas), len(self.channels), self.n_steps), np.nan)
        reasons = [""] * len(thetas)

        def one(i: int) -> None:
            try:
                values = self._respond(thetas[i])
                if np.iscomplexobj(values):  # the assignment would keep the real part
                    raise ValueError("expected real numbers, got complex ones")
                response[i] = values
            except SimulationFailed as failure:
                reasons[i] = failure.reason

        n_threads = min(numba.get_num_threads(), len(thetas), os.cpu_count() or 1)
        if n_threads <= 1:
            for i in range(len(thetas)):
                one(i)
            return SimulationBatch(response, reasons)
        with ThreadPoolExecutor(n_threads) as threads:
            try:
                list(threads.map(one, range(len(thetas))))
            except BaseException:  # Ctrl-C: cancel the simulations that have not begun
                threads.shutdown(wait=False, cancel_futures=True)
                raise
        return SimulationBatch(response, reasons)

    def _prepare(self) -> Any:
        raise NotImplementedError

    @cached_property
    def _prepared(self) -> Any:
        return self._prepare()

    def __getstate__(self) -> dict[str, Any]:
        """State without cached properties, such as the prepared inputs: each process computes its own."""
        cls = type(self)
        return {
            name: value
            for name, value in vars(self).items()
            if not isinstance(getattr(cls, name, None), cached_property)
        }


def remark_on_range(model: BuiltInModel, text: str) -> None:
    """Log the first warning about a model beyond the range of its laws; an empty text forbids further warnings."""
    if "_remark" not in vars(model):
        object.__setattr__(model, "_remark", text)
        if text:
            logger.warning("%s", text)


def _text(value: object) -> str:
    """Text that is equal for equal arguments: names and sources of records do not enter it."""
    if isinstance(value, Record | DisplacementHistory):
        return value.fingerprint
    if isinstance(value, np.ndarray):
        return array_digest(value)
    return repr(value)
