"""Samples at equal steps: checks of steps, arrays and time windows, and values at other times.

Between two samples a history follows the fifth-degree polynomial through the three samples before and the three samples
after (Lagrange's form). At a sample it has exactly the value of the sample. For a sine with n samples per period, the
largest error is ``0.31 (pi / n)^6`` of its amplitude: 5e-6 for n = 20, 3e-4 for n = 10. Nothing is filtered.
"""

from __future__ import annotations

import hashlib
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

SAME_TIME = 1e-6  # in steps: times nearer to each other are equal, such as multiples of a rounded step
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
    within = -SAME_TIME * dt <= start < stop <= duration + SAME_TIME * dt
    expect(within, name, f"0 <= start < stop <= {duration:g} s, its duration", f"start = {start}, stop = {stop}")
    first = max(math.ceil(start / dt - SAME_TIME), 0)
    last = min(math.floor(stop / dt + SAME_TIME), n_steps - 1)
    if last - first < 1:
        raise ValueError(f"{start} ... {stop} s keeps fewer than 2 samples of {name!r}, whose step is {dt:g} s")
    return slice(first, last + 1)


def array_digest(*arrays: NDArray[np.float64]) -> str:
    """Return a hex digest (BLAKE2b, 128 bits) of float64 arrays, equal on every machine (little-endian bytes)."""
    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
    return state.hexdigest()


POINTS = 6
"""Number of samples that determine a value between two samples."""


class Interpolation(NamedTuple):
    """Samples and weights that give a history at other times."""

    first: NDArray[np.intp]  # (n_times,) first sample of each polynomial
    weights: NDArray[np.float64] | None  # (n_points, n_times) of this and the next samples; None: all are sample times


def make_interpolation(dt: float, n_steps: int, times: NDArray[np.float64]) -> Interpolation:
    """Return samples and weights for times (n_times,) [s] within a history that begins at time zero."""
    position = np.asarray(times, dtype=float) / dt
    nearest = np.clip(np.rint(position), 0, n_steps - 1)
    same = np.abs(position - nearest) <= SAME_TIME
    if same.all():
        return Interpolation(nearest.astype(np.intp), None)
    position = np.where(same, nearest, position)
    points = min(POINTS, n_steps)
    first = np.clip(np.floor(position).astype(np.intp) - (points // 2 - 1), 0, n_steps - points)
    local = position - first
    weights = np.ones((points, len(position)))
    for k in range(points):
        for j in range(points):
            if j != k:
                weights[k] *= (local - j) / (k - j)
    return Interpolation(first, weights)


def interpolate(history: NDArray[np.float64], at: Interpolation) -> NDArray[np.float64]:
    """Return the values (..., n_times) of histories (..., n_steps)."""
    if at.weights is None:
        return history[..., at.first]
    values = at.weights[0] * history[..., at.first]
    for k in range(1, len(at.weights)):
        values += at.weights[k] * history[..., at.first + k]
    return values


# uneven times, from a clock with jitter or a logger that loses packets ------------------------------------------------

_GAP = 1.5  # usual steps between two samples, from which on samples are missing: nearer to two than to one
_NEAR = 0.1  # usual steps from a sample, within which a time beside a gap has its value
_MOST_REPEATED = 0.05  # share of rows that repeat a time; more are the times of packets
_LARGEST_DIFFERENCE = 0.05  # relative, of the new step from the usual one


class UniformTimes(NamedTuple):
    """Times with a uniform step instead of uneven ones."""

    times: NDArray[np.float64]  # (n_samples,) uneven [s]
    step: float  # [s]
    uniform: NDArray[np.float64]  # (n_steps,) from the first uneven time on [s]
    usual: float  # mean step without gaps [s]
    gaps: NDArray[np.float64]  # (n_gaps,) lengths [s]
    note: str  # what is done, for the description of the data
    kept: NDArray[np.bool_]  # (n_rows,) samples that are used: of those with equal times the first

    def interpolate(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Values (n_steps,) at the uniform times, linear between known samples, NaN in gaps and beyond the last."""
        known = ~np.isnan(values[self.kept])
        values, times = values[self.kept][known], self.times[known]
        if times.size == 0:
            return np.full(self.uniform.size, np.nan)
        after = np.searchsorted(times, self.uniform).clip(0, times.size - 1)
        before = (after - 1).clip(0)
        ahead, behind = times[after] - self.uniform, self.uniform - times[before]
        nearest = np.where(np.abs(ahead) < np.abs(behind), after, before)
        found = np.interp(self.uniform, times, values)
        apart = (ahead + behind > _GAP * self.usual) | (ahead < 0.0) | (behind < 0.0)
        near = np.minimum(np.abs(ahead), np.abs(behind)) <= _NEAR * self.usual
        return np.where(apart, np.where(near, values[nearest], np.nan), found)


def uniform_times(times: NDArray[np.float64], step: float | None, where: str) -> UniformTimes:
    """Times with the uniform `step` [s] from the first to the last of the given times (n_samples,) [s].

    The default is a whole number of samples per second near the usual step, else this step; ValueError for a step that
    differs by more than 5 %, which would need a filter. Of a few samples with equal times the first one is used.
    """
    step = None if step is None else check_step(step, f"resample of {where}")
    kept = np.concatenate([[True], np.diff(times) != 0.0])
    kept |= np.count_nonzero(~kept) > _MOST_REPEATED * times.size
    repeated, first_repeated, times = np.count_nonzero(~kept), times[np.argmin(kept)], times[kept]
    increments = np.diff(times, append=np.inf if times.size > 1 else -np.inf)
    place = int(np.argmin(increments > 0.0))
    got = f"{times[(place + 1) % times.size]:.15g} s after {times[place]:.15g} s"
    advice = "if the times are of packets, leave the column of times out and give dt="
    advice += "; if the clock was set back, correct the later times"
    expect(increments[place] > 0.0, where, "times that increase", got, advice)
    increments = increments[:-1]
    usual = float(increments[increments <= _GAP * np.median(increments)].mean())
    if step is None:
        whole = 1.0 / max(round(1.0 / usual), 1) if usual > 1e-9 else usual
        step = whole if abs(whole - usual) < 0.999 * _LARGEST_DIFFERENCE * usual else usual
    advice = "resample the record or decimate the measurements afterwards"
    nominal = abs(step - usual) <= _LARGEST_DIFFERENCE * usual
    expect(nominal, where, f"the nominal step of the samples, about {usual:.4g} s", f"resample={step:g}", advice)
    gaps, others = (increments[chosen] for chosen in (increments > _GAP * usual, increments <= _GAP * usual))
    note = f"interpolated linearly to a step of {step:g} s from steps of {others.min():.4g} to {others.max():.4g} s"
    note += f", with {gaps.size} gap(s) of up to {gaps.max():.4g} s" if gaps.size else ""
    note += f", without {repeated} row(s) of a repeated time, the first at {first_repeated:g} s" if repeated else ""
    duration = times[-1] - times[0]
    got = f"{times.size} in {duration:.4g} s with a gap of {gaps.max(initial=0.0):.4g} s"
    expect(duration <= 2 * times.size * step, where, "samples at most times", got, "cut the file at its long gaps")
    uniform = times[0] + step * np.arange(int(duration / step + SAME_TIME) + 1)
    return UniformTimes(times, step, uniform, usual, gaps, note, kept)
