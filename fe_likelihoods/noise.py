"""What separates a measured response from a simulated one, as a probability.

The measurement is the simulated response plus an error. For an error that is Gaussian, independent from channel to
channel and from sample to sample, the likelihood needs the simulation only through the sums of squared residuals, one
number J per channel: they are a sufficient statistic. So a noise takes J, not the response, and a change of the
standard deviations alone costs no simulation.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .channels import Channel, Measurements

__all__ = ["GaussianNoise", "SharedGaussianNoise"]


@dataclass(frozen=True)
class GaussianNoise:
    """Independent white Gaussian noise, one unknown standard deviation per channel.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.

    Notes
    -----
    Equations (2) and (3) of Ramancha et al., Bayesian nonlinear finite element model updating of a full-scale
    bridge-column using sequential Monte Carlo: with n samples in channel c and the residuals' sum of squares J_c, ::

        log L = sum_c [ -n/2 log(2 pi) - n log(sigma_c) - J_c / (2 sigma_c^2) ]
    """

    channels: tuple[Channel, ...]

    def __init__(self, channels: Sequence[Channel]) -> None:
        object.__setattr__(self, "channels", tuple(channels))
        if not self.channels:
            raise ValueError("GaussianNoise expects at least one channel; got none")

    def __repr__(self) -> str:
        # display units change nothing, so they do not enter
        return f"GaussianNoise({', '.join(f'{channel.name}: {channel.quantity}' for channel in self.channels)})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>``: standard deviations, each in the SI unit of its channel."""
        return tuple(f"sigma_{channel.name}" for channel in self.channels)

    def log_likelihood(self, misfit: np.ndarray, n_steps: int, sigma: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        misfit : (n, n_channels) float
            Sums over the samples of squared residuals [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_steps : int
            Number of samples in each channel.
        sigma : (n, n_channels) float
            Standard deviations of the noise [SI unit of the channel].

        Returns
        -------
        (n,) float : -inf where a sigma is not a positive number or the misfit is NaN or infinite, never NaN.
        """
        return _log_likelihood(misfit, n_steps, np.asarray(sigma, dtype=float))

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of every channel [SI], (n, n_channels), from the noise's parameters (n, n_channels)."""
        return np.asarray(parameters, dtype=float)


@dataclass(frozen=True)
class SharedGaussianNoise:
    """Independent white Gaussian noise, one unknown standard deviation for all channels, each in units of its scale.

    Channels of different dimensions can only share a dimensionless sigma: the standard deviation of channel c is
    sigma times its scale. `of` takes the root mean square of the measured channel, so that sigma is the share of noise.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    scales : sequence of float
        One for each channel [SI unit of the channel], positive.

    Raises
    ------
    ValueError
        If there is not one positive scale for each channel.

    Notes
    -----
    specs/isolated_bridge.md, section 5: the isolated bridge's paper has "the same sigma for all the measured response
    time histories". The likelihood is that of the measurements themselves, not of the scaled ones: the logarithms of
    the scales are in it, so that evidences of different noises can be compared.
    """

    channels: tuple[Channel, ...]
    scales: tuple[float, ...]

    def __init__(self, channels: Sequence[Channel], scales: Sequence[float]) -> None:
        object.__setattr__(self, "channels", tuple(channels))
        object.__setattr__(self, "scales", tuple(float(scale) for scale in scales))
        if not self.channels or len(self.scales) != len(self.channels):
            raise ValueError(
                f"SharedGaussianNoise expects one scale for each channel; got {len(self.channels)} channels and "
                f"{len(self.scales)} scales"
            )
        for channel, scale in zip(self.channels, self.scales, strict=True):
            if not (math.isfinite(scale) and scale > 0.0):
                raise ValueError(
                    f"SharedGaussianNoise expects positive scales; got {scale} for channel {channel.name!r}: leave a "
                    "channel that measured nothing out of the measurements, or give its scale"
                )

    @classmethod
    def of(cls, measurements: Measurements) -> "SharedGaussianNoise":
        """With the root mean squares of the measured channels as scales."""
        return cls(measurements.channels, np.sqrt(np.mean(np.square(measurements.values), axis=1)))

    def __repr__(self) -> str:
        named = (f"{c.name}: {c.quantity} / {scale!r}" for c, scale in zip(self.channels, self.scales, strict=True))
        return f"SharedGaussianNoise({', '.join(named)})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma``, dimensionless."""
        return ("sigma",)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of every channel [SI], (n, n_channels), from the noise's parameter (n, 1)."""
        return np.asarray(parameters, dtype=float) * np.array(self.scales)

    def log_likelihood(self, misfit: np.ndarray, n_steps: int, sigma: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        misfit : (n, n_channels) float
            Sums over the samples of squared residuals [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_steps : int
            Number of samples in each channel.
        sigma : (n, 1) float
            Shared standard deviation, in units of the scales.

        Returns
        -------
        (n,) float : -inf where sigma is not a positive number or the misfit is NaN or infinite, never NaN.
        """
        return _log_likelihood(misfit, n_steps, self.standard_deviations(sigma))


def _log_likelihood(misfit: np.ndarray, n_steps: int, sigma: np.ndarray) -> np.ndarray:
    """Of independent Gaussian residuals with standard deviations `sigma` (n, n_channels)."""
    misfit = np.asarray(misfit, dtype=float)
    with np.errstate(all="ignore"):
        # the ratio is squared, not sigma: a tiny sigma squared would be zero, and zero misfit then 0 / 0
        ratio = np.sqrt(misfit) / sigma
        terms = -n_steps * (0.5 * math.log(2.0 * math.pi) + np.log(sigma)) - 0.5 * ratio * ratio
    possible = (sigma > 0.0) & np.isfinite(misfit)
    return np.where(possible, terms, -np.inf).sum(axis=-1)
