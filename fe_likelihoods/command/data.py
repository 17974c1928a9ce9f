"""The record and the measurements that a TOML file names."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.datasets import Dataset, read_dataset
from ..signals.read import read_columns, read_record
from ..signals.records import Record
from .job import Job
from .schema import did_you_mean, read_quantity

__all__ = [
    "BUNDLED",
    "FEWEST_SAMPLES",
    "is_dataset",
    "read_base_motion",
    "read_bundled",
    "read_measured",
    "read_supports",
    "within",
]

BUNDLED = {
    "column-short": ("bridge_column_data", ("short",)),
    "column-eq1": ("bridge_column_data", ("eq1",)),
    "column-eq1-eq2": ("bridge_column_data", ("eq1-eq2",)),
    "bridge-twin": ("isolated_bridge_data", ("twin",)),
    "bridge-means": ("isolated_bridge_data", ("means",)),
}
"""Bundled synthetic data sets: function in `fe_likelihoods.problems`, and its arguments."""

_TABLE_KEYS = ("dt", "time", "time_unit", "skip")
_HDF5 = (".h5", ".hdf5")


def read_bundled(job: Job, section: str) -> Dataset:
    """The bundled data set that a section names; ValueError for an unknown name."""
    from .. import problems

    name = getattr(job, section)["bundled"]
    if name not in BUNDLED:
        raise ValueError(
            f"{job.where(section)} bundled: unknown synthetic data {name!r}; {did_you_mean(name, tuple(BUNDLED))}"
        )
    function, arguments = BUNDLED[name]
    return vars(problems)[function](*arguments)


def is_dataset(job: Job, section: str) -> bool:
    """Whether the file of a section is a data set in HDF5, which has record and measurements."""
    given = getattr(job, section)
    return "bundled" in given or Path(given.get("file", "")).suffix.lower() in _HDF5


def _one_source(job: Job, section: str) -> None:
    given = getattr(job, section)
    if ("file" in given) == ("bundled" in given):
        found = "both" if "file" in given else "none"
        raise ValueError(f"{job.where(section)} file: expected file = ... or bundled = ...; got {found} of them")


def read_base_motion(job: Job) -> Record | None:
    """The excitation, scaled but neither shortened nor resampled, or None without a section ``[record]``.

    ValueError, which names the key, if the file does not exist or cannot be read.
    """
    given = job.record
    if (job.kind == "bridge deck") != ("supports" in given):
        raise ValueError(
            f'{job.where("record")} supports: a bridge deck needs three, supports = ["base.csv", "first.csv", '
            '"second.csv"], and other structures have one motion, file'
        )
    if "supports" in given:
        return read_supports(job)[0]
    if not given:
        if job.kind in ("column", "bridge", "oscillator", "frame", "grouped frame"):
            raise ValueError(f"{job.where('record')} file: this key is missing; the {job.kind} needs a base motion")
        return None
    _one_source(job, "record")
    if "bundled" in given:
        record = read_bundled(job, "record").record
    else:
        path = job.path("record", "file", given["file"])
        record = _within_messages(job, "record", lambda: _read_record(job, path))
    return record.scale(given["scale"]) if "scale" in given else record


def read_supports(job: Job) -> list[Record]:
    """The motions of several supports, as `read_base_motion`."""
    if more := [key for key in ("file", "bundled", "column") if key in job.record]:
        raise ValueError(f"{job.where('record')} {more[0]}: leave it out with supports, which name files and columns")
    found = []
    for text in job.record["supports"]:
        file, _, column = text.partition(":")
        given = {key: value for key, value in job.record.items() if key != "supports"} | {"file": file}
        found.append(read_base_motion(replace(job, kind="", record=given | ({"column": column} if column else {}))))
    return found


def _read_record(job: Job, path: Path) -> Record:
    given = job.record
    if path.suffix.lower() in _HDF5:
        return read_dataset(path).record
    keys = ("channel", "column", "units", "resample", *_TABLE_KEYS)
    return read_record(path, **{key: given[key] for key in keys if key in given})


def read_measured(job: Job, channels: Sequence[Channel], record: Record | None) -> Measurements:
    """The measurements of a model's channels, without samples before and after the record.

    ValueError, which names the key, if the file does not exist, cannot be read or lacks a column.
    """
    given = job.measurements
    if not given:
        raise ValueError(
            f"{job.where('measurements')} file: this key is missing; give the measured response, such as "
            'file = "top.csv"'
        )
    _one_source(job, "measurements")
    if is_dataset(job, "measurements"):
        measured = (
            read_bundled(job, "measurements").measurements
            if "bundled" in given
            else _within_messages(
                job, "measurements", lambda: read_dataset(job.path("measurements", "file", given["file"]))
            ).measurements
        )
    else:
        path = job.path("measurements", "file", given["file"])
        measured = _within_messages(job, "measurements", lambda: _read_columns(path, given, channels))
    if "reversed" in given:
        measured = _within_messages(job, "measurements", lambda: _turned(measured, given["reversed"]), "reversed: ")
    measured = _within_messages(job, "measurements", lambda: _left_out(measured, given), "missing: ")
    measured = _within_messages(job, "measurements", lambda: _straightened(measured, given), "baseline: ")
    if "channels" in given:
        measured = _within_messages(job, "measurements", lambda: measured.select(given["channels"]), "channels: ")
    if record is None or is_dataset(job, "measurements"):
        return measured
    return _within_messages(job, "measurements", lambda: within(measured, record), "zero: ")


def _read_columns(path: Path, given: dict[str, Any], channels: Sequence[Channel]) -> Measurements:
    by_name = {channel.name: channel for channel in channels}
    columns, units = given.get("columns", {name: name for name in by_name}), given.get("units", {})
    for key, names, known in (("columns", columns, tuple(by_name)), ("units", units, tuple(columns))):
        for name in names:
            if name not in known:
                raise ValueError(f"{key}: unknown channel {name!r}; {did_you_mean(name, known)}")
    chosen = [name for name in by_name if name in columns]
    if missing := [name for name in by_name if name not in columns]:
        raise ValueError(
            f"columns: expected a column for each channel of the model, {', '.join(by_name)}; there is none for "
            f"{', '.join(missing)}"
        )
    options = {key: given[key] for key in ("dt", "time", "time_unit", "skip", "zero", "resample") if key in given}
    marks = [each for each in given.get("missing", ()) if not isinstance(each, list)]
    if marks or given.get("missing") == []:
        options["missing"] = marks
    return read_columns(
        path,
        [by_name[name] for name in chosen],
        [columns[name] for name in chosen],
        [units.get(name) for name in chosen] if units else None,
        description=f"measurements of {path.name}",
        **options,
    )


def _known(measured: Measurements, names: Iterable[str]) -> tuple[str, ...]:
    """Names of the channels; ValueError if a given name is none of them."""
    known = tuple(channel.name for channel in measured.channels)
    for name in names:
        if name not in known:
            raise ValueError(f"unknown channel {name!r}; {did_you_mean(name, known)}")
    return known


def _left_out(measured: Measurements, given: Mapping[str, Any]) -> Measurements:
    """Measurements without the samples at the times that `missing` lists, for one channel or all."""
    times = [each for each in given.get("missing", ()) if isinstance(each, list)]
    if not times:
        return measured
    known = _known(measured, [each[0] for each in times if len(each) == 3])
    values, left_out = measured.values.copy(), dict.fromkeys(known, 0)
    for *name, first, last in times:
        for row, (channel, step) in enumerate(zip(known, measured.steps, strict=True)):
            at = measured.times(channel)
            inside = (at >= first - 0.1 * step) & (at <= last + 0.1 * step) & (channel in (name or known))
            left_out[channel] += int(np.isfinite(values[row, inside]).sum())
            values[row, inside] = np.nan
    text = ", ".join(f"{count} of {name}" for name, count in left_out.items() if count)
    text = f"{measured.description}, samples left out: {text or 'none'}"
    return replace(measured, values=values, description=text)


def _straightened(measured: Measurements, given: Mapping[str, Any]) -> Measurements:
    """Measurements less the polynomial through the points of `baseline`, for each channel that it names."""
    points = given.get("baseline", {})
    if not points:
        return measured
    known, values = _known(measured, points), measured.values.copy()
    for name, each in points.items():
        row = known.index(name)
        levels = [read_quantity(value, measured.channels[row].dimension) for _, value in each]
        line = np.polynomial.Polynomial.fit([time for time, _ in each], levels, len(each) - 1)
        values[row] -= line(measured.times(name))
    return replace(measured, values=values, description=f"{measured.description}, less a baseline: {', '.join(points)}")


def _turned(measured: Measurements, names: Sequence[str]) -> Measurements:
    """Measurements with the channels `names` multiplied by -1; ValueError for an unknown channel."""
    known = _known(measured, names)
    signs = np.where(np.isin(known, names), -1.0, 1.0)[:, None]
    text = f"{measured.description}, reversed: {', '.join(names)}"
    return Measurements(measured.channels, measured.dt, signs * measured.values, text, measured.start)


def _within_messages(job: Job, section: str, read: Callable[[], Any], key: str = "") -> Any:
    """Errors of a reader, with file and section before them."""
    try:
        return read()
    except ValueError as error:
        if str(error).startswith(f"{job.file.name}: ["):
            raise
        raise ValueError(f"{job.where(section)} {key}{error}") from error


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
