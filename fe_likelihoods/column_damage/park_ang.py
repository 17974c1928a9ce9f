r"""The damage index of Park & Ang (1985), and its constants from a static analysis of a column.

The index adds the largest displacement and the dissipated energy,

.. math:: D = \frac{\delta_{max}}{\delta_u} + \frac{\beta}{Q_y \delta_u} \int dE,

with the ultimate displacement :math:`\delta_u` under monotonic loading, the yield strength :math:`Q_y` and a factor
:math:`\beta` of strength deterioration. See ``docs/damage.rst``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from numbers import Real
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..prediction.quantities import FAILED
from ..signals.records import DisplacementHistory
from ..text_tables import number

if TYPE_CHECKING:
    from ..models.rc_column import RCColumn

_DRIFTS = (0.03, 0.06, 0.12, 0.2)  # of the static analyses; the next one is run only if the column survives
_STEPS = 150


class ParkAng(NamedTuple):
    """Constants of the damage index."""

    ultimate_displacement: float  # at failure under monotonic loading [m]
    yield_force: float  # force at yield [N]
    beta: float = 0.05  # factor of the energy [-]
    source: str = ""  # how the constants were found

    def __str__(self) -> str:
        said = f" ({self.source})" if self.source else ""
        return (
            f"Park-Ang index: ultimate displacement {number(1e3 * self.ultimate_displacement)} mm, yield force "
            f"{number(1e-3 * self.yield_force)} kN, beta {number(self.beta)}{said}"
        )

    __repr__ = __str__

    def check(self) -> None:
        """Raise ValueError if a constant is no positive and finite number; `beta` may be zero."""
        for name, value in zip(("ultimate_displacement", "yield_force", "beta"), self, strict=False):
            if not isinstance(value, Real) or not 0.0 <= value < math.inf or (value == 0.0 and name != "beta"):
                raise ValueError(f"{name} of ParkAng must be positive [SI]; got {value!r}")


def park_ang_constants(column: RCColumn, beta: float = 0.05) -> ParkAng:
    """Find the constants of the damage index by pushing the column, at its nominal values, to failure.

    The top is displaced in the positive direction. The yield force is the lateral force at the yield of the outermost
    bar at the negative side, which is in tension. The ultimate displacement is reached at the first of three events:
    this bar, in the base section, reaches the ultimate strain of the steel; the core, at the hoops, reaches the strain
    at which the hoops fracture (`RCColumn.confinement`); or the lateral force has decreased to 80 % of its largest
    value. The factor of the energy `beta` is **assumed**: Park & Ang derive it from axial load and reinforcement; 0.05
    to 0.15 are usual for columns that fail in flexure.

    Raises ValueError if no bar yields or none of the three events is reached up to a drift of 20 %, SimulationFailed if
    the analysis does not converge.

    Examples
    --------
    >>> print(park_ang_constants(column))
    Park-Ang index: ultimate displacement 365 mm, yield force 512 kN, beta 0.05 (static analysis at nominal
    parameters: first yield of a bar, fracture of the hoops; beta assumed)
    """
    from ..models.rc_column_analysis import expect_fracture

    bar, core = column.section.outermost_bars[0], 0.5 * column.core_diameter
    outputs = ("force", f"strain@0:{bar:.10g}", f"strain@0:{core:.10g}")
    nominal = column.nominal
    limits = column.steel.ultimate_strain, column.section.confinement(nominal["fc"]).ultimate_strain
    yield_strain = nominal["fy"] / nominal["Es"]
    for drift in _DRIFTS:
        push = DisplacementHistory("monotonic", np.linspace(0.0, drift * column.height, _STEPS + 1))
        static = replace(column, loading=push, outputs=outputs, units=(), parameters=("Ec",))
        expect_fracture(static)
        force, tension, compression = static.simulate(np.ones(1))
        after = np.arange(force.size) > np.argmax(force)
        low = FAILED * force.max()
        failures = {
            "bars at their ultimate strain": _first(tension >= limits[0], tension - limits[0], push.displacement),
            "fracture of the hoops": _first(-compression >= limits[1], -compression - limits[1], push.displacement),
            "loss of force": _first(after & (force <= low), force - low, push.displacement),
        }
        yield_force = _first(tension >= yield_strain, tension - yield_strain, force)
        cause = min(failures, key=failures.__getitem__)
        if failures[cause] < math.inf and yield_force < math.inf:
            source = f"static analysis at nominal parameters: first yield of a bar, {cause}; beta assumed"
            return ParkAng(failures[cause], yield_force, float(beta), source)
    raise ValueError(
        f"the column does not fail up to a drift of {100 * _DRIFTS[-1]:.0f} %: give ParkAng(ultimate_displacement, "
        "yield_force, beta) from a test or from another analysis"
    )


def _first(reached: np.ndarray, excess: np.ndarray, values: np.ndarray) -> float:
    """Value, interpolated between two steps, at which an excess over a limit is first zero; inf if never reached."""
    if not reached.any():
        return math.inf
    k = max(int(np.argmax(reached)), 1)
    share = -excess[k - 1] / (excess[k] - excess[k - 1])
    return float(values[k - 1] + share * (values[k] - values[k - 1]))
