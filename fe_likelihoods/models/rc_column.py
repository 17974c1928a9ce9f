"""Circular reinforced-concrete column of fiber sections, shaken at its base or pushed at its top.

A cantilever of force-based beam-column elements on a fixed base carries a mass at its top. Each section is made of core
concrete, cover concrete (Popovics, with tension softening) and bars (`kernels.reinforcing_steel`); large displacements
are followed by the corotational transformation; damping is a0 M + a1 Kc with the last committed tangent.

Two loadings, told by what is given as `loading`:

* a `Record`: base acceleration; channels "acceleration" (absolute) and "displacement" (relative) of the top;
* a `DisplacementHistory`: reversed lateral displacement of the top; channel "force", the lateral force it takes.

Structural parameters are multiples of the nominal values in `RCColumn.nominal`. What the literature leaves open (peak
strain of the concrete, softening in tension, geometry, rotational inertia, mesh ...) changes the response of the
tested column by tens of per cent (specs/bridge_column.md, section 8), so each is an argument.

References
----------
Ramancha, Astroza, Conte, Restrepo & Todd, "Bayesian nonlinear finite element model updating of a full-scale
bridge-column using sequential Monte Carlo" (the tested column and the five parameters).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from numbers import Integral
from typing import TYPE_CHECKING

import numpy as np

from ..kernels import concrete04, reinforcing_steel
from ..kernels.frame import Column, allocate
from ..kernels.jit import KERNEL_HASH
from ..kernels.newmark import HISTORY_ROWS, newmark
from ..kernels.static import impose_displacement
from ..signals.channels import Channel, Measurements, plot_response
from ..signals.records import DisplacementHistory, Record
from ..simulation.model import MisfitBatch, SimulationBatch, SimulationFailed
from ..simulation.threads import map_threads
from ..units import G0, find_unit, to_si
from .circular_section import (
    Confinement,
    bar_circle,
    circular_patches,
    circular_strips,
    gauss_lobatto,
    mander_confinement,
)
from .rc_column_parts import Bars, Concrete, Hoops, Patches, Steel
from .validation import channel_rows, number, refuse, theta_row, theta_rows, whole_number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


__all__ = ["Bars", "ColumnHistory", "Concrete", "Hoops", "Patches", "RCColumn", "Steel"]


@dataclass(frozen=True)
class ColumnHistory:
    """Everything one simulation can tell, for plots and checks: names and values (n_rows, n_steps), SI."""

    names: tuple[str, ...]
    values: np.ndarray
    retries: int

    def __getitem__(self, name: str) -> np.ndarray:
        return self.values[self.names.index(name)]


PARAMETERS = {
    "Ec": "modulus of concrete [Pa]",
    "Es": "modulus of steel [Pa]",
    "a0": "mass-proportional damping [1/s]",
    "a1": "stiffness-proportional damping [s]",
    "ft": "tensile strength of concrete [Pa]",
    "fc": "compressive strength of concrete [Pa]",
    "fy": "yield strength of steel [Pa]",
    "fu": "ultimate strength of steel [Pa]",
    "Esh": "hardening modulus of steel [Pa]",
    "mass": "mass at the top [kg]",
    "penetration": "penetration of strain into the foundation [m]",
}

PUSHOVER_ROWS = (
    "displacement",
    "vertical displacement",
    "rotation",
    "force",
    "base axial strain",
    "base curvature",
    "base axial force",
    "base moment",
)
_CHANNEL_ROWS = {"displacement": 0, "acceleration": 1, "force": 3}


@dataclass(frozen=True, eq=False)
class RCColumn:
    """Circular reinforced-concrete column; `simulate` turns multiples of the nominal parameters into responses.

    Attributes
    ----------
    loading : Record or DisplacementHistory
        Base acceleration, or lateral displacement of the top.
    diameter, height : float
        Of the section, and from the fixed base to the mass [m].
    cover : float
        Clear cover, to the outside of the hoops [m].
    concrete, steel, bars, hoops
        Materials and reinforcement.
    mass : float
        At the top [kg].
    axial_load : float or None
        Gravity load at the top [N], positive downwards. None: the weight of `mass`.
    rotational_inertia : float
        Of the mass [kg m2]. Zero by default, which only the tests of the preset can justify.
    vertical_mass : bool
        The mass acts vertically too.
    a0, a1 : float
        Rayleigh damping on the mass [1/s] and on the committed tangent stiffness [s].
    penetration : float
        Length below the base over which the base section's deformations go on, as the bars slip out of the foundation
        [m]: its rotation and its lift are added to the column's. Zero by default: a rigid anchorage. The usual estimate
        is .022 fy d [MPa, m] (Priestley, Seible & Calvi 1996), which with 2 elements of 3 points makes up their plastic
        hinge, .08 height + .022 fy d, because the end section of such an element stands for height/12.
    parameters : tuple of str
        Which of `PARAMETERS` make up theta, in this order.
    n_elements, n_points : int
        Elements, and Gauss-Lobatto points in each (2 to 7).
    mesh : int or Patches
        Number of strips (even), or rings and wedges.
    geometry : str
        "corotational" or "linear".
    substeps : int
        Integration steps in one step of the record, which is linear between its samples.
    max_increment : float or None
        Largest increment of an imposed displacement [m]; longer ones are divided. None: height/5000.
    outputs : tuple of str or None
        Channels; None: all that the loading has.
    units : dict
        Display units of the channels, by name.
    tolerance, element_tolerance : float
        Norm of the last Newton correction [m and rad], work of the last element correction [J].
    max_iterations, halvings : int
        Newton iterations of one attempt; how often a step may be halved before the simulation counts as failed.
    """

    loading: Record | DisplacementHistory
    diameter: float
    height: float
    cover: float
    concrete: Concrete
    steel: Steel
    bars: Bars
    hoops: Hoops
    mass: float
    axial_load: float | None = None
    rotational_inertia: float = 0.0
    vertical_mass: bool = True
    a0: float = 0.0
    a1: float = 0.0
    penetration: float = 0.0
    parameters: tuple[str, ...] = ("Ec", "Es", "a0", "a1", "ft")
    n_elements: int = 2
    n_points: int = 3
    mesh: int | Patches = 40
    geometry: str = "corotational"
    substeps: int = 1
    max_increment: float | None = None
    outputs: tuple[str, ...] | None = None
    units: tuple[tuple[str, str], ...] = ()
    tolerance: float = 1e-8
    element_tolerance: float = 1e-10
    max_iterations: int = 20
    halvings: int = 10

    @classmethod
    def lhpost(cls, loading: Record | DisplacementHistory, **changes) -> RCColumn:
        """The full-scale column of the LHPOST tests (UC San Diego, 2010) under `loading`; any argument can be changed.

        Values as in specs/bridge_column.md, section 0: the paper where it gives them (height, diameter, Ec, Es, ft,
        damping, weight), else a public model of the same column. Assumed, as the paper is silent: the peak strain
        2 fc/Ec, tension softening over .001 to a tenth of ft, no rotational inertia of the superstructure.
        """
        ksi, inch = to_si(1.0, "ksi").item(), to_si(1.0, "in").item()
        weight = to_si(522.0, "kip").item()
        values = dict(
            loading=loading,
            diameter=48.0 * inch,
            height=288.0 * inch,
            cover=2.0 * inch,
            concrete=Concrete(fc=6.1 * ksi, ec=3320.0 * ksi, ft=0.306 * ksi),
            steel=Steel(75.2 * ksi, 102.4 * ksi, 28400.0 * ksi, 456.0 * ksi, 0.0110, 0.1220),
            bars=Bars(number=18, diameter=1.41 * inch, area=1.56 * inch**2),
            hoops=Hoops(diameter=0.625 * inch, spacing=6.0 * inch, fy=54.8 * ksi, area=0.62 * inch**2),
            mass=weight / G0,
            a0=0.737,
            a1=0.0002016,
            units=(("acceleration", "g"), ("displacement", "in"), ("force", "kip")),
        )
        return cls(**(values | changes))

    def __post_init__(self) -> None:
        _check(self)
        object.__setattr__(self, "parameters", tuple(self.parameters))
        object.__setattr__(self, "units", tuple(dict(self.units).items()))
        if self.outputs is not None:
            object.__setattr__(self, "outputs", tuple(self.outputs))

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of theta, each a multiple of the value in `nominal`."""
        return self.parameters

    @property
    def nominal(self) -> dict[str, float]:
        """Nominal values of all parameters [SI]."""
        c, s = self.concrete, self.steel
        values = (c.ec, s.es, self.a0, self.a1, c.ft, c.fc, s.fy, s.fu, s.esh, self.mass, self.penetration)
        return dict(zip(PARAMETERS, values, strict=True))

    @property
    def channels(self) -> tuple[Channel, ...]:
        """Channels of the response, in order."""
        units = dict(self.units)
        known = (
            (
                Channel("acceleration", "absolute acceleration", units.get("acceleration", "m/s2")),
                Channel("displacement", "relative displacement", units.get("displacement", "m")),
            )
            if isinstance(self.loading, Record)
            else (Channel("force", "lateral force", units.get("force", "N")),)
        )
        return known if self.outputs is None else tuple(c for name in self.outputs for c in known if c.name == name)

    @property
    def dt(self) -> float:
        """Step of the response [s]; 1 (a step) under imposed displacement."""
        return self.loading.dt if isinstance(self.loading, Record) else 1.0

    @property
    def n_steps(self) -> int:
        """Number of samples of the response."""
        return self.loading.n_steps

    @property
    def core_diameter(self) -> float:
        """Diameter of the confined core, between the centre lines of the hoops [m]."""
        return self.diameter - 2.0 * self.cover - self.hoops.diameter

    @property
    def confinement(self) -> Confinement:
        """Confined concrete at the nominal strength."""
        return self._confinement(self.concrete.fc)

    @property
    def fingerprint(self) -> str:
        """Changes with anything that changes a response: arguments, loading, kernels."""
        parts = [
            f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.name not in ("loading", "units", "outputs")
        ]
        parts += [repr([c.name for c in self.channels]), self.loading.fingerprint, KERNEL_HASH, type(self).__name__]
        return hashlib.blake2b("|".join(parts).encode(), digest_size=16).hexdigest()

    def with_record(self, record: Record | DisplacementHistory) -> RCColumn:
        """The same column under another loading of the same kind; ValueError for one of another kind."""
        kind = type(self.loading)
        if not isinstance(record, kind):
            refuse(
                f"a {kind.__name__}, as the loading of this column is", type(record).__name__, "channels depend on it"
            )
        return replace(self, loading=record)

    def section(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fibers (y [m], area [m2]) of core, cover and bars, each (n, 2)."""
        radius, core_radius = 0.5 * self.diameter, 0.5 * self.core_diameter
        if isinstance(self.mesh, Patches):
            m = self.mesh
            core, cover = circular_patches(radius, core_radius, m.wedges, m.core_rings, m.cover_rings)
        else:
            core, cover = circular_strips(radius, core_radius, self.mesh)
        return (
            core,
            cover,
            bar_circle(self.bar_circle_radius, self.bars.number, self.bars.area_each, self.bars.first_angle),
        )

    def simulate(self, theta: np.ndarray) -> np.ndarray:
        """Response (n_channels, n_steps) [SI] at multiples `theta` (n_parameters,) of the nominal parameters.

        Raises
        ------
        SimulationFailed
            When the parameters make no material or a step does not converge.
        """
        history = self.history(theta)
        return np.ascontiguousarray(history.values[self._rows()])

    def history(self, theta: np.ndarray) -> ColumnHistory:
        """All that the kernels record: displacements, energies, forces (rows named), same errors as `simulate`."""
        return self._runner(theta_row(theta, self.parameters))

    def simulate_batch(self, thetas: np.ndarray) -> SimulationBatch:
        """Responses at `thetas` (n, n_parameters), on numba's number of threads."""
        run, rows = self._runner, self._rows()
        thetas = theta_rows(thetas, self.parameters)
        return SimulationBatch(*map_threads(lambda theta: run(theta).values[rows], thetas, (len(rows), self.n_steps)))

    def misfit_batch(self, thetas: np.ndarray, measured: np.ndarray) -> MisfitBatch:
        """Sums of squared residuals (n, n_channels) against `measured` (n_channels, n_steps); no response is kept."""
        run, rows = self._runner, self._rows()
        measured = channel_rows(measured, self.channels, self.n_steps)

        def misfit(theta: np.ndarray) -> np.ndarray:
            return ((run(theta).values[rows] - measured) ** 2).sum(axis=1)

        return MisfitBatch(*map_threads(misfit, theta_rows(thetas, self.parameters), (len(rows),)))

    def plot_section(self, axes: Axes | None = None) -> Axes:
        """Cover, core, mesh and bars of the section (`fe_likelihoods.plots.structures.plot_section`)."""
        from ..plots.structures import plot_section

        return plot_section(self, axes)

    def plot_response(self, theta: np.ndarray, measurements: Measurements | None = None) -> Figure:
        """Plot the response at `theta`, beside measurements if there are any."""
        response = Measurements(self.channels, self.dt, self.simulate(theta))
        return plot_response(
            response, measurements, time_label="time [s]" if isinstance(self.loading, Record) else "step"
        )

    def plot_hysteresis(self, theta: np.ndarray) -> Figure:
        """Base moment against curvature, force against displacement of the top."""
        from ..plots.structures import plot_column_loops

        return plot_column_loops(self, self.history(theta))

    def _rows(self) -> list[int]:
        return [_CHANNEL_ROWS[c.name] for c in self.channels]

    @property
    def bar_circle_radius(self) -> float:
        """Radius of the circle through the centres of the longitudinal bars [m]."""
        return 0.5 * self.diameter - self.cover - self.hoops.diameter - 0.5 * self.bars.diameter

    def _confinement(self, fc: float) -> Confinement:
        return mander_confinement(
            fc,
            core_diameter=self.core_diameter,
            steel_ratio=self.bars.number * self.bars.area_each / (0.25 * math.pi * self.core_diameter**2),
            hoop_area=self.hoops.area_each,
            spacing=self.hoops.spacing,
            clear_spacing=self.hoops.spacing - self.hoops.diameter,
            fyh=self.hoops.fy,
            ultimate_hoop_strain=self.hoops.ultimate_strain,
            spiral=self.hoops.spiral,
        )

    def _set_materials(self, column: Column, v: dict[str, float]) -> None:
        """Constants of core, cover and bars at the parameter values `v`, into `column`."""
        c, s = self.concrete, self.steel
        confinement = self._confinement(v["fc"])
        peak = c.peak_strain if c.peak_strain is not None else 2.0 * v["fc"] / v["Ec"]
        core_peak = peak * confinement.strain_ratio
        end_of_tension = v["ft"] / v["Ec"] + c.softening_strain
        tension = (v["Ec"], v["ft"], end_of_tension, c.softening_ratio)
        core_ultimate = max(confinement.ultimate_strain, 1.05 * core_peak)
        concrete04.constants(
            -v["fc"] * confinement.strength_ratio, -core_peak, -core_ultimate, *tension, column.concrete[0]
        )
        concrete04.constants(-v["fc"], -peak, -max(c.ultimate_strain, 1.5 * peak), *tension, column.concrete[1])
        reinforcing_steel.constants(
            v["fy"], v["fu"], v["Es"], v["Esh"], s.hardening_strain, s.ultimate_strain, column.steel
        )

    def __getstate__(self) -> dict:
        return {name: value for name, value in vars(self).items() if name != "_runner"}  # each process makes its own

    @cached_property
    def _runner(self) -> Callable[[np.ndarray], ColumnHistory]:
        """What is the same for every theta, done once; the function that is left runs one theta."""
        core, cover, bars = self.section()
        points, weights = gauss_lobatto(self.n_points)
        nominal = self.nominal
        shaken = isinstance(self.loading, Record)
        if shaken:
            instants = np.arange((self.n_steps - 1) * self.substeps + 1) / self.substeps
            ground = np.interp(instants, np.arange(self.n_steps), self.loading.acceleration)
        else:
            finer = self.loading.subdivide(self.max_increment or self.height / 5000.0)
            targets, kept = np.asarray(finer.history.displacement), np.asarray(finer.indices)
        n_dof = 3 * self.n_elements

        def run(theta: np.ndarray) -> ColumnHistory:
            v = nominal | dict(zip(self.parameters, np.asarray(theta, dtype=float).tolist(), strict=True))
            for name in self.parameters:
                v[name] = v[name] * nominal[name]
            _check_parameters(v, self.steel)
            column = allocate(
                n_elements=self.n_elements,
                height=self.height,
                corotational=self.geometry == "corotational",
                element_tolerance=self.element_tolerance,
                points=points,
                weights=weights,
                core=core,
                cover=cover,
                bars=bars,
                penetration=v["penetration"],
            )
            self._set_materials(column, v)
            gravity = np.zeros(n_dof)
            gravity[-2] = -(self.axial_load if self.axial_load is not None else v["mass"] * G0)
            if not shaken:
                history = np.zeros((len(PUSHOVER_ROWS), len(targets)))
                status, retries = impose_displacement(
                    column, gravity, targets, self.tolerance, self.max_iterations, self.halvings, history
                )
                if status:
                    raise SimulationFailed(_reason(status, len(targets), None, self.halvings))
                return ColumnHistory(PUSHOVER_ROWS, history[:, kept], retries)
            mass = np.zeros(n_dof)
            mass[-3:] = v["mass"], v["mass"] * self.vertical_mass, self.rotational_inertia
            history = np.zeros((len(HISTORY_ROWS), self.n_steps))
            dt = self.loading.dt / self.substeps
            status, retries, _ = newmark(
                column,
                gravity,
                mass,
                v["a0"],
                v["a1"],
                ground,
                dt,
                self.tolerance,
                self.max_iterations,
                self.halvings,
                self.substeps,
                0.0,
                history,
            )
            if status:
                raise SimulationFailed(_reason(status, len(ground), dt, self.halvings))
            return ColumnHistory(HISTORY_ROWS, history, retries)

        return run


def _reason(status: int, n_steps: int, dt: float | None, halvings: int) -> str:
    if status < 0:
        return "gravity load did not converge: the section cannot carry it at these parameters"
    at = "" if dt is None else f" (t = {status * dt:.4g} s)"
    return f"step {status} of {n_steps}{at} did not converge, halved {halvings} times"


def _check_parameters(v: dict[str, float], steel: Steel) -> None:
    """SimulationFailed for values that make no column; what a column can do without may be zero."""
    for name, value in v.items():
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and name not in ("a0", "a1", "ft", "penetration")):
            raise SimulationFailed(f"{name} = {value:.4g} {PARAMETERS[name]} makes no column: it must be positive")
    if v["fy"] / v["Es"] >= steel.hardening_strain:
        raise SimulationFailed("steel yields beyond the strain where its hardening begins: no plateau is left")
    if v["fu"] <= v["fy"]:
        raise SimulationFailed(f"the steel has no hardening: fu = {v['fu']:.4g} Pa is not above fy = {v['fy']:.4g} Pa")


