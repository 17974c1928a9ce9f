"""Simulations of a cache as an HDF5 file: to keep them beside a publication, or to take them to another machine.

One data set a quantity, one entry a simulation, each with its CRC-32. The sums of squared residuals of all
simulations stand behind one another in ``misfit``, ``n_channels`` of them each; reasons of failures likewise, as UTF-8.
"""

import os
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

__all__ = ["read_rows", "write_rows"]

SCHEMA = "fe_likelihoods.cache"  # a name of the format: it stays when modules are moved
SCHEMA_VERSION = 1
KEY_BYTES = 16
COLUMNS = {
    "key": "u1",
    "misfit": "<f8",
    "n_channels": "<i8",
    "n_steps": "<i8",
    "reason": "u1",
    "reason_bytes": "<i8",
    "seconds": "<f8",
}

Row = tuple[bytes, bytes, int, bytes, float]


def write_rows(path: str | os.PathLike, pages: Iterable[list[Row]]) -> int:
    """Write lists of (key, misfit, n_steps, reason, seconds), misfits and reasons as bytes; returns how many.

    A file of that name is replaced at once, and never left half written.

    Raises
    ------
    ValueError
        If the folder does not exist.
    OSError
        If the file cannot be written.
    """
    import h5py  # takes longer to start than the whole cache

    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}; make it first")
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    count, checksums = 0, dict.fromkeys(COLUMNS, 0)
    try:
        with h5py.File(temporary, "w") as file:
            for name, kind in COLUMNS.items():
                file.create_dataset(name, (0,), dtype=kind, maxshape=(None,), chunks=(8192,), compression="gzip")
            for page in pages:
                columns = _columns(page)
                for name, values in columns.items():
                    checksums[name] = zlib.crc32(values.tobytes(), checksums[name])
                    data = file[name]
                    data.resize((len(data) + len(values),))
                    data[len(data) - len(values) :] = values
                count += len(page)
            for name, checksum in checksums.items():
                file[name].attrs["crc32"] = checksum
            file.attrs.update({"schema": SCHEMA, "schema_version": SCHEMA_VERSION})
            file["misfit"].attrs["units"] = "SI units of the channels, squared"
            file["seconds"].attrs["units"] = "s"
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return count


def read_rows(path: str | os.PathLike) -> list[Row]:
    """Rows that `write_rows` wrote.

    Raises
    ------
    ValueError
        If the file is not there, is something else, of another version, or damaged.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            schema, version = file.attrs.get("schema"), file.attrs.get("schema_version")
            if schema != SCHEMA or version != SCHEMA_VERSION:
                raise ValueError(
                    f"{path}: expected schema {SCHEMA!r} version {SCHEMA_VERSION}, got {schema!r} version {version}; "
                    "give a file that SimulationCache.export_hdf5 wrote"
                )
            columns = {name: np.asarray(file[name][()], dtype=kind) for name, kind in COLUMNS.items()}
            whole = all(zlib.crc32(values.tobytes()) == file[name].attrs["crc32"] for name, values in columns.items())
    except (OSError, KeyError, TypeError, RuntimeError) as error:
        raise ValueError(f"{path}: not a complete export of a cache ({error}); make it or fetch it again") from error
    if not whole:
        raise ValueError(f"{path}: the contents do not match their checksums; make it or fetch it again")
    keys, misfits, reasons = (columns[name].tobytes() for name in ("key", "misfit", "reason"))
    ends = [8 * np.cumsum(columns["n_channels"]), np.cumsum(columns["reason_bytes"])]
    starts = [ends[0] - 8 * columns["n_channels"], ends[1] - columns["reason_bytes"]]
    return [
        (
            keys[KEY_BYTES * i : KEY_BYTES * (i + 1)],
            misfits[starts[0][i] : ends[0][i]],
            int(columns["n_steps"][i]),
            reasons[starts[1][i] : ends[1][i]],
            float(columns["seconds"][i]),
        )
        for i in range(len(columns["n_steps"]))
    ]


def _columns(page: list[Row]) -> dict[str, np.ndarray]:
    keys, misfits, n_steps, reasons, seconds = zip(*page, strict=True) if page else ((),) * 5
    columns = {
        "key": np.frombuffer(b"".join(keys), dtype="u1"),
        "misfit": np.frombuffer(b"".join(misfits), dtype="<f8"),
        "n_channels": [len(misfit) // 8 for misfit in misfits],
        "n_steps": n_steps,
        "reason": np.frombuffer(b"".join(reasons), dtype="u1"),
        "reason_bytes": [len(reason) for reason in reasons],
        "seconds": seconds,
    }
    return {name: np.asarray(values, dtype=COLUMNS[name]) for name, values in columns.items()}
