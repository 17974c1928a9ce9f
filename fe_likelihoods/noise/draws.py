"""Draws of measurement errors, given the noise parameters."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .protocol import noise_title


class SampleNoise(NamedTuple):
    """Noise of every parameter sample; steps outside the events have no noise.

    A noise that depends on the response has its parameters (n, n_noise) as `deviations`. `of_response` takes the
    parameters (n_noise,) and the response (n_channels, n_steps) of a sample and returns standard deviations of this
    shape [SI].
    """

    deviations: np.ndarray  # (n, n_channels) or (n, n_events, n_channels) [SI]
    lag_one: np.ndarray | None  # (n, n_channels) correlation of successive errors, None for white noise
    events: tuple[slice, ...] = ()  # steps of each event, for standard deviations per event
    of_response: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None

    def over_time(self, levels: np.ndarray, n_steps: int) -> np.ndarray:
        """Values at all steps, shape (n_channels, n_steps) or (n_channels, 1), from the levels of one sample."""
        if not self.events:
            return levels[:, None]
        values = np.zeros((levels.shape[1], n_steps))
        for level, steps in zip(levels, self.events, strict=True):
            values[:, steps] = level[:, None]
        return values

    def draw(
        self, sample: int, n_steps: int, rng: np.random.Generator, response: np.ndarray | None = None
    ) -> np.ndarray:
        """Draw the errors of one sample, shape (n_channels, n_steps) [SI].

        The response (n_channels, n_steps) of the sample is needed if the noise depends on it.
        """
        n_channels = self.deviations.shape[-1] if response is None else len(response)
        errors = rng.standard_normal((n_channels, n_steps))
        if self.lag_one is not None:
            from scipy.signal import lfilter  # imported here because it is slow to import and rarely needed

            for row, rho in zip(errors, self.lag_one[sample], strict=True):
                # e_t = rho e_{t-1} + sqrt(1 - rho^2) z_t is stationary: e_0 has the same variance as the others.
                row[1:] *= np.sqrt((1.0 - rho) * (1.0 + rho))
                row[:] = lfilter([1.0], [1.0, -rho], row)
        if self.of_response is not None:
            return self.of_response(self.deviations[sample], response) * errors
        return self.over_time(self.deviations[sample], n_steps) * errors


def sample_noise(noise: Any, parameters: np.ndarray, n_channels: int, dt: float | None = None) -> SampleNoise:
    """Noise of samples with parameters (n, n_noise), with levels for the whole measurements or by the response.

    A level that depends on the response needs its time step `dt` [s]; without it, ``noise.standard_deviations`` of the
    measurements are used. Raises ValueError if the noise cannot be drawn from, or has impossible standard deviations or
    correlations.
    """
    if not hasattr(noise, "standard_deviations"):
        raise ValueError(
            f"{noise_title(noise)} cannot be drawn from: give it a method standard_deviations(parameters (n, "
            "n_parameters)) that returns (n, n_channels) in SI units"
        )
    deviations = np.asarray(noise.standard_deviations(parameters), dtype=float)
    if deviations.shape != (len(parameters), n_channels) or not np.all((deviations > 0) & (deviations < np.inf)):
        raise ValueError(
            f"the noise needs a positive standard deviation for each of {len(parameters)} samples and {n_channels} "
            f"channels; got shape {deviations.shape}, smallest {deviations.min(initial=np.inf)}"
        )
    if dt is not None and hasattr(noise, "response_deviations"):
        deviations_of = partial(noise.response_deviations, dt=dt)
        return SampleNoise(parameters, None, of_response=deviations_of)
    if not hasattr(noise, "lag_one_correlations"):
        return SampleNoise(deviations, None)
    lag_one = np.asarray(noise.lag_one_correlations(parameters), dtype=float)
    if lag_one.shape != deviations.shape or not np.all(np.abs(lag_one) < 1.0):
        raise ValueError(
            f"the noise needs a correlation between -1 and 1 for each of {len(parameters)} samples and {n_channels} "
            f"channels; got shape {lag_one.shape}, largest {np.abs(lag_one).max(initial=0.0)}"
        )
    return SampleNoise(deviations, lag_one)
