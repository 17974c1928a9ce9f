r"""Model error in the response of a structure, without the sensor noise. See ``docs/theory/prediction.rst``.

A noise whose standard deviation follows the response (`GaussianNoise` with ``shares_of="response"`` or "measured") has
two parts, the sensor noise, which is no motion of the structure, and the model error: :math:`\sigma^2 = s^2 +
\sigma_m^2`. The likelihood takes both as white, but the largest of many independent errors adds to each peak, while
model errors change as slowly as the response. A draw of the model error therefore has the Fourier amplitudes of the
response, random phases, and the standard deviation :math:`\sigma_m` at each step.
"""

from typing import Any, NamedTuple

import numpy as np

from ..noise.protocol import follows_response, noise_title

__all__ = ["ModelError", "model_error"]


class ModelError(NamedTuple):
    """Model error of every sample; a prediction uses it like a `SampleNoise`."""

    noise: Any
    deviations: np.ndarray  # noise parameters (n, n_noise)
    dt: float  # time step of the responses [s]

    def of_response(self, parameters: np.ndarray, response: np.ndarray) -> np.ndarray:
        """Standard deviations (n_channels, n_steps) [SI] of one sample, without the sensor noise."""
        total = self.noise.response_deviations(parameters, response, dt=self.dt)
        sensor = getattr(self.noise, "sensor", None)
        if sensor is None:
            return total
        return np.sqrt(np.maximum(np.square(total) - np.square(np.array(sensor))[:, None], 0.0))

    def draw(self, sample: int, n_steps: int, rng: np.random.Generator, response: np.ndarray) -> np.ndarray:
        """Draw the error of one sample, shape (n_channels, n_steps) [SI]."""
        parameters, normal = self.deviations[sample], rng.standard_normal(response.shape)
        level = np.sqrt(np.sum(np.square(response), axis=1, keepdims=True))
        spectrum = np.abs(np.fft.rfft(response, axis=1)) / np.where(level > 0.0, level, 1.0)  # of mean square 1
        deviations = self.of_response(parameters, response)
        return deviations * np.fft.irfft(spectrum * np.fft.rfft(normal, axis=1), n=n_steps, axis=1)


def model_error(noise: Any, parameters: np.ndarray, dt: float) -> ModelError:
    """The model error for samples (n, n_noise) of the noise parameters, at a time step of the responses [s].

    The noise needs a method ``response_deviations``, and ``sensor``, the known standard deviations of the sensors or
    None. ValueError if the noise does not follow the response: its levels do not tell the model error from sensor
    noise.
    """
    if not follows_response(noise):
        raise ValueError(
            'noise="model" needs a noise that follows the response, such as GaussianNoise(..., shares_of="response"); '
            f"{noise_title(noise)} does not tell model error from sensor noise: use noise=True, or ratios="
        )
    return ModelError(noise, parameters, dt)
