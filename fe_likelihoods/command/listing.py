"""What a file of data holds, as text, and the lines of a TOML file that read it."""

import json
import re
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..checks.finding import NOTE
from ..checks.screening import Screened, check_data, check_sensors, repair_lines, screen
from ..checks.sensor_faults import find_sensor_faults
from ..modal.modal_readers import read_matlab, read_modal_data
from ..signals.datasets import read_dataset
from ..signals.strong_motion import find_channels, recognise
from ..signals.tables import (
    Statements,
    Table,
    clock_text,
    column_values,
    dimension_of,
    read_table,
    row_times,
    stated_unit,
    table_start,
    table_step,
    text_unit,
    uniform_times,
    value_columns,
)
from ..text_tables import number, text_table
from ..units import from_si, to_si
from .job import HDF5

__all__ = ["describe_data"]

_MOST_TEXTS = 3  # that stand for missing samples; a column with more is no column of numbers


class _Lines(NamedTuple):
    """Text about a file, and lines of sections such as ``[record]`` and ``[measurements]``."""

    text: list[str]
    sections: dict[str, list[str]]


def describe_data(path: Path) -> str:
    """What a file of data holds, and the lines of a TOML file that read it; ValueError if it cannot be read.

    It is a table, a ground motion in a supported format, a zip archive of V2 files, a data set (.h5), or a MATLAB file.
    """
    ending = path.suffix.lower()
    if ending == ".toml":
        raise ValueError(f"{path} names data: `fe-likelihoods check {path}` reads it; give the files that it names")
    if ending in HDF5 or ending == ".mat":
        found = _dataset(path) if ending in HDF5 else _matlab(path)
    else:
        form = recognise(path)
        found = _table(path) if form is None else _motions(path, form)
    lines = [f"{path}: {found.text[0]}", *found.text[1:], "", "# lines for the TOML file"]
    for section, given in found.sections.items():
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


def _screen(name: str, values: np.ndarray, unit: str, step: float, start: float = 0.0) -> list[Screened]:
    """Faults of a channel in a unit, which is empty if it is not known."""
    faults = find_sensor_faults(values, dimension_of(unit) or "displacement")
    return [Screened(name, unit, step, start, faults)] if faults else []


def _cautions(channels: list[Screened]) -> list[str]:
    return [f"CAUTION: {each.kind}: {each.text}" for each in check_sensors(channels)]


def _motions(path: Path, form: str) -> _Lines:
    """Accelerations in a format of networks, which readers know by numbers or names if there are several."""
    channels = find_channels(path, form)
    files = [each.file.removeprefix(f"{path}/") if each.file != str(path) else path.name for each in channels]
    numbers = [each.channel for each in channels]
    given = [  # a V2 file without a number of its own is known by its name
        each.channel if form != "v2" or (each.channel is not None and numbers.count(each.channel) == 1) else file
        for each, file in zip(channels, files, strict=True)
    ]
    rows = [("channel", "samples", "step [s]", "duration [s]", "peak [g]", "label", "file")]
    columns, said, screened, base = dict[str, object](), list[str](), list[Screened](), list[str]()
    for each, column, file in zip(channels, given, files, strict=True):
        try:
            parsed = each.parse()
            step = parsed.dt if parsed.times is None else uniform_times(parsed.times, None, str(column or path)).step
        except ValueError as error:
            if column is None:
                raise
            said.append(f"not read: {error}")
            continue
        values = from_si(to_si(parsed.values, parsed.unit or "g", "acceleration"), "g")
        peak, duration = number(np.abs(values).max()), number((values.size - 1) * step, 4)
        rows.append((str(each.channel or "-"), str(values.size), f"{step:g}", duration, peak, each.label, file))
        if parsed.unit is None:
            said.append("The unit is not stated: the peak is that of samples in g.")
            base.append('units = "?"    # write it: the file does not state it')
        if parsed.times is not None:
            said.append(f"uneven times in channel {column or 1}: give resample = {step:.6g}")
            base += [f"resample = {step:.6g}"] if column is None else []
        if (count := given.count(column)) > 1:
            said.append(f"{column!r} is there {count} times, and no number tells them apart")
            continue
        name = _name_of_channel(f"ch{column}" if isinstance(column, int) else column or "motion", columns)
        columns[name] = column
        screened += _screen(name, values, "g", step) if parsed.times is None else []
    if len({row[1:3] for row in rows[1:]}) > 1:
        said.append(
            "The channels differ in samples or step: they may be of several recorders, whose clocks may differ."
        )
    text = [f"{len(columns)} channel(s) of acceleration", text_table(rows), *dict.fromkeys(said), *_cautions(screened)]
    if given == [None]:
        return _Lines(text, {"record": base})
    sections = {}
    if columns:
        first = next(iter(columns.values()))
        key = "channel" if isinstance(first, int) else "column"
        measured = [f"columns = {_toml(columns)}    # channel of the model = channel of the file"]
        sections = {"record": [f"{key} = {_toml(first)}    # the base motion"]}
        sections["measurements"] = measured + repair_lines(screened)
    return _Lines(text, sections)


