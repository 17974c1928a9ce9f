"""Autoregressive noise: errors that are correlated in time.

The equations are on the page ``docs/theory/noise.rst``.
"""

from collections.abc import Callable, Sequence
from dataclasses import KW_ONLY, dataclass

import numpy as np

from ..priors.truncated_normal_integrals import HALF_LOG_TWO_PI
from ..signals.channels import Channel
from .option_checks import PerChannel, checked_channels, sensor_levels, shown, weighted
from .residuals import innovations, lag_one_sums
from .sufficient_statistics import SampleCounts


@dataclass(frozen=True, repr=False)
class AutoregressiveNoise:
    """Stationary first-order autoregressive Gaussian noise, with unknown standard deviation and lag-one correlation.

    Both parameters are unknown for each channel.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the model.
    sensor : mapping of channel names to float, or sequence of float, optional
        Known standard deviations of the sensor noise, as for `GaussianNoise`: lower bounds for the standard deviation
        of the whole error. The lag-one correlation describes the whole error, not the model error alone.

    Raises
    ------
    ValueError
        As `GaussianNoise`.

    Notes
    -----
    The exact likelihood of the n samples, also with gaps, is on the page ``docs/theory/noise.rst``. For the mean of a
    channel, they are worth n (1 - rho) / (1 + rho) independent samples.

    Finely sampled errors of a smooth model are smoother than any AR(1) process. Then rho tends to one, and the
    likelihood depends on the differences of successive residuals only. Decimate the measurements
    (`Measurements.decimate`) to a step at which rho is well below one.

    Examples
    --------
    >>> noise = AutoregressiveNoise(model.channels)
    >>> noise.parameter_names
    ('sigma_acceleration', 'sigma_displacement', 'rho_acceleration', 'rho_displacement')
    >>> errors = {name: HalfNormal(0.1) for name in noise.parameter_names[:2]}
    >>> correlations = {name: Uniform(-0.99, 0.99) for name in noise.parameter_names[2:]}
    >>> correlated = Posterior(FELikelihood(model, measurements, noise), {
    ...     "stiffness": LogNormal(1.0, 0.2), "damping": Uniform(0.2, 4.0), **errors, **correlations,
    ... })
    """

    channels: Sequence[Channel]
    _: KW_ONLY
    sensor: PerChannel = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", checked_channels(self, self.channels))
        object.__setattr__(self, "sensor", sensor_levels(self, self.channels, self.sensor))

    def __repr__(self) -> str:
        return f"AutoregressiveNoise({shown(self.channels, {'sensor': self.sensor})})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>`` of all channels [SI], then ``rho_<channel>`` of all channels [-], between -1 and 1."""
        names = [channel.name for channel in self.channels]
        return tuple(f"sigma_{name}" for name in names) + tuple(f"rho_{name}" for name in names)

    @property
    def statistic(self) -> Callable[[np.ndarray], np.ndarray]:
        """Statistic of the residuals: `fe_likelihoods.noise.residuals.lag_one_sums`."""
        return lag_one_sums

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,) of statistics J, D and E of all channels (`lag_one_sums`); never NaN.

        It is -inf where a sigma is impossible (`GaussianNoise`), or a rho is not between -1 and 1.
        """
        statistics = np.asarray(statistics, dtype=float)
        if isinstance(n_samples, SampleCounts):
            return self._log_likelihood_with_gaps(statistics, n_samples, parameters)
        n_steps, n_channels = n_samples, len(self.channels)
        squares, differences, ends = (statistics[:, k * n_channels : (k + 1) * n_channels] for k in range(3))
        sigma, rho = self.standard_deviations(parameters), self.lag_one_correlations(parameters)
        with np.errstate(all="ignore"):
            spread = (1.0 - rho) * (1.0 + rho)
            quadratic = (1.0 - rho) ** 2 * squares + rho * differences + rho * (1.0 - rho) * ends
            ratio = np.sqrt(np.maximum(quadratic, 0.0) / spread) / sigma
            terms = -n_steps * (HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * (n_steps - 1) * np.log(spread) - 0.5 * ratio**2
        possible = (sigma > 0.0) & (sigma < np.inf) & (np.abs(rho) < 1.0) & np.isfinite(squares + differences + ends)
        return np.where(possible, terms, -np.inf).sum(axis=-1)

    def _log_likelihood_with_gaps(
        self, statistics: np.ndarray, counts: SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """`log_likelihood` where samples are missing: one factor for each pair of neighbouring samples."""
        sigma, rho = self.standard_deviations(parameters), self.lag_one_correlations(parameters)
        sums = statistics.reshape(len(statistics), -1, len(self.channels))
        with np.errstate(all="ignore"):
            quadratic, logarithms = sums[:, 1], np.zeros_like(rho)
            for k, (gap, times) in enumerate(zip(counts.gaps, counts.transitions, strict=True)):
                later, earlier, differences = (sums[:, 2 + 3 * k + j] for j in range(3))
                mean = rho ** int(gap)
                # the variance, in units of sigma^2, without the cancellation of 1 - rho^(2 g) near one
                spread = -np.expm1(2.0 * gap * np.log(np.abs(rho)))
                # sum (r_t - mean r_{t-g})^2, with differences as in the form without gaps
                squares = (1.0 - mean) * (later - mean * earlier) + mean * differences
                quadratic = quadratic + np.maximum(squares, 0.0) / spread
                logarithms = logarithms + times * np.log(spread)
            ratio = np.sqrt(quadratic) / sigma
            terms = -counts.samples * (HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * logarithms - 0.5 * ratio**2
        possible = (sigma > 0.0) & (sigma < np.inf) & (np.abs(rho) < 1.0) & np.isfinite(sums).all(axis=1)
        return np.where(possible, terms, -np.inf).sum(axis=-1)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) [SI] of the errors with the sensors; NaN for a negative parameter."""
        sigma = np.asarray(parameters, dtype=float)[..., : len(self.channels)]
        with np.errstate(invalid="ignore"):
            return np.where(sigma >= 0.0, np.hypot(sigma, 0.0 if self.sensor is None else self.sensor), np.nan)

    def lag_one_correlations(self, parameters: np.ndarray) -> np.ndarray:
        """Correlation of successive errors [-], (n, n_channels), from parameters (n, 2 n_channels)."""
        return np.asarray(parameters, dtype=float)[..., len(self.channels) :]

    def whitened(self, residuals: np.ndarray, response: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Innovations (n_channels, n_samples) of residuals; NaN in a channel of zeros alone."""
        found = np.full(residuals.shape, np.nan)
        for row, rho in enumerate(self.lag_one_correlations(parameters)):
            if np.nan_to_num(residuals[row]).any() and abs(rho) < 1.0:
                found[row, 1:] = innovations(residuals[[row]], np.array([rho]))[0]
        return found

    def with_channels(
        self, channels: Sequence[Channel], weights: np.ndarray
    ) -> "tuple[AutoregressiveNoise, np.ndarray]":
        """Noise of other channels, with the weights of the parameters; see `fe_likelihoods.noise.protocol.Noise`."""
        return AutoregressiveNoise(channels, sensor=weighted(self.sensor, weights)), np.kron(np.eye(2), weights)
