"""What a likelihood and a prediction need of a noise, and the optional members with their defaults."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ..signals.channels import Channel, Measurements
from .sample_counts import SampleCounts

__all__ = [
    "Noise",
    "follows_response",
    "noise_channels",
    "noise_of_part",
    "noise_statistic",
    "noise_time_shifts",
    "noise_title",
    "noise_under",
    "remark_on_gaps",
]


class Noise(Protocol):
    """What a likelihood needs of a noise.

    Two members are required, `parameter_names` and `log_likelihood`. A noise may also have:

    * ``channels``, the measured channels in the order of the statistics; checked against the channels of the model.
    * ``statistic``, a function of a module that takes the residuals (n_channels, n_steps) and returns the numbers
      (n_numbers,) which `log_likelihood` needs, the sums of squares (n_channels,) first. Without it the sums of squares
      are all. Residuals of missing samples are NaN; a statistic without a rule for them is refused with such
      measurements. A statistic with an attribute ``of_response`` that is true also takes the response at the samples,
      as a second argument.
    * ``title``, a short text that names the noise in reports and messages; the name of its class by default.
    * ``standard_deviations(parameters)`` with parameters (n, n_noise), which returns the standard deviation of the
      errors (n, n_channels) [SI]; needed for predictions with noise.
    * ``response_deviations(parameters, response, dt)`` with the parameters (n_noise,) of one sample, which returns the
      standard deviations (n_channels, n_steps) of the errors of a simulated response; used in predictions in place of
      ``standard_deviations`` where the noise depends on the response.
    * ``response_errors(parameters, response, normal, dt, sensor)``, which returns the errors (n_channels, n_steps) made
      of standard normal numbers of that shape, with ``sensor=False`` without sensor noise; for errors that are
      correlated in time and depend on the response.
    * ``whitened(residuals, response, parameters)`` and ``log_densities(residuals, response, parameters)`` at the
      measured samples, for checks of residuals and for the log-likelihood in blocks of time.
    * ``under(model, first)``, which returns the noise under the excitation of a model whose response begins at the step
      ``first``; called by a likelihood with its model, and by a prediction with the model under the predicted record.
    * ``with_measurements(measurements)``, which returns the noise for a part of the measurements; needed where it
      depends on their number or times. A likelihood calls it with its own measurements, after ``under``.
    * ``lag_one_correlations(parameters)``, which returns the correlation of successive errors (n, n_channels); for
      predictions with autoregressive noise.
    * ``with_channels(channels, weights)`` with the weights (n_others, n_channels) of its channels in each of other
      channels, which returns the noise of the other channels for predictions, and the weights (n_others_noise, n_noise)
      of its parameters in the parameters of that noise; for predictions of channels that were not measured.
    * ``remark_on_gaps()``, which returns a sentence on gaps in the measurements that make predictions doubtful, empty
      if there are none. A likelihood warns with it, and predictions with noise have it among their remarks.
    """

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters of the noise."""

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,) of statistics (n, n_numbers) of the residuals at parameters (n, n_noise).

        `n_samples` is the number of samples of every channel; `SampleCounts` for measurements with missing samples. The
        value is -inf where a parameter is impossible, also for statistics of zero.
        """


def noise_channels(noise: Noise, default: Sequence[Channel]) -> tuple[Channel, ...]:
    """Channels of a noise; `default` where the noise does not specify them."""
    return tuple(getattr(noise, "channels", default))


def noise_statistic(noise: Noise) -> Callable[..., np.ndarray] | None:
    """Statistic of the residuals that a noise needs, None for the sums of squares."""
    return getattr(noise, "statistic", None)


def noise_time_shifts(noise: Noise | None) -> Mapping[str, float]:
    """Largest unknown time shifts of channels [s] of the noise of a likelihood, by name; empty without any."""
    return getattr(noise, "time_shifts", None) or {}


def noise_title(noise: Noise) -> str:
    """Short name of a noise with its options, for reports and messages."""
    return getattr(noise, "title", type(noise).__name__)


def noise_of_part(noise: Noise, measurements: Measurements) -> Noise:
    """Noise of a part of the measurements: the same, unless it has a method ``with_measurements``."""
    return noise.with_measurements(measurements) if hasattr(noise, "with_measurements") else noise


def noise_under(noise: Noise, model: Any, first: int = 0) -> Noise:
    """Noise under the excitation of a model: the same, unless it has a method ``under``."""
    return noise.under(model, first) if hasattr(noise, "under") else noise


def remark_on_gaps(noise: Noise) -> str:
    """What a noise says of gaps in its measurements; empty if nothing, or without a method ``remark_on_gaps``."""
    return noise.remark_on_gaps() if hasattr(noise, "remark_on_gaps") else ""


def follows_response(noise: Any) -> bool:
    """Return whether the standard deviation of a noise is a share of the response, which holds for other motions."""
    return hasattr(noise, "response_deviations") and getattr(noise, "level", "") != "si"
