"""Parts of a `LinearStructure` with few parameters for tall buildings on one support.

* `ModalModel`: frequencies, damping ratios and effective shapes of a few modes, without an assumption on the structure.
* `GroupedFrame`: a shear frame with one stiffness factor per group of storeys.
* `ShearFlexuralBeam`: a uniform cantilever between a shear and a flexural beam (Miranda & Taghavi 2005), with one
  parameter for the ratio of the two, whatever the number of storeys.

The equations are in ``docs/theory/tall_buildings.rst``.

References
----------
E. Miranda, S. Taghavi, Approximate floor acceleration demands in multistory buildings. I: Formulation, Journal of
Structural Engineering 131(2), 2005, 203-211, doi:10.1061/(ASCE)0733-9445(2005)131:2(203).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..simulation.model import SimulationFailed
from .linear_structure_parts import ShearFrame
from .linear_system import LinearSystem
from .validation import check_integer

__all__ = ["BeamModes", "GroupedFrame", "ModalModel", "ShearFlexuralBeam", "beam_modes"]

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


@dataclass(frozen=True)
class ShearFlexuralBeam:
    """Building as a uniform cantilever, a shear beam and a flexural beam side by side (Miranda & Taghavi 2005).

    The parameters are ``frequency``, the first natural frequency [Hz]; ``alpha``, the ratio of shear to flexural
    stiffness H sqrt(GA / EI); and ``damping``, the ratio of critical damping of all modes. alpha = 0 is a flexural beam
    (shear walls), alpha above about 20 a shear beam (moment frames), in between are buildings with both. Modes above
    the last one move with the base.

    Parameters
    ----------
    heights : dict of str to float, or sequence of pairs
        Names of the channels, and their heights above the base as shares of the building height, above 0 to 1.
    n_modes : int
        Number of modes.

    Raises
    ------
    ValueError
        If there is no channel, a height is not above 0 and at most 1, or the number of modes is not from 1 to 50.

    Examples
    --------
    >>> tower = ShearFlexuralBeam({"roof": 1.0, "floor 20": 0.5}, n_modes=5)
    >>> tower.parameter_names
    ('frequency', 'alpha', 'damping')
    >>> LinearStructure(tower, record).simulate([0.2, 6.0, 0.015]).shape
    (2, 200)
    """

    heights: Mapping[str, float] | Sequence[tuple[str, float]]
    n_modes: int = 5

    n_supports = 1

    def __post_init__(self) -> None:
        pairs = tuple(self.heights.items() if isinstance(self.heights, Mapping) else self.heights)
        names = _names("ShearFlexuralBeam", [name for name, _ in pairs])
        shares = tuple(float(height) for _, height in pairs)
        if not all(0.0 < share <= 1.0 for share in shares):
            raise ValueError(
                f"ShearFlexuralBeam: expected heights as shares of that of the building, above 0 to 1; got {shares}"
            )
        check_integer("n_modes of a ShearFlexuralBeam", self.n_modes, 1, _MOST_MODES)
        object.__setattr__(self, "heights", tuple(zip(names, shares, strict=True)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency``, ``alpha`` and ``damping``."""
        return ("frequency", "alpha", "damping")

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(name for name, _ in self.heights)

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Compute the matrices at the parameters (n_parameters,), with the modes as degrees of freedom.

        Raises
        ------
        SimulationFailed
            If the frequency or the damping is not positive, or alpha is negative or above 1000.
        """
        frequency, alpha, damping = theta.tolist()
        if not (frequency > 0.0 and damping > 0.0 and 0.0 <= alpha <= 1000.0):
            raise SimulationFailed(
                "frequency and damping must be positive, and alpha from 0 to 1000; they are "
                f"{frequency} Hz, {damping} and {alpha}"
            )
        modes = beam_modes(alpha, self.n_modes, np.array([height for _, height in self.heights]))
        frequencies = 2.0 * np.pi * frequency * modes.frequency_ratios
        return _modal_system(frequencies, np.full(self.n_modes, damping), modes.shapes)


class BeamModes(NamedTuple):
    """Modes of the shear-flexural beam."""

    frequency_ratios: np.ndarray  # (n_modes,) multiples of the first frequency
    shapes: np.ndarray  # (n_heights, n_modes) times participation factors [-], which add to 1 over all modes


def beam_modes(alpha: float, n_modes: int, heights: np.ndarray) -> BeamModes:
    """Modes of a uniform cantilever of shear and flexural stiffness (Miranda & Taghavi 2005, eqs. 7-13).

    `alpha` is H sqrt(GA / EI) >= 0, heights (n_heights,) are shares of the building height.
    """
    from scipy.optimize import brentq  # slow to import, and not needed for other structures

    def characteristic(gamma: float) -> float:
        # divided by cosh(beta), which overflows for large beta
        beta = math.hypot(gamma, alpha)
        inverse = 2.0 * math.exp(-beta) / (1.0 + math.exp(-2.0 * beta))
        return (
            2.0 * inverse
            + (2.0 + alpha**4 / (gamma * beta) ** 2) * math.cos(gamma)
            + alpha**2 / (gamma * beta) * math.sin(gamma) * math.tanh(beta)
        )

    # one root in each interval of pi: between the root of the shear beam, (k + 1/2) pi, and of the flexural beam
    roots = [brentq(characteristic, max(k * math.pi, 1e-3), (k + 1) * math.pi, xtol=1e-14) for k in range(n_modes)]
    gamma = np.array(roots)
    beta = np.hypot(gamma, alpha)
    ratios = gamma * beta
    return BeamModes(ratios / ratios[0], _beam_shapes(gamma, beta, heights))


def _beam_shapes(gamma: np.ndarray, beta: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Mode shapes times participation factors (n_heights, n_modes) at the roots gamma and beta (n_modes,).

    phi = sin(gamma x) - eta cos(gamma x) + eta cosh(beta x) - gamma / beta sinh(beta x), written with decaying
    exponentials only. The differential equation gives the integral of phi; the integral of phi^2 is a sum over products
    of the four terms.
    """
    small = np.exp(-beta)
    sine, cosine = np.sin(gamma), np.cos(gamma)
    denominator = 2.0 * gamma**2 * cosine * small + beta**2 * (1.0 + small**2)
    eta = (2.0 * gamma**2 * sine * small + gamma * beta * (1.0 - small**2)) / denominator
    rising = (gamma**2 * sine - gamma**3 / beta * cosine - gamma * beta * small) / denominator
    falling = 0.5 * (eta + gamma / beta)
    x = heights[:, None]
    phi = np.sin(gamma * x) - eta * np.cos(gamma * x)
    phi += rising * np.exp(beta * (x - 1.0)) + falling * np.exp(-beta * x)

    sum_of_squares = gamma**2 + beta**2
    # integrals over the height of sine and cosine times exp(beta (x - 1)), and times exp(-beta x)
    sine_rising = (beta * sine - gamma * cosine + gamma * small) / sum_of_squares
    cosine_rising = (beta * cosine + gamma * sine - beta * small) / sum_of_squares
    sine_falling = (gamma - small * (beta * sine + gamma * cosine)) / sum_of_squares
    cosine_falling = (beta + small * (gamma * sine - beta * cosine)) / sum_of_squares
    square = 0.5 * (1.0 + eta**2) - 0.5 / gamma * sine * ((1.0 - eta**2) * cosine + 2.0 * eta * sine)
    square += (rising**2 + falling**2) * 0.5 / beta * (1.0 - small**2) + 2.0 * rising * falling * small
    square += 2.0 * rising * (sine_rising - eta * cosine_rising)
    square += 2.0 * falling * (sine_falling - eta * cosine_falling)
    return sum_of_squares / (gamma * beta**2) / square * phi


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
