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

# words in the names of columns that are no sensors, and whole names
_WORDS = {
    "deviation": ("std", "stdev", "sd", "cv"),
    "frequency": ("frequency", "frequencies", "freq", "eigenfrequency", "omega"),
    "period": ("period",),
    "damping": ("damping",),
    "temperature": ("temperature", "temp"),
    "set": ("set", "identification"),
    "mode": ("mode",),
    "quality": ("mac", "automac", "mpc", "mpd", "mcf", "complexity", "order", "quality", "confidence"),
}
_NAMES = {"f": "frequency", "f_hz": "frequency", "fn": "frequency", "fn_hz": "frequency", "xi": "damping", "no": "mode"}
_BY_UNIT = {"s": "period", "sec": "period", **dict.fromkeys(("°c", "degc", "c", "k"), "temperature")}  # of T


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
          ``damping``, ``frequency_std`` [Hz] or ``frequency_cv``, ``temperature`` [°C] and ``set`` (the number of the
          identification, where there are several). What describes an identification, such as ``MAC`` or ``order``, is
          left out, which the description says. All other columns of numbers are sensors. A table with a column for each
          mode is transposed.
        * A MATLAB file (``.mat``, up to version 7.2) with the `variables`, the modes in the columns of the shapes.
        * A result of pyOMA2, such as ``ssi.result`` after the choice of the modes: ``Fn``, ``Phi``, ``Xi``, ``Fn_std``,
          ``Phi_std``.
    sensors : sequence of str, optional
        Names of the sensors. In a table: the columns that are sensors, in this order. Needed for other sources.
    unit : str, optional
        Unit of the frequencies, where the file does not state it: ``"Hz"`` or ``"rad/s"``. A result of pyOMA2 is in
        hertz.
    variables : mapping of str to str, optional
        Names of the MATLAB variables: ``{"frequencies": "f", "shapes": "Phi", "damping": "xi"}``, without those that
        do not exist.
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
    if hasattr(source, "Fn") and hasattr(source, "Phi"):
        return _of_result(source, sensors, options)
    if not isinstance(source, str | Path):
        raise ValueError(f"read_modal_data: expected a path, or a result with Fn and Phi; got {type(source).__name__}")
    options = {"description": Path(source).name} | options
    if Path(source).suffix.lower() == ".mat":
        return _of_matlab(Path(source), sensors, unit, variables or {}, options)
    table = read_table(source)
    if not {"frequency", "period"} & set(map(_kind, _names_of(table))):
        table = _transposed(table)
    return _of_table(table, sensors, unit, options)


def _names_of(table: Table) -> list[str]:
    """Names of the columns."""
    return [column.name for column in table.columns]


def _kind(name: str) -> str:
    """What a column is, by its name; empty for a sensor."""
    name, unit = re.fullmatch(r"\s*(.*?)[\s._]*(?:[\[(](.*?)[\])]?)?\s*", name.lower(), re.S).groups()
    if of_t := re.fullmatch(r"tn?(?:_(\w+))?", name):
        return _BY_UNIT.get((unit or of_t[1] or "").strip(), "")
    words = set(re.split(r"[^a-z]+", name))
    return next((kind for kind, known in _WORDS.items() if words & set(known)), _NAMES.get(name, ""))


def _transposed(table: Table) -> Table:
    """A table with a column for each mode with a line for each mode; any other table as it is."""
    names = table.columns[0].cells
    if table.columns[0].kind != "text" or not {"frequency", "period"} & set(map(_kind, names)):
        return table
    digits = [re.sub(r"\D", "", column.name) for column in table.columns[1:]]
    numbers = np.array(digits if all(digits) else range(1, len(digits) + 1), dtype=float)
    rows = np.array([column.values for column in table.columns[1:]]).T
    columns = [
        Column(name, values, 0, "", "number") for name, values in zip(("mode", *names), (numbers, *rows), strict=True)
    ]
    return table._replace(columns=tuple(columns), lines=tuple(range(len(numbers))))


