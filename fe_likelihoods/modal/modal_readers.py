"""Modal data from files and from programs of operational modal analysis."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.finding import warn
from ..checks.screening import check_phases
from ..signals.tables import Column, Table, agree_on_unit, read_table
from ..units import to_si
from .modal_data import ModalData, real_shapes

__all__ = ["read_matlab", "read_modal_data"]

# what a column is, by its name in lower case without a unit; all others of numbers are sensors
_KINDS = {
    "frequency": r"f|fn|freq\.?|(natural[ _]|eigen)?(frequency|frequenz|fr[eé]quence|fre[ck]uencia|frequenza)|omega",
    "deviation": r"(f|fn|freq|frequency)[ _]std",
    "damping": r"damping|d[äa]e?mpfung|zeta|xi",
    "temperature": r"temp\.?|temp[eé]ratur[ea]?|t[ _]?[\[(]?(°c|degc|c)[\])]?",  # a T alone may be a sensor
    "set": r"set|identification|date|datum",
    "mode": r"mode([ _]no\.?)?",
}
_NO_SENSOR = re.compile(r"\b(re|im|real|imag|mag|phase|angle|mac|mpc|order|std|sd|cv|period|factor)\b", re.IGNORECASE)
_OF_MODE = re.compile(r"(?:fn?|freq|frequency)[ _]?(\d+)(?:_hz)?\s*(?:[\[(].*)?", re.IGNORECASE)  # a column for each


def read_modal_data(
    source: str | Path | Any,
    sensors: Sequence[str] = (),
    *,
    unit: str | None = None,
    variables: Mapping[str, str] | None = None,
    **options: Any,
) -> ModalData:
    """Read natural frequencies and mode shapes.

    Parameters
    ----------
    source : path, or result of an identification
        * A CSV file, a text file or a workbook with a header line and a line for each mode: a column ``frequency`` with
          its unit, such as ``frequency_Hz``; optional columns ``mode`` (its number), ``damping``, ``frequency_std``,
          ``temperature`` [°C] and ``set`` or ``date`` (the identification, where there are several). All other columns
          of numbers are sensors.
        * Frequencies alone with a line for each identification: ``f1_Hz``, ``f2_Hz``, ... and ``temperature``.
        * A MATLAB file (``.mat``, up to version 7.2) with the `variables`, the modes in the columns of the shapes.
        * An algorithm of pyOMA2 or its result, after the choice of the modes: ``Fn``, ``Phi``, ``Xi``, ``Fn_std``.
          ``Phi_std`` is not used: in pyOMA2 1.4.3 it is 6 to 100 times the scatter of shapes (four masses, 20 records).
    sensors : sequence of str, optional
        Names of the sensors. In a table: the columns that are sensors, in this order. Needed for other sources.
    unit : str, optional
        Unit of the frequencies, ``"Hz"`` or ``"rad/s"``, where the file does not state it.
    variables : mapping of str to str, optional
        Names of the MATLAB variables that exist: ``{"frequencies": "f", "shapes": "Phi", "damping": "xi"}``.
    **options
        Of `ModalData`, such as ``frequency_cv``.

    Returns
    -------
    ModalData
        Complex shapes are made real (`real_shapes`), with a warning if their phases scatter.

    Raises
    ------
    ValueError
        If the unit is not known, columns or variables are missing, a column may be no sensor, or as `ModalData`.

    Examples
    --------
    >>> table = [[2.9, 0.62, 1.0], [7.8, -1.0, 0.62]]
    >>> np.savetxt("modes.csv", table, delimiter=",", header="frequency_Hz,floor 1,roof", comments="")
    >>> identified = read_modal_data("modes.csv", frequency_cv=0.005, shape_error=0.02)
    >>> identified.sensors
    ('floor 1', 'roof')
    """
    source = getattr(source, "result", source)
    if hasattr(source, "Fn") and hasattr(source, "Phi"):
        return _of_result(source, sensors, options)
    if not isinstance(source, str | Path):
        raise ValueError(f"read_modal_data: expected a path, or a result with Fn and Phi; got {type(source).__name__}")
    options = {"description": Path(source).name} | options
    if Path(source).suffix.lower() == ".mat":
        return _of_matlab(Path(source), sensors, unit, variables or {}, options)
    table = read_table(source)
    of_modes = {place: found for place, each in enumerate(table.columns) if (found := _OF_MODE.fullmatch(each.name))}
    if not of_modes:
        return _of_modes(table, sensors, unit, options)
    kinds, found = [_kind(column.name) for column in table.columns], {}
    if "temperature" in kinds:
        found["temperatures"] = _si(table, kinds.index("temperature"), "temperature", "degC")
    frequencies = np.stack([_in_hertz(table, place, unit) for place in of_modes], axis=1)
    return ModalData(frequencies, mode_numbers=[int(each[1]) for each in of_modes.values()], **found | options)


def _kind(name: str) -> str:
    """What a column is, by its name with or without a unit; empty for a sensor."""
    name = name.strip().lower()
    plain = re.sub(r"[\s_]*([\[(].*[\])]|_(hz|rad/s|%|c|°c|degc))$", "", name)
    return next((kind for kind, known in _KINDS.items() if any(re.fullmatch(known, x) for x in (name, plain))), "")


def _of_modes(table: Table, sensors: Sequence[str], unit: str | None, options: dict[str, Any]) -> ModalData:
    """Modes of a table with a line for each mode."""
    import pandas as pd  # slow to import

    kinds = ["" if column.name in sensors else _kind(column.name) for column in table.columns]
    at = {kind: kinds.index(kind) for kind in _KINDS if kind in kinds}
    if "frequency" not in at or max(kinds.count(kind) for kind in at) > 1:
        raise ValueError(
            f"{table.file}: expected one column of frequencies, such as frequency_Hz, and at most one of "
            f"{', '.join(_KINDS)}; the columns are {', '.join(column.name for column in table.columns)}"
        )
    columns = _sensor_columns(table, [k for k, kind in enumerate(kinds) if not kind], sensors)
    lines = pd.DataFrame({k: column.values for k, column in enumerate(columns)})
    lines["frequency"] = _in_hertz(table, at["frequency"], unit)
    if "deviation" in at:
        lines["cv"] = _in_hertz(table, at["deviation"], unit) / lines["frequency"]
    if "temperature" in at:
        lines["temperature"] = _si(table, at["temperature"], "temperature", "degC")
    if "damping" in at:
        lines["damping"] = _si(table, at["damping"], "dimensionless", "1")
    day = table.columns[at["set"]] if "set" in at else None
    lines["set"] = 0 if day is None else day.cells if day.kind == "text" else day.values
    lines["mode"] = table.columns[at["mode"]].values if "mode" in at else lines.groupby("set").cumcount() + 1
    if lines.duplicated(["set", "mode"]).any() or (lines["mode"] % 1 != 0).any():
        raise ValueError(
            f"{table.file}: expected a line for each mode, with different whole numbers in the column of modes; got "
            f"{lines['mode'].tolist()}: give a column 'set' with the number of the identification if there are several"
        )
    wide = lines.pivot(index="set", columns="mode")
    shapes = np.stack([wide[k] for k in range(len(columns))], axis=-1) if columns else None
    found = {"shapes": shapes, "sensors": [each.name for each in columns], "mode_numbers": wide["frequency"].columns}
    if "damping" in lines:
        found["damping"] = wide["damping"]
    if "cv" in lines:  # the mean square of several identifications
        found["frequency_cv"] = np.sqrt(np.square(wide["cv"]).mean())
    if "temperature" in lines:
        found["temperatures"] = wide["temperature"].mean(axis=1)
        if (wide["temperature"].nunique(axis=1) != 1).any():
            raise ValueError(f"{table.file}: expected one temperature for each identification (column 'set')")
    return ModalData(wide["frequency"], **found | options)


def _sensor_columns(table: Table, others: Sequence[int], sensors: Sequence[str]) -> list[Column]:
    """The columns of the sensors among those at the places `others`: all of them, or those with the given names."""
    columns = {table.columns[k].name: table.columns[k] for k in others if table.columns[k].kind == "number"}
    if unknown := [name for name in sensors if name not in columns]:
        raise ValueError(f"{table.file}: no columns {', '.join(unknown)}; the sensors are {', '.join(columns)}")
    units = {table.stated_unit(k, "dimensionless") for k in others if table.columns[k].name in columns}
    doubtful = [name for name in columns if _NO_SENSOR.search(name.replace("_", " "))]
    if not sensors and (doubtful or len(units) > 1):
        raise ValueError(
            f"{table.file}: some of the columns {', '.join(columns)} may be no components of real shapes (other units, "
            "a name as of a phase or a quality): give those that are sensors, sensors=[...] (columns in a TOML file)"
        )
    return [columns[name] for name in sensors or columns]


def _si(table: Table, place: int, dimension: str, default: str) -> np.ndarray:
    """Values of a column in the SI unit, or °C."""
    return to_si(table.columns[place].values, table.stated_unit(place, dimension) or default, dimension)


def _in_hertz(table: Table, place: int, given: str | None) -> np.ndarray:
    """Frequencies [Hz] in a column; ValueError if the unit is not known, or is stated and given differently."""
    unit = agree_on_unit(table.stated_unit(place, "frequency"), given, "frequency", table.file, "unit")
    return _si(table, place, "frequency", unit)


def read_matlab(path: str | Path) -> dict[str, Any]:
    """The variables of a MATLAB file by name; ValueError if it cannot be read."""
    from scipy.io import loadmat  # slow to import

    try:
        return {name: each for name, each in loadmat(path).items() if not name.startswith("__")}
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path} is no MATLAB file up to version 7.2 ({error}): save it again with '-v7'") from None


def _of_matlab(
    path: Path, sensors: Sequence[str], unit: str | None, variables: Mapping[str, str], options: dict[str, Any]
) -> ModalData:
    """Modes of a MATLAB file."""
    content = read_matlab(path)
    wanted = {"frequencies"} <= set(variables) <= {"frequencies", "shapes", "damping"}
    if not wanted or not set(variables.values()) <= set(content):
        raise ValueError(
            f"{path}: name the variables, such as variables={{'frequencies': 'f', 'shapes': 'Phi'}}; got "
            f"{dict(variables)}, the file has {', '.join(content)}"
        )
    values = {what: content[name] for what, name in variables.items()}
    unit = agree_on_unit(None, unit, "frequency", path, "unit")
    return _of_columns(to_si(values.pop("frequencies"), unit, "frequency"), sensors, values, options)


def _of_result(result: Any, sensors: Sequence[str], options: dict[str, Any]) -> ModalData:
    """Modes of a result with the attributes of pyOMA2."""
    if result.Fn is None or result.Phi is None or not np.size(result.Fn):
        raise ValueError("read_modal_data: the result has no modes; choose them first, with mpe or mpe_from_plot")
    found = {"shapes": result.Phi, "damping": getattr(result, "Xi", None), "cv": getattr(result, "Fn_std", None)}
    return _of_columns(result.Fn, sensors, {what: x for what, x in found.items() if x is not None}, options)


def _of_columns(frequencies: Any, sensors: Sequence[str], values: dict[str, Any], options: dict[str, Any]) -> ModalData:
    """Modes of arrays, which are the columns of the shapes; complex ones after a rotation by the mean phase."""
    frequencies, found = np.ravel(np.asarray(frequencies, dtype=float)), {}
    if "shapes" in values:
        found["shapes"] = np.asarray(values["shapes"]).T
        if np.iscomplexobj(found["shapes"]):
            found["shapes"], scatter = real_shapes(found["shapes"])
            warn(check_phases(scatter), stacklevel=4)
    if "damping" in values:
        found["damping"] = np.ravel(values["damping"])
    if "cv" in values:
        found["frequency_cv"] = np.ravel(values["cv"]) / frequencies
    return ModalData(frequencies, sensors=sensors, **found | options)
