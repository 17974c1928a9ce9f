"""The record and the measurements that a TOML file names."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.datasets import Dataset, read_dataset
from ..signals.read import read_columns, read_record
from ..signals.records import Record
from .job import HDF5, Job
from .keys import check_known, read_quantity
from .sections import USER_MODELS, Measured

__all__ = ["first_part", "is_dataset", "read_base_motion", "read_measured", "read_supports"]

FEWEST_SAMPLES = 10  # of a channel, where others lie outside the record


def is_dataset(job: Job, section: str) -> bool:
    """Whether the file of a section is a data set in HDF5, which has record and measurements."""
    given = getattr(job, section)
    return given is not None and Path(given.file or "").suffix.lower() in HDF5


def _file(job: Job, section: str) -> tuple[Path, Dataset | None]:
    """The file that a section names, and its contents if it is a data set."""
    given = getattr(job, section)
    if given is None or given.file is None:
        raise ValueError(f'{job.where(section)} file: this key is missing; it names the data, such as file = "top.csv"')
    path = job.path(section, "file", given.file)
    if not is_dataset(job, section):
        return path, None
    stated = {"column", "columns", "units", *given.READING, *({"zero"} if section == "measurements" else ())}
    if idle := [name for name in given.given() if name in stated]:
        raise ValueError(f"{job.where(section)} {idle[0]}: a data set states this itself: leave the key out")
    return path, job.located(section, read_dataset, path)


def read_base_motion(job: Job) -> Record | None:
    """The excitation, scaled but not shortened, or None without a section ``[record]``."""
    given = job.record
    if (job.kind == "bridge deck") != (given is not None and given.supports is not None):
        raise ValueError(
            f'{job.where("record")} supports: a bridge deck needs three, supports = ["base.csv", "first.csv", '
            '"second.csv"], and other structures have one motion, file'
        )
    if given is None and job.kind in USER_MODELS:
        return None
    if given is not None and given.supports is not None:
        return read_supports(job)[0]
    path, dataset = _file(job, "record")
    options = given.given("column", "units", "missing", *given.READING)
    record = dataset.record if dataset else job.located("record", read_record, path, **options)
    return record if given.scale is None else record.scale(given.scale)


def read_supports(job: Job) -> list[Record]:
    """The motions of several supports, as `read_base_motion`."""
    if more := job.record.given("file", "column"):
        raise ValueError(f"{job.where('record')} {[*more][0]}: leave it out with supports, which name files")
    places = [text.partition(":") for text in job.record.supports]
    alone = [replace(job.record, supports=None, file=file, column=column or None) for file, _, column in places]
    return [read_base_motion(replace(job, kind="", record=one)) for one in alone]


def first_part(job: Job, data: Any) -> Any:
    """The part of a record or of measurements within the duration that is used."""
    wanted = job.record and job.record.duration
    return data if wanted is None or data is None else job.located("record", data.trim, 0.0, wanted)


def read_measured(job: Job, channels: Sequence[Channel], record: Record | None) -> Measurements:
    """The measurements of a model's channels, without samples before and after the record."""
    path, dataset = _file(job, "measurements")
    given = job.measurements
    measured = dataset.measurements if dataset else job.located("measurements", _read_columns, path, given, channels)
    steps = {"reversed": _turned, "missing": _left_out, "baseline": _straightened, "channels": Measurements.select}
    asked = {key: getattr(given, key) for key in steps if getattr(given, key)}
    if record is not None and dataset is None:
        asked["zero"] = record
    for key, value in asked.items():
        try:
            measured = steps.get(key, _within)(measured, value)
        except ValueError as error:
            raise ValueError(f"{job.where('measurements')} {key}: {error}") from error
    return measured


