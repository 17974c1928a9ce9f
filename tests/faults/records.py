"""The record of a run in a file, as the tests of faults read and cut it."""

from pathlib import Path

from samplers.record import BLOCK, MAGIC, Record


def record_of(path):
    """The record beside an HDF5 file."""
    return Path(f"{path}.mcmc.record")


def blocks(path):
    """Kind of each block, and the place in the file where it begins; the start of the run is left out."""
    data, place, found = record_of(path).read_bytes(), len(MAGIC), []
    while place < len(data):
        kind, length, *_ = BLOCK.unpack_from(data, place)
        found.append((kind, place))
        place += BLOCK.size + length
    return found[1:]


def cut(path, place, copy):
    """A copy of a record up to a place, as a kill leaves it, without an HDF5 file."""
    record_of(copy).write_bytes(record_of(path).read_bytes()[:place])
    copy.unlink(missing_ok=True)


def points_of(path):
    """The evaluated points of a record, as bytes."""
    if not record_of(path).exists():
        return []
    record = Record(record_of(path))
    known = record.latest(max(record.count, 1))
    return [] if known is None else [row.tobytes() for row in known.coords]
