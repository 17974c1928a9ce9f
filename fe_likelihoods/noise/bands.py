r"""Gaussian noise with a standard deviation for each band of frequency: errors that are correlated in time.

Errors of a model are correlated in time, because the model is wrong in some bands of frequency and right in others.
`BandNoise` takes the discrete cosine transform (DCT-II, orthonormal) of the errors. Its coefficients are independent
and Gaussian, and those of one band have one variance. The transform keeps sums of squares and volumes, so that the
likelihood of the samples is exact, without a matrix, and the sums of squares per band are sufficient.

The parameters are shares of the simulated response in each band, which transfer to other motions, or root mean squares
of the error in each band in SI units. See ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..signals.channels import Channel, Measurements
from .gaussian import HALF_LOG_TWO_PI, PerChannel, numbers, options_repr, set_channels, weighted
from .grouped import MeasuredLayout, grouped_log_likelihood, per_channel, split_sums, without_layout
from .sample_counts import SampleCounts

__all__ = ["BandNoise", "BandSums"]

_ROUND_OFF = 1e-9  # of a frequency


@dataclass(frozen=True)
class BandSums:
    """Statistic of the residuals: sums of squared coefficients of the cosine transform in bands of frequency.

    Samples without a gap between them are a stretch, which is transformed by itself.

    Parameters
    ----------
    edges : tuple of float
        Frequencies between the bands [Hz].
    steps : tuple of float
        Time step of each channel [s].
    of_response : bool
        Whether the sums of the response are needed too.
    """

    edges: tuple[float, ...]
    steps: tuple[float, ...]
    of_response: bool

    def __call__(self, residuals: np.ndarray, response: np.ndarray | None = None) -> np.ndarray:
        """Return the sums (n_numbers,) [SI unit of the channel, squared].

        Those of the squared residuals of all samples, then those of the coefficients of the residuals in each band,
        first of the first stretch, then those of the response; (n_channels,) each.
        """
        there = ~np.isnan(residuals)
        histories = [residuals] if response is None else [residuals, response]
        sums = [self.powers(each, there) for each in histories]
        return np.concatenate([np.nansum(np.square(residuals), axis=1), *(each.ravel() for each in sums)])

    def powers(self, histories: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Sums of squared coefficients (n_stretches * n_bands, n_channels) of histories (n_channels, n_steps)."""
        from scipy.fft import dct  # imported here because it is slow to import and rarely needed

        return self._collect(there, lambda c, samples: np.square(dct(histories[c, samples], norm="ortho")))

    def counts(self, there: np.ndarray) -> np.ndarray:
        """Number of coefficients (n_stretches * n_bands, n_channels), from whether samples are there."""
        return self._collect(there, lambda c, samples: np.ones(samples.stop - samples.start)).astype(int)

    def _collect(self, there: np.ndarray, values_of: Callable[[int, slice], np.ndarray]) -> np.ndarray:
        n_bands = len(self.edges) + 1
        found = [list(stretches(row)) for row in there]
        sums = np.zeros((max(map(len, found)), n_bands, len(there)))
        for c, each in enumerate(found):
            for k, samples in enumerate(each):
                bands = self.bands(samples.stop - samples.start, self.steps[c])
                sums[k, :, c] = np.bincount(bands, values_of(c, samples), minlength=n_bands)
        return sums.reshape(-1, len(there))

    def bands(self, n: int, dt: float) -> np.ndarray:
        """Band of each coefficient (n,) of n samples: coefficient k has the frequency k / (2 n dt)."""
        return _bands(self.edges, n, dt)


@lru_cache(maxsize=64)  # the same for every simulation
def _bands(edges: tuple[float, ...], n: int, dt: float) -> np.ndarray:
    frequencies = np.arange(n) / (2.0 * n * dt)
    bands = np.searchsorted(edges, frequencies * (1.0 + _ROUND_OFF), side="right")
    bands.flags.writeable = False
    return bands


def stretches(there: np.ndarray) -> Iterator[slice]:
    """Samples of each stretch without a gap, from whether each sample is there (n_steps,)."""
    if there.all():
        yield slice(0, len(there))
        return
    edges = np.flatnonzero(np.diff(np.concatenate([[False], there, [False]]).astype(int)))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(first), int(stop))


