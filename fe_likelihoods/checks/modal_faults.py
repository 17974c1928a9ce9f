"""Findings about measured and computed modes: units, sensors, modes without a counterpart, pairings, stated errors.

Modes are `PredictedModes` of `fe_likelihoods.modal`, which is above this folder.
"""

from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import ndtri
from scipy.stats import chi2
from scipy.stats import t as student

from ..text_tables import listed
from .data_faults import FACTOR, SAME_UNITS
from .finding import CARE, HALF, NOTE, SMALL_PROBABILITY, TAIL, WRONG, Finding, about
from .steps import LARGE_SHIFT
from .wrong_values import check_frequency

__all__ = ["check_modes"]

UNREACHED = "The prior does not reach the measurements"
RESEMBLES = HALF  # MAC; one shape cannot have more than this with two orthogonal ones
# Mean MAC of the best draw that asks for a fault of a sensor, and the share of 1 - MAC that is left without it. Beams,
# decks with torsion, and frames of 3 to 12 storeys, 2 to 5 modes at 3 to 9 sensors, 44 cases each with shape errors of
# 0.02 (and 0.1): named were right ones 0 (1), other signs 44 (44), dead 35 (14), gains of 3 35 (13), of 2 32 (8), of
# 0.5 24 (2), exchanged 42 (37), doubled modes 42 (42), wrong units 88 of 88 (86), one sign in one mode 41 (20), a sign
# and rad/s both 44. TAIL from 0.02 to 0.1, and FACTOR of 1.25, change at most 1 in 275 of these verdicts; FACTOR of 2
# loses 10.
POOR, MENDED = 0.97, 0.4
MOST_DRAWS = 20  # that are compared for faults of sensors


def check_modes(fit: Any) -> list[Finding]:
    """What a `ModalFit` shows: draws of the prior, and samples of the posterior if there are any.

    What draws show before a run stands after it. Samples make up for a part of a fault, and then show others.
    """
    data = fit.likelihood.model.data
    found = about("data", _check_sets(data))
    found += [] if fit.draws is None else about("data", _check_faults(fit.draws))
    if fit.draws is not None and all(each.severity != WRONG for each in found):
        wrong = about("data", check_frequency(fit))  # which no draw reaches then
        found = wrong + [each for each in found if not wrong or each.kind != UNREACHED]
    if fit.samples is not None and all(each.severity != WRONG for each in found):
        known = {each.kind for each in found} | {UNREACHED}  # samples are no draws of the prior
        found += about("data", [each for each in _check_faults(fit.samples) if each.kind not in known])
        found += _check_pairs(fit.samples)
    if any(each.severity == WRONG for each in found):
        return found
    return found + _check_errors(fit) + ([] if fit.held_out is None else _check_held_out(fit.held_out))


def _check_faults(modes: Any) -> list[Finding]:
    """Faults of sensors, modes and units at draws of the prior, or at samples of the posterior."""
    found, corrected = _check_sensors(modes)
    if found := _check_duplicates(modes) or found:  # which explains the rest, but no unit
        return found + [each for each in _check_frequencies(corrected) if each.severity == WRONG]
    return (_check_frequencies(modes) or _check_numbers(modes)) + _check_shapes(modes) + _note_planes(modes)


def _check_sets(data: Any) -> list[Finding]:
    """The frequency or the shape of one identification, of three or more, that the other ones contradict most.

    Of 2000 data sets each with a scatter of 0.5, 1, 2 and 3 %, with stated errors or none, right ones were named in 0,
    0, 8 and 25; one frequency 10 % off in 1996, 1770, 371 and 82; a day on which all change by 12 % in 0, 0, 3 and 5;
    exchanged lines in all but 4; a wrong sign of one component, at shape errors of 0.02, in 1245.
    """
    off = np.log(data.frequencies / np.nanmedian(data.frequencies, axis=0))
    if data.n_sets < 3:
        return []
    others = [np.delete(off, mode, axis=1) for mode in range(data.n_modes if data.n_modes > 1 else 0)]
    common = np.stack([np.nan_to_num(np.nanmedian(each, axis=1)) for each in others], axis=1) if others else 0.0
    spread, stated = 1.4826 * np.nanmedian(np.abs(off)), data.frequency_cv  # of normal errors
    limit = 8.0 * spread if stated is None else 5.0 * np.maximum(stated, spread)
    far = np.minimum(np.abs(off), np.abs(off - common)) / np.maximum(limit, TAIL)  # not where all modes change alike
    unlike = np.full(off.shape, np.nan)
    for mode in [group[0] for group in data.groups(0.02) if len(group) == 1]:
        for k in np.flatnonzero(data.has_shape[:, mode]):
            rest = data.has_shape[:, mode] & (np.arange(data.n_sets) != k)
            if rest.sum() > 1:
                shape = np.linalg.svd(data.shapes[rest, mode], full_matrices=False)[2][0]
                unlike[k, mode] = 1.0 - (shape @ data.shapes[k, mode]) ** 2
    if np.isfinite(unlike).any():
        far = np.fmax(far, unlike / max(30.0 * np.nanmedian(unlike), 2.0 * TAIL))
    k, mode = np.unravel_index(np.nan_to_num(far).argmax(), far.shape)
    if not far[k, mode] > 1.0:
        return []
    ratio, like = float(np.exp(off[k, mode])), 1.0 - unlike[k, mode]
    text = (
        f"Mode {data.mode_numbers[mode]} of set {k + 1} ({data.frequencies[k, mode]:.4g} Hz) has {ratio:.3g} times the "
        f"median frequency of {data.n_sets} sets" + (f", and a MAC of {like:.2f} with them." if like <= 1.0 else ".")
    )
    action = "Check its line in the file; if it is right, `student_t=4` lets it move the parameters little."
    return [Finding("A value may be wrong", CARE, text, action, {"ratio": ratio})]


