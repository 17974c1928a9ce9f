"""Checks of residuals: are they white, and how many independent samples are they worth?

White noise treats the n samples of a channel as independent. Residuals of real measurements (measured minus simulated
response) are correlated, because model errors change slowly and repeat from cycle to cycle. `residual_checks` measures
this, its `n_effective` is for `fe_likelihoods.GaussianNoise`, and `innovations` shows whether
`fe_likelihoods.AutoregressiveNoise` explains it::

    residuals = likelihood.residuals_of(model.simulate(best))
    noise = GaussianNoise(model.channels, effective_samples=residual_checks(residuals).n_effective)

The equations are on the page ``docs/theory/noise.rst``.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..signals.channels import Channel
from ..text_tables import text_table
from ..units import find_unit
from .sufficient_statistics import distinct_gaps

_WINDOW = 5.0  # length of the sums over lags, in correlation times (as in emcee.autocorr: Sokal 1997)


class ResidualChecks(NamedTuple):
    """Checks of the residuals per channel; all arrays are (n_channels,). ``str`` gives a table.

    Attributes
    ----------
    mean, standard_deviation : ndarray
        [SI unit of the channel].
    lag_one : ndarray
        Correlation of successive residuals [-], near zero for white noise.
    n_effective : ndarray
        Number of independent samples that the channel is worth.
    white : ndarray
        p-value of white noise: probability of a lag-one correlation at least as far from zero.
    normal : ndarray
        p-value of normal residuals: probability of a skewness and kurtosis at least as far from the normal values.
    n_samples : ndarray
        Number of samples, without missing ones.
    channels : tuple of Channel
        The channels, for names and units in the table; empty if they were not given.
    """

    mean: np.ndarray
    standard_deviation: np.ndarray
    lag_one: np.ndarray
    n_effective: np.ndarray
    white: np.ndarray
    normal: np.ndarray
    n_samples: np.ndarray
    channels: tuple[Channel, ...] = ()

    def __str__(self) -> str:
        names, units = [f"channel {i}" for i in range(len(self.mean))], [("SI", 1.0)] * len(self.mean)
        if self.channels:
            names = [channel.name for channel in self.channels]
            units = [(channel.unit, find_unit(channel.unit, channel.dimension).factor) for channel in self.channels]
        rows = [("channel", "unit", "mean", "sd", "lag one", "samples", "independent", "p white", "p normal")]
        for i, (name, (unit, factor)) in enumerate(zip(names, units, strict=True)):
            sizes = f"{self.mean[i] / factor:.3g}", f"{self.standard_deviation[i] / factor:.3g}"
            counts = f"{self.lag_one[i]:.2f}", f"{self.n_samples[i]:.0f}", f"{self.n_effective[i]:.0f}"
            rows.append((name, unit, *sizes, *counts, f"{self.white[i]:.2g}", f"{self.normal[i]:.2g}"))
        return text_table(rows)

    __repr__ = __str__


def lag_one_sums(residuals: np.ndarray) -> np.ndarray:
    """Statistics of an AR(1) error of residuals (n_channels, n_steps) [SI]: J, D and E of `AutoregressiveNoise`.

    Each for all channels [SI unit, squared]: the sum of squares, the sum of squared differences of successive
    residuals, and first squared plus last squared. With missing samples (NaN): the sum of squares and the square of the
    first residual; then, for each distance in `SampleCounts.gaps`, sums over the neighbouring pairs at this distance of
    squared later residuals, squared earlier residuals, and squared differences.
    """
    if np.isnan(residuals).any():
        return _sums_with_gaps(residuals)
    squares = np.square(residuals).sum(axis=-1)
    differences = np.square(np.diff(residuals, axis=-1)).sum(axis=-1)
    return np.concatenate([squares, differences, residuals[:, 0] ** 2 + residuals[:, -1] ** 2])


def _sums_with_gaps(residuals: np.ndarray) -> np.ndarray:
    places = [np.flatnonzero(there) for there in ~np.isnan(residuals)]
    gaps = distinct_gaps(places)
    sums = np.zeros((2 + 3 * len(gaps), len(residuals)))
    for c, (row, one) in enumerate(zip(residuals, places, strict=True)):
        values = row[one]
        sums[0, c], sums[1, c] = np.square(values).sum(), values[0] ** 2
        pairs = np.searchsorted(gaps, np.diff(one))
        later, earlier = values[1:], values[:-1]
        for k, each in enumerate((later, earlier, later - earlier)):
            sums[2 + k :: 3, c] = np.bincount(pairs, each * each, minlength=len(gaps))
    return sums.ravel()


def autocorrelation(residuals: np.ndarray) -> np.ndarray:
    """sum_t r_t r_{t+k} / sum_t r_t^2 of residuals (n_channels, n_steps) at lags k = 0, 1, ..., about a mean of zero
    (the mean of an error); one at lag zero.

    Where samples are missing (NaN), products are averaged over the complete pairs; zero at lags without a pair. Raises
    ValueError for another shape, fewer than two samples, infinite values, or only zeros in a channel.
    """
    residuals = _checked(residuals)
    missing = np.isnan(residuals)
    if missing.any():
        correlation = _lagged_products(np.where(missing, 0.0, residuals))
        shares = _pair_shares(missing)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(shares > 0.0, correlation / shares, 0.0)
    return _lagged_products(residuals)


def _lagged_products(residuals: np.ndarray) -> np.ndarray:
    """Sums of r_t r_{t+k} divided by the sum at lag zero, (n_channels, n_steps)."""
    n = residuals.shape[1]
    size = 2 ** (2 * n - 1).bit_length()  # zero padding, so that no lag wraps around
    spectrum = np.fft.rfft(residuals / np.abs(residuals).max(axis=1, keepdims=True), size, axis=1)
    products = np.fft.irfft(spectrum * spectrum.conj(), size, axis=1)[:, :n]
    return products / products[:, :1]


def _pair_counts(missing: np.ndarray) -> np.ndarray:
    """Number of complete sample pairs at each lag (n_channels, n_steps)."""
    there = (~missing).astype(float)
    return np.rint(_lagged_products(there) * there.sum(axis=1, keepdims=True))


def _pair_shares(missing: np.ndarray) -> np.ndarray:
    """Complete pairs at each lag, divided by n (1 - k / s) for n samples in a span of s steps; one without gaps."""
    n = missing.shape[1]
    span = n - np.argmax(~missing[:, ::-1], axis=1) - np.argmax(~missing, axis=1)
    inside = np.maximum(1.0 - np.arange(n) / span[:, None], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = _pair_counts(missing) / ((~missing).sum(axis=1)[:, None] * inside)
    return np.where(inside > 0.0, shares, 0.0)


def effective_samples(residuals: np.ndarray) -> np.ndarray:
    """Number of independent samples (n_channels,) that residuals (n_channels, n_steps) are worth for a mean square.

    n_eff = n / (1 + 2 sum_k rho_k^2) with the autocorrelation rho_k of the errors, summed to the first lag of at least
    five correlation times (Sokal's window). The integrated autocorrelation time of a mean is not suitable: it is less
    than one for oscillating residuals. Where samples are missing, n is the number of samples without them, and each lag
    is weighted by the share of complete pairs. See ``docs/theory/noise.rst``.
    """
    correlation, missing = autocorrelation(residuals), np.isnan(residuals)
    n = correlation.shape[1]
    squares, samples = correlation**2, n
    if missing.any():
        squares, samples = squares * _pair_shares(missing), (~missing).sum(axis=1)
    times = 2.0 * np.cumsum(squares, axis=1) - 1.0
    wide = np.arange(n) >= _WINDOW * times
    last = np.where(wide.any(axis=1), np.argmax(wide, axis=1), n - 1)
    return samples / np.clip(np.take_along_axis(times, last[:, None], axis=1)[:, 0], 1.0, samples)


def innovations(residuals: np.ndarray, lag_one: np.ndarray) -> np.ndarray:
    """Innovations (n_channels, n_steps - 1) [SI] of residuals (n_channels, n_steps), white if these are AR(1).

    With the correlations rho (n_channels,) of successive residuals they are (r_t - rho r_{t-1}) / sqrt(1 - rho^2), and
    after a gap of g steps (r_t - rho^g r_{t-g}) / sqrt(1 - rho^(2 g)); NaN where r_t is missing or is the first sample.
    ValueError as `residual_checks`, or for a correlation that is not between -1 and 1.

    Examples
    --------
    >>> from fe_likelihoods.noise.residuals import innovations
    >>> innovations(likelihood.residuals_of(model.simulate([1.1, 0.9])), np.array([0.2, 0.1])).shape
    (2, 199)
    """
    residuals = _checked(residuals)
    rho = np.asarray(lag_one, dtype=float)
    if rho.shape != (len(residuals),) or not (np.abs(rho) < 1.0).all():
        raise ValueError(
            f"lag_one must be a correlation between -1 and 1 for each of {len(residuals)} channels; got {lag_one!r}"
        )
    if np.isnan(residuals).any():
        white = np.full((len(residuals), residuals.shape[1] - 1), np.nan)
        for row, one, correlation in zip(white, residuals, rho, strict=True):
            places = np.flatnonzero(~np.isnan(one))
            mean = correlation ** np.diff(places)
            row[places[1:] - 1] = (one[places[1:]] - mean * one[places[:-1]]) / np.sqrt(1.0 - mean**2)
        return white
    return (residuals[:, 1:] - rho[:, None] * residuals[:, :-1]) / np.sqrt(1.0 - rho[:, None] ** 2)


def residual_checks(residuals: np.ndarray, channels: Sequence[Channel] = ()) -> ResidualChecks:
    """Compare residuals with Gaussian white noise.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured minus simulated response at parameters that fit [SI unit of the channel]. NaN where a sample is
        missing.
    channels : sequence of Channel, optional
        The channels, one per row: their names and display units are printed in the table.

    Returns
    -------
    ResidualChecks

    Raises
    ------
    ValueError
        If the residuals have another shape, fewer than two samples, non-finite values, or only zeros in a channel, if
        a channel has no two successive samples, or if the number of channels differs from the number of rows.

    Notes
    -----
    The number of independent samples is n / (1 + 2 sum_k rho_k^2) with the autocorrelation rho_k: the one for sigma,
    and for a parameter whose sensitivity varies as fast as the errors. Intervals are too wide for a parameter whose
    sensitivity varies faster, and too narrow for one whose sensitivity varies more slowly, such as an offset;
    `fe_likelihoods.AutoregressiveNoise` makes this distinction.

    The lag-one correlation of n white residuals is approximately normal with standard deviation 1 / sqrt(n). Normality
    is tested with the statistic of Jarque and Bera [1]_, with the effective number of samples instead of n, so that
    correlation alone does not make the test significant. If `white` or `normal` is below 0.01, look at the plots of
    `fe_likelihoods.plot_residuals`.

    References
    ----------
    .. [1] C. M. Jarque, A. K. Bera (1987), "A test for normality of observations and regression residuals",
       International Statistical Review 55, 163-172, doi:10.2307/1403192.

    Examples
    --------
    >>> print(residual_checks(likelihood.residuals_of(model.simulate([1.1, 0.9])), model.channels))
    channel       unit      mean      sd  lag one  samples  independent  p white  p normal
    acceleration     g  -0.00376  0.0471    -0.07      200          178     0.36      0.31
    displacement    cm    -0.181    1.79    -0.21      200          180   0.0027      0.33
    """
    from scipy.special import chdtrc, ndtr  # slow to import, and every noise imports this module

    residuals = _checked(residuals, channels)
    if len(channels) not in (0, len(residuals)):
        raise ValueError(f"expected one channel per row of the residuals, {len(residuals)}; got {len(channels)}")
    n_effective = effective_samples(residuals)
    lag_one = autocorrelation(residuals)[:, 1]
    n, missing = residuals.shape[1], np.isnan(residuals)
    if missing.any():
        n = 1.0 + _pair_counts(missing)[:, 1]
        if not (n > 1.0).all():
            raise ValueError(
                f"{_listed(n == 1.0, channels)} have no two successive samples, so their lag-one "
                "correlation is unknown: check residuals with a longer step, without the missing samples between"
            )
    # rows without their missing samples; one array where none is missing
    groups = [row[None, ~gap] for row, gap in zip(residuals, missing, strict=True)] if missing.any() else [residuals]
    score = n_effective / 6.0 * np.concatenate([_departure(rows) for rows in groups])
    return ResidualChecks(
        mean=np.concatenate([rows.mean(axis=1) for rows in groups]),
        standard_deviation=np.concatenate([rows.std(axis=1) for rows in groups]),
        lag_one=lag_one,
        n_effective=n_effective,
        white=2.0 * ndtr(-np.sqrt(n) * np.abs(lag_one)),
        normal=chdtrc(2, score),
        n_samples=(~missing).sum(axis=1),
        channels=tuple(channels),
    )


def _departure(rows: np.ndarray) -> np.ndarray:
    """Squared skewness and a quarter of the squared excess kurtosis of rows (m, n), NaN for constant rows."""
    mean = rows.mean(axis=1, keepdims=True)
    squares = (rows - mean) ** 2
    variance = squares.mean(axis=1)
    variance[variance <= (np.finfo(float).eps * mean[:, 0]) ** 2] = np.nan
    skewness = (squares * (rows - mean)).mean(axis=1) / variance**1.5
    return skewness**2 + 0.25 * ((squares**2).mean(axis=1) / variance**2 - 3.0) ** 2


def _checked(residuals: np.ndarray, channels: Sequence[Channel] = ()) -> np.ndarray:
    residuals = np.asarray(residuals, dtype=float)
    if residuals.ndim != 2 or residuals.shape[1] < 2:
        raise ValueError(
            f"expected residuals of shape (n_channels, n_steps) with two samples or more; got {residuals.shape}"
        )
    missing = np.isnan(residuals)
    if np.isinf(residuals).any() or ((~missing).sum(axis=1) < 2).any():
        raise ValueError(
            "residuals must be finite, with two samples or more in each channel; these are not, perhaps because a "
            "simulation failed"
        )
    zero = ~np.nan_to_num(residuals).any(axis=1)
    if zero.any():
        raise ValueError(
            f"the residuals of {_listed(zero, channels)} are all zero and have no correlation; leave these channels out"
        )
    return residuals


def _listed(chosen: np.ndarray, channels: Sequence[Channel]) -> str:
    """Names of the chosen channels (n_channels,) bool, or their numbers if the names are not known."""
    places = np.flatnonzero(chosen).tolist()
    if len(channels) == len(chosen):
        return ", ".join(channels[place].name for place in places)
    return f"channels {places}"
