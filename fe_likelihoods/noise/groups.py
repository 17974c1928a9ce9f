"""Squared residuals summed in groups of orthonormal coordinates: sufficient statistics of Gaussian noise.

Errors are independent in the coordinates, with one variance per group. Coordinates are samples (groups are events, or
parts of the time) or coefficients of an orthonormal cosine transform (frequency bands), which preserves sums of squares
and densities. The statistics of a group are the number of coordinates, the sum of squared residuals and, for a variance
that depends on the response, the sum of squared response coordinates.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np

__all__ = ["BandSums", "EventSums", "GroupSums", "Layout", "PartSums", "split_sums", "stretches"]

_ROUND_OFF = 1e-6  # of a part
_ROUND_OFF_OF_FREQUENCY = 1e-9


class Layout(NamedTuple):
    """Times of the measured samples, and the number of coordinates in each group."""

    steps: tuple[float, ...]  # time step per channel [s]
    starts: tuple[float, ...]  # first sample time per channel [s]
    counts: tuple[tuple[int, ...], ...]  # (n_groups, n_channels)


class GroupSums(ABC):
    """Statistic of the residuals, and of the response if `of_response`: sums of squares in groups of coordinates."""

    of_response: bool

    def __call__(self, residuals: np.ndarray, response: np.ndarray | None = None) -> np.ndarray:
        """Return the sums (n_numbers,) [SI unit of the channel, squared]; samples with residuals of NaN are left out.

        Sums of squares (n_channels,): of all residuals, then of the residuals in each group, then of the response in
        each group.
        """
        there = ~np.isnan(residuals)
        histories = [residuals] if response is None else [residuals, response]
        sums = [self.powers(each, there) for each in histories]
        return np.concatenate([np.nansum(np.square(residuals), axis=1), *(each.ravel() for each in sums)])

    @abstractmethod
    def powers(self, histories: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Sums of squared coordinates (n_groups, n_channels) for histories (n_channels, n_steps)."""

    @abstractmethod
    def counts(self, there: np.ndarray) -> np.ndarray:
        """Number of coordinates (n_groups, n_channels), from whether samples are present (n_channels, n_steps)."""


