"""Modal data of other people's identification: tables, MATLAB files, and results of programs such as pyOMA2."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..modal.modal_data import ModalData, read_mode_table, real_shapes
from ..signals.text_files import agree_on_unit
from ..units import to_si

__all__ = ["read_matlab", "read_modal_data"]


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
          ``temperature`` [°C], and ``set``, or ``date`` and ``time`` (the identification, where there are several). All
          other columns of numbers are sensors. German names are read too; French, Italian, Spanish ones of frequency.
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
    if hasattr(source, "Fn") and hasattr(source, "Phi"):  # the attributes of pyOMA2
        if source.Fn is None or source.Phi is None or not np.size(source.Fn):
            raise ValueError("read_modal_data: the result has no modes; choose them first, with mpe or mpe_from_plot")
        found = {"shapes": source.Phi, "damping": getattr(source, "Xi", None), "cv": getattr(source, "Fn_std", None)}
        return _of_arrays(source.Fn, sensors, {what: x for what, x in found.items() if x is not None}, options)
    if not isinstance(source, str | Path):
        raise ValueError(f"read_modal_data: expected a path, or a result with Fn and Phi; got {type(source).__name__}")
    options = {"description": Path(source).name} | options
    if Path(source).suffix.lower() != ".mat":
        try:
            return read_mode_table(source, sensors, unit, options)
        except ValueError as error:
            if not re.search(r"expected a number.*\d *[ij]'", str(error)):
                raise
            raise ValueError(f"{error}: give ModalData the real_shapes of complex numbers") from None
    content, names = read_matlab(source), dict(variables or {})
    wanted = {"frequencies"} <= set(names) <= {"frequencies", "shapes", "damping"}
    if not wanted or not set(names.values()) <= set(content):
        raise ValueError(
            f"{source}: name the variables, such as variables={{'frequencies': 'f', 'shapes': 'Phi'}}; got {names}, "
            f"the file has {', '.join(content)}"
        )
    values = {what: content[name] for what, name in names.items()}
    unit = agree_on_unit(None, unit, "frequency", source, "unit")
    return _of_arrays(to_si(values.pop("frequencies"), unit, "frequency"), sensors, values, options)


def read_matlab(path: str | Path) -> dict[str, Any]:
    """The variables of a MATLAB file by name; ValueError if it cannot be read."""
    from scipy.io import loadmat  # slow to import

    try:
        return {name: each for name, each in loadmat(path).items() if not name.startswith("__")}
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path} is no MATLAB file up to version 7.2 ({error}): save it again with '-v7'") from None


def _of_arrays(frequencies: Any, sensors: Sequence[str], values: dict[str, Any], options: dict[str, Any]) -> ModalData:
    """Modes of arrays, which are the columns of the shapes; complex ones after a rotation by the mean phase."""
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
