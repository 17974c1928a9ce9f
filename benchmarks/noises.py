"""Noises compared: evidence where the truth is known, and evidence and predictions of real bridges.

* "synthetic": a bridge deck with data made by each noise; the evidence of each noise for each data set, less that of
  the noise that made the data (whose own row has the log-evidence itself).
* "Painter Street": the transverse deck of the main shock of 1992 (channel 7); the evidence of each noise, less that of
  white noise, and the scores of ten other events as `propagate` predicts them with the posterior of this one event:
  medians over the events, CRPS, interval score and width as multiples of the root mean square of the measured channel.
* "Meloland": the evidence for the earthquake of 1979 (channel 7). There is no second event.

The likelihood of shares of the measured channel is not a normalised density, so that its evidence is approximate; the
others are.

The data are no part of this project: set FE_SHARED to a folder with the downloads from https://www.strongmotioncenter.org
(``*ce89324p.zip`` and ``*ce01336p.zip``) in ``measured``. Without them one row says so.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from fe_likelihoods import (
    AutoregressiveNoise,
    BridgeDeck,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearStructure,
    Measurements,
    Posterior,
    Record,
    Uniform,
    propagate,
    read_record,
)
from fe_likelihoods.noise.draws import sample_noise
from fe_likelihoods.noise.protocol import Noise
from fe_likelihoods.prediction.score_tables import HistoryScores
from samplers import SMCSampler, compare_models

from .rows import Row
from .targets import SHARED

__all__ = ["noises"]

_FOLDER = SHARED / "measured"
_MAIN = "petrolia_25apr1992_ce89324p"
_MEMBERS = ("CHAN{:d}.V2", "CHAN{:02d}.V2", "CHAN{:03d}.V2", "chan{:03d}.v2")
_PRIOR = {"frequency": Uniform(0.5, 10.0), "damping": Uniform(0.005, 0.8), "share": Uniform(0.0, 1.0)}
_SENSOR = 0.002  # of the accelerations [m/s²] (assumed)
_EDGES, _WINDOW = (2.0, 4.0, 8.0), 1.0  # [Hz], [s]
_TRUTH = {"frequency": 4.0, "damping": 0.1, "share": 0.8}
_WALKERS, _STEPS = 150, 600

NOISES: dict[str, Callable[[Measurements], Noise]] = {
    "white": lambda measured: GaussianNoise(measured.channels, sensor=_floor(measured)),
    "autoregressive": lambda measured: AutoregressiveNoise(measured.channels, sensor=_floor(measured)),
    "relative": lambda measured: GaussianNoise(
        measured.channels, level="measured", window=_WINDOW, sensor=_floor(measured)
    ),
    "modulated": lambda measured: _modulated(measured, 0.25),
    "modulated, half": lambda measured: _modulated(measured, 0.5),
    "modulated, envelope": lambda measured: _modulated(measured, 1.0),
    "bands, shares": lambda measured: GaussianNoise(
        measured.channels, groups=_EDGES, level="response", sensor=_floor(measured)
    ),
    "bands, SI": lambda measured: GaussianNoise(measured.channels, groups=_EDGES, sensor=_floor(measured)),
}
_MADE_WITH = {  # parameters of the noises that make synthetic data
    "white": [0.3],
    "autoregressive": [0.3, 0.9],
    "relative": [0.2],
    "modulated": [0.3],
    "bands, shares": [0.8, 0.5, 0.1, 0.5],
    "bands, SI": [0.1, 0.3, 0.05, 0.02],
}


def noises(repeats: int = 1) -> list[Row]:
    """Evidence of each noise for synthetic and real data, and scores of held-out events; one seed per repeat."""
    rows = []
    for seed in range(1, repeats + 1):
        rows += [*_synthetic(seed), *_painter_street(seed), *_meloland(seed)]
    return rows


def _floor(measured: Measurements) -> list[float]:
    return [_SENSOR] * measured.n_channels


def _modulated(measured: Measurements, local: float) -> GaussianNoise:
    return GaussianNoise(measured.channels, level="response", window=_WINDOW, sensor=_floor(measured), local=local)


def _prior_of(name: str) -> Uniform | HalfNormal:
    """Standard deviations [m/s²] and shares are of the order of one, correlations anywhere."""
    return Uniform(-1.0, 1.0) if name.startswith("rho_") else HalfNormal(1.0)


def _calibrate(model: LinearStructure, measured: Measurements, kind: str, seed: int) -> tuple[Posterior, SMCSampler]:
    likelihood = FELikelihood(model, measured, NOISES[kind](measured))
    noise = likelihood.noise.parameter_names
    prior = {name: _PRIOR.get(name, Uniform(0.0, 1.0)) for name in model.parameter_names}
    posterior = Posterior(likelihood, prior | {name: _prior_of(name) for name in noise})
    sampler = SMCSampler(_WALKERS, posterior.ndim, posterior, vectorize=True, seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sampler.run_mcmc(None, 1, progress=False)
    return posterior, sampler


def _compare(case: str, fits: dict[str, tuple[Posterior, SMCSampler]], reference: str) -> list[Row]:
    """Evidences less that of the reference, whose own row has the evidence itself."""
    found, rows = compare_models({name: sampler for name, (_, sampler) in fits.items()}), []
    base = found.log_evidence[found.names.index(reference)]
    for name, value, error in zip(found.names, found.log_evidence, found.log_evidence_error, strict=True):
        note = f"+- {error:.2f}, {fits[name][0].report()['simulations']} simulations"
        what = "log-evidence" if name == reference else f"log-evidence less that of {reference}"
        rows.append(Row(what, f"{case}, {name}", float(value if name == reference else value - base), "", note))
    return rows


def _synthetic(seed: int) -> list[Row]:
    rng, time = np.random.default_rng(seed), 0.02 * np.arange(_STEPS)
    burst = np.exp(-(((time - 6.0) / 2.5) ** 2))
    supports = [Record(f"support {k}", 0.02, burst * rng.standard_normal(_STEPS)) for k in range(3)]
    model = LinearStructure(BridgeDeck("deck"), supports)
    response = model.simulate(np.array([_TRUTH[name] for name in model.parameter_names]))
    rows = []
    for truth, parameters in _MADE_WITH.items():
        noise = NOISES[truth](Measurements(model.channels, model.dt, response))
        if noise.level == "measured":
            noise = replace(noise, window=None)  # one level, as in its likelihood
        drawn = sample_noise(noise, np.array([parameters]), 1, model.dt)
        measured = Measurements(model.channels, model.dt, response + drawn.draw(0, model.n_steps, rng, response))
        fits = {kind: _calibrate(model, measured, kind, seed) for kind in NOISES}
        rows += _compare(f"synthetic, made with {truth}, seed {seed}", fits, truth)
    return rows


def _painter_street(seed: int) -> list[Row]:
    files = sorted(_FOLDER.rglob("*ce89324p.zip"))
    if len(files) < 2:
        return [Row("noises", "SKIPPED", None, "", f"no two files *ce89324p.zip in {_FOLDER}: set FE_SHARED")]
    events = {path.stem: _events(path, BridgeDeck("ch7"), (3, 4, 9), (7,)) for path in files}
    fits = {kind: _calibrate(*events[_MAIN], kind, seed) for kind in NOISES}
    rows = _compare(f"Painter Street, main shock, seed {seed}", fits, "white")
    for kind, (posterior, sampler) in fits.items():
        scored = []
        for name, (model, measured) in events.items():
            if name != _MAIN:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # the level of white noise is that of a strong motion
                    samples = sampler.get_chain(flat=True)[:150]
                    prediction = propagate(
                        posterior, samples, record=model.supports, noise=True, seed=seed, progress=False
                    )
                scored.append(prediction.score(measured))
        rows += _scores(f"Painter Street, {len(scored)} other events, seed {seed}, {kind}", scored)
    return rows


def _scores(case: str, scored: list[HistoryScores]) -> list[Row]:
    rows = []
    for name in ("crps", "interval_score", "width", "coverage", "coverage_strong"):
        relative = name not in ("coverage", "coverage_strong")
        values = [float(getattr(each, name)[0] / (each.rms[0] if relative else 1.0)) for each in scored]
        note = f"{min(values):.2g} to {max(values):.2g}"
        rows.append(Row(name + (" / RMS" if relative else ""), case, float(np.median(values)), "", note))
    return rows


def _meloland(seed: int) -> list[Row]:
    files = sorted(_FOLDER.rglob("*ce01336p.zip"))
    if not files:
        return [Row("noises", "SKIPPED", None, "", f"no file *ce01336p.zip in {_FOLDER}: set FE_SHARED")]
    event = _events(files[0], BridgeDeck("ch7"), (2, 3, 13), (7,))
    fits = {kind: _calibrate(*event, kind, seed) for kind in NOISES}
    return _compare(f"Meloland, seed {seed}", fits, "white")


def _events(
    path: Path, deck: BridgeDeck, inputs: Sequence[int], outputs: Sequence[int]
) -> tuple[LinearStructure, Measurements]:
    """Model and measurements of one event, of one length."""
    found = {number: _channel(path, number) for number in (*inputs, *outputs)}
    end = min((each.n_steps - 1) * each.dt for each in found.values())
    found = {number: each.trim(0.0, end) for number, each in found.items()}
    model = LinearStructure(deck, [found[number] for number in inputs])
    rows = [found[int(channel.name.removeprefix("ch"))].acceleration for channel in model.channels]
    return model, Measurements(model.channels, model.dt, rows)


def _channel(path: Path, number: int) -> Record:
    reason: ValueError | None = None
    for member in _MEMBERS:
        try:
            return read_record(path, number, member=member.format(number))
        except ValueError as error:
            reason = error
    raise ValueError(f"{path.name}: no channel {number}: {reason}")
