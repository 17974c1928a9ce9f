"""Outputs of the reinforced-concrete column: the names of sensors, and how their values follow from a simulation.

An output is named by its quantity and its place, ``quantity@place``, with heights above the base and positions in m:

* ``acceleration``, ``displacement`` and ``force`` of the top;
* ``base_moment``, ``base_shear`` and ``axial_force`` at the base;
* ``curvature@height`` of the section at a height;
* ``strain@height:position`` of the concrete or of a bar at a position in that section, as a strain gauge measures it;
* ``rotation@lower:upper`` of the section at the upper height relative to the section at the lower height, as a pair of
  displacement transducers over a gauge length measures it.

Positions are measured from the axis of the column in the direction of loading. Curvatures, rotations, moments and shear
forces are positive where the column bends towards positive displacements; strains and axial forces are positive in
tension. Plane sections stay plane, so concrete and bars at the same position have the same strain.

Outputs at the integration points are section deformations. In between, axial strain and curvature follow the polynomial
through the points of the element (Neuenhofer & Filippou 1998). The integral of this polynomial over an element is the
sum that the element uses, so that the rotation between two nodes is the difference of their rotations.
``docs/sensors.rst`` describes the outputs.

References
----------
A. Neuenhofer, F. C. Filippou, Geometrically nonlinear flexibility-based frame finite element, Journal of Structural
Engineering 124(6), 1998, 704-711, doi:10.1061/(ASCE)0733-9445(1998)124:6(704).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Channel
from ..units import find_unit
from .validation import invalid

__all__ = ["Output", "Sections", "check_units", "display_channels", "parse_outputs", "section_heights"]


class _Row(NamedTuple):
    """Output that is a row of a simulation's history, times a sign."""

    quantity: str
    si_unit: str
    row: str
    sign: float


_ROWS = {
    "acceleration": _Row("absolute acceleration", "m/s2", "absolute acceleration", 1.0),
    "displacement": _Row("relative displacement", "m", "relative displacement", 1.0),
    "force": _Row("lateral force", "N", "force", 1.0),
    "base_moment": _Row("base moment", "N m", "base moment", -1.0),
    "base_shear": _Row("base shear force", "N", "base shear", 1.0),
    "axial_force": _Row("axial force", "N", "base axial force", 1.0),
}
_AT_TOP = ("acceleration", "displacement", "force")
"""Outputs at the top, which depend on the type of loading."""
_LOCATED = {"curvature": ("curvature", "1/m", 1), "strain": ("strain", "1", 2), "rotation": ("rotation", "rad", 2)}
"""Outputs with a place: quantity, SI unit, and how many values the place has."""

_ROUNDING = 1e-9
"""How far rounding may put a place outside the column, as a share of the column's height or radius."""

_NUMBER = r"([+-]?\d+\.?\d*(?:[eE][+-]?\d+)?|[+-]?\.\d+(?:[eE][+-]?\d+)?)"
_PLACE = re.compile(rf"(\w+)@{_NUMBER}(?::{_NUMBER})?")
_ADVICE = (
    'names are such as "base_moment", "base_shear", "axial_force", "curvature@0.3", "strain@0.3:-0.5" (height and '
    'position) and "rotation@0:0.6" (two heights), in m'
)


class Sections(NamedTuple):
    """Places of the integration points of a column.

    Attributes
    ----------
    height, radius : float
        Height of the column and radius of its section [m].
    n_elements : int
        Number of elements, which have equal lengths.
    points : ndarray[n_points]
        Integration points of an element, on [0, 1].
    """

    height: float
    radius: float
    n_elements: int
    points: np.ndarray

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


