"""Modal data of other people's identification: tables, MATLAB files, and results of programs such as pyOMA2."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..modal.modal_data import ModalData, real_shapes
from ..modal.mode_columns import KINDS, OF_MODE, in_hertz, kind_of, sensor_places, si_values
from ..signals.sampling import expect
from ..signals.tables import read_table
from ..signals.text_files import agree_on_unit
from ..units import to_si


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
          its unit, such as ``frequency_Hz``; optional columns ``mode`` (its number), ``damping_%``, ``frequency_std``,
          ``temperature`` [°C], and ``set``, or ``date`` and ``time`` (the identification, where there are several). All
          other columns of numbers are sensors. German names are read too; French, Italian, Spanish ones of frequency.
        * Frequencies alone with a line for each identification: ``f1_Hz``, ``f2_Hz``, ..., ``temperature``, and ``set``
          or ``date`` and ``time``; no other columns.
        * A MATLAB file (``.mat``, up to version 7.2) with the `variables`, the modes in the columns of the shapes.
        * An algorithm of pyOMA2 or its result, after the choice of the modes: ``Fn``, ``Phi``, ``Xi``, ``Fn_std``.
          ``Phi_std`` is not used: in pyOMA2 1.4.3 it is 6 to 100 times the scatter of shapes (four masses, 20 records).
    sensors : sequence of str, optional
        Names of the sensors. In a table: the columns that are sensors, in this order. Needed for other sources.
    unit : str, optional
        Unit of the frequencies, ``"Hz"`` or ``"rad/s"``, where the file does not state it.
    variables : mapping of str to str, optional
        Names of the MATLAB variables that exist: ``{"frequencies": "f", "shapes": "Phi"}``.
    **options
        Of `ModalData`, such as ``frequency_cv``.

    Returns
    -------
    ModalData
        Complex shapes are made real (`real_shapes`, which also returns the scatter of their phases).

    Raises
    ------
    ValueError
        If the unit is not known, columns or variables are missing, a column or a number may be something else, lines
        have no label of their identification, or as `ModalData`.

    Examples
    --------
    >>> table = [[2.9, 0.62, 1.0], [7.8, -1.0, 0.62]]
    >>> np.savetxt("modes.csv", table, delimiter=",", header="frequency_Hz,floor 1,roof", comments="")
    >>> identified = read_modal_data("modes.csv", frequency_cv=0.005, shape_error=0.02)
    >>> identified.sensors
    ('floor 1', 'roof')
    """
    source = getattr(source, "result", source)
    if hasattr(source, "Fn") and hasattr(source, "Phi"):  # the attributes of pyOMA2
        if source.Fn is None or source.Phi is None or not np.size(source.Fn):
            raise ValueError("read_modal_data: the result has no modes; choose them first, with mpe or mpe_from_plot")
        agree_on_unit("Hz", unit, "frequency", "read_modal_data: a result with Fn and Phi", "unit")
        found = {"shapes": source.Phi, "damping": getattr(source, "Xi", None), "cv": getattr(source, "Fn_std", None)}
        return _of_arrays(source.Fn, sensors, {what: x for what, x in found.items() if x is not None}, options)
    if not isinstance(source, str | Path):
        raise ValueError(f"read_modal_data: expected a path, or a result with Fn and Phi; got {type(source).__name__}")
    options = {"description": Path(source).name} | options
    if Path(source).suffix.lower() != ".mat":
        try:
            return _of_table(source, sensors, unit, options)
        except ValueError as error:
            if not re.search(r"expected a number.*\d *[ij]'", str(error)):
                raise
            raise ValueError(f"{error}: give ModalData the real_shapes of complex numbers") from None
    content, names = read_matlab(source), dict(variables or {})
    wanted = {"frequencies"} <= set(names) <= {"frequencies", "shapes"}
    if not wanted or not set(names.values()) <= set(content):
        raise ValueError(
            f"{source}: name the variables, variables={{'frequencies': 'f', 'shapes': 'Phi'}}, and give damping=, as "
            f"ratios, since such a file states no unit; got {names}, the file has {', '.join(content)}"
        )
    values = {what: np.asarray(content[name]) for what, name in names.items()}
    for what, each in values.items():
        if each.dtype.kind not in ("fiuc" if what == "shapes" else "fiu"):
            kind = {"c": "complex numbers", "U": "text", "V": "a struct"}.get(each.dtype.kind, "no matrix of numbers")
            got = f"the variable {names[what]!r} is {kind}: name another one, or save real numbers"
            raise ValueError(f"{source}: expected {what} as an array of numbers; {got}")
    unit = agree_on_unit(None, unit, "frequency", source, "unit")
    return _of_arrays(to_si(values.pop("frequencies"), unit, "frequency"), sensors, values, options)