def _check(m: RCColumn) -> None:
    """ValueError for a column that cannot be built, before anything is run."""
    if not isinstance(m.loading, (Record, DisplacementHistory)):
        refuse("a Record or a DisplacementHistory as loading", type(m.loading).__name__, "read one with records.read_*")
    for kind in (Concrete, Steel, Bars, Hoops):
        part = getattr(m, kind.__name__.lower())
        if not isinstance(part, kind):
            refuse(f"{kind.__name__}(...) as {kind.__name__.lower()}", part, "import it from this module")
    for name in ("diameter", "height", "mass", "tolerance", "element_tolerance"):
        number(name, getattr(m, name))
    for name in ("cover", "rotational_inertia", "a0", "a1", "penetration"):
        number(name, getattr(m, name), zero=True)
    if m.axial_load is not None:
        number("axial_load", m.axial_load, any_sign=True)
    if m.max_increment is not None:
        number("max_increment", m.max_increment)
    counts = {"n_elements": (1, 50), "n_points": (2, 7), "substeps": (1, 1000), "max_iterations": (2, 1000)}
    for name, (low, high) in (counts | {"halvings": (0, 30)}).items():
        whole_number(name, getattr(m, name), low, high)

    if m.core_diameter <= 0.0:
        refuse(f"a cover smaller than the radius {m.diameter / 2:.4g} m less hoops", m.cover, "cover is clear, in m")
    chord = 2.0 * m.bar_circle_radius * math.sin(math.pi / m.bars.number)
    if m.bar_circle_radius <= 0.0 or chord < m.bars.diameter:
        refuse(
            f"bars that fit on their circle of radius {m.bar_circle_radius:.4g} m",
            f"{m.bars.number} bars of {m.bars.diameter:.4g} m, {chord:.4g} m apart",
            "take fewer or thinner bars, or less cover",
        )
    steel_ratio = m.bars.number * m.bars.area_each / (0.25 * math.pi * m.core_diameter**2)
    if steel_ratio > 0.3:
        refuse("an area of bars below 30 % of the core's", f"{100 * steel_ratio:.3g} %", "give the area of one, in m2")
    if m.hoops.spacing - m.hoops.diameter >= 2.0 * m.core_diameter:
        refuse("a spacing of hoops below two core diameters", m.hoops.spacing, "beyond that no core is confined")
    if not (isinstance(m.mesh, Patches) or (isinstance(m.mesh, Integral) and m.mesh >= 4 and m.mesh % 2 == 0)):
        refuse("an even number of at least 4 strips, or Patches", m.mesh, "40 strips are the default")
    if m.geometry not in ("corotational", "linear"):
        refuse('geometry "corotational" or "linear"', m.geometry, "corotational is the default")

    shaken = isinstance(m.loading, Record)
    names = m.parameters
    if isinstance(names, str) or not isinstance(names, Sequence) or not names or set(names) - set(PARAMETERS):
        refuse(f"parameters out of {tuple(PARAMETERS)}", names, "see RCColumn.nominal for their values")
    if len(set(names)) != len(names):
        refuse("each of the parameters once", names, "leave the repeated one out")
    idle = [p for p in names if not shaken and p in ("a0", "a1")]
    if idle:
        refuse("parameters that act under imposed displacement", idle, "leave damping out of parameters")
    zero = [p for p in names if m.nominal[p] == 0.0]
    if zero:
        refuse("non-zero nominal values to take multiples of", zero, "give them, or leave them out of parameters")
    known = ("acceleration", "displacement") if shaken else ("force",)
    if m.outputs is not None and (
        not m.outputs or set(m.outputs) - set(known) or len(set(m.outputs)) != len(m.outputs)
    ):
        refuse(f"outputs out of {known}, each once", m.outputs, "these are what the loading gives")
    for name, unit in dict(m.units).items():
        if name not in _CHANNEL_ROWS:
            refuse(f"display units of channels out of {tuple(_CHANNEL_ROWS)}", name, 'such as {"displacement": "in"}')
        try:
            find_unit(unit, name)
        except ValueError as error:
            refuse(f"a display unit of {name}", unit, str(error))
