"""Checks of time steps, sample arrays and time windows, shared by records, measurements and predictions."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "array_digest",
    "as_number",
    "check_samples",
    "check_step",
    "expect",
    "rest_samples",
    "same_step",
    "sample_window",
]

_TIME_TOLERANCE = 1e-9  # in steps: round-off in times that are multiples of the step
_STEP_TOLERANCE = 1e-9  # relative difference up to which two steps are equal


def expect(fits: object, where: object, expected: str, got: object = None, advice: str = "") -> None:
    """ValueError that says what was expected in a file, what came and what to do, unless it `fits`."""
    if not fits:
        came = "" if got is None else f", got {got}"
        raise ValueError(f"{where}: expected {expected}{came}" + (f"; {advice}" if advice else ""))


def check_samples(values: ArrayLike, what: str, name: str) -> NDArray[np.float64]:
    """Return a read-only float64 copy (n_steps,) of the samples, at least two finite numbers; ValueError otherwise."""
    where, masked = f"{what} of {name!r}", np.ma.count_masked(values) if np.ma.is_masked(values) else 0
    expect(not np.iscomplexobj(values), where, "real numbers", "complex ones")
    expect(not masked, where, "all samples", f"{masked} masked ones", "interpolate them, or cut the data")
    try:
        samples = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{where}: expected an array of numbers, got {error}") from None
    fits = samples.ndim == 1 and samples.size > 1
    expect(fits, where, "one dimension with 2 samples or more", f"shape {samples.shape}")
    bad = np.flatnonzero(~np.isfinite(samples))
    first = "".join(f"{k} ({samples[k]})" for k in bad[:1])
    got = f"{bad.size} of {samples.size} that are not, the first is sample {first}"
    expect(not bad.size, where, "finite samples", got, "repair or cut the data")
    samples.flags.writeable = False
    return samples


def as_number(value: Any) -> float:
    """Return a value as a float, NaN if it is no number."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return math.nan


def check_step(dt: float, name: str) -> float:
    """Return the time step [s] as a float; raise ValueError unless it is positive and finite."""
    step = as_number(dt)
    if not (math.isfinite(step) and step > 0):
        raise ValueError(f"time step of {name!r} must be a positive number of seconds, got {dt!r}")
    return step


def rest_samples(rest: float, dt: float) -> int:
    """Return the number of zero samples in a pause of `rest` seconds between two records with the step `dt` [s].

    Raises ValueError if the pause is negative, so that the events would overlap, or not a finite number.
    """
    seconds = as_number(rest)
    if not (math.isfinite(seconds) and seconds >= 0.0):
        overlap = ": the events would overlap" if seconds < 0.0 else ""
        raise ValueError(f"the pause between two records must be zero or more seconds, got {rest!r}{overlap}")
    return round(seconds / dt)


def same_step(dt: float, other_dt: float) -> bool:
    """Return whether two time steps [s] are equal within round-off."""
    return not abs(dt - other_dt) > _STEP_TOLERANCE * dt


def sample_window(name: str, n_steps: int, dt: float, start: float, stop: float | None) -> slice:
    """Return the slice of the samples between `start` and `stop` [s], both included; None is the end of the series.

    The first sample is at time zero. Raises ValueError if times are out of order or outside of the series, or fewer
    than two samples remain.
    """
    duration = (n_steps - 1) * dt
    stop = duration if stop is None else stop
    slack = _TIME_TOLERANCE * dt
    within = -slack <= start < stop <= duration * (1 + 1e-12) + slack
    expect(within, name, f"0 <= start < stop <= {duration:g} s, its duration", f"start = {start}, stop = {stop}")
    first = max(math.ceil(start / dt - _TIME_TOLERANCE), 0)
    last = min(math.floor(stop / dt + _TIME_TOLERANCE), n_steps - 1)
    if last - first < 1:
        raise ValueError(f"{start} ... {stop} s keeps fewer than 2 samples of {name!r}, whose step is {dt:g} s")
    return slice(first, last + 1)


def array_digest(*arrays: NDArray[np.float64]) -> str:
    """Return a hex digest (BLAKE2b, 128 bits) of float64 arrays, equal on every machine (little-endian bytes)."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return state.hexdigest()
