"""Outputs of the reinforced-concrete column: the names of sensors, and how their values follow from a simulation.

`RCColumn` and ``docs/sensors.rst`` list them. Outputs at the integration points are section deformations. In between,
axial strain and curvature follow the polynomial through the points of the element (Neuenhofer & Filippou 1998). The
integral of this polynomial over an element is the sum that the element uses, so that the rotation between two nodes is
the difference of their rotations. The second integral of the curvature is the deflection from the chord of the element.
Velocities and accelerations belong to nodes with a mass, stresses to the sections, whose fibers have a history.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Channel
from ..units import find_unit
from .rc_column_section import ReinforcedSection
from .validation import invalid

_ROWS = {
    "acceleration": ("absolute acceleration", "m/s2", "absolute acceleration", 1.0),
    "displacement": ("relative displacement", "m", "relative displacement", 1.0),
    "force": ("lateral force", "N", "force", 1.0),
    "base_moment": ("base moment", "N m", "base moment", -1.0),
    "base_shear": ("base shear force", "N", "base shear", 1.0),
    "axial_force": ("axial force", "N", "base axial force", 1.0),
}
"""Outputs that are a row of a simulation's history: quantity, SI unit, row, sign."""
_AT_TOP = ("acceleration", "displacement", "force")
"""Outputs at the top, which depend on the type of loading."""
_LOCATED = {
    "displacement": ("relative displacement", "m", 1),
    "velocity": ("relative velocity", "m/s", 1),
    "relative_acceleration": ("relative acceleration", "m/s2", 1),
    "acceleration": ("absolute acceleration", "m/s2", 1),
    "curvature": ("curvature", "1/m", 1),
    "strain": ("strain", "1", 2),
    "bar_stress": ("bar stress", "Pa", 2),
    "concrete_stress": ("concrete stress", "Pa", 2),
    "rotation": ("rotation", "rad", 2),
}
"""Outputs with a place: quantity, SI unit, and how many values the place has."""
_MOTIONS = ("displacement", "velocity", "relative_acceleration", "acceleration")
"""Outputs of the motion, in the order of the recorded rows; the last one is the third row plus the base motion."""

_SAME_PLACE = 1e-3
"""How far a sensor may be from a node or a section to belong to it, as a share of the column's height."""
_ROUNDING = 1e-9
"""How far rounding may put a place outside the column, as a share of the column's height or radius."""

_NUMBER = r"([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?|[+-]?\.\d+(?:[eE][+-]?\d+)?)"
_PLACE = re.compile(rf"(\w+)@{_NUMBER}(?::{_NUMBER})?")
_ADVICE = (
    'names are such as "base_moment", "base_shear", "axial_force", "displacement@2.4", "curvature@0.3", '
    '"strain@0.3:-0.5" (height and position) and "rotation@0:0.6" (two heights), in m'
)


