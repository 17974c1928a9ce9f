"""Modal data from files and from programs of operational modal analysis."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..checks.finding import warn
from ..checks.screening import check_phases
from ..signals.tables import Column, Table, read_table, stated_unit
from ..units import to_si
from .modal_data import ModalData, real_shapes

__all__ = ["read_modal_data"]

# what a column is that is no sensor: patterns of the words of its name; whole names; T by its unit
_WORDS = {
    "part": r"im|imag\w*|phase|angle",  # of a complex shape
    "quality": r"\w*mac|mp[cd]|mcf|complexity|order|quality|confidence|participation|effective",
    "deviation": r"std\w*|sd|cv|sigma|uncertainty|deviation",
    "period": r"period\w*",
    "frequency": r"(eigen)?fr[eé][cq]\w*|omega|ω",
    "damping": r"damp\w*|dämpf\w*|amort\w*|zeta|ksi|ζ|ξ",
    "temperature": r"temp|temperature",
    "set": r"set|identification|date",
    "mode": r"mode",
}
_NAMES = {"f": "frequency", "fn": "frequency", "xi": "damping", "no": "mode"}
_BY_UNIT = {"s": "period", "sec": "period", **dict.fromkeys(("°c", "degc", "c", "k"), "temperature")}
_OF_MODE = r"(?:fn?|freq|frequency)[ _]?(\d+)(?:_hz)?\s*(?:[\[(].*)?"  # a column for each mode
_COMPLEX = "make real ones, real_shapes(shapes) of fe_likelihoods.modal.modal_data, and give them to ModalData"


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
          its unit, such as ``frequency_Hz``, or ``period_s`` (or ``T [s]``); optional columns ``mode`` (its number),
          ``damping``, ``frequency_std`` [Hz] or ``frequency_cv``, ``temperature`` [°C] and ``set`` or ``date`` (the
          identification, where there are several). What describes an identification, such as ``MAC`` or ``order``, is
          left out, which the description says. All other columns of numbers are sensors.
        * The same with a column for each mode.
        * Frequencies alone with a line for each identification: ``f1_Hz``, ``f2_Hz``, ... and ``temperature``.
        * A MATLAB file (``.mat``, up to version 7.2) with the `variables`, the modes in the columns of the shapes.
        * An algorithm of pyOMA2 or its result, after the choice of the modes: ``Fn``, ``Phi``, ``Xi``, ``Fn_std``.
          ``Phi_std`` is not used: in pyOMA2 1.4.3 it is 6 to 100 times the scatter of shapes (four masses, 20 records).
    sensors : sequence of str, optional
        Names of the sensors. In a table: the columns that are sensors, in this order. Needed for other sources.
    unit : str, optional
        Unit of the frequencies, where the file does not state it: ``"Hz"`` or ``"rad/s"``. A result of pyOMA2 is in
        hertz.
    variables : mapping of str to str, optional
        Names of the MATLAB variables: ``{"frequencies": "f", "shapes": "Phi", "damping": "xi"}``, without those that
        do not exist; ``"modal.f"`` is the field of a structure.
    **options
        Of `ModalData`, such as ``frequency_cv``.

    Returns
    -------
    ModalData
        Complex shapes are made real (`real_shapes`).

    Raises
    ------
    ValueError
        If the unit is not known, columns or variables are missing, or as `ModalData`.

    Warns
    -----
    UserWarning
        If the phases of a complex shape scatter (`fe_likelihoods.checks.screening.check_phases`).

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
    try:
        table = read_table(source)
    except ValueError as error:
        is_complex = re.search(r"\d[ij]'$", str(error))
        raise ValueError(f"{error}, a complex shape: {_COMPLEX}" if is_complex else str(error)) from None
    head = table.columns[0]
    if not {"frequency", "period"} & {_kind(column.name) for column in table.columns}:
        if head.kind == "text" and {"frequency", "period"} & set(map(_kind, head.cells)):
            table = _transposed(table)
        elif any(re.fullmatch(_OF_MODE, column.name.lower()) for column in table.columns):
            return _of_days(table, unit, options)
    return _of_modes(table, sensors, unit, options)


def _kind(name: str) -> str:
    """What a column is, by its name; empty for a sensor."""
    name, unit = re.fullmatch(r"\s*(.*?)[\s._]*(?:[\[(](.*?)[\])]?)?\s*", name.lower(), re.S).groups()
    if of_t := re.fullmatch(r"tn?(?:_(\w+))?", name):
        return _BY_UNIT.get((unit or of_t[1] or "").strip(), "")
    words = re.split(r"[\W\d_]+", name)
    kinds = [kind for kind, known in _WORDS.items() if any(re.fullmatch(known, word) for word in words)]
    if {"deviation", "damping"} <= set(kinds):
        return "quality"
    return kinds[0] if kinds else _NAMES.get(name.removesuffix("_hz"), "")


def _transposed(table: Table) -> Table:
    """A table with a column for each mode with a line for each mode."""
    head, *modes = table.columns
    values = np.array([column.values for column in modes]).T
    names = Column("mode", np.full(len(modes), np.nan), 0, "", "text", tuple(column.name for column in modes))
    rows = [Column(name, row, 0, "", "number") for name, row in zip(head.cells, values, strict=True)]
    return table._replace(columns=(names, *rows), lines=tuple(range(len(modes))))


def _of_days(table: Table, unit: str | None, options: dict[str, Any]) -> ModalData:
    """Frequencies of a table with a line for each identification, and a column for each mode."""
    numbers = [re.fullmatch(_OF_MODE, column.name.lower()) for column in table.columns]
    frequencies = [_in_hertz(table, place, unit) for place, number in enumerate(numbers) if number]
    warm = [column for column in table.columns if _kind(column.name) == "temperature"]
    found = {"temperatures": _degrees(warm[0])} if warm else {}
    found["mode_numbers"] = [int(number[1]) for number in numbers if number]
    return ModalData(np.stack(frequencies, axis=1), **found | options)


def _of_modes(table: Table, sensors: Sequence[str], unit: str | None, options: dict[str, Any]) -> ModalData:
    """Modes of a table with a line for each mode."""
    names = [column.name for column in table.columns]
    kinds = ["" if name in sensors else _kind(name) for name in names]
    at = {kind: [place for place, each in enumerate(kinds) if each == kind] for kind in _WORDS}
    if at["part"]:
        parts = ", ".join(names[place] for place in at["part"])
        raise ValueError(f"{table.file}: the columns {parts} are parts of complex shapes: {_COMPLEX}")
    for kind, places in at.items():
        if len(places) > 1 and kind != "quality":
            several = ", ".join(names[place] for place in places)
            raise ValueError(f"{table.file}: expected one column of the {kind}; got {several}: rename the others")
    notes = [f"without {', '.join(names[place] for place in at['quality'])}"] if at["quality"] else []
    if at["frequency"]:
        frequencies = _in_hertz(table, at["frequency"][0], unit)
    elif at["period"]:
        notes, frequencies = [*notes, "frequencies from periods"], _of_periods(table, at["period"][0])
    else:
        raise ValueError(
            f"{table.file}: expected a column of frequencies, such as frequency_Hz; the columns are {', '.join(names)}"
        )
    others = [place for place, kind in enumerate(kinds) if not kind and table.columns[place].kind == "number"]
    shapes = _sensor_columns(table, others, sensors)  # texts are remarks
    columns = {kind: table.columns[places[0]] for kind, places in at.items() if places}
    n_sets, of_set, numbers, of_mode = _places(columns, len(frequencies), table.file)

    def placed(values: np.ndarray) -> np.ndarray:
        """Values (n_lines, ...) by set and mode."""
        found = np.full((n_sets, len(numbers), *values.shape[1:]), np.nan)
        found[of_set, of_mode] = values
        return found

    found = {"description": ", ".join([options["description"], *notes])}
    if at["deviation"]:  # the mean square of several identifications
        squares = placed(np.square(_coefficients(table, at["deviation"][0], frequencies)))
        found["frequency_cv"] = np.sqrt(np.nanmean(squares, axis=0))
    if at["temperature"]:
        degrees = placed(_degrees(columns["temperature"]))
        if (np.nanmin(degrees, axis=1) != np.nanmax(degrees, axis=1)).any():
            raise ValueError(f"{table.file}: expected one temperature for each identification (column 'set')")
        found["temperatures"] = np.nanmean(degrees, axis=1)
    if at["damping"]:
        named = stated_unit(table, at["damping"][0], "dimensionless")
        found["damping"] = placed(to_si(columns["damping"].values, named or "1", "dimensionless"))
    values = np.reshape([column.values for column in shapes], (len(shapes), len(frequencies))).T
    found |= {"sensors": [column.name for column in shapes], "mode_numbers": numbers.astype(int).tolist()}
    return ModalData(placed(frequencies), placed(values), **found | options | {"description": found["description"]})


def _sensor_columns(table: Table, others: Sequence[int], sensors: Sequence[str]) -> list[Column]:
    """The columns of the sensors among those at the places `others`: all of them, or those with the given names."""
    columns = {table.columns[place].name: table.columns[place] for place in others}
    if unknown := [name for name in sensors if name not in columns]:
        raise ValueError(f"{table.file}: no columns {', '.join(unknown)}; the sensors are {', '.join(columns)}")
    if sensors:
        return [columns[name] for name in sensors]
    if len({stated_unit(table, place, "dimensionless") for place in others}) > 1:
        raise ValueError(
            f"{table.file}: the columns {', '.join(columns)} have different units, and a shape has one: give those "
            "that are sensors, sensors=[...] (columns in a TOML file)"
        )
    return [table.columns[place] for place in others]


def _places(columns: Mapping[str, Column], n: int, file: str) -> tuple[int, np.ndarray, np.ndarray, np.ndarray]:
    """Number of identifications, place of each of n lines among them, numbers of the modes, place among these."""
    day, mode = columns.get("set"), columns.get("mode")
    days = np.zeros(n) if day is None else np.array(day.cells) if day.kind == "text" else day.values
    order, of_set = np.unique(days, return_inverse=True)
    modes = np.array([(of_set[: k + 1] == each).sum() for k, each in enumerate(of_set)])  # in the order of the lines
    if mode is not None and mode.kind != "text":
        modes = mode.values
    elif mode is not None:
        digits = [re.sub(r"\D", "", cell) for cell in mode.cells]  # of names such as mode 3
        different = all(digits) and len(set(zip(of_set, digits, strict=True))) == n
        modes = np.array(digits, dtype=float) if different else modes
    numbers, of_mode = np.unique(modes, return_inverse=True)
    if len(set(zip(of_set, of_mode, strict=True))) < n or (numbers != np.round(numbers)).any():
        raise ValueError(
            f"{file}: expected a line for each mode, with different whole numbers in the column of modes; got "
            f"{modes.tolist()}: give a column 'set' with the number of the identification if there are several, and a "
            "column for each sensor"
        )
    return len(order), of_set, numbers, of_mode


def _degrees(column: Column) -> np.ndarray:
    """Temperatures [°C] of a column in degrees Celsius or Fahrenheit, or in kelvin."""
    found = re.search(r"[\[( _°](K|F)\W*$", f"{column.name} {column.below}".strip())
    if found:
        return column.values - 273.15 if found[1] == "K" else (column.values - 32.0) / 1.8
    return column.values


def _in_hertz(table: Table, place: int, given: str | None) -> np.ndarray:
    """Frequencies [Hz] in a column; ValueError if the unit is not known, or is stated and given differently."""
    column, stated = table.columns[place], stated_unit(table, place, "frequency")
    if stated is not None and given is not None and stated != given:
        raise ValueError(f"{table.file}: the file states {stated}, and unit={given!r} is given: leave unit out")
    return _to_hertz(column.values, stated or given, f"{table.file}, column {column.name!r}")


def _to_hertz(values: np.ndarray, unit: str | None, where: str) -> np.ndarray:
    if unit is None:
        raise ValueError(f"{where}: the unit of the frequencies is not stated; give unit='Hz' or unit='rad/s'")
    return to_si(values, unit, "frequency")


def _of_periods(table: Table, place: int) -> np.ndarray:
    """Frequencies [Hz] from a column of periods."""
    stated = stated_unit(table, place, "time")
    if stated is None:
        raise ValueError(f"{table.file}: the unit of the periods is not stated; name the column period_s")
    return 1.0 / to_si(table.columns[place].values, stated, "time")


def _coefficients(table: Table, place: int, frequencies: np.ndarray) -> np.ndarray:
    """Coefficients of variation from a column ``frequency_std`` [Hz, rad/s] or ``frequency_cv``."""
    column = table.columns[place]
    if "cv" not in re.split(r"[^a-z]+", column.name.lower()):
        return _in_hertz(table, place, None) / frequencies
    return to_si(column.values, stated_unit(table, place) or "1", "dimensionless")


def _of_matlab(
    path: Path, sensors: Sequence[str], unit: str | None, variables: Mapping[str, str], options: dict[str, Any]
) -> ModalData:
    """Modes of a MATLAB file."""
    from scipy.io import loadmat  # slow to import

    try:
        found = {name: each for name, each in loadmat(path, simplify_cells=True).items() if not name.startswith("__")}
    except (NotImplementedError, OSError, ValueError) as error:
        raise ValueError(
            f"{path}: cannot be read as a MATLAB file up to version 7.2: {error}; save it again with '-v7'"
        ) from None
    fields = {f"{name}.{key}": each[key] for name, each in found.items() if isinstance(each, dict) for key in each}
    content = {name: each for name, each in found.items() if not isinstance(each, dict)} | fields
    missing = [name for name in variables.values() if name not in content]
    if missing or not {"frequencies"} <= set(variables) <= {"frequencies", "shapes", "damping"}:
        raise ValueError(
            f"{path}: name the variables, such as variables={{'frequencies': 'f', 'shapes': 'Phi'}}; got "
            f"{dict(variables)}, the file has {', '.join(content)}"
        )
    values = {what: np.atleast_1d(np.squeeze(content[name])) for what, name in variables.items()}
    values["frequencies"] = _to_hertz(values["frequencies"], unit, str(path))
    if "shapes" in values:
        values["shapes"] = _real(np.reshape(values["shapes"], (len(values["shapes"]), -1)).T)  # modes in columns
    return ModalData(sensors=sensors, **values, **options)


def _of_result(result: Any, sensors: Sequence[str], options: dict[str, Any]) -> ModalData:
    """Modes of a result with the attributes of pyOMA2, whose shapes have the modes in columns."""
    if result.Fn is None or result.Phi is None or not np.size(result.Fn):
        raise ValueError("read_modal_data: the result has no modes; choose them first, with mpe or mpe_from_plot")
    frequencies = np.atleast_1d(np.asarray(result.Fn, dtype=float))
    if (deviations := getattr(result, "Fn_std", None)) is not None:
        options = {"frequency_cv": np.ravel(deviations) / frequencies} | options
    if (damping := getattr(result, "Xi", None)) is not None:
        options = {"damping": np.ravel(damping)} | options
    return ModalData(frequencies, _real(np.asarray(result.Phi).T), sensors, **options)


def _real(shapes: np.ndarray) -> np.ndarray:
    """Real shapes: those of complex ones, after a rotation by the mean phase."""
    if not np.iscomplexobj(shapes):
        return shapes
    real, scatter = real_shapes(shapes)
    warn(check_phases(scatter), stacklevel=4)
    return real
