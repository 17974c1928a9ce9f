"""Does the judgement tell right fits from wrong ones? Real events as they were recorded, and with one fault each.

Structures: transverse and longitudinal decks of the Painter Street Overpass (eleven events) and of the Meloland Road
Overcrossing on recorded supports at the base of the column and at or beside the abutments, and a three-storey frame on
a shake table (three shakings). Each event is calibrated under white noise, to the best mode of a search; samples are
of the mode. The judgement is `fe_likelihoods.check_result`'s without the judgement of a sampler.

A row counts, for a fault, the cases whose judgement is not "use" and names the fault ("named"), names something else
("other"), is "use" ("silent"), or is "use" with a frequency within 5 % and a damping within 0.02 of the right fit
("harmless"). The row "right" counts the three judgements; its note has what was found.

The data are no part of this project (docs/real_data.rst). Set FE_SHARED to a folder that has them in ``measured``.
"""

import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fe_likelihoods import (
    BridgeDeck,
    Channel,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearStructure,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    ShearFrame,
    Uniform,
    check_data,
    read_columns,
    read_record,
)
from fe_likelihoods.checks.finding import Judgement, judge
from fe_likelihoods.emulation.modes import Mode, find_modes
from fe_likelihoods.emulation.target import ResponseTarget
from tests.checks.fitted import check_fit

from .rows import Row
from .targets import SHARED

__all__ = ["STRUCTURES", "Deck", "badge", "best_mode", "posterior_of"]

_FOLDER = SHARED / "measured"
_PRIOR = {
    "frequency": Uniform(0.5, 10.0),
    "damping": Uniform(0.005, 0.8),
    "share": Uniform(0.0, 1.0),
    "shape": Uniform(0.3, 1.0),
}
_FRAME = {f"stiffness_{i}": LogNormal(1.0, 0.5) for i in (1, 2, 3)}
_FRAME |= {f"damping_{i}": LogNormal(0.01, 1.0) for i in (1, 2, 3)}
_SHAKINGS = ((18.0, 26.0), (36.0, 44.0), (54.0, 62.0))  # [s]
_LONGEST, _BEFORE = 30.0, 4.0  # [s]

_UNIT = {"A unit may be wrong", "A gain may be wrong"}
_CLOCK = {"Clocks may differ"}
_STUCK = {"A sensor was stuck", "A sensor was silent"}
_OFFSET = {"A measurement may have an offset or a drift", "A channel has an offset", "A channel drifts"}


@dataclass(frozen=True)
class Deck:
    """Channels of a deck: supports (base of the column, ends), outputs, and one that is no output."""

    files: str
    inputs: tuple[int, int, int]
    outputs: tuple[int, ...]
    wrong: int

    def events(self) -> Iterator["_Event"]:
        names = [f"ch{number}" for number in self.outputs]
        parts = BridgeDeck(*names) if len(names) == 1 else BridgeDeck(names[1], names[0], names[2])
        for path in sorted(_FOLDER.rglob(self.files)):
            numbers = (*self.inputs, *self.outputs, self.wrong)
            found = {number: read_record(path, number) for number in numbers}
            strong = np.cumsum(found[self.outputs[0]].acceleration ** 2)
            step, end = found[self.inputs[0]].dt, min((each.n_steps - 1) * each.dt for each in found.values())
            begin, late = (step * np.searchsorted(strong, share * strong[-1]) for share in (0.02, 0.98))
            begin = max(0.0, begin - _BEFORE)
            span = begin, min(end, late + _BEFORE, begin + _LONGEST)
            found = {number: each.trim(*span) for number, each in found.items()}
            model = LinearStructure(parts, [found[number] for number in self.inputs])
            values = [found[int(channel.name[2:])].acceleration for channel in model.channels]
            yield _Event(model, np.stack(values), found[self.wrong].acceleration)


class _Frame(NamedTuple):
    """Floors of the frame that are measured."""

    floors: tuple[str, ...]

    def events(self) -> Iterator["_Event"]:
        path = _FOLDER / "mini_shake_table" / "Flexible_3_story__Northridge.csv"
        columns = {"table": "ground_x", "1": "1st_x", "2": "2nd_x", "3": "3rd_x", "wrong": "3rd_y"}
        kinds = [Channel(name, "absolute acceleration", "g") for name in columns]
        if not path.exists():
            return
        raw = read_columns(path, kinds, list(columns.values()), units="m/s2")
        rest = raw.values[:, : round(9.0 / raw.dt)].mean(axis=1, keepdims=True)
        measured = replace(raw, values=raw.values - rest)
        for start, stop in _SHAKINGS:
            table = Record("table", raw.dt, measured.channel("table")).trim(9.0, stop)
            parts = ShearFrame({floor: int(floor) for floor in self.floors}, [1.0] * 3, [2912.0] * 3)
            part = measured.trim(start, stop)
            model = LinearStructure(parts, table, lead=start - 9.0)
            yield _Event(model, part.select(self.floors).values, part.channel("wrong"))


