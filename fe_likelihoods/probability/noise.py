"""What separates a measured response from a simulated one, as a probability.

The measurement is the simulated response plus an error. For an error that is Gaussian and independent from channel to
channel, a few numbers per channel are all that the likelihood needs of the residuals (a sufficient statistic): for
white noise their sum of squares J, for an autoregressive error two numbers more. So a noise takes these numbers, not
the response, and a change of its own parameters costs no simulation.

Which one to take::

    GaussianNoise(channels)                          errors independent from sample to sample: synthetic data
    AutoregressiveNoise(channels)                    errors that last: an unknown lag-one correlation per channel
    GaussianNoise(channels, effective_samples=n_eff) the same concern, at no further parameter: n_eff from residuals
    SharedGaussianNoise.of(measurements)             one sigma for all channels
    ...Noise(channels, sensor={"top": 0.02})         known sensor noise beside the unknown model error

Real measurements differ from a model by more than a sensor's noise, and by errors that last longer than a sample.
White noise counts n of them as n independent witnesses, and its posterior is too sharp. `fe_likelihoods.probability.residuals` has
the checks and the effective number of samples.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..signals.channels import Channel, Measurements
from .residuals import lag_one_sums

__all__ = ["AutoregressiveNoise", "GaussianNoise", "SharedGaussianNoise"]

PerChannel = Mapping[str, float] | Sequence[float] | None
_HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class GaussianNoise:
    """Independent white Gaussian noise, one unknown standard deviation per channel.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    sensor : mapping of channel names to float, or one for each channel, optional
        Known standard deviations of the sensors [SI unit of the channel], zero where a name is left out. The parameters
        are then the standard deviations of the model's error, zero allowed: sigma_total^2 = sensor^2 + sigma^2.
    effective_samples : mapping of channel names to float, or one for each channel, optional
        How many independent samples a channel is worth, as `fe_likelihoods.probability.residuals.effective_samples` estimates it;
        no more than there are, and all of them where a name is left out.

    Raises
    ------
    ValueError
        For no channel, an unknown one, a negative sensor noise, a number of samples that is not positive.

    Notes
    -----
    Equations (2) and (3) of Ramancha et al., Bayesian nonlinear finite element model updating of a full-scale
    bridge-column using sequential Monte Carlo: with n samples in channel c and the residuals' sum of squares J_c, ::

        log L = sum_c [ -n/2 log(2 pi) - n log(sigma_c) - J_c / (2 sigma_c^2) ]

    With effective samples, the term of channel c is multiplied by n_eff / n. This is what thinning to n_eff samples
    does, but no sample is thrown away. It is no density of the measurements any more: evidences can be compared among
    models of the same n_eff only.
    """

    channels: tuple[Channel, ...]
    sensor: tuple[float, ...] | None
    effective_samples: tuple[float, ...] | None

    def __init__(
        self, channels: Sequence[Channel], *, sensor: PerChannel = None, effective_samples: PerChannel = None
    ) -> None:
        _set_channels(self, channels, sensor)
        _set_effective(self, effective_samples)

    def __repr__(self) -> str:
        # display units change nothing, so they do not enter
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        return f"GaussianNoise({', '.join(named + _options(self))})"

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
            Standard deviations of the noise [SI unit of the channel], of the model's error where the sensor's is known.

        Returns
        -------
        (n,) float : -inf where a sigma is impossible (not positive; negative, where the sensor's noise is known) or
            the misfit is NaN or infinite, never NaN.
        """
        return _log_likelihood(misfit, n_steps, self.standard_deviations(sigma), self.effective_samples)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of every channel's error [SI], sensor included, (n, n_channels), from the noise's
        parameters (n, n_channels); NaN for a negative one."""
        return _total(np.asarray(parameters, dtype=float), self.sensor)


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
    sensor, effective_samples : optional
        As in `GaussianNoise`.

    Raises
    ------
    ValueError
        If there is not one positive scale for each channel; and as `GaussianNoise`.

    Notes
    -----
    specs/isolated_bridge.md, section 5: the isolated bridge's paper has "the same sigma for all the measured response
    time histories". The likelihood is that of the measurements themselves, not of the scaled ones: the logarithms of
    the scales are in it, so that evidences of different noises can be compared.
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
        object.__setattr__(self, "scales", tuple(float(scale) for scale in scales))
        channels = tuple(channels)
        if not channels or len(self.scales) != len(channels):
            raise ValueError(
                f"SharedGaussianNoise expects one scale for each channel; got {len(channels)} channels and "
                f"{len(self.scales)} scales"
            )
        for channel, scale in zip(channels, self.scales, strict=True):
            if not (math.isfinite(scale) and scale > 0.0):
                raise ValueError(
                    f"SharedGaussianNoise expects positive scales; got {scale} for channel {channel.name!r}: leave a "
                    "channel that measured nothing out of the measurements, or give its scale"
                )
        _set_channels(self, channels, sensor)
        _set_effective(self, effective_samples)

    @classmethod
    def of(cls, measurements: Measurements, **options: PerChannel) -> "SharedGaussianNoise":
        """With the root mean squares of the measured channels as scales; `options` are sensor, effective_samples."""
        return cls(measurements.channels, np.sqrt(np.mean(np.square(measurements.values), axis=1)), **options)

    def __repr__(self) -> str:
        named = [f"{c.name}: {c.quantity} / {scale!r}" for c, scale in zip(self.channels, self.scales, strict=True)]
        return f"SharedGaussianNoise({', '.join(named + _options(self))})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma``, dimensionless."""
        return ("sigma",)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of every channel's error [SI], sensor included, (n, n_channels), from the noise's
        parameter (n, 1); NaN for a negative one."""
        return _total(np.asarray(parameters, dtype=float) * np.array(self.scales), self.sensor)

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
        (n,) float : -inf where sigma is impossible (see `GaussianNoise.log_likelihood`) or the misfit is NaN or
            infinite, never NaN.
        """
        return _log_likelihood(misfit, n_steps, self.standard_deviations(sigma), self.effective_samples)


