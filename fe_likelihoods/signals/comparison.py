"""Comparison of a model response with measurements that have gaps, or other sample times than the response.

Each channel is compared at the times at which it was measured; missing samples have residuals of NaN. The response is
interpolated there without a filter, even for channels sampled more coarsely: a filter would remove motion that the
sensor has measured, and the noise of thinned white samples stays white.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .channels import Measurements
from .interpolation import Interpolation, interpolate, make_interpolation
from .sampling import expect, same_step

__all__ = ["Comparison", "compare_with", "measured_values", "relative_errors", "rrmse"]

_LATEST = 1e-6  # in steps: how far a sample may be after the end of the response, for round-off


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measurements that have gaps, or other sample times than a response, prepared for this response."""

    values: NDArray[np.float64]  # (n_channels, n_samples) [SI], NaN where there is none
    places: tuple[Interpolation | None, ...]  # per channel; None if it has the times of the response

    @property
    def description(self) -> str:
        """Whether the response of a channel is evaluated between its samples, for fingerprints."""
        between = any(place is not None and place.weights is not None for place in self.places)
        return " interpolated by six points" if between else ""

    @cached_property
    def missing(self) -> NDArray[np.bool_]:
        """Whether a sample is missing, shape (n_channels, n_samples)."""
        return np.isnan(self.values)

    def at_samples(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the response (n_channels, n_steps) at the sample times, shape (n_channels, n_samples)."""
        if all(place is None for place in self.places):
            return response
        rows = zip(response, self.places, strict=True)
        n = self.values.shape[1]
        return np.stack([row[:n] if place is None else interpolate(row, place) for row, place in rows])

    def residuals(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return response minus measurement, shape (n_channels, n_samples) [SI], NaN where a sample is missing."""
        return np.ascontiguousarray(self.at_samples(response) - self.values)  # as for a complete response

    def known_residuals(self, response: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return `residuals` with zero where a sample is missing."""
        residuals = self.residuals(response)
        residuals[self.missing] = 0.0
        return residuals


def compare_with(measurements: Measurements, dt: float, n_steps: int) -> NDArray[np.float64] | Comparison:
    """Return the measured values (n_channels, n_steps) if every response sample has one, else a `Comparison`.

    Measurements with the step of the response [s] need as many samples, some of them NaN; with other steps or starts
    they must end within one step before the end of the response, so that a wrong step raises ValueError.
    """
    end = (n_steps - 1) * dt
    _check_end(measurements, dt, n_steps)
    places: list[Interpolation | None] = []
    for row, channel in enumerate(measurements.channels):
        step, start = measurements.steps[row], measurements.starts[row]
        if start == 0.0 and n_steps == measurements.n_steps and same_step(dt, step):
            places.append(None)
            continue
        times = measurements.times(channel.name)
        there = np.isfinite(measurements.values[row])
        known = times[there]
        got = f"samples of channel {channel.name!r} from {known[0]:g} to {known[-1]:g} s"
        advice = "correct their start, or replace the samples before zero by NaN (in a TOML file missing = "
        advice += f"[[{known[0]:g}, {-0.5 * step:g}]])"
        expect(known[0] >= -_LATEST * dt, "measurements", f"times of the response, 0 to {end:g} s", got, advice)
        # a missing sample may be outside the response: any place within serves
        places.append(make_interpolation(dt, n_steps, np.where(there, times, known[0])))
    if all(place is None for place in places) and not np.isnan(measurements.values).any():
        return measurements.values
    return Comparison(measurements.values, tuple(places))


def _check_end(measurements: Measurements, dt: float, n_steps: int) -> None:
    """Raise ValueError if the measurements do not end with the response."""
    begin, end, last = min(measurements.starts), (n_steps - 1) * dt, measurements.end
    if begin > end:
        raise ValueError(
            f"the response ends at {end:g} s, and the measurements begin at {begin:g} s; give the time in their file "
            'at which the excitation begins, as zero=12.5 or zero="10:32:07" of read_columns (zero in a TOML file)'
        )
    if measurements.simultaneous and measurements.start == 0.0 and same_step(dt, measurements.dt):
        fits = measurements.n_steps == n_steps
    else:
        # missing samples at the end count: they say that the end was not measured. Channels with fewer samples than
        # others are filled with NaN, so only the channel whose rows end first states the end.
        stated = max(last, min(float(measurements.times(channel.name)[-1]) for channel in measurements.channels))
        fits = last <= end + _LATEST * dt and stated >= end - (1.0 + _LATEST) * max(dt, *measurements.steps)
    expected = f"{n_steps} samples with a step of {dt} s up to {end:g} s, as the response has"
    got = f"{measurements.n_steps} with a step of {measurements.dt} s up to {last:g} s"
    advice = "use the same part of record and measurements (trim in Python, duration in a TOML file), correct the step,"
    expect(fits, "measurements", expected, got, f"{advice} or fill times that were not measured with NaN")


def measured_values(measured: NDArray[np.float64] | Comparison) -> NDArray[np.float64]:
    """Return the measured values (n_channels, n_samples) [SI], with zero where a sample is missing."""
    return np.nan_to_num(measured.values, nan=0.0) if isinstance(measured, Comparison) else measured


def rrmse(
    predicted: ArrayLike, measured: ArrayLike, names: Sequence[str] | None = None
) -> NDArray[np.float64] | np.float64:
    r"""Relative root mean square error of predicted histories.

    .. math:: \mathrm{RRMSE} = \sqrt{\frac{\sum_k (\hat y_k - y_k)^2}{\sum_k y_k^2}}

    Parameters
    ----------
    predicted : (..., n_steps) array_like
        Predicted values :math:`\hat y`.
    measured : (..., n_steps) array_like
        Measured values :math:`y` in the same unit, of the same shape. Samples that are NaN are left out of the sums.
    names : sequence of str, optional
        Names of the histories, for the message of an error.

    Returns
    -------
    ndarray, shape (...,)
        The error of each history [-]: 0 for a perfect prediction, 1 for a prediction of zero.

    Raises
    ------
    ValueError
        If the shapes differ, or a measured history has no sample or only zeros.

    Examples
    --------
    >>> round(float(rrmse([1.1, 2.2], [1.0, 2.0])), 3)
    0.1
    """
    predicted, measured = np.asarray(predicted, dtype=float), np.asarray(measured, dtype=float)
    got = f"{predicted.shape} and {measured.shape}"
    expect(predicted.shape == measured.shape and measured.ndim, "rrmse", "histories of one shape, (..., n_steps)", got)
    zero = np.flatnonzero(np.nansum(np.square(measured), axis=-1) == 0.0)
    rows = ", ".join(f"row {row}" if names is None else repr(names[row]) for row in zero)
    expect(not rows, "rrmse", "measured histories that are not zero", f"{rows} is zero at all samples", "leave it out")
    unknown = (np.isnan(predicted) & ~np.isnan(measured)).any(axis=-1)
    return np.where(unknown, np.nan, relative_errors(predicted - measured, measured))[()]


def relative_errors(residuals: np.ndarray, measured: np.ndarray) -> NDArray[np.float64]:
    """RRMSE (...,) of residuals (..., n_steps); NaN is left out, and a measured history of zeros has the error NaN."""
    there = np.isfinite(residuals) & np.isfinite(measured)
    squares, power = (np.square(np.where(there, each, 0.0)).sum(axis=-1) for each in (residuals, measured))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(np.where(power > 0.0, squares / power, np.nan))