def _check_errors(fit: Any) -> list[Finding]:
    """Stated errors that samples show to be too small."""
    likelihood, noise = fit.likelihood, fit.likelihood.noise
    if fit.samples is None or noise.parameter_names or getattr(noise, "student", True):
        return []
    sums = likelihood.simulator.statistics(fit.points[:, : len(likelihood.model.parameter_names)])
    deviations = np.repeat(np.concatenate(noise.deviations(np.zeros((1, 0))), axis=1), noise.n_sets, axis=1)
    squares = sums[:, len(noise.channels) :] / np.square(deviations)
    n_modes, best = fit.samples.data.n_modes, squares[np.nanargmin(squares.sum(axis=1))]
    largest = np.argsort(-np.nan_to_num(best))[:2]
    of_shape, numbers = largest // (n_modes * noise.n_sets), largest // noise.n_sets % n_modes
    of_set = [f" in set {k % noise.n_sets + 1}" if noise.n_sets > 1 else "" for k in largest]
    places = [
        f"the {'shape' if shape else 'frequency'} of mode {_number(fit.samples, k)}{place}"
        for shape, k, place in zip(of_shape, numbers, of_set, strict=True)
    ]
    action = (
        f"The largest: {listed(places)}. Look for a wrong number or sensor, and at the model. If both are right, add "
        'an unknown error: frequency_error="common", shape_error="common" (unknown_errors in a TOML file).'
    )
    what, data = "At the best sample, frequencies and shapes", sum(map(sum, noise.counts))
    return check_squares(float(best.sum()), data, what, action)


def check_squares(square: float, n: int, what: str, action: str) -> list[Finding]:
    """Whether the sum of the squares of n residuals, each by its stated error, is larger than errors explain.

    It is not used where the mean square is five times as stated. Of 44 cases each on the structures above, with shape
    errors of 0.02 (and 0.1), these were right ones 0 (0), one frequency 20 % off 36, errors three times as stated 28
    (19); of 11 load tests, right ones 0, two load cases exchanged 10, one value off by 10 deviations 6, by 30 11.
    """
    factor = float(np.sqrt(square / n))
    if not chi2.sf(square, n) < SMALL_PROBABILITY:
        return []
    text = (
        f"{what} differ from the model by {factor:.2g} times their stated errors (root mean square): intervals of the "
        "parameters are too narrow."
    )
    severity = WRONG if factor > np.hypot(1.0, LARGE_SHIFT) else CARE
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


def _number(modes: Any, k: int) -> str:
    return f"{modes.data.mode_numbers[k]} ({modes.data.mean_frequencies[k]:.4g} Hz)"


