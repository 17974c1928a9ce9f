"""Matrices of linear structures, and structures with few parameters: a bridge deck, a shear frame, a sum of modes.

They give the matrices that `fe_likelihoods.models.linear_structure.LinearStructure` simulates. Masses are relative,
because accelerations of supports identify only the ratio of stiffness to mass. The equations of buildings are in
``docs/theory/tall_buildings.rst``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from scipy.linalg import eigh

from ..simulation.model import SimulationFailed
from .validation import check_integer, check_number, described, structure

_MOST_MODES = 50


class LinearSystem(NamedTuple):
    """Matrices of a linear structure with n degrees of freedom, and the positions of its sensors.

    Units need only be consistent: M^-1 C [1/s] and M^-1 K [1/s²] matter.
    """

    mass: np.ndarray  # (n, n)
    damping: np.ndarray  # (n, n)
    stiffness: np.ndarray  # (n, n)
    influence: np.ndarray  # (n, n_supports) static displacements under unit support displacements [-]
    shape: np.ndarray  # (n_channels, n) weight of each absolute acceleration in a channel [-]
    direct: np.ndarray  # (n_channels, n_supports) weight of each support acceleration [-]


class Structure(Protocol):
    """Interface of the structures that `LinearStructure` simulates; their ``repr`` enters the fingerprint."""

    parameter_names: tuple[str, ...]
    n_supports: int
    channel_names: tuple[str, ...]  # of absolute accelerations

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters (n_parameters,); raises `SimulationFailed` if they describe no structure."""


def _modal_damping(mass: np.ndarray, stiffness: np.ndarray, ratios: np.ndarray) -> np.ndarray:
    """Damping matrix (n, n) of modal damping ratios (n,): C = M Phi diag(2 zeta omega) Phi^T M.

    Mass and stiffness are symmetric; Phi are the undamped modes, lowest frequency first. Raises SimulationFailed if the
    stiffness is not positive definite.
    """
    squares, modes = eigh(stiffness, mass)
    if not squares[0] > 0.0:
        raise SimulationFailed(
            f"the stiffness must be positive definite; its smallest eigenvalue is {squares[0]:g} 1/s2"
        )
    return mass @ (modes * (2.0 * np.asarray(ratios) * np.sqrt(squares))) @ modes.T @ mass


