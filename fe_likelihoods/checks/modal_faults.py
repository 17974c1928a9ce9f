"""Findings about measured and computed modes: units, sensors, modes without a counterpart, pairings, stated errors.

Modes are `PredictedModes` of `fe_likelihoods.modal`, which is above this folder.
"""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.stats import chi2

from ..text_tables import listed
from .data_faults import FACTOR, SAME_UNITS
from .finding import CARE, HALF, SMALL_PROBABILITY, TAIL, WRONG, Finding
from .slow_motion import FEWEST_DRAWS

__all__ = ["check_modes"]

RESEMBLES = HALF  # MAC; one shape cannot have more than this with two orthogonal ones
# Mean MAC of the best draw that asks for a fault of a sensor, and the share of 1 - MAC that is left without it: in
# 0 of 120 right and 231 of 240 wrong cases (shear frames, shape errors of 0.02 and 0.1).
POOR, MENDED = 0.97, 0.4
MOST_DRAWS = 20  # that are compared for faults of sensors


def check_modes(fit: Any) -> list[Finding]:
    """What a `ModalFit` shows: draws of the prior, and samples of the posterior if there are any."""
    draws, samples = fit.draws, fit.samples
    modes = draws if samples is None else samples
    if modes is None:
        return []
    if found := _check_sensors(modes):  # which pairs wrong modes
        return found
    found = [] if draws is None else _check_frequencies(draws, WRONG if samples is None else CARE)
    found += _check_shapes(modes)
    found += [] if samples is None else _check_pairs(samples)
    return found if any(each.severity == WRONG for each in found) else found + _check_errors(fit)


def _check_errors(fit: Any) -> list[Finding]:
    """Stated errors that samples show to be too small."""
    likelihood, noise = fit.likelihood, fit.likelihood.noise
    if fit.samples is None or noise.parameter_names or getattr(noise, "student", True):
        return []
    sums = likelihood.simulator.statistics(fit.points[:, : len(likelihood.model.parameter_names)])
    deviations = np.repeat(np.concatenate(noise.deviations(np.zeros((1, 0))), axis=1), noise.n_sets, axis=1)
    squares = sums[:, len(noise.channels) :] / np.square(deviations)
    least, data = float(np.nanmin(squares.sum(axis=1))), sum(noise.counts) + sum(noise.freedoms)
    factor = float(np.sqrt(least / data))
    text = (
        f"At the best sample, frequencies and shapes differ from the model by {factor:.2g} times their stated errors "
        "(root mean square): intervals of the parameters are too narrow."
    )
    action = 'Add an unknown error, frequency_error="common" and shape_error="common"; or look for a wrong mode.'
    found = [Finding("Modes differ more than their stated errors", CARE, text, action, {"factor": factor})]
    return found if chi2.sf(least, data) < SMALL_PROBABILITY else []


def _number(modes: Any, k: int) -> str:
    return f"{modes.data.mode_numbers[k]} ({modes.data.mean_frequencies[k]:.4g} Hz)"