@dataclass(frozen=True)
class AutoregressiveNoise:
    """Stationary Gaussian error of each channel that lasts: AR(1), standard deviation and lag-one correlation unknown.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    sensor : optional
        Known standard deviations of the sensors, as in `GaussianNoise`: a floor under that of the whole error, whose
        lag-one correlation is the parameter (not that of the model's part alone).

    Raises
    ------
    ValueError
        As `GaussianNoise`.

    Notes
    -----
    With e_1 ~ N(0, sigma^2) and e_t = rho e_{t-1} + sqrt(1 - rho^2) sigma z_t, the errors of n samples are normal with
    the covariance sigma^2 rho^|i-j|, and their exact likelihood is (Hamilton, Time Series Analysis, 1994, section 5.2,
    there with the variance of z) ::

        log L = -n/2 log(2 pi) - n log(sigma) - (n-1)/2 log(1 - rho^2) - Q / (2 sigma^2 (1 - rho^2))
        Q     = (1 - rho)^2 J + rho D + rho (1 - rho) E

    of the sums J = sum r_t^2, D = sum (r_t - r_{t-1})^2 and E = r_1^2 + r_n^2 (`residuals.lag_one_sums`). At rho = 0
    this is white noise. Q is written with differences, not with products r_t r_{t-1}, whose sum would cancel against J
    for rho near one. A mean over a channel is then worth n (1 - rho) / (1 + rho) independent samples.

    Errors of a smooth model are smoother than any AR(1) when sampled finely: rho goes to one and the likelihood is that
    of differences. Decimate the measurements (`Measurements.decimate`) to a step at which rho is well below one.
    """

    channels: tuple[Channel, ...]
    sensor: tuple[float, ...] | None

    def __init__(self, channels: Sequence[Channel], *, sensor: PerChannel = None) -> None:
        _set_channels(self, channels, sensor)

    def __repr__(self) -> str:
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        return f"AutoregressiveNoise({', '.join(named + _options(self))})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>`` of all channels [SI], then ``rho_<channel>`` of all [-], between -1 and 1."""
        names = [channel.name for channel in self.channels]
        return tuple(f"sigma_{name}" for name in names) + tuple(f"rho_{name}" for name in names)

    @property
    def statistic(self) -> Callable[[np.ndarray], np.ndarray]:
        """What is needed of the residuals: `residuals.lag_one_sums`, three numbers per channel."""
        return lag_one_sums

    def log_likelihood(self, statistics: np.ndarray, n_steps: int, parameters: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        statistics : (n, 3 n_channels) float
            J of all channels, then D, then E (see Notes of the class) [SI unit of the channel, squared]; NaN where the
            simulation failed.
        n_steps : int
            Number of samples in each channel.
        parameters : (n, 2 n_channels) float
            Standard deviations of all channels' errors [SI], then their lag-one correlations.

        Returns
        -------
        (n,) float : -inf where a sigma is impossible (see `GaussianNoise.log_likelihood`), a rho not between -1 and 1,
            or a statistic NaN or infinite, never NaN.
        """
        statistics = np.asarray(statistics, dtype=float)
        n_channels = len(self.channels)
        squares, differences, ends = (statistics[:, k * n_channels : (k + 1) * n_channels] for k in range(3))
        sigma, rho = self.standard_deviations(parameters), self.lag_one_correlations(parameters)
        with np.errstate(all="ignore"):
            spread = (1.0 - rho) * (1.0 + rho)
            quadratic = (1.0 - rho) ** 2 * squares + rho * differences + rho * (1.0 - rho) * ends
            ratio = np.sqrt(np.maximum(quadratic, 0.0) / spread) / sigma
            terms = (
                -n_steps * (_HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * (n_steps - 1) * np.log(spread) - 0.5 * ratio**2
            )
        possible = (sigma > 0.0) & (sigma < np.inf) & (np.abs(rho) < 1.0) & np.isfinite(squares + differences + ends)
        return np.where(possible, terms, -np.inf).sum(axis=-1)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviation of every channel's error [SI], sensor included, (n, n_channels), from the noise's
        parameters (n, 2 n_channels); NaN for a negative one."""
        return _total(np.asarray(parameters, dtype=float)[..., : len(self.channels)], self.sensor)

    def lag_one_correlations(self, parameters: np.ndarray) -> np.ndarray:
        """Correlation of successive errors of every channel [-], (n, n_channels), from the noise's parameters."""
        return np.asarray(parameters, dtype=float)[..., len(self.channels) :]


def _set_channels(noise: object, channels: Sequence[Channel], sensor: PerChannel) -> None:
    object.__setattr__(noise, "channels", tuple(channels))
    if not noise.channels:
        raise ValueError(f"{type(noise).__name__} expects at least one channel; got none")
    values = _per_channel(noise, "sensor", sensor, 0.0)
    if values is not None and not all(0.0 <= value < math.inf for value in values):
        raise ValueError(
            f"{type(noise).__name__}: sensor must be standard deviations in SI units, zero or more; got {sensor!r}"
        )
    object.__setattr__(noise, "sensor", values)


def _set_effective(noise: object, effective_samples: PerChannel) -> None:
    values = _per_channel(noise, "effective_samples", effective_samples, math.inf)
    if values is not None and not all(value > 0.0 for value in values):
        raise ValueError(
            f"{type(noise).__name__}: effective_samples must be positive numbers of samples; got {effective_samples!r}"
        )
    object.__setattr__(noise, "effective_samples", values)


def _per_channel(noise: object, what: str, given: PerChannel, default: float) -> tuple[float, ...] | None:
    """One number for each channel, or None where none is given."""
    if given is None:
        return None
    names = [channel.name for channel in noise.channels]
    if isinstance(given, Mapping):
        unknown = set(given) - set(names)
        if unknown:
            raise ValueError(
                f"{type(noise).__name__}: {what} names no channel with {sorted(unknown)}; they are {', '.join(names)}"
            )
        given = [given.get(name, default) for name in names]
    values = tuple(float(value) for value in np.ravel(given))
    if len(values) != len(names):
        raise ValueError(
            f"{type(noise).__name__}: {what} must be one number for each of {', '.join(names)}; got {len(values)}"
        )
    return values


def _options(noise: object) -> list[str]:
    """The options that are not the default, for the `repr`: a noise without them has the digest that it always had."""
    options = {name: getattr(noise, name, None) for name in ("sensor", "effective_samples")}
    return [f"{name}={value!r}" for name, value in options.items() if value is not None]


def _total(sigma: np.ndarray, sensor: tuple[float, ...] | None) -> np.ndarray:
    """Standard deviations of model and sensor together; NaN for a negative sigma."""
    if sensor is None:
        return sigma
    with np.errstate(invalid="ignore"):
        return np.where(sigma >= 0.0, np.hypot(sigma, sensor), np.nan)


def _log_likelihood(
    misfit: np.ndarray, n_steps: int, sigma: np.ndarray, effective: tuple[float, ...] | None
) -> np.ndarray:
    """Of independent Gaussian residuals with standard deviations `sigma` (n, n_channels)."""
    misfit = np.asarray(misfit, dtype=float)
    with np.errstate(all="ignore"):
        # the ratio is squared, not sigma: a tiny sigma squared would be zero, and zero misfit then 0 / 0
        ratio = np.sqrt(misfit) / sigma
        terms = -n_steps * (_HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * ratio * ratio
    if effective is not None:
        terms = terms * np.minimum(np.array(effective) / n_steps, 1.0)
    possible = (sigma > 0.0) & np.isfinite(misfit)
    return np.where(possible, terms, -np.inf).sum(axis=-1)
