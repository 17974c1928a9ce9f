"""Materials and reinforcement of a column, and the settings of its analysis.

All values are in SI units, and are checked when an object is made. A value that is negative, not a number, or
inconsistent with the others (for example because of mixed units) raises ValueError.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from ..kernels import reinforcing_steel
from ..priors.distributions import LogNormal
from .validation import check_described, check_integer, described, invalid, structure

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
