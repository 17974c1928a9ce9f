"""Checks of residuals: are they white, and how many independent samples are they worth?

A residual is the measured minus the simulated response at parameters that fit. White noise treats the n samples of a
channel as independent. Residuals of real measurements are not, because the error of a model changes slowly and repeats
from cycle to cycle. `residual_checks` measures how far they are from white noise, `effective_samples` gives the number
of independent samples for `fe_likelihoods.probability.noise.GaussianNoise`, and `innovations` shows whether
`fe_likelihoods.AutoregressiveNoise` explains them::

    residuals = posterior.likelihood.residuals(best)
    residual_checks(residuals)
    noise = GaussianNoise(model.channels, effective_samples=effective_samples(residuals))

The equations are on the page ``docs/theory/noise.rst``.
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

_WINDOW = 5.0  # length of the sums over lags, in correlation times


class ResidualChecks(NamedTuple):
    """Checks of the residuals of each channel; all arrays are (n_channels,).

    Attributes
    ----------
    mean, standard_deviation : ndarray
        [SI unit of the channel].
    lag_one : ndarray
        Correlation of successive residuals [-], near zero for white noise.
    n_effective : ndarray
        Number of independent samples (`effective_samples`).
    white : ndarray
        Probability that white noise has a lag-one correlation at least as far from zero.
    normal : ndarray
        Probability that normal residuals have a skewness and kurtosis at least as far from those of the normal
        distribution.
    """

    mean: np.ndarray
    standard_deviation: np.ndarray
    lag_one: np.ndarray
    n_effective: np.ndarray
    white: np.ndarray
    normal: np.ndarray


def lag_one_sums(residuals: np.ndarray) -> np.ndarray:
    """Statistics of an AR(1) error: J, D and E of `fe_likelihoods.AutoregressiveNoise`.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        [SI unit of the channel].

    Returns
    -------
    (3 n_channels,) float
        Sums of squares of all channels, then sums of squared differences of successive residuals, then the square of
        the first plus the square of the last residual [SI unit of the channel, squared].
    """
    squares = np.square(residuals).sum(axis=-1)
    differences = np.square(np.diff(residuals, axis=-1)).sum(axis=-1)
    return np.concatenate([squares, differences, residuals[:, 0] ** 2 + residuals[:, -1] ** 2])


def autocorrelation(residuals: np.ndarray) -> np.ndarray:
    """Autocorrelation at lags of 0, 1, ... samples about a mean of zero, which is the mean of an error.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Any unit.

    Returns
    -------
    (n_channels, n_steps) float
        sum_t r_t r_{t+k} / sum_t r_t^2; one at lag zero.

    Raises
    ------
    ValueError
        If the residuals have another shape, fewer than two samples, non-finite values, or only zeros in a channel.
    """
    residuals = _checked(residuals)
    n = residuals.shape[1]
    size = 2 ** (2 * n - 1).bit_length()  # zero padding, so that no lag wraps around
    spectrum = np.fft.rfft(residuals / np.abs(residuals).max(axis=1, keepdims=True), size, axis=1)
    products = np.fft.irfft(spectrum * spectrum.conj(), size, axis=1)[:, :n]
    return products / products[:, :1]


def effective_samples(residuals: np.ndarray) -> np.ndarray:
    """Number of independent samples that the residuals of each channel are worth.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured minus simulated response at parameters that fit; any unit.

    Returns
    -------
    (n_channels,) float
        Between one and n_steps.

    Raises
    ------
    ValueError
        If the residuals have another shape, fewer than two samples, non-finite values, or only zeros in a channel.

    Notes
    -----
    With the autocorrelation rho_k of the errors::

        n_eff = n / (1 + 2 sum_k rho_k^2)

    This is the number for the variance of a mean square, that is for sigma [1]_. It also holds for a parameter whose
    sensitivity has the same spectrum as the errors; in general, one factor rho_k is the autocorrelation of the
    sensitivity (compare [2]_). Intervals are therefore too wide for a parameter whose sensitivity varies faster than
    the errors, and too narrow for one whose sensitivity varies more slowly, such as an offset.
    `fe_likelihoods.AutoregressiveNoise` makes this distinction, a single number cannot. For AR(1)
    errors the number is n (1 - rho^2) / (1 + rho^2).

    The integrated autocorrelation time of a mean, which samplers report, is not suitable: it is less than one for
    oscillating residuals, which are typical of structures.

    The sum ends at the first lag of at least five correlation times 1 + 2 sum_k rho_k^2 (Sokal's window), because later
    terms are dominated by estimation errors.

    References
    ----------
    .. [1] G. V. Bayley, J. M. Hammersley (1946), "The 'effective' number of independent observations in an
       autocorrelated time series", Supplement to the Journal of the Royal Statistical Society 8, 184-197,
       doi:10.2307/2983560.
    .. [2] C. S. Bretherton et al. (1999), "The effective number of spatial degrees of freedom of a time-varying field",
       Journal of Climate 12, 1990-2009.
    """
    correlation = autocorrelation(residuals)
    n = correlation.shape[1]
    times = 2.0 * np.cumsum(correlation**2, axis=1) - 1.0
    wide = np.arange(n) >= _WINDOW * times
    last = np.where(wide.any(axis=1), np.argmax(wide, axis=1), n - 1)
    return n / np.clip(np.take_along_axis(times, last[:, None], axis=1)[:, 0], 1.0, n)


def innovations(residuals: np.ndarray, lag_one: np.ndarray) -> np.ndarray:
    """Innovations of an AR(1) process: white, with the standard deviation of the residuals, if they are AR(1).

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        [SI unit of the channel].
    lag_one : (n_channels,) float
        Correlations of successive residuals, between -1 and 1.

    Returns
    -------
    (n_channels, n_steps - 1) float
        (r_t - rho r_{t-1}) / sqrt(1 - rho^2) [SI unit of the channel].

    Raises
    ------
    ValueError
        If the residuals have another shape, fewer than two samples, non-finite values, or only zeros in a channel; for
        a wrong number of correlations, or one that is not between -1 and 1.
    """
    residuals = _checked(residuals)
    rho = np.asarray(lag_one, dtype=float)
    if rho.shape != (len(residuals),) or not (np.abs(rho) < 1.0).all():
        raise ValueError(
            f"lag_one must be a correlation between -1 and 1 for each of {len(residuals)} channels; got {lag_one!r}"
        )
    return (residuals[:, 1:] - rho[:, None] * residuals[:, :-1]) / np.sqrt(1.0 - rho[:, None] ** 2)


def residual_checks(residuals: np.ndarray) -> ResidualChecks:
    """Compare residuals with Gaussian white noise.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured minus simulated response at parameters that fit [SI unit of the channel].

    Returns
    -------
    ResidualChecks

    Raises
    ------
    ValueError
        If the residuals have another shape, fewer than two samples, non-finite values, or only zeros in a channel.

    Notes
    -----
    The lag-one correlation of n white residuals is approximately normal with standard deviation 1 / sqrt(n). Normality
    is tested with the statistic of Jarque and Bera [1]_, with the effective number of samples instead of n, so that
    correlation alone does not make the test significant. If `white` or `normal` is below 0.01, look at the figure of
    `fe_likelihoods.plot_residuals`.

    References
    ----------
    .. [1] C. M. Jarque, A. K. Bera (1987), "A test for normality of observations and regression residuals",
       International Statistical Review 55, 163-172, doi:10.2307/1403192.
    """
    from scipy import stats  # takes 0.5 s to import, and every noise imports this module

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
        If the number of channels differs from the number of rows, or the residuals have another shape, fewer than two
        samples, non-finite values, or only zeros in a channel.
    """
    from ..plots.histories import plot_residual_checks

    return plot_residual_checks(residuals, channels, dt, residual_checks(residuals), autocorrelation(residuals))


def _checked(residuals: np.ndarray) -> np.ndarray:
    residuals = np.asarray(residuals, dtype=float)
    if residuals.ndim != 2 or residuals.shape[1] < 2:
        raise ValueError(
            f"expected residuals of shape (n_channels, n_steps) with two samples or more; got {residuals.shape}"
        )
    if not np.isfinite(residuals).all():
        raise ValueError("residuals must be finite; these are not, perhaps because a simulation failed")
    if not residuals.any(axis=1).all():
        raise ValueError(
            f"the residuals of channels {np.flatnonzero(~residuals.any(axis=1)).tolist()} are all zero and have no "
            "correlation; leave these channels out"
        )
    return residuals
