"""What a file of data holds, as text, and the lines of a TOML file that read it."""

import json
import re
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..adapters.identification import read_matlab, read_modal_data
from ..checks.finding import labelled
from ..checks.screening import check_sensors, repair_lines, screen
from ..signals.channels import Channel, Measurements
from ..signals.datasets import read_dataset
from ..signals.read import read_columns
from ..signals.strong_motion import find_channels, recognise
from ..signals.tables import read_table
from ..signals.text_files import dimension_of
from ..text_tables import number, text_table
from ..units import from_si
from .job import HDF5

_MOST_ERRORS = 3  # of a file, each of which advises an option
_WRITE = '    # write what is "?": the file does not state it'
_Parts = tuple[list[str], list[str]]  # text, and lines of [measurements]
_Lines = tuple[list[str], dict[str, list[str]]]  # text about a file, and lines of sections such as [measurements]


def describe_data(path: Path) -> str:
    """What a file of data holds, and the lines of a TOML file that read it; ValueError if it cannot be read."""
    ending = path.suffix.lower()
    if ending in HDF5:
        found = read_dataset(path)
        described, repairs = _screened(found.measurements)
        text = ["a data set", str(found.record), found.record.source, *described]
        sections = {"record": [], "measurements": repairs}
    elif ending == ".mat":
        sizes = ((name, " x ".join(map(str, np.shape(each)))) for name, each in read_matlab(path).items())
        text = ["a MATLAB file", text_table([("variable", "size"), *sizes])]
        given = {"variables": {"frequencies": "?", "shapes": "?"}, "columns": {"sensor": "? row"}, "unit": "?"}
        sections = {"modes": _keys(given)}
    else:
        text, sections = _table(path) if (form := recognise(path)) is None else _motions(path, form)
    lines = [f"{path}: {text[0]}", *text[1:], "\n# lines for the TOML file; columns: channel of the model = column"]
    for section, given in sections.items():
        lines += [f"[{section}]", f"file = {_toml(str(path))}", *given]
    return "\n".join(lines)


