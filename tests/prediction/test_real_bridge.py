"""Eleven earthquakes of a real bridge, predicted from a few of them: ``pytest -m slow -s`` prints the table.

Each event is calibrated once, by the largest posterior density with white noise. Random subsets of the events have the
geometric means of their parameters, and predict the others. The models are of different quality: their relative errors
are 0.2 to 0.7.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from fe_likelihoods import (
    BridgeDeck,
    EventRatios,
    FELikelihood,
    LinearStructure,
    Measurements,
    peak,
    read_record,
)
from fe_likelihoods.prediction.new_event import _event, event_ratios
from fe_likelihoods.prediction.quantities import arias_intensity
from fe_likelihoods.priors.between_events import BETWEEN_EVENTS

MEMBERS = "CHAN{:d}.V2", "CHAN{:02d}.V2", "CHAN{:03d}.V2", "chan{:03d}.v2"
MODELS = {"middle": (3, 4, 9, 7), "middle, from the ground": (3, 17, 20, 7), "east end": (3, 17, 17, 9)}
MODELS["along the bridge"] = (1, 15, 18, 11)  # channels of the base, of both ends and of the deck
NAMES, NUMBERS = ["frequency", "damping", "share"], ["peaks", "Arias"]
LOW, HIGH = np.array([0.5, 0.005, 0.0]), np.array([10.0, 0.8, 1.0])  # uniform priors


def likelihoods_of(folder, channels):
    """Likelihoods of the events that have these channels."""
    found = []
    for path in sorted(folder.rglob("*ce89324p.zip")):
        records = {}
        for number in dict.fromkeys(channels):
            for member in MEMBERS:
                try:
                    records[number] = read_record(path, number, member=member.format(number))
                    break
                except ValueError:
                    continue
        if len(records) == len(set(channels)):
            end = min((each.n_steps - 1) * each.dt for each in records.values())
            *supports, deck = (records[number].trim(0.0, end) for number in channels)
            model = LinearStructure(BridgeDeck("deck"), supports)
            found.append(FELikelihood(model, Measurements(model.channels, model.dt, [deck.acceleration])))
    return found


def fitted(likelihood):
    """Parameters of the best fit; a tenth of the samples is independent."""
    draws = LOW + (HIGH - LOW) * np.random.default_rng(1).random((300, 3))
    worth = 0.05 * likelihood.model.n_steps

    def loss(theta):
        if not ((theta > LOW) & (theta < HIGH)).all():
            return np.inf
        return worth * np.log(likelihood.misfit(theta[None]).sum()) + 0.5 * np.log(theta[1] / 0.05) ** 2

    start = draws[np.argmin(likelihood.misfit(draws).sum(axis=1))]
    return minimize(loss, start, method="Nelder-Mead", options={"maxfev": 250, "xatol": 1e-3}).x


def predicted(likelihoods, thetas, size, subsets):
    """PIT (n, 2) of peaks and Arias intensities, and ends of 90 % intervals; also by one scatter of 0.12."""
    numbers, found = [peak("deck"), arias_intensity("deck")], {"expected": [], "0.12": []}
    for seed in range(subsets):
        order = np.random.default_rng([size, seed]).permutation(len(likelihoods))
        at = dict(zip(NAMES, np.exp(thetas[order[:size]].mean(axis=0)), strict=True))
        known = {f"{k}": likelihoods[k] for k in order[:size]}
        ratios = event_ratios(at, known, numbers)
        for k in order[size:]:
            ratio, level, variance, _ = _event(likelihoods[k], at, numbers, BETWEEN_EVENTS)
            own = replace(ratios, new_sd=np.sqrt(variance + ratios.remainder))
            for name, each in (("expected", own), ("0.12", EventRatios(ratios.values))):
                ends = each.quantile(0.95, level) / each.quantile(0.05, level)
                found[name].append([1.0 - each.probability_above(ratio, np.log(level)), ends])
    return {name: np.array(each).swapaxes(0, 1) for name, each in found.items()}


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_few_events_of_a_real_bridge_predict_the_others(shared):
    """In the mean over models and sizes, and in the worst of them; one scatter of 0.12 misses the Arias intensities."""
    shares = {"expected": [], "0.12": []}
    for model, channels in MODELS.items():
        likelihoods = likelihoods_of(shared / "measured" / "painter_street_bridge", channels)
        assert len(likelihoods) >= 9
        thetas = np.log([fitted(each) for each in likelihoods])
        for size in (1, 3, 5):
            for name, (pit, ends) in predicted(likelihoods, thetas, size, 11).items():
                within = np.array([(np.abs(pit - 0.5) < 0.5 * level).mean(axis=0) for level in (0.9, 0.5)])
                shares[name].append(within)
                cells = [
                    f"{what} {100 * a:.0f}, {100 * b:.0f} %" for what, (a, b) in zip(NUMBERS, within.T, strict=True)
                ]
                print(f"\n{model}, {size} events, {name}: {'; '.join(cells)}; ends {np.median(ends, axis=0).round(2)}")
    (in_90, in_50), worst = np.mean(shares["expected"], axis=0), np.min(shares["expected"], axis=0)[0]
    assert (in_90 > 0.85).all() and (worst > 0.7).all() and 0.4 < in_50[0] < 0.65
    control = np.min(shares["0.12"], axis=0)[0]
    assert (control < worst).all() and control[1] < 0.6