def _check_frequencies(draws: Any) -> list[Finding]:
    """Frequencies that are out of reach of the prior, by a factor of units or another one."""
    resemble = np.flatnonzero(~(np.median(draws.assurance, axis=0) < RESEMBLES))
    logs = np.log(draws.data.mean_frequencies / draws.frequencies)[:, resemble]
    if not logs.size:
        return []
    median, most = float(np.median(logs)), (logs.shape[1] - 1) // 2
    numbers = {"factor": float(np.exp(median))}
    common = np.sort(np.sign(median) * logs, axis=1)[:, most]  # of half of the modes: one wrong number is no unit
    if common.min() > np.log(FACTOR):
        ratios = {  # square roots of factors of stiffness or mass, besides those of frequencies
            2.0 * np.pi: "rad/s instead of Hz",
            60.0: "1/min instead of Hz",
            1000.0**0.5: "a stiffness in kN instead of N, or a mass in t instead of kg",
            9.81**0.5: "a weight instead of a mass",
        }
        near = [f", as with {each}" for r, each in ratios.items() if abs(abs(median) - np.log(r)) < np.log(SAME_UNITS)]
        two, factor = ("measured", "computed")[:: 1 if median > 0.0 else -1], np.exp(abs(median))
        text = f"The {two[0]} frequencies are about {factor:.3g} times the {two[1]} ones{''.join(near[:1])}."
        action = "Check the unit of the measured frequencies, and the units of stiffness and mass in the model (SI)."
        return [Finding("A unit may be wrong", WRONG, text, action, numbers)]
    # further from the nearest draw than all draws are from each other, and than one more of these few draws would be
    n, m = logs.shape
    reach = student.ppf(1.0 - 0.5 * SMALL_PROBABILITY / m, n - 1) * logs.std(axis=0) * np.sqrt((n + 1) / max(n - 1, 1))
    beyond = np.maximum(logs.min(axis=0), -logs.max(axis=0)) > np.ptp(logs, axis=0)
    outside = np.flatnonzero(beyond & (np.abs(logs.mean(axis=0)) > reach))
    if not len(outside):
        return []
    shown = [
        f"{_number(draws, k)}, computed {draws.frequencies[:, k].min():.4g} to {draws.frequencies[:, k].max():.4g} Hz"
        for k in resemble[outside]
    ]
    text = f"No draw of the prior comes near the measured frequency of mode {listed(shown)}."
    action = "Check masses, boundary conditions and priors of the model, and the numbers of the modes."
    return [Finding(UNREACHED, CARE, text, action, numbers)]


def _check_numbers(modes: Any) -> list[Finding]:
    """Modes without a shape whose frequencies are much nearer to computed modes with other numbers."""
    single = np.flatnonzero(~modes.data.has_shape.any(axis=0))
    if not len(single):
        return []
    logs = np.square(np.log(modes.computed[:, 0, None, :] / modes.data.mean_frequencies[single, None]))
    rows, given = np.arange(len(single)), np.array(modes.data.mode_numbers)[single]
    columns = [linear_sum_assignment(each)[1] for each in logs]
    others = np.sqrt([each[rows, found].mean() for each, found in zip(logs, columns, strict=True)])
    before, best = float(np.sqrt(logs[:, rows, given - 1].mean(axis=1)).min()), int(others.argmin())
    after = float(others[best])
    if before < TAIL or not after < MENDED * before:
        return []
    text = (
        f"The frequencies without shapes are those of the modes {given.tolist()} by their numbers, and differ by "
        f"{before:.0%} from these (best sample, root mean square); with the numbers {(columns[best] + 1).tolist()} by "
        f"{after:.0%}."
    )
    action = "Check the numbers of the modes (mode_numbers, or the column mode): were modes missed between them?"
    return [Finding("The numbers of modes may be wrong", CARE, text, action, {"before": before, "after": after})]


def _note_planes(modes: Any) -> list[Finding]:
    """Close modes of which the plane of the shapes is compared alone."""
    close = [group for group in modes.paired.groups if len(group) > 1]
    if not close:
        return []
    shown = [" and ".join(_number(modes, k) for k in group) for group in close]
    text = f"The measured modes {listed(shown)} are close: the plane of their shapes is compared, not each shape in it."
    action = "If the identification tells them apart, close=0 compares each shape, which says more of the parameters."
    return [Finding("Close modes are compared as a plane", NOTE, text, action)]


def _check_duplicates(modes: Any) -> list[Finding]:
    """Two measured modes with one shape, where all computed ones have different shapes."""
    data, groups, found = modes.data, modes.paired.groups, []
    for i, j in combinations(np.flatnonzero(data.has_shape.any(axis=0)) if data.n_sensors > 2 else (), 2):
        here, there = (data.shapes[data.has_shape[:, k].argmax(), k] for k in (i, j))
        same = (here @ there) ** 2
        if same <= POOR:
            continue
        pair = modes.shapes[:, [i, j]] / np.linalg.norm(modes.shapes[:, [i, j]], axis=2, keepdims=True)
        alike = np.square(pair.prod(axis=1).sum(axis=1)).max()
        ratios = np.median(modes.frequencies[:, [i, j]], axis=0) / data.mean_frequencies[[i, j]]
        far = np.abs(np.log(ratios)).max() > np.log(FACTOR)  # a far mode may look the same at few sensors
        if alike < RESEMBLES or far or any(i in group and j in group for group in groups):
            text = f"The measured modes {_number(modes, i)} and {_number(modes, j)} have one shape: MAC {same:.3f}."
            action = "One of them may be identified twice, a harmonic, or another column: leave it out."
            found.append(Finding("Two measured modes are one", WRONG, text, action, {"mac": float(same)}))
    return found