@structure
@dataclass(frozen=True)
class BridgeDeck:
    """Transverse vibration of a two-span deck in one shape, on a column in the middle and on its two ends.

    With the accelerations a_c of the column base and a_1, a_2 of the deck ends, the middle of the deck has the absolute
    acceleration y ::

        x'' + 2 zeta omega x' + omega^2 x = -[w (a_1 + a_2) / 2 + (1 - w) a_c],    y = -2 zeta omega x' - omega^2 x

    w is the share of the ends in the stiffness that supports the middle. A point in the first span has the acceleration
    (1 - s) a_1 + s y, a point in the second span (1 - s) a_2 + s y. At the middle of a span, s = 1/2 if the halves of
    the deck remain straight, and s = sin(pi / 4) if the deck vibrates as half a sine.

    The supports are the base of the column, the first end and the second end. The parameters are ``frequency``
    omega / 2 pi [Hz], ``damping`` zeta, and ``share`` w and ``shape`` s unless they are given here.

    Raises
    ------
    ValueError
        If there is no channel, or a fixed value is not between 0 and 1.

    Examples
    --------
    >>> deck = BridgeDeck("middle", share=0.8)
    >>> deck.parameter_names
    ('frequency', 'damping')
    >>> bridge = LinearStructure(deck, [record, record, record])  # base of the column, both ends
    >>> bridge.simulate([3.5, 0.05]).shape
    (1, 200)
    """

    middle: str = described("", 'Name of the channel in the middle, or "" if there is none', default="middle")
    first_span: str = described("", 'Name of the channel in the first span, or "" if there is none', default="")
    second_span: str = described("", 'Name of the channel in the second span, or "" if there is none', default="")
    share: float | None = described(
        "",
        "Fixed share of the ends in the stiffness, from 0 (on the column only) to 1 (on the ends only)",
        default=None,
    )
    shape: float | None = described("", "Fixed value s of the shape in the spans, from 0 to 1", default=None)

    n_supports = 3

    def __post_init__(self) -> None:
        if not self.channel_names:
            raise ValueError("BridgeDeck: expected the name of a channel in the middle or in a span; got none")
        for name, value in (("share", self.share), ("shape", self.shape)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise ValueError(f"BridgeDeck: {name} must be a number from 0 to 1, or None if unknown; got {value!r}")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency``, ``damping``, and ``share`` and ``shape`` unless they are given."""
        free = ["share"] if self.share is None else []
        free += ["shape"] if self.shape is None and (self.first_span or self.second_span) else []
        return ("frequency", "damping", *free)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels that exist, in the order first span, middle, second span."""
        return tuple(name for name in (self.first_span, self.middle, self.second_span) if name)

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters (n_parameters,); SimulationFailed if they are impossible."""
        values = dict(share=self.share, shape=self.shape) | dict(zip(self.parameter_names, theta.tolist(), strict=True))
        frequency, damping, share = (values[name] for name in ("frequency", "damping", "share"))
        shape = 0.0 if values["shape"] is None else values["shape"]
        if not (frequency > 0.0 and damping > 0.0):
            raise SimulationFailed(f"frequency and damping must be positive; they are {frequency} Hz and {damping}")
        if not (0.0 <= share <= 1.0 and 0.0 <= shape <= 1.0):
            raise SimulationFailed(f"share and shape must be from 0 to 1; they are {share} and {shape}")
        omega = 2.0 * math.pi * frequency
        rows = {
            self.first_span: (shape, [0.0, 1.0 - shape, 0.0]),
            self.middle: (1.0, [0.0, 0.0, 0.0]),
            self.second_span: (shape, [0.0, 0.0, 1.0 - shape]),
        }
        return LinearSystem(
            mass=np.eye(1),
            damping=np.array([[2.0 * damping * omega]]),
            stiffness=np.array([[omega**2]]),
            influence=np.array([[1.0 - share, 0.5 * share, 0.5 * share]]),
            shape=np.array([[rows[name][0]] for name in self.channel_names]),
            direct=np.array([rows[name][1] for name in self.channel_names]),
        )


@structure
@dataclass(frozen=True)
class ShearFrame:
    """Frame with rigid floors, each connected to the storey below and the storey above.

    Storey i, below floor i, has the shear stiffness theta_i k_i; floor i has the mass m_i. The modes have the given
    ratios of critical damping, lowest frequency first. The parameters are ``stiffness_1``, ``stiffness_2``, ...,
    multiples of the nominal stiffnesses; and ``damping_1``, ``damping_2``, ..., ratios [-]. With `groups`, the storeys
    of a group share a multiple, and all modes the ratio ``damping``. Masses are known, because accelerations identify
    only the ratios of stiffness to mass.

    Raises
    ------
    ValueError
        If a floor does not exist, values are not positive, their numbers differ, or `groups` do not fit.

    Examples
    --------
    >>> frame = ShearFrame({"floor 1": 1, "roof": 2}, masses=[1.0, 1.0], stiffnesses=[900.0, 900.0])
    >>> frame.parameter_names
    ('stiffness_1', 'stiffness_2', 'damping_1', 'damping_2')
    >>> LinearStructure(frame, record).simulate([1.0, 1.0, 0.03, 0.03]).shape
    (2, 200)
    >>> ShearFrame({"roof": 6}, [1.0] * 6, [900.0] * 6, groups=[1, 1, 1, 2, 2, 2]).parameter_names
    ('stiffness_1', 'stiffness_2', 'damping')
    """

    floors: Mapping[str, int] | Sequence[tuple[str, int]] = described(
        "", "Names of the channels, and the floors they are on, counted from 1", kind="table of whole number"
    )
    masses: Sequence[float] = described("", "Nominal mass of each floor, in any unit; relative masses are sufficient")
    stiffnesses: Sequence[float] = described(
        "",
        "Nominal stiffness of each storey, in the unit of the masses times 1/s² (N/m if the masses are in kg)",
    )
    groups: Sequence[int] | None = described(
        "",
        "Group of each storey, from the lowest one: 1 to the number of groups, each of which has a storey",
        default=None,
        more="Groups usually end where the section of the columns changes.",
    )

    n_supports = 1

    def __post_init__(self) -> None:
        floors = tuple(self.floors.items() if isinstance(self.floors, Mapping) else self.floors)
        for value in (*self.masses, *self.stiffnesses):
            check_number("positive", "mass or stiffness of a ShearFrame", value)
        n = len(self.masses)
        if n < 1 or len(self.stiffnesses) != n:
            raise ValueError(f"ShearFrame: expected a stiffness for each of {n} masses; got {len(self.stiffnesses)}")
        for _, floor in floors:
            if floor not in range(1, n + 1):
                raise ValueError(f"ShearFrame: expected floors from 1 to {n}; got {floor!r}")
        groups = None if self.groups is None else tuple(map(int, self.groups))
        if groups is not None and (len(groups) != n or set(groups) != set(range(1, max(groups, default=0) + 1))):
            raise ValueError(
                f"ShearFrame: expected the group of each of {n} storeys, numbers from 1 without gaps; got {groups!r}"
            )
        object.__setattr__(self, "groups", groups)
        object.__setattr__(self, "floors", tuple((str(name), int(floor)) for name, floor in floors))
        object.__setattr__(self, "masses", tuple(map(float, self.masses)))
        object.__setattr__(self, "stiffnesses", tuple(map(float, self.stiffnesses)))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``stiffness_1``, ..., and ``damping_1``, ... or, with groups, ``damping``."""
        numbers = range(1, (len(self.masses) if self.groups is None else max(self.groups)) + 1)
        dampings = ("damping",) if self.groups else (f"damping_{i}" for i in numbers)
        return (*(f"stiffness_{i}" for i in numbers), *dampings)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(name for name, _ in self.floors)

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters (n_parameters,); SimulationFailed if one is not positive."""
        if not (theta > 0.0).all():
            bad = [name for name, value in zip(self.parameter_names, theta, strict=True) if not value > 0.0]
            raise SimulationFailed(f"stiffnesses and dampings must be positive; not positive: {', '.join(bad)}")
        n = len(self.masses)
        if self.groups is None:
            factors, ratios = theta[:n], theta[n:]
        else:
            factors, ratios = theta[np.array(self.groups) - 1], np.full(n, theta[-1])
        storeys = factors * self.stiffnesses
        above = np.append(storeys[1:], 0.0)
        stiffness = np.diag(storeys + above) - np.diag(storeys[1:], 1) - np.diag(storeys[1:], -1)
        mass = np.diag(self.masses)
        shape = np.zeros((len(self.floors), n))
        shape[np.arange(len(self.floors)), [floor - 1 for _, floor in self.floors]] = 1.0
        return LinearSystem(
            mass=mass,
            damping=_modal_damping(mass, stiffness, ratios),
            stiffness=stiffness,
            influence=np.ones((n, 1)),
            shape=shape,
            direct=np.zeros((len(self.floors), 1)),
        )


@structure
@dataclass(frozen=True)
class ModalModel:
    """A building on one support as a sum of modes, whose properties at the sensors are the parameters.

    With the relative displacement u_k of an oscillator with the frequency and the damping of mode k, channel c has the
    absolute acceleration a + sum_k s_ck u_k''. The effective shape s_ck is the participation factor times the mode
    shape at the sensor; its sum over all modes of a structure is 1. Modes that are left out are stiff: they move with
    the support, with the remaining share 1 - sum_k s_ck.

    The parameters are ``frequency_1``, ... [Hz], in ascending order; ``damping_1``, ...; and ``shape_<channel>_1``, ...
    for each channel.

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

    channels: Sequence[str] = described("", "Names of the channels")
    n_modes: int = described("", "Number of modes")

    n_supports = 1

    def __post_init__(self) -> None:
        names = self.channels
        if isinstance(names, str) or not names or not all(isinstance(name, str) and name for name in names):
            raise ValueError(f"ModalModel: expected the names of one or more channels; got {names!r}")
        object.__setattr__(self, "channels", tuple(names))
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
        """Matrices at the parameters (n_parameters,), with the modes as degrees of freedom.

        SimulationFailed if frequencies are not positive and ascending, or a damping ratio is not positive.
        """
        n = self.n_modes
        frequencies, ratios, shapes = theta[:n], theta[n : 2 * n], theta[2 * n :].reshape(-1, n)
        if not (frequencies[0] > 0.0 and (np.diff(frequencies) > 0.0).all()):
            listed = ", ".join(f"{value:.4g}" for value in frequencies)
            raise SimulationFailed(f"frequencies must be positive and ascending; they are {listed} Hz")
        if not (ratios > 0.0).all():
            raise SimulationFailed(f"damping ratios must be positive; they are {ratios}")
        omegas = 2.0 * np.pi * frequencies
        return LinearSystem(
            mass=np.eye(n),
            damping=np.diag(2.0 * ratios * omegas),
            stiffness=np.diag(np.square(omegas)),
            influence=np.ones((n, 1)),
            shape=shapes,
            direct=1.0 - shapes.sum(axis=1, keepdims=True),
        )
