"""Bar of reinforcing steel in a testing machine: strain history in, stress history out.

The law is the same as for the bars in `RCColumn` (``docs/theory/reinforcing_steel.rst``). A cyclic coupon test can
therefore give a prior for column bars of the same steel, or check the posterior found from a column. The law fixes the
shape of the curves between reversals and the loss of stiffness at a reversal; for a steel that behaves differently, the
other parameters compensate for the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from ..kernels import reinforcing_steel
from ..signals.channels import Channel
from ..signals.sampling import sample_window
from ..simulation.model import SimulationFailed
from .base import BuiltInModel
from .rc_column_parts import Steel, hardening_fault
from .validation import check_names, check_values, invalid

__all__ = ["PARAMETERS", "SteelCoupon"]

PARAMETERS = {
    "fy": "yield strength [Pa]",
    "fu": "ultimate strength [Pa]",
    "Es": "modulus [Pa]",
    "Esh": "modulus at the onset of hardening [Pa]",
    "eps_sh": "strain at the onset of hardening [-]",
    "eps_u": "strain at the ultimate strength [-]",
}


LARGEST_STRAIN = 0.5  # real bars fracture at 0.1 to 0.3


@dataclass(frozen=True, eq=False)
class SteelCoupon(BuiltInModel):
    """Stress of a bar under a strain history; theta holds multiples of the nominal parameters.

    Parameters
    ----------
    strain : array_like, shape (n_steps,)
        Engineering strain, positive in tension, starting from the unloaded bar [-]. A read-only copy is stored.
    steel : Steel
        Nominal values.
    parameters : tuple of str
        Names that make up theta, in this order, out of fy, fu, Es, Esh, eps_sh (strain at the onset of hardening) and
        eps_u (strain at fu).
    unit : str
        Display unit of the channel "stress".

    Raises
    ------
    ValueError
        If the strains are not one-dimensional, at least two, and within 0.5 of zero, or a parameter is unknown or
        repeated.
    """

    strain: np.ndarray
    steel: Steel
    parameters: tuple[str, ...] = tuple(PARAMETERS)
    unit: str = "MPa"

    time_label: ClassVar[str] = "step"
    _nominal_units: ClassVar[dict[str, str]] = {"fy": "MPa", "fu": "MPa", "Es": "GPa", "Esh": "GPa"}

    def __post_init__(self) -> None:
        strain = np.array(self.strain, dtype=float)
        largest = float(np.abs(strain).max()) if strain.size else 0.0
        if strain.ndim != 1 or strain.size < 2 or not largest <= LARGEST_STRAIN:  # neither is NaN
            raise invalid(
                f"strains (n_steps,), two or more, finite and between -{LARGEST_STRAIN:g} and {LARGEST_STRAIN:g}",
                f"an array of shape {strain.shape} with a largest absolute value of {largest:g}",
                "give engineering strains, not per cent",
            )
        strain.flags.writeable = False
        object.__setattr__(self, "strain", strain)
        if not isinstance(self.steel, Steel):
            raise invalid("Steel(...) as steel", self.steel, "import it from fe_likelihoods")
        check_names("parameters", self.parameters, PARAMETERS, "see SteelCoupon.nominal for their values")
        object.__setattr__(self, "parameters", tuple(self.parameters))
        Channel("stress", "stress", self.unit)  # checks the unit

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        s = self.steel
        values = (s.fy, s.fu, s.es, s.esh, s.hardening_strain, s.ultimate_strain)
        return dict(zip(PARAMETERS, values, strict=True))

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One channel, the engineering stress."""
        return (Channel("stress", "stress", self.unit),)

    @property
    def dt(self) -> float:
        """1: the response is given per step of the test."""
        return 1.0

    @property
    def n_steps(self) -> int:
        """Number of strains."""
        return self.strain.size

    def with_record(self, strain: np.ndarray) -> SteelCoupon:
        """Return the same steel under other strains (n_steps,), starting again from the unloaded bar."""
        return replace(self, strain=strain)

    def first(self, seconds: float) -> SteelCoupon:
        """Return the same steel under the first part of its strains.

        Parameters
        ----------
        seconds : float
            Number of the last step, which the response has instead of time.

        Returns
        -------
        SteelCoupon
            Its response is the first part of this model's response.

        Raises
        ------
        ValueError
            If the time is not within the response, or fewer than two samples remain.
        """
        return self.with_record(self.strain[sample_window("the response", self.n_steps, self.dt, 0.0, seconds)])

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        v = self.physical_values(theta)
        check_values(v)
        if not v["fy"] / v["Es"] < v["eps_sh"] < v["eps_u"]:
            raise SimulationFailed("no yield plateau or no hardening branch: fy/Es < eps_sh < eps_u is required")
        if v["fu"] <= v["fy"]:
            raise SimulationFailed(f"no hardening: fu = {v['fu']:.4g} Pa is not above fy = {v['fy']:.4g} Pa")
        fault = hardening_fault(*v.values())
        if fault:
            raise SimulationFailed(f"no hardening branch: {fault}")
        constants = np.zeros(reinforcing_steel.N_CONSTANTS)
        reinforcing_steel.constants(*v.values(), constants)
        stress = np.empty((1, self.n_steps))
        reinforcing_steel.stress_history(self.strain, np.zeros(reinforcing_steel.N_STATE), constants, stress[0])
        if not np.isfinite(stress).all():
            step = int(np.argmin(np.isfinite(stress[0])))
            raise SimulationFailed(f"the law has no stress at step {step}, strain {self.strain[step]:.4g}")
        return stress
