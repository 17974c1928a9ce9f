"""The members that likelihoods and predictions need of a noise: required, and optional with defaults."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from ..signals.channels import Channel, Measurements
from .sufficient_statistics import SampleCounts


class Noise(Protocol):
    """What a likelihood needs of a noise.

    Two members are required, `parameter_names` and `log_likelihood`. A noise may also have:

    * ``channels``, the measured channels in the order of the statistics; checked against the channels of the model.
    * ``statistic``, a module-level function that takes the residuals (n_channels, n_steps) and returns the numbers
      (n_numbers,) which `log_likelihood` needs, the sums of squares (n_channels,) first. Default: the sums of squares
      alone. Residuals of missing samples are NaN; a statistic that does not handle them is refused for measurements
      with gaps. If the statistic has a true attribute ``of_response``, it also takes the response at the samples, as
      second argument.
    * ``title``, a short text that names the noise in reports and messages; the class name by default.
    * ``standard_deviations(parameters)`` with parameters (n, n_noise), which returns the standard deviation of the
      errors (n, n_channels) [SI]; needed for predictions with noise.
    * ``response_deviations(parameters, response, dt)`` with the parameters (n_noise,) of one sample, which returns the
      standard deviations (n_channels, n_steps) of the errors, given a simulated response; used in predictions instead
      of ``standard_deviations`` where the noise depends on the response.
    * ``whitened(residuals, response, parameters)`` at the measured samples, for checks of residuals.
    * ``under(model, first)``, which returns the noise under the excitation of a model whose response begins at the step
      ``first``; called by a likelihood with its model, and by a prediction with the model under the predicted record.
    * ``with_measurements(measurements)``, which returns the noise for a part of the measurements; needed if the noise
      depends on their number or times. A likelihood calls it with all its measurements, after ``under``.
    * ``lag_one_correlations(parameters)``, which returns the correlation of successive errors (n, n_channels); for
      predictions with autoregressive noise.
    * ``with_channels(channels, weights)``, for predictions of channels that were not measured. ``weights`` (n_others,
      n_channels) expresses each new channel by the noise's channels. It returns the noise of the new channels, and the
      weights (n_others_noise, n_noise) that express the new noise's parameters by the parameters of this noise.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the noise parameters."""

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,) for residual statistics (n, n_numbers) at parameters (n, n_noise).

        `n_samples` is the number of samples per channel; `SampleCounts` for measurements with missing samples. The
        value is -inf where a parameter is impossible, also for statistics of zero.
        """


def noise_channels(noise: Noise, default: Sequence[Channel]) -> tuple[Channel, ...]:
    """Channels of a noise; `default` where the noise does not specify them."""
    return tuple(getattr(noise, "channels", default))


def noise_statistic(noise: Noise) -> Callable[..., np.ndarray] | None:
    """Statistic of the residuals that a noise needs, None for the sums of squares."""
    return getattr(noise, "statistic", None)


def noise_title(noise: Noise) -> str:
    """Short name of a noise with its options, for reports and messages."""
    return getattr(noise, "title", type(noise).__name__)


def noise_of_part(noise: Noise, measurements: Measurements) -> Noise:
    """Noise for a part of the measurements: unchanged unless it has a method ``with_measurements``."""
    return noise.with_measurements(measurements) if hasattr(noise, "with_measurements") else noise


def noise_under(noise: Noise, model: Any, first: int = 0) -> Noise:
    """Noise under the excitation of a model: unchanged unless it has a method ``under``."""
    return noise.under(model, first) if hasattr(noise, "under") else noise


def follows_response(noise: Any) -> bool:
    """Whether the standard deviation of a noise is a share of the response, and so is valid for other motions."""
    return hasattr(noise, "response_deviations") and getattr(noise, "shares_of", "") is not None
