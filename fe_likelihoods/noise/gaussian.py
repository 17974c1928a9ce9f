"""Probability models of the error, the difference between a measured and a simulated response.

The errors are Gaussian and independent between channels. The likelihood then needs only a few sums of the residuals
per channel (sufficient statistics): for white noise the sum of squares J, for an autoregressive error two more. A noise
takes these sums instead of the response, so a change of its own parameters needs no simulation. Equations and sources
are on the page ``docs/theory/noise.rst``.

Which noise to take:

========================================================  ==============================================================
``GaussianNoise(channels)``                               Independent errors: synthetic data, thinned measurements.
``AutoregressiveNoise(channels)``                         Correlated errors, with an unknown lag-one correlation per
                                                          channel.
``GaussianNoise(channels, effective_samples=n_eff)``      Correlated errors without more parameters; `n_eff` is
                                                          estimated from residuals.
``SharedGaussianNoise.of(measurements)``                  One unknown standard deviation for all channels.
``ModulatedNoise(channels, window=1.0, sensor=...)``      Shares of the level of the simulated response in time, for
                                                          predictions of weaker or stronger motions and of other tests.
``BandNoise(channels, (1.0, 5.0), sensor=...)``           Errors that are correlated in time: shares of the response in
                                                          bands of frequency, for predictions of other motions.
``RelativeNoise.of(measurements)``                        Standard deviations that are shares of the response levels.
``...Noise(channels, sensor={"top": 0.02})``              Known sensor noise in addition to the unknown model error.
========================================================  ==============================================================

Real measurements differ from a model by more than the noise of a sensor, and the differences are correlated in time.
White noise counts the n samples of a channel as n independent observations, which makes the posterior too narrow. The
module `fe_likelihoods.noise.residuals` has checks of this assumption and estimates the effective number of
samples. `AutoregressiveNoise` is in `fe_likelihoods.noise.autoregressive`, `RelativeNoise` in
`fe_likelihoods.noise.relative`.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..signals.channels import Channel, Measurements
from .sample_counts import SampleCounts, samples_per_channel

__all__ = [
    "GaussianNoise",
    "Noise",
    "SharedGaussianNoise",
    "as_number",
    "noise_channels",
    "noise_of_part",
    "noise_statistic",
    "noise_time_shifts",
    "noise_under",
    "remark_on_gaps",
    "numbers",
    "options_repr",
    "set_channels",
    "set_effective",
    "total_deviations",
    "weighted",
]

PerChannel = Mapping[str, float] | Sequence[float] | None
Statistic = Callable[..., np.ndarray]
HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


class Noise(Protocol):
    """What a likelihood needs of a noise.

    Two members are required, `parameter_names` and `log_likelihood`. A noise may also have:

    * ``channels``, the measured channels in the order of the statistics; checked against those of the model.
    * ``statistic``, a function of a module that takes the residuals (n_channels, n_steps) and returns the numbers
      (n_numbers,) which `log_likelihood` needs, the sums of squares (n_channels,) first. Without it these are all.
      Residuals of missing samples are NaN; a statistic without a rule for them is refused with such measurements. A
      statistic with an attribute ``of_response`` that is true also takes the response at the samples, as a second
      argument.
    * ``time_shifts``, the largest unknown time shifts of channels [s] by name, with the statistics of
      `fe_likelihoods.noise.time_shifts.TimeShiftNoise`.
    * ``standard_deviations(parameters)`` with parameters (n, n_noise), which returns the standard deviation of the
      errors (n, n_channels) [SI]; needed for predictions with noise.
    * ``response_deviations(parameters, response, dt)`` with the parameters (n_noise,) of one sample, which returns the
      standard deviations (n_channels, n_steps) of the errors of a simulated response; used in predictions in place of
      ``standard_deviations`` where the noise depends on the response.
    * ``response_errors(parameters, response, normal, dt, sensor)``, which returns the errors (n_channels, n_steps) made
      of standard normal numbers of that shape, with ``sensor=False`` without the noise of the sensors; for errors that
      are correlated in time and depend on the response.
    * ``whitened(residuals, response, parameters)`` and ``log_densities(residuals, response, parameters)`` at the
      measured samples, for checks of residuals and for the log-likelihood in blocks of time.
    * ``with_measurements(measurements)``, which returns the noise for a part of the measurements; needed where it
      depends on their number or times. A likelihood calls it with its own measurements.
    * ``under(model, first)``, which returns the noise under the excitation of a model whose response begins at the step
      ``first``; called by a likelihood with its model, and by a prediction with the model under the predicted record.
    * ``lag_one_correlations(parameters)``, which returns the correlation of successive errors (n, n_channels); for
      predictions with autoregressive noise.
    * ``with_channels(channels, weights)`` with the weights (n_others, n_channels) of its channels in each of others,
      which returns the noise of these for predictions, and the weights (n_others_noise, n_noise) of its parameters in
      theirs; for predictions of channels that were not measured.
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

        The number of samples is that of every channel; measurements with missing samples have `SampleCounts`. The value
        is -inf where a parameter is impossible, also for statistics of zero.
        """


def noise_channels(noise: Noise, default: Sequence[Channel]) -> tuple[Channel, ...]:
    """Channels of a noise; `default` where the noise does not specify them."""
    return tuple(getattr(noise, "channels", default))


def noise_statistic(noise: Noise) -> Statistic | None:
    """Statistic of the residuals that a noise needs, None for the sums of squares."""
    return getattr(noise, "statistic", None)


def noise_time_shifts(noise: Noise) -> Mapping[str, float] | None:
    """Largest unknown time shifts of channels [s] of a noise with such parameters, None for others."""
    return getattr(noise, "time_shifts", None)


def noise_of_part(noise: Noise, measurements: Measurements) -> Noise:
    """Noise of a part of the measurements: the same, unless it has a method ``with_measurements``."""
    return noise.with_measurements(measurements) if hasattr(noise, "with_measurements") else noise


def noise_under(noise: Noise, model: Any, first: int = 0) -> Noise:
    """Noise under the excitation of a model: the same, unless it has a method ``under``."""
    return noise.under(model, first) if hasattr(noise, "under") else noise


def remark_on_gaps(noise: Noise) -> str:
    """What a noise says of gaps in its measurements; empty if nothing, or without a method ``remark_on_gaps``."""
    return noise.remark_on_gaps() if hasattr(noise, "remark_on_gaps") else ""


def as_number(noise: Any, what: str, value: Any, unit: str) -> float:
    """A number that a user gave for a noise; ValueError in words for anything else, such as a text with a unit."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(
            f"{type(noise).__name__}: {what} must be a number {unit}; got {value!r}: give the number alone; "
            'to_si(0.02, "g") converts other units'
        ) from None