def _of_table(path: str | Path, sensors: Sequence[str], unit: str | None, options: dict[str, Any]) -> ModalData:
    """Modes of a table."""
    import pandas as pd  # slow to import

    table, found = read_table(path)._replace(time=None), dict[str, Any]()
    file, names = table.file, [column.name for column in table.columns]
    kinds = ["" if column.name in sensors else kind_of(column) for column in table.columns]
    at = {kind: kinds.index(kind) for kind in KINDS if kind in kinds}
    of_modes = {k: match for k, name in enumerate(names) if (match := OF_MODE.fullmatch(name))}
    once = len(set(names)) == len(names) and max(map(kinds.count, at.keys() - {"time"}), default=0) < 2
    expected = f"one column of frequencies, such as frequency_Hz, at most one of {', '.join(KINDS)}, different names"
    expect(once and ("frequency" in at or of_modes), file, expected, f"the columns {', '.join(names)}", "rename some")
    days = [table.columns[k] for k, kind in enumerate(kinds) if kind == ("set" if "set" in at else "time")]
    for name, cell in ((each.name, cell) for each in days for cell in each.cells):
        advice = "write it in each line, also where cells were merged, and no line of means"
        label = re.search("." if "set" in at else r"\d", cell)
        expect(label, file, f"a label of the set, a date or a time in each line of {name!r}", repr(cell), advice)
    others = [k for k, kind in enumerate(kinds) if not kind and (k or names[0])]  # 0: names of the rows
    if "temperature" in at:
        found["temperatures"] = si_values(table, at["temperature"], "temperature", "degC")
    if "frequency" not in at:  # a line for each identification
        expected = "beside f1_Hz, f2_Hz, ... only set, date, time, and the temperature_C of the structure"
        wrong = [names[k] for k in others if k not in of_modes] + sorted(at.keys() & {"mode", "damping", "deviation"})
        advice = "rename or delete these columns, or write a line for each mode with one column frequency_Hz"
        expect(not wrong, file, expected, ", ".join(wrong), advice)
        frequencies = np.stack([in_hertz(table, place, unit) for place in of_modes], axis=1)
        return ModalData(frequencies, mode_numbers=[int(each[1]) for each in of_modes.values()], **found | options)
    texts = [each.name for each, kind in zip(table.columns, kinds, strict=True) if not kind and each.kind == "text"]
    clear = not texts or "mode" in at or len(table.lines) == 1
    expect(
        clear, file, "a column 'mode' beside text", texts, "write it, and 'set' if there are several identifications"
    )
    places = sensor_places(table, others, sensors)
    lines = pd.DataFrame({k: table.measured(place) for k, place in enumerate(places)})
    lines["frequency"] = in_hertz(table, at["frequency"], unit)
    if "deviation" in at:  # the mean square of several identifications
        usual = table.stated_unit(at["frequency"], "frequency") or unit
        lines["square"] = np.square(si_values(table, at["deviation"], "frequency", usual) / lines["frequency"])
    if "damping" in at:
        lines["damping"] = si_values(table, at["damping"], "dimensionless", "1")
        advice = "state it, such as damping_% or damping [1]: 0.5 may be a ratio or percent"
        expect(table.stated_unit(at["damping"]), file, "a unit of damping", repr(names[at["damping"]]), advice)
    cells = [each.values if each.kind == "number" else each.cells for each in days]
    lines["set"] = pd.factorize(np.array([*map(repr, zip(*cells, strict=True))]))[0] if days else 0
    counted = 1.0 + np.arange(len(lines)) if lines["set"].nunique() == 1 else np.nan  # which mode was missed?
    lines["mode"] = table.columns[at["mode"]].values if "mode" in at else counted
    whole = not lines.duplicated(["set", "mode"]).any() and (lines["mode"] % 1 == 0).all()
    expected = "a line for each mode, with different whole numbers in the column of modes"
    advice = "several identifications need a column 'set' with their numbers, and a column 'mode', because one of them "
    expect(whole, file, expected, lines["mode"].tolist(), f"{advice}may miss a mode")
    wide = lines.pivot(index="set", columns="mode")
    found |= {"sensors": [names[k] for k in places], "mode_numbers": wide["frequency"].columns.astype(int).tolist()}
    found["shapes"] = np.stack([wide[k] for k in range(len(places))], axis=-1) if places else None
    found["damping"] = wide["damping"].to_numpy() if "damping" in at else None
    if "deviation" in at:
        found["frequency_cv"] = np.sqrt(wide["square"].mean()).tolist()
    if "temperature" in at:
        of_sets = pd.Series(found["temperatures"]).groupby(lines["set"])
        expect((of_sets.nunique() == 1).all(), file, "one temperature for each identification (column 'set')")
        found["temperatures"] = of_sets.mean().tolist()
    return ModalData(wide["frequency"].to_numpy(), **found | options)


def read_matlab(path: str | Path) -> dict[str, Any]:
    """The variables of a MATLAB file by name; ValueError if it cannot be read."""
    from scipy.io import loadmat  # slow to import

    try:
        return {name: each for name, each in loadmat(path).items() if not name.startswith("__")}
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path} is no MATLAB file up to version 7.2 ({error}): save it again with '-v7'") from None


def _of_arrays(frequencies: Any, sensors: Sequence[str], values: dict[str, Any], options: dict[str, Any]) -> ModalData:
    """Modes of arrays, which are the columns of the shapes; complex ones after a rotation by the mean phase."""
    for what, each in {"frequencies": frequencies, **values}.items():
        if what != "shapes" and np.size(each) != max(np.shape(each), default=1):
            expected = f"read_modal_data: expected {what} of one identification, a number for each mode"
            advice = "give ModalData arrays of shape (n_sets, m), read_matlab returns those of a MATLAB file"
            raise ValueError(f"{expected}; got an array of shape {np.shape(each)}: {advice}")
    frequencies, found = np.ravel(np.asarray(frequencies, dtype=float)), {}
    if "shapes" in values:
        found["shapes"] = np.asarray(values["shapes"]).T
        if np.iscomplexobj(found["shapes"]):
            found["shapes"], _ = real_shapes(found["shapes"])
    if "damping" in values:
        found["damping"] = np.ravel(values["damping"])
    if "cv" in values:
        found["frequency_cv"] = np.ravel(values["cv"]) / frequencies
    return ModalData(frequencies, sensors=sensors, **found | options)