class _Event(NamedTuple):
    """Model and measurements (n_channels, n_samples) of an event, and a channel that is none of them."""

    model: LinearStructure
    values: np.ndarray
    wrong: np.ndarray


STRUCTURES = {
    "Painter Street": Deck("*ce89324p.zip", (3, 4, 9), (7,), 6),
    "Painter Street ground": Deck("*ce89324p.zip", (3, 17, 20), (7,), 8),
    "Painter Street along": Deck("*ce89324p.zip", (1, 15, 18), (11,), 7),
    "Meloland": Deck("*ce01336p.zip", (2, 3, 13), (7,), 8),
    "Meloland three": Deck("*ce01336p.zip", (2, 3, 13), (5, 7, 9), 8),
    "Meloland embankment": Deck("*ce01336p.zip", (2, 11, 11), (7,), 6),
    "Meloland along": Deck("*ce01336p.zip", (4, 12, 12), (8,), 9),
    "frame two floors": _Frame(("1", "3")),
    "frame three floors": _Frame(("1", "2", "3")),
}


def badge(repeats: int = 1, structures: tuple[str, ...] = tuple(STRUCTURES), every: int = 12) -> list[Row]:
    """Counts of judgements: all events as recorded, and one in `every` of each structure with each fault."""
    counts: dict[str, Counter] = defaultdict(Counter)
    notes: dict[str, Counter] = defaultdict(Counter)
    for name in structures:
        for number, event in enumerate(STRUCTURES[name].events()):
            right, theta = _judge(event)
            print(f"badge, {name}, event {number}: {right}", flush=True)
            counts["right"][right.status] += 1
            notes["right"].update(f"{name}: {each.kind}" for each in right.findings if each.severity != "note")
            for fault, (expected, spoil) in _FAULTS.items() if number % every == 0 else ():
                spoiled = spoil(event)
                if spoiled is None:
                    continue
                judgement, other = _judge(spoiled)
                found = {each.kind for each in judgement.findings if each.severity != "note"}
                names = list(event.model.parameter_names)
                tolerance = [
                    0.02 if "damping" in each else 0.05 * value for each, value in zip(names, theta, strict=True)
                ]
                near = np.abs(other - theta) < tolerance
                same = all(
                    near[i] for i, each in enumerate(names) if each.startswith(("frequency", "damping", "stiff"))
                )
                status = "harmless" if same else "silent"
                if judgement.status != "use":
                    status = "named" if found & expected else "other"
                counts[fault][status] += 1
                print(f"badge, {name}, event {number}, {fault}: {status}, {judgement}", flush=True)
                if status in ("other", "silent"):
                    notes[fault].update([f"{status}, {name}: {', '.join(sorted(found)) or 'nothing'}"])
    if not counts:
        return [Row("badge", "SKIPPED", None, "", f"no files in {_FOLDER}: set FE_SHARED")]
    rows = []
    for fault, each in counts.items():
        note = "; ".join(f"{text} {count}" for text, count in notes[fault].most_common())
        rows += [Row(fault, status, float(count), f"of {each.total()}", note) for status, count in each.most_common()]
    return rows


def posterior_of(event: _Event) -> Posterior:
    """The posterior of an event under white noise."""
    model, measured = event.model, Measurements(event.model.channels, event.model.dt, event.values)
    noise = GaussianNoise(model.channels)
    prior = {name: (_PRIOR | _FRAME)[name] for name in model.parameter_names}
    prior |= {n: HalfNormal(float(r)) for n, r in zip(noise.parameter_names, measured.root_mean_squares, strict=True)}
    return Posterior(FELikelihood(model, measured, noise), prior)


def best_mode(posterior: Posterior) -> Mode | None:
    """The highest mode of a search; None without one."""
    more = len(posterior.likelihood.model.parameter_names) > 4
    modes = find_modes(posterior, starts=2 + more, seed=1, max_simulations=200 + 100 * more).modes
    return modes[0] if modes else None


def _judge(event: _Event) -> tuple[Judgement, np.ndarray]:
    """The judgement of a fit, and its structural parameters."""
    posterior = posterior_of(event)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mode, samples = best_mode(posterior), posterior.prior.mean()[None]
        if mode is not None:
            rng, factor = np.random.default_rng(1), np.linalg.cholesky(mode.covariance)
            coords = mode.coords + rng.standard_normal((300, len(factor))) @ factor.T
            samples = ResponseTarget(posterior).parameters(coords)
        measured = posterior.likelihood.measurements
        found = (*check_fit(posterior, samples), *check_data(measured, list(event.model.supports)))
    return judge(found), samples.mean(axis=0)[: len(event.model.parameter_names)]


