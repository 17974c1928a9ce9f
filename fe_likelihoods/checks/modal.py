"""Findings about modes, which are `PredictedModes` of `fe_likelihoods.modal`, above this folder."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.special import chdtrc, ndtri, stdtrit

from ..text_tables import listed
from .fault_words import finding_of
from .finding import CARE, HALF, NOTE, SMALL_PROBABILITY, TAIL, WRONG, Finding, about, percent
from .model import LARGE_SHIFT
from .tables import find_changes_of_modes

__all__ = ["check_modes", "check_squares"]

RESEMBLES = HALF  # MAC; one shape cannot have more than this with two orthogonal ones


def check_modes(fit: Any) -> list[Finding]:
    """What a `ModalFit` shows: faults at draws of the prior, and stated errors at samples of the posterior, if any."""
    found = about("data", _check_sets(fit.likelihood.model.data))
    if fit.draws is not None:
        changes = find_changes_of_modes(fit.draws, fit.deviations)
        turned = [each for each in changes if each.kind != "value" or each.value < 0.0]
        of_sensor = any(each.names[0] in fit.draws.data.sensors for each in turned)
        strange = [] if of_sensor else _check_shapes(fit.draws)
        # a mode that the model lacks has no frequency that could be expected
        named = [finding_of(each, fit.title) for each in changes if each.names[0] != "frequency" or not strange]
        found += about("data", named + strange or _check_reach(fit.draws))
    if any(each.severity == WRONG for each in found) or fit.samples is None:
        return found
    found += _check_errors(fit) + _check_pairs(fit.samples)
    return found + ([] if fit.held_out is None else _check_held_out(fit.held_out))


def _number(modes: Any, k: int) -> str:
    return f"{modes.data.mode_numbers[k]} ({modes.data.mean_frequencies[k]:.4g} Hz)"


def _check_sets(data: Any) -> list[Finding]:
    """The frequency of one identification, of three or more, that the other ones contradict most.

    Of 500 data sets each with a scatter of 0.5, 1, 2 and 3 %, right ones were named in 0, 0, 1 and 3, one frequency
    10 % off in 500, 448, 104 and 22, days on which all change by 12 % in 0, 1, 0 and 2, exchanged lines in 480 to 500.
    """
    if data.n_sets < 3 or data.n_modes < 2:
        return []
    off = np.log(data.frequencies / np.nanmedian(data.frequencies, axis=0))
    spread, stated = 1.4826 * np.nanmedian(np.abs(off)), data.frequency_cv  # of normal errors
    limit = 8.0 * spread if stated is None else 5.0 * np.maximum(stated, spread)
    common = np.stack(
        [np.nanmedian(np.delete(off, k, axis=1), axis=1) for k in range(data.n_modes)], axis=1
    )  # of others
    # not where all modes change alike
    far = np.nan_to_num(np.fmin(np.abs(off), np.abs(off - common)) / np.maximum(limit, TAIL))
    k, mode = np.unravel_index(far.argmax(), far.shape)
    if not far[k, mode] > 1.0:
        return []
    ratio, number = float(np.exp(off[k, mode])), data.mode_numbers[mode]
    text = (
        f"Mode {number} of set {k + 1} ({data.frequencies[k, mode]:.4g} Hz) has {ratio:.3g} times the median frequency "
        f"of {data.n_sets} sets."
    )
    action = "Check its line in the file; if it is right, `student_t=4` lets it move the parameters little."
    return [Finding("A value may be wrong", CARE, text, action, {"ratio": ratio})]


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


def _check_reach(modes: Any) -> list[Finding]:
    """Frequencies further from the nearest draw than all draws are from each other, and than one more would be."""
    logs = np.log(modes.data.mean_frequencies / modes.frequencies)
    n, m = logs.shape
    reach = stdtrit(n - 1, 1.0 - 0.5 * SMALL_PROBABILITY / m) * logs.std(axis=0) * np.sqrt((n + 1) / max(n - 1, 1))
    beyond = np.maximum(logs.min(axis=0), -logs.max(axis=0)) > np.ptp(logs, axis=0)
    shown = [
        f"{_number(modes, k)}, computed {modes.frequencies[:, k].min():.4g} to {modes.frequencies[:, k].max():.4g} Hz"
        for k in np.flatnonzero(beyond & (np.abs(logs.mean(axis=0)) > reach))
    ]
    if not shown:
        return []
    text = f"No draw of the prior comes near the measured frequency of mode {listed(shown)}."
    action = "Check masses, boundary conditions and priors of the model, and the numbers of the modes."
    return [Finding("The prior does not reach the measurements", CARE, text, action)]


def _check_errors(fit: Any) -> list[Finding]:
    """Stated errors that samples show to be too small."""
    likelihood, noise = fit.likelihood, fit.likelihood.noise
    if noise.parameter_names or getattr(noise, "student", True):
        return []
    sums = likelihood.simulator.statistics(fit.points[:, : len(likelihood.model.parameter_names)])
    deviations = np.repeat(np.concatenate(noise.deviations(np.zeros((1, 0))), axis=1), noise.n_sets, axis=1)
    squares = sums[:, len(noise.channels) :] / np.square(deviations)
    best, samples = squares[np.nanargmin(squares.sum(axis=1))], fit.samples
    names = [
        f"the {what} of mode {_number(samples, mode)}{f' in set {k + 1}' if noise.n_sets > 1 else ''}"
        for what in ("frequency", "shape")
        for mode in range(samples.data.n_modes)
        for k in range(noise.n_sets)
    ]
    more = 'add an unknown error: frequency_error="common", shape_error="common" (unknown_errors in a TOML file).'
    what, n = "At the best sample, frequencies and shapes", sum(map(sum, noise.counts))
    return check_squares(best, n, names, what, more)


def check_squares(squares: np.ndarray, n: int, names: Sequence[str], what: str, more: str) -> list[Finding]:
    """Whether squares (m,) of residuals by their stated errors, NaN where unknown, are larger than n errors explain."""
    square = float(np.nansum(squares))
    factor = float(np.sqrt(square / n))
    if not chdtrc(n, square) < SMALL_PROBABILITY:
        return []
    text = (
        f"{what} differ from the model by {factor:.2g} times their stated errors (root mean square): intervals of the "
        "parameters are too narrow."
    )
    largest = listed([names[k] for k in np.argsort(-np.nan_to_num(squares))[:2]])
    action = (
        f"The largest: {largest}. Look for a wrong number, sensor or place, and at the model. If all are right, {more}"
    )
    severity = WRONG if factor > np.hypot(1.0, LARGE_SHIFT) else CARE  # of a mean square that is five times as stated
    return [Finding("Values differ more than their stated errors", severity, text, action, {"factor": factor}, "fit")]


def _check_held_out(modes: Any) -> list[Finding]:
    """Held-out modes that no computed one resembles, or whose frequency is outside of its interval."""
    known = modes.errors.any(axis=0)  # else the error of the identification is not known, and neither is an interval
    off = modes.frequencies / modes.data.mean_frequencies - 1.0
    distance = np.abs(off.mean(axis=0)) / np.sqrt(off.var(axis=0) + np.square(modes.errors).mean(axis=0) + 1e-300)
    far = known & (distance > ndtri(1.0 - 0.5 * SMALL_PROBABILITY / modes.data.n_modes))
    best, (low, high) = np.median(modes.assurance, axis=0), modes.interval()
    shown = {}
    for k in np.flatnonzero(far | (best < RESEMBLES)):
        predicted = f"by none (best MAC {best[k]:.2f})" if best[k] < RESEMBLES else f"{low[k]:.4g} to {high[k]:.4g} Hz"
        shown[f"{_number(modes, k)}, predicted {predicted}"] = float(distance[k])
    if not shown:
        return []
    text = f"Modes that were held out are not predicted: {listed(list(shown))}."
    action = "Do not predict what depends on them; look at masses and boundary conditions, or compare these modes too."
    return [Finding("A held-out mode is not predicted", CARE, text, action, shown, "fit")]