class Sections(NamedTuple):
    """Places of the integration points of a column, and what can be recorded there."""

    height: float  # [m]
    radius: float  # of the section [m]
    n_elements: int  # of equal lengths
    points: np.ndarray  # (n_points,) integration points of an element, on [0, 1]
    section: ReinforcedSection | None = None  # for stresses
    has_mass: bool = False  # of all nodes, so that the equation of motion determines their accelerations

    def interpolation(self, height: float) -> np.ndarray:
        """Weights (n_sections,) of the sections in the value at `height` [m]."""
        element, xi = self._locate(height)
        return self._spread(element, self._lagrange(xi))

    def integral(self, lower: float, upper: float) -> np.ndarray:
        """Weights (n_sections,) [m] of the sections in the integral from one height [m] to another."""
        length = self.height / self.n_elements
        nodes, gauss = np.polynomial.legendre.leggauss(len(self.points))  # exact for the interpolating polynomial
        total = np.zeros(self.n_elements * len(self.points))
        for element in range(self.n_elements):
            a = min(max(lower / length - element, 0.0), 1.0)
            b = min(max(upper / length - element, 0.0), 1.0)
            if b > a:
                xi = 0.5 * (a + b) + 0.5 * (b - a) * nodes
                shares = sum(w * self._lagrange(x) for w, x in zip(gauss, xi, strict=True))
                total += self._spread(element, 0.5 * (b - a) * length * shares)
        return total

    def deflection(self, height: float) -> tuple[int, float, np.ndarray]:
        """Element, place in it on [0, 1], and weights (n_sections,) [m²] of the curvatures in the deflection there.

        The deflection is across the chord of the element, from it.
        """
        element, xi = self._locate(height)
        nodes, gauss = np.polynomial.legendre.leggauss(len(self.points) + 1)  # exact, of one degree more

        def twice_integrated(upper: float) -> np.ndarray:
            at = 0.5 * upper * (1.0 + nodes)
            return sum(0.5 * upper * w * (upper - x) * self._lagrange(x) for w, x in zip(gauss, at, strict=True))

        length = self.height / self.n_elements
        return element, xi, self._spread(element, length**2 * (twice_integrated(xi) - xi * twice_integrated(1.0)))

    def node_at(self, name: str, height: float) -> int:
        """Number of the node at a height, from 1; ValueError for the output `name` if there is none."""
        element = self.height / self.n_elements
        node = max(1, round(height / element))
        if abs(node * element - height) > _SAME_PLACE * self.height:
            advice = "n_elements decides where the nodes are; displacements are interpolated between them"
            raise invalid(f"a height of a node, {_heights(element * np.arange(1, self.n_elements + 1))}", name, advice)
        if node < self.n_elements and not self.has_mass:
            expected = "a column whose nodes have a mass, for velocities and accelerations below the top"
            raise invalid(expected, name, "give the mass of the column itself, column_mass [kg]")
        return node

    def fiber_at(self, name: str, height: float, position: float, bar: bool) -> tuple[int, int]:
        """Section and number of a fiber (`fe_likelihoods.kernels.frame.Recorder`) at a place; ValueError as above."""
        distances = np.abs(section_heights(self) - height)
        if distances.min() > _SAME_PLACE * self.height:
            advice = "n_elements and n_points decide where the sections are; stresses are not interpolated"
            raise invalid(f"a height of a section, {_heights(np.unique(section_heights(self)))}", name, advice)
        section = int(np.flatnonzero(distances <= distances.min() + _ROUNDING * self.height)[-1])  # the upper element's
        core, cover, bars = self.section.fibers()
        if not bar:
            first, part = (0, core) if abs(position) <= 0.5 * self.section.core_diameter else (len(core), cover)
            return section, first + int(np.abs(part[:, 0] + position).argmin())
        nearest = int(np.abs(bars[:, 0] + position).argmin())
        if abs(bars[nearest, 0] + position) > 0.5 * self.section.bars.diameter:
            places = _heights(np.unique(np.round(-bars[:, 0], 4)))
            raise invalid(f"a position on a bar, {places}", name, "concrete_stress has the concrete")
        return section, -1 - nearest

    def _locate(self, height: float) -> tuple[int, float]:
        """Element and place in it on [0, 1]; a node between two elements belongs to the upper one."""
        place = height * self.n_elements / self.height
        element = min(int(place + 1e-9), self.n_elements - 1)
        return element, place - element

    def _lagrange(self, xi: float) -> np.ndarray:
        """Lagrange polynomials of the points (n_points,) at `xi`; one and zeros at a point."""
        near = np.abs(self.points - xi) < 1e-9
        if near.any():
            return near.astype(float)
        difference = self.points[:, None] - self.points
        np.fill_diagonal(difference, 1.0)
        ratio = (xi - self.points) / difference
        np.fill_diagonal(ratio, 1.0)
        return ratio.prod(axis=1)

    def _spread(self, element: int, shares: np.ndarray) -> np.ndarray:
        total = np.zeros(self.n_elements * len(self.points))
        total[element * len(self.points) : (element + 1) * len(self.points)] = shares
        return total


