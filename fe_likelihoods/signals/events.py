"""Several records on one structure, one after the other: `Events` is one loading and knows the times of its events.

The state of the structure is carried from event to event, because a model simulates the joined record as one. Cracks,
yielded bars and residual displacements after one event are the initial state of the next event.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .channels import Channel, Measurements
from .records import Record
from .sampling import expect, rest_samples, same_step


class EventWindow(NamedTuple):
    """Place of one event in the joined record."""

    name: str
    first: int  # index of its first sample
    stop: int  # index after its last sample
    start: float  # time of its first sample [s]
    end: float  # time of its last sample [s]

    @property
    def samples(self) -> slice:
        """Samples of the event in the joined record."""
        return slice(self.first, self.stop)


@dataclass(frozen=True, eq=False, init=False)
class Events(Record):
    """Records that follow each other on one structure, with pauses without ground motion between them.

    The object is a `Record`: a model takes it as its excitation. `trim` returns a plain `Record`, without events.

    Parameters
    ----------
    records : sequence of Record
        The events in chronological order, with the same time step. `Events` in the sequence are split into their
        records, and keep their pauses.
    rest : float or sequence of float
        Length of the pauses [s], zero or more, rounded to whole time steps; a sequence has one for each pause. The
        pause should be long enough for the free vibration to decay, as it was in the test.
    names : sequence of str, optional
        Names of the events, which must differ. Default: the names of the records; a repeated name gets a number ("EQ1",
        "EQ1_2").

    Attributes
    ----------
    records : tuple of Record
        The events.
    windows : tuple of EventWindow
        Names, times and samples of the events.
    rests : tuple of float
        The pauses between the events [s], in whole time steps.

    Raises
    ------
    ValueError
        If there are no records, their time steps differ, a pause is negative (the events would overlap), or names are
        repeated or do not match the records.

    Examples
    --------
    >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
    >>> response = LinearOscillator(events).simulate([1.0, 1.0])
    >>> response[:, events.window("second").samples].shape
    (2, 200)
    """

    records: tuple[Record, ...]
    windows: tuple[EventWindow, ...]
    rests: tuple[float, ...]

    def __init__(
        self, records: Sequence[Record], rest: float | Sequence[float] = 10.0, names: Sequence[str] | None = None
    ) -> None:
        given = [records] if isinstance(records, Record) else list(records)
        found = ", ".join(type(record).__name__ for record in given) or "none"
        known = given and all(isinstance(record, Record) for record in given)
        expect(known, "Events", "a sequence of one Record or more", found)
        parts, pauses, names = _flatten(given, rest, names)
        for part in parts[1:]:
            got = f"{parts[0].dt!r} s ({parts[0].name!r}) and {part.dt!r} s ({part.name!r})"
            alike = same_step(parts[0].dt, part.dt)
            expect(alike, "Events", "records of the same time step", got, "use Record.resample(dt) on one of them")
        dt = parts[0].dt
        zeros = [rest_samples(pause, dt) for pause in pauses]
        samples, windows, first = [], [], 0
        for part, name, n_zeros in zip(parts, names, [*zeros, 0], strict=True):
            stop = first + part.n_steps
            windows.append(EventWindow(name, first, stop, first * dt, (stop - 1) * dt))
            samples += [part.acceleration, np.zeros(n_zeros)]
            first = stop + n_zeros
        source = "; ".join(f"{name}: {part.source}" for name, part in zip(names, parts, strict=True))
        super().__init__(", ".join(names), dt, np.concatenate(samples), source)
        rests = tuple(n * dt for n in zeros)
        for field, value in {"records": tuple(parts), "windows": tuple(windows), "rests": rests}.items():
            object.__setattr__(self, field, value)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the events."""
        return tuple(window.name for window in self.windows)

    def window(self, name: str) -> EventWindow:
        """Return the window of one event; raise ValueError if there is no event of this name.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> events.window("second").start
        15.0
        """
        if name not in self.names:
            raise ValueError(f"no event {name!r}; the events are {', '.join(self.names)}")
        return self.windows[self.names.index(name)]

    def split(self, values: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """Return the parts of histories (..., n_steps) over the joined record by event, without the pauses.

        ValueError if the histories and the joined record have different numbers of samples.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> response = LinearOscillator(events).simulate([1.0, 1.0])
        >>> {name: part.shape for name, part in events.split(response).items()}
        {'first': (2, 200), 'second': (2, 200)}
        """
        values = np.asarray(values)
        expect(values.shape[-1:] == (self.n_steps,), self.name, f"histories of {self.n_steps} samples", values.shape)
        return {window.name: values[..., window.samples] for window in self.windows}

    def join(self, measurements: Mapping[str, Measurements]) -> Measurements:
        """Put the measurements of single events, by name, at their times in the joined record.

        Time zero of the measurements is the first sample of the event; all have the same time step. An event may be
        left out: it then only changes the state of the structure. A channel may be missing in some events. The result
        has all channels over the joined record, with NaN in the pauses and wherever nothing was measured. ValueError if
        there are no measurements, an event is unknown, the steps differ, samples are outside of their event or between
        the steps of the joined record, or a channel has another quantity in another event.

        Examples
        --------
        >>> events = Events([record, record.scale(2.0)], rest=5.0, names=["first", "second"])
        >>> joined = events.join({"first": measurements, "second": measurements})  # NaN in the pause
        >>> joined.values.shape
        (2, 500)
        """
        given = isinstance(measurements, Mapping) and measurements
        expect(given, self.name, f"Measurements for one or more of {', '.join(self.names)}", repr(measurements))
        windows = {name: self.window(name) for name in measurements}
        first = next(iter(measurements.values()))
        channels: dict[str, Channel] = {}
        for name, each in measurements.items():
            alike = isinstance(each, Measurements) and each.simultaneous and same_step(first.dt, each.dt)
            advice = "use Measurements.decimate, or join channels with different steps by NaN in one Measurements"
            expect(alike, f"measurements of {name!r}", "one time step for all channels and events", "others", advice)
            for channel in each.channels:
                known = channels.setdefault(channel.name, channel)
                got = f"{channel.quantity!r} in {name!r}"
                alike, what = known.quantity == channel.quantity, f"channel {channel.name!r}"
                expect(alike, what, f"{known.quantity!r} as in another event", got, "rename one of them")
        dt = first.dt
        values = np.full((len(channels), math.floor(self.duration / dt * (1 + 1e-12)) + 1), np.nan)
        rows = {name: row for row, name in enumerate(channels)}
        for name, each in measurements.items():
            end, duration = each.start + (each.n_steps - 1) * dt, self.records[self.names.index(name)].duration
            within = each.start >= -1e-9 * duration and end <= duration * (1 + 1e-9)  # not in a pause or another event
            expected = f"samples in the event from 0, its first sample, to {duration:g} s"
            got = f"measurements from {each.start:g} to {end:g} s"
            expect(within, repr(name), expected, got, "use Measurements.trim(start, stop)")
            time = windows[name].start + each.start
            start = round(time / dt)
            expected = f"a first sample at a multiple of the step {dt:g} s of the measurements in the joined record"
            advice = "choose pauses after which every event begins at such a multiple"
            expect(abs(time - start * dt) <= 1e-6 * dt, repr(name), expected, f"{time:g} s", advice)
            for channel, samples in zip(each.channels, each.values, strict=True):
                values[rows[channel.name], start : start + each.n_steps] = samples
        described = [f"{name}: {each.description}" for name, each in measurements.items() if each.description]
        return Measurements(tuple(channels.values()), dt, values, "; ".join(described))

    def resample(self, dt: float) -> Events:
        """Return the events with another time step, each resampled separately by `Record.resample`."""
        return Events([record.resample(dt) for record in self.records], self.rests, self.names)

    def scale(self, factor: float) -> Events:
        """Return the events with all samples multiplied by `factor`; ValueError if it is not finite."""
        return Events([record.scale(factor) for record in self.records], self.rests, self.names)

    def followed_by(self, other: Record, rest: float = 10.0) -> Events:
        """Return these events, a pause of `rest` [s] and another record or further events; see `Record.followed_by`."""
        return Events([self, other], rest)


def _flatten(
    given: list[Record], rest: float | Sequence[float], names: Sequence[str] | None
) -> tuple[list[Record], list[float], list[str]]:
    """All records with those of `Events` among them, the pauses between them, and their names, each once."""
    n = len(given) - 1
    pauses = [rest] * n if isinstance(rest, str | Mapping) or np.ndim(rest) == 0 else list(rest)
    if len(pauses) != n:
        raise ValueError(f"expected one pause, or one for each of the {n} pauses between the records; got {rest!r}")
    parts, between, unique = [], [], list[str]()
    for record, pause in zip(given, [*pauses, None], strict=True):
        inner = isinstance(record, Events)
        parts += record.records if inner else [record]
        between += [*(record.rests if inner else ()), *([] if pause is None else [pause])]
        for wanted in record.names if inner else [record.name]:
            numbered = (wanted if k == 1 else f"{wanted}_{k}" for k in range(1, len(unique) + 2))
            unique.append(next(name for name in numbered if name not in unique))
    if names is None:
        return parts, between, unique
    stated = [names] if isinstance(names, str) else list(names)
    if len(stated) != len(parts) or len(set(stated)) != len(parts) or not all(isinstance(x, str) and x for x in stated):
        raise ValueError(f"names must be {len(parts)} different texts, one for each event; got {names!r}")
    return parts, between, stated


def find_events(model: Any) -> Events | None:
    """The events that are the excitation of a model; None if the excitation is a plain record."""
    return next((each for each in motions_of(model) if isinstance(each, Events)), None)


def motions_of(model: Any) -> tuple[Record, ...]:
    """The records that excite a model, one for each support that has one; empty for a model of another kind."""
    given = getattr(model, "supports", ()) or [getattr(model, name, None) for name in ("record", "loading")]
    return tuple(each for each in given if isinstance(each, Record))


def events_of(model: Any) -> Events:
    """The events that are the excitation of a model; raise ValueError if the excitation is not `Events`."""
    events = find_events(model)
    got, what = f"{type(model).__name__} with another excitation", "measurements and noise per event"
    expect(events is not None, what, "a model whose excitation is Events([eq1, eq2, ...])", got)
    missing = events.duration - (model.n_steps - 1) * model.dt
    expected = f"a response to all {events.duration:g} s of the events"
    advice = "leave out its lead, and put NaN where the measurements of the first event are not to be compared"
    expect(missing <= 1.000001 * model.dt, what, expected, f"{type(model).__name__} without {missing:g} s", advice)
    return events
