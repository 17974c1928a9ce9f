"""What a reinforced-concrete column is made of: materials and reinforcement, each checked when it is made.

Everything is in SI units. A value that cannot be (negative, not a number, text, a slip of units that contradicts its
neighbours) is refused with what was expected, what came and what to do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

from .validation import number, refuse, whole_number

__all__ = ["Bars", "Concrete", "Hoops", "Patches", "Steel"]


@dataclass(frozen=True)
class Concrete:
    """Unconfined concrete (Popovics envelope, exponential softening in tension).

    Attributes
    ----------
    fc, ec, ft : float
        Compressive strength (positive), initial modulus and tensile strength [Pa].
    peak_strain : float or None
        Strain at fc (positive). None: 2 fc/Ec, which follows an updated Ec. A fixed strain below fc/Ec makes the
        envelope ignore Ec.
    ultimate_strain : float
        Strain beyond which the cover carries nothing (positive); at least 1.5 times the peak strain is taken.
    softening_strain : float
        Strain from cracking, ft/Ec, to where tension has decayed to `softening_ratio` ft and is dropped.
    softening_ratio : float
        Share of ft left there.
    """

    fc: float
    ec: float
    ft: float
    peak_strain: float | None = None
    ultimate_strain: float = 0.006
    softening_strain: float = 0.001
    softening_ratio: float = 0.1

    def __post_init__(self) -> None:
        for name in ("fc", "ec", "ultimate_strain", "softening_strain"):
            number(name, getattr(self, name))
        number("ft", self.ft, any_sign=True)
        if self.peak_strain is not None:
            number("peak_strain", self.peak_strain)
        if not 0.0 <= self.ft < self.fc:
            refuse("a tensile strength between 0 and fc", self.ft, "give both positive, in Pa")
        if self.ec <= self.fc:
            refuse("a modulus ec above the strength fc", self.ec, "give both in Pa")
        number("softening_ratio", self.softening_ratio)
        if self.softening_ratio >= 1.0:
            refuse("a softening_ratio below 1", self.softening_ratio, "0.1 is the default")


@dataclass(frozen=True)
class Steel:
    """Longitudinal steel.

    Attributes
    ----------
    fy, fu, es, esh : float
        Yield strength, ultimate strength, modulus and modulus at the onset of hardening [Pa].
    hardening_strain, ultimate_strain : float
        Strains at the onset of hardening and at fu.
    """

    fy: float
    fu: float
    es: float
    esh: float
    hardening_strain: float
    ultimate_strain: float

    def __post_init__(self) -> None:
        for name in ("fy", "fu", "es", "esh", "hardening_strain", "ultimate_strain"):
            number(name, getattr(self, name))
        if not self.fy / self.es < self.hardening_strain < self.ultimate_strain or self.fu <= self.fy:
            refuse("fy/es < hardening_strain < ultimate_strain and fy < fu", self, "check the units of the steel")


@dataclass(frozen=True)
class Bars:
    """`number` longitudinal bars of `diameter` [m] and `area` [m2; None: of the circle], evenly on a circle.

    first_angle [rad] : of the first bar from the direction of loading.
    """

    number: int
    diameter: float
    area: float | None = None
    first_angle: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.number, Integral) or isinstance(self.number, bool) or self.number < 3:
            refuse("a whole number of at least three bars", self.number, "a circular column needs them all around")
        number("diameter of bars", self.diameter)
        number("first_angle", self.first_angle, any_sign=True)
        if self.area is not None:
            number("area of bars", self.area)

    @property
    def area_each(self) -> float:
        """Area of one bar [m2]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2


@dataclass(frozen=True)
class Hoops:
    """Transverse steel: hoops or a spiral of bar `diameter` [m], `area` [m2] of one set, at `spacing` [m].

    fy : yield strength [Pa]. ultimate_strain : at fracture. area None: that of one bar (bundled hoops have more).
    """

    diameter: float
    spacing: float
    fy: float
    area: float | None = None
    ultimate_strain: float = 0.12
    spiral: bool = False

    def __post_init__(self) -> None:
        for name in ("diameter", "spacing"):
            number(f"{name} of hoops", getattr(self, name))
        number("fy of hoops", self.fy)
        number("ultimate_strain of hoops", self.ultimate_strain)
        if self.area is not None:
            number("area of hoops", self.area)
        if self.spacing <= self.diameter:
            refuse("hoops further apart than their diameter", self.spacing, "spacing is centre to centre, in m")

    @property
    def area_each(self) -> float:
        """Area of one set [m2]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2


@dataclass(frozen=True)
class Patches:
    """Mesh of rings and wedges, as many codes have it (the strips of the default are the better quadrature)."""

    wedges: int = 20
    core_rings: int = 10
    cover_rings: int = 2

    def __post_init__(self) -> None:
        whole_number("wedges of Patches", self.wedges, 4, 1000)
        whole_number("core_rings of Patches", self.core_rings, 1, 1000)
        whole_number("cover_rings of Patches", self.cover_rings, 1, 1000)