def _dataset(path: Path) -> _Lines:
    found = read_dataset(path)
    measured = found.measurements
    rows = [("channel", "quantity", "samples", "step [s]", "missing")]
    for channel, step, values in zip(measured.channels, measured.steps, measured.values, strict=True):
        rows.append((channel.name, channel.quantity, str(values.size), f"{step:g}", str(int(np.isnan(values).sum()))))
    text = ["a data set", str(found.record), found.record.source, text_table(rows), measured.description]
    text += [f"CAUTION: {each}" for each in check_data(measured, found.record) if each.severity != NOTE]
    return _Lines(text, {"record": [], "measurements": repair_lines(screen(measured))})


def _matlab(path: Path) -> _Lines:
    """Variables of a file that may have identified modes."""
    found = read_matlab(path)
    rows = [("variable", "size"), *((name, " x ".join(map(str, np.shape(each)))) for name, each in found.items())]
    given = ['variables = {frequencies = "?", shapes = "?"}    # write them: names of variables; also damping']
    given += ['columns = {"?" = "1"}    # write all: sensor of the model = row of the shapes']
    given += ['unit = "Hz"    # or "rad/s"']
    return _Lines(["a MATLAB file", text_table(rows)], {"modes": given})


def _readable(path: Path) -> tuple[Table, list[str], list[float], list[str]]:
    """A table, texts and numbers in it that may stand for missing samples, and what is said about them."""
    texts, numbers, said = list[str](), list[float](), list[str]()
    while True:
        try:
            table = read_table(path, missing=[*texts, *numbers] or None)
            for place in value_columns(table):
                column_values(table, place)
            return table, texts, sorted(numbers), said
        except ValueError as error:
            text = re.search(r"got '(.+)'; if it stands for a missing sample", str(error))
            value = re.search(r"got (\S+) in \d+ rows", str(error))
            if value is None and (text is None or len(texts) == _MOST_TEXTS):
                raise
            texts += [] if value else [text[1]]
            numbers += [float(value[1])] if value else []
            said.append(str(error))