@dataclass(frozen=True)
class BandNoise:
    """Gaussian noise with one unknown level per channel and band of frequency.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the model.
    edges : sequence of float
        Frequencies between the bands [Hz], ascending: ``(1, 5)`` makes the three bands below 1 Hz, from 1 to 5 Hz, and
        above. The last edge must be below half the sampling frequency.
    relative : bool
        Whether the parameters are shares of the simulated response in the band (the default), or root mean squares of
        the error in the band, in SI units.
    sensor : mapping of channel names to float, or sequence of float
        Known standard deviation of the white noise of each sensor [SI unit of the channel], as for `GaussianNoise`. It
        must be positive for shares, because a response may have nothing in a band.
    layout : MeasuredLayout, optional
        Number of coefficients in each band; set by the likelihood (`with_measurements`).

    Raises
    ------
    ValueError
        If the edges are not positive and ascending, or the sensor noise is missing.

    Notes
    -----
    With the coefficients of the DCT-II, orthonormal, of the residuals, z_k at the frequency k / (2 n dt)::

        log L = sum_k [ -1/2 log(2 pi) - log(sigma_k) - z_k^2 / (2 sigma_k^2) ]
        sigma_k^2 = sensor^2 + (share_b u_b)^2          shares: u_b^2 is the mean square of the n_b coefficients of the
                                                        simulated response in the band b of k
        sigma_k^2 = sensor^2 + sigma_b^2 n / n_b        SI units: sigma_b is the root mean square of the errors in b

    This is the multivariate normal density of the samples with the covariance C = D^T diag(sigma_k^2) D, with the
    matrix D of the transform. It is a normalised density of the measurements in both cases, so evidences can be
    compared. The errors are stationary in time except near the ends, where they are reflected.

    Missing samples divide a channel into stretches. Each is transformed by itself, its errors are independent of those
    of the others, and shares refer to the response of the stretch. This suits events with pauses; stretches that are
    shorter than a period of the lowest edge are refused. In predictions the whole response is one stretch.

    A simulation is cached with one sum per band and channel, and with twice as many for shares. Samplers can use a
    guide with SI units; with shares they cannot, because the level depends on the response.

    Examples
    --------
    >>> noise = BandNoise(model.channels, edges=(1.0, 5.0), sensor={"top": 0.005})
    >>> shares = {name: HalfNormal(0.5) for name in noise.parameter_names}  # share_top_band1, ...
    >>> posterior = Posterior(FELikelihood(model, measurements, noise), prior | shares)
    >>> propagate(posterior, samples, record=weaker, noise=True)
    """

    channels: tuple[Channel, ...]
    edges: tuple[float, ...]
    relative: bool
    sensor: tuple[float, ...] | None
    layout: MeasuredLayout | None

    def __init__(
        self,
        channels: Sequence[Channel],
        edges: Sequence[float],
        *,
        relative: bool = True,
        sensor: PerChannel = None,
        layout: MeasuredLayout | None = None,
    ) -> None:
        object.__setattr__(self, "edges", numbers(self, "edges", edges, "[Hz]"))
        ascending = all(low < high for low, high in zip((0.0, *self.edges), self.edges, strict=False))
        if not self.edges or not ascending or not self.edges[-1] < math.inf:
            raise ValueError(
                "BandNoise expects ascending positive frequencies between the bands [Hz], such as (1.0, 5.0); got "
                f"{edges!r}. For one band use GaussianNoise"
            )
        object.__setattr__(self, "relative", bool(relative))
        set_channels(self, channels, sensor)
        if relative and (self.sensor is None or not all(value > 0.0 for value in self.sensor)):
            raise ValueError(
                "BandNoise with shares needs the noise of the sensor of each channel, a positive standard deviation in "
                f"SI units, for bands in which the response is zero; got {sensor!r}. Take it from the quiet part "
                "before the motion, or set relative=False for levels in SI units"
            )
        object.__setattr__(self, "layout", layout)

    def __repr__(self) -> str:
        # display units and the layout, which the measurements determine, change no value of the likelihood
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        options = [f"edges={self.edges!r}", f"relative={self.relative!r}", *options_repr(self.sensor)]
        return f"BandNoise({', '.join(named + options)})"

    @property
    def n_bands(self) -> int:
        """Number of bands."""
        return len(self.edges) + 1

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``share_<channel>_band1`` [-], or ``sigma_<channel>_band1`` [SI], ...: of each channel from low to high."""
        kind, bands = "share" if self.relative else "sigma", range(1, self.n_bands + 1)
        return tuple(f"{kind}_{channel.name}_band{band}" for channel in self.channels for band in bands)

    @property
    def statistic(self) -> BandSums:
        """Statistic of the residuals, and with shares of the response."""
        if self.layout is None:
            raise without_layout(self)
        return BandSums(self.edges, self.layout.steps, self.relative)

    def with_measurements(self, measurements: Measurements) -> "BandNoise":
        """The same noise for the times of these measurements.

        Raises
        ------
        ValueError
            If a band is above half the sampling frequency, or gaps leave a stretch that is shorter than a period of the
            lowest edge.
        """
        steps, there = tuple(measurements.steps), ~np.isnan(measurements.values)
        for channel, step, row in zip(measurements.channels, steps, there, strict=True):
            if not self.edges[-1] < 0.5 / step:
                raise ValueError(
                    f"BandNoise: channel {channel.name!r} has a step of {step:g} s and contains frequencies below "
                    f"{0.5 / step:g} Hz; the last band begins at {self.edges[-1]:g} Hz: leave that edge out"
                )
            found = list(stretches(row))
            short = [each for each in found if (each.stop - each.start) * step * self.edges[0] < 1.0]
            if len(found) > 1 and short:
                place = short[0]
                raise ValueError(
                    f"BandNoise: gaps divide channel {channel.name!r} into {len(found)} stretches, of which "
                    f"{len(short)} are shorter than a period of the lowest edge, {self.edges[0]:g} Hz; the first has "
                    f"{place.stop - place.start} samples from {measurements.times(channel.name)[place.start]:g} s on. "
                    "Replace short stretches by NaN, fill short gaps, or use AutoregressiveNoise, which bridges "
                    "gaps"
                )
        counts = BandSums(self.edges, steps, self.relative).counts(there)
        layout = MeasuredLayout(steps, tuple(measurements.starts), tuple(map(tuple, counts.tolist())))
        return replace(self, layout=layout)

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        statistics : (n, n_numbers) float
            Those of `BandSums` [SI unit of the channel, squared]; NaN where the simulation failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel where samples are missing.
        parameters : (n, n_channels n_bands) float
            Parameters of the noise: bands of the first channel, then those of the next.

        Returns
        -------
        (n,) float
            -inf for impossible parameters (negative; zero without sensor noise), and where the statistics are not
            finite; never NaN.
        """
        if self.layout is None:
            raise without_layout(self)
        counts = np.array(self.layout.counts)
        sums = split_sums(statistics, counts)
        powers = sums[1] if self.relative else None
        deviations = self._deviations(np.asarray(parameters, dtype=float), counts, powers)
        return grouped_log_likelihood(sums[0], counts, deviations, n_samples)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) of the errors [SI]; NaN for negative parameters.

        With shares: where the response is zero. Those of a response are `response_deviations`.
        """
        parameters = np.asarray(parameters, dtype=float)
        each = parameters.reshape(len(parameters), len(self.channels), self.n_bands)
        levels = np.zeros(each.shape[:2]) if self.relative else np.sqrt(np.square(each).sum(axis=2))
        return np.where((each >= 0.0).all(axis=2), np.hypot(levels, self._floor), np.nan)

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> "tuple[BandNoise, np.ndarray]":
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`."""
        others = replace(self, channels=channels, sensor=weighted(self.sensor, weights), layout=None)
        return others, np.kron(weights, np.eye(self.n_bands))

    def response_deviations(
        self, parameters: np.ndarray, response: np.ndarray, dt: float | Sequence[float] | None = None
    ) -> np.ndarray:
        """Standard deviations of the errors of a simulated response at each step.

        Parameters
        ----------
        parameters : (n_channels n_bands,) float
            Parameters of the noise.
        response : (n_channels, n_steps) float
            Response [SI unit of each channel]; NaN where a sample is missing.
        dt : float or sequence of float, optional
            Its time step [s]. Default: the response is at the measured samples.

        Returns
        -------
        (n_channels, n_steps) float
            [SI unit of each channel]; NaN where the response is. Nearly constant in time, except near the ends.
        """
        found = np.full(np.shape(response), np.nan)
        for c, samples, deviations in self._spectra(parameters, response, dt):
            found[c, samples] = np.sqrt(_variances_in_time(np.square(deviations)))
        return found

    def response_errors(
        self,
        parameters: np.ndarray,
        response: np.ndarray,
        normal: np.ndarray,
        dt: float | Sequence[float] | None = None,
        sensor: bool = True,
    ) -> np.ndarray:
        """Errors (n_channels, n_steps) [SI] of a simulated response, from independent standard normal numbers.

        Parameters
        ----------
        parameters, response, dt
            As for `response_deviations`.
        normal : (n_channels, n_steps) float
            The standard normal numbers.
        sensor : bool
            Whether the errors contain the noise of the sensors. Without it they are those of the model.
        """
        from scipy.fft import idct

        found = np.full(np.shape(response), np.nan)
        for c, samples, deviations in self._spectra(parameters, response, dt):
            if not sensor:  # the sensor's noise is white: the same variance in each coefficient
                deviations = np.sqrt(np.maximum(np.square(deviations) - self._floor[c] ** 2, 0.0))
            found[c, samples] = idct(deviations * normal[c, samples], norm="ortho")
        return found

    def whitened(self, residuals: np.ndarray, response: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Residuals whose coefficients are divided by their standard deviations: white, of variance one, if it fits.

        Parameters
        ----------
        residuals, response : (n_channels, n_samples) float
            At the measured samples [SI unit of each channel]; NaN where a sample is missing.
        parameters : (n_channels n_bands,) float
            Parameters of the noise.

        Returns
        -------
        (n_channels, n_samples) float
            [-], for `fe_likelihoods.residual_checks`. They have no delay: the matrix is the symmetric inverse square
            root of the covariance.
        """
        return self._whitened(residuals, response, parameters)[0]

    def log_densities(self, residuals: np.ndarray, response: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Terms (n_channels, n_samples) of the log-likelihood, of which each belongs to one sample; arguments as above.

        Their sum is the log-likelihood: the density of the whitened residual and, in equal parts, the logarithm of the
        determinant. Zero where a sample is missing.
        """
        white, logarithms = self._whitened(residuals, response, parameters)
        return np.nan_to_num(-HALF_LOG_TWO_PI - logarithms - 0.5 * np.square(white), nan=0.0)

    def _whitened(
        self, residuals: np.ndarray, response: np.ndarray, parameters: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals, and the mean logarithm of the standard deviations at each sample."""
        from scipy.fft import dct, idct

        white, logarithms = np.full(residuals.shape, np.nan), np.full(residuals.shape, np.nan)
        response = np.where(np.isnan(residuals), np.nan, response)
        for c, samples, deviations in self._spectra(parameters, response, None):
            white[c, samples] = idct(dct(residuals[c, samples], norm="ortho") / deviations, norm="ortho")
            logarithms[c, samples] = np.log(deviations).mean()
        return white, logarithms

    def _spectra(
        self, parameters: np.ndarray, response: np.ndarray, dt: float | Sequence[float] | None
    ) -> Iterator[tuple[int, slice, np.ndarray]]:
        """Channel, samples and standard deviations of the coefficients (n,) of each stretch of a response."""
        response = np.asarray(response, dtype=float)
        sums = self.statistic if dt is None else BandSums(self.edges, per_channel(dt, len(response)), self.relative)
        there = ~np.isnan(response)
        counts = sums.counts(there)
        powers = sums.powers(response, there)[None] if self.relative else None
        deviations = self._deviations(np.asarray(parameters, dtype=float)[None], counts, powers)[0]
        deviations = deviations.reshape(-1, self.n_bands, len(response))
        for c, row in enumerate(there):
            for k, samples in enumerate(stretches(row)):
                bands = sums.bands(samples.stop - samples.start, sums.steps[c])
                yield c, samples, deviations[k, bands, c]

    @property
    def _floor(self) -> np.ndarray:
        return np.zeros(len(self.channels)) if self.sensor is None else np.array(self.sensor)

    def _deviations(self, parameters: np.ndarray, counts: np.ndarray, powers: np.ndarray | None) -> np.ndarray:
        """Standard deviations (n, n_stretches n_bands, n_channels) of the coefficients; NaN for negative parameters."""
        n_channels, n_bands = len(self.channels), self.n_bands
        levels = parameters.reshape(len(parameters), n_channels, n_bands).transpose(0, 2, 1)
        levels = np.tile(levels, (1, len(counts) // n_bands, 1))
        if powers is None:
            samples = counts.reshape(-1, n_bands, n_channels).sum(axis=1)
            squares = np.repeat(samples, n_bands, axis=0)[None] / np.maximum(counts, 1)
        else:
            squares = powers / np.maximum(counts, 1)
        with np.errstate(invalid="ignore"):
            return np.where(levels >= 0.0, np.hypot(self._floor, levels * np.sqrt(squares)), np.nan)


def _variances_in_time(spectrum: np.ndarray) -> np.ndarray:
    """Variances (n,) of samples whose DCT-II coefficients are independent, with the variances `spectrum` (n,).

    The squared basis functions are (1 + cos(2 pi k (t + 1/2) / n)) / n for k > 0, and 1 / n for k = 0.
    """
    n = len(spectrum)
    shifted = spectrum * np.exp(1j * np.pi * np.arange(n) / n)
    shifted[0] = 0.0
    return spectrum.mean() + np.fft.ifft(shifted).real
