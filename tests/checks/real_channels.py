"""Right channels of real and bundled synthetic motions and measurements."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fe_likelihoods import from_si, to_si
from fe_likelihoods.problems import bridge_column_data, isolated_bridge_data
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.signals.strong_motion import find_channels


class RealChannel(NamedTuple):
    """Samples of a sensor, and of a motion."""

    name: str
    dimension: str
    step: float
    values: np.ndarray


def real_channels(shared: Path) -> Iterator[RealChannel]:
    """Right channels, about 370 with the reference material."""
    for archive in sorted((shared / "measured").rglob("*.zip")):
        for each in find_channels(archive, "v2"):
            series = each.parse()
            values = to_si(series.values, series.unit, "acceleration")
            yield RealChannel(f"{archive.stem} {each.channel}", "acceleration", series.dt, values)
    for table in sorted(path for path in (shared / "measured").rglob("*.csv") if path.stem != "channels"):
        if "cyclic" not in str(table) and "time_s" in table.open().readline():
            columns = np.genfromtxt(table, delimiter=",", names=True)
            times, kind = columns["time_s"], "displacement" if "disp" in table.stem else "acceleration"
            for name in columns.dtype.names[1:]:
                step = (times[-1] - times[0]) / (len(times) - 1)
                yield RealChannel(f"{table.stem} {name}", kind, step, columns[name])
    for path in sorted((shared / "records").glob("*.csv")):
        record = read_record(path)
        yield RealChannel(path.stem, "acceleration", record.dt, record.acceleration)
    bundled = [(bridge_column_data, name) for name in ("short", "eq1", "eq1-eq2")]
    for read, name in [*bundled, (isolated_bridge_data, "twin"), (isolated_bridge_data, "means")]:
        measured = read(name).measurements
        for channel, step, values in zip(measured.channels, measured.steps, measured.values, strict=True):
            yield RealChannel(f"{name} {channel.name}", channel.dimension, step, from_si(values, channel.unit))
