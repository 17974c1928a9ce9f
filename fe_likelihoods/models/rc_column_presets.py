"""Arguments of published columns."""

from __future__ import annotations

from typing import Any

from ..units import G0, to_si
from .rc_column_parts import Bars, Concrete, Hoops, Steel

__all__ = ["lhpost_arguments"]


def lhpost_arguments() -> dict[str, Any]:
    """Arguments of `RCColumn`, without loading, for the column tested on the LHPOST shake table (UC San Diego, 2010).

    Height, diameter, Ec, Es, ft, damping and weight are from Ramancha et al. (2022), the other values from a published
    model of the same column.
    """
    ksi, inch = to_si(1.0, "ksi").item(), to_si(1.0, "in").item()
    weight = to_si(522.0, "kip").item()
    return dict(
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
