"""Circular reinforced-concrete column under base acceleration or imposed displacement.

A cantilever of force-based beam-column elements on a fixed base carries a mass at its top. Each section consists of
fibers: core and cover concrete (Popovics envelope with tension softening) and bars. A corotational transformation
accounts for large displacements. The damping matrix is a0 M + a1 Kc, with the tangent stiffness Kc of the last
converged step. The laws and equations are in ``docs/theory`` (``concrete.rst``, ``reinforcing_steel.rst``,
``fiber_section.rst``, ``beam_column.rst`` and ``time_integration.rst``).

The type of `loading` selects the analysis:

* a `Record` is a base acceleration; the default channels are "acceleration" (absolute) and "displacement" (relative to
  the base) of the top;
* a `DisplacementHistory` is a reversed lateral displacement of the top; the default channel is "force", the lateral
  force that it requires.

Other channels are forces, moments, motions, curvatures, strains, stresses and rotations at the places of sensors
(`rc_column_outputs`).

The structural parameters are multiples of the nominal values in `RCColumn.nominal`. Choices that the literature leaves
open (peak strain of the concrete, softening in tension, geometry, rotational inertia, mesh) change the response of the
tested column by up to 75 %, so each is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from ..signals.channels import Channel
from ..signals.records import DisplacementHistory, Record
from ..signals.sampling import sample_window
from ..units import G0, to_si
from .base import BuiltInModel
from .rc_column_analysis import ColumnHistory, PreparedColumn, check_loading, run_column
from .rc_column_materials import (
    Bars,
    ColumnAnalysis,
    Concrete,
    Hoops,
    LowCycleFatigue,
    Steel,
)
from .rc_column_outputs import Output, Sections, check_units, display_channels, parse_outputs, section_heights
from .rc_column_section import Confinement, ReinforcedSection, gauss_lobatto
from .validation import (
    check_described,
    check_names,
    check_nominal,
    check_theta,
    described,
    invalid,
    structure,
)

_OF_FATIGUE = ("Cf", "Cd")
_NOMINAL_UNITS = {
    **dict(Ec="GPa", Es="GPa", a0="1/s", a1="s", ft="MPa", fc="MPa", fy="MPa", fu="MPa", Esh="GPa"),
    **dict(mass="kg", penetration="m"),
}
PARAMETERS = (*_NOMINAL_UNITS, *_OF_FATIGUE)


@structure
@dataclass(frozen=True, eq=False)
class RCColumn(BuiltInModel):
    """Circular reinforced-concrete column; theta holds multiples of the nominal parameters.

    Raises
    ------
    ValueError
        If an argument is out of range, or the arguments do not fit together.

    Notes
    -----
    The channels are the following outputs. Heights H are measured from the base and positions X from the axis of the
    column in the direction of loading [m].

    ===========================  ===================================================================================
    ``"acceleration"``           absolute acceleration of the top [m/s²], under a `Record` (default)
    ``"displacement"``           displacement of the top relative to the base [m], under a `Record` (default)
    ``"velocity"``               velocity of the top relative to the base [m/s], under a `Record`
    ``"relative_acceleration"``  acceleration of the top relative to the base [m/s²], under a `Record`
    ``"force"``                  lateral force at the top [N], under a `DisplacementHistory` (default)
    ``"base_moment"``            bending moment of the base section [N m]
    ``"base_shear"``             restoring force that the column transmits to its base, without damping forces [N]
    ``"axial_force"``            axial force of the base section [N]
    ``"displacement@H"``         displacement at height H relative to the base [m]
    ``"velocity@H"``             velocity of the node at height H [m/s], under a `Record`; below the top with
                                 `column_mass`. So are ``relative_acceleration@H`` and ``acceleration@H`` [m/s²],
                                 which vibrate above 20 Hz: with steps of 1/256 s they are wrong by 48 %, of 1 ms by 4 %
    ``"curvature@H"``            curvature of the section at height H [1/m]
    ``"strain@H:X"``             strain at position X in that section, of the concrete or of a bar
    ``"bar_stress@H:X"``         stress of the bar at position X of an element's section at height H [Pa]
    ``"concrete_stress@H:X"``    stress of the concrete fiber nearest to position X of such a section [Pa]
    ``"rotation@H:J"``           rotation of the section at height J relative to that at H [rad]; for H = 0 relative
                                 to the foundation, including the rotation by strain penetration
    ===========================  ===================================================================================

    Curvatures, rotations, moments and shear forces are positive where the column bends towards positive displacements.
    Strains, stresses and axial forces are positive in tension and include the effect of gravity. Strains and curvatures
    belong to a section at the heights `section_heights`, and are interpolated in between, as displacements are between
    nodes (``docs/sensors.rst``). Velocities and accelerations belong to nodes, and stresses to sections.

    Each value of theta is a multiple of a nominal value (`nominal`). The parameters are:

    ================  ============================================================
    ``Ec``            modulus of concrete [Pa]
    ``Es``            modulus of steel [Pa]
    ``a0``            mass-proportional damping [1/s]
    ``a1``            stiffness-proportional damping [s]
    ``ft``            tensile strength of concrete [Pa]
    ``fc``            compressive strength of concrete [Pa]
    ``fy``            yield strength of steel [Pa]
    ``fu``            ultimate strength of steel [Pa]
    ``Esh``           hardening modulus of steel [Pa]
    ``mass``          mass at the top [kg]
    ``penetration``   length of strain penetration into the foundation [m]
    ``Cf``            coefficient of Coffin and Manson, with `fatigue`
    ``Cd``            coefficient of strength loss, with `fatigue`
    ================  ============================================================

    Examples
    --------
    >>> column = RCColumn.lhpost(record)  # full-scale bridge column of the LHPOST tests
    >>> column.parameter_names
    ('Ec', 'Es', 'a0', 'a1', 'ft')
    >>> acceleration, displacement = column.simulate(np.ones(5))
    >>> strains = RCColumn.lhpost(record, outputs=("displacement", "strain@0.1:0.5"))
    """

    loading: Record | DisplacementHistory = described("", "Base acceleration, or lateral displacement of the top")
    diameter: float = described("m", "Diameter of the section", "positive")
    height: float = described("m", "Height from the fixed base to the mass", "positive")
    cover: float = described("m", "Clear cover, measured to the outside of the hoops", "zero or positive")
    concrete: Concrete = described("", "Unconfined concrete; the confinement of the core follows from the hoops")
    steel: Steel = described("", "Longitudinal steel")
    bars: Bars = described("", "Longitudinal reinforcement")
    hoops: Hoops = described("", "Transverse reinforcement")
    mass: float = described("kg", "Mass at the top", "positive")
    axial_load: float | None = described(
        "N", "Gravity load at the top, positive downwards; default: the weight of ``mass``", "finite", None
    )
    rotational_inertia: float = described("kg m²", "Rotational inertia of the mass", "zero or positive", 0.0)
    column_mass: float = described(
        "kg",
        "Mass of the column itself, with its weight",
        "zero or positive",
        0.0,
        "Half of each element's share is at either end: the nodes below the top have velocities and accelerations.",
    )
    a0: float = described("1/s", "Rayleigh damping: factor of the mass", "zero or positive", 0.0)
    a1: float = described("s", "Rayleigh damping: factor of the stiffness in the last step", "zero or positive", 0.0)
    penetration: float = described(
        "m",
        "Length of strain penetration below the base",
        "zero or positive",
        0.0,
        "The deformations of the base section continue over this length, because the bars slip out of the foundation. "
        "A common estimate is 0.022 fy d [MPa, m] (Priestley, Seible & Calvi, Seismic Design and Retrofit of Bridges, "
        "1996). With 2 elements of 3 points it completes the plastic hinge, 0.08 height + 0.022 fy d, because the end "
        "section of such an element represents height/12.",
    )
    fatigue: LowCycleFatigue | None = described(
        "", "Low-cycle fatigue of the bars; default: they neither lose strength nor fracture", default=None
    )
    parameters: tuple[str, ...] = described(
        "", "Names of the parameters in theta (``RCColumn`` lists them)", default=("Ec", "Es", "a0", "a1", "ft")
    )
    analysis: ColumnAnalysis = described("", "Mesh, integration and end of a simulation", default=ColumnAnalysis())
    outputs: tuple[str, ...] | None = described(
        "", "Names of the channels, that is, of the sensors (see the notes); default: those at the top", default=None
    )
    units: tuple[tuple[str, str], ...] = described(
        "", "Channel, or the part of its name before the @, = display unit", default=(), kind="table of text"
    )
    nominal_units: ClassVar[dict[str, str]] = _NOMINAL_UNITS

    @classmethod
    def lhpost(cls, loading: Record | DisplacementHistory, **changes) -> RCColumn:
        """Build the full-scale column tested on the LHPOST shake table (UC San Diego, 2010).

        Height, diameter, Ec, Es, ft, damping and weight are from Ramancha et al. (2022), the other values from a
        published model of the same column. They do not give, and this model assumes: the peak strain 2 fc/Ec, tension
        softening over a strain of 0.001 to a tenth of ft, and no rotational inertia of the superstructure. `changes`
        are arguments of `RCColumn` that replace the values of the tested column.

        Examples
        --------
        >>> RCColumn.lhpost(record, outputs=("displacement", "base_shear")).simulate(np.ones(5)).shape
        (2, 200)
        """
        ksi, inch = to_si(1.0, "ksi").item(), to_si(1.0, "in").item()
        arguments = dict(
            diameter=48.0 * inch,
            height=288.0 * inch,
            cover=2.0 * inch,
            concrete=Concrete(fc=6.1 * ksi, ec=3320.0 * ksi, ft=0.306 * ksi),
            steel=Steel(75.2 * ksi, 102.4 * ksi, 28400.0 * ksi, 456.0 * ksi, 0.0110, 0.1220),
            bars=Bars(number=18, diameter=1.41 * inch, area=1.56 * inch**2),
            hoops=Hoops(diameter=0.625 * inch, spacing=6.0 * inch, fy=54.8 * ksi, area=0.62 * inch**2),
            mass=to_si(522.0, "kip").item() / G0,
            a0=0.737,
            a1=0.0002016,
            units=(("acceleration", "g"), ("displacement", "in"), ("force", "kip")),
        )
        return cls(loading, **(arguments | changes))

    def __post_init__(self) -> None:
        self._check_arguments()
        self._check_names()
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(self, "units", tuple(dict(self.units).items()))
        if self.outputs is not None:
            object.__setattr__(self, "outputs", tuple(self.outputs))

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        c, s = self.concrete, self.steel
        values = (c.ec, s.es, self.a0, self.a1, c.ft, c.fc, s.fy, s.fu, s.esh, self.mass, self.penetration)
        found = dict(zip(PARAMETERS, values, strict=False))
        if self.fatigue is not None:
            found |= dict(zip(_OF_FATIGUE, (self.fatigue.cf, self.fatigue.cd), strict=True))
        return found

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the response, in order."""
        return self._channels

    @property
    def dt(self) -> float:
        """Time step of the response [s]; 1 (per step) for an imposed displacement."""
        return self.loading.dt if isinstance(self.loading, Record) else 1.0

    @property
    def n_steps(self) -> int:
        """Number of response samples."""
        return self.loading.n_steps

    @property
    def section_heights(self) -> np.ndarray:
        """Heights of the integration points above the base [m], where curvatures and strains are not interpolated."""
        return section_heights(self._sections)

    @cached_property
    def section(self) -> ReinforcedSection:
        """Cross-section: dimensions, fibers and confinement."""
        return ReinforcedSection(self.diameter, self.cover, self.bars, self.hoops, self.analysis.mesh)

    @property
    def core_diameter(self) -> float:
        """Diameter of the confined core, between the centre lines of the hoops [m]."""
        return self.section.core_diameter

    @property
    def bar_circle_radius(self) -> float:
        """Radius of the circle through the centres of the bars [m]."""
        return self.section.bar_circle_radius

    @property
    def confinement(self) -> Confinement:
        """Confinement of the core at the nominal strength of the concrete."""
        return self.section.confinement(self.concrete.fc)

    def with_record(self, record: Record | DisplacementHistory) -> RCColumn:
        """Return the same column under another loading of the same type; ValueError for another type."""
        kind = Record if isinstance(self.loading, Record) else DisplacementHistory
        if not isinstance(record, kind):
            raise invalid(
                f"a {kind.__name__}, the type of this column's loading",
                type(record).__name__,
                "build a new RCColumn for another type, because the channels depend on it",
            )
        return replace(self, loading=record)

    def followed_by(self, record: Record, rest: float = 10.0) -> RCColumn:
        """Return the same column under its present record, a pause of `rest` [s] and a further record.

        ValueError as `Record.followed_by`, and for a column under imposed displacement.
        """
        if not isinstance(self.loading, Record):
            advice = "join the displacements in one DisplacementHistory and build a new RCColumn"
            raise invalid("a column under a Record", type(self.loading).__name__, advice)
        return self.with_record(self.loading.followed_by(record, rest))

    def first(self, seconds: float) -> RCColumn:
        """Return the same column up to the sample at `seconds` [s] of its response, or the step of this number.

        ValueError if it is not within the response, or fewer than two samples remain.
        """
        window = sample_window("the response", self.n_steps, self.dt, 0.0, seconds)
        if isinstance(self.loading, Record):
            return self.with_record(self.loading.trim(0.0, seconds))
        return self.with_record(replace(self.loading, displacement=self.loading.displacement[window]))

    def history(self, theta: np.ndarray) -> ColumnHistory:
        """Simulate and return all histories that the kernels record, and the outputs of the column by their names.

        The kernel histories, such as "base moment", have the signs of the element, whose second axis points against the
        direction of loading: ``history["base_moment"]``, an output, is ``-history["base moment"]``.
        """
        history, outputs = run_column(self, self._prepared, check_theta(theta, self.parameters))
        sensors = {name: values for name, values in outputs.items() if name not in history.names}
        values = np.vstack([history.values, *sensors.values()])
        return replace(history, names=(*history.names, *sensors), values=values)

    def _respond(self, theta: np.ndarray) -> np.ndarray:
        return np.stack(list(run_column(self, self._prepared, theta)[1].values()))

    def _prepare(self) -> PreparedColumn:
        return PreparedColumn.of(self, self._parsed_outputs)

    @property
    def _sections(self) -> Sections:
        n_elements, points = self.analysis.n_elements, gauss_lobatto(self.analysis.n_points)[0]
        return Sections(self.height, 0.5 * self.diameter, n_elements, points, self.section, self.column_mass > 0.0)

    @cached_property
    def _channels(self) -> tuple[Channel, ...]:
        return display_channels(self._parsed_outputs, dict(self.units))

    @cached_property
    def _parsed_outputs(self) -> tuple[Output, ...]:
        names = self._channel_names if self.outputs is None else self.outputs
        return parse_outputs(names, self._sections, self._channel_names)

    @property
    def _channel_names(self) -> tuple[str, ...]:
        return ("acceleration", "displacement") if isinstance(self.loading, Record) else ("force",)

    def _check_arguments(self) -> None:
        """Raise ValueError for arguments from which no column can be built."""
        parts = {"concrete": Concrete, "steel": Steel, "bars": Bars, "hoops": Hoops, "analysis": ColumnAnalysis}
        for name, kind in (parts | {"fatigue": LowCycleFatigue}).items():
            part = getattr(self, name)
            if not isinstance(part, kind) and (part is not None or name in parts):
                raise invalid(f"{kind.__name__}(...) as {name}", part, "import it from fe_likelihoods")
        check_described(self)
        check_loading(self.loading, self.height)
        _ = self.section  # checks its dimensions

    def _check_names(self) -> None:
        """Raise ValueError for unknown or repeated names of parameters, outputs and units."""
        check_names("parameters", self.parameters, PARAMETERS, "see RCColumn.nominal for their values")
        idle = [name for name in self.parameters if name in ("a0", "a1")]
        if idle and not isinstance(self.loading, Record):
            raise invalid("parameters that act under imposed displacement", idle, "leave damping out of parameters")
        idle = [name for name in self.parameters if name in _OF_FATIGUE]
        if idle and self.fatigue is None:
            raise invalid("parameters that act without fatigue", idle, "add fatigue=LowCycleFatigue() to the column")
        check_nominal(self.parameters, self.nominal)
        _ = self._parsed_outputs  # checks the names
        check_units(dict(self.units))
