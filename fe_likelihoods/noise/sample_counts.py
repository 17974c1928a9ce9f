"""Sample counts for measurements with missing samples, as the noises need them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

__all__ = ["SampleCounts", "count_samples", "distinct_gaps", "samples_per_channel"]


class SampleCounts(NamedTuple):
    """Numbers of samples and of the distances between them, for measurements with missing samples."""

    samples: np.ndarray  # (n_channels,) without missing ones
    gaps: np.ndarray  # (n_gaps,) distinct distances between samples in all channels, ascending [steps]; 1: none missing
    transitions: np.ndarray  # (n_gaps, n_channels), how often each distance occurs


def count_samples(values: np.ndarray) -> int | SampleCounts:
    """Count samples (n_channels, n_steps): the number of steps if no sample is missing (NaN), else `SampleCounts`."""
    if not np.isnan(values).any():
        return values.shape[1]
    places = [np.flatnonzero(there) for there in ~np.isnan(values)]
    gaps = distinct_gaps(places)
    transitions = [np.bincount(np.searchsorted(gaps, np.diff(one)), minlength=len(gaps)) for one in places]
    return SampleCounts(np.array([len(one) for one in places]), gaps, np.array(transitions, dtype=int).T)


def distinct_gaps(places: Sequence[np.ndarray]) -> np.ndarray:
    """The field `gaps` of `SampleCounts`, shape (n_gaps,), from the sample places in each channel."""
    return np.flatnonzero(np.bincount(np.concatenate([np.diff(one) for one in places])))


def samples_per_channel(n_samples: int | SampleCounts) -> int | np.ndarray:
    """Number of samples per channel: one number for all channels, or (n_channels,) where samples are missing."""
    return n_samples.samples if isinstance(n_samples, SampleCounts) else n_samples
