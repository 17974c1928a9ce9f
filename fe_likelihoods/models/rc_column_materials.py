"""Parts of a reinforced-concrete column: materials, reinforcement, and the circular section that they form.

All values are in SI units, and are checked when a part is made. A value that is negative, not a number, or inconsistent
with the others (for example because of mixed units) raises ValueError.

The mesh of the section consists of strips with equal heights. The part of a strip inside the hoops is a core fiber, the
rest is a cover fiber. Each fiber is at its radius of gyration about the axis of bending, y = sqrt(I/A), so that the
section's area and second moment of area are exact for any number of strips. The acceleration of the tested column has
an error of 0.6 % with 40 strips, and of 10 to 18 % with rings and 20 wedges (``docs/theory/fiber_section.rst``).

Confinement follows Mander et al. (1988): effective lateral pressure of circular hoops or spirals, then strength and
strain at the peak. The ultimate strain follows from the approximate energy balance by Priestley et al. (1996).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from numbers import Integral
from typing import NamedTuple

import numpy as np

from ..kernels import reinforcing_steel
from ..priors.distributions import LogNormal
from .validation import check_described, check_integer, described, invalid, structure

__all__ = [
    "Bars",
    "ColumnAnalysis",
    "Concrete",
    "Confinement",
    "Hoops",
    "LowCycleFatigue",
    "ReinforcedSection",
    "Steel",
    "gauss_lobatto",
    "hardening_fault",
]

_MEDIAN_CF, _LOG_SD_CF = 0.20, 0.34  # of a new column, by study `failing_columns` of docs/results.rst


@structure
@dataclass(frozen=True)
class Concrete:
    """Unconfined concrete: Popovics envelope in compression, exponential softening in tension.

    Examples
    --------
    >>> concrete = Concrete(fc=40e6, ec=30e9, ft=3e6)  # Pa
    >>> column = RCColumn.lhpost(record, concrete=concrete)
    >>> column.nominal["Ec"]
    30000000000.0
    """

    fc: float = described("Pa", "Compressive strength, positive", "positive")
    ec: float = described("Pa", "Initial modulus", "positive")
    ft: float = described("Pa", "Tensile strength", "finite")
    peak_strain: float | None = described(
        "",
        "Strain at ``fc``, positive; default: 2 fc/Ec, which follows an updated Ec",
        "positive",
        None,
        "With a fixed strain below fc/Ec the envelope does not depend on Ec.",
    )
    ultimate_strain: float = described(
        "",
        "Strain beyond which the cover carries no stress (positive)",
        "positive",
        0.006,
        "The model uses at least 1.5 times the peak strain.",
    )
    softening_strain: float = described(
        "",
        "Strain in tension from cracking (ft/Ec) to where the stress is ``softening_ratio`` ft and drops to zero",
        "positive",
        0.001,
    )
    softening_ratio: float = described(
        "", "Ratio of the stress at the end of the softening branch to ft", "positive", 0.1
    )

    def __post_init__(self) -> None:
        check_described(self)
        if not 0.0 <= self.ft < self.fc:
            raise invalid("a tensile strength between 0 and fc", self.ft, "give both as positive values in Pa")
        if self.ec <= self.fc:
            raise invalid("a modulus ec above the strength fc", self.ec, "give both in Pa")
        if self.softening_ratio >= 1.0:
            raise invalid("a softening_ratio below 1", self.softening_ratio, "the default is 0.1")


@structure
@dataclass(frozen=True)
class Steel:
    """Longitudinal reinforcing steel.

    Examples
    --------
    >>> steel = Steel(fy=500e6, fu=700e6, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
    >>> stronger = RCColumn.lhpost(record, steel=steel)
    """

    fy: float = described("Pa", "Yield strength", "positive")
    fu: float = described("Pa", "Ultimate strength", "positive")
    es: float = described("Pa", "Elastic modulus", "positive")
    esh: float = described("Pa", "Modulus at the onset of hardening", "positive")
    hardening_strain: float = described("", "Strain at the onset of hardening", "positive")
    ultimate_strain: float = described("", "Strain at ``fu``", "positive")

    def __post_init__(self) -> None:
        check_described(self)
        if not self.fy / self.es < self.hardening_strain < self.ultimate_strain or self.fu <= self.fy:
            raise invalid(
                "fy/es < hardening_strain < ultimate_strain and fy < fu", self, "check the units of the steel"
            )
        fault = hardening_fault(self.fy, self.fu, self.es, self.esh, self.hardening_strain, self.ultimate_strain)
        if fault:
            raise invalid("a steel with a hardening branch", self, fault)


def hardening_fault(fy: float, fu: float, es: float, esh: float, eps_sh: float, eps_u: float) -> str:
    """Return why the steel law has no hardening branch at these constants, or an empty text.

    Arguments as for `fe_likelihoods.kernels.reinforcing_steel.constants`, with fy/es < eps_sh < eps_u. The law is
    written in natural strains and stresses, for which fu > fy and Esh > 0 are not sufficient for a hardening branch
    that rises from the end of the plateau to the ultimate strain.
    """
    length = math.log1p(eps_u) - math.log1p(eps_sh)
    onset, slope = fy * (1.0 + eps_sh), fu * (1.0 + eps_u)
    rise = slope * (1.0 - length) - onset
    if not rise > 0.0:
        return (
            f"fu = {fu:.4g} Pa is too close to fy = {fy:.4g} Pa for an ultimate strain of {eps_u:.4g}; "
            "a larger fu or a smaller ultimate strain is needed"
        )
    start = esh * (1.0 + eps_sh) ** 2 + onset - slope
    constants = np.full(reinforcing_steel.N_CONSTANTS, math.nan)
    if start > 0.0 and rise - reinforcing_steel.TRANSITION * slope > 0.0:  # else the constants divide by zero
        reinforcing_steel.constants(fy, fu, es, esh, eps_sh, eps_u, constants)
    if not (np.isfinite(constants).all() and constants[reinforcing_steel.A_SHIFT] > 0.0):
        return (
            f"the hardening modulus Esh = {esh:.4g} Pa does not fit fy = {fy:.4g} Pa and fu = {fu:.4g} Pa; "
            "a larger Esh or a larger difference between fy and fu is needed"
        )
    return ""


@structure
@dataclass(frozen=True)
class LowCycleFatigue:
    """Low-cycle fatigue of bars: loss of strength from cycle to cycle, and fracture.

    A half cycle of the plastic strain ep adds (ep/cf)^(1/alpha) to Miner's sum; a bar fractures where the sum reaches
    one. The strength decreases by (cf/cd)^(1/alpha) times the sum. ``docs/theory/reinforcing_steel.rst`` has the
    equations.

    Examples
    --------
    >>> fatigue = LowCycleFatigue(cf=0.26)
    >>> RCColumn.lhpost(record, fatigue=fatigue, parameters=("Ec", "Cf")).parameter_names
    ('Ec', 'Cf')
    """

    cf: float = described(
        "",
        "Coefficient of Coffin and Manson: plastic strain of a half cycle that breaks a bar",
        "positive",
        0.26,
        "The defaults are the starting values that OpenSees documents for its material ReinforcingSteel, from tests of "
        "Brown & Kunnath (2000) with bars whose slenderness was 6.",
    )
    alpha: float = described("", "Exponent of Coffin and Manson, at most 1", "positive", 0.506)
    cd: float = described("", "Coefficient of strength loss, at least ``cf``; large: no loss", "positive", 0.389)

    def __post_init__(self) -> None:
        check_described(self, "of fatigue")
        if self.alpha > 1.0:
            raise invalid("an exponent alpha of at most 1", self.alpha, "tests of bars give 0.4 to 0.6")
        if self.cd < self.cf:
            raise invalid(
                f"a coefficient cd of at least cf = {self.cf:g}", self.cd, "a smaller one has no strength at fracture"
            )

    def prior(self) -> dict[str, LogNormal]:
        """Prior of the parameter ``Cf`` of a column that was not tested.

        Population of four columns of two series, and of tests of bars, with a prior of the scatter: the median is 0.20,
        the standard deviation of the logarithm 0.34 (``docs/theory/reinforcing_steel.rst``). It holds for columns that
        fail by flexure, with the default `cd`, and with bars that buckle between hoops or not at all. A draw above `cd`
        (2 in 100) is a failed simulation.

        Returns
        -------
        dict of str to LogNormal
            ``{"Cf": ...}``, for the multiple of `cf` that the parameter of `RCColumn` is.

        References
        ----------
        M. P. Berry, M. O. Eberhard (2005), Practical performance model for bar buckling, Journal of Structural
        Engineering 131(7), 1060-1070, doi:10.1061/(ASCE)0733-9445(2005)131:7(1060), for the prior of the scatter.
        """
        return {"Cf": LogNormal(_MEDIAN_CF / self.cf, _LOG_SD_CF)}


@structure
@dataclass(frozen=True)
class Bars:
    """Longitudinal bars, evenly spaced on a circle.

    Examples
    --------
    >>> bars = Bars(number=18, diameter=0.0358, area=1.006e-3)
    >>> round(bars.number * bars.area, 4)  # all bars [m²]
    0.0181
    """

    number: int = described("", "Number of bars, at least 3")
    diameter: float = described("m", "Diameter of one bar", "positive")
    area: float | None = described("m²", "Area of one bar; default: from ``diameter``", "positive", None)
    first_angle: float = described(
        "rad",
        "Angle between the direction of negative displacements and the first bar",
        "finite",
        0.0,
        "It matters only where the bars are not symmetric to the axis of bending, such as an odd number of bars.",
    )

    def __post_init__(self) -> None:
        if not isinstance(self.number, Integral) or isinstance(self.number, bool) or self.number < 3:
            raise invalid("an integer number of at least three bars", self.number, "bars stand on a whole circle")
        check_described(self, "of bars")

    @property
    def area_each(self) -> float:
        """Area of one bar [m²]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2


@structure
@dataclass(frozen=True)
class Hoops:
    """Transverse reinforcement: hoops or a spiral.

    Examples
    --------
    >>> hoops = Hoops(diameter=0.0159, spacing=0.152, fy=450e6)
    >>> stirrups = RCColumn.lhpost(record, hoops=hoops)
    """

    diameter: float = described("m", "Diameter of the hoop bar", "positive")
    spacing: float = described("m", "Distance between the centres of adjacent sets", "positive")
    fy: float = described("Pa", "Yield strength", "positive")
    area: float | None = described("m²", "Area of one set; default: one bar, from ``diameter``", "positive", None)
    ultimate_strain: float = described("", "Strain at fracture", "positive", 0.12)
    spiral: bool = described("", "Whether the reinforcement is a spiral", default=False)

    def __post_init__(self) -> None:
        check_described(self, "of hoops")
        if self.spacing <= self.diameter:
            raise invalid(
                "a spacing of hoops larger than their diameter", self.spacing, "give it between centres, in m"
            )

    @property
    def area_each(self) -> float:
        """Area of one set [m²]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2


@structure
@dataclass(frozen=True)
class ColumnAnalysis:
    """Mesh of a column, integration of its response, and the end of a simulation.

    Examples
    --------
    >>> finer = RCColumn.lhpost(record, analysis=ColumnAnalysis(n_elements=4, substeps=2))
    """

    n_elements: int = described("", "Number of elements", default=2)
    n_points: int = described("", "Number of Gauss-Lobatto points per element, 2 to 7", default=3)
    mesh: int = described("", "Number of strips of the section (even)", default=40)
    geometry: str = described("", '"corotational" or "linear"', default="corotational")
    substeps: int = described("", "Integration steps per step of the record", default=1)
    max_increment: float | None = described(
        "m", "Largest increment of an imposed displacement; default: height/5000", "positive", None
    )
    collapse_drift: float = described(
        "",
        'Displacement of the top by the height at which the simulation ends with the reason "collapse"',
        "positive",
        0.2,
        "Tested columns have lost their strength at 0.05 to 0.15; bars that do not fracture would come back from more.",
    )
    tolerance: float = described("m and rad", "Norm of the last Newton correction", "positive", 1e-8)

    def __post_init__(self) -> None:
        check_described(self)
        check_integer("n_elements", self.n_elements, 1, 50)
        check_integer("n_points", self.n_points, 2, 7)
        check_integer("substeps", self.substeps, 1, 1000)
        if self.geometry not in ("corotational", "linear"):
            raise invalid('geometry "corotational" or "linear"', self.geometry, "the default is corotational")


def _slice_moments(radius: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of the chord 2 sqrt(r^2 - y^2), and of y^2 times the chord, from 0 to `y` (clipped to the circle)."""
    z = np.clip(y / radius, -1.0, 1.0)
    root = np.sqrt(1.0 - z * z)
    angle = np.arcsin(z)
    area = radius**2 * (angle + z * root)
    second = radius**4 * (angle - z * root * (1.0 - 2.0 * z * z)) / 4.0
    return area, second


def circular_strips(radius: float, core_radius: float, n_strips: int) -> tuple[np.ndarray, np.ndarray]:
    """Make core and cover fibers, each ndarray[n, 2] of position y [m] and area [m²], from strips with equal heights.

    The number of strips is even, so that no strip crosses the axis of bending. Strips outside the core have no core
    fiber.
    """
    edges = np.linspace(-radius, radius, n_strips + 1)
    core_area, core_second = (np.diff(m) for m in _slice_moments(core_radius, edges))
    area, second = (np.diff(m) for m in _slice_moments(radius, edges))
    sign = np.where(np.arange(n_strips) < n_strips // 2, -1.0, 1.0)

    def fibers(a: np.ndarray, i: np.ndarray) -> np.ndarray:
        keep = a > 1e-12 * radius**2
        return np.column_stack([sign[keep] * np.sqrt(i[keep] / a[keep]), a[keep]])

    return fibers(core_area, core_second), fibers(area - core_area, second - core_second)


def bar_circle(radius: float, n_bars: int, area: float, first_angle: float = 0.0) -> np.ndarray:
    """Make fibers, ndarray[n, 2] of position y [m] and area [m²], of bars that are evenly spaced on a circle.

    The first bar is at `first_angle` [rad] from the y axis; bars with the same position y are merged.
    """
    y = radius * np.cos(first_angle + 2.0 * math.pi * np.arange(n_bars) / n_bars)
    return _merge(y, np.full(n_bars, area), radius)


def _merge(y: np.ndarray, area: np.ndarray, scale: float) -> np.ndarray:
    """Merge fibers with the same position, which have the same strain."""
    _, first, where = np.unique(np.round(y / scale, 12), return_index=True, return_inverse=True)
    return np.column_stack([y[first], np.bincount(where, weights=area)])


class Confinement(NamedTuple):
    """Properties of confined concrete (Mander et al. 1988)."""

    strength_ratio: float  # confined / unconfined strength, fcc/fc
    strain_ratio: float  # strains at these strengths, eps_cc/eps_c0
    ultimate_strain: float  # compressive strain at the fracture of the hoops


@dataclass(frozen=True)
class ReinforcedSection:
    """Circular section with a confined core, cover concrete and one circle of bars.

    Raises ValueError if the reinforcement does not fit into the section, or the mesh is no even number of strips.
    """

    diameter: float  # outer [m]
    cover: float  # clear, to the outside of the hoops [m]
    bars: Bars
    hoops: Hoops
    mesh: int  # number of strips, even and at least 4

    def __post_init__(self) -> None:
        bars, hoops, radius = self.bars, self.hoops, self.bar_circle_radius
        if self.core_diameter <= 0.0:
            expected = f"a cover smaller than the radius {self.diameter / 2:.4g} m minus the hoops"
            raise invalid(expected, self.cover, "give the clear cover in m")
        chord = 2.0 * radius * math.sin(math.pi / bars.number)
        if radius <= 0.0 or chord < bars.diameter:
            got = f"{bars.number} bars of {bars.diameter:.4g} m, {chord:.4g} m apart"
            expected = f"bars that fit on their circle of radius {radius:.4g} m"
            raise invalid(expected, got, "use fewer or thinner bars, or less cover")
        if self.steel_ratio > 0.3:
            share = f"{100 * self.steel_ratio:.3g} %"
            raise invalid("an area of bars below 30 % of the core's", share, "give the area of one bar, in m²")
        if hoops.spacing - hoops.diameter >= 2.0 * self.core_diameter:
            raise invalid(
                "a spacing of hoops below two core diameters", hoops.spacing, "a larger spacing confines no core"
            )
        if not (isinstance(self.mesh, Integral) and self.mesh >= 4 and self.mesh % 2 == 0):
            raise invalid("an even number of at least 4 strips", self.mesh, "the default is 40 strips")

    @property
    def core_diameter(self) -> float:
        """Diameter of the confined core, between the centre lines of the hoops [m]."""
        return self.diameter - 2.0 * self.cover - self.hoops.diameter

    @property
    def bar_circle_radius(self) -> float:
        """Radius of the circle through the centres of the bars [m]."""
        return 0.5 * self.diameter - self.cover - self.hoops.diameter - 0.5 * self.bars.diameter

    @property
    def outermost_bars(self) -> tuple[float, float]:
        """Positions of the outermost bars at the negative and the positive side, in the direction of loading [m]."""
        y = self.fibers()[2][:, 0]  # the second axis of the element points against the direction of loading
        return float(-y.max()), float(-y.min())

    @property
    def steel_ratio(self) -> float:
        """Area of the longitudinal bars divided by the area of the core."""
        return self.bars.number * self.bars.area_each / (0.25 * math.pi * self.core_diameter**2)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - equal sections share them, and few are kept
    def fibers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fibers of core, cover and bars, each (n, 2), read-only: position y [m] and area [m²]."""
        core, cover = circular_strips(0.5 * self.diameter, 0.5 * self.core_diameter, self.mesh)
        bars = bar_circle(self.bar_circle_radius, self.bars.number, self.bars.area_each, self.bars.first_angle)
        for each in (core, cover, bars):
            each.setflags(write=False)
        return core, cover, bars

    def confinement(self, fc: float) -> Confinement:
        """Confinement of the core for concrete of the unconfined strength `fc` [Pa].

        The arching reduction enters once for a spiral, squared for hoops.
        """
        hoops = self.hoops
        volumetric_ratio = 4.0 * hoops.area_each / (self.core_diameter * hoops.spacing)
        arch = 1.0 - (hoops.spacing - hoops.diameter) / (2.0 * self.core_diameter)
        effectiveness = (arch if hoops.spiral else arch * arch) / (1.0 - self.steel_ratio)
        pressure = 0.5 * effectiveness * volumetric_ratio * hoops.fy
        strength_ratio = -1.254 + 2.254 * math.sqrt(1.0 + 7.94 * pressure / fc) - 2.0 * pressure / fc
        ultimate = 0.004 + 1.4 * volumetric_ratio * hoops.fy * hoops.ultimate_strain / (strength_ratio * fc)
        return Confinement(strength_ratio, 1.0 + 5.0 * (strength_ratio - 1.0), ultimate)


@functools.cache
def gauss_lobatto(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute points and weights of the Gauss-Lobatto rule with `n` points on [0, 1], both ends included."""
    legendre = np.polynomial.legendre.Legendre.basis(n - 1)
    x = np.concatenate([[-1.0], np.sort(legendre.deriv().roots().real), [1.0]])
    x = 0.5 * (x - x[::-1])  # exactly symmetric
    weights = 2.0 / (n * (n - 1) * legendre(x) ** 2)
    return 0.5 * (x + 1.0), 0.5 * weights
