"""What sensors saw: channels, measurements, and the HDF5 data set that keeps an excitation with its measured response.

Values are SI everywhere; the unit of a `Channel` is the one in which people want to read it, used in labels and plots.
A data set is one file with a `Record`, the `Measurements` it caused and free attributes (how the data were made, true
parameters of synthetic data). It carries a checksum over all of it, because a posterior from damaged data looks fine.
"""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..units import DIMENSIONS, find_unit, to_si
from . import file_formats
from .records import DisplacementHistory, Record, check_step, sample_window

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Channel",
    "Dataset",
    "ImposedTest",
    "Measurements",
    "read_columns",
    "read_dataset",
    "read_imposed_test",
    "write_dataset",
]

SCHEMA = "fe_likelihoods.dataset"
SCHEMA_VERSION = 1


@dataclass(frozen=True)
class Channel:
    """One measured quantity.

    Parameters
    ----------
    name : str
        Name, unique among the channels of a model or of measurements.
    quantity : str
        What is measured: a dimension of `fe_likelihoods.units.DIMENSIONS`, with or without words before it, such as
        ``"acceleration"`` or ``"relative displacement"``.
    unit : str
        Unit for labels and plots ("g", "in", "kip"); values are SI everywhere.

    Raises
    ------
    ValueError
        If the name is empty, the quantity does not end with a dimension, or the unit does not measure it.
    """

    name: str
    quantity: str
    unit: str

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ValueError(f"a channel needs a name, got {self.name!r}")
        if not isinstance(self.quantity, str) or self.dimension not in DIMENSIONS:
            raise ValueError(
                f"quantity of channel {self.name!r} must be one of {', '.join(DIMENSIONS)}, with or without words "
                f"before it, got {self.quantity!r}"
            )
        try:
            find_unit(self.unit, self.dimension)
        except ValueError as error:
            raise ValueError(f"channel {self.name!r}: {error}") from None

    @property
    def dimension(self) -> str:
        """Last word of the quantity: a key of `fe_likelihoods.units.DIMENSIONS`."""
        return self.quantity.split()[-1] if self.quantity.split() else ""

    @property
    def si_unit(self) -> str:
        """SI unit of the values."""
        return DIMENSIONS[self.dimension]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Simultaneous samples of several channels at a constant step.

    Parameters
    ----------
    channels : tuple of Channel
        The channels, with unique names.
    dt : float
        Time step [s].
    values : (n_channels, n_steps) array_like
        Samples in SI, one row a channel; kept as a read-only copy.
    description : str, optional
        What was measured, where and when.

    Raises
    ------
    ValueError
        If names repeat, the shape does not fit the channels, the step is not positive, or a sample is not finite.
    """

    channels: tuple[Channel, ...]
    dt: float
    values: NDArray[np.float64]
    description: str = ""

    def __post_init__(self) -> None:
        channels = tuple(self.channels)
        names = [channel.name for channel in channels]
        if not channels or len(set(names)) != len(names):
            raise ValueError(f"measurements need channels with different names, got {names}")
        values = np.array(self.values, dtype=np.float64)
        if values.ndim != 2 or values.shape[0] != len(channels) or values.shape[1] < 1:
            raise ValueError(
                f"expected values of shape (n_channels, n_steps) = ({len(channels)}, n_steps), got {values.shape}"
            )
        bad = np.argwhere(~np.isfinite(values))
        if bad.size:
            row, step = bad[0]
            raise ValueError(
                f"values must be finite: {len(bad)} are not, the first is sample {step} of channel {names[row]!r} "
                f"({values[row, step]}); repair or cut the data"
            )
        values.flags.writeable = False
        object.__setattr__(self, "channels", channels)
        object.__setattr__(self, "dt", check_step(self.dt, "the measurements"))
        object.__setattr__(self, "values", values)

    @property
    def n_channels(self) -> int:
        """Number of channels."""
        return len(self.channels)

    @property
    def n_steps(self) -> int:
        """Number of samples of each channel."""
        return self.values.shape[1]

    @property
    def time(self) -> NDArray[np.float64]:
        """Times of the samples, from zero, shape (n_steps,) [s]."""
        return np.arange(self.n_steps) * self.dt

    @property
    def fingerprint(self) -> str:
        """Hex digest (BLAKE2b, 128 bits) of names, quantities, step and values; display units do not enter."""
        state = hashlib.blake2b(digest_size=16)
        state.update(json.dumps([[channel.name, channel.quantity] for channel in self.channels]).encode())
        state.update(np.array([self.dt, self.n_steps], dtype="<f8").tobytes())
        state.update(np.ascontiguousarray(self.values, dtype="<f8").tobytes())
        return state.hexdigest()

    def channel(self, name: str) -> NDArray[np.float64]:
        """Samples of the channel `name`, shape (n_steps,), SI; ValueError if there is no such channel."""
        return self.values[self._row(name)]

    def select(self, names: Sequence[str]) -> "Measurements":
        """Measurements of the named channels only, in the order of `names`; ValueError if one is not there."""
        if isinstance(names, str):
            raise ValueError(f"select takes a sequence of names, for instance [{names!r}]")
        rows = [self._row(name) for name in names]
        return replace(self, channels=tuple(self.channels[row] for row in rows), values=self.values[rows])

    def trim(self, start: float = 0.0, stop: float | None = None) -> "Measurements":
        """Samples between two times [s], both included, as `fe_likelihoods.signals.records.Record.trim`; time restarts at 0."""
        window = sample_window("the measurements", self.n_steps, self.dt, start, stop)
        return replace(self, values=self.values[:, window])

    def decimate(self, factor: int) -> "Measurements":
        """Every `factor`-th sample, from the first one, unfiltered.

        This is what a likelihood with noise that is white in time wants: the kept samples are the measured ones with
        their noise unchanged and independent, and they are compared with the model's response at those very instants.
        A filter would correlate the noise. The kept samples are not a band-limited signal, though: motion above the
        new Nyquist frequency is folded back, so do not differentiate, integrate or take spectra of them, and decimate
        an excitation with `fe_likelihoods.signals.records.Record.resample` instead.

        Raises
        ------
        ValueError
            If the factor is not a whole number of 1 or more, or larger than the number of samples.
        """
        if not isinstance(factor, (int, np.integer)) or not 1 <= factor <= self.n_steps:
            raise ValueError(f"factor must be a whole number from 1 to {self.n_steps}, got {factor!r}")
        return replace(self, dt=self.dt * factor, values=self.values[:, ::factor])

    def plot(
        self, response: "Measurements | None" = None, channels: Sequence[str] | None = None, **options
    ) -> "Figure":
        """Histories of the channels, and what a model answers; see `fe_likelihoods.plots.histories.plot_histories`."""
        from ..plots.histories import plot_histories

        return plot_histories(self, response, channels, **options)

    def _row(self, name: str) -> int:
        names = [channel.name for channel in self.channels]
        if name not in names:
            raise ValueError(f"no channel {name!r}; the channels are {', '.join(names)}")
        return names.index(name)


class Dataset(NamedTuple):
    """An excitation, the response measured under it, and free attributes."""

    record: Record
    measurements: Measurements
    attributes: dict


class ImposedTest(NamedTuple):
    """A displacement imposed on a specimen, and what was measured at its steps (`measurements.dt` is 1: one step)."""

    history: DisplacementHistory
    measurements: Measurements


def read_columns(
    path: str | Path,
    channels: Sequence[Channel],
    columns: Sequence[str],
    units: str | Sequence[str] | None = None,
    dt: float | None = None,
    description: str = "",
) -> Measurements:
    """Measured responses from the columns of a CSV file with a header line (see `fe_likelihoods.signals.records.read_csv`).

    Parameters
    ----------
    path : path
        The file.
    channels : sequence of Channel
        What the columns are.
    columns : sequence of str
        Names of the columns in the header line, one for each channel.
    units : str or sequence of str, optional
        Unit of the numbers, one for all or one for each column; not needed where the names of the columns end with it
        (``disp_in``), and then it must agree.
    dt : float, optional
        Time step [s], needed for a file without times.
    description : str, optional
        Description of the measurements.

    Raises
    ------
    ValueError
        If a column is missing, a unit is missing or of another dimension than its channel, the times are not uniform,
        or a cell is not a finite number.
    """
    table = file_formats.read_table(path)
    values = _channel_values(table, channels, columns, units)
    return Measurements(tuple(channels), file_formats.table_step(table, dt), values, description)


def read_imposed_test(
    path: str | Path,
    displacement: str,
    channels: Sequence[Channel],
    columns: Sequence[str],
    units: str | Sequence[str] | None = None,
    displacement_unit: str | None = None,
    description: str = "",
) -> ImposedTest:
    """Quasi-static laboratory test from a CSV file: imposed displacement, and channels measured at its steps.

    Parameters
    ----------
    path : path
        The file.
    displacement : str
        Name of the column with the imposed displacement.
    channels, columns, units, description
        The measured channels, as in `read_columns`.
    displacement_unit : str, optional
        Unit of the displacement, if the name of its column does not end with it.

    Raises
    ------
    ValueError
        As `read_columns`, apart from times, of which there are none.
    """
    table = file_formats.read_table(path)
    imposed = Channel(displacement, "displacement", displacement_unit or "m")
    (history,) = _channel_values(table, (imposed,), (displacement,), displacement_unit)
    values = _channel_values(table, channels, columns, units)
    measurements = Measurements(tuple(channels), 1.0, values, description)
    return ImposedTest(DisplacementHistory(Path(path).stem, history, Path(path).name), measurements)


def write_dataset(path: str | Path, record: Record, measurements: Measurements, attributes: dict | None = None) -> None:
    """Write a data set to HDF5; a file of that name is replaced at once, and never left half written.

    Parameters
    ----------
    path : path
        The file to write.
    record : Record
        The excitation.
    measurements : Measurements
        The response.
    attributes : dict, optional
        Anything JSON can hold exactly (text, finite numbers, lists, dicts with text as keys); arrays become lists.

    Raises
    ------
    ValueError
        If the attributes are not of that kind, or the folder does not exist.
    """
    import h5py  # takes longer to start than this package

    path = Path(path)
    text = _attributes_text(attributes or {})
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}")
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
            values = file.create_dataset("measurements/values", data=measurements.values, dtype="<f8")
            values.attrs.update({"description": measurements.description, "dt": measurements.dt, "dt_units": "s"})
            for key, column in _channel_columns(measurements.channels).items():
                values.attrs.create(key, column, dtype=h5py.string_dtype())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_dataset(path: str | Path) -> Dataset:
    """Read a data set that `write_dataset` wrote.

    Raises
    ------
    ValueError
        If the file is not there, is not such a data set, is of another version, lacks a part, or its contents do not
        have the checksum that was written with them.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            schema, version = file.attrs.get("schema"), file.attrs.get("schema_version")
            if schema != SCHEMA or version != SCHEMA_VERSION:
                raise ValueError(
                    f"{path}: expected schema {SCHEMA!r} version {SCHEMA_VERSION}, got {schema!r} version {version}; "
                    f"write the data set again with this release"
                )
            samples, values = file["record/acceleration"], file["measurements/values"]
            text, checksum = file.attrs["attributes"], file.attrs["checksum"]
            record = Record(samples.attrs["name"], samples.attrs["dt"], samples[()], samples.attrs["source"])
            columns = [values.attrs[key] for key in ("channel_names", "quantities", "display_units")]
            channels = tuple(Channel(*map(str, each)) for each in zip(*columns, strict=True))
            measurements = Measurements(channels, values.attrs["dt"], values[()], values.attrs["description"])
            units = [samples.attrs["units"], *values.attrs["units"]]
    except (OSError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: not a complete data set ({error}); make it or fetch it again") from error
    if units != [DIMENSIONS["acceleration"], *(channel.si_unit for channel in channels)]:
        raise ValueError(f"{path}: expected SI units, got {units}; the file is damaged or written by something else")
    if checksum != _checksum(record, measurements, text):
        raise ValueError(
            f"{path}: the contents do not match their checksum; the file is damaged, make it or fetch it again"
        )
    return Dataset(record, measurements, json.loads(text))


def _channel_values(
    table: file_formats.Table, channels: Sequence[Channel], columns: Sequence[str], units: str | Sequence[str] | None
) -> NDArray[np.float64]:
    """Columns of a table in SI, shape (n_channels, n_rows)."""
    given = [units] * len(columns) if units is None or isinstance(units, str) else list(units)
    if isinstance(columns, str) or not len(channels) == len(columns) == len(given):
        raise ValueError(
            f"expected one column and one unit for each of {len(channels)} channels, got columns {columns!r}, "
            f"units {units!r}"
        )
    rows = []
    for channel, column, unit in zip(channels, columns, given, strict=True):
        samples = table.values[:, file_formats.value_column(table, column)]
        where = f"{table.file}, column {column!r}"
        rows.append(
            to_si(samples, file_formats.agreed_unit(file_formats.column_unit(column), unit, channel.dimension, where))
        )
    return np.array(rows)


def _channel_columns(channels: Sequence[Channel]) -> dict[str, list[str]]:
    return {
        "channel_names": [channel.name for channel in channels],
        "quantities": [channel.quantity for channel in channels],
        "units": [channel.si_unit for channel in channels],
        "display_units": [channel.unit for channel in channels],
    }


def _attributes_text(attributes: dict) -> str:
    def plain(value):
        if isinstance(value, (np.ndarray, np.generic)):
            return value.tolist()
        raise TypeError(f"{type(value).__name__} {value!r}")

    try:
        return json.dumps(attributes, default=plain, allow_nan=False, sort_keys=True)
    except (TypeError, ValueError) as error:
        raise ValueError(f"attributes must be text, finite numbers, lists and dicts of them, got {error}") from None


def _checksum(record: Record, measurements: Measurements, attributes: str) -> str:
    names = json.dumps([record.name, record.source, measurements.description, _channel_columns(measurements.channels)])
    parts = (record.fingerprint, measurements.fingerprint, names, attributes)
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=16).hexdigest()
