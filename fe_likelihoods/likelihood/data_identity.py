"""Digests of measurements that do not depend on the excitation in which they are placed.

The measurements of one event are the same data whether the model simulates that event only or the events before it as
well. Evidences of the two models can then be compared. The digests therefore have the times of the event and no missing
samples.
"""

import hashlib
import json
from collections.abc import Sequence

import numpy as np

from ..signals.channels import Measurements
from ..signals.events import find_events
from ..simulation.model import Model

__all__ = ["combined_digest", "data_digests"]


def data_digests(model: Model, measurements: Measurements) -> list[str]:
    """Digests of independent parts of the measurements over the excitation of a model.

    One per measured event if the excitation is `Events` and nothing was measured in the pauses; otherwise one.
    """
    there = ~np.isnan(measurements.values)
    whole = [(-np.inf, np.inf)]
    events = find_events(model)
    windows = whole if events is None else [(window.start, window.end) for window in events.windows]
    times = [measurements.times(channel.name) for channel in measurements.channels]
    # a tenth of a step separates round-off of the times from a sample of the pause
    inside = [
        [(row >= start - 0.1 * dt) & (row <= end + 0.1 * dt) for row, dt in zip(times, measurements.steps, strict=True)]
        for start, end in windows
    ]
    pauses = any(
        (there[row, : len(each)] & ~np.any([part[row] for part in inside], axis=0)).any()
        for row, each in enumerate(times)
    )
    if pauses:
        windows, inside = whole, [[np.ones(len(row), dtype=bool) for row in times]]
    digests = []
    for (start, _), rows in zip(windows, inside, strict=True):
        zero = start if np.isfinite(start) else 0.0
        kept = [rows[i] & there[i, : len(times[i])] for i in range(len(times))]
        if any(row.any() for row in kept):
            digests.append(_digest_of(measurements, times, kept, zero))
    return digests


def combined_digest(digests: Sequence[str]) -> str:
    """One digest for several data sets, in any order; a single digest is returned unchanged."""
    if len(digests) == 1:
        return digests[0]
    return hashlib.blake2b(json.dumps(sorted(digests)).encode(), digest_size=16).hexdigest()


def _digest_of(measurements: Measurements, times: list[np.ndarray], kept: list[np.ndarray], zero: float) -> str:
    """Digest of the kept samples, in any order of the channels, with times after `zero` [s]."""
    parts = []
    for i, (channel, dt) in enumerate(zip(measurements.channels, measurements.steps, strict=True)):
        samples = np.flatnonzero(kept[i])
        if samples.size:
            # in steps, so that the times of a joined record have no round-off
            first = round(float((times[i][samples[0]] - zero) / dt), 5) + 0.0
            state = hashlib.blake2b(digest_size=16)
            state.update(np.asarray(samples - samples[0], dtype="<i8").tobytes())
            state.update(np.asarray(measurements.values[i, samples], dtype="<f8").tobytes())
            parts.append([channel.name, channel.quantity, f"{dt:.9g}", first, state.hexdigest()])
    return hashlib.blake2b(json.dumps(sorted(parts)).encode(), digest_size=16).hexdigest()
