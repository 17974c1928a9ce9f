"""Samples at uneven times, from a clock with jitter or a logger that loses packets, on times with a uniform step."""

import warnings
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .sampling import check_step

__all__ = ["UniformTimes", "uniform_times"]

_GAP = 1.5  # usual steps between two samples, from which on samples are missing
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
        values = values[self.kept]
        known = np.flatnonzero(~np.isnan(values))
        if known.size == 0:
            return np.full(self.uniform.size, np.nan)
        times = self.times[known]
        after = np.searchsorted(times, self.uniform).clip(0, times.size - 1)
        before = (after - 1).clip(0)
        ahead, behind = times[after] - self.uniform, self.uniform - times[before]
        nearest = np.where(np.abs(ahead) < np.abs(behind), after, before)
        found = np.interp(self.uniform, times, values[known])
        apart = (ahead + behind > _GAP * self.usual) | (ahead < 0.0) | (behind < 0.0)
        near = np.minimum(np.abs(ahead), np.abs(behind)) <= _NEAR * self.usual
        return np.where(apart, np.where(near, values[known][nearest], np.nan), found)

    def straight(self, values: NDArray[np.float64], where: str, stacklevel: int) -> NDArray[np.float64]:
        """Values (n_steps,) at the uniform times, with straight lines over gaps and a warning about them."""
        if self.gaps.size:
            warnings.warn(
                f"{where}: {self.note}; an excitation needs all samples, so the gaps are straight lines: compare with "
                "another record of the motion if a gap is in its strong part",
                UserWarning,
                stacklevel=stacklevel + 1,
            )
        return np.interp(self.uniform, self.times, values[self.kept])


def uniform_times(times: NDArray[np.float64], step: float | None, where: str) -> UniformTimes:
    """Return times with the uniform `step` [s] from the first to the last of the given times (n_samples,) [s].

    The default step is a whole number of samples per second within 5 % of the usual step, else the usual step. Raises
    ValueError if times decrease or many repeat, more than half of the samples are missing, or the step differs from the
    usual one by more than 5 %: that would need a filter (`Record.resample`, `Measurements.decimate`). Of samples with
    equal times the first one is used.
    """
    step = None if step is None else check_step(step, f"resample of {where}")
    kept = np.concatenate([[True], np.diff(times) != 0.0])
    if 0 < (repeated := np.count_nonzero(~kept)) <= _MOST_REPEATED * times.size:
        first_repeated, times = float(times[~kept][0]), times[kept]
    else:
        repeated, kept = 0, np.ones(times.size, dtype=bool)
    increments = np.diff(times)
    if times.size < 2 or not np.all(increments > 0.0):
        place = int(np.argmax(~(increments > 0.0))) if times.size > 1 else 0
        raise ValueError(
            f"{where}: expected times that increase, got {times[min(place + 1, times.size - 1)]:.15g} s after "
            f"{times[place]:.15g} s; if the times are those of packets, leave the column of times out and give dt="
        )
    usual = float(increments[increments <= _GAP * np.median(increments)].mean())
    if step is None:
        whole = 1.0 / max(round(1.0 / usual), 1) if usual > 1e-9 else usual
        step = whole if abs(whole - usual) < 0.999 * _LARGEST_DIFFERENCE * usual else usual
    if abs(step - usual) > _LARGEST_DIFFERENCE * usual:
        raise ValueError(
            f"{where}: expected the nominal step of the samples, about {usual:.4g} s, got resample={step:g}; resample "
            "the record or decimate the measurements afterwards"
        )
    gaps, others = (increments[chosen] for chosen in (increments > _GAP * usual, increments <= _GAP * usual))
    note = f"interpolated linearly to a step of {step:g} s from steps of {others.min():.4g} to {others.max():.4g} s"
    note += f", with {gaps.size} gap(s) of up to {gaps.max():.4g} s" if gaps.size else ""
    note += f", without {repeated} row(s) of a repeated time, the first at {first_repeated:g} s" if repeated else ""
    duration = times[-1] - times[0]
    if duration > 2 * times.size * step:
        raise ValueError(
            f"{where}: expected samples at most times, got {times.size} in {duration:.4g} s with a gap of "
            f"{gaps.max():.4g} s; cut the file at its long gaps"
        )
    uniform = times[0] + step * np.arange(int(duration / step + 1e-6) + 1)
    return UniformTimes(times, step, uniform, usual, gaps, note, kept)
