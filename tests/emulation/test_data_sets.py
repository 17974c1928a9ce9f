"""Guides of several data sets with parameters in common."""

import numpy as np
import pytest

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    SimulationFailed,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.emulation.target import ResponseTarget, at_once
from tests.emulation.problems import guided

DT, N = 0.02, 100
CHANNEL = (Channel("top", "displacement", "mm"),)
EVENTS = {"first": (0.05, 200, 0.0), "second": (0.02, 300, 1.0)}  # amplitude [m], steps, phase
TRUTH, SD = np.array([1.2, 0.8]), 2e-3


class Vibration:
    """A mass that vibrates freely after an event; its simulations may fail above a stiffness."""

    def __init__(self, amplitude, n_steps, phase, limit=np.inf):
        self.amplitude, self.time, self.phase, self.limit = amplitude, DT * np.arange(n_steps), phase, limit

    def __call__(self, theta):
        if theta[0] > self.limit:
            raise SimulationFailed("no convergence")
        omega = 2.0 * np.pi * 1.5 * np.sqrt(theta[0])
        return [self.amplitude * np.exp(-0.05 * theta[1] * omega * self.time) * np.cos(omega * self.time + self.phase)]


def likelihoods(truth=TRUTH, sd=(SD, SD), seed=1, limits=(np.inf, np.inf), noises=(None, None), pool=None):
    """One likelihood per event, with synthetic measurements."""
    random, found = np.random.default_rng(seed), {}
    for (name, event), own, limit, noise in zip(EVENTS.items(), sd, limits, noises, strict=True):
        function = Vibration(*event, limit)
        n = event[1]
        model = FunctionModel(function, ["stiffness", "damping"], CHANNEL, DT, n, version=f"{name} {limit}")
        exact = np.array(Vibration(*event)(truth))
        measured = Measurements(CHANNEL, DT, exact + own * random.standard_normal((1, n)))
        found[name] = FELikelihood(model, measured, noise, pool)
    return found


def joint(marginal=True, **options):
    """Posterior of both events: stiffness and damping in common, a standard deviation of the noise for each."""
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
    prior |= {f"sigma_top_{name}": HalfNormal(0.01) for name in EVENTS}
    posterior = Posterior(JointLikelihood(likelihoods(**options), separate=["sigma_top"]), prior)
    return posterior.marginal() if marginal else posterior


def with_other_parameters():
    """The second event has its own first parameter, the common one second, and correlated noise."""
    first, second = likelihoods(noises=(None, AutoregressiveNoise(CHANNEL))).values()
    model = FunctionModel(
        lambda theta: [theta[0] * np.array(Vibration(*EVENTS["second"])([theta[1], 1.0]))[0]],
        ["scale", "stiffness"],
        CHANNEL,
        DT,
        EVENTS["second"][1],
        version="scaled",
    )
    second = FELikelihood(model, second.measurements, AutoregressiveNoise(CHANNEL))
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping", "scale")}
    prior |= {"sigma_top": HalfNormal(0.01), "rho_top": Uniform(-0.5, 0.9)}
    return Posterior(JointLikelihood({"first": first, "second": second}), prior)


def joint_of_one():
    """A `JointLikelihood` of the first event alone, with a name of its own for its noise."""
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
    prior |= {"sigma_top_first": HalfNormal(0.01)}
    return Posterior(JointLikelihood({"first": likelihoods()["first"]}, separate=["sigma_top"]), prior)


def with_gaps():
    """The first event has a missing sample, and the second a longer step and correlated noise."""
    first, second = likelihoods(noises=(None, AutoregressiveNoise(CHANNEL))).values()
    values = first.measurements.values.copy()
    values[0, 7] = np.nan
    first = FELikelihood(first.model, Measurements(CHANNEL, DT, values))
    coarse = Measurements(CHANNEL, 2 * DT, second.measurements.values[:, ::2].copy())
    second = FELikelihood(second.model, coarse, AutoregressiveNoise(CHANNEL))
    prior = {name: TruncatedNormal(1.0, 0.3) for name in ("stiffness", "damping")}
    prior |= {"sigma_top": HalfNormal(0.01), "rho_top": Uniform(-0.5, 0.9)}
    return Posterior(JointLikelihood({"first": first, "second": second}), prior)


@pytest.mark.parametrize("make", [joint, lambda: joint(marginal=False), with_other_parameters, joint_of_one, with_gaps])
def test_the_likelihood_of_the_target_is_that_of_all_data_sets(make):
    posterior = make()
    target = ResponseTarget(posterior)
    points = posterior.sample_prior(6, 1)
    coords = target.coordinates(points)
    runs = at_once(target.run(coords[:, : target.n_structural], thetas=points[:, : target.n_structural]))
    found = target.log_likelihood(runs.statistics, coords[:, target.n_structural :])
    assert found == pytest.approx(posterior.log_likelihood(points), rel=1e-9)
    for number, statistics in zip(runs.numbers, runs.statistics, strict=True):
        assert target.data.statistic(target.archive.read(range(number, number + 1))[0]) == pytest.approx(
            statistics, rel=1e-4
        )  # residuals are single precision


