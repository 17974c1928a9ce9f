"""Unknown time shifts of channels: the clock of a logger that is not that of the excitation.

The equations are on the page ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from ..signals.channels import Channel
from ..signals.interpolation import POINTS
from .gaussian import GaussianNoise, Noise, SharedGaussianNoise, as_number
from .sample_counts import SampleCounts

__all__ = ["TimeShiftNoise"]


@dataclass(frozen=True)
class TimeShiftNoise:
    """White noise with an unknown time shift of some channels.

    A sample at the time t is compared with the response at t - shift: with a positive shift, the measurement is later
    than the response.

    Parameters
    ----------
    noise : GaussianNoise or SharedGaussianNoise
        The noise of the samples.
    time_shifts : mapping of str to float
        Largest shift in both directions [s], by the names of the channels that are shifted. The prior of a shift must
        be within it.
    dt : float
        Time step of the model's response [s].

    Raises
    ------
    ValueError
        For another noise, an unknown channel, or a largest shift that is not positive.

    Notes
    -----
    The shift needs no simulation: the statistics of a simulation are sums over all lags of interest. With the residuals
    e_k at a lag of k steps, the residual at a shift between two lags is sum_i w_i e_(k+i), with the weights w_i of the
    polynomial of fifth degree through six lags, and its sum of squares is sum_ij w_i w_j G_(k+i, k+j) with
    G_kl = sum_t e_k e_l. The sums G of neighbouring lags are sufficient.

    So that every shift compares the same samples, those within the largest shift of all channels, and three further
    steps, of an end of the response are left out of the shifted channels.

    Examples
    --------
    >>> noise = TimeShiftNoise(GaussianNoise(model.channels), {"top": 0.05}, model.dt)
    >>> prior["time_shift_top"] = Uniform(-0.05, 0.05)
    >>> posterior = Posterior(FELikelihood(model, measurements, noise), prior)
    """

    noise: GaussianNoise | SharedGaussianNoise
    shifts: tuple[tuple[str, float], ...]
    dt: float

    def __init__(self, noise: GaussianNoise | SharedGaussianNoise, time_shifts: Mapping[str, float], dt: float) -> None:
        if not isinstance(noise, GaussianNoise | SharedGaussianNoise):
            raise ValueError(
                f"TimeShiftNoise expects a GaussianNoise or a SharedGaussianNoise; got {noise!r}. For errors "
                "correlated in time, and for standard deviations that are integrated out, estimate the shift with "
                "align(response, measurements), correct it with Measurements.shift(-lag), and use the noise without "
                "TimeShiftNoise"
            )
        names = [channel.name for channel in noise.channels]
        if not isinstance(time_shifts, Mapping):
            raise ValueError(
                f"TimeShiftNoise expects the largest shifts [s] by the names of channels, such as {{{names[0]!r}: "
                f"0.05}}; got {time_shifts!r}"
            )
        unknown = sorted(set(time_shifts) - set(names))
        if unknown or not time_shifts:
            raise ValueError(
                f"TimeShiftNoise expects the largest shifts of some of the channels {', '.join(names)}; got "
                f"{dict(time_shifts)!r}"
            )
        shifts = tuple(
            (name, as_number(self, "time_shifts", time_shifts[name], "[s]")) for name in names if name in time_shifts
        )
        dt = as_number(self, "dt", dt, "[s]")
        if not all(0.0 < shift < math.inf for _, shift in shifts) or not 0.0 < dt < math.inf:
            raise ValueError(
                f"TimeShiftNoise expects positive largest shifts and a positive step, in seconds; got {dict(shifts)!r} "
                f"and {dt!r}"
            )
        object.__setattr__(self, "noise", noise)
        object.__setattr__(self, "shifts", shifts)
        object.__setattr__(self, "dt", dt)

    @property
    def channels(self) -> Sequence[Channel]:
        """Channels of the noise."""
        return self.noise.channels

    @property
    def time_shifts(self) -> dict[str, float]:
        """Largest shift of each shifted channel [s]."""
        return dict(self.shifts)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of the noise, then ``time_shift_<channel>`` [s]."""
        return (*self.noise.parameter_names, *(f"time_shift_{name}" for name, _ in self.shifts))

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of the errors of every channel (n, n_channels), from parameters (n, n_noise)."""
        return self.noise.standard_deviations(np.asarray(parameters, dtype=float)[..., : self._n_noise])

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> tuple[Noise, np.ndarray]:
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`.

        A measured channel keeps its unknown shift, another one has none.
        """
        noise, of_noise = self.noise.with_channels(channels, weights)
        names = [channel.name for channel in channels]
        kept = [k for k, (name, _) in enumerate(self.shifts) if name in names]
        matrix = block_diag(of_noise, np.eye(len(self.shifts))[kept])
        return (TimeShiftNoise(noise, dict(self.shifts[k] for k in kept), self.dt) if kept else noise), matrix

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        statistics : (n, n_numbers) float
            Sums of squared residuals of all channels at a shift of zero, then those of
            `fe_likelihoods.signals.comparison.Lags.sums` [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel.
        parameters : (n, n_noise) float
            Parameters of the noise, then the shifts [s].

        Returns
        -------
        (n,) float
            As that of the noise; -inf also where a shift is larger than the largest one.
        """
        parameters = np.asarray(parameters, dtype=float)
        largest = np.array([shift for _, shift in self.shifts])
        possible = (np.abs(parameters[:, self._n_noise :]) <= largest).all(axis=1)
        values = self.noise.log_likelihood(
            self.misfit(statistics, parameters), n_samples, parameters[:, : self._n_noise]
        )
        return np.where(possible, values, -np.inf)

    def misfit(self, statistics: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Sums of squared residuals (n, n_channels) at the shifts of `parameters`, both as for `log_likelihood`."""
        statistics, parameters = np.asarray(statistics, dtype=float), np.asarray(parameters, dtype=float)
        n_channels = len(self.channels)
        misfit = statistics[:, :n_channels].copy()
        sums = statistics[:, n_channels:].reshape(len(statistics), -1, POINTS, n_channels)
        names = [channel.name for channel in self.channels]
        for k, (name, largest) in enumerate(self.shifts):
            shift, channel = parameters[:, self._n_noise + k], names.index(name)
            misfit[:, channel] = _misfit_at(sums[..., channel], np.clip(shift, -largest, largest) / self.dt)
        return misfit

    @property
    def _n_noise(self) -> int:
        return len(self.noise.parameter_names)


def _misfit_at(sums: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Sum of squares (n,) at shifts `steps` (n,), in steps, of sums (n, n_lags, POINTS) of products."""
    n_lags = sums.shape[1]
    position = steps + n_lags // 2
    first = np.clip(np.floor(position).astype(int) - (POINTS // 2 - 1), 0, n_lags - POINTS)
    local = position - first
    weights = np.ones((POINTS, len(steps)))
    for k in range(POINTS):
        for j in range(POINTS):
            if j != k:
                weights[k] *= (local - j) / (k - j)
    rows, total = np.arange(len(steps)), np.zeros(len(steps))
    for i in range(POINTS):
        for j in range(POINTS - i):
            total += (1.0 if j == 0 else 2.0) * weights[i] * weights[i + j] * sums[rows, first + i, j]
    return np.where(np.isfinite(total), np.maximum(total, 0.0), np.nan)