class Recording(NamedTuple):
    """What a simulation recorded of the outputs.

    Deformations are in the coordinates of the element, whose second axis points against the direction of loading.
    """

    rows: Mapping[str, np.ndarray]  # (n_steps,) each, as the kernels record them
    deformations: np.ndarray  # (n_steps, n_sections, 2) axial strain at the axis and curvature [1/m]
    motion: np.ndarray  # (n_steps, 1 or 3, n_dof) of the nodes relative to the base
    ground: np.ndarray | None  # (n_steps,) base acceleration [m/s²]
    stresses: Mapping[tuple[int, int], np.ndarray]  # (n_steps,) of each recorded fiber [Pa]
    penetration: float  # length of strain penetration below the base [m]
    length: float  # of an element [m], infinite for linear geometry


class Output(NamedTuple):
    """One output, with its name resolved."""

    name: str
    quantity: str
    si_unit: str
    row: str | None  # row of the history; None for an output with a place
    factor: float = 1.0  # of this row
    strain: np.ndarray | None = None  # (n_sections,) weights of the axial strains
    curvature: np.ndarray | None = None  # of the curvatures; with `motion`, of the deflection from the chord
    slip: bool = False  # add the rotation by strain penetration below the base
    motion: int | None = None  # number of the motion
    node: int = 0  # of the motion, from 1: the upper end of the element
    xi: float = 1.0  # place in this element, 1 at the node
    fiber: tuple[int, int] | None = None  # section and number

    def evaluate(self, recording: Recording) -> np.ndarray:
        """Values (n_steps,) of this output [SI]."""
        if self.row is not None:
            values = recording.rows[self.row]
            return values if self.factor == 1.0 else self.factor * values
        if self.fiber is not None:
            return recording.stresses[self.fiber]
        if self.motion is not None:
            return self._motion(recording)
        curvature = self.curvature.copy()
        if self.slip:
            curvature[0] -= recording.penetration
        total = np.zeros(len(recording.deformations))
        _add(total, self.strain, recording.deformations[:, :, 0])
        _add(total, curvature, recording.deformations[:, :, 1])
        return total

    def _motion(self, recording: Recording) -> np.ndarray:
        """Motion of a node, or the displacement of a point between two nodes."""
        absolute = self.motion == _MOTIONS.index("acceleration")
        upper = recording.motion[:, self.motion - absolute]
        x = 3 * self.node - 3
        if self.xi == 1.0:
            return upper[:, x] + recording.ground if absolute else upper[:, x].copy()
        top, bottom = upper[:, x : x + 2].T, upper[:, x - 3 : x - 1].T if x else np.zeros((2, len(upper)))
        slope = (top[0] - bottom[0]) / (recording.length + top[1] - bottom[1])  # of the chord
        across = np.zeros(len(upper))
        _add(across, self.curvature, recording.deformations[:, :, 1])
        return bottom[0] + self.xi * (top[0] - bottom[0]) + across / np.sqrt(1.0 + slope**2)


def _add(total: np.ndarray, weights: np.ndarray, values: np.ndarray) -> None:
    """Add the weighted columns of `values` (n_steps, n_sections), one after the other.

    A product of matrices is left to BLAS, whose last bit depends on its threads.
    """
    for section in np.flatnonzero(weights):
        total += weights[section] * values[:, section]