def _table(path: Path) -> _Lines:
    """A table of samples, of modes or of load cases."""
    table, texts, marks, said = _readable(path)
    try:
        if table.time is None or table.clock is not None:  # days of several identifications are clocks as well
            return _Lines(["a table of modes", str(read_modal_data(path))], {"modes": []})
    except ValueError as error:
        if "unit of its frequency" in str(error) and table.clock is None:
            return _Lines(["a table of modes"], {"modes": ['unit = "?"    # write it: the file does not state it']})
    names = [column.name for column in table.columns]
    places = re.search(r"case|load|truck|position|place", names[0], re.IGNORECASE)
    cases = table.time is None and len(names) > 1 and (table.columns[0].kind == "text" or places)
    options, remarks, step = ([], ["a line for each load case"], None) if cases else _sampling(table)
    remarks += said
    rows: list[tuple[str, ...]] = [("column", "unit", "numbers", "missing", "smallest", "largest")]
    columns, unstated, screened = dict[str, object](), dict[str, str](), list[Screened]()
    for k in value_columns(table):
        name, values = names[k], column_values(table, k)
        known = values[~np.isnan(values)]
        ends = (number(known.min(), 4), number(known.max(), 4)) if known.size else ("-", "-")
        unit = stated_unit(table, k) or text_unit(table, k, "acceleration")  # as the readers of accelerations take it
        rows.append((name, unit or "not stated", str(known.size), str(values.size - known.size), *ends))
        if names.count(name) > 1:
            remarks.append(f"the name {name!r} is that of several columns: rename them")
            continue
        channel = _name_of_channel(name if table.named else f"column {name}", columns)
        columns[channel] = name
        if step is not None:
            if any(each.startswith("resample") for each in options):
                values = uniform_times(row_times(table), None, table.file).interpolate(values)
            start = table_start(table, step, 0.0 if table.clock is None else clock_text(table.clock))
            screened += _screen(channel, values, unit or "", step, start)
        if unit is None or dimension_of(unit) is None:
            unstated[channel] = "?"
    text = [f"a table of {len(table.lines)} rows", text_table(rows), *remarks, *_cautions(screened)]
    missing = [f"missing = {_toml([*texts, *marks])}"] if texts or marks else []
    repairs = repair_lines(screened, {"missing": [*texts, *marks]})
    repairs = ([] if any(each.startswith("missing") for each in repairs) else missing) + repairs
    if not columns:
        return _Lines(text, {})
    columns = {name: column for name, column in columns.items() if not cases or column != names[0]}
    measured = [f"columns = {_toml(columns)}    # channel of the model = column", *options]
    if unknown := {name: unit for name, unit in unstated.items() if name in columns}:
        measured.append(f"units = {_toml(unknown)}    # write them: the file does not state them")
    if cases:
        return _Lines(text, {"load_test": measured})
    if table.clock is not None:
        zero = _toml(clock_text(table.clock))
        measured.append(f"zero = {zero}    # or when the base motion begins, if it is in another file")
    first = next(iter(columns))
    base = [f"column = {_toml(columns[first])}    # the base motion, if it is in this file"]
    base += [f"missing = {_toml(texts)}"] if texts else []
    base += ['units = "?"    # write it: the file does not state it'] if first in unstated else []
    return _Lines(text, {"record": [*base, *options], "measurements": measured + repairs})


def _sampling(table: Table) -> tuple[list[str], list[str], float | None]:
    """Keys that the times need, what is said about them, and the step that these keys give, if they do."""
    try:
        step = table_step(table)
    except ValueError as error:
        advised = re.search(r"give (resample|time_unit|skip|dt)=", str(error))  # what the message asks for is a key
        key = advised[1] if advised and (advised[1] != "dt" or table.time is None) else ""
        said, lines, step = [f"times: {error}"], [f'{key} = "?"    # write it: the file does not state it'], None
        if key == "skip":
            above = table.lines[0] - 1 - table.named - any(column.below for column in table.columns)
            lines = [f"skip = {above}    # the step of the times, without the text above the table"] if above else []
            step = table_step(table._replace(stated=Statements())) if above else None
        elif key == "resample":
            even = uniform_times(row_times(table), None, table.file)
            said, lines, step = [f"times: uneven, to be {even.note}"], [f"resample = {even.step:.6g}"], even.step
        return lines if key else [], said, step
    column = None if table.time is None else table.columns[table.time]
    start = "" if column is None else f", from {column.values[0]:.10g} in column {column.name!r}"
    start += "" if table.clock is None else f", first clock time {clock_text(table.clock)}"
    return [], [f"times: step {step:g} s ({1 / step:g} per second){start}"], step
