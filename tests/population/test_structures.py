"""Populations of events of all kinds of structures: frames, decks on several supports, and modes."""

import numpy as np
import pytest

from fe_likelihoods import (
    BridgeDeck,
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    LinearStructure,
    LogNormal,
    Measurements,
    ModalData,
    ModalLikelihood,
    Posterior,
    Record,
    ShearFrame,
    StoredPosterior,
    Varying,
)
from fe_likelihoods.emulation.modes import find_modes

FRAME = ShearFrame({"floor": 1, "roof": 2}, [20e3] * 2, [30e6] * 2, groups=[1, 1])
OTHERS = {"damping": LogNormal(0.05, 0.2)} | {f"sigma_{name}": HalfNormal(1.0) for name in ("middle", "floor", "roof")}


def likelihood_of(kind, truth, rng):
    if kind == "modes":
        frequencies = np.array([3.8096, 9.9736]) * np.sqrt(truth) * (1.0 + 0.005 * rng.standard_normal(2))
        return ModalLikelihood(FRAME, ModalData(frequencies, frequency_cv=0.005))
    motions = [Record("noise", 0.02, rng.standard_normal(300)) for _ in range(3)]
    model = LinearStructure(FRAME, motions[0]) if kind == "frame" else LinearStructure(BridgeDeck(share=0.8), motions)
    response = model.simulate([truth, 0.05])
    noise = 0.1 * response.std(axis=1, keepdims=True) * rng.standard_normal(response.shape)
    return FELikelihood(model, Measurements(model.channels, 0.02, response + noise))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "median"), [("frame", 1.0), ("deck", 3.0), ("modes", 1.0)])
def test_the_spread_of_ten_events_is_found_whatever_the_structure(kind, median):
    rng, tests = np.random.default_rng(7), {}
    for event, truth in enumerate(median * np.exp(0.08 * rng.standard_normal(10))):
        likelihood = likelihood_of(kind, truth, rng)
        prior = {name: OTHERS.get(name, LogNormal(median, 0.5)) for name in likelihood.parameter_names}
        posterior = Posterior(likelihood, prior)
        tests[f"event {event}"] = StoredPosterior.from_search(find_modes(posterior, starts=1, seed=1), posterior)
    varying = {likelihood.parameter_names[0]: Varying(LogNormal(median, 0.2), HalfNormal(0.2))}
    population = HierarchicalPosterior(tests, varying)
    points = population.sample_prior(20_000, 1)
    weights = np.exp((logs := population.log_likelihood(points)) - logs.max())
    mean, spread = weights @ points / weights.sum()
    assert abs(np.log(mean / median)) < 3.0 * 0.08 / np.sqrt(10) and 0.05 < spread < 0.15
