"""Base classes for the models of this package.

`StructuralModel` checks the shape of the parameters and plots the response. `BuiltInModel` adds what the built-in
structures share: parameters that are multiples of nominal values, and a fingerprint computed from the arguments. Models
of your own need neither: any object with the attributes of `fe_likelihoods.simulation.model.Model` is a model.
"""

from __future__ import annotations

import hashlib
import logging
import weakref
from dataclasses import dataclass, fields
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ..signals.channels import Channel
from ..signals.records import DisplacementHistory, Record
from ..signals.sampling import array_digest
from .validation import check_theta, invalid

__all__ = ["BuiltInModel", "History", "StructuralModel", "digest", "remark_on_range"]

logger = logging.getLogger(__name__)

_REMARKS: weakref.WeakKeyDictionary[BuiltInModel, str] = weakref.WeakKeyDictionary()


def digest(*parts: str) -> str:
    """Hexadecimal digest of texts, in order."""
    return hashlib.blake2b("|".join(parts).encode(), digest_size=16).hexdigest()


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
        """Simulate the structure for one set of parameters.

        Parameters
        ----------
        theta : ndarray[n_parameters]
            Values of `parameter_names`, in this order.

        Returns
        -------
        ndarray[n_channels, n_steps]
            Response [SI].

        Raises
        ------
        SimulationFailed
            If the parameters describe no structure, or the solution does not converge.
        ValueError
            If `theta` has another shape.
        """
        return self._respond(check_theta(theta, self.parameter_names))

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class BuiltInModel(StructuralModel):
    """Base class for frozen dataclasses that describe a structure with nominal values.

    A subclass has the field `parameters` and the property `nominal`.
    """

    parameters: tuple[str, ...]
    _nominal_units: ClassVar[dict[str, str]] = {}
    _display_fields: ClassVar[tuple[str, ...]] = ("outputs", "unit", "units")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the elements in theta, which are multiples of the values in `nominal`."""
        return self.parameters

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        raise NotImplementedError

    @property
    def nominal_units(self) -> dict[str, str]:
        """Units in which the nominal values are shown, by parameter."""
        return self._nominal_units

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
        return _REMARKS.get(self, "")

    def physical_values(self, theta: np.ndarray) -> dict[str, float]:
        """Physical values [SI] of all parameters at the multiples `theta` (n_parameters,) of the nominal values."""
        values = self.nominal
        for name, multiple in zip(self.parameters, theta.tolist(), strict=True):
            values[name] *= multiple
        return values


def remark_on_range(model: BuiltInModel, text: str) -> None:
    """Log the first warning about a model beyond the range of its laws; an empty text forbids further warnings."""
    if model not in _REMARKS:
        _REMARKS[model] = text
        if text:
            logger.warning("%s", text)


def _text(value: object) -> str:
    """Text that is equal for equal arguments: names and sources of records do not enter it."""
    if isinstance(value, Record | DisplacementHistory):
        return value.fingerprint
    if isinstance(value, np.ndarray):
        return array_digest(value)
    return repr(value)