@dataclass(frozen=True)
class EventSums(GroupSums):
    """Groups are the samples of events."""

    windows: tuple[tuple[int, int], ...]  # first sample of each event, and the one after its last

    of_response: ClassVar[bool] = False

    def powers(self, histories: np.ndarray, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        squares = np.where(there, np.square(histories), 0.0)
        return np.stack([squares[:, first:stop].sum(axis=-1) for first, stop in self.windows])

    def counts(self, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        return np.stack([there[:, first:stop].sum(axis=-1) for first, stop in self.windows])


@dataclass(frozen=True)
class PartSums(GroupSums):
    """Groups are the samples in equal parts of the time, from time zero on."""

    part: float  # length [s]
    steps: tuple[float, ...]  # time step per channel [s]
    starts: tuple[float, ...]  # first sample time per channel [s]

    of_response: ClassVar[bool] = True

    def powers(self, histories: np.ndarray, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        places, squares = _places(self, there.shape[1]), np.square(histories)
        rows = [
            np.bincount(place[known], row[known], minlength=int(places.max()) + 1)
            for row, place, known in zip(squares, places, there, strict=True)
        ]
        return np.stack(rows, axis=1)

    def counts(self, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        return self.powers(np.ones(there.shape), there).astype(int)

    def in_time(self, deviations: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Standard deviations of samples (n_channels, n_steps) from group deviations; NaN where a sample is missing."""
        found = np.take_along_axis(deviations.T, _places(self, there.shape[1]), axis=1)
        return np.where(there, found, np.nan)

    def whitened(self, residuals: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals divided by their standard deviations, and the log standard deviations, at each sample."""
        levels = self.in_time(deviations, ~np.isnan(residuals))
        return residuals / levels, np.log(levels)


@lru_cache(maxsize=64)  # the same for every simulation
def _places(sums: PartSums, n_steps: int) -> np.ndarray:
    """Part of each sample (n_channels, n_steps)."""
    times = np.array(sums.starts)[:, None] + np.array(sums.steps)[:, None] * np.arange(n_steps)
    places = np.maximum(np.floor(times / sums.part + _ROUND_OFF).astype(int), 0)
    places.flags.writeable = False
    return places


@dataclass(frozen=True)
class BandSums(GroupSums):
    """Groups are coefficients of the orthonormal cosine transform (DCT-II) in frequency bands.

    A stretch is a run of samples without a gap; each stretch is transformed separately. Groups are the bands of the
    first stretch from low to high, then the bands of the next one.
    """

    edges: tuple[float, ...]  # frequencies between the bands [Hz]
    steps: tuple[float, ...]  # time step per channel [s]
    of_response: bool  # sums of the response are needed too

    def powers(self, histories: np.ndarray, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        from scipy.fft import dct  # imported here because it is slow to import and rarely needed

        return self._collect(there, lambda c, samples: np.square(dct(histories[c, samples], norm="ortho")))

    def counts(self, there: np.ndarray) -> np.ndarray:
        """See `GroupSums`."""
        return self._collect(there, lambda c, samples: np.ones(samples.stop - samples.start)).astype(int)

    def _collect(self, there: np.ndarray, values_of: Callable[[int, slice], np.ndarray]) -> np.ndarray:
        n_bands = len(self.edges) + 1
        sums = np.zeros((max(len(list(stretches(row))) for row in there), n_bands, len(there)))
        for c, k, samples, bands in self._stretches(there):
            sums[k, :, c] = np.bincount(bands, values_of(c, samples), minlength=n_bands)
        return sums.reshape(-1, len(there))

    def in_time(self, deviations: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Standard deviations of samples (n_channels, n_steps) from group deviations; NaN where a sample is missing."""
        return self._filled(there, deviations, lambda c, samples, spectrum: np.sqrt(_variances_in_time(spectrum**2)))

    def errors(self, normal: np.ndarray, deviations: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Errors (n_channels, n_steps) from standard normal numbers; NaN where a sample is missing."""
        from scipy.fft import idct

        return self._filled(
            there, deviations, lambda c, samples, spectrum: idct(spectrum * normal[c, samples], norm="ortho")
        )

    def whitened(self, residuals: np.ndarray, deviations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals, and the mean log standard deviation of the coefficients, at each sample.

        Multiplication with the symmetric inverse square root of the covariance gives whitened residuals without delay.
        """
        from scipy.fft import dct, idct

        there = ~np.isnan(residuals)
        white = self._filled(
            there,
            deviations,
            lambda c, samples, spectrum: idct(dct(residuals[c, samples], norm="ortho") / spectrum, norm="ortho"),
        )
        return white, self._filled(there, deviations, lambda c, samples, spectrum: np.log(spectrum).mean())

    def _filled(
        self, there: np.ndarray, deviations: np.ndarray, values_of: Callable[[int, slice, np.ndarray], np.ndarray]
    ) -> np.ndarray:
        """Values (n_channels, n_steps), computed stretch by stretch from the coefficients' standard deviations."""
        found, deviations = np.full(there.shape, np.nan), deviations.reshape(-1, len(self.edges) + 1, len(there))
        for c, k, samples, bands in self._stretches(there):
            found[c, samples] = values_of(c, samples, deviations[k, bands, c])
        return found

    def _stretches(self, there: np.ndarray) -> Iterator[tuple[int, int, slice, np.ndarray]]:
        """Channel, number and samples of each stretch, and the bands of its coefficients."""
        for c, row in enumerate(there):
            for k, samples in enumerate(stretches(row)):
                yield c, k, samples, _bands(self.edges, samples.stop - samples.start, self.steps[c])


@lru_cache(maxsize=64)  # the same for every simulation
def _bands(edges: tuple[float, ...], n: int, dt: float) -> np.ndarray:
    """Band of each coefficient (n,) of n samples: coefficient k has the frequency k / (2 n dt)."""
    frequencies = np.arange(n) / (2.0 * n * dt)
    bands = np.searchsorted(edges, frequencies * (1.0 + _ROUND_OFF_OF_FREQUENCY), side="right")
    bands.flags.writeable = False
    return bands


def _variances_in_time(spectrum: np.ndarray) -> np.ndarray:
    """Variances (n,) of samples whose DCT-II coefficients are independent, with the variances `spectrum` (n,).

    The squared basis functions are (1 + cos(2 pi k (t + 1/2) / n)) / n for k > 0, and 1 / n for k = 0.
    """
    n = len(spectrum)
    shifted = spectrum * np.exp(1j * np.pi * np.arange(n) / n)
    shifted[0] = 0.0
    return spectrum.mean() + np.fft.ifft(shifted).real


def stretches(there: np.ndarray) -> Iterator[slice]:
    """Samples of each stretch without a gap, from whether each sample is present (n_steps,)."""
    edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
    for first, stop in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(first), int(stop))


def split_sums(statistics: np.ndarray, n_channels: int, n_groups: int) -> list[np.ndarray]:
    """Sums (n, n_groups, n_channels) of the residuals, then of the response, from statistics (n, n_numbers).

    The sums over all samples, which come first, are left out: they are the totals of the group sums.
    """
    rows = statistics.reshape(len(statistics), statistics.shape[1] // n_channels, n_channels)[:, 1:]
    return [rows[:, first : first + n_groups] for first in range(0, rows.shape[1], n_groups)]
