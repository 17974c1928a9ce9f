"""Which faults of data the fit gate names, and how often it disturbs good fits: a confusion table.

Cases are synthetic (an oscillator, a shear frame, the bridge column, the isolated bridge; new true parameters and a
model error of 2 to 15 % of each channel, with the spectrum and the envelope of the response, for each seed) and real
(eleven events of Painter Street, one of Meloland, transverse decks on three recorded supports). Each case is calibrated
as it is, and some of the synthetic ones and all real ones once with each fault that they can have, under white noise,
noise in shares of the measured level, and autoregressive noise in turn: the fit is the best mode that a search finds.
The gate then compares the fit and draws of the prior with the measurements. A row has the share of cases in which the
fault was named, and what else was named; it has these of the draws alone, as ``fe-likelihoods check`` makes them, too.

A late sensor and early supports are the same fault of clocks, so either name counts. Where one support contributes
little, its clock has no effect on the fit: the row of the base of the column says so.
"""

import warnings
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    BridgeDeck,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    LinearStructure,
    Measurements,
    Posterior,
    Prior,
    Record,
    ShearFrame,
    TruncatedNormal,
    Uniform,
    problems,
)
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.reporting import fit_gate as gate

from .noises import _FOLDER, _events
from .rows import Row

__all__ = ["fit_gate"]

_LAG = 0.1  # [s]
_MODEL_ERROR = 0.02, 0.15  # RRMSE of synthetic measurements without a fault
_SEARCH = 80  # simulations of the search for the fit
_SHARE = {"oscillator": 3, "frame": 3, "column": 4, "bridge": 6}  # one in so many synthetic cases has faults as well
_DECK = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
_CLOCK = {"Clocks may differ", "Clocks of input recorders may differ"}
_NOISES: dict[str, Callable[[Measurements], Any]] = {
    "white": lambda measured: GaussianNoise(measured.channels),
    "measured": lambda measured: GaussianNoise(measured.channels, level="measured"),
    "autoregressive": lambda measured: AutoregressiveNoise(measured.channels),
}


class _Case(NamedTuple):
    """A model with its prior, and measurements without a fault."""

    name: str
    model: Any
    prior: Mapping[str, Any]
    values: np.ndarray


