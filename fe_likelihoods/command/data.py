"""The record and the measurements that a TOML file names."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.datasets import Dataset, read_dataset
from ..signals.read import read_columns, read_record
from ..signals.records import Record
from .job import Job
from .keys import did_you_mean, read_quantity
from .sections import Measured

__all__ = [
    "FEWEST_SAMPLES",
    "is_dataset",
    "read_base_motion",
    "read_measured",
    "read_supports",
    "reduce_data",
    "within",
]

_HDF5 = (".h5", ".hdf5")


def is_dataset(job: Job, section: str) -> bool:
    """Whether the file of a section is a data set in HDF5, which has record and measurements."""
    given = getattr(job, section)
    return given is not None and Path(given.file or "").suffix.lower() in _HDF5


def _dataset(job: Job, section: str) -> Dataset | None:
    """The data set that a section names; None for other files, ValueError without a file."""
    file = getattr(job, section).file
    if file is None:
        raise ValueError(f"{job.where(section)} file: this key is missing; it names the data")
    if not is_dataset(job, section):
        return None
    return job.located(section, lambda: read_dataset(job.path(section, "file", file)))


def read_base_motion(job: Job) -> Record | None:
    """The excitation, scaled but neither shortened nor resampled, or None without a section ``[record]``.

    ValueError, which names the key, if the file does not exist or cannot be read.
    """
    given = job.record
    if (job.kind == "bridge deck") != (given is not None and given.supports is not None):
        raise ValueError(
            f'{job.where("record")} supports: a bridge deck needs three, supports = ["base.csv", "first.csv", '
            '"second.csv"], and other structures have one motion, file'
        )
    if given is None:
        if job.kind in ("column", "bridge", "oscillator", "frame"):
            raise ValueError(f"{job.where('record')} file: this key is missing; the {job.kind} needs a base motion")
        return None
    if given.supports is not None:
        return read_supports(job)[0]
    dataset = _dataset(job, "record")
    if dataset is None:
        path = job.path("record", "file", given.file)
        options = given.given("channel", "column", "units", "missing", *given.READING)
        record = job.located("record", lambda: read_record(path, **options))
    else:
        record = dataset.record
    return record if given.scale is None else record.scale(given.scale)


def read_supports(job: Job) -> list[Record]:
    """The motions of several supports, as `read_base_motion`."""
    if more := job.record.given("file", "column"):
        raise ValueError(
            f"{job.where('record')} {[*more][0]}: leave it out with supports, which name files and columns"
        )
    found = []
    for text in job.record.supports:
        file, _, column = text.partition(":")
        one = replace(job.record, supports=None, file=file, column=column or None)
        found.append(read_base_motion(replace(job, kind="", record=one)))
    return found


def reduce_data(
    job: Job, record: Record | None, measured: Measurements | None
) -> tuple[Record | None, Measurements | None]:
    """The first part of the data, reduced to every n-th sample."""
    duration, every = (None, 1) if job.record is None else (job.record.duration, job.record.every)

    def reduce() -> tuple[Record, Measurements | None]:
        shorter, fewer = record, measured
        if duration is not None:
            shorter, fewer = shorter.trim(0.0, duration), fewer and fewer.trim(0.0, duration)
        if every != 1:
            shorter, fewer = shorter.resample(shorter.dt * every), fewer and fewer.decimate(every)
        return shorter, fewer

    return (record, measured) if record is None else job.located("record", reduce)


def read_measured(job: Job, channels: Sequence[Channel], record: Record | None) -> Measurements:
    """The measurements of a model's channels, without samples before and after the record.

    ValueError, which names the key, if the file does not exist, cannot be read or lacks a column.
    """
    given = job.measurements
    if given is None:
        raise ValueError(
            f"{job.where('measurements')} file: this key is missing; give the measured response, such as "
            'file = "top.csv"'
        )
    dataset = _dataset(job, "measurements")
    if dataset is None:
        path = job.path("measurements", "file", given.file)
        measured = job.located("measurements", lambda: _read_columns(path, given, channels))
    else:
        measured = dataset.measurements
    steps: dict[str, Callable[[Measurements], Measurements]] = {
        "reversed": lambda found: _turned(found, given.reversed),
        "missing": lambda found: _left_out(found, given.missing),
        "baseline": lambda found: _straightened(found, given.baseline),
        "channels": lambda found: found.select(given.channels),
    }
    if record is not None and dataset is None:
        steps["zero"] = lambda found: within(found, record)
    for key, step in steps.items():
        if key == "zero" or getattr(given, key):
            try:
                measured = step(measured)
            except ValueError as error:
                raise ValueError(f"{job.where('measurements')} {key}: {error}") from error
    return measured


def _read_columns(path: Path, given: Measured, channels: Sequence[Channel]) -> Measurements:
    by_name = {channel.name: channel for channel in channels}
    columns, units = given.columns or {name: name for name in by_name}, given.units or {}
    for key, names, known in (("columns", columns, tuple(by_name)), ("units", units, tuple(columns))):
        for name in names:
            if name not in known:
                raise ValueError(f"{key}: unknown channel {name!r}; {did_you_mean(name, known)}")
    if missing := [name for name in by_name if name not in columns]:
        raise ValueError(
            f"columns: expected a column for each channel of the model, {', '.join(by_name)}; there is none for "
            f"{', '.join(missing)}"
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


def _left_out(measured: Measurements, missing: Sequence[Any]) -> Measurements:
    """Measurements without the samples at the times that `missing` lists, for one channel or all."""
    spans = [each for each in missing if isinstance(each, list)]
    if not spans:
        return measured
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for *name, first, last in spans:
        for channel in measured.select(name or names).channels:
            row, times = names.index(channel.name), measured.times(channel.name)
            margin = 0.1 * measured.steps[row]
            values[row, (times >= first - margin) & (times <= last + margin)] = np.nan
    counts = (np.isfinite(measured.values) & np.isnan(values)).sum(axis=1)
    text = ", ".join(f"{count} of {name}" for name, count in zip(names, counts, strict=True) if count)
    return replace(measured, values=values, description=f"{measured.description}, samples left out: {text or 'none'}")


def _straightened(measured: Measurements, points: Mapping[str, Any]) -> Measurements:
    """Measurements less the polynomial through points of time and level, for each channel that has some."""
    values, names = measured.values.copy(), [channel.name for channel in measured.channels]
    for channel in measured.select([*points]).channels:
        times, levels = zip(*points[channel.name], strict=True)
        levels = [read_quantity(level, channel.dimension) for level in levels]
        line = np.polynomial.Polynomial.fit(times, levels, len(levels) - 1)
        values[names.index(channel.name)] -= line(measured.times(channel.name))
    return replace(measured, values=values, description=f"{measured.description}, less a baseline: {', '.join(points)}")


def _turned(measured: Measurements, names: Sequence[str]) -> Measurements:
    """Measurements with the channels `names` multiplied by -1."""
    turned = measured.select(names).channels
    signs = np.array([[-1.0 if channel in turned else 1.0] for channel in measured.channels])
    text = f"{measured.description}, reversed: {', '.join(names)}"
    return replace(measured, values=signs * measured.values, description=text)


FEWEST_SAMPLES = 10  # of a channel, where others lie outside the record


def within(measurements: Measurements, record: Record) -> Measurements:
    """The samples between the first and the last one of a record, with NaN where the measurements are shorter.

    The description says how many samples were left out, with a caution where these are more than half of them, and how
    much is missing at the end. ValueError if a channel has no sample within the record, or fewer than `FEWEST_SAMPLES`
    while others were left out.
    """
    end, rows, starts, notes = record.time[-1], [], [], []
    for channel, values, step in zip(measurements.channels, measurements.values, measurements.steps, strict=True):
        times = measurements.times(channel.name)
        inside = np.flatnonzero((times >= -1e-6 * step) & (times <= end + 1e-6 * step))
        found, used = np.isfinite(values).sum(), np.isfinite(values[inside]).sum()
        outside = found - used
        if not np.isfinite(values[inside]).any():
            raise ValueError(
                f"channel {channel.name!r} was measured from {times[0]:g} to {times[-1]:g} s and has no sample within "
                f"the record, 0 to {end:g} s; set zero in [measurements] to the time in the file at which the base "
                'motion begins (a clock time such as "10:32:07" where the file has clock times)'
            )
        share = f"{used} of {found} samples of {channel.name} lie within the record"
        if outside and used < FEWEST_SAMPLES:
            raise ValueError(
                f"{share}, 0 to {end:g} s; expected {FEWEST_SAMPLES} or more. They were measured from {times[0]:g} to "
                f"{times[-1]:g} s: check time_unit and zero in [measurements], and the record"
            )
        missing = int((end - times[inside[-1]]) / step + 1e-6)
        rows.append(np.append(values[inside], np.full(missing, np.nan)))
        starts.append(0.0 if abs(times[inside[0]]) <= 1e-6 * step else float(times[inside[0]]))
        notes += [f"without {outside} samples of {channel.name} before or after the record"] if outside else []
        if outside > used:
            notes.append(f"CAUTION: only {share}: check time_unit and zero in [measurements], and the record")
        notes += [f"{channel.name} ends {missing * step:.3g} s before the record"] if missing else []
    text = ", ".join([measurements.description, *notes])
    return Measurements(measurements.channels, measurements.steps, rows, text, starts)
