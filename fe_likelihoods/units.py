"""Units: a table from the name of a unit to its SI factor and its dimension.

All numbers inside the library are in SI units; they are converted only where files are read (`to_si`), and where labels
and figures are made (`from_si`). An unknown unit, or one of another dimension, raises ValueError, because a wrong unit
gives results that look right. Factors are exact by definition: 1 in = 25.4 mm, 1 lb = 0.45359237 kg, g = 9.80665 m/s².
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

G0 = 9.80665
"""Standard acceleration of gravity [m/s²] (3rd General Conference on Weights and Measures, 1901)."""

INCH = 0.0254
FOOT = 12 * INCH
POUND_FORCE = 0.45359237 * G0


class Unit(NamedTuple):
    """A unit of measurement."""

    name: str  # canonical
    factor: float  # size in the SI unit of its dimension
    dimension: str  # a key of `DIMENSIONS`


_FACTORS = {
    "acceleration": {
        "m/s2": 1.0,
        "cm/s2": 1e-2,
        "mm/s2": 1e-3,
        "in/s2": INCH,
        "ft/s2": FOOT,
        "gal": 1e-2,
        "g": G0,
        "mg": 1e-3 * G0,
    },
    "velocity": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "in/s": INCH, "ft/s": FOOT},
    "displacement": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": INCH, "ft": FOOT},
    "force": {"N": 1.0, "kN": 1e3, "MN": 1e6, "lbf": POUND_FORCE, "kip": 1e3 * POUND_FORCE},
    "stress": {
        "Pa": 1.0,
        "kPa": 1e3,
        "MPa": 1e6,
        "GPa": 1e9,
        "psi": POUND_FORCE / INCH**2,
        "ksi": 1e3 * POUND_FORCE / INCH**2,
    },
    "moment": {
        "N m": 1.0,
        "kN m": 1e3,
        "MN m": 1e6,
        "lbf in": POUND_FORCE * INCH,
        "lbf ft": POUND_FORCE * FOOT,
        "kip in": 1e3 * POUND_FORCE * INCH,
        "kip ft": 1e3 * POUND_FORCE * FOOT,
    },
    "energy": {"J": 1.0, "kJ": 1e3, "MJ": 1e6},
    "curvature": {"1/m": 1.0, "1/mm": 1e3, "1/km": 1e-3, "1/in": 1.0 / INCH, "1/ft": 1.0 / FOOT},
    "stiffness": {
        "N/m": 1.0,
        "N/mm": 1e3,
        "kN/m": 1e3,
        "kN/mm": 1e6,
        "MN/m": 1e6,
        "lbf/in": POUND_FORCE / INCH,
        "kip/in": 1e3 * POUND_FORCE / INCH,
        "kip/ft": 1e3 * POUND_FORCE / FOOT,
    },
    "rotational stiffness": {"N m/rad": 1.0, "kN m/rad": 1e3, "MN m/rad": 1e6},
    "mass": {"kg": 1.0, "tonne": 1e3, "lb": POUND_FORCE / G0, "lbf s2/in": POUND_FORCE / INCH},
    "frequency": {"Hz": 1.0, "kHz": 1e3, "rad/s": 0.5 / np.pi, "rpm": 1.0 / 60.0},
    "eigenvalue": {"1/s2": 1.0},
    "temperature": {"degC": 1.0},  # no kelvin: a factor cannot convert it
    "dimensionless": {"1": 1.0, "%": 1e-2},  # and a strain where no dimension is stated
    "strain": {"1": 1.0, "%": 1e-2, "microstrain": 1e-6},
    "rotation": {"rad": 1.0, "mrad": 1e-3, "deg": np.pi / 180},
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
}

UNITS: dict[str, Unit] = {
    name: Unit(name, factor, dimension) for dimension, table in _FACTORS.items() for name, factor in table.items()
}
"""All known units by their canonical name."""

DIMENSIONS: dict[str, str] = {
    dimension: next(name for name, factor in table.items() if factor == 1.0) for dimension, table in _FACTORS.items()
}
"""The SI unit of each dimension."""

_BY_LOWER_CASE = {name.replace(" ", "").lower(): unit for name, unit in UNITS.items()}
_MICRO = "u\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}"
_MICROSTRAIN = {"ue", *(f"{mu}{each}" for mu in _MICRO for each in ("\N{GREEK SMALL LETTER EPSILON}", "m/m", "strain"))}


def find_unit(name: str, dimension: str | None = None) -> Unit:
    """Return the unit with a name; ValueError lists the known units if it is unknown or has another dimension.

    The spellings of common file formats are understood: ``cm/sec/sec``, ``cm/sec2``, ``cm/s^2`` and ``cm_s2`` are all
    ``cm/s2``; ``kN-m``, ``kN*m``, ``kN.m``, ``kN_m`` and ``kNm`` are ``kN m``; ``seconds`` is ``s``; ``ue`` is
    ``microstrain``, ``µm`` is ``um``, ``mg`` a thousandth of g. Letter case is ignored, because file headers are often
    in capitals, except for the prefix of ``MN`` and ``MPa``: ``mN`` would be smaller by a factor of 10⁹.
    """
    if dimension is not None and dimension not in DIMENSIONS:
        raise ValueError(f"unknown dimension {dimension!r}; known dimensions: {', '.join(DIMENSIONS)}")
    unit = _lookup(name) if isinstance(name, str) else None
    if dimension == "mass" and name == "t":  # elsewhere a single letter is too short to be a unit
        unit = UNITS["tonne"]
    if unit is None and dimension == "temperature" and name in ("K", "kelvin"):
        raise ValueError("temperatures in kelvin are not converted by a factor: subtract 273.15, and give degC")
    if unit is None:
        raise ValueError(f"unknown unit {name!r}; known units: {_known(dimension)}")
    if dimension is not None and unit.name in _FACTORS[dimension]:
        return unit._replace(dimension=dimension)
    if dimension is not None:
        raise ValueError(
            f"expected a unit of {dimension}, got {name!r}, a unit of {unit.dimension}; {_known(dimension)}"
        )
    return unit


def to_si(values: ArrayLike, unit: str, dimension: str | None = None) -> NDArray[np.float64]:
    """Convert values to SI units.

    Parameters
    ----------
    values : array_like
        Numbers in `unit`.
    unit : str
        Name of a unit in `UNITS` (see `find_unit` for the spellings).
    dimension : str, optional
        Required dimension of the unit, a key of `DIMENSIONS`.

    Returns
    -------
    ndarray
        The numbers in SI units, float64, of the same shape (a scalar for a scalar).

    Raises
    ------
    ValueError
        If the unit is unknown or has another dimension.

    Examples
    --------
    >>> to_si([1.0, 2.0], "kN")
    array([1000., 2000.])
    >>> float(to_si(0.5, "g"))  # m/s²
    4.903325
    """
    return np.asarray(values, dtype=np.float64) * find_unit(unit, dimension).factor


def from_si(values: ArrayLike, unit: str, dimension: str | None = None) -> NDArray[np.float64]:
    """Convert values from SI units to `unit`, the inverse of `to_si`: parameters, shape and errors are the same.

    Examples
    --------
    >>> float(from_si(9.80665, "g"))
    1.0
    >>> from_si([0.001, 0.0254], "mm")
    array([ 1. , 25.4])
    """
    return np.asarray(values, dtype=np.float64) / find_unit(unit, dimension).factor


def _lookup(name: str) -> Unit | None:
    text = re.sub(r"\s+", "", name).removesuffix(".")  # an abbreviation, or the end of a sentence
    if text in UNITS:
        return UNITS[text]
    if text.lower() in _MICROSTRAIN:
        return UNITS["microstrain"]
    text = re.sub(r"(?<=[A-Za-z])[-*·.](?=[A-Za-z])", "", text)
    text = re.sub(f"^[{_MICRO}](?=m$)", "u", text, flags=re.IGNORECASE)
    for prefix, letter in (("milli", "m"), ("micro", "u"), (f"[{_MICRO}]", "u")):
        text = re.sub(rf"{prefix}(?=s(ec|$))", letter, text, flags=re.IGNORECASE)
    text = re.sub(r"sec(onds?|s)?(?![a-z])", "s", text, flags=re.IGNORECASE)
    text = text.replace("**", "").replace("^", "").replace("²", "2").replace("°", "deg")
    product = _BY_LOWER_CASE.get(text.replace("_", "").lower())
    text = re.sub(r"/s/s$", "/s2", text.replace("_", "/"), flags=re.IGNORECASE)
    unit = _BY_LOWER_CASE.get(text.lower())
    if product is not None and product.dimension == "moment":  # kN_m; c_m is no unit
        unit = product
    if unit is not None and unit.name.startswith("M") and not text.startswith("M"):
        return None
    return unit


def _known(dimension: str | None) -> str:
    dimensions = DIMENSIONS if dimension is None else (dimension,)
    return "; ".join(f"{each}: {', '.join(_FACTORS[each])}" for each in dimensions)