def _later(values: np.ndarray, steps: int) -> np.ndarray:
    """A history that is later by a number of steps, with zeros where nothing is known."""
    out, n = np.zeros_like(values), values.shape[-1]
    out[..., max(steps, 0) : n + min(steps, 0)] = values[..., max(-steps, 0) : n - max(steps, 0)]
    return out


def _output(change: Callable[[np.ndarray, _Event], np.ndarray]) -> Callable[[_Event], _Event | None]:
    """A fault of the middle channel."""

    def spoil(event: _Event) -> _Event:
        values = event.values.copy()
        values[len(values) // 2] = change(values[len(values) // 2], event)
        return event._replace(values=values)

    return spoil


def _input(change: Callable[[np.ndarray, float], np.ndarray], *, all_supports: bool = False) -> Callable:
    """A fault of one end, or of all supports; of none where there is one support."""

    def spoil(event: _Event) -> _Event | None:
        supports = list(event.model.supports)
        if len(supports) < 2 and not all_supports:
            return None
        changed = [
            replace(each, acceleration=change(each.acceleration, each.dt)) if all_supports or k == 1 else each
            for k, each in enumerate(supports)
        ]
        return event._replace(model=event.model.with_record(changed if len(changed) > 1 else changed[0]))

    return spoil


def _held(y: np.ndarray, event: _Event, value: float | None) -> np.ndarray:
    """Half a second from the peak on."""
    at = int(np.argmax(np.abs(y)))
    out = y.copy()
    out[at : at + round(0.5 / event.model.dt)] = y[at] if value is None else value
    return out


def _spikes(y: np.ndarray, event: _Event) -> np.ndarray:
    rng, out = np.random.default_rng(len(y)), y.copy()
    out[rng.integers(0, len(y), 6)] += 4.0 * np.abs(y).max() * rng.choice([-1.0, 1.0], 6)
    return out


def _swapped(event: _Event) -> _Event | None:
    if len(event.values) < 2:
        return None
    values = event.values.copy()
    values[[0, 1]] = values[[1, 0]]
    return event._replace(values=values)


_FAULTS: dict[str, tuple[set[str], Callable[[_Event], _Event | None]]] = {
    "gain 2": (_UNIT, _output(lambda y, _: 2.0 * y)),
    "gain 0.5": (_UNIT, _output(lambda y, _: 0.5 * y)),
    "g read as m/s²": (_UNIT, _output(lambda y, _: y / 9.80665)),
    "0.05 s late": (_CLOCK, _output(lambda y, event: _later(y, round(0.05 / event.model.dt)))),
    "0.05 s early": (_CLOCK, _output(lambda y, event: _later(y, -round(0.05 / event.model.dt)))),
    "0.2 s late": (_CLOCK, _output(lambda y, event: _later(y, round(0.2 / event.model.dt)))),
    "2 s late": (_CLOCK, _output(lambda y, event: _later(y, round(2.0 / event.model.dt)))),
    "sign": ({"A sign may be wrong"}, _output(lambda y, _: -y)),
    "wrong channel": ({"The model does not follow the measurements"}, _output(lambda y, e: np.resize(e.wrong, len(y)))),
    "two channels swapped": ({"Channels may be swapped"}, _swapped),
    "spikes": ({"A channel has spikes"}, _output(_spikes)),
    "offset": (_OFFSET, _output(lambda y, _: y + 0.2 * np.abs(y).max())),
    "drift": (_OFFSET, _output(lambda y, _: y + 0.6 * np.abs(y).max() * np.linspace(0.0, 1.0, len(y)))),
    "clipped": (
        {"A sensor is clipped"},
        _output(lambda y, _: np.clip(y, -0.4 * np.abs(y).max(), 0.4 * np.abs(y).max())),
    ),
    "dead half a second": (_STUCK, _output(lambda y, event: _held(y, event, 0.0))),
    "stuck half a second": (_STUCK | {"A sensor is clipped"}, _output(lambda y, event: _held(y, event, None))),
    "motions 0.05 s early": (_CLOCK, _input(lambda a, dt: _later(a, -round(0.05 / dt)), all_supports=True)),
    "one end 0.1 s late": (_CLOCK, _input(lambda a, dt: _later(a, round(0.1 / dt)))),
    "one end, g read as m/s²": (_UNIT, _input(lambda a, _: a / 9.80665)),
    "one end, gain 2": (_UNIT, _input(lambda a, _: 2.0 * a)),
    "one end, sign": ({"A sign may be wrong"}, _input(lambda a, _: -a)),
}
"""Findings that name each fault, and the event with this fault."""