@dataclass(frozen=True)
class GaussianNoise:
    r"""Independent white Gaussian noise with one unknown standard deviation per channel.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    sensor : mapping of channel names to float, or sequence of float, optional
        Known standard deviations of the sensors [SI unit of the channel], one per channel; zero for names that are left
        out. The parameters are then the standard deviations of the model error, and may be zero:
        sigma_total^2 = sensor^2 + sigma^2.
    effective_samples : mapping of channel names to float, or sequence of float, optional
        Number of independent samples that each channel is worth, as estimated by
        `fe_likelihoods.noise.residuals.effective_samples`; the number of samples where it is smaller or the name
        is left out.

    Raises
    ------
    ValueError
        For no channel, an unknown channel, a negative sensor noise, or a number of samples that is not positive.

    Notes
    -----
    With n samples in channel c (those that are not missing) and the sum of squared residuals J_c, the log-likelihood is
    [1]_, eqs. (2) and (3)::

        log L = sum_c [ -n/2 log(2 pi) - n log(sigma_c) - J_c / (2 sigma_c^2) ]

    With effective samples, the term of channel c is multiplied by n_eff / n. This has the effect of thinning to n_eff
    samples without discarding any. The result is not a density of the measurements: only evidences of models with the
    same n_eff can be compared.

    References
    ----------
    .. [1] M. K. Ramancha, R. Astroza, J. P. Conte, J. I. Restrepo, M. D. Todd, "Bayesian nonlinear finite element model
       updating of a full-scale bridge-column using sequential Monte Carlo", in "Model Validation and Uncertainty
       Quantification, Volume 3", Springer.
    """

    channels: tuple[Channel, ...]
    sensor: tuple[float, ...] | None
    effective_samples: tuple[float, ...] | None

    def __init__(
        self, channels: Sequence[Channel], *, sensor: PerChannel = None, effective_samples: PerChannel = None
    ) -> None:
        set_channels(self, channels, sensor)
        set_effective(self, effective_samples)

    def __repr__(self) -> str:
        # display units change no value, so they are left out
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        return f"GaussianNoise({', '.join(named + options_repr(self.sensor, self.effective_samples))})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>``: standard deviations, each in the SI unit of its channel."""
        return tuple(f"sigma_{channel.name}" for channel in self.channels)

    def log_likelihood(self, misfit: np.ndarray, n_samples: int | SampleCounts, sigma: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        misfit : (n, n_channels) float
            Sums of squared residuals over the samples [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel where samples are missing.
        sigma : (n, n_channels) float
            Standard deviations of the noise [SI unit of the channel]; of the model error where sensor noise is given.

        Returns
        -------
        (n,) float
            -inf where a sigma is impossible (zero or negative; with sensor noise only negative) and where the misfit is
            NaN or infinite; never NaN.
        """
        return white_log_likelihood(misfit, n_samples, self.standard_deviations(sigma), self.effective_samples)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of the errors of every channel, sensor noise included.

        Parameters
        ----------
        parameters : (n, n_channels) float
            Parameters of the noise.

        Returns
        -------
        (n, n_channels) float
            [SI unit of the channel]; NaN for a negative parameter where sensor noise is given.
        """
        return total_deviations(np.asarray(parameters, dtype=float), self.sensor)

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> "tuple[GaussianNoise, np.ndarray]":
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`."""
        return GaussianNoise(channels, sensor=weighted(self.sensor, weights)), weights


@dataclass(frozen=True)
class SharedGaussianNoise:
    """Independent white Gaussian noise with one unknown standard deviation for all channels, in units of their scales.

    Channels of different dimensions can only share a dimensionless sigma: the standard deviation of channel c is
    sigma times the scale of the channel. With `of`, the scale is the root mean square of the measured channel, and
    sigma is the ratio of noise to signal.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    scales : sequence of float
        One positive scale per channel [SI unit of the channel].
    sensor, effective_samples : optional
        As for `GaussianNoise`.

    Raises
    ------
    ValueError
        If there is not one positive scale per channel, and as `GaussianNoise`.

    Notes
    -----
    The likelihood is that of the measurements, not of the scaled measurements: it contains the logarithms of the
    scales, so evidences of different noises can be compared.
    """

    channels: tuple[Channel, ...]
    scales: tuple[float, ...]
    sensor: tuple[float, ...] | None
    effective_samples: tuple[float, ...] | None

    def __init__(
        self,
        channels: Sequence[Channel],
        scales: Sequence[float],
        *,
        sensor: PerChannel = None,
        effective_samples: PerChannel = None,
    ) -> None:
        channels = tuple(channels)
        object.__setattr__(self, "scales", numbers(self, "scales", scales, "[SI unit of the channel]"))
        if not channels or len(self.scales) != len(channels):
            raise ValueError(
                f"SharedGaussianNoise expects one scale per channel; got {len(channels)} channels and "
                f"{len(self.scales)} scales"
            )
        for channel, scale in zip(channels, self.scales, strict=True):
            if not (math.isfinite(scale) and scale > 0.0):
                raise ValueError(
                    f"SharedGaussianNoise expects positive scales; got {scale} for channel {channel.name!r}: remove a "
                    "channel without signal from the measurements, or give its scale"
                )
        set_channels(self, channels, sensor)
        set_effective(self, effective_samples)

    @classmethod
    def of(cls, measurements: Measurements, **options: PerChannel) -> "SharedGaussianNoise":
        """Noise with the root mean squares of the measured channels as scales.

        Parameters
        ----------
        measurements : Measurements
        **options
            `sensor` and `effective_samples`, as for the class.
        """
        mean = np.mean if measurements.complete else np.nanmean
        return cls(measurements.channels, np.sqrt(mean(np.square(measurements.values), axis=1)), **options)

    def __repr__(self) -> str:
        named = [f"{c.name}: {c.quantity} / {scale!r}" for c, scale in zip(self.channels, self.scales, strict=True)]
        return f"SharedGaussianNoise({', '.join(named + options_repr(self.sensor, self.effective_samples))})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma``, dimensionless."""
        return ("sigma",)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of the errors of every channel, sensor noise included.

        Parameters
        ----------
        parameters : (n, 1) float
            Shared standard deviation, in units of the scales.

        Returns
        -------
        (n, n_channels) float
            [SI unit of the channel]; NaN for a negative parameter where sensor noise is given.
        """
        return total_deviations(np.asarray(parameters, dtype=float) * np.array(self.scales), self.sensor)

    def log_likelihood(self, misfit: np.ndarray, n_samples: int | SampleCounts, sigma: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        misfit : (n, n_channels) float
            Sums of squared residuals over the samples [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel where samples are missing.
        sigma : (n, 1) float
            Shared standard deviation, in units of the scales.

        Returns
        -------
        (n,) float
            -inf where sigma is impossible (see `GaussianNoise.log_likelihood`) and where the misfit is NaN or infinite;
            never NaN.
        """
        return white_log_likelihood(misfit, n_samples, self.standard_deviations(sigma), self.effective_samples)

    def with_channels(
        self, channels: Sequence[Channel], weights: np.ndarray
    ) -> "tuple[SharedGaussianNoise, np.ndarray]":
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`."""
        scales, sensor = weighted(self.scales, weights), weighted(self.sensor, weights)
        return SharedGaussianNoise(channels, scales, sensor=sensor), np.eye(1)


def set_channels(noise: Any, channels: Sequence[Channel], sensor: PerChannel) -> None:
    """Set and check the fields `channels` and `sensor` of a frozen noise."""
    object.__setattr__(noise, "channels", tuple(channels))
    if not noise.channels:
        raise ValueError(f"{type(noise).__name__} expects at least one channel; got none")
    values = _per_channel(noise, "sensor", sensor, 0.0)
    if values is not None and not all(0.0 <= value < math.inf for value in values):
        raise ValueError(
            f"{type(noise).__name__}: sensor must be standard deviations in SI units, zero or more; got {sensor!r}"
        )
    object.__setattr__(noise, "sensor", values)


def set_effective(noise: Any, effective_samples: PerChannel) -> None:
    """Set and check the field `effective_samples` of a frozen noise."""
    values = _per_channel(noise, "effective_samples", effective_samples, math.inf)
    if values is not None and not all(value > 0.0 for value in values):
        raise ValueError(
            f"{type(noise).__name__}: effective_samples must be positive numbers of samples; got {effective_samples!r}"
        )
    object.__setattr__(noise, "effective_samples", values)


def _per_channel(noise: Any, what: str, given: PerChannel, default: float) -> tuple[float, ...] | None:
    """One number per channel, or None if none are given."""
    if given is None:
        return None
    names = [channel.name for channel in noise.channels]
    if isinstance(given, Mapping):
        unknown = set(given) - set(names)
        if unknown:
            raise ValueError(
                f"{type(noise).__name__}: {what} has the unknown channels {sorted(unknown)}; the channels are "
                f"{', '.join(names)}"
            )
        given = [given.get(name, default) for name in names]
    values = numbers(noise, what, given, "per channel" if what == "effective_samples" else "[SI unit of the channel]")
    if len(values) != len(names):
        raise ValueError(
            f"{type(noise).__name__}: {what} must be one number for each of {', '.join(names)}; got {len(values)}"
        )
    return values


def numbers(noise: Any, what: str, given: Any, unit: str) -> tuple[float, ...]:
    """Numbers that a user gave for a noise, in any sequence; see `as_number`."""
    listed = [given] if isinstance(given, str) else np.ravel(np.asarray(given, dtype=object))
    return tuple(as_number(noise, what, value, unit) for value in listed)


def options_repr(sensor: tuple[float, ...] | None, effective_samples: tuple[float, ...] | None = None) -> list[str]:
    """Options that differ from the default, for the `repr`, which fingerprints are made of."""
    options = {"sensor": sensor, "effective_samples": effective_samples}
    return [f"{name}={value!r}" for name, value in options.items() if value is not None]


def weighted(values: tuple[float, ...] | None, weights: np.ndarray) -> np.ndarray | None:
    """Weighted sums (n_others,) of one number per channel, such as those of the sensors; None for None."""
    return None if values is None else weights @ np.array(values)


def total_deviations(sigma: np.ndarray, sensor: tuple[float, ...] | None) -> np.ndarray:
    """Standard deviations of model error and sensor noise together; NaN for a negative sigma."""
    if sensor is None:
        return sigma
    with np.errstate(invalid="ignore"):
        return np.where(sigma >= 0.0, np.hypot(sigma, sensor), np.nan)


def white_log_likelihood(
    misfit: np.ndarray, n_samples: int | SampleCounts, sigma: np.ndarray, effective: tuple[float, ...] | None
) -> np.ndarray:
    """Log-likelihood (n,) of independent Gaussian residuals with standard deviations `sigma` (n, n_channels)."""
    misfit, n = np.asarray(misfit, dtype=float), samples_per_channel(n_samples)
    with np.errstate(all="ignore"):
        # the ratio is squared instead of sigma: the square of a tiny sigma would be zero, and 0 / 0 for zero misfit
        ratio = np.sqrt(misfit) / sigma
        terms = -n * (HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * ratio * ratio
    if effective is not None:
        terms = terms * np.minimum(np.array(effective) / n, 1.0)
    possible = (sigma > 0.0) & np.isfinite(misfit)
    return np.where(possible, terms, -np.inf).sum(axis=-1)