class Output(NamedTuple):
    """One output, with its name resolved.

    Attributes
    ----------
    name, quantity, si_unit : str
        Name of the channel, its quantity, and the SI unit of its values.
    row : str or None
        Row of the history with this output, or None for an output with a place.
    factor : float
        Factor of that row.
    strain, curvature : ndarray[n_sections] or None
        Weights of axial strain and curvature of the sections.
    slip : bool
        Whether the rotation by strain penetration below the base is added.
    """

    name: str
    quantity: str
    si_unit: str
    row: str | None
    factor: float = 1.0
    strain: np.ndarray | None = None
    curvature: np.ndarray | None = None
    slip: bool = False

    def evaluate(self, rows: Mapping[str, np.ndarray], deformations: np.ndarray, penetration: float) -> np.ndarray:
        """Values (n_steps,) of this output.

        Parameters
        ----------
        rows : mapping of str to ndarray[n_steps]
            Rows of the history, as the kernels record them.
        deformations : ndarray[n_steps, n_sections, 2]
            Axial strain at the axis and curvature [1/m] of every section, in the coordinates of the element, whose
            second axis points against the direction of loading.
        penetration : float
            Length of strain penetration below the base [m].
        """
        if self.row is not None:
            values = rows[self.row]
            return values if self.factor == 1.0 else self.factor * values
        curvature = self.curvature.copy()
        if self.slip:
            curvature[0] -= penetration
        total = np.zeros(len(deformations))
        # summed in a fixed order: a product of matrices is left to BLAS, whose last bit depends on its threads
        for part, weights in enumerate((self.strain, curvature)):
            for section in np.flatnonzero(weights):
                total += weights[section] * deformations[:, section, part]
        return total


def parse_outputs(names: object, sections: Sections, at_top: Sequence[str]) -> tuple[Output, ...]:
    """Resolve the names of outputs.

    Parameters
    ----------
    names : sequence of str
        The names, each once.
    sections : Sections
        Integration points of the column.
    at_top : sequence of str
        Outputs at the top that the type of loading has.

    Returns
    -------
    tuple of Output

    Raises
    ------
    ValueError
        If a name is unknown or repeated, or a place is outside the column.
    """
    if isinstance(names, str) or not isinstance(names, Sequence) or not names:
        raise invalid("outputs as a tuple of names", names, _ADVICE)
    outputs = tuple(_parse(name, sections, at_top) for name in names)
    if len(set(names)) != len(names):
        raise invalid("each of the outputs once", names, "remove the repeated name")
    return outputs


def _parse(name: object, sections: Sections, at_top: Sequence[str]) -> Output:
    if isinstance(name, str) and name in _ROWS and (name in at_top or name not in _AT_TOP):
        quantity, si_unit, row, sign = _ROWS[name]
        return Output(name, quantity, si_unit, row, sign)
    match = _PLACE.fullmatch(name) if isinstance(name, str) else None
    kind = match[1] if match else None
    place = [float(number) for number in match.groups()[1:] if number is not None] if match else []
    if kind not in _LOCATED or len(place) != _LOCATED[kind][2]:
        known = (*at_top, "base_moment", "base_shear", "axial_force", "curvature@...", "strain@...", "rotation@...")
        raise invalid(f"outputs out of {known} for this loading", name, _ADVICE)
    quantity, si_unit, _ = _LOCATED[kind]
    heights = place if kind == "rotation" else place[:1]
    rounding = _ROUNDING * sections.height
    if not all(-rounding <= height <= sections.height + rounding for height in heights):
        raise invalid(f"heights between 0 and {sections.height:.6g} m", name, "heights are measured from the base")
    place[: len(heights)] = [min(max(height, 0.0), sections.height) for height in heights]
    none = np.zeros(sections.n_elements * len(sections.points))
    if kind == "curvature":
        return Output(name, quantity, si_unit, None, strain=none, curvature=-sections.interpolation(place[0]))
    if kind == "strain":
        if not abs(place[1]) <= sections.radius * (1.0 + _ROUNDING):
            raise invalid(
                f"a position in the section, between {-sections.radius:.6g} and {sections.radius:.6g} m",
                name,
                "positions are measured from the axis of the column in the direction of loading",
            )
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
    for name, unit in units.items():
        kind = str(name).split("@")[0]
        known = _ROWS[kind].quantity if kind in _ROWS else _LOCATED[kind][0] if kind in _LOCATED else None
        if known is None:
            raise invalid(
                f"display units of channels out of {(*_ROWS, *_LOCATED)}", name, 'such as {"displacement": "in"}'
            )
        try:
            find_unit(unit, known.split()[-1])
        except ValueError as error:
            raise invalid(f"a display unit of {name}", unit, str(error)) from error


def section_heights(sections: Sections) -> np.ndarray:
    """Heights (n_sections,) of the integration points above the base [m]; ends of adjacent elements appear twice."""
    length = sections.height / sections.n_elements
    return ((np.arange(sections.n_elements)[:, None] + sections.points) * length).ravel()