def _of_table(table: Table, sensors: Sequence[str], unit: str | None, options: dict[str, Any]) -> ModalData:
    names = _names_of(table)
    kinds = list(map(_kind, names))
    found = {what: kinds.index(what) if what in kinds else None for what in _WORDS}
    left_out = [name for name, kind in zip(names, kinds, strict=True) if kind == "quality" and name not in sensors]
    notes = [f"without {', '.join(left_out)}"] if left_out else []
    notes += ["frequencies from periods"] if found["frequency"] is None else []
    options["description"] = ", ".join([options["description"], *notes])
    if found["frequency"] is None and found["period"] is None:
        raise ValueError(
            f"{table.file}: expected a column of frequencies, such as frequency_Hz; the columns are {', '.join(names)}"
        )
    texts = [place for place, column in enumerate(table.columns) if column.kind == "text"]  # such as remarks
    taken = [*(place for what, place in found.items() if what != "quality"), *texts, *map(names.index, left_out)]
    others = [name for place, name in enumerate(names) if place not in taken]
    if unknown := [name for name in sensors if name not in others]:
        raise ValueError(f"{table.file}: no columns {', '.join(unknown)}; the sensors are {', '.join(others)}")
    sensors = tuple(sensors) or tuple(others)
    values = {what: None if place is None else table.columns[place].values for what, place in found.items()}
    frequencies = _frequencies(table, found, unit)
    _refuse_complex(table, sensors)
    shapes = np.array([table.columns[names.index(name)].values for name in sensors])
    shapes = shapes.reshape(len(sensors), len(frequencies)).T
    sets = np.zeros(len(frequencies)) if values["set"] is None else values["set"]
    modes = values["mode"]
    if modes is None:  # the place among the lines of its identification
        modes = np.array([(sets[: place + 1] == each).sum() for place, each in enumerate(sets)])
    numbers, order = np.unique(modes), np.unique(sets)
    shape = len(order), len(numbers)
    rows = np.searchsorted(order, sets), np.searchsorted(numbers, modes)
    if len(set(zip(*rows, strict=True))) < len(modes) or (numbers != np.round(numbers)).any():
        raise ValueError(
            f"{table.file}: expected different whole numbers in the column of modes; got {modes.tolist()}: give a "
            "column 'set' with the number of the identification if there are several"
        )
    placed = {"frequencies": np.full(shape, np.nan), "shapes": np.full((*shape, len(sensors)), np.nan)}
    placed["frequencies"][rows], placed["shapes"][rows] = frequencies, shapes
    if found["deviation"] is not None:  # the mean square of several identifications
        squares = np.full(shape, np.nan)
        squares[rows] = np.square(_coefficients(table, found["deviation"], frequencies))
        options = {"frequency_cv": np.sqrt(np.nanmean(squares, axis=0))} | options
    if values["temperature"] is not None:
        degrees = values["temperature"] - (273.15 if re.search(r"[\[( _]K\W*$", names[found["temperature"]]) else 0.0)
        by_set = [np.unique(degrees[sets == each]) for each in order]
        if any(len(each) > 1 for each in by_set):
            raise ValueError(f"{table.file}: expected one temperature for each identification (column 'set')")
        options = {"temperatures": np.concatenate(by_set)} | options
    if values["damping"] is not None:
        placed["damping"] = np.full(shape, np.nan)
        named = stated_unit(table, found["damping"], "dimensionless")
        placed["damping"][rows] = to_si(values["damping"], named or "1", "dimensionless")
    return ModalData(sensors=sensors, mode_numbers=numbers.astype(int).tolist(), **placed, **options)


def _refuse_complex(table: Table, sensors: Sequence[str]) -> None:
    """Raise ValueError for columns that are real and imaginary parts, or magnitudes and phases, of a shape."""
    words = [(re.sub(r"[^a-z]+(re|im|real|imag|mag|abs|phase)$", "", name.lower()), name) for name in sensors]
    ends = [name for stem, name in words if stem != name.lower()]
    if len(ends) > 1 and len({stem for stem, _ in words}) < len(words):
        raise ValueError(
            f"{table.file}: the columns {', '.join(ends)} are parts of complex shapes; make real ones of them, "
            "real_shapes(parts) of fe_likelihoods.modal.modal_data, and give these to ModalData"
        )


def _frequencies(table: Table, found: Mapping[str, int | None], unit: str | None) -> np.ndarray:
    """Frequencies [Hz] from a column of frequencies or periods."""
    place = found["frequency"]
    if place is None:
        stated = stated_unit(table, found["period"], "time")
        if stated is None:
            raise ValueError(f"{table.file}: the unit of the periods is not stated; name the column period_s")
        return 1.0 / to_si(table.columns[found["period"]].values, stated, "time")
    stated = stated_unit(table, place, "frequency")
    return _in_hertz(table.columns[place].values, stated, unit, f"{table.file}, column {_names_of(table)[place]!r}")


