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
PRIOR = {"damping": LogNormal(0.05, 0.2), "sigma_middle": HalfNormal(1.0)}
PRIOR |= {"sigma_floor": HalfNormal(1.0), "sigma_roof": HalfNormal(1.0)}


def motion(rng):
    return Record("noise", 0.02, rng.standard_normal(300))


def of_histories(model, truth, rng):
    response = model.simulate([truth, 0.05])
    measured = response + 0.1 * response.std(axis=1, keepdims=True) * rng.standard_normal(response.shape)
    return FELikelihood(model, Measurements(model.channels, 0.02, measured))


def frame(truth, rng):
    return of_histories(LinearStructure(FRAME, motion(rng)), truth, rng)


def deck(truth, rng):
    return of_histories(LinearStructure(BridgeDeck(share=0.8), [motion(rng) for _ in range(3)]), truth, rng)


def modes(truth, rng):
    frequencies = np.array([3.8096, 9.9736]) * np.sqrt(truth) * (1.0 + 0.005 * rng.standard_normal(2))
    shapes = np.array([[0.618, 1.0], [-1.0, 0.618]]) + 0.02 * rng.standard_normal((2, 2))
    return ModalLikelihood(
        FRAME, ModalData(frequencies, shapes, ("floor", "roof"), frequency_cv=0.005, shape_error=0.02)
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "name", "median"), [(frame, "stiffness", 1.0), (deck, "frequency", 3.0), (modes, "stiffness", 1.0)]
)
def test_the_spread_of_ten_events_is_found_whatever_the_structure(of, name, median):
    rng, tests = np.random.default_rng(7), {}
    truths = median * np.exp(0.08 * rng.standard_normal(10))
    for event, truth in enumerate(truths):
        likelihood = of(truth, rng)
        own = [each for each in likelihood.parameter_names if each not in PRIOR]
        assert own == [next(each for each in own if each.startswith(name))]
        prior = {each: PRIOR.get(each, LogNormal(median, 0.5)) for each in likelihood.parameter_names}
        posterior = Posterior(likelihood, prior)
        tests[f"event {event}"] = StoredPosterior.from_search(find_modes(posterior, starts=1, seed=1), posterior)
    population = HierarchicalPosterior(tests, {own[0]: Varying(LogNormal(median, 0.2), HalfNormal(0.2))})
    points = population.sample_prior(20_000, 1)
    weights = np.exp((logs := population.log_likelihood(points)) - logs.max())
    mean, spread = weights @ points / weights.sum()
    assert abs(np.log(mean / median)) < 3.0 * 0.08 / np.sqrt(10) and 0.05 < spread < 0.15