def fit_gate(repeats: int = 1, cases: int = 12, events: int = 12) -> list[Row]:
    """Confusion table: `cases` of each synthetic problem and up to `events` real ones per repeat."""
    rows: list[Row] = []
    named: dict[tuple[str, str], Counter] = defaultdict(Counter)
    right: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for seed in range(1, repeats + 1):
        seen: Counter = Counter()
        for number, case in enumerate(_cases(seed, cases, events, rows)):
            noise = list(_NOISES)[number % len(_NOISES)]
            seen[case.name] += 1
            with_faults = case.name == "real" or seen[case.name] <= max(1, cases // _SHARE[case.name])
            for fault, expected, model, values in _faults(case) if with_faults else list(_faults(case))[:1]:
                for stage, found in _judge(case, model, values, noise).items():
                    names = {each.name for each in found}
                    named[fault, stage].update(names or {"nothing"})
                    right[fault, stage].append(bool(names & expected) if expected else not names)
    for (fault, stage), each in right.items():
        note = ", ".join(f"{name} {count}" for name, count in named[fault, stage].most_common())
        rows.append(Row(fault, f"{stage}, {len(each)} cases", float(np.mean(each)), "", note))
    return rows


def _judge(case: _Case, model: Any, values: np.ndarray, noise: str) -> dict[str, tuple]:
    """Findings with draws of the prior alone, and with a fit, without the notes on parameters."""
    measured = Measurements(model.channels, model.dt, values)
    law = _NOISES[noise](measured)
    levels = dict(zip(law.parameter_names, 0.5 * np.tile(measured.root_mean_squares, 2), strict=False))
    prior = dict(case.prior)
    for name in law.parameter_names:
        level = 0.5 if noise == "measured" else float(levels[name])
        prior[name] = Uniform(-1.0, 1.0) if name.startswith("rho_") else HalfNormal(level)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        posterior = Posterior(FELikelihood(model, measured, law), prior)
        draws = gate.draws_to_compare(posterior, 0.0)
        found = {"draws": gate.fit_gate(gate.compare(posterior.likelihood, draws, False))}
        try:
            modes = find_modes(posterior, starts=3, seed=1, max_simulations=_SEARCH).modes
        except np.linalg.LinAlgError:  # shares far above one have no Laplace approximation
            modes = ()
        centre = modes[0].parameters if modes else posterior.prior.mean()
        found["fit"] = gate.fit_gate(gate.compare(posterior.likelihood, np.stack([centre, *draws]), True))
    return found


def _cases(seed: int, number: int, events: int, rows: list[Row]) -> Iterator[_Case]:
    rng = np.random.default_rng(seed)
    for name, model, prior in _synthetic():
        names = model.parameter_names
        for theta in Prior({each: prior[each] for each in names}).rvs(number, rng):
            response = model.simulate(theta)
            share = rng.uniform(*_MODEL_ERROR)
            yield _Case(name, model, prior, response + np.stack([share * _model_error(row, rng) for row in response]))
    files = [*sorted(_FOLDER.rglob("*ce89324p.zip")), *sorted(_FOLDER.rglob("*ce01336p.zip"))]
    if not files:
        rows.append(Row("fit_gate", "SKIPPED: real events", None, "", f"no files in {_FOLDER}: set FE_SHARED"))
    for path in files[:events]:
        inputs = (3, 4, 9) if "89324" in path.stem else (2, 3, 13)
        model, measured = _events(path, BridgeDeck("ch7"), inputs, (7,))
        yield _Case("real", model, _DECK, measured.values)


def _synthetic() -> Iterator[tuple[str, Any, dict[str, Any]]]:
    motion = problems.table_motion().trim(0.0, 12.0).resample(0.02)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    yield "oscillator", LinearOscillator(motion, 0.8), prior
    frame = LinearStructure(ShearFrame({"1": 1, "2": 2, "3": 3}, [1.0] * 3, [1200.0, 1000.0, 800.0]), motion)
    kinds = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": Uniform(0.005, 0.15)}
    yield "frame", frame, {name: kinds[name.split("_")[0]] for name in frame.parameter_names}
    for name, posterior in (
        ("column", problems.bridge_column(every=8, duration=20.0)),
        ("bridge", problems.isolated_bridge()),
    ):
        model = posterior.likelihood.model
        yield name, model, {each: posterior.prior.distributions[each] for each in model.parameter_names}


def _model_error(response: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An error with the spectrum and the envelope of a response, and its root mean square."""
    spectrum = np.abs(np.fft.rfft(response))
    phases = rng.standard_normal(len(spectrum)) + 1j * rng.standard_normal(len(spectrum))
    width = max(5, len(response) // 40)
    envelope = np.sqrt(np.convolve(response**2, np.full(width, 1.0 / width), "same"))
    error = envelope * np.fft.irfft(spectrum * phases, len(response))
    return error * np.sqrt(np.mean(response**2) / np.mean(error**2))


def _faults(case: _Case) -> Iterator[tuple[str, set[str], Any, np.ndarray]]:
    """Name of the fault, findings that name it, model and measurements with the fault."""
    model, values = case.model, case.values
    unit, sign = {"A unit may be wrong"}, {"A sign may be wrong"}

    def one(row: int, changed: np.ndarray) -> np.ndarray:
        out = values.copy()
        out[row] = changed
        return out

    steps = round(_LAG / model.dt)
    late, early = _shifted(values, steps), _shifted(values, -steps)
    yield "none, real" if case.name == "real" else "none", set(), model, values
    for factor in (1000.0, 1e-3, 9.80665, 1.0 / 9.80665):
        yield f"unit, {factor:.3g}", unit, model, factor * values
    yield "sign", sign, model, -values
    yield "late 0.1 s", _CLOCK, model, late
    yield "early 0.1 s", _CLOCK, model, early
    if len(values) > 1:
        yield "unit of one channel", unit, model, one(0, 9.80665 * values[0])
        yield "sign of one channel", sign, model, one(-1, -values[-1])
        yield "one channel late 0.1 s", _CLOCK, model, one(0, late[0])
        kinds = [channel.dimension for channel in model.channels]
        alike = [(i, j) for i in range(len(kinds)) for j in range(i) if kinds[i] == kinds[j]]
        if alike:
            i, j = max(alike, key=lambda pair: _difference(values[pair[0]], values[pair[1]]))
            swapped = values.copy()
            swapped[[i, j]] = values[[j, i]]
            yield "two channels swapped", {"Channels may be swapped"}, model, swapped
    if case.name == "real":
        for name, places in (("ends", (1, 2)), ("column", (0,))):
            for sign_of_lag in (1, -1):
                records = [
                    replace(each, acceleration=_shifted(each.acceleration[None], sign_of_lag * steps)[0])
                    if k in places
                    else each
                    for k, each in enumerate(model.supports)
                ]
                yield f"recorder of the {name}, {sign_of_lag * _LAG:+g} s", _CLOCK, model.with_record(records), values
    elif isinstance(getattr(model, "record", None), Record):
        yield "unit of the motion, 9.81", unit, model.with_record(model.record.scale(9.80665)), values


def _difference(one: np.ndarray, other: np.ndarray) -> float:
    """Difference of two channels as a share of both."""
    return float(np.sum((one - other) ** 2) / (np.sum(one**2) + np.sum(other**2)))


def _shifted(values: np.ndarray, steps: int) -> np.ndarray:
    """Histories (n, n_steps) that are later by a number of steps, with zeros where nothing is known."""
    out = np.zeros_like(values)
    n = values.shape[1]
    out[:, max(steps, 0) : n + min(steps, 0)] = values[:, max(-steps, 0) : n - max(steps, 0)]
    return out
