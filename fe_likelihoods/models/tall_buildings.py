"""Parts of a `LinearStructure` with few parameters for tall buildings on one support.

* `ModalModel`: frequencies, damping ratios and effective shapes of a few modes, without an assumption on the structure.
* `GroupedFrame`: a shear frame with one stiffness factor per group of storeys.

The equations are in ``docs/theory/tall_buildings.rst``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..simulation.model import SimulationFailed
from .linear_structure_parts import ShearFrame
from .linear_system import LinearSystem
from .validation import check_integer

__all__ = ["GroupedFrame", "ModalModel"]

_MOST_MODES = 50


@dataclass(frozen=True)
class ModalModel:
    """A building on one support as a sum of modes, whose properties at the sensors are the parameters.

    With the relative displacement u_k of an oscillator with the frequency and the damping of mode k, channel c has the
    absolute acceleration a + sum_k s_ck u_k''. The effective shape s_ck is the participation factor times the mode
    shape at the sensor; its sum over all modes of a structure is 1. Modes that are left out are stiff: they move with
    the support, with the remaining share 1 - sum_k s_ck.

    The parameters are ``frequency_1``, ... [Hz], in ascending order; ``damping_1``, ...; and ``shape_<channel>_1``, ...
    for each channel.

    Parameters
    ----------
    channels : sequence of str
        Names of the channels.
    n_modes : int
        Number of modes.

    Raises
    ------
    ValueError
        If there is no channel, or the number of modes is not from 1 to 50.

    Examples
    --------
    >>> tower = ModalModel(["roof", "floor 20"], n_modes=1)
    >>> tower.parameter_names
    ('frequency_1', 'damping_1', 'shape_roof_1', 'shape_floor 20_1')
    >>> LinearStructure(tower, record).simulate([0.2, 0.02, 1.4, 0.7]).shape
    (2, 200)
    """

    channels: Sequence[str]
    n_modes: int

    n_supports = 1

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", _names("ModalModel", self.channels))
        check_integer("n_modes of a ModalModel", self.n_modes, 1, _MOST_MODES)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency_1``, ..., ``damping_1``, ..., and ``shape_<channel>_1``, ..., channel by channel."""
        what = ("frequency", "damping", *(f"shape_{channel}" for channel in self.channels))
        return tuple(f"{each}_{k}" for each in what for k in range(1, self.n_modes + 1))

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return self.channels

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Compute the matrices at the parameters (n_parameters,), with the modes as degrees of freedom.

        Raises
        ------
        SimulationFailed
            If the frequencies are not positive and ascending, or a damping ratio is not positive.
        """
        n = self.n_modes
        frequencies, ratios, shapes = theta[:n], theta[n : 2 * n], theta[2 * n :].reshape(-1, n)
        if not (frequencies[0] > 0.0 and (np.diff(frequencies) > 0.0).all()):
            raise SimulationFailed(f"frequencies must be positive and ascending; they are {_listed(frequencies)} Hz")
        if not (ratios > 0.0).all():
            raise SimulationFailed(f"damping ratios must be positive; they are {_listed(ratios)}")
        return _modal_system(2.0 * np.pi * frequencies, ratios, shapes)


@dataclass(frozen=True)
class GroupedFrame(ShearFrame):
    """Shear frame whose storeys share one stiffness factor per group, with one damping ratio.

    The parameters are ``stiffness_1``, ..., the multiples of the nominal stiffnesses of the storeys in each group, and
    ``damping``, the ratio of critical damping of all modes.

    Parameters
    ----------
    floors, masses, stiffnesses
        As for `ShearFrame`.
    groups : sequence of int
        Group of each storey, from the lowest one: 1 to the number of groups, each of which has a storey. Groups usually
        end where the section of the columns changes.

    Raises
    ------
    ValueError
        As `ShearFrame`, and if `groups` do not fit.

    Examples
    --------
    >>> tower = GroupedFrame({"roof": 6}, [1.0] * 6, [900.0] * 6, groups=[1, 1, 1, 2, 2, 2])
    >>> tower.parameter_names
    ('stiffness_1', 'stiffness_2', 'damping')
    >>> (acceleration,) = LinearStructure(tower, record).simulate([1.1, 0.9, 0.02])
    """

    groups: Sequence[int]

    def __post_init__(self) -> None:
        super().__post_init__()
        groups, n = tuple(self.groups), len(self.masses)
        if len(groups) != n or set(groups) != set(range(1, max(groups, default=0) + 1)):
            raise ValueError(
                f"GroupedFrame: expected the group of each of {n} storeys, numbers from 1 without gaps; got {groups!r}"
            )
        object.__setattr__(self, "groups", tuple(map(int, groups)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``stiffness_1``, ..., one per group, and ``damping``."""
        return (*(f"stiffness_{group}" for group in range(1, max(self.groups) + 1)), "damping")

    def _system(self, factors: np.ndarray, ratios: np.ndarray) -> LinearSystem:
        return super()._system(factors[np.array(self.groups) - 1], np.full(len(self.masses), ratios[-1]))


def _modal_system(frequencies: np.ndarray, ratios: np.ndarray, shapes: np.ndarray) -> LinearSystem:
    """Matrices with the modes as degrees of freedom: angular frequencies [rad/s], ratios, effective shapes."""
    n = len(frequencies)
    return LinearSystem(
        mass=np.eye(n),
        damping=np.diag(2.0 * ratios * frequencies),
        stiffness=np.diag(np.square(frequencies)),
        influence=np.ones((n, 1)),
        shape=shapes,
        direct=1.0 - shapes.sum(axis=1, keepdims=True),
    )


def _names(kind: str, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str) or not names or not all(isinstance(name, str) and name for name in names):
        raise ValueError(f"{kind}: expected the names of one or more channels; got {names!r}")
    return tuple(names)


def _listed(values: np.ndarray) -> str:
    return ", ".join(f"{value:.4g}" for value in values)
