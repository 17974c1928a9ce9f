"""Circular reinforced-concrete section: fibers, and the strength that hoops give to the core.

**Strips, the default mesh.** The circle is cut into strips of equal height; the part of a strip inside the hoops is a
core fiber, the rest a cover fiber. Each stands at its radius of gyration about the axis of bending, y = sqrt(I/A), so
that area and second moment of the section are exact with any number of strips. Circular patches (rings and wedges),
the usual mesh, are available too; they are the poorer quadrature by far: with 20 wedges the acceleration of the tested
column is off by 10-18 % against .6 % for 40 strips (specs/bridge_column.md, section 8).

**Confinement** after Mander, Priestley & Park (1988), J. Struct. Eng. 114(8): effective lateral pressure of circular
hoops or spirals, strength and strain at the peak, and the ultimate strain of the energy balance in its usual
approximation (Priestley, Seible & Calvi 1996).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

__all__ = ["Confinement", "circular_strips", "circular_patches", "bar_circle", "mander_confinement", "gauss_lobatto"]


def _slice_moments(radius: float, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Integrals of the chord 2 sqrt(r^2 - y^2) and of y^2 times it from 0 to `y` (clipped to the circle)."""
    z = np.clip(y / radius, -1.0, 1.0)
    root = np.sqrt(1.0 - z * z)
    angle = np.arcsin(z)
    area = radius**2 * (angle + z * root)
    second = radius**4 * (angle - z * root * (1.0 - 2.0 * z * z)) / 4.0
    return area, second


def circular_strips(radius: float, core_radius: float, n_strips: int) -> tuple[np.ndarray, np.ndarray]:
    """Core and cover fibers of `n_strips` strips of equal height.

    Parameters
    ----------
    radius, core_radius : float
        Of the section and of the confined core [m].
    n_strips : int
        Even, so that no strip straddles the axis of bending.

    Returns
    -------
    core, cover : ndarray (n, 2)
        Position y and area of each fiber; strips that hold no core have no core fiber.
    """
    edges = np.linspace(-radius, radius, n_strips + 1)
    core_area, core_second = (np.diff(m) for m in _slice_moments(core_radius, edges))
    area, second = (np.diff(m) for m in _slice_moments(radius, edges))
    sign = np.where(np.arange(n_strips) < n_strips // 2, -1.0, 1.0)

    def fibers(a: np.ndarray, i: np.ndarray) -> np.ndarray:
        keep = a > 1e-12 * radius**2
        return np.column_stack([sign[keep] * np.sqrt(i[keep] / a[keep]), a[keep]])

    return fibers(core_area, core_second), fibers(area - core_area, second - core_second)


def circular_patches(
    radius: float, core_radius: float, n_wedges: int, n_core_rings: int, n_cover_rings: int
) -> tuple[np.ndarray, np.ndarray]:
    """Core and cover fibers of rings and wedges at the centroids of their cells, mirror cells merged.

    Returns
    -------
    core, cover : ndarray (n, 2)
        Position y and area of each fiber.
    """
    a = math.pi / n_wedges
    angles = a + 2.0 * a * np.arange(n_wedges)

    def rings(inner: float, outer: float, n_rings: int) -> np.ndarray:
        r = np.linspace(inner, outer, n_rings + 1)
        area = a * (r[1:] ** 2 - r[:-1] ** 2)
        centroid = 2.0 * math.sin(a) / (3.0 * a) * (r[1:] ** 3 - r[:-1] ** 3) / (r[1:] ** 2 - r[:-1] ** 2)
        y = np.outer(centroid, np.cos(angles)).ravel()
        return _merge(y, np.repeat(area, n_wedges), radius)

    return rings(0.0, core_radius, n_core_rings), rings(core_radius, radius, n_cover_rings)


def bar_circle(radius: float, n_bars: int, area: float, first_angle: float = 0.0) -> np.ndarray:
    """Bars evenly on a circle, the first at `first_angle` [rad] from the y axis; (n, 2) y and area, equal y merged."""
    y = radius * np.cos(first_angle + 2.0 * math.pi * np.arange(n_bars) / n_bars)
    return _merge(y, np.full(n_bars, area), radius)


def _merge(y: np.ndarray, area: np.ndarray, scale: float) -> np.ndarray:
    """Fibers of the same position as one: the section cannot tell them apart."""
    _, first, where = np.unique(np.round(y / scale, 12), return_index=True, return_inverse=True)
    return np.column_stack([y[first], np.bincount(where, weights=area)])


class Confinement(NamedTuple):
    """Confined concrete."""

    effectiveness: float  # ke
    lateral_pressure: float  # effective, fl' [Pa]
    strength_ratio: float  # fcc/fc
    strain_ratio: float  # eps_cc/eps_c0
    ultimate_strain: float


def mander_confinement(
    fc: float,
    *,
    core_diameter: float,
    steel_ratio: float,
    hoop_area: float,
    spacing: float,
    clear_spacing: float,
    fyh: float,
    ultimate_hoop_strain: float,
    spiral: bool,
) -> Confinement:
    """Mander's model for circular hoops or a spiral.

    Parameters
    ----------
    fc : float
        Strength of the unconfined concrete, positive [Pa].
    core_diameter : float
        Between the centre lines of the hoops [m].
    steel_ratio : float
        Area of the longitudinal bars over that of the core.
    hoop_area, spacing, clear_spacing : float
        Area of one set of hoops [m2], its spacing and the clear distance between sets [m].
    fyh, ultimate_hoop_strain : float
        Yield strength [Pa] and strain at fracture of the hoops.
    spiral : bool
        A spiral (one power of the arching reduction) instead of hoops (two).
    """
    volumetric_ratio = 4.0 * hoop_area / (core_diameter * spacing)
    arch = 1.0 - clear_spacing / (2.0 * core_diameter)
    effectiveness = (arch if spiral else arch * arch) / (1.0 - steel_ratio)
    pressure = 0.5 * effectiveness * volumetric_ratio * fyh
    strength_ratio = -1.254 + 2.254 * math.sqrt(1.0 + 7.94 * pressure / fc) - 2.0 * pressure / fc
    return Confinement(
        effectiveness=effectiveness,
        lateral_pressure=pressure,
        strength_ratio=strength_ratio,
        strain_ratio=1.0 + 5.0 * (strength_ratio - 1.0),
        ultimate_strain=0.004 + 1.4 * volumetric_ratio * fyh * ultimate_hoop_strain / (strength_ratio * fc),
    )


def gauss_lobatto(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of the Gauss-Lobatto rule with `n` points on [0, 1] (both ends included)."""
    legendre = np.polynomial.legendre.Legendre.basis(n - 1)
    x = np.concatenate([[-1.0], np.sort(legendre.deriv().roots().real), [1.0]])
    x = 0.5 * (x - x[::-1])  # exactly symmetric
    weights = 2.0 / (n * (n - 1) * legendre(x) ** 2)
    return 0.5 * (x + 1.0), 0.5 * weights
