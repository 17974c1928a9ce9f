"""Two linear structures of few parameters: the deck of a short bridge, and a frame with one floor a storey.

Each is a frozen description, whose matrices `fe_likelihoods.models.linear_structure.LinearStructure` simulates. Neither
knows its mass: accelerations of supports cannot tell it from the stiffness.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..simulation.model import SimulationFailed
from .linear_structure import LinearSystem, modal_damping
from .validation import number

__all__ = ["BridgeDeck", "ShearFrame"]


@dataclass(frozen=True)
class BridgeDeck:
    """Transverse motion of a two-span deck, as one vibrating shape between a column in the middle and the two ends.

    With the acceleration a_c of the column's base and a_1, a_2 of the ends, the middle of the deck has the absolute
    acceleration y ::

        x'' + 2 zeta omega x' + omega^2 x = -[w (a_1 + a_2) / 2 + (1 - w) a_c],    y = -2 zeta omega x' - omega^2 x

    w is the share of the ends in what carries the middle: their stiffness, by way of the deck, over that and the
    column's together. A place within the first (second) span has (1 - s) a_1 + s y (with a_2): s = 1/2 half way if the
    halves of the deck stay straight, sin(pi / 4) if the deck swings as half a sine.

    Supports: the base of the column, the first end, the second end. Parameters: ``frequency`` omega / 2 pi [Hz],
    ``damping`` zeta, and ``share`` w and ``shape`` s unless they are given here.

    Parameters
    ----------
    middle : str
        Name of the channel in the middle, or "" if there is none.
    first_span, second_span : str
        Names of the channels within the spans, or "".
    share, shape : float, optional
        Fixed values, from 0 to 1; share=1 is a deck on its ends only, share=0 one on its column only.

    Raises
    ------
    ValueError
        If there is no channel, or a fixed value is not from 0 to 1.
    """

    middle: str = "middle"
    first_span: str = ""
    second_span: str = ""
    share: float | None = None
    shape: float | None = None

    n_supports = 3

    def __post_init__(self) -> None:
        if not self.channel_names:
            raise ValueError("BridgeDeck: expected the name of a channel in the middle or within a span; got none")
        for name in ("share", "shape"):
            value = getattr(self, name)
            if value is not None and not 0.0 <= value <= 1.0:
                raise ValueError(f"BridgeDeck: {name} must be a number from 0 to 1, or None if unknown; got {value!r}")

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``frequency``, ``damping``, and ``share`` and ``shape`` where unknown."""
        free = ["share"] if self.share is None else []
        free += ["shape"] if self.shape is None and (self.first_span or self.second_span) else []
        return ("frequency", "damping", *free)

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Those of the first span, the middle and the second span that have a name."""
        return tuple(name for name in (self.first_span, self.middle, self.second_span) if name)

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters; `SimulationFailed` for a frequency or damping that is not positive, or shares
        that are not from 0 to 1."""
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


@dataclass(frozen=True)
class ShearFrame:
    """A frame with rigid floors, one above the other, each held by the storey below and the storey above.

    Storey i below floor i has the shear stiffness theta_i k_i, floor i the mass m_i; the modes have the stated ratios
    of critical damping, slowest first. Parameters: ``stiffness_1`` ..., multiples of the nominal stiffnesses;
    ``damping_1`` ..., ratios [-]; ``mass_i`` of the floors in `free_masses`, multiples of their nominal masses. One
    floor's mass must stay fixed: only ratios of stiffness and mass show in accelerations.

    Parameters
    ----------
    floors : dict of str to int, or sequence of pairs
        Names of the channels, and the floors, from 1, that they are on.
    masses : sequence of float
        Nominal, one a floor, in any unit (relative ones will do).
    stiffnesses : sequence of float
        Nominal, one a storey, in that unit times 1/s² (N/m where the masses are in kg).
    free_masses : sequence of int
        Floors, from 1, whose masses are unknown.

    Raises
    ------
    ValueError
        If a floor does not exist, values are not positive, not one a floor, or no mass is fixed.
    """

    floors: tuple[tuple[str, int], ...]
    masses: tuple[float, ...]
    stiffnesses: tuple[float, ...]
    free_masses: tuple[int, ...] = ()

    n_supports = 1

    def __init__(self, floors, masses: Sequence[float], stiffnesses: Sequence[float], free_masses=()) -> None:
        floors = tuple(floors.items() if hasattr(floors, "items") else floors)
        for value in (*masses, *stiffnesses):
            number("mass or stiffness of a ShearFrame", value)
        n = len(masses)
        if n < 1 or len(stiffnesses) != n:
            raise ValueError(f"ShearFrame: expected a stiffness for each of {n} masses; got {len(stiffnesses)}")
        for floor in (*(floor for _, floor in floors), *free_masses):
            if floor not in range(1, n + 1):
                raise ValueError(f"ShearFrame: expected floors from 1 to {n}; got {floor!r}")
        if len(set(free_masses)) >= n or len(set(free_masses)) != len(free_masses):
            raise ValueError(
                f"ShearFrame: expected different floors, fewer than {n}, as free_masses; got {free_masses}"
            )
        object.__setattr__(self, "floors", tuple((str(name), int(floor)) for name, floor in floors))
        object.__setattr__(self, "masses", tuple(float(mass) for mass in masses))
        object.__setattr__(self, "stiffnesses", tuple(float(stiffness) for stiffness in stiffnesses))
        object.__setattr__(self, "free_masses", tuple(int(floor) for floor in free_masses))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``stiffness_1`` ... , ``damping_1`` ..., and ``mass_i`` of the free ones."""
        numbers = range(1, len(self.masses) + 1)
        names = [f"{what}_{i}" for what in ("stiffness", "damping") for i in numbers]
        return (*names, *(f"mass_{i}" for i in self.free_masses))

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the channels."""
        return tuple(name for name, _ in self.floors)

    def assemble(self, theta: np.ndarray) -> LinearSystem:
        """Matrices at the parameters; `SimulationFailed` for stiffness, mass or damping that is not positive."""
        if not (theta > 0.0).all():
            bad = [name for name, value in zip(self.parameter_names, theta, strict=True) if not value > 0.0]
            raise SimulationFailed(f"stiffnesses, dampings and masses must be positive; {', '.join(bad)} are not")
        n = len(self.masses)
        masses = np.array(self.masses)
        masses[[floor - 1 for floor in self.free_masses]] *= theta[2 * n :]
        storeys = theta[:n] * self.stiffnesses
        above = np.append(storeys[1:], 0.0)
        stiffness = np.diag(storeys + above) - np.diag(storeys[1:], 1) - np.diag(storeys[1:], -1)
        mass = np.diag(masses)
        shape = np.zeros((len(self.floors), n))
        shape[np.arange(len(self.floors)), [floor - 1 for _, floor in self.floors]] = 1.0
        return LinearSystem(
            mass=mass,
            damping=modal_damping(mass, stiffness, theta[n : 2 * n]),
            stiffness=stiffness,
            influence=np.ones((n, 1)),
            shape=shape,
            direct=np.zeros((len(self.floors), 1)),
        )