def _read_columns(path: Path, given: Measured, channels: Sequence[Channel]) -> Measurements:
    by_name = {channel.name: channel for channel in channels}
    columns, units = given.columns or {name: name for name in by_name}, given.units or {}
    for key, names, known in (("columns", columns, tuple(by_name)), ("units", units, tuple(columns))):
        check_known(names, known, f"{key}:", "unknown channel")
    if lacking := [name for name in by_name if name not in columns]:
        raise ValueError(
            f"columns: expected a column for each channel of the model, {', '.join(by_name)}; there is none for "
            f"{', '.join(lacking)}"
        )
    options = given.given("zero", *given.READING)
    marks = [each for each in given.missing or () if not isinstance(each, list)]
    if named := [each for each in marks if each in by_name]:
        raise ValueError(f"missing: a time span is a list of its own, missing = [[{named[0]!r}, 12.3, 12.8]]")
    if marks or given.missing == []:
        options["missing"] = marks
    return read_columns(
        path,
        list(by_name.values()),
        [columns[name] for name in by_name],
        [units.get(name) for name in by_name] if units else None,
        description=f"measurements of {path.name}",
        **options,
    )


def _changed(measured: Measurements, values: np.ndarray, what: str) -> Measurements:
    return replace(measured, values=values, description=f"{measured.description}, {what}")


def _turned(measured: Measurements, names: Sequence[str]) -> Measurements:
    """Measurements with the channels `names` multiplied by -1."""
    turned = measured.select(names).channels
    signs = np.array([[-1.0 if channel in turned else 1.0] for channel in measured.channels])
    return _changed(measured, signs * measured.values, f"reversed: {', '.join(names)}")


def _left_out(measured: Measurements, missing: Sequence[Any]) -> Measurements:
    """Measurements without the samples at the times that `missing` lists, for one channel or all."""
    spans = [each for each in missing if isinstance(each, list)]
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for *name, first, last in spans:
        for channel in measured.select(name or names).channels:
            row, times = names.index(channel.name), measured.times(channel.name)
            margin = 0.1 * measured.steps[row]
            values[row, (times >= first - margin) & (times <= last + margin)] = np.nan
    counts = (np.isfinite(measured.values) & np.isnan(values)).sum(axis=1)
    text = ", ".join(f"{count} of {name}" for name, count in zip(names, counts, strict=True) if count)
    return _changed(measured, values, f"samples left out: {text or 'none'}") if spans else measured


def _straightened(measured: Measurements, points: Mapping[str, Any]) -> Measurements:
    """Measurements less the polynomial through points of time and level, for each channel that has some."""
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for channel in measured.select([*points]).channels:
        times, levels = zip(*points[channel.name], strict=True)
        levels = [read_quantity(level, channel.dimension) for level in levels]
        line = np.polynomial.Polynomial.fit(times, levels, len(levels) - 1)
        values[names.index(channel.name)] -= line(measured.times(channel.name))
    return _changed(measured, values, f"less a baseline: {', '.join(points)}")


def _within(measured: Measurements, record: Record) -> Measurements:
    """The samples within a record, with NaN where the measurements are shorter; the description says what is left out.

    ValueError if a channel has no sample within the record, or fewer than `FEWEST_SAMPLES` while others were left out.
    """
    end, rows, starts, notes = record.time[-1], [], [], []
    for channel, values, step in zip(measured.channels, measured.values, measured.steps, strict=True):
        times, name = measured.times(channel.name), channel.name
        inside = np.flatnonzero((times >= -1e-6 * step) & (times <= end + 1e-6 * step))
        found, used = np.isfinite(values).sum(), np.isfinite(values[inside]).sum()
        share = f"{used} of {found} samples of {name} lie within the record"
        if not used or used < min(found, FEWEST_SAMPLES):
            raise ValueError(
                f"{share}, 0 to {end:g} s; expected {FEWEST_SAMPLES} or more. They were measured from {times[0]:g} to "
                f"{times[-1]:g} s: check time_unit, and set zero to the time in the file at which the base motion "
                'begins (a clock time such as "10:32:07" where the file has clock times)'
            )
        missing = int((end - times[inside[-1]]) / step + 1e-6)
        rows.append(np.append(values[inside], np.full(missing, np.nan)))
        starts.append(0.0 if abs(times[inside[0]]) <= 1e-6 * step else float(times[inside[0]]))
        notes += [f"without {found - used} samples of {name} before or after the record"] if used < found else []
        notes += [f"CAUTION: only {share}: check time_unit and zero, and the record"] if used < found - used else []
        notes += [f"{name} ends {missing * step:.3g} s before the record"] if missing else []
    text = ", ".join([measured.description, *notes])
    return Measurements(measured.channels, measured.steps, rows, text, starts)
