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

from .channels import Channel

__all__ = ["GaussianNoise"]


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
        misfit, sigma = np.asarray(misfit, dtype=float), np.asarray(sigma, dtype=float)
        with np.errstate(all="ignore"):
            # the ratio is squared, not sigma: a tiny sigma squared would be zero, and zero misfit then 0 / 0
            ratio = np.sqrt(misfit) / sigma
            terms = -n_steps * (0.5 * math.log(2.0 * math.pi) + np.log(sigma)) - 0.5 * ratio * ratio
        possible = (sigma > 0.0) & np.isfinite(misfit)
        return np.where(possible, terms, -np.inf).sum(axis=-1)
