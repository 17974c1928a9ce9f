"""`check_model` names models that are not repeatable, do not read their motion, or are too coarse for their data."""

import re

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    Measurements,
    Posterior,
    TruncatedNormal,
    check_model,
    check_result,
)
from fe_likelihoods.checks.model import halve_steps, refuse_chance
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.problems import table_motion
from tests.emulation.problems import guided

MOTION = table_motion().trim(0.0, 4.0).resample(0.01)
TOP = (Channel("top", "relative displacement", "mm"),)
TRUE = np.array([1.1, 0.9])


def central_differences(theta, record, substeps=1):
    """Displacement of an oscillator of 0.4 s, with errors of the second order in the step."""
    omega, step = 2.0 * np.pi / 0.4 * np.sqrt(theta[0]), record.dt / substeps
    factor = 0.03 * theta[1] * omega * step
    motion = np.interp(
        np.arange((record.n_steps - 1) * substeps + 1) / substeps, np.arange(record.n_steps), record.acceleration
    )
    u = np.zeros(len(motion) + 1)
    for i in range(1, len(motion)):
        u[i + 1] = (2.0 * u[i] - (1.0 - factor) * u[i - 1] - step**2 * (motion[i] + omega**2 * u[i])) / (1.0 + factor)
    return u[None, :-1][:, ::substeps]


def posterior_of(function, noise=0.02):
    clean = central_differences(TRUE, MOTION, 8)
    errors = np.random.default_rng(1).standard_normal(clean.shape)
    measured = Measurements(TOP, MOTION.dt, clean + noise * clean.std() * errors)
    model = FunctionModel(function, ("stiffness", "damping"), TOP, record=MOTION)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    return Posterior(FELikelihood(model, measured), prior | {"sigma_top": HalfNormal(0.01)})


def names(checked):
    return [finding.kind for finding in checked.findings if finding.severity != "note"]


def test_a_good_model_has_no_findings():
    made = []

    def fine(theta, record):
        made.append(1)
        return central_differences(theta, record, 8)

    found = check_model(posterior_of(fine))
    assert names(found) == [] and len(made) > 100 and repr(found) == "Nothing was found."


@pytest.mark.parametrize(("noise", "weight"), [(0.003, ["care"]), (0.2, ["care"]), (1.5, [])])
def test_a_coarse_step_is_compared_with_the_width_that_the_data_give(noise, weight):
    """The same step is too coarse for precise data, and fine enough for noisy ones."""
    posterior = posterior_of(central_differences, noise)
    mode = find_modes(posterior, starts=1).modes[0]
    coords = np.random.default_rng(1).multivariate_normal(mode.coords, mode.covariance, 400)
    sd = posterior.prior.from_normal(coords).std(axis=0)
    found = halve_steps(posterior, mode.parameters, sd)[0]
    assert [each.severity for each in found] == weight
    before = check_model(posterior).findings
    assert [each.kind for each in before] == [each.kind for each in found], "known before a run"
    for each, after in zip(before, found, strict=True):
        assert 0.5 < each.numbers["stiffness"] / after.numbers["stiffness"] < 1.1 and "by about" in each.text
    for each in found:
        moved = float(re.search(r"stiffness by .*? posterior standard deviations \((.*?) %\)", each.text)[1])
        number = each.numbers["stiffness"] * sd[0] / mode.parameters[0]
        assert moved == pytest.approx(100.0 * number, rel=0.01) and "the time step" in each.text


@pytest.mark.slow
@pytest.mark.parametrize("joint", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_coarse_step_limits_the_result_of_a_run(joint):
    """Also where only one of two data sets is computed with the coarse step."""

    def judged(function):
        posterior = posterior_of(function, 0.02)
        if joint:
            second = posterior_of(lambda theta, record: central_differences(theta, record, 8), 0.02).likelihood
            likelihood = JointLikelihood({"a": posterior.likelihood, "b": second})
            posterior = Posterior(likelihood, posterior.prior)
        sampler = guided(posterior, walkers=40)
        before = posterior.likelihood.simulations
        judgement = check_result(sampler)
        return judgement, posterior.likelihood.simulations - before

    judgement, made = judged(central_differences)
    assert judgement.status == "use with care"
    found = next(each for each in judgement.findings if each.kind == "The model is too coarse for its data")
    assert "stiffness by" in found.text and made <= 2 * (100 + 2 + 4)
    fine, _ = judged(lambda theta, record: central_differences(theta, record, 8))
    assert not [each for each in fine.findings if "coarse" in each.kind or "tested" in each.kind], str(fine)


def test_a_random_model_is_named_and_a_run_refuses_it():
    rng = np.random.default_rng(3)
    posterior = posterior_of(lambda theta, record: central_differences(theta, record) * (1.0 + 0.02 * rng.normal()))
    assert names(check_model(posterior)) == ["The model is not repeatable"]
    with pytest.raises(ValueError, match="not repeatable: Two simulations of the same parameters differ by"):
        refuse_chance(posterior)
    refuse_chance(posterior_of(central_differences))


def test_a_motion_that_is_not_read_is_named():
    unread = posterior_of(lambda theta, record: central_differences(theta, MOTION)[:, : record.n_steps])
    assert names(check_model(unread)) == ["The motion changes nothing"]


def test_failures_and_units_are_named():
    model = LinearOscillator(MOTION.scale(9.80665), 0.4)  # a motion in g, taken for m/s², and then for g again
    values = LinearOscillator(MOTION, 0.4).simulate(TRUE)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    likelihood = FELikelihood(model, Measurements(model.channels, model.dt, values))
    prior |= {name: HalfNormal(1.0) for name in likelihood.noise.parameter_names}
    found = names(check_model(Posterior(likelihood, prior)))
    assert "A unit may be wrong" in found
    failing = posterior_of(lambda theta, record: 1 / 0)
    with pytest.raises(ValueError, match="mean of the prior has failed"):
        check_model(failing)


def test_a_model_that_keeps_its_own_step_is_not_tested():
    """It returns as many samples as before under half the step, or integrates with steps of its own."""

    def own_samples(theta, record):
        return central_differences(theta, MOTION, 8)[:, : MOTION.n_steps] * (np.abs(record.acceleration).max() / PEAK)

    def own_steps(theta, record):
        fine = record.resample(0.00125) if record.dt > 0.002 else record
        found = central_differences(theta, fine)
        return found[:, :: round(record.dt / 0.00125)][:, : record.n_steps]

    PEAK = np.abs(MOTION.acceleration).max()
    for function in (own_samples, own_steps):
        posterior = posterior_of(function)
        point, sd = np.array([1.1, 0.9, 0.001]), np.array([0.01, 0.01, 1e-4])
        found, tests = halve_steps(posterior, point, sd)
        assert not found and tests.startswith("not tested: ")
    tests = halve_steps(posterior_of(central_differences), point, sd)[1]
    assert tests == "the time step was halved at the fit"