def _toml(value: object) -> str:
    """A text, number or list as TOML writes it, and a mapping as an inline table."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {_toml(each)}" for name, each in value.items()) + "}"
    return json.dumps(value, ensure_ascii=False)


def _name_of_channel(text: str, taken: dict[str, object]) -> str:
    """A name for a channel, from the name of its column without the unit."""
    base = re.sub(r"[^A-Za-z0-9_]+", "_", re.sub(r"[\[(].*$", "", text)).strip("_").lower() or "channel"
    return next(name for k in range(1, len(taken) + 2) if (name := base if k == 1 else f"{base}_{k}") not in taken)


def _twice(names: Sequence[Any]) -> list[str]:
    """What is said about names that are there several times, which readers cannot tell apart."""
    return [f"{name!r} is there {n} times, and is left out" for name, n in Counter(names).items() if n > 1]


def _advised(read: Callable[..., Any], options: dict[str, Any], above: int = 0) -> tuple[Any, list[str]]:
    """What `read` returns with the options that its errors advise, which are added, or None; and these errors.

    An option whose value is not known is "?"; `above` is the number of lines above a table.
    """
    said = list[str]()
    while True:
        try:
            return read(**options), said
        except ValueError as error:
            said.append(str(error))
            mark = re.search(r"got '(.+)'; if it stands for a missing sample|got (\S+) in \d+ rows", said[-1])
            key = re.search(
                r"(?:give|step,) (units|resample|time_unit|skip|dt)=(?: in seconds|([\d.e-]+\d)|)", said[-1]
            )
            if len(said) > _MOST_ERRORS or not (mark or key):
                raise
            if mark:
                options["missing"] = [*options.get("missing", []), mark[1] or float(mark[2])]
                continue
            options[key[1]] = above if key[1] == "skip" else float(key[2]) if key[2] else "?"
            if options[key[1]] == "?":
                return None, said


def _keys(options: dict[str, Any]) -> list[str]:
    """Lines of keys, of which some have "?" for what the file does not state."""
    return [f"{key} = {(text := _toml(value))}{_WRITE * ('?' in text)}" for key, value in options.items()]


def describe(measured: Measurements, unstated: Iterable[str] = ()) -> list[str]:
    """A table of channels, of which some have an `unstated` unit, and the description."""
    rows = [("channel", "unit", "samples", "missing", "step [s]", "smallest", "largest")]
    for channel, step, values in zip(measured.channels, measured.steps, measured.values, strict=True):
        known = from_si(values[np.isfinite(values)], channel.unit)
        ends = (number(known.min(), 4), number(known.max(), 4)) if known.size else ("-", "-")
        counts = str(values.size), str(values.size - known.size), f"{step:g}" if measured.is_history else "-"
        rows.append((channel.name, "?" if channel.name in unstated else channel.unit, *counts, *ends))
    return [text_table(rows), *filter(None, [measured.description])]


def _screened(measured: Measurements | None, marks: Sequence[Any] = (), unstated: Iterable[str] = ()) -> _Parts:
    """The same with faults of sensors, and lines of ``[measurements]`` that deal with these."""
    if measured is None:
        return [], []
    faults = [each._replace(unit="") if each.name in unstated else each for each in screen(measured)]
    cautions = labelled(each._replace(action="") for each in check_sensors(faults))
    return [*describe(measured, unstated), *cautions], repair_lines(faults, marks)


def _motions(path: Path, form: str) -> _Lines:
    """Accelerations in a format of networks, which readers know by numbers or names if there are several."""
    found, columns, options = find_channels(path, form), dict[str, Any](), dict[str, Any]()
    numbers = [each.channel for each in found]
    known = [  # a V2 file without a number of its own is known by its name
        each.file.removeprefix(f"{path}/")
        if form == "v2" and (each.channel is None or numbers.count(each.channel) > 1)
        else each.channel
        for each in found
    ]
    for column in (each for each in known if known.count(each) == 1):
        columns[_name_of_channel(f"ch{column}" if isinstance(column, int) else column or "motion", columns)] = column
    channels = [Channel(name, "acceleration", "g") for name in columns]
    measured, text = _advised(lambda **more: read_columns(path, channels, [*columns.values()], **more), options)
    described, repairs = _screened(measured)
    text = [f"{len(columns)} channel(s) of acceleration", *described, *text, *_twice(known)]
    if (first := next(iter(columns.values()))) is None:
        return text, {"record": _keys(options)}
    base = [f"column = {_toml(first)}    # the base motion"]
    return text, {"record": base + _keys(options), "measurements": _keys({"columns": columns} | options) + repairs}


def _table(path: Path) -> _Lines:
    """A table of samples, of modes or of load cases."""
    options, columns, units, unstated = dict[str, Any](), dict[str, str](), list[str](), dict[str, str]()
    table, said = _advised(lambda **more: read_table(path, **more), options)
    try:
        if table.time is None or table.clock is not None:  # days of several identifications are clocks as well
            return ["a table of modes", str(read_modal_data(path))], {"modes": []}
    except ValueError as error:
        if "unit of its frequency" in str(error) and table.clock is None:
            return ["a table of modes"], {"modes": _keys({"unit": "?"})}
    names, clock = [column.name for column in table.columns], table.clock and table.clock.text
    of_cases = re.search(r"case|load|truck|position|place", names[0], re.IGNORECASE) or table.columns[0].kind == "text"
    cases = bool(of_cases) and table.time is None and len(names) > 1
    for k in (k for k in table.value_columns if names.count(names[k]) == 1 and not (cases and k == 0)):
        unit = table.stated_unit(k) or table.text_unit(k, "acceleration")  # as the readers of accelerations take it
        if unit and dimension_of(unit) is None:
            said.append(f"column {names[k]!r} has the unknown unit {unit!r}, and is left out")
            continue
        name = _name_of_channel(names[k] if table.named else f"column {names[k]}", columns)
        columns[name], unstated = names[k], unstated | ({} if unit else {name: "?"})
        units.append(unit or "1")
    if not columns:
        return [f"a table of {len(table.lines)} rows without a column of values", *said, *_twice(names)], {}
    channels = [Channel(name, dimension_of(u) or "", u) for name, u in zip(columns, units, strict=True)]
    given = {"dt": 1.0} if cases else {"zero": clock or 0.0}
    measured, more = _advised(
        lambda **more: read_columns(path, channels, [*columns.values()], units, **given, **more),
        options,
        table.lines[0] - 1 - table.named - any(column.below for column in table.columns),
    )
    measured = replace(measured, axis="load case") if cases else measured
    marks = options.pop("missing", [])
    described, repairs = _screened(measured, marks, unstated)
    text = [f"a table of {len(table.lines)} rows", *described, *said, *more, *_twice(names)]
    lines = _keys({"columns": columns} | options | ({"units": unstated} if unstated else {}))
    if cases:
        return text, {"load_test": lines}
    if clock:
        lines.append(f"zero = {_toml(clock)}    # or when the base motion begins, if it is in another file")
    base = {"column": next(iter(columns.values()))} | options | ({"units": "?"} if [*columns][0] in unstated else {})
    base |= {"missing": texts} if (texts := [each for each in marks if isinstance(each, str)]) else {}
    return text, {"record": _keys(base), "measurements": lines + repairs}
