"""A bar of reinforcing steel in a testing machine: strain in, stress out.

The law is that of the bars of `rc_column` (`kernels.reinforcing_steel`), alone: what a cyclic coupon test says about it
is a prior, or a judge, for the bars of a column. The shape of the curves between reversals and the loss of stiffness at
a reversal are fixed in that law (OpenSees' defaults); a steel that differs there is fitted by other parameters.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..kernels import reinforcing_steel
from ..kernels.jit import KERNEL_HASH
from ..signals.channels import Channel
from ..simulation.model import SimulationFailed
from .rc_column_parts import Steel
from .validation import refuse, theta_row

__all__ = ["SteelCoupon"]

PARAMETERS = {
    "fy": ("fy", "yield strength [Pa]"),
    "fu": ("fu", "ultimate strength [Pa]"),
    "Es": ("es", "modulus [Pa]"),
    "Esh": ("esh", "modulus at the onset of hardening [Pa]"),
    "eps_sh": ("hardening_strain", "strain at the onset of hardening [-]"),
    "eps_u": ("ultimate_strain", "strain at the ultimate strength [-]"),
}


@dataclass(frozen=True, eq=False)
class SteelCoupon:
    """Stress of a bar under a strain history; `simulate` takes multiples of the nominal parameters.

    Parameters
    ----------
    strain : (n_steps,) array_like
        Engineering strain, tension positive, from the virgin bar on [-]; kept as a read-only copy.
    steel : Steel
        Nominal values.
    parameters : tuple of str
        Which of fy, fu, Es, Esh, eps_sh (onset of hardening) and eps_u (at fu) make up theta, in this order.
    unit : str
        Display unit of the channel "stress".

    Raises
    ------
    ValueError
        If the strains are not one-dimensional, at least two, finite and above -.95, or a parameter is unknown or named
        twice.
    """

    strain: np.ndarray
    steel: Steel
    parameters: tuple[str, ...] = tuple(PARAMETERS)
    unit: str = "MPa"

    def __post_init__(self) -> None:
        strain = np.array(self.strain, dtype=float)
        if strain.ndim != 1 or strain.size < 2 or not np.isfinite(strain).all() or strain.min() <= -0.95:
            refuse(
                "strains (n_steps,), two or more, finite and above -.95",
                f"an array of shape {strain.shape}" + (f" from {strain.min():g}" if strain.size else ""),
                "give engineering strains, not per cent",
            )
        strain.flags.writeable = False
        object.__setattr__(self, "strain", strain)
        if not isinstance(self.steel, Steel):
            refuse("Steel(...) as steel", self.steel, "import it from fe_likelihoods.models.rc_column")
        names = self.parameters
        if isinstance(names, str) or not isinstance(names, Sequence) or not names or set(names) - set(PARAMETERS):
            refuse(f"parameters out of {tuple(PARAMETERS)}", names, "see SteelCoupon.nominal for their values")
        if len(set(names)) != len(names):
            refuse("each of the parameters once", names, "leave the repeated one out")
        object.__setattr__(self, "parameters", tuple(names))
        Channel("stress", "stress", self.unit)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of theta, each a multiple of the value in `nominal`."""
        return self.parameters

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        return {name: getattr(self.steel, field) for name, (field, _) in PARAMETERS.items()}

    @property
    def channels(self) -> tuple[Channel, ...]:
        """One, the engineering stress."""
        return (Channel("stress", "stress", self.unit),)

    @property
    def dt(self) -> float:
        """1: a step of the test."""
        return 1.0

    @property
    def n_steps(self) -> int:
        """Number of strains."""
        return self.strain.size

    @property
    def fingerprint(self) -> str:
        """Changes with the strains, the nominal values, the parameters and the law."""
        text = f"{type(self).__name__}|{self.steel!r}|{self.parameters}|{KERNEL_HASH}"
        return hashlib.blake2b(text.encode() + self.strain.tobytes(), digest_size=16).hexdigest()

    def with_record(self, strain: np.ndarray) -> SteelCoupon:
        """The same steel under other strains (n_steps,), again from the virgin bar on."""
        return replace(self, strain=strain)

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Stress (1, n_steps) [Pa] at multiples `theta` (n_parameters,) of the nominal parameters.

        Raises
        ------
        SimulationFailed
            When the parameters make no steel, or the law finds no stress.
        """
        theta = theta_row(theta, self.parameters)
        v = self.nominal
        for name, factor in zip(self.parameters, theta.tolist(), strict=True):
            v[name] *= factor
        for name, value in v.items():
            if not (math.isfinite(value) and value > 0.0):
                raise SimulationFailed(f"{name} = {value:.4g}, {PARAMETERS[name][1]}, must be positive")
        if not v["fy"] / v["Es"] < v["eps_sh"] < v["eps_u"]:
            raise SimulationFailed("no plateau before hardening, or none of hardening: fy/Es < eps_sh < eps_u is asked")
        if v["fu"] <= v["fy"]:
            raise SimulationFailed(f"no hardening: fu = {v['fu']:.4g} Pa is not above fy = {v['fy']:.4g} Pa")
        constants = np.zeros(reinforcing_steel.N_CONSTANTS)
        reinforcing_steel.constants(*v.values(), constants)
        stress = np.empty((1, self.n_steps))
        reinforcing_steel.stress_history(self.strain, np.zeros(reinforcing_steel.N_STATE), constants, stress[0])
        if not np.isfinite(stress).all():
            step = int(np.argmin(np.isfinite(stress[0])))
            raise SimulationFailed(f"the law has no stress at step {step}, strain {self.strain[step]:.4g}")
        return stress
