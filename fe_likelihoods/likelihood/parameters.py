"""What the parameters of a likelihood are: units, nominal values and labels, for tables and figures.

Densities and samplers work with plain numbers: structural parameters in the model's own convention, often multiples of
nominal values, and noise parameters in SI units. `Parameter` says how to show such a number to a reader.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from ..noise.gaussian import GaussianNoise
from ..noise.marginal import sampled_noise
from ..noise.protocol import Noise, noise_channels
from ..signals.channels import Channel
from ..simulation.model import Model
from ..units import find_unit

__all__ = ["Parameter", "channels_of_deviations", "describe_parameters", "parameter_of"]


class Parameter(NamedTuple):
    """What is known of one parameter.

    Attributes
    ----------
    name : str
        Its name.
    unit : str
        Unit in which it is shown: "-" for multiples of nominal values and other numbers without a unit, empty where the
        unit is not known.
    factor : float
        Size of that unit in the unit of the samples: a sample divided by `factor` is in `unit`.
    nominal : float
        Nominal value, in the unit of the samples: 1 for multiples of nominal values, NaN where none is known.
    multiple_of : str
        What a multiple is a multiple of, such as "28.3 GPa"; empty for other parameters.

    Examples
    --------
    >>> [parameter.label for parameter in posterior.parameters]
    ['stiffness [x nominal]', 'damping [x nominal]', 'sigma_acceleration [g]', 'sigma_displacement [cm]']
    """

    name: str
    unit: str = ""
    factor: float = 1.0
    nominal: float = np.nan
    multiple_of: str = ""

    @property
    def label(self) -> str:
        """Name and unit, for axes and tables: "sigma_top [mm]", "Ec [x 28.3 GPa]", "damping"."""
        unit = f"x {self.multiple_of}" if self.multiple_of else self.unit
        return f"{self.name} [{unit}]" if unit else self.name

    def shown(self, values: np.ndarray) -> np.ndarray:
        """Values of samples in the unit in which the parameter is shown."""
        return np.asarray(values, dtype=float) / self.factor


def describe_parameters(model: Model, noise: Noise) -> tuple[Parameter, ...]:
    """Describe the parameters of a model and of a noise, in this order, from the optional members of the model.

    These map names: ``nominal`` to the nominal values [SI] of which the parameters are multiples, ``nominal_units`` to
    the units in which these are shown, and ``parameter_units`` to the units of other parameters in words.
    """
    return (*(parameter_of(model, name) for name in model.parameter_names), *_of_noise(noise, model.channels))


def parameter_of(model: Any, name: str) -> Parameter:
    """A parameter of a model, or of a function that has these members as well."""
    units, nominal = getattr(model, "parameter_units", {}), getattr(model, "nominal", {})
    if name in units:
        return Parameter(name, str(units[name]))
    if not isinstance(nominal, Mapping) or name not in nominal:
        return Parameter(name)
    unit = str(getattr(model, "nominal_units", {}).get(name, ""))
    value = nominal[name]
    with suppress(ValueError):  # the nominal value itself where its unit is not known
        value = value / find_unit(unit).factor
    return Parameter(name, "-", 1.0, 1.0, f"{value:.4g} {unit}".rstrip(" -"))


def channels_of_deviations(noise: Noise, default: Sequence[Channel]) -> dict[str, Channel]:
    """Channel of each noise parameter that is a standard deviation in the unit of a channel, by name.

    `default`: the channels of the model, for a noise that does not specify its own.
    """
    sampled = sampled_noise(noise)
    if hasattr(sampled, "parameter_channels"):
        return sampled.parameter_channels
    return {f"sigma_{channel.name}": channel for channel in noise_channels(sampled, default)}


def _of_noise(noise: Noise, default: Sequence[Channel]) -> Iterator[Parameter]:
    sampled, channels = sampled_noise(noise), channels_of_deviations(noise, default)
    for name in noise.parameter_names:
        if (channel := channels.get(name)) is not None:
            yield Parameter(name, channel.unit, find_unit(channel.unit, channel.dimension).factor)
        else:
            dimensionless = name.startswith(("rho_", "share_")) or isinstance(sampled, GaussianNoise)
            yield Parameter(name, "-" if dimensionless else "")
