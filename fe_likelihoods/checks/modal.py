"""Findings about modes, which are `PredictedModes` of `fe_likelihoods.modal`, above this folder."""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from ..likelihood.fits import MOST_DRAWS
from .faults import BETTER, FACTOR, FLOOR, Fault, finding_of
from .finding import CARE, HALF, Finding


def check_modes(modes: Any, title: str) -> list[Finding]:
    """Faults of data with a title, and modes without a counterpart, at draws of the prior."""
    found = [finding_of(each, title, error="of frequencies") for each in _unit(modes)]
    of_sensor = [finding_of(each, title, error="of shapes") for each in _faults_of_sensors(modes)]
    return found + (of_sensor or _check_shapes(modes))


def _unit(modes: Any) -> list[Fault]:
    """A factor of the frequencies that half of the modes have at all draws: one wrong number is no unit."""
    logs = np.log(modes.data.mean_frequencies / modes.frequencies)
    median = float(np.median(logs))
    common = np.sort(np.sign(median) * logs, axis=1)[:, (modes.data.n_modes - 1) // 2].min()
    factor, large = float(np.exp(median)), modes.data.n_modes > 1 and common > np.log(FACTOR)
    return [Fault("factor", ("frequencies",), factor, abs(factor - 1.0), float(logs.std()))] if large else []


def _faults_of_sensors(modes: Any) -> list[Fault]:
    """A sensor with the other sign, or two that are exchanged, by the errors of the shapes, sqrt(1 - MAC)."""
    data, n = modes.data, modes.data.n_sensors
    if n < 3 or not data.has_shape.any() or len(modes.frequencies) < HALF * MOST_DRAWS:
        return []

    def error(shapes: np.ndarray) -> float:  # of the best draw; another sensor changes which mode is which
        found = np.sqrt(np.maximum(1.0 - modes.against(replace(data, shapes=shapes)).assurance, FLOOR**2))
        return float(np.exp(np.nanmean(np.log(found), axis=1).min()))

    order, signs = np.arange(n), 1.0 - 2.0 * np.eye(n)
    found = [Fault("sign", (name,), np.nan, 0.0, error(data.shapes * signs[k])) for k, name in enumerate(data.sensors)]
    for i, j in combinations(range(n), 2):
        swapped = np.where(order == i, j, np.where(order == j, i, order))
        found.append(Fault("swap", (data.sensors[i], data.sensors[j]), np.nan, 0.0, error(data.shapes[..., swapped])))
    best, before = min(found, key=lambda each: each.after), error(data.shapes)
    return [best._replace(before=before)] if best.after < BETTER * before else []


def _number(data: Any, k: int) -> str:
    return f"{data.mode_numbers[k]} ({data.mean_frequencies[k]:.4g} Hz)"


def _check_shapes(modes: Any) -> list[Finding]:
    """Measured modes that no computed one resembles."""
    found, resembling, numbers = [], np.median(modes.assurance, axis=0), modes.data.mode_numbers
    for k in np.flatnonzero(resembling < HALF):  # MAC; one shape cannot have more than a half with two orthogonal ones
        others = [number for number in numbers if number != numbers[k]]
        text = f"No computed mode resembles the measured mode {_number(modes.data, k)}, whose best MAC is "
        text += f"{resembling[k]:.2f}."
        action = f"Leave it out, data.select({others}) or modes = {others} in a TOML file; or compute more modes."
        found.append(Finding("A mode has no counterpart", CARE, text, action, {"mac": float(resembling[k])}, "data"))
    return found


def squares_of_modes(fit: Any) -> tuple[dict[str, float], int]:
    """Squares of residuals by stated errors at the centre of the samples, by name, and how many errors they are of."""
    noise, data = fit.likelihood.noise, fit.likelihood.model.data
    if fit.centre is None or noise.parameter_names or getattr(noise, "student", True):
        return {}, 0
    sums = fit.likelihood.simulator.statistics(fit.centre[None, : len(fit.likelihood.model.parameter_names)])
    squares = (
        sums[0, data.n_modes :].reshape(noise.counts.shape) / noise.deviations(np.zeros((1, 0)))[0, ..., None] ** 2
    )
    found = dict[str, float]()
    for (what, k, number), square in np.ndenumerate(np.nan_to_num(squares)):
        of_set = f" in set {number + 1}" if data.n_sets > 1 else ""
        found[f"the {('frequency', 'shape')[what]} of mode {_number(data, k)}{of_set}"] = float(square)
    return found, int(noise.counts.sum())
