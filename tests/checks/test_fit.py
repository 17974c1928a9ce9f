"""The gate before every result: unit errors that a fit hides, clocks of supports, quiet on good fits, events alone."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    BridgeDeck,
    Events,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    LinearOscillator,
    LinearStructure,
    Measurements,
    Posterior,
    Record,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.problems import table_motion
from samplers import SMCSampler
from tests.checks.fitted import check_fit, fitted

MOTION = table_motion().trim(0.0, 8.0).resample(0.02)
DECK = {"frequency": Uniform(2.0, 7.0), "damping": Uniform(0.01, 0.3), "share": Uniform(0.2, 1.0)}


def supports(late=0):
    """Three motions; the two ends are late by a number of steps."""
    rng, time = np.random.default_rng(7), 0.02 * np.arange(600)
    burst = np.exp(-(((time - 5.0) / 2.0) ** 2))
    motions = [burst * np.convolve(rng.standard_normal(600), np.hanning(8), "same") for _ in range(3)]
    return [
        Record(name, 0.02, np.roll(motion, late if name != "column" else 0))
        for name, motion in zip(("column", "south", "north"), motions, strict=True)
    ]


def deck(late=0):
    """A deck whose ends are recorded late, measured with an error of a tenth."""
    true = LinearStructure(BridgeDeck("deck"), supports()).simulate([4.0, 0.08, 0.6])
    error = np.convolve(np.random.default_rng(8).standard_normal(true.shape[1]), np.ones(4) / 2.0, "same")
    model = LinearStructure(BridgeDeck("deck"), supports(late))
    return model, Measurements(model.channels, 0.02, true + 0.1 * true.std() * error)


def posterior_of(model, measured, prior, **noise):
    law = GaussianNoise(model.channels, **noise)
    scale = HalfNormal(0.3 if noise else float(measured.root_mean_squares[0]))
    return Posterior(FELikelihood(model, measured, law), prior | dict.fromkeys(law.parameter_names, scale))


def sampled(*arguments, **noise):
    """A posterior, and the chain of a run."""
    posterior = posterior_of(*arguments, **noise)
    sampler = SMCSampler(60, posterior.ndim, posterior, vectorize=True, seed=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sampler.run_mcmc(None, 1, progress=False)
    return posterior, sampler.get_chain(flat=True)


def names(findings):
    return {finding.kind for finding in findings if finding.severity == "wrong"}


@pytest.mark.slow
@pytest.mark.parametrize("noise", [{}, pytest.param({"shares_of": "measured"}, marks=pytest.mark.slow)])
def test_a_unit_that_is_wrong_is_named_after_the_run_and_before_it(noise):
    """A frequency makes up for a part of the factor."""
    model, measured = deck()
    posterior, samples = sampled(model, replace(measured, values=measured.values / 9.80665), DECK, **noise)
    for found in (check_fit(posterior, samples), check_fit(posterior)):
        assert names(found) >= {"A unit may be wrong"}
        (unit,) = (each for each in found if each.kind == "A unit may be wrong")
        assert "g read as m/s2" in unit.text
    good, samples = sampled(model, measured, DECK, **noise)
    assert not names(check_fit(good, samples)) and not check_fit(good)


def test_a_late_recorder_of_an_input_is_not_used():
    model, measured = deck(late=5)
    posterior = posterior_of(model, measured, DECK)
    assert names(check_fit(posterior, fitted(posterior, starts=2)))


@pytest.mark.slow
def test_the_fault_of_one_event_is_named_with_it():
    events = Events([MOTION, MOTION.scale(0.5)], rest=2.0, names=("EQ1", "EQ2"))
    model = LinearOscillator(events, 0.8)
    values = model.simulate([1.1, 0.9])
    values[:, events.window("EQ2").samples] *= 1000.0
    for before, after in zip(events.windows[:-1], events.windows[1:], strict=True):
        values[:, before.stop : after.first] = np.nan
    prior = {name: TruncatedNormal(1.0, 0.3) for name in model.parameter_names}
    likelihood = FELikelihood(model, Measurements(model.channels, model.dt, values))
    prior |= {name: HalfNormal(1.0) for name in likelihood.noise.parameter_names}
    (found,) = check_fit(Posterior(likelihood, prior))
    assert "(EQ2)" in found.text and "mm read as m" in found.text
