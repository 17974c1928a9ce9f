"""White noise with a level of its own for every event of a structure, and the measurements of single events.

A specimen that is tested several times has other sensors, cables and model errors in every test. `EventNoise` has one
standard deviation per channel and event, which are inferred like those of `GaussianNoise`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.events import Events, events_of
from .gaussian import HALF_LOG_TWO_PI, GaussianNoise, Noise
from .sample_counts import SampleCounts

__all__ = ["EventNoise", "EventSums", "named_noise"]


@dataclass(frozen=True)
class EventSums:
    """Statistic of the residuals: sums of squares of every channel over all samples, then over those of each event.

    Parameters
    ----------
    windows : tuple of (int, int)
        First sample of each event, and the one after its last.
    """

    windows: tuple[tuple[int, int], ...]

    def __call__(self, residuals: np.ndarray) -> np.ndarray:
        """Return the sums (n_channels (1 + n_events),) [SI unit of the channel, squared], without NaN residuals."""
        squares = np.square(residuals)
        sums = [np.nansum(squares, axis=-1)]
        sums += [np.nansum(squares[:, first:stop], axis=-1) for first, stop in self.windows]
        return np.concatenate(sums)


@dataclass(frozen=True)
class EventNoise:
    """Independent white Gaussian noise with one unknown standard deviation per channel and event.

    Make it with `EventNoise.of`, or with ``FELikelihood(model, measurements, noise="per event")``. An event in which a
    channel was not measured has no parameter for it.

    Parameters
    ----------
    channels : tuple of Channel
        The measured channels.
    names : tuple of str
        Names of the events.
    windows : tuple of (int, int)
        Samples of each event: the first one, and the one after its last.
    samples : tuple of tuple of int
        Number of samples of each channel in each event.
    levels : tuple of (int, int)
        Event and channel of each parameter.

    Notes
    -----
    The log-likelihood is that of `GaussianNoise`, summed over the events. Predictions with ``noise=True`` have the
    levels of each event in that event, and no noise in the pauses and in channels that were not measured in the event.
    Under another record, ``noise="EQ1"`` has those of EQ1.
    """

    channels: tuple[Channel, ...]
    names: tuple[str, ...]
    windows: tuple[tuple[int, int], ...]
    samples: tuple[tuple[int, ...], ...]
    levels: tuple[tuple[int, int], ...]

    @classmethod
    def of(cls, events: Events, measurements: Measurements) -> "EventNoise":
        """Noise of measurements over the joined record of events.

        Parameters
        ----------
        events : Events
            The events.
        measurements : Measurements
            Measurements with one time step, such as the result of `Events.join`.

        Returns
        -------
        EventNoise

        Raises
        ------
        ValueError
            If the channels have times of their own, or a sample is outside of every event.
        """
        if not measurements.simultaneous or measurements.start != 0.0:
            raise ValueError(
                'noise="per event" needs channels with the same times, from the first sample of the record; use '
                "Events.join, or a noise for all events"
            )
        dt = measurements.dt
        windows = tuple(
            (math.ceil(each.start / dt - 1e-6), math.floor(each.end / dt + 1e-6) + 1) for each in events.windows
        )
        outside = ~np.isnan(measurements.values)
        for first, stop in windows:
            outside[:, first:stop] = False
        if outside.any():
            place = int(np.argmax(outside.any(axis=0)))
            raise ValueError(
                f"{int(outside.sum())} measured samples are outside of every event, the first at {place * dt:g} s; the "
                f"events are at {', '.join(f'{e.start:g} to {e.end:g} s' for e in events.windows)}: put NaN there, as "
                "Events.join does, or use a noise for all samples"
            )
        noise = cls(measurements.channels, events.names, windows, (), ()).with_measurements(measurements)
        levels = tuple(
            (event, row) for event, counts in enumerate(noise.samples) for row, count in enumerate(counts) if count > 0
        )
        return replace(noise, levels=levels)

    def __repr__(self) -> str:
        # display units change no value, so they are left out
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        return f"EventNoise({', '.join(named)}, {self.names}, {self.windows}, {self.samples}, {self.levels})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_<channel>_<event>``: standard deviations, each in the SI unit of its channel."""
        return tuple(f"sigma_{self.channels[row].name}_{self.names[event]}" for event, row in self.levels)

    @property
    def statistic(self) -> EventSums:
        """Statistic of the residuals."""
        return EventSums(self.windows)

    def deviations_per_event(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_events, n_channels) from parameters (n, n_levels); NaN where there is none."""
        found = np.full((len(parameters), len(self.names), len(self.channels)), np.nan)
        for column, (event, row) in enumerate(self.levels):
            found[:, event, row] = np.asarray(parameters, dtype=float)[:, column]
        return found

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> tuple["EventNoise", np.ndarray]:
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`.

        The level of a channel in an event is the mean of those with a weight that were measured in this event.
        """
        levels, rows = [], []
        for event in range(len(self.names)):
            measured = np.array([row if known == event else -1 for known, row in self.levels])
            for other, of_channels in enumerate(weights):
                row = np.where(measured >= 0, of_channels[measured], 0.0)
                if row.any():
                    levels.append((event, other))
                    rows.append(row / row.sum())
        noise = EventNoise(tuple(channels), self.names, self.windows, (), tuple(levels))
        return noise, np.array(rows).reshape(-1, len(self.levels))

    def with_measurements(self, measurements: Measurements) -> "EventNoise":
        """The same noise, with the same parameters, for other measurements of the same events and channels."""
        there = ~np.isnan(measurements.values)
        samples = tuple(tuple(there[:, first:stop].sum(axis=1).tolist()) for first, stop in self.windows)
        return replace(self, samples=samples)

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        statistics : (n, n_channels (1 + n_events)) float
            Those of `EventSums` [SI unit of the channel, squared]; NaN where the simulation failed.
        n_samples : int or SampleCounts
            Not used: the numbers of samples per event are those of the noise.
        parameters : (n, n_levels) float
            Standard deviations, in the order of `parameter_names` [SI unit of the channel].

        Returns
        -------
        (n,) float
            -inf where a standard deviation is not positive and where the statistics are not finite; never NaN.
        """
        sums = np.asarray(statistics, dtype=float).reshape(len(statistics), -1, len(self.channels))
        sigma = np.asarray(parameters, dtype=float)
        event, row = np.array(self.levels, dtype=int).reshape(-1, 2).T
        squares, counts = sums[:, 1 + event, row], np.array(self.samples, dtype=float)[event, row]
        with np.errstate(all="ignore"):
            # the ratio is squared instead of sigma: the square of a tiny sigma would be zero, and 0 / 0 for zero misfit
            ratio = np.sqrt(squares) / sigma
            terms = -counts * (HALF_LOG_TWO_PI + np.log(sigma)) - 0.5 * ratio * ratio
        possible = (sigma > 0.0) & np.isfinite(squares)
        return np.where(possible, terms, -np.inf).sum(axis=-1)


def named_noise(model: Any, measurements: Measurements, noise: Noise | str | None) -> Noise:
    """The noise that a likelihood was given: an object, None for `GaussianNoise`, or "per event".

    Raises
    ------
    ValueError
        If the text is another one, or the excitation of the model is not `Events`.
    """
    if noise is None:
        return GaussianNoise(model.channels)
    if not isinstance(noise, str):
        return noise
    if noise != "per event":
        raise ValueError(f'noise must be a noise, such as GaussianNoise(model.channels), or "per event"; got {noise!r}')
    return EventNoise.of(events_of(model), measurements)