def _check_sensors(modes: Any) -> tuple[list[Finding], Any]:
    """A sensor with another sign or gain, or two exchanged ones, without which the shapes fit much better.

    Also returns modes beside the data without this fault.
    """
    data, n = modes.data, modes.data.n_sensors
    if n < 3 or not data.has_shape.any():
        return [], modes
    rows = np.unique(np.linspace(0, len(modes.computed) - 1, MOST_DRAWS).astype(int))
    few = modes.of(modes.paired, modes.computed[rows])

    def best(data: Any) -> tuple[float, Any, int]:
        """The mean MAC of the best draw, all modes, and the number of this draw."""
        each = few.against(data)
        means = np.nanmean(each.assurance, axis=1)
        return float(means.max()), each, int(means.argmax())

    before, each, draw = best(data)
    if before > POOR:
        return [], modes
    fitted = 1.0 - HALF * MENDED * (1.0 - before)  # of what a few numbers can mend, such as a wrong shape
    macs, found = np.sort(each.assurance[draw][data.has_shape.any(axis=0)]), dict[str, tuple[float, Any]]()
    one_mode = len(macs) > 1 and macs[0] < RESEMBLES and macs[1:].mean() > 1.0 - 2.0 * TAIL  # no sensor is
    for i, j in () if one_mode else combinations(range(n), 2):
        order = np.arange(n)
        order[[i, j]] = j, i
        what = f"the sensors {data.sensors[i]} and {data.sensors[j]} are exchanged"
        found[what] = best(replace(data, shapes=data.shapes[:, :, order]))[:2]
    for j, name in enumerate(data.sensors):
        signs = np.where(np.arange(n) == j, -1.0, 1.0)
        what = f"the sensor {name} counts the other way round"
        found |= {} if one_mode else {what: best(replace(data, shapes=data.shapes * signs))[:2]}
        for k in np.flatnonzero(data.has_shape.any(axis=0)):
            in_mode = np.where(np.arange(data.n_modes)[:, None] == k, signs, 1.0)
            after, each, _ = best(replace(data, shapes=data.shapes * in_mode))
            in_words = f"the sign of {name} is turned in mode {_number(modes, k)}"
            found |= {in_words: (after, each)} if after > fitted else {}
        if n > 3 and not one_mode:  # a shape of two sensors fits nearly anything
            after, each, draw = best(data.at([other for other in data.sensors if other != name]))
            after = 1.0 - (1.0 - after) * (n - 1) / (n - 2)  # as if the others were as many as all of them
            text, gain = _fault_of_gain(each, draw, data, j)
            if abs(gain) > 2.0 * TAIL:  # a sign in one mode, without which the others fit, is no gain of all
                after = best(replace(data, shapes=data.shapes / np.where(np.arange(n) == j, gain, 1.0)))[0]
            if text and after > fitted:
                found[text] = after, each
    text, (after, corrected) = max(found.items(), key=lambda each: each[1][0], default=("", (before, modes)))
    if not 1.0 - after < MENDED * (1.0 - before):
        return [], modes
    said = f"If {text}, the mean MAC of the best draw is {after:.2f} instead of {before:.2f}."
    action = "Check directions, places, gains and names of sensors, and the rows or channels of the model."
    if " in mode " in text:
        action = (
            "Check this number in the table of shapes, and its phase in the identification; or leave this mode out."
        )
    return [Finding("A sensor may be wrong", WRONG, said, action, {"before": before, "after": after})], corrected


def _fault_of_gain(modes: Any, draw: int, data: Any, j: int) -> tuple[str, float]:
    """What sensor j measures, if the others, which `modes` are of, are right, and its gain."""
    names = [channel.name for channel in modes.paired.model.channels]
    shapes = modes.computed[draw][:, modes.numbers[draw] - 1]
    others, own = shapes[[names.index(name) for name in modes.data.sensors]], shapes[names.index(data.sensors[j])]
    measured = data.shapes[data.has_shape.argmax(axis=0), np.arange(data.n_modes)]
    scales = (others * np.delete(measured, j, axis=1).T).sum(axis=0) / np.square(others).sum(axis=0)
    expected = scales * own
    gain = float(np.nansum(measured[:, j] * expected) / np.nansum(np.square(expected * ~np.isnan(measured[:, j]))))
    if 1.0 / FACTOR < abs(gain) < FACTOR:
        return (f"the sensor {data.sensors[j]} counts the other way round" if gain < 0.0 else ""), gain
    if abs(gain) < 2.0 * TAIL:
        return f"the sensor {data.sensors[j]} is dead (gain {gain:.2f})", gain
    return f"the sensor {data.sensors[j]} has a gain of {gain:.2g}", gain


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
