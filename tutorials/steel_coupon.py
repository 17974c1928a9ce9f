"""Bar of reinforcing steel in a testing machine, for tutorial 09: strain history in, stress history out.

The law is the same as for the bars in `RCColumn` (:doc:`/theory/reinforcing_steel`). A cyclic coupon test can therefore
give a prior for column bars of the same steel, or check the posterior found from a column. The law fixes the shape of
the curves between reversals and the loss of stiffness at a reversal; for a steel that behaves differently, the other
parameters compensate for the difference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from fe_likelihoods import Channel, SimulationFailed, Steel
from fe_likelihoods.kernels import reinforcing_steel
from fe_likelihoods.models.base import BuiltInModel
from fe_likelihoods.models.rc_column_parts import hardening_fault
from fe_likelihoods.models.validation import check_values

PARAMETERS = ("fy", "fu", "Es", "Esh", "eps_sh", "eps_u")


@dataclass(frozen=True, eq=False)
class SteelCoupon(BuiltInModel):
    """Stress of a bar under engineering strains (n_steps,), positive in tension; theta holds multiples of `nominal`."""

    strain: np.ndarray
    steel: Steel
    parameters: tuple[str, ...] = PARAMETERS
    channels: ClassVar = (Channel("stress", "stress", "MPa"),)
    dt: ClassVar = 1.0  # the response is given per step of the test
    time_label: ClassVar[str] = "step"
    _nominal_units: ClassVar[dict[str, str]] = {"fy": "MPa", "fu": "MPa", "Es": "GPa", "Esh": "GPa"}

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        s = self.steel
        return dict(zip(PARAMETERS, (s.fy, s.fu, s.es, s.esh, s.hardening_strain, s.ultimate_strain), strict=True))

    @property
    def n_steps(self) -> int:
        """Number of strains."""
        return len(self.strain)

    def with_record(self, strain: np.ndarray) -> SteelCoupon:
        """Return the same steel under other strains (n_steps,), starting again from the unloaded bar."""
        return replace(self, strain=strain)

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        v = self.physical_values(theta)
        check_values(v)
        if not v["fy"] / v["Es"] < v["eps_sh"] < v["eps_u"] or v["fu"] <= v["fy"]:
            raise SimulationFailed("no plateau or no hardening: expected fy/Es < eps_sh < eps_u and fy < fu")
        if fault := hardening_fault(*v.values()):
            raise SimulationFailed(f"no hardening branch: {fault}")
        constants, stress = np.zeros(reinforcing_steel.N_CONSTANTS), np.empty((1, self.n_steps))
        reinforcing_steel.constants(*v.values(), constants)
        reinforcing_steel.stress_history(self.strain, np.zeros(reinforcing_steel.N_STATE), constants, stress[0])
        return stress
