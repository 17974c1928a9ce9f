"""What an isolated bridge is made of: piers and devices, each checked when it is made; and its sets of channels.

The defaults are the quarter-scale bridge of NCEER 94-0002 as far as it could be reconstructed; most values are
**assumed** or recalled from sister reports (specs/isolated_bridge.md, section 4, says which).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .validation import number, refuse, whole_number

__all__ = ["CHANNEL_SETS", "Bearing", "Damper", "Pier", "Rubber"]

_PIER_1 = ("Ub_1", "Fb_1", "drift_1", "shear_1", "acc_p1")
_PIER_2 = ("Ub_2", "Fb_2", "drift_2", "shear_2", "acc_p2")
CHANNEL_SETS = {5: _PIER_1, 6: (*_PIER_1, "Ub_2"), 10: _PIER_1 + _PIER_2}
"""The sets of measured channels: the paper's five of pier 1, six (its figure of the fit), and both piers."""


@dataclass(frozen=True)
class Pier:
    """A cantilever fixed to the table, massless, with a rigid block at its tip that carries the isolators.

    Attributes
    ----------
    modulus, inertia, length : float
        Of the cantilever [Pa], [m4], [m].
    height : float
        Of the block [m]; the isolators stand on its top.
    center : float
        Height of the block's centre of mass above its bottom [m].
    mass, rotary_inertia : float
        Of the block [kg], [kg m2], the latter about its centre of mass.
    damping_ratio : float
        Of the pier alone in its first mode; damping is proportional to the stiffness.
    """

    modulus: float = 200e9
    inertia: float = 3.02e-5
    length: float = 1.60
    height: float = 0.30
    center: float = 0.15
    mass: float = 907.0
    rotary_inertia: float = 34.0
    damping_ratio: float = 0.02

    def __post_init__(self) -> None:
        for name in ("modulus", "inertia", "length", "mass", "rotary_inertia"):
            number(f"{name} of a pier", getattr(self, name))
        for name in ("height", "center", "damping_ratio"):
            number(f"{name} of a pier", getattr(self, name), zero=True)

    @property
    def stiffness(self) -> np.ndarray:
        """Of the tip in translation and rotation, (2, 2) [N/m, N, N m]."""
        length = self.length
        return (
            self.modulus
            * self.inertia
            / length**3
            * np.array([[12.0, -6.0 * length], [-6.0 * length, 4.0 * length**2]])
        )

    @property
    def mass_matrix(self) -> np.ndarray:
        """Of the block, moved by translation and rotation of its bottom, (2, 2) [kg, kg m, kg m2]."""
        first = self.mass * self.center
        return np.array([[self.mass, first], [first, self.rotary_inertia + first * self.center]])

    @property
    def damping(self) -> np.ndarray:
        """Proportional to the stiffness, (2, 2)."""
        lowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(self.mass_matrix, self.stiffness)).real.min())
        return 2.0 * self.damping_ratio / lowest * self.stiffness

    def geometric_stiffness(self, load: float, gravity: float) -> np.ndarray:
        """P-delta of the `load` on the block [N] and of the block itself, slider on the block, (2, 2), to be added."""
        length, axial = self.length, load + self.mass * gravity
        matrix = -axial / (30.0 * length) * np.array([[36.0, -3.0 * length], [-3.0 * length, 4.0 * length**2]])
        matrix[1, 1] -= load * self.height + self.mass * gravity * self.center
        return matrix


@dataclass(frozen=True)
class Bearing:
    """A flat sliding bearing: ``mu(v) = f_min + df (1 - exp(-a |v|))``.

    Attributes
    ----------
    load : float
        Weight that it carries [N].
    f_min, df : float
        Coefficient of friction at rest, and what a high velocity adds to it.
    a : float
        How fast it is added [s/m].
    yield_displacement : float
        Over which the regularised laws let the friction turn round [m]. It is physics, not numerics: peak pier
        accelerations differ by a third between .13 mm and none.
    gamma : float
        Of the Bouc-Wen law with A = 1, exponent 2 and beta = 1 - gamma: between .5 and 1.
    """

    load: float = 70e3
    f_min: float = 0.055
    df: float = 0.065
    a: float = 24.0
    yield_displacement: float = 0.13e-3
    gamma: float = 0.9

    def __post_init__(self) -> None:
        for name in ("load", "f_min", "yield_displacement"):
            number(f"{name} of a bearing", getattr(self, name))
        for name in ("df", "a"):
            number(f"{name} of a bearing", getattr(self, name), zero=True)
        number("gamma of a bearing", self.gamma)
        if not 0.5 < self.gamma <= 1.0:
            refuse("a gamma of a bearing above .5, up to 1", self.gamma, ".9 is the default")


@dataclass(frozen=True)
class Damper:
    """`count` linear fluid dampers at a pier, each a spring `stiffness` [N/m] and a dashpot `viscosity` [N s/m]."""

    stiffness: float = 2575e3
    viscosity: float = 15.45e3
    count: int = 2

    def __post_init__(self) -> None:
        number("stiffness of a damper", self.stiffness)
        number("viscosity of a damper", self.viscosity)
        whole_number("count of dampers", self.count, 1, 1000)


@dataclass(frozen=True)
class Rubber:
    """A rubber restoring-force device, the same at both piers, with s = displacement / scale.

    Attributes
    ----------
    skeleton : 6 floats
        A_1, A_3 ... A_11 [N]: force sum A_n s^n.
    half_loop : 3 floats
        B_0, B_2, B_4 [N]: half the distance of the branches of loading and unloading, sum B_m s^m.
    scale : float
        [m]
    limit : float
        Beyond \\|s\\| = limit the skeleton goes on along its tangent.
    """

    skeleton: tuple[float, ...] = (8500.0, 250.0, 100.0, 150.0, 1500.0, 7500.0)
    half_loop: tuple[float, ...] = (450.0, 100.0, 250.0)
    scale: float = 0.050
    limit: float = 1.2

    def __post_init__(self) -> None:
        for name, count in (("skeleton", 6), ("half_loop", 3)):
            values = tuple(getattr(self, name))
            if len(values) != count:
                refuse(
                    f"{count} coefficients of the {name} of rubber", values, "give zeros for those that are not used"
                )
            for value in values:
                number(f"coefficient of the {name} of rubber", value, any_sign=True)
            object.__setattr__(self, name, values)
        number("scale of rubber", self.scale)
        number("limit of rubber", self.limit)
        s = np.linspace(0.0, self.limit, 200)
        tangent = sum(a * n * s ** (n - 1) for a, n in zip(self.skeleton, range(1, 12, 2), strict=True))
        if tangent.min() < 0.0:
            refuse("a skeleton of rubber that rises up to its limit", self.skeleton, "a falling one has no one answer")
        if sum(b * s**m for b, m in zip(self.half_loop, (0, 2, 4), strict=True)).min() < 0.0:
            refuse("a half loop of rubber that is nowhere negative", self.half_loop, "it would give energy away")