def _check_frequencies(draws: Any, severity: str) -> list[Finding]:
    """Frequencies that are out of reach of the prior, by a factor of units or another one."""
    resemble = np.flatnonzero(~(np.median(draws.assurance, axis=0) < RESEMBLES))
    logs = np.log(draws.data.mean_frequencies / draws.frequencies)[:, resemble]
    if not logs.size:
        return []
    common, median = logs.mean(axis=1), float(np.median(logs))
    numbers = {"factor": float(np.exp(median))}
    if np.abs(common).min() > np.log(FACTOR) and len(set(np.sign(common))) == 1:
        ratios = {  # square roots of factors of stiffness or mass, besides those of frequencies
            2.0 * np.pi: "rad/s instead of Hz",
            60.0: "1/min instead of Hz",
            1000.0**0.5: "a stiffness in kN instead of N, or a mass in t instead of kg",
            9.81**0.5: "a weight instead of a mass",
        }
        near = [f", as with {each}" for r, each in ratios.items() if abs(abs(median) - np.log(r)) < np.log(SAME_UNITS)]
        which, factor = "measured" if median > 0.0 else "computed", np.exp(abs(median))
        text = f"The {which} frequencies are about {factor:.3g} times the others{''.join(near[:1])}."
        action = "Check the unit of the measured frequencies, and the units of stiffness and mass in the model (SI)."
        return [Finding("A unit may be wrong", severity, text, action, numbers)]
    # further from the nearest draw than all draws are from each other
    outside = np.flatnonzero(np.maximum(logs.min(axis=0), -logs.max(axis=0)) > np.ptp(logs, axis=0))
    if not len(outside) or len(logs) < FEWEST_DRAWS:
        return []
    shown = [
        f"{_number(draws, k)}, computed {draws.frequencies[:, k].min():.4g} to {draws.frequencies[:, k].max():.4g} Hz"
        for k in resemble[outside]
    ]
    text = f"No draw of the prior comes near the measured frequency of mode {listed(shown)}."
    action = "Check masses, boundary conditions and priors of the model, and the numbers of the modes."
    return [Finding("The prior does not reach the measurements", CARE, text, action, numbers)]


def _check_sensors(modes: Any) -> list[Finding]:
    """A sensor with the other sign, or two exchanged ones, without which the shapes fit much better."""
    data, n = modes.data, modes.data.n_sensors
    if n < 3 or not data.has_shape.any():
        return []
    rows = np.unique(np.linspace(0, len(modes.computed) - 1, MOST_DRAWS).astype(int))
    few, every = modes.of(modes.paired, modes.computed[rows]), np.arange(n)

    def best(shapes: np.ndarray) -> float:
        return float(np.nanmean(few.against(replace(data, shapes=shapes)).assurance, axis=1).max())

    before = best(data.shapes)
    if before > POOR:
        return []
    faults = {
        f"the sensor {data.sensors[j]} counts the other way round": data.shapes * np.where(every == j, -1.0, 1.0)
        for j in every
    }
    for i, j in combinations(range(n), 2):
        order = np.where(every == i, j, np.where(every == j, i, every))
        faults[f"the sensors {data.sensors[i]} and {data.sensors[j]} are exchanged"] = data.shapes[:, :, order]
    text, after = max(((text, best(shapes)) for text, shapes in faults.items()), key=lambda each: each[1])
    said = f"If {text}, the mean MAC of the best sample is {after:.2f} instead of {before:.2f}."
    action = "Check the directions, places and names of sensors, and the rows or channels of the model."
    numbers = {"before": before, "after": after}
    found = [Finding("A sensor may be reversed or exchanged", WRONG, said, action, numbers)]
    return found if 1.0 - after < MENDED * (1.0 - before) else []


def _check_shapes(modes: Any) -> list[Finding]:
    """Measured modes that no computed one resembles."""
    found, resembling, numbers = [], np.median(modes.assurance, axis=0), modes.data.mode_numbers
    for k in np.flatnonzero(resembling < RESEMBLES):
        others = [number for number in numbers if number != numbers[k]]
        text = f"No computed mode resembles the measured mode {_number(modes, k)}: its best MAC is {resembling[k]:.2f}."
        action = f"Leave it out, data.select({others}) or modes = {others} in a TOML file; or compute more modes."
        found.append(Finding("A mode has no counterpart", CARE, text, action, {"mac": float(resembling[k])}))
    return found


def _check_pairs(modes: Any) -> list[Finding]:
    """Measured modes that are paired with different computed modes in the posterior."""
    found = []
    for k, numbers in enumerate(modes.numbers.T):
        values, counts = np.unique(numbers, return_counts=True)
        if len(values) > 1 and counts.max() < (1.0 - TAIL) * len(numbers):
            shares = ", ".join(f"{v} ({c / len(numbers):.0%})" for v, c in zip(values, counts, strict=True))
            text = f"The measured mode {_number(modes, k)} is paired with different computed modes: {shares}."
            action = "The posterior may have several regions; more sensors tell the shapes apart."
            found.append(Finding("The pairing of modes changes", CARE, text, action))
    return found
