"""Data sets in HDF5: an excitation, the response measured under it, and how both were made.

A data set is one file with a `Record`, `Measurements` and free attributes, such as the true parameters of synthetic
data. It carries a checksum of all contents, because a posterior gives no sign of damaged data.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..units import DIMENSIONS
from .channels import Channel, Measurements
from .records import Events, Record
from .sampling import expect

SCHEMA, SCHEMA_VERSION = "fe_likelihoods.dataset", 1


class Dataset(NamedTuple):
    """An excitation and the response measured under it.

    Attributes
    ----------
    record : Record
        The excitation, an `Events` if one was written.
    measurements : Measurements
        The response.
    attributes : dict
        Free attributes, such as the true parameters of synthetic data.

    Examples
    --------
    >>> data = problems.bridge_column_data("short")
    >>> data.record.dt, data.measurements.values.shape
    (0.015625, (2, 640))
    """

    record: Record
    measurements: Measurements
    attributes: dict


def write_dataset(path: str | Path, record: Record, measurements: Measurements, attributes: dict | None = None) -> None:
    """Write a data set to an HDF5 file, which is replaced as a whole.

    Parameters
    ----------
    path, record, measurements
        The file, the excitation, and the response under it.
    attributes : dict, optional
        Values that JSON can represent exactly: text, finite numbers, lists, and dicts with text as keys. Arrays are
        written as lists; ValueError for others.

    Examples
    --------
    >>> from fe_likelihoods.signals.datasets import read_dataset, write_dataset
    >>> write_dataset("test.h5", record, measurements, {"note": "synthetic"})
    >>> read_dataset("test.h5").attributes["note"]
    'synthetic'
    """
    import h5py  # imported here because it takes longer to import than this package

    path = Path(path)
    text = _attributes_text(attributes or {})
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with h5py.File(temporary, "w") as file:
            file.attrs["schema"] = SCHEMA
            file.attrs["schema_version"] = SCHEMA_VERSION
            file.attrs["attributes"] = text
            file.attrs["checksum"] = _checksum(record, measurements, text)
            samples = file.create_dataset("record/acceleration", data=record.acceleration, dtype="<f8")
            samples.attrs.update({"name": record.name, "source": record.source, "dt": record.dt})
            samples.attrs.update({"units": DIMENSIONS["acceleration"], "dt_units": "s"})
            if isinstance(record, Events):
                samples.attrs["events"] = _windows(record)
                samples.attrs["sources"] = json.dumps([each.source for each in record.records])
            values = file.create_dataset("measurements/values", data=measurements.values, dtype="<f8")
            values.attrs.update({"description": measurements.description, "dt": measurements.dt, "dt_units": "s"})
            values.attrs["start"] = measurements.start  # [s]; NaN among the values is a missing sample
            for key, column in _channel_columns(measurements.channels).items():
                values.attrs.create(key, column, dtype=h5py.string_dtype())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_dataset(path: str | Path) -> Dataset:
    """Read a data set written by `write_dataset`.

    ValueError if the file does not exist, is not a data set, has another version, is incomplete, or does not match its
    checksum.
    """
    import h5py

    if not Path(path).is_file():
        raise ValueError(f"cannot read {path}: there is no such file; check the path")
    try:
        with h5py.File(path, "r") as file:
            schema, version = file.attrs.get("schema"), file.attrs.get("schema_version")
            known, got = (schema, version) == (SCHEMA, SCHEMA_VERSION), f"{schema!r} version {version}"
            advice = "a data set of another release is to be written again with this one"
            expect(known, path, f"schema {SCHEMA!r} version {SCHEMA_VERSION}", got, advice)
            samples, values = file["record/acceleration"], file["measurements/values"]
            text, checksum = file.attrs["attributes"], file.attrs["checksum"]
            acceleration, responses = (np.asarray(each[()], dtype="<f8") for each in (samples, values))
            record = _record(acceleration, samples.attrs)
            columns = [values.attrs[key] for key in ("channel_names", "quantities", "display_units")]
            channels = tuple(Channel(*map(str, each)) for each in zip(*columns, strict=True))
            dt, start = (np.atleast_1d(values.attrs.get(key, 0.0)).tolist() for key in ("dt", "start"))
            dt, start = (each[0] if len(each) == 1 else each for each in (dt, start))
            measurements = Measurements(channels, dt, responses, values.attrs["description"], start)
            units = [samples.attrs["units"], *values.attrs["units"]]
        found, free = _checksum(record, measurements, text), json.loads(text)
    except ValueError:
        raise
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path}: not a complete data set ({error}); make it or download it again") from error
    known = units == [DIMENSIONS["acceleration"], *(channel.si_unit for channel in channels)]
    expect(known, path, "SI units", units, "the file is damaged or was written by another program")
    if checksum != found:
        raise ValueError(f"{path}: the contents do not match their checksum; make it or download it again")
    return Dataset(record, measurements, free)


def _record(acceleration: np.ndarray, attributes: Mapping) -> Record:
    """Return the record of a file, an `Events` if it was one when it was written."""
    dt = attributes["dt"]
    if "events" not in attributes:
        return Record(attributes["name"], dt, acceleration, attributes["source"])
    names, firsts, stops = zip(*json.loads(attributes["events"]), strict=True)
    places = zip(names, firsts, stops, json.loads(attributes["sources"]), strict=True)
    parts = [Record(name, dt, acceleration[first:stop], source) for name, first, stop, source in places]
    rests = [(first - stop) * dt for first, stop in zip(firsts[1:], stops[:-1], strict=True)]
    return Events(parts, rests, names)


def _windows(events: Events) -> str:
    """Name, first sample and the one after the last of each event."""
    return json.dumps([window[:3] for window in events.windows])


def _channel_columns(channels: Sequence[Channel]) -> dict[str, list[str]]:
    return {
        "channel_names": [channel.name for channel in channels],
        "quantities": [channel.quantity for channel in channels],
        "units": [channel.si_unit for channel in channels],
        "display_units": [channel.unit for channel in channels],
    }


def _attributes_text(attributes: dict) -> str:
    try:  # arrays become lists
        return json.dumps(attributes, default=lambda array: array.tolist(), allow_nan=False, sort_keys=True)
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"attributes must be text, finite numbers, lists and dicts of them, got {error}") from None


def _checksum(record: Record, measurements: Measurements, attributes: str) -> str:
    names = json.dumps([record.name, record.source, measurements.description, _channel_columns(measurements.channels)])
    parts = [record.fingerprint, measurements.fingerprint, names, attributes]
    parts += [_windows(record)] if isinstance(record, Events) else []
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
