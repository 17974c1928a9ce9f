"""Parts of the isolated bridge: piers, bearings, dampers and rubber devices, checked when made; and its channels.

The defaults describe the quarter-scale bridge of Tsopelas et al., NCEER 94-0002 (1994), as far as it could be
reconstructed. Most values are **assumed**, or taken from related reports without verification;
``docs/theory/isolated_bridge.rst`` says which.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..signals.channels import Channel
from .validation import check_described, check_integer, check_number, described, invalid, structure


@structure
@dataclass(frozen=True)
class Pier:
    """Massless cantilever, fixed to the table, with a rigid block at its tip that carries the isolators."""

    modulus: float = described("Pa", "Elastic modulus of the cantilever", "positive", 200e9)
    inertia: float = described("m⁴", "Second moment of area of the cantilever", "positive", 3.02e-5)
    length: float = described("m", "Length of the cantilever", "positive", 1.60)
    height: float = described("m", "Height of the block; the isolators are on its top", "zero or positive", 0.30)
    center: float = described("m", "Height of the block's centre of mass above its bottom", "zero or positive", 0.15)
    mass: float = described("kg", "Mass of the block", "positive", 907.0)
    rotary_inertia: float = described("kg m²", "Rotary inertia of the block about its centre of mass", "positive", 34.0)
    damping_ratio: float = described("", "Damping ratio of the pier alone in its first mode", "zero or positive", 0.02)

    def __post_init__(self) -> None:
        check_described(self, "of a pier")

    @property
    def stiffness(self) -> np.ndarray:
        """Stiffness of the tip in translation and rotation, (2, 2) [N/m, N, N m]."""
        length = self.length
        return (
            self.modulus
            * self.inertia
            / length**3
            * np.array([[12.0, -6.0 * length], [-6.0 * length, 4.0 * length**2]])
        )

    @property
    def mass_matrix(self) -> np.ndarray:
        """Mass matrix of the block for translation and rotation of its bottom, (2, 2) [kg, kg m, kg m²]."""
        first = self.mass * self.center
        return np.array([[self.mass, first], [first, self.rotary_inertia + first * self.center]])

    @property
    def damping(self) -> np.ndarray:
        """Damping matrix, proportional to the stiffness, (2, 2) [N s/m, N s, N m s]."""
        lowest = np.sqrt(np.linalg.eigvals(np.linalg.solve(self.mass_matrix, self.stiffness)).real.min())
        return 2.0 * self.damping_ratio / lowest * self.stiffness


@structure
@dataclass(frozen=True)
class Bearing:
    """Flat sliding bearing with the friction coefficient ``mu(v) = f_min + df (1 - exp(-a |v|))``.

    Examples
    --------
    >>> from fe_likelihoods.models.isolated_bridge_bearings import Bearing
    >>> rough = Bearing(load=70e3, f_min=0.08)
    >>> bridge = IsolatedBridge(record.resample(0.005), bearings=(rough, rough))
    """

    load: float = described("N", "Weight on the bearing", "positive", 70e3)
    f_min: float = described("", "Friction coefficient at rest", "positive", 0.055)
    df: float = described("", "Increase of the friction coefficient at high velocity", "zero or positive", 0.065)
    a: float = described("s/m", "Rate of this increase with velocity", "zero or positive", 24.0)
    yield_displacement: float = described(
        "m",
        "Displacement over which the regularised laws reverse the friction force",
        "positive",
        0.13e-3,
        "It is a physical property, not a numerical setting: peak pier accelerations differ by a third between 0.13 mm "
        "and zero.",
    )
    gamma: float = described(
        "", "Constant of the Bouc-Wen law (A = 1, exponent 2, beta = 1 - gamma); above 0.5, at most 1", "positive", 0.9
    )

    def __post_init__(self) -> None:
        check_described(self, "of a bearing")
        if not 0.5 < self.gamma <= 1.0:
            raise invalid("a gamma of a bearing above 0.5, at most 1", self.gamma, "the default is 0.9")


@structure
@dataclass(frozen=True)
class Damper:
    """Linear fluid dampers at a pier, each a spring and a dashpot in series (Maxwell element).

    Examples
    --------
    >>> from fe_likelihoods.models.isolated_bridge_bearings import Damper
    >>> softer = Damper(viscosity=10e3, count=1)
    >>> bridge = IsolatedBridge(record.resample(0.005), dampers=(softer, softer))
    """

    stiffness: float = described("N/m", "Spring stiffness of one damper", "positive", 2575e3)
    viscosity: float = described("N s/m", "Dashpot coefficient of one damper", "positive", 15.45e3)
    count: int = described("", "Number of dampers at the pier", default=2)

    def __post_init__(self) -> None:
        check_described(self, "of a damper")
        check_integer("count of dampers", self.count, 1, 1000)


@structure
@dataclass(frozen=True)
class Rubber:
    """Rubber restoring-force device, the same at both piers, with s = displacement / scale."""

    skeleton: tuple[float, ...] = described(
        "N",
        "The 6 coefficients A_1, A_3, ..., A_11 of the skeleton curve, sum of A_n s^n",
        default=(8500.0, 250.0, 100.0, 150.0, 1500.0, 7500.0),
    )
    half_loop: tuple[float, ...] = described(
        "N",
        "The 3 coefficients B_0, B_2, B_4 of half the difference of loading and unloading branch, sum of B_m s^m",
        default=(450.0, 100.0, 250.0),
    )
    scale: float = described("m", "Displacement at s = 1", "positive", 0.050)
    limit: float = described(
        "", "Value of abs(s) beyond which the skeleton curve continues along its tangent", "positive", 1.2
    )

    def __post_init__(self) -> None:
        for name, given, count in (("skeleton", self.skeleton, 6), ("half_loop", self.half_loop, 3)):
            values = tuple(given)
            if len(values) != count:
                raise invalid(f"{count} coefficients of the {name} of rubber", values, "set unused ones to zero")
            for value in values:
                check_number("finite", f"coefficient of the {name} of rubber", value)
            object.__setattr__(self, name, values)
        check_described(self, "of rubber")
        s = np.linspace(0.0, self.limit, 200)
        tangent = sum(a * n * s ** (n - 1) for a, n in zip(self.skeleton, range(1, 12, 2), strict=True))
        if tangent.min() < 0.0:
            raise invalid(
                "a skeleton of rubber that increases up to its limit",
                self.skeleton,
                "with a decreasing one the response would not be unique",
            )
        if sum(b * s**m for b, m in zip(self.half_loop, (0, 2, 4), strict=True)).min() < 0.0:
            raise invalid(
                "a half loop of rubber that is nowhere negative", self.half_loop, "a negative one would create energy"
            )

    @property
    def linear_stiffness(self) -> float:
        """Stiffness of the linear term of the skeleton curve [N/m]."""
        return self.skeleton[0] / self.scale


OF_A_PIER = {
    "Ub": ("bearing displacement", "mm"),
    "Fb": ("isolator force", "kN"),
    "drift": ("drift displacement", "mm"),
    "shear": ("shear force", "kN"),
    "acc_p": ("absolute acceleration", "g"),
}


def at_pier(name: str, i: int) -> str:
    """Name of a channel at pier `i`."""
    return f"{name}{i}" if name == "acc_p" else f"{name}_{i}"


CHANNELS = {
    **{at_pier(name, i): Channel(at_pier(name, i), *what) for name, what in OF_A_PIER.items() for i in (1, 2)},
    "Ud": Channel("Ud", "deck displacement", "mm"),
    "acc_d": Channel("acc_d", "absolute acceleration", "g"),
    **{f"mean_{name}": Channel(f"mean_{name}", *what) for name, what in OF_A_PIER.items()},
}
"""All channels by name."""

ALL_CHANNELS = tuple(name for name in CHANNELS if not name.startswith("mean_"))
"""Names of the twelve channels that are not means."""
