"""Stiffness losses from modes before and after an event, with another temperature."""

import numpy as np
import pytest

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    ModalData,
    ModalLikelihood,
    Posterior,
    ShearFrame,
    StoredPosterior,
    Uniform,
    Varying,
    stiffness_loss,
)
from fe_likelihoods.modal.mode_models import StructureModes
from samplers import SMCSampler

FLOORS = {"floor 1": 1, "floor 2": 2, "floor 4": 4, "roof": 6}
FRAME = ShearFrame(FLOORS, [300e3] * 6, [400e6] * 6)
NAMES = [f"stiffness_{i}" for i in range(1, 7)]


def calibrated(stiffnesses, temperature, rng):
    """Posterior of the mean of five synthetic identifications of four modes."""
    modes = StructureModes(FRAME).simulate(stiffnesses)[:, :4]
    shapes = modes[1:].T / np.linalg.norm(modes[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(5, 4, 4))
    frequencies = modes[0] * (1.0 - 0.0015 * (temperature - 20.0)) * (1.0 + 0.005 * rng.normal(size=(5, 4)))
    data = ModalData(frequencies, shapes, tuple(FLOORS)).mean()
    posterior = Posterior(ModalLikelihood(FRAME, data), dict.fromkeys(NAMES, LogNormal(1.0, 0.2)))
    sampler = SMCSampler(200, 6, posterior, guide=posterior.guide(starts=2), seed=1, vectorize=True)
    sampler.run_mcmc(None, 1)
    return StoredPosterior.from_run(sampler, posterior)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_loss_is_found_and_a_warmer_day_is_none(seed):
    rng = np.random.default_rng(1000 + seed)
    healthy, storey = np.exp(0.1 * rng.normal(size=6)), int(rng.integers(6))
    after = healthy * np.exp(0.01 * rng.normal(size=6))
    after[storey] *= 0.75 if seed % 2 else 1.0
    loss = stiffness_loss(calibrated(healthy, 2.0, rng), calibrated(after, 28.0, rng), NAMES)
    if seed % 2:
        assert loss.presence() > 0.9 and loss.location().argmax() == storey
    else:
        assert loss.presence() < 0.1


def test_modes_of_several_structures_have_a_population(rng):
    """Six frames whose stiffnesses differ by 8 %: the population, and the modes of another frame."""
    frame = ShearFrame({"floor 1": 1, "roof": 2}, [20e3] * 2, [30e6] * 2)
    prior, tests, truths = dict.fromkeys(NAMES[:2], LogNormal(1.0, 0.3)), {}, np.exp(0.08 * rng.normal(size=(6, 2)))
    for k, truth in enumerate(truths):
        modes = StructureModes(frame).simulate(truth)
        shapes = modes[1:].T / np.linalg.norm(modes[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(2, 2))
        frequencies = modes[0] * (1.0 + 0.01 * rng.normal(size=2))
        data = ModalData(frequencies, shapes, ("floor 1", "roof"), frequency_cv=0.01, shape_error=0.02)
        posterior = Posterior(ModalLikelihood(frame, data), prior)
        samples = truth * np.exp(0.1 * rng.normal(size=(400, 2)))  # around it, and weighted
        wider = -0.5 * np.square(np.log(samples / truth) / 0.1).sum(axis=1) - np.log(samples).sum(axis=1)
        tests[f"frame {k}"] = StoredPosterior(samples, posterior.prior, posterior(samples) - wider)
    population = HierarchicalPosterior(tests, dict.fromkeys(NAMES[:2], Varying(LogNormal(1.0, 0.3), HalfNormal(0.2))))
    points = population.sample_prior(6000, 1)
    weights = np.exp((logs := population.log_likelihood(points)) - logs.max())
    mean = weights @ points / weights.sum()
    np.testing.assert_allclose(np.log(mean[[0, 2]]), np.log(truths).mean(axis=0), atol=0.08)
    hierarchy = Hierarchy(population, points[rng.choice(len(points), 200, p=weights / weights.sum())])
    predicted = posterior.likelihood.predict_modes(hierarchy.new_test(200, rng=1))
    other = StructureModes(frame).simulate([1.0, 1.0])[0]
    low, high = predicted.interval()
    assert (low < other).all() and (other < high).all() and (high / low > 1.1).all() and (high / low < 1.6).all()


@pytest.mark.slow
def test_a_building_with_23_parameters_takes_few_simulations():
    """20 storeys, six sensors, three modes on five days: an effective sample size of 100 in 308 simulations."""
    rng, n = np.random.default_rng(4), 20
    floors = {f"floor {i}": i for i in (2, 5, 9, 13, 17, 20)}
    frame = ShearFrame(floors, [300e3] * n, np.linspace(900e6, 400e6, n).tolist())
    truth, temperatures = np.exp(0.1 * rng.normal(size=n)), np.array([2.0, 10.0, 18.0, 25.0, 33.0])
    modes = StructureModes(frame).simulate(truth)[:, :3]
    shapes = modes[1:].T / np.linalg.norm(modes[1:], axis=0)[:, None] + 0.02 * rng.normal(size=(5, 3, 6))
    frequencies = modes[0] * (1.0 - 0.001 * (temperatures[:, None] - 20.0)) * (1.0 + 0.004 * rng.normal(size=(5, 3)))
    likelihood = ModalLikelihood(frame, ModalData(frequencies, shapes, tuple(floors), temperatures=temperatures))
    prior = {f"stiffness_{i}": LogNormal(1.0, 0.15) for i in range(1, n + 1)} | {
        "temperature_slope": Uniform(-0.01, 0.01)
    }
    prior |= {"frequency_error": LogNormal(0.005, 0.5), "shape_error": LogNormal(0.03, 0.5)}
    posterior = Posterior(likelihood, prior)
    sampler = SMCSampler(100, 23, posterior, guide=posterior.guide(starts=2), seed=1, vectorize=True)
    sampler.run_mcmc(None, 1)
    samples = sampler.get_chain(flat=True)
    assert sampler.verdict.status == "converged" and likelihood.simulations < 400
    distance = (samples.mean(axis=0) - [*truth, -0.001, 0.004, 0.02]) / samples.std(axis=0)
    assert np.abs(distance).max() < 4.0
