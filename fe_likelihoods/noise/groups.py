"""Squared residuals summed in groups of samples, which are events or parts of the time: statistics of Gaussian noise.

Errors have one variance per group. The statistics of a group are the number of samples, the sum of squared residuals
and, for a variance that depends on the response, the sum of squared samples of the response.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np

from ..signals.sampling import SAME_TIME


class Layout(NamedTuple):
    """Times of the measured samples, and the number of samples in each group."""

    steps: tuple[float, ...]  # time step per channel [s]
    starts: tuple[float, ...]  # first sample time per channel [s]
    counts: tuple[tuple[int, ...], ...]  # (n_groups, n_channels)


class GroupSums(ABC):
    """Statistic of the residuals, and of the response if `of_response`: sums of squares in groups of samples."""

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
        """Sums of squared samples (n_groups, n_channels) for histories (n_channels, n_steps)."""

    @abstractmethod
    def counts(self, there: np.ndarray) -> np.ndarray:
        """Number of samples (n_groups, n_channels), from whether samples are present (n_channels, n_steps)."""


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

    def whitened(self, residuals: np.ndarray, deviations: np.ndarray) -> np.ndarray:
        """Residuals divided by their standard deviations at each sample."""
        return residuals / self.in_time(deviations, ~np.isnan(residuals))


@lru_cache(maxsize=64)  # the same for every simulation
def _places(sums: PartSums, n_steps: int) -> np.ndarray:
    """Part of each sample (n_channels, n_steps)."""
    times = np.array(sums.starts)[:, None] + np.array(sums.steps)[:, None] * np.arange(n_steps)
    places = np.maximum(np.floor(times / sums.part + SAME_TIME).astype(int), 0)
    places.flags.writeable = False
    return places


def split_sums(statistics: np.ndarray, n_channels: int, n_groups: int) -> list[np.ndarray]:
    """Sums (n, n_groups, n_channels) of the residuals, then of the response, from statistics (n, n_numbers).

    The sums over all samples, which come first, are left out: they are the totals of the group sums.
    """
    rows = statistics.reshape(len(statistics), statistics.shape[1] // n_channels, n_channels)[:, 1:]
    return [rows[:, first : first + n_groups] for first in range(0, rows.shape[1], n_groups)]
