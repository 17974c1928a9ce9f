"""Materials and reinforcement of a reinforced-concrete column. Arguments are checked when a part is made.

All values are in SI units. A value that is negative, not a number, or inconsistent with the others (for example because
of mixed units) raises ValueError.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from ..kernels import reinforcing_steel
from ..priors.distributions import LogNormal
from .validation import check_fields, invalid

__all__ = ["Bars", "Concrete", "Hoops", "LowCycleFatigue", "Steel", "hardening_fault"]

_MEDIAN_CF, _LOG_SD_CF = 0.20, 0.34  # of a new column, by study `failing_columns` of docs/results.rst


@dataclass(frozen=True)
class Concrete:
    """Unconfined concrete: Popovics envelope in compression, exponential softening in tension.

    Attributes
    ----------
    fc : float
        Compressive strength [Pa], positive.
    ec : float
        Initial modulus [Pa].
    ft : float
        Tensile strength [Pa].
    peak_strain : float, optional
        Strain at `fc`, positive. Default: 2 fc/Ec, which follows an updated Ec. With a fixed strain below fc/Ec the
        envelope does not depend on Ec.
    ultimate_strain : float
        Strain beyond which the cover carries no stress (positive). The model uses at least 1.5 times the peak strain.
    softening_strain : float
        Length of the softening branch in tension: strain from cracking (ft/Ec) to the point where the stress has
        decreased to `softening_ratio` ft and drops to zero.
    softening_ratio : float
        Ratio of the stress at the end of the softening branch to ft.

    Examples
    --------
    >>> concrete = Concrete(fc=40e6, ec=30e9, ft=3e6)  # Pa
    >>> column = RCColumn.lhpost(record, concrete=concrete)
    >>> column.nominal["Ec"]
    30000000000.0
    """

    fc: float
    ec: float
    ft: float
    peak_strain: float | None = None
    ultimate_strain: float = 0.006
    softening_strain: float = 0.001
    softening_ratio: float = 0.1

    def __post_init__(self) -> None:
        check_fields(
            self,
            positive=("fc", "ec", "ultimate_strain", "softening_strain", "peak_strain", "softening_ratio"),
            finite=("ft",),
            optional=("peak_strain",),
        )
        if not 0.0 <= self.ft < self.fc:
            raise invalid("a tensile strength between 0 and fc", self.ft, "give both as positive values in Pa")
        if self.ec <= self.fc:
            raise invalid("a modulus ec above the strength fc", self.ec, "give both in Pa")
        if self.softening_ratio >= 1.0:
            raise invalid("a softening_ratio below 1", self.softening_ratio, "the default is 0.1")


@dataclass(frozen=True)
class Steel:
    """Longitudinal reinforcing steel.

    Attributes
    ----------
    fy : float
        Yield strength [Pa].
    fu : float
        Ultimate strength [Pa].
    es : float
        Elastic modulus [Pa].
    esh : float
        Modulus at the onset of hardening [Pa].
    hardening_strain : float
        Strain at the onset of hardening.
    ultimate_strain : float
        Strain at `fu`.

    Examples
    --------
    >>> steel = Steel(fy=500e6, fu=700e6, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
    >>> stronger = RCColumn.lhpost(record, steel=steel)
    """

    fy: float
    fu: float
    es: float
    esh: float
    hardening_strain: float
    ultimate_strain: float

    def __post_init__(self) -> None:
        check_fields(self, positive=("fy", "fu", "es", "esh", "hardening_strain", "ultimate_strain"))
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


@dataclass(frozen=True)
class LowCycleFatigue:
    """Low-cycle fatigue of bars: loss of strength from cycle to cycle, and fracture.

    A half cycle of the plastic strain ep adds (ep/cf)^(1/alpha) to Miner's sum; a bar fractures where the sum reaches
    one. The strength decreases by (cf/cd)^(1/alpha) times the sum. ``docs/theory/reinforcing_steel.rst`` has the
    equations.

    Attributes
    ----------
    cf : float
        Coefficient of Coffin and Manson: plastic strain of a half cycle, from one reversal to the next, that breaks a
        bar. The defaults are the starting values that OpenSees documents for its material ReinforcingSteel, from tests
        of Brown & Kunnath (2000) with bars whose slenderness was 6.
    alpha : float
        Exponent of Coffin and Manson, at most 1.
    cd : float
        Coefficient of strength loss, at least `cf`; a large coefficient means no loss before fracture.

    Examples
    --------
    >>> fatigue = LowCycleFatigue(cf=0.26)
    >>> RCColumn.lhpost(record, fatigue=fatigue, parameters=("Ec", "Cf")).parameter_names
    ('Ec', 'Cf')
    """

    cf: float = 0.26
    alpha: float = 0.506
    cd: float = 0.389

    def __post_init__(self) -> None:
        check_fields(self, positive=("cf", "alpha", "cd"), of="of fatigue")
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


@dataclass(frozen=True)
class Bars:
    """Longitudinal bars, evenly spaced on a circle.

    Attributes
    ----------
    number : int
        Number of bars, at least 3.
    diameter : float
        Diameter of one bar [m].
    area : float, optional
        Area of one bar [m²]. Default: from `diameter`.
    first_angle : float
        Angle between the direction of negative displacements and the first bar [rad]. It matters only where the bars
        are not symmetric to the axis of bending, such as an odd number of bars.

    Examples
    --------
    >>> bars = Bars(number=18, diameter=0.0358, area=1.006e-3)
    >>> round(bars.number * bars.area, 4)  # all bars [m²]
    0.0181
    """

    number: int
    diameter: float
    area: float | None = None
    first_angle: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.number, Integral) or isinstance(self.number, bool) or self.number < 3:
            raise invalid("an integer number of at least three bars", self.number, "bars stand on a whole circle")
        check_fields(self, positive=("diameter", "area"), finite=("first_angle",), optional=("area",), of="of bars")

    @property
    def area_each(self) -> float:
        """Area of one bar [m²]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2


@dataclass(frozen=True)
class Hoops:
    """Transverse reinforcement: hoops or a spiral.

    Attributes
    ----------
    diameter : float
        Diameter of the hoop bar [m].
    spacing : float
        Distance between the centres of adjacent sets [m].
    fy : float
        Yield strength [Pa].
    area : float, optional
        Area of one set [m²]; bundled hoops have more than one bar. Default: one bar, from `diameter`.
    ultimate_strain : float
        Strain at fracture.
    spiral : bool
        Whether the reinforcement is a spiral.

    Examples
    --------
    >>> hoops = Hoops(diameter=0.0159, spacing=0.152, fy=450e6)
    >>> stirrups = RCColumn.lhpost(record, hoops=hoops)
    """

    diameter: float
    spacing: float
    fy: float
    area: float | None = None
    ultimate_strain: float = 0.12
    spiral: bool = False

    def __post_init__(self) -> None:
        positive = ("diameter", "spacing", "fy", "ultimate_strain", "area")
        check_fields(self, positive=positive, optional=("area",), of="of hoops")
        if self.spacing <= self.diameter:
            raise invalid(
                "a spacing of hoops larger than their diameter", self.spacing, "give it between centres, in m"
            )

    @property
    def area_each(self) -> float:
        """Area of one set [m²]."""
        return self.area if self.area is not None else 0.25 * math.pi * self.diameter**2
