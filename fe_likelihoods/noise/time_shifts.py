"""Unknown time shifts of channels, for a data logger whose clock differs from the excitation's clock.

The equations are on the page ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from ..signals.channels import Channel
from ..signals.interpolation import POINTS
from .gaussian import GaussianNoise
from .options import as_number
from .protocol import Noise, noise_title
from .sample_counts import SampleCounts

__all__ = ["ShiftedNoise", "with_time_shifts"]


@dataclass(frozen=True)
class ShiftedNoise:
    """White noise with unknown time shifts of channels, as ``FELikelihood(..., time_shifts=)`` makes it.

    A sample at the time t is compared with the response at t - shift: with a positive shift, the measurement is later
    than the response. The levels of the noise are in SI units per channel or for all channels.

    A changed shift needs no simulation: the statistics of a simulation are sums over all lags of interest. With the
    residuals e_k at a lag of k steps, the residual at a shift between two lags is sum_i w_i e_(k+i), with the weights
    w_i of fifth-degree interpolation between six lags. Its sum of squares is sum_ij w_i w_j G_(k+i, k+j) with G_kl =
    sum_t e_k e_l. The sums G of neighbouring lags are sufficient. Every shift must compare the same samples, so shifted
    channels leave out all samples nearer to an end of the response than the largest shift in any channel plus three
    steps.
    """

    noise: GaussianNoise
    shifts: tuple[tuple[str, float], ...]  # channels and largest shifts in both directions [s]
    dt: float  # time step of the model's response [s]

    @property
    def title(self) -> str:
        """Title of the noise, and the channels with time shifts."""
        return f"{self.noise.title} with time shifts of {', '.join(self.time_shifts)}"

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
        """Standard deviations of the errors (n, n_channels), from parameters (n, n_noise)."""
        return self.noise.standard_deviations(np.asarray(parameters, dtype=float)[..., : self._n_noise])

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> tuple[Noise, np.ndarray]:
        """Noise of other channels, with the weights of the parameters; see `fe_likelihoods.noise.protocol.Noise`.

        Measured channels keep their unknown shifts; other channels have none.
        """
        noise, of_noise = self.noise.with_channels(channels, weights)
        names = [channel.name for channel in channels]
        kept = [k for k, (name, _) in enumerate(self.shifts) if name in names]
        matrix = block_diag(of_noise, np.eye(len(self.shifts))[kept])
        return (ShiftedNoise(noise, tuple(self.shifts[k] for k in kept), self.dt) if kept else noise), matrix

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,), -inf also where a shift exceeds its limit.

        `statistics` (n, n_numbers) are sums of squared residuals at a shift of zero (n_channels), then `Lags.sums` [SI
        unit of the channel, squared], NaN where the simulation failed; `parameters` are those of the noise, then the
        shifts [s].
        """
        parameters = np.asarray(parameters, dtype=float)
        largest = np.array([shift for _, shift in self.shifts])
        possible = (np.abs(parameters[:, self._n_noise :]) <= largest).all(axis=1)
        values = self.noise.log_likelihood(
            self.misfit(statistics, parameters), n_samples, parameters[:, : self._n_noise]
        )
        return np.where(possible, values, -np.inf)

    def misfit(self, statistics: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Sums of squared residuals (n, n_channels) at the shifts in `parameters`; arguments: see `log_likelihood`."""
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


def with_time_shifts(noise: Noise, time_shifts: Mapping[str, float] | None, dt: float) -> Noise:
    """A likelihood's noise with largest unknown time shifts of channels [s]; None keeps the shifts that the noise has.

    `dt` is the step of the response [s]. Raises ValueError for a noise that is not white or not in SI units, an unknown
    channel, or a shift that is not positive.
    """
    if isinstance(noise, ShiftedNoise):
        noise, time_shifts = noise.noise, noise.time_shifts if time_shifts is None else time_shifts
    if time_shifts is None:
        return noise
    if not isinstance(noise, GaussianNoise) or not noise.white:
        raise ValueError(
            "time_shifts= is for white noise in SI units, GaussianNoise(channels) or GaussianNoise(channels, "
            f'groups="all"); got {noise_title(noise)}. For other noises, and for standard deviations that are '
            "integrated out, estimate the shift with align(response, measurements), correct it with "
            "Measurements.shift(-lag, [channel]), and leave time_shifts= out"
        )
    names = [channel.name for channel in noise.channels]
    if not isinstance(time_shifts, Mapping) or not time_shifts or set(time_shifts) - set(names):
        raise ValueError(
            f"time_shifts= expects the largest shifts [s] of some of the channels {', '.join(names)} by name, such as "
            f"{{{names[0]!r}: 0.05}}; got {time_shifts!r}"
        )
    shifts = [
        (name, as_number(noise, "time_shifts", time_shifts[name], "in s")) for name in names if name in time_shifts
    ]
    if not all(0.0 < shift < math.inf for _, shift in shifts):
        raise ValueError(f"time_shifts= expects positive largest shifts, in seconds; got {dict(shifts)!r}")
    return ShiftedNoise(noise, tuple(shifts), dt)


def _misfit_at(sums: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Sum of squared residuals (n,) at shifts `steps` (n,) [steps], from lag products `sums` (n, n_lags, POINTS)."""
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
