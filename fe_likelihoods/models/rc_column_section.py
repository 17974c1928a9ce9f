"""Cross-section of the reinforced-concrete column: dimensions, fibers and confinement of one circular section."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Integral

import numpy as np

from .circular_section import Confinement, bar_circle, circular_patches, circular_strips, mander_confinement
from .rc_column_parts import Bars, Hoops, Patches
from .validation import invalid

__all__ = ["ReinforcedSection"]


@dataclass(frozen=True)
class ReinforcedSection:
    """Circular section with a confined core, cover concrete and one circle of bars.

    Raises ValueError if the reinforcement does not fit into the section, or the mesh is not strips or `Patches`.
    """

    diameter: float  # outer [m]
    cover: float  # clear, to the outside of the hoops [m]
    bars: Bars
    hoops: Hoops
    mesh: int | Patches  # number of strips (even, at least 4), or rings and wedges

    def __post_init__(self) -> None:
        bars, hoops, radius = self.bars, self.hoops, self.bar_circle_radius
        if self.core_diameter <= 0.0:
            raise invalid(
                f"a cover smaller than the radius {self.diameter / 2:.4g} m minus the hoops",
                self.cover,
                "give the clear cover in m",
            )
        chord = 2.0 * radius * math.sin(math.pi / bars.number)
        if radius <= 0.0 or chord < bars.diameter:
            raise invalid(
                f"bars that fit on their circle of radius {radius:.4g} m",
                f"{bars.number} bars of {bars.diameter:.4g} m, {chord:.4g} m apart",
                "use fewer or thinner bars, or less cover",
            )
        if self.steel_ratio > 0.3:
            raise invalid(
                "an area of bars below 30 % of the core's",
                f"{100 * self.steel_ratio:.3g} %",
                "give the area of one bar, in m²",
            )
        if hoops.spacing - hoops.diameter >= 2.0 * self.core_diameter:
            raise invalid(
                "a spacing of hoops below two core diameters", hoops.spacing, "a larger spacing confines no core"
            )
        is_strips = isinstance(self.mesh, Integral) and self.mesh >= 4 and self.mesh % 2 == 0
        if not (isinstance(self.mesh, Patches) or is_strips):
            raise invalid("an even number of at least 4 strips, or Patches", self.mesh, "the default is 40 strips")

    @property
    def core_diameter(self) -> float:
        """Diameter of the confined core, between the centre lines of the hoops [m]."""
        return self.diameter - 2.0 * self.cover - self.hoops.diameter

    @property
    def bar_circle_radius(self) -> float:
        """Radius of the circle through the centres of the bars [m]."""
        return 0.5 * self.diameter - self.cover - self.hoops.diameter - 0.5 * self.bars.diameter

    @property
    def outermost_bars(self) -> tuple[float, float]:
        """Positions of the outermost bars at the negative and the positive side, in the direction of loading [m]."""
        y = self.fibers()[2][:, 0]  # the second axis of the element points against the direction of loading
        return float(-y.max()), float(-y.min())

    @property
    def steel_ratio(self) -> float:
        """Area of the longitudinal bars divided by the area of the core."""
        return self.bars.number * self.bars.area_each / (0.25 * math.pi * self.core_diameter**2)

    def fibers(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fibers of core, cover and bars, each (n, 2): position y [m] and area [m²]."""
        radius, core_radius = 0.5 * self.diameter, 0.5 * self.core_diameter
        if isinstance(self.mesh, Patches):
            m = self.mesh
            core, cover = circular_patches(radius, core_radius, m.wedges, m.core_rings, m.cover_rings)
        else:
            core, cover = circular_strips(radius, core_radius, self.mesh)
        bars = bar_circle(self.bar_circle_radius, self.bars.number, self.bars.area_each, self.bars.first_angle)
        return core, cover, bars

    def confinement(self, fc: float) -> Confinement:
        """Confinement of the core for concrete of the unconfined strength `fc` [Pa]."""
        return mander_confinement(
            fc,
            core_diameter=self.core_diameter,
            steel_ratio=self.steel_ratio,
            hoop_area=self.hoops.area_each,
            spacing=self.hoops.spacing,
            clear_spacing=self.hoops.spacing - self.hoops.diameter,
            fyh=self.hoops.fy,
            ultimate_hoop_strain=self.hoops.ultimate_strain,
            spiral=self.hoops.spiral,
        )