def _coefficients(table: Table, place: int, frequencies: np.ndarray) -> np.ndarray:
    """Coefficients of variation from a column ``frequency_std`` [Hz, rad/s] or ``frequency_cv``."""
    name, stated = _names_of(table)[place], stated_unit(table, place)
    if "cv" in re.split(r"[^a-z]+", name.lower()):
        return to_si(table.columns[place].values, stated or "1", "dimensionless")
    return _in_hertz(table.columns[place].values, stated, None, f"{table.file}, column {name!r}") / frequencies


def _of_matlab(
    path: Path, sensors: Sequence[str], unit: str | None, variables: Mapping[str, str], options: dict[str, Any]
) -> ModalData:
    from scipy.io import loadmat  # slow to import

    try:
        content = {name: value for name, value in loadmat(path).items() if not name.startswith("__")}
    except NotImplementedError:
        raise ValueError(f"{path}: a file of version 7.3; save it with '-v7', or read it with h5py") from None
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: cannot be read as a MATLAB file: {error}; save it again with '-v7'") from None
    missing = [name for name in variables.values() if name not in content]
    if missing or not {"frequencies"} <= set(variables) <= {"frequencies", "shapes", "damping"}:
        raise ValueError(
            f"{path}: name the variables, such as variables={{'frequencies': 'f', 'shapes': 'Phi'}}; got "
            f"{dict(variables)}, the file has {', '.join(content)}"
        )
    values = {what: np.squeeze(content[name]) for what, name in variables.items()}
    values["frequencies"] = _in_hertz(np.atleast_1d(values["frequencies"]), None, unit, str(path))
    if "shapes" in values:
        m, shapes = len(values["frequencies"]), content[variables["shapes"]]
        if m == 1:
            shapes = shapes.reshape(-1, 1)
        if shapes.ndim != 2 or shapes.shape[1] != m:
            raise ValueError(
                f"{path}: expected {m} modes in the columns of {variables['shapes']}; got the shape {shapes.shape}: "
                "transpose it"
            )
        values["shapes"] = _real(shapes.T)
    return ModalData(sensors=sensors, **values, **options)


def _of_result(result: Any, sensors: Sequence[str], options: dict[str, Any]) -> ModalData:
    """Modes of a result with the attributes of pyOMA2, whose shapes have the modes in columns."""
    if result.Fn is None or result.Phi is None:
        raise ValueError("read_modal_data: the result has no modes yet; choose them first, with mpe or mpe_from_plot")
    frequencies = np.atleast_1d(np.asarray(result.Fn, dtype=float))
    if (deviations := getattr(result, "Fn_std", None)) is not None:
        options = {"frequency_cv": np.ravel(deviations) / frequencies} | options
    if (damping := getattr(result, "Xi", None)) is not None:
        options = {"damping": np.ravel(damping)} | options
    shapes = np.asarray(result.Phi).T
    if (deviations := getattr(result, "Phi_std", None)) is not None:
        squares = np.square(np.abs(np.asarray(deviations).T)).mean(axis=1)
        options = {"shape_error": np.sqrt(squares) / np.linalg.norm(shapes, axis=1)} | options
    return ModalData(frequencies, _real(shapes), sensors, **options)


def _in_hertz(values: np.ndarray, stated: str | None, given: str | None, where: str) -> np.ndarray:
    """Frequencies [Hz]; ValueError if the unit is not known, or is stated and given differently."""
    if stated is None and given is None:
        raise ValueError(f"{where}: the unit of the frequencies is not stated; give unit='Hz' or unit='rad/s'")
    if stated is not None and given is not None and stated != given:
        raise ValueError(f"{where}: the file states {stated}, and unit={given!r} is given: leave unit out")
    return to_si(values, stated or given, "frequency")


def _real(shapes: np.ndarray) -> np.ndarray:
    """Real shapes: those of complex ones, after a rotation by the mean phase."""
    if not np.iscomplexobj(shapes):
        return shapes
    real, scatter = real_shapes(shapes)
    warn(check_phases(scatter), stacklevel=4)
    return real
