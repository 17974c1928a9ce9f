"""What the residuals say about the noise: are they white, and how many independent samples are they worth.

A residual is measured less simulated, at parameters that fit. White noise takes the n samples of a channel as
independent. Residuals of real measurements are not: the error of a model lasts longer than a sample and looks alike
from one cycle to the next. `residual_checks` says how far they are from white, `effective_samples` what they are worth
to `fe_likelihoods.probability.noise.GaussianNoise`, and `innovations` whether one lag of correlation explains them
(`fe_likelihoods.probability.noise.AutoregressiveNoise`)::

    residuals = posterior.likelihood.residuals(best)
    residual_checks(residuals)
    noise = GaussianNoise(model.channels, effective_samples=effective_samples(residuals))
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..signals.channels import Channel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "ResidualChecks",
    "autocorrelation",
    "effective_samples",
    "innovations",
    "lag_one_sums",
    "plot_residuals",
    "residual_checks",
]

_WINDOW = 5.0  # of the sums over lags, in correlation times


class ResidualChecks(NamedTuple):
    """Of the residuals of each channel, all (n_channels,).

    mean, standard_deviation : [SI unit of the channel]
    lag_one : correlation of successive residuals, near zero for white ones
    n_effective : independent samples that they are worth (`effective_samples`)
    white : probability of a lag-one correlation at least so far from zero if they were white
    normal : probability of a skewness and a kurtosis at least so far from the normal's if they were normal
    """

    mean: np.ndarray
    standard_deviation: np.ndarray
    lag_one: np.ndarray
    n_effective: np.ndarray
    white: np.ndarray
    normal: np.ndarray


def lag_one_sums(residuals: np.ndarray) -> np.ndarray:
    """Statistic of residuals for an AR(1) error: J, D and E of `fe_likelihoods.probability.noise.AutoregressiveNoise`.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float, [SI]

    Returns
    -------
    (3 n_channels,) float : sums of squares of all channels, then those of successive differences, then the squares of
        first and last residual together [SI unit of the channel, squared].
    """
    squares = np.square(residuals).sum(axis=-1)
    differences = np.square(np.diff(residuals, axis=-1)).sum(axis=-1)
    return np.concatenate([squares, differences, residuals[:, 0] ** 2 + residuals[:, -1] ** 2])


def autocorrelation(residuals: np.ndarray) -> np.ndarray:
    """Autocorrelation at lags of 0, 1, ... samples about a mean of zero, which is the mean of an error.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float — any unit.

    Returns
    -------
    (n_channels, n_steps) float : sum_t r_t r_{t+k} / sum_t r_t^2, one at lag zero.

    Raises
    ------
    ValueError
        If the residuals are not of this shape, have fewer than two samples, are not finite, or zero in a channel.
    """
    residuals = _checked(residuals)
    n = residuals.shape[1]
    size = 2 ** (2 * n - 1).bit_length()  # room for all lags, without wrapping round
    spectrum = np.fft.rfft(residuals / np.abs(residuals).max(axis=1, keepdims=True), size, axis=1)
    products = np.fft.irfft(spectrum * spectrum.conj(), size, axis=1)[:, :n]
    return products / products[:, :1]


def effective_samples(residuals: np.ndarray) -> np.ndarray:
    """Number of independent samples that the residuals of each channel are worth.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured less simulated, at parameters that fit; any unit.

    Returns
    -------
    (n_channels,) float : between one and n_steps.

    Raises
    ------
    ValueError
        As `autocorrelation`.

    Notes
    -----
    With the autocorrelation rho_k of the errors ::

        n_eff = n / (1 + 2 sum_k rho_k^2)

    This is the number for sigma (the variance of a mean square: Bayley & Hammersley, The "effective" number of
    independent observations in an autocorrelated time series, Supplement to the Journal of the Royal Statistical
    Society 8, 1946, 184-197), and for a parameter whose sensitivity has the spectrum of the errors: in general one
    rho_k is the autocorrelation of the sensitivity (compare Bretherton et al., The effective number of spatial degrees
    of freedom of a time-varying field, Journal of Climate 12, 1999, 1990-2009). So intervals of a parameter whose
    sensitivity is quicker than the errors come out too wide, of a slower one (an offset) too narrow;
    `fe_likelihoods.probability.noise.AutoregressiveNoise` tells parameters apart, a single number cannot. For AR(1) errors it is
    n (1 - rho^2) / (1 + rho^2). The autocorrelation time of a mean, which samplers report, would not do: for residuals
    that oscillate, as those of structures do, it falls below one.

    The sum ends at the first lag of five times the sum of rho_k^2 (Sokal's window), lest it be a sum of errors of
    estimation.
    """
    correlation = autocorrelation(residuals)
    n = correlation.shape[1]
    times = 2.0 * np.cumsum(correlation**2, axis=1) - 1.0
    wide = np.arange(n) >= _WINDOW * times
    last = np.where(wide.any(axis=1), np.argmax(wide, axis=1), n - 1)
    return n / np.clip(np.take_along_axis(times, last[:, None], axis=1)[:, 0], 1.0, n)


def innovations(residuals: np.ndarray, lag_one: np.ndarray) -> np.ndarray:
    """What is new in each residual if they are AR(1): white, and of the same standard deviation, if they are.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float, [SI]
    lag_one : (n_channels,) float — correlations of successive residuals, between -1 and 1.

    Returns
    -------
    (n_channels, n_steps - 1) float : (r_t - rho r_{t-1}) / sqrt(1 - rho^2), [SI].

    Raises
    ------
    ValueError
        As `autocorrelation`; also for another number of correlations, or one that is not between -1 and 1.
    """
    residuals = _checked(residuals)
    rho = np.asarray(lag_one, dtype=float)
    if rho.shape != (len(residuals),) or not (np.abs(rho) < 1.0).all():
        raise ValueError(
            f"lag_one must be a correlation between -1 and 1 for each of {len(residuals)} channels; got {lag_one!r}"
        )
    return (residuals[:, 1:] - rho[:, None] * residuals[:, :-1]) / np.sqrt(1.0 - rho[:, None] ** 2)


def residual_checks(residuals: np.ndarray) -> ResidualChecks:
    """Whether residuals are what a Gaussian white noise would leave.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured less simulated, at parameters that fit [SI].

    Returns
    -------
    ResidualChecks

    Raises
    ------
    ValueError
        As `autocorrelation`.

    Notes
    -----
    The lag-one correlation of n white residuals is normal with a standard deviation of 1 / sqrt(n). The test of
    normality is that of Jarque and Bera, with the effective number of samples in the place of n: independence is
    another question, and takes none of its significance. Probabilities below a hundredth are worth a look at
    `plot_residuals`.
    """
    from scipy import stats  # where used: half a second, and whoever has a noise imports this module

    residuals = _checked(residuals)
    n_effective = effective_samples(residuals)
    lag_one = autocorrelation(residuals)[:, 1]
    n = residuals.shape[1]
    score = n_effective / 6.0 * (stats.skew(residuals, axis=1) ** 2 + 0.25 * stats.kurtosis(residuals, axis=1) ** 2)
    return ResidualChecks(
        mean=residuals.mean(axis=1),
        standard_deviation=residuals.std(axis=1),
        lag_one=lag_one,
        n_effective=n_effective,
        white=2.0 * stats.norm.sf(np.sqrt(n) * np.abs(lag_one)),
        normal=stats.chi2.sf(score, 2),
    )


def plot_residuals(residuals: np.ndarray, channels: Sequence[Channel], dt: float) -> "Figure":
    """Plot residuals against time, their autocorrelation and their normal quantiles, one row per channel.

    The shaded band holds 95 % of the autocorrelation coefficients of white residuals. The quantiles of normal
    residuals follow the straight line.

    Parameters
    ----------
    residuals : ndarray, shape (n_channels, n_steps)
        Measured minus simulated response [SI], such as the result of `FELikelihood.residuals`.
    channels : sequence of Channel
        The channels, one per row of `residuals`.
    dt : float
        Time step [s].

    Returns
    -------
    matplotlib Figure
        The figure, with axes of shape (n_channels, 3).

    Raises
    ------
    ValueError
        If the number of channels differs from the number of rows, and as `residual_checks`.
    """
    from ..plots.histories import plot_residual_checks

    return plot_residual_checks(residuals, channels, dt, residual_checks(residuals), autocorrelation(residuals))


def _checked(residuals: np.ndarray) -> np.ndarray:
    residuals = np.asarray(residuals, dtype=float)
    if residuals.ndim != 2 or residuals.shape[1] < 2:
        raise ValueError(
            f"expected residuals of shape (n_channels, n_steps), of two samples or more; got {residuals.shape}"
        )
    if not np.isfinite(residuals).all():
        raise ValueError("residuals must be finite; they are not: is this a simulation that failed?")
    if not residuals.any(axis=1).all():
        raise ValueError(
            f"residuals of channels {np.flatnonzero(~residuals.any(axis=1)).tolist()} are all zero: nothing can be said"
        )
    return residuals
