"""Export of the simulations of a cache to an HDF5 file, to archive them with a publication or to copy them.

The file has one data set per quantity with one entry per simulation, and a CRC-32 per data set. The sums of squared
residuals of all simulations are concatenated in ``misfit``, with ``n_channels`` numbers each, and the reasons of
failures, as UTF-8, in ``reason``.
"""

import os
import zlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..signals.hdf5_files import DAMAGE, read_values

__all__ = ["read_rows", "write_rows"]

SCHEMA = "fe_likelihoods.cache"  # a name of the format: it stays when modules are moved
SCHEMA_VERSION = 2
KEY_BYTES = 16
COLUMNS = {
    "key": "u1",
    "source": "<i8",
    "theta": "<f8",
    "n_parameters": "<i8",
    "misfit": "<f8",
    "n_channels": "<i8",
    "n_steps": "<i8",
    "reason": "u1",
    "reason_bytes": "<i8",
    "seconds": "<f8",
}

Row = tuple[bytes, int, bytes, bytes, int, bytes, float]


def write_rows(path: str | os.PathLike, pages: Iterable[list[Row]]) -> int:
    """Write rows to an HDF5 file. An existing file is replaced atomically, so it is never incomplete.

    Parameters
    ----------
    path : path
        The HDF5 file.
    pages : iterable of list of tuple
        Rows (key, source, theta, misfit, n_steps, reason, seconds), with arrays and reason as bytes.

    Returns
    -------
    int
        Number of rows.

    Raises
    ------
    ValueError
        If the folder does not exist.
    OSError
        If the file cannot be written.
    """
    import h5py  # takes longer to import than the rest of the cache

    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"cannot write {path}: there is no folder {path.parent}; create it first")
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
    """Rows of a file that `write_rows` wrote.

    Parameters
    ----------
    path : path
        The HDF5 file.

    Returns
    -------
    list of tuple
        As in `write_rows`.

    Raises
    ------
    ValueError
        If the file does not exist, is not such a file, has another version, or is damaged.
    """
    import h5py

    try:
        with h5py.File(path, "r") as file:
            schema, version = file.attrs.get("schema"), file.attrs.get("schema_version")
            if schema != SCHEMA or version != SCHEMA_VERSION:
                raise ValueError(
                    f"{path}: expected schema {SCHEMA!r} version {SCHEMA_VERSION}, got {schema!r} version {version}; "
                    "expected a file that SimulationCache.export_hdf5 wrote"
                )
            columns = {name: read_values(file[name], path, kind) for name, kind in COLUMNS.items()}
            whole = all(zlib.crc32(values.tobytes()) == file[name].attrs["crc32"] for name, values in columns.items())
    except DAMAGE as error:
        raise ValueError(f"{path}: not a complete export of a cache ({error}); export or copy it again") from error
    if not whole:
        raise ValueError(f"{path}: the contents do not match their checksums; export or copy it again")
    _check_lengths(columns, path)
    keys = columns["key"].tobytes()
    thetas = _split(columns["theta"], 8 * columns["n_parameters"])
    misfits = _split(columns["misfit"], 8 * columns["n_channels"])
    reasons = _split(columns["reason"], columns["reason_bytes"])
    return [
        (
            keys[KEY_BYTES * i : KEY_BYTES * (i + 1)],
            int(columns["source"][i]),
            thetas[i],
            misfits[i],
            int(columns["n_steps"][i]),
            reasons[i],
            float(columns["seconds"][i]),
        )
        for i in range(len(columns["n_steps"]))
    ]


def _check_lengths(columns: dict[str, np.ndarray], path: str | os.PathLike) -> None:
    """Raise ValueError unless all columns belong to the same number of simulations."""
    n = len(columns["n_steps"])
    wanted = dict.fromkeys(COLUMNS, n) | {"key": KEY_BYTES * n}
    for name, sizes in (("theta", "n_parameters"), ("misfit", "n_channels"), ("reason", "reason_bytes")):
        lengths = columns[sizes]
        wanted[name] = int(lengths.sum()) if lengths.size and lengths.min() >= 0 else 0
    bad = [name for name, values in columns.items() if values.shape != (wanted[name],)]
    if bad:
        raise ValueError(
            f"{path}: {bad[0]} has shape {columns[bad[0]].shape}, where {n} simulations need ({wanted[bad[0]]},); "
            "export or copy it again"
        )


def _split(values: np.ndarray, sizes: np.ndarray) -> list[bytes]:
    """Parts of the bytes of an array, of the given sizes [bytes]."""
    data, ends = values.tobytes(), np.cumsum(sizes)
    return [data[end - size : end] for end, size in zip(ends, sizes, strict=True)]


def _columns(page: list[Row]) -> dict[str, np.ndarray]:
    """Values of the data sets for a list of rows."""
    keys, sources, thetas, misfits, n_steps, reasons, seconds = zip(*page, strict=True) if page else ((),) * 7
    columns = {
        "key": np.frombuffer(b"".join(keys), dtype="u1"),
        "source": sources,
        "theta": np.frombuffer(b"".join(thetas), dtype="<f8"),
        "n_parameters": [len(theta) // 8 for theta in thetas],
        "misfit": np.frombuffer(b"".join(misfits), dtype="<f8"),
        "n_channels": [len(misfit) // 8 for misfit in misfits],
        "n_steps": n_steps,
        "reason": np.frombuffer(b"".join(reasons), dtype="u1"),
        "reason_bytes": [len(reason) for reason in reasons],
        "seconds": seconds,
    }
    return {name: np.asarray(values, dtype=COLUMNS[name]) for name, values in columns.items()}