def test_a_point_that_fails_in_one_model_is_not_simulated_by_the_later_ones():
    posterior = joint(limits=(1.1, np.inf))
    first, second = posterior.likelihood.likelihoods.values()
    target = ResponseTarget(posterior)
    thetas = np.array([[1.0, 0.8], [1.15, 0.8], [0.9, 0.8]])
    stored = []

    def remember(_, compute=None):
        stored.extend([] if compute is None else [compute()])
        return None if compute is None else stored[-1]

    runs = at_once(target.run(target.coordinates(thetas), remember, thetas))
    assert list(runs.failed) == [False, True, False]
    assert (first.simulations, second.simulations) == (3, 2)
    # a run that goes on knows all of it without a simulation
    again = joint(limits=(1.1, np.inf))
    target = ResponseTarget(again)
    repeated = at_once(target.run(target.coordinates(thetas), lambda *_: stored[0], thetas))
    assert np.array_equal(repeated.statistics, runs.statistics, equal_nan=True)
    assert np.array_equal(again(thetas), posterior(thetas)) and again.likelihood.simulations == 0
    assert again.report()["failure_count"] == 1


def exact(posterior):
    """Log-evidence, mean and standard deviation of two parameters by quadrature around the mode."""
    axes = np.linspace(1.19, 1.212, 45), np.linspace(0.735, 0.885, 45)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    values = posterior(grid)
    weights = np.exp(values - values.max())
    cell = np.prod([axis[1] - axis[0] for axis in axes])
    log_evidence = values.max() + np.log(weights.sum() * cell)
    mean = weights @ grid / weights.sum()
    return log_evidence, mean, np.sqrt(weights @ (grid - mean) ** 2 / weights.sum())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_two_events_take_hundreds_of_simulations():
    """The result equals quadrature; every simulation is one run of each model."""
    log_evidence, mean, sd = exact(joint())
    chains, variance = [], 0.0
    for seed in range(3):
        posterior = joint()
        sampler = guided(posterior, limit=3000, seed=seed)
        assert sampler.verdict.status == "converged" and sampler.simulations <= 600  # recycling: 2800 and more
        assert posterior.likelihood.simulations <= 2 * sampler.simulations
        assert abs(sampler.log_evidence - log_evidence) < 4.0 * sampler.log_evidence_error < 0.4
        chains.append(sampler.get_chain(flat=True))
        # the weighted draws, and the walkers that are resampled from them
        variance += (1.0 / sampler.verdict.effective_sample_size + 1.0 / N) / 9.0
    samples = np.concatenate(chains)
    assert np.all(np.abs(samples.mean(axis=0) - mean) < 4.0 * sd * np.sqrt(variance))
    assert samples.std(axis=0) == pytest.approx(sd, rel=4.0 * np.sqrt(variance / 2.0))


def test_control_one_event_alone_has_another_posterior():
    """The second event has a part in the result: without it, the standard deviations are larger."""
    _, _, sd = exact(joint())
    names = ("stiffness", "damping")
    prior = {name: TruncatedNormal(1.0, 0.3) for name in names} | {"sigma_top": HalfNormal(0.01)}
    _, _, alone = exact(Posterior(likelihoods()["first"], prior).marginal())
    assert np.all(alone > 1.05 * sd)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")
def test_a_limit_that_ends_the_search_repeats_no_simulation(monkeypatch):
    """The draws that fill the limit are of a guide that has not ended its search; they stay in the count."""
    calls, call = [], Vibration.__call__

    def count(self, theta):
        calls.append((len(self.time), *theta))
        return call(self, theta)

    monkeypatch.setattr(Vibration, "__call__", count)
    whole = guided(joint(), 700, seed=0)
    posterior = joint()
    calls.clear()
    sampler = guided(posterior, limit=50, seed=0)
    assert sampler.simulations == 50
    sampler.max_simulations = 700
    sampler.run_mcmc(None, 0)  # the step of the limited run is replaced
    assert np.array_equal(sampler.get_chain(), whole.get_chain()) and sampler.log_evidence == whole.log_evidence
    # the list of calls is a value of the model that changes: earlier points are run again, to see whether it matters
    distinct = len(calls) - posterior.report()["verifications"]
    assert len(set(calls)) == distinct == 2 * sampler.simulations == posterior.likelihood.simulations
    assert whole.simulations < sampler.simulations < whole.simulations + 50
