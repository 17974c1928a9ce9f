"""Stiffness losses of 50 synthetic twins with a wrong model: are the stated probabilities right?

A twin is a building of 20 storeys with four acceleration sensors and 5 % of noise. One or two storeys lose 0, 10, 20 or
30 % of their stiffness, every stiffness changes by 1 % of scatter, and all of them by a common factor of 3 %
(temperature). The model is a shear building with unknown stiffnesses. It does not contain the twin: masses deviate by
3 %, damping ratios of the modes by 15 %, and the base rotates on soft soil, or the building bends, which makes 2 % of
the roof's displacement. The event before and the event after have the same ground motion, or different ones.

Each calibration is the highest mode of a search with exact derivatives and its Laplace approximation, with
autoregressive noise. `stiffness_loss` combines two of them. Calibrations are appended to a file of JSON lines, and a
second run continues it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtr

from fe_likelihoods import (
    AutoregressiveNoise,
    FELikelihood,
    HalfNormal,
    LogNormal,
    Measurements,
    Posterior,
    Prior,
    StoredPosterior,
    Uniform,
    stiffness_loss,
)
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.models.linear_system import LinearSystem, modal_damping, respond_structure

from .many_stiffnesses import DT, floors, ground_motion, nominal_stiffnesses, shear_model

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Findings", "LossRow", "Twin", "calibrate", "find_losses", "make_twin", "stiffness_losses"]

STOREYS, LIMIT = 20, 0.1
_NAMES = tuple(f"k_{k + 1}" for k in range(STOREYS))
_NOISE, _SCATTER, _COMMON = 0.05, 0.01, 0.03
_MASSES, _RATIOS, _DAMPING, _SOFT = 0.03, 0.15, 0.03, 0.02
_PRIOR_SD = 0.2
_MOST = 400  # simulations of a calibration
_DRAWS = 5000  # of a Laplace approximation
_BINS = np.array([0.0, 0.02, 0.05, 0.15, 0.35, 0.65, 0.85, 0.95, 1.001])


class Twin(NamedTuple):
    """A building before and after an event.

    Attributes
    ----------
    loss : (n,) float
        True losses beyond the common factor, scatter included.
    before, after : (4, n_steps) float
        Measured accelerations [m/s2].
    motions : tuple of int
        Seeds of the two ground motions.
    """

    loss: np.ndarray
    before: np.ndarray
    after: np.ndarray
    motions: tuple[int, int]


def _respond(factors: np.ndarray, masses: np.ndarray, ratios: np.ndarray, bends: bool, motion: int) -> np.ndarray:
    """Accelerations of a building whose base rotates, or that bends: flexibilities are added."""
    stiffness = nominal_stiffnesses(STOREYS)
    below = np.tril(np.ones((STOREYS, STOREYS)))
    height = np.arange(1.0, STOREYS + 1.0) / STOREYS
    low, high = np.minimum.outer(height, height), np.maximum.outer(height, height)
    soft = 0.5 * low**2 * (3.0 * high - low) if bends else np.outer(height, height)
    flexibility = (below / (stiffness * factors)) @ below.T + _SOFT * np.sum(1.0 / stiffness) * soft
    matrix, mass = np.linalg.inv(flexibility), np.diag(masses)
    matrix, sensors = 0.5 * (matrix + matrix.T), floors(STOREYS)
    system = LinearSystem(
        mass,
        modal_damping(mass, matrix, ratios),
        matrix,
        np.ones((STOREYS, 1)),
        np.eye(STOREYS)[sensors],
        np.zeros((len(sensors), 1)),
    )
    return respond_structure(system, ground_motion(motion)[None], DT).acceleration[sensors]


def make_twin(number: int, same_motion: bool) -> Twin:
    """Twin of a number; its structure and its data before the event do not depend on the motion after it."""
    rng = np.random.default_rng([77, number])
    before = np.exp(0.12 * rng.standard_normal(STOREYS))
    damage, level = np.zeros(STOREYS), 0.1 * (number % 4)
    damage[rng.choice(STOREYS, 1 + (number // 4) % 2, replace=False)] = level
    common, scatter = _COMMON * rng.standard_normal(), _SCATTER * rng.standard_normal(STOREYS)
    masses = np.exp(_MASSES * rng.standard_normal(STOREYS))
    ratios = _DAMPING * np.exp(_RATIOS * rng.standard_normal(STOREYS))
    ratio = (1.0 - damage) * np.exp(scatter)
    motions = 1000 + number, (1000 if same_motion else 2000) + number
    data = []
    for factors, motion in zip((before, before * ratio * np.exp(common)), motions, strict=True):
        clean = _respond(factors, masses, ratios, number // 8 % 2 == 1, motion)
        noise = np.sqrt(np.square(clean).mean(axis=1, keepdims=True)) * rng.standard_normal(clean.shape)
        data.append(clean + _NOISE * noise)
    return Twin(1.0 - ratio, *data, motions)


def posterior_of(values: np.ndarray, motion: int) -> Posterior:
    """The shear building with lognormal priors and autoregressive noise."""
    model = shear_model(STOREYS, jacobian=True, motion=motion)
    prior = {name: LogNormal(1.0, _PRIOR_SD) for name in _NAMES}
    levels = np.sqrt(np.square(values).mean(axis=1))
    prior |= {f"sigma_{c.name}": HalfNormal(float(s)) for c, s in zip(model.channels, levels, strict=True)}
    prior |= {f"rho_{c.name}": Uniform(0.0, 0.999) for c in model.channels}
    measured = Measurements(model.channels, DT, values, "SYNTHETIC")
    return Posterior(FELikelihood(model, measured, AutoregressiveNoise(model.channels)), prior)


def calibrate(values: np.ndarray, motion: int, seed: int) -> dict:
    """Mean and covariance of the logarithms at the highest mode, simulations and concerns."""
    posterior = posterior_of(values, motion)
    search = find_modes(posterior, starts=4, seed=seed, max_simulations=_MOST)
    found = StoredPosterior.from_search(search, posterior, _DRAWS)
    logs = np.log(found.samples[:, :STOREYS])
    return {
        "mean": logs.mean(axis=0).tolist(),
        "covariance": np.cov(logs.T).tolist(),
        "simulations": float(search.simulations),
        "concerns": list(found.concerns),
    }


def _stored(found: dict) -> StoredPosterior:
    """Draws with the moments of a calibration."""
    draws = np.random.default_rng(1).multivariate_normal(found["mean"], found["covariance"], _DRAWS)
    prior = Prior({name: LogNormal(1.0, _PRIOR_SD) for name in _NAMES})
    return StoredPosterior(np.exp(draws), prior, concerns=found["concerns"])


def calibrations(twins: int, file: Path) -> list[dict]:
    """Calibrations of all twins, from the file where it has them; others are appended."""
    known = {each["number"]: each for each in map(json.loads, file.read_text().splitlines())} if file.exists() else {}
    file.parent.mkdir(parents=True, exist_ok=True)
    for number in range(twins):
        if number in known:
            continue
        same, other = make_twin(number, True), make_twin(number, False)
        found = {"number": number, "loss": same.loss.tolist()}
        found["before"] = calibrate(same.before, same.motions[0], number)
        found["same"] = calibrate(same.after, same.motions[1], number)
        found["other"] = calibrate(other.after, other.motions[1], number)
        with file.open("a") as lines:
            lines.write(json.dumps(found) + "\n")
        known[number] = found
    return [known[number] for number in range(twins)]


class Findings(NamedTuple):
    """What was stated about all twins, and the truth.

    Attributes
    ----------
    probability : (n_twins, n) float
        Probabilities of losses above 10 %.
    presence : (n_twins,) float
        Probability of any.
    first : (n_twins,) int
        The storey that most probably has the largest loss.
    concerned : (n_twins,) bool
    covered : (n_twins, n) bool
        Whether the true losses are within the intervals of 90 %.
    loss : (n_twins, n) float
        True losses.
    """

    probability: np.ndarray
    presence: np.ndarray
    first: np.ndarray
    concerned: np.ndarray
    covered: np.ndarray
    loss: np.ndarray


def find_losses(found: list[dict], after: str, **options) -> Findings:
    """Losses of all twins with the calibration "same" or "other" after the event; options of `stiffness_loss`."""
    rows = []
    for each in found:
        result = stiffness_loss(_stored(each["before"]), _stored(each[after]), _NAMES, **options)
        truth, (low, high) = np.array(each["loss"]), result.extent((0.05, 0.95))
        first = int(np.argmax(result.location(LIMIT)))
        inside = (low <= truth) & (truth <= high)
        rows.append((result.probability(LIMIT), result.presence(LIMIT), first, bool(result.concerns), inside, truth))
    return Findings(*(np.array(column) for column in zip(*rows, strict=True)))


def without_structure(found: list[dict], after: str) -> Findings:
    """What two calibrations alone say: normal differences of the logarithms, without a prior of the change."""
    rows = []
    for each in found:
        mean = np.array(each[after]["mean"]) - each["before"]["mean"]
        sd = np.sqrt(np.diag(np.array(each[after]["covariance"]) + each["before"]["covariance"]))
        truth = np.array(each["loss"])
        probability = ndtr((np.log1p(-LIMIT) - mean) / sd)
        inside = np.abs(np.log1p(-truth) - mean) <= 1.645 * sd
        rows.append((probability, 1.0 - np.prod(1.0 - probability), int(np.argmin(mean)), False, inside, truth))
    return Findings(*(np.array(column) for column in zip(*rows, strict=True)))


def reliability(stated: np.ndarray, true: np.ndarray) -> list[tuple[float, float, float, int]]:
    """Mean stated probability, observed share, its standard error and number, per bin of stated probabilities."""
    rows = []
    for low, high in zip(_BINS[:-1], _BINS[1:], strict=True):
        inside = (stated >= low) & (stated < high)
        if n := int(inside.sum()):
            mean = float(stated[inside].mean())
            rows.append((mean, float(true[inside].mean()), float(np.sqrt(mean * (1.0 - mean) / n)), n))
    return rows


class LossRow(NamedTuple):
    """One line of the table: all twins of a case. Presence above 0.5 is an alarm."""

    case: str
    simulations: float
    most_simulations: float
    brier: float
    brier_of_base_rate: float
    brier_presence: float
    worst_bin: float
    in_90_percent: float
    false_alarms: str
    found_10: str
    found_20: str
    found_30: str
    near: str
    concerned: int


def _row(case: str, simulations: list[float], found: Findings) -> LossRow:
    true, alarm = found.loss > LIMIT, found.presence > 0.5
    level = 0.1 * (np.arange(len(true)) % 4)
    damaged = alarm & (level > 0.0)
    places = [np.flatnonzero(row > 0.75 * size) for row, size in zip(found.loss[damaged], level[damaged], strict=True)]
    near = [np.abs(at - first).min() <= 1 for at, first in zip(places, found.first[damaged], strict=True)]
    bins = reliability(found.probability.ravel(), true.ravel())
    base = float(true.mean())
    return LossRow(
        case,
        float(np.mean(simulations)),
        float(np.max(simulations)),
        float(np.mean((found.probability - true) ** 2)),
        base * (1.0 - base),
        float(np.mean((found.presence - true.any(axis=1)) ** 2)),
        max((abs(share - mean) / np.hypot(error, 0.5 / n) for mean, share, error, n in bins), default=np.nan),
        100.0 * float(found.covered.mean()),
        *(
            f"{alarm[each].sum()} of {each.sum()}"
            for each in (np.isclose(level, loss) for loss in (0.0, 0.1, 0.2, 0.3))
        ),
        f"{np.sum(near)} of {len(near)}",
        int(found.concerned.sum()),
    )


def stiffness_losses(
    repeats: int = 1, twins: int = 50, file: str = "results/stiffness_loss.jsonl", figure: str = ""
) -> Iterator[LossRow]:
    """Calibration of stated losses, one row per case.

    `file` keeps the calibrations, `figure` is a picture of the reliability diagrams. ``brier`` is the Brier score of
    the stated probabilities of losses above 10 %, ``worst_bin`` the largest deviation of a bin of the reliability
    diagram in standard errors, and ``near`` counts the alarms whose storey is within one storey of a true loss. The
    repeats are not used.
    """
    found = calibrations(twins, Path(file))
    drawn = {}
    for after in ("same", "other"):
        simulations = [each["before"]["simulations"] + each[after]["simulations"] for each in found]
        for what, options in (("", {}), (", errors as stated", {"error": 1.0}), (", calibrations alone", None)):
            case = f"{after} motion{what}"
            drawn[case] = without_structure(found, after) if options is None else find_losses(found, after, **options)
            yield _row(case, simulations, drawn[case])
    if figure:
        draw_reliability(drawn).savefig(figure, dpi=100)


def draw_reliability(found: dict[str, Findings]) -> "Figure":
    """Reliability diagrams: share of true losses against stated probability, with two standard errors."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(9.0, 6.0), layout="constrained")
    for axes, (case, each) in zip(picture.subplots(2, 3, sharex=True, sharey=True).flat, found.items(), strict=True):
        mean, share, error, n = np.array(reliability(each.probability.ravel(), (each.loss > LIMIT).ravel())).T
        axes.plot([0.0, 1.0], [0.0, 1.0], color="0.6", linewidth=1.0)
        axes.errorbar(mean, share, 2.0 * error, fmt="o", capsize=2.0)
        for x, y, count in zip(mean, share, n, strict=True):
            axes.annotate(f"{count:.0f}", (x, y), xytext=(4.0, -10.0), textcoords="offset points", fontsize=7.0)
        axes.set_title(case, fontsize=9.0)
        axes.set_ylim(-0.05, 1.05)
    picture.supxlabel("stated probability of a loss above 10 %")
    picture.supylabel("share of storeys with such a loss")
    return picture