def parse_outputs(names: object, sections: Sections, at_top: Sequence[str]) -> tuple[Output, ...]:
    """Resolve names of outputs, each once; `at_top` are the outputs at the top that the type of loading has.

    Raises ValueError if a name is unknown or repeated, or a place is outside the column.
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise invalid("outputs as a tuple of names", names, _ADVICE)
    outputs = tuple(_parse(name, sections, at_top) for name in names)
    if len(set(names)) != len(names):
        raise invalid("each of the outputs once", names, "remove the repeated name")
    return outputs


def _parse(name: object, sections: Sections, at_top: Sequence[str]) -> Output:
    moving = "acceleration" in at_top
    if isinstance(name, str) and name in _ROWS and (name in at_top or name not in _AT_TOP):
        quantity, si_unit, row, sign = _ROWS[name]
        return Output(name, quantity, si_unit, row, sign)
    match = _PLACE.fullmatch(name) if isinstance(name, str) else None
    kind = match[1] if match else None
    place = [float(number) for number in match.groups()[1:] if number is not None] if match else []
    if name in ("velocity", "relative_acceleration"):
        kind, place = name, [sections.height]
    located = [each for each in _LOCATED if moving or each not in _MOTIONS[1:]]
    if kind not in located or len(place) != _LOCATED[kind][2]:
        of_top = ("velocity", "relative_acceleration") if moving else ()
        known = (*at_top, *of_top, "base_moment", "base_shear", "axial_force", *(f"{each}@..." for each in located))
        raise invalid(f"outputs out of {known} for this loading", name, _ADVICE)
    quantity, si_unit, _ = _LOCATED[kind]
    heights = place if kind == "rotation" else place[:1]
    rounding = _ROUNDING * sections.height
    if not all(-rounding <= height <= sections.height + rounding for height in heights):
        raise invalid(f"heights between 0 and {sections.height:.6g} m", name, "heights are measured from the base")
    place[: len(heights)] = [min(max(height, 0.0), sections.height) for height in heights]
    if kind in _MOTIONS:
        motion = _MOTIONS.index(kind)
        if kind != "displacement":
            return Output(name, quantity, si_unit, None, motion=motion, node=sections.node_at(name, place[0]))
        element, xi, across = sections.deflection(place[0])
        if abs(xi - 1.0) < _ROUNDING:
            return Output(name, quantity, si_unit, None, motion=motion, node=element + 1)
        return Output(name, quantity, si_unit, None, curvature=-across, motion=motion, node=element + 1, xi=xi)
    none = np.zeros(sections.n_elements * len(sections.points))
    if kind == "curvature":
        return Output(name, quantity, si_unit, None, strain=none, curvature=-sections.interpolation(place[0]))
    if kind != "rotation":
        if not abs(place[1]) <= sections.radius * (1.0 + _ROUNDING):
            expected = f"a position in the section, between {-sections.radius:.6g} and {sections.radius:.6g} m"
            raise invalid(expected, name, "positions are from the axis of the column in the direction of loading")
        if kind != "strain":
            return Output(name, quantity, si_unit, None, fiber=sections.fiber_at(name, *place, kind == "bar_stress"))
        weights = sections.interpolation(place[0])
        return Output(name, quantity, si_unit, None, strain=weights, curvature=place[1] * weights)
    if not place[0] < place[1]:
        raise invalid("a rotation between a lower and a higher section", name, "give the lower height first")
    curvature = -sections.integral(*place)
    return Output(name, quantity, si_unit, None, strain=none, curvature=curvature, slip=place[0] == 0.0)


def display_channels(outputs: Sequence[Output], units: Mapping[str, str]) -> tuple[Channel, ...]:
    """Channels of the outputs; `units` has display units by the whole name or by the part before the ``@``."""
    return tuple(
        Channel(each.name, each.quantity, units.get(each.name, units.get(each.name.split("@")[0], each.si_unit)))
        for each in outputs
    )


def check_units(units: Mapping[str, str]) -> None:
    """Raise ValueError for display units of unknown outputs, or of another dimension."""
    quantities = {kind: each[0] for kind, each in (_ROWS | _LOCATED).items()}
    for name, unit in units.items():
        known = quantities.get(str(name).split("@")[0])
        if known is None:
            raise invalid(
                f"display units of channels out of {tuple(quantities)}", name, 'such as {"displacement": "in"}'
            )
        try:
            find_unit(unit, known.split()[-1])
        except ValueError as error:
            raise invalid(f"a display unit of {name}", unit, str(error)) from error


def _heights(values: np.ndarray) -> str:
    return f"{', '.join(f'{value:.4g}' for value in values)} m"


def section_heights(sections: Sections) -> np.ndarray:
    """Heights (n_sections,) of the integration points above the base [m]; ends of adjacent elements appear twice."""
    length = sections.height / sections.n_elements
    return ((np.arange(sections.n_elements)[:, None] + sections.points) * length).ravel()
