"""Findings about modes, which are `PredictedModes` of `fe_likelihoods.modal`, above this folder."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from ..text_tables import listed
from .compared import MOST_DRAWS
from .faults import BETTER, FACTOR, FLOOR, Fault, finding_of
from .finding import CARE, HALF, NOTE, TAIL, Finding, percent

__all__ = ["check_modes", "squares_of_modes"]


def check_modes(fit: Any) -> list[Finding]:
    """Faults and modes without a counterpart at draws of the prior of a `ModalFit`; pairs that change in samples."""
    pairs = [] if fit.samples is None else _check_pairs(fit.samples)
    if fit.draws is None:
        return pairs
    found = [finding_of(each, fit.title, error="of frequencies") for each in _unit(fit.draws)]
    of_sensor = [finding_of(each, fit.title, error="of shapes") for each in _faults_of_sensors(fit.draws)]
    return found + (of_sensor or _check_shapes(fit.draws)) + pairs


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


def _number(modes: Any, k: int) -> str:
    return f"{modes.data.mode_numbers[k]} ({modes.data.mean_frequencies[k]:.4g} Hz)"


def _check_shapes(modes: Any) -> list[Finding]:
    """Measured modes that no computed one resembles."""
    found, resembling, numbers = [], np.median(modes.assurance, axis=0), modes.data.mode_numbers
    for k in np.flatnonzero(resembling < HALF):  # MAC; one shape cannot have more than a half with two orthogonal ones
        others = [number for number in numbers if number != numbers[k]]
        text = f"No computed mode resembles the measured mode {_number(modes, k)}: its best MAC is {resembling[k]:.2f}."
        action = f"Leave it out, data.select({others}) or modes = {others} in a TOML file; or compute more modes."
        found.append(Finding("A mode has no counterpart", CARE, text, action, {"mac": float(resembling[k])}, "data"))
    return found


def _check_pairs(modes: Any) -> list[Finding]:
    """Measured modes that are different computed modes in the posterior, which no result has to suffer from."""
    found = []
    for k, column in enumerate(modes.numbers.T):
        numbers, counts = np.unique(column, return_counts=True)
        if counts.max() < (1.0 - TAIL) * len(column):
            shares = listed([f"{each} ({percent(n / len(column))})" for each, n in zip(numbers, counts, strict=True)])
            text = f"The measured mode {_number(modes, k)} is paired with different computed modes: {shares}."
            action = "Parameters may have several regions; more sensors tell the shapes apart."
            found.append(Finding("The pairing of modes changes", NOTE, text, action))
    return found


def squares_of_modes(fit: Any) -> Iterator[tuple[str, dict[str, float], int]]:
    """What is compared, squares of residuals by stated errors at the best sample, by name, and their number."""
    likelihood, noise = fit.likelihood, fit.likelihood.noise
    if fit.samples is None or noise.parameter_names or getattr(noise, "student", True):
        return
    sums = likelihood.simulator.statistics(fit.points[:, : len(likelihood.model.parameter_names)])
    deviations = np.repeat(noise.deviations(np.zeros((1, 0))).reshape(1, -1), noise.n_sets, axis=1)
    squares = sums[:, len(noise.channels) :] / np.square(deviations)
    names = [
        f"the {what} of mode {_number(fit.samples, mode)}{f' in set {k + 1}' if noise.n_sets > 1 else ''}"
        for what in ("frequency", "shape")
        for mode in range(fit.samples.data.n_modes)
        for k in range(noise.n_sets)
    ]
    best = np.nan_to_num(squares[np.nanargmin(squares.sum(axis=1))]).tolist()
    what = "At the best sample, frequencies and shapes"
    yield what, dict(zip(names, best, strict=True)), int(noise.counts.sum())
