"""Formats of seismology that the package obspy reads: miniSEED, SAC, GSE2."""

import io
from pathlib import Path

import numpy as np

from .smc_geonet_knet_esm_formats import recognise
from .text_files import Series, read_bytes

__all__ = ["parse_obspy"]

_FORMATS = {"miniSEED": "MSEED", "SAC": "SAC", "GSE2": "GSE2"}  # names in `recognise` and in obspy
_NO_ACCELERATION = {6: "displacement", 7: "velocity"}  # IDEP in a SAC header


def parse_obspy(path: str | Path, channel: str | None) -> Series:
    """Return the samples of one trace (see `fe_likelihoods.signals.read.read_obspy`)."""
    try:
        import obspy
    except ImportError as error:
        raise ValueError(
            f"reading {path} needs the package obspy: install it with pip install obspy, or write the record as CSV"
        ) from error
    content = read_bytes(path)
    form = _FORMATS.get(recognise(content)[0])
    if form is None:
        raise ValueError(f"{path}: expected a file in {', '.join(_FORMATS)}")
    try:
        # by name: obspy would also find formats such as pickle, which runs code of the file
        stream = obspy.read(io.BytesIO(content), format=form).merge()
        traces = [trace for trace in stream if channel is None or trace.id.endswith(channel)]
    except Exception as error:  # a damaged file may raise anything
        raise ValueError(f"{path}: obspy cannot read the file ({error}); download it again") from error
    if len(traces) != 1:
        raise ValueError(
            f"{path}: expected one trace with channel = {channel!r}, found {len(traces)}; the traces are "
            f"{', '.join(trace.id for trace in stream)}"
        )
    (trace,) = traces
    if np.ma.is_masked(trace.data):
        raise ValueError(
            f"{path}: {trace.id} lacks {np.ma.count_masked(trace.data)} samples; an excitation needs all samples: cut "
            "the record, or fill the gaps in obspy"
        )
    if not np.issubdtype(trace.data.dtype, np.floating):
        raise ValueError(
            f"{path}: the samples of {trace.id} are whole numbers, counts of a recorder; remove the response of the "
            "instrument in obspy, stream.remove_response(inventory, output='ACC'), and write the file again"
        )
    quantity = _NO_ACCELERATION.get(trace.stats.get("sac", {}).get("idep"))
    if quantity is not None:
        raise ValueError(
            f"{path}: expected acceleration, the SAC header of {trace.id} says {quantity}; differentiate it"
        )
    rate = round(1.0 / trace.stats.delta)  # SAC has the step in single precision
    dt = 1.0 / rate if rate and abs(rate * trace.stats.delta - 1.0) < 1e-6 else trace.stats.delta
    return Series(f"{trace.id}", float(dt), None, np.asarray(trace.data, dtype=np.float64))
