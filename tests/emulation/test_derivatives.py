"""The model's own derivatives in the search for modes: chain rule, pools, parts of the record, wrong derivatives."""

import pickle
import warnings
from functools import partial

import numpy as np
import pytest

from benchmarks.many_stiffnesses import shear_building
from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    LogNormal,
    Measurements,
    Posterior,
    Record,
    SimulationFailed,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.emulation.target import ResponseTarget, at_once
from fe_likelihoods.priors.multivariate import MultivariateNormal
from samplers import SMCSampler

from .problems import CHANNELS, DT, N_STEPS, TRUTH, Shortened, free_vibration, noisy

NAMES = ("stiffness", "damping")


def slopes(theta):
    """Derivatives of `free_vibration`."""
    time, response = DT * np.arange(N_STEPS), free_vibration(theta)
    omega, rate = 2.0 * np.pi * 1.5 * np.sqrt(theta[0]), 0.05 * theta[1]
    decay = 0.05 * np.exp(-rate * omega * time)
    by_omega = decay * (-rate * time * np.cos(omega * time) - time * np.sin(omega * time))
    by_stiffness = by_omega * omega / (2.0 * theta[0])
    by_damping = -0.05 * omega * time * response[0]
    forces = 1e5 * (response[0] + theta[0] * by_stiffness), 1e5 * theta[0] * by_damping
    return np.array([[by_stiffness, forces[0]], [by_damping, forces[1]]])


class Counted:
    """A function that counts its calls."""

    def __init__(self, function):
        self.function, self.calls = function, 0

    def __call__(self, *arguments):
        self.calls += 1
        return self.function(*arguments)


def posterior_of(jacobian=slopes, prior=None, values=None, **options):
    model = FunctionModel(free_vibration, NAMES, CHANNELS, DT, N_STEPS, jacobian=jacobian)
    measured = noisy(model)
    if values is not None:
        measured = Measurements(CHANNELS, DT, values(measured.values))
    prior = prior or {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.3)}
    sigmas = {"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(20.0)}
    return Posterior(FELikelihood(model, measured, **options).marginal(sigmas), prior)


# the search --------------------------------------------------------------------------------------------------


def test_derivatives_replace_differences_and_count_as_simulations():
    counted = Counted(slopes)
    posterior = posterior_of(counted)
    search = find_modes(posterior, seed=1)
    without = find_modes(posterior_of(None), seed=1)
    assert counted.calls > 0
    assert search.simulations == posterior.report()["simulations"] + counted.calls
    assert posterior.report()["simulations"] < without.simulations
    (mode,), (expected,) = search.modes, without.modes
    scale = np.sqrt(np.diag(expected.covariance))
    assert np.abs((mode.coords - expected.coords) / scale).max() < 1.0
    assert mode.log_evidence == pytest.approx(expected.log_evidence, abs=0.5)


def test_a_guide_with_derivatives_is_another_one():
    """A run that goes on would otherwise repeat another search."""
    with_derivatives, without = posterior_of(), posterior_of(None)
    assert with_derivatives.fingerprint == without.fingerprint
    assert with_derivatives.guide().fingerprint != without.guide().fingerprint


@pytest.mark.parametrize("budget", [0, 3, 11])
def test_a_budget_includes_derivatives(budget):
    counted = Counted(slopes)
    posterior = posterior_of(counted)
    search = find_modes(posterior, starts=3, seed=1, max_simulations=budget)
    assert not search.finished
    assert posterior.report()["simulations"] + counted.calls == search.simulations <= budget


@pytest.mark.slow
def test_a_run_in_a_pool_is_that_of_one_process():
    runs = []
    for pool in (None, 2):
        posterior = posterior_of(pool=pool)
        sampler = SMCSampler(50, 2, posterior, vectorize=True, seed=1, guide=posterior.guide(3))
        sampler.run_mcmc(None, 0)
        assert sampler.verdict.status == "converged"
        runs.append((sampler.log_evidence, sampler.log_evidence_error))
        if pool:
            posterior.likelihood.simulator.pool.close()
    assert runs[0] == runs[1]


def test_a_run_that_goes_on_repeats_no_derivatives():
    results = []
    for limits in ((400,), (20, 400)):
        counted = Counted(slopes)
        posterior = posterior_of(counted)
        sampler = SMCSampler(50, 2, posterior, vectorize=True, seed=1, guide=posterior.guide(3))
        for steps, sampler.max_simulations in zip((1, 0), limits, strict=False):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                sampler.run_mcmc(None, steps)  # the step of the limited run is replaced
        results.append((sampler.log_evidence, sampler.get_chain().tolist(), counted.calls))
    assert results[0] == results[1]


def test_parts_of_a_record_have_derivatives_of_their_length():
    class Observed(LinearOscillator):
        lengths = []

        def jacobian(self, theta):
            self.lengths.append(self.n_steps)
            return super().jacobian(theta)

    record = Record("noise", 0.02, np.random.default_rng(3).normal(size=600))
    model = Observed(record, period=0.6)
    values = model.simulate([1.1, 0.9])
    values += 0.1 * values.std(axis=1, keepdims=True) * np.random.default_rng(1).standard_normal(values.shape)
    prior = {"stiffness": TruncatedNormal(1.0, 0.3), "damping": TruncatedNormal(1.0, 0.5)}
    prior |= {
        f"sigma_{channel.name}": HalfNormal(float(row.std()))
        for channel, row in zip(model.channels, values, strict=True)
    }
    posterior = Posterior(FELikelihood(model, Measurements(model.channels, model.dt, values)), prior)
    search = find_modes(posterior, starts=4, seed=1)
    assert len(set(Observed.lengths)) > 2 and min(Observed.lengths) < model.n_steps
    assert search.modes[0].parameters[:2] == pytest.approx([1.1, 0.9], abs=0.1)


def two_events(jacobian, second_values=None):
    """Two data sets of different length; the second has its own damping."""
    model = FunctionModel(free_vibration, NAMES, CHANNELS, DT, N_STEPS, jacobian=jacobian)
    shorter = FunctionModel(
        lambda theta: free_vibration(theta)[:, :150],
        NAMES,
        CHANNELS,
        DT,
        150,
        jacobian=None if jacobian is None else lambda theta: jacobian(theta)[:, :, :150],
    )
    values = noisy(shorter, seed=2).values
    second = Measurements(CHANNELS, DT, values if second_values is None else second_values(values))
    sigmas = {"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(20.0)}
    parts = {"first": FELikelihood(model, noisy(model, seed=1)), "second": FELikelihood(shorter, second)}
    joint = JointLikelihood({key: part.marginal(sigmas) for key, part in parts.items()}, separate=["damping"])
    return Posterior(joint, {name: TruncatedNormal(1.0, 0.3) for name in joint.parameter_names})


def test_joint_likelihoods_use_derivatives():
    counted = Counted(slopes)
    with_derivatives, without = (find_modes(two_events(each), starts=3, seed=1) for each in (counted, None))
    assert counted.calls > 0 and with_derivatives.simulations < without.simulations
    (mode,), (expected,) = with_derivatives.modes, without.modes
    assert np.abs((mode.coords - expected.coords) / np.sqrt(np.diag(expected.covariance))).max() < 1.0
    assert mode.log_evidence == pytest.approx(expected.log_evidence, abs=0.5)


# the chain rule ----------------------------------------------------------------------------------------------


def assert_close(found, expected):
    """Within 1e-4 of the largest value of each channel."""
    scale = np.abs(expected).max(axis=(0, 2))[:, None]
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-4)


def with_gaps(values):
    values = values.copy()
    values[0, 20:50] = values[1, 3] = np.nan
    return values


PRIORS = {
    "independent": {"stiffness": LogNormal(1.1, 0.3), "damping": Uniform(0.2, 2.0)},
    "correlated": {NAMES: MultivariateNormal([1.0, 1.0], [[0.09, 0.05], [0.05, 0.09]])},
}


def histories(target, numbers):
    return np.array([target.archive.read(range(k, k + 1))[0] for k in numbers.ravel()], float).reshape(
        *numbers.shape, *target.data.shape
    )


@pytest.mark.parametrize("values", [None, with_gaps])
@pytest.mark.parametrize("prior", [*PRIORS.values(), None], ids=[*PRIORS, "joint"])
def test_derivatives_of_residuals_by_coordinates(prior, values):
    target = ResponseTarget(two_events(slopes, values) if prior is None else posterior_of(prior=prior, values=values))
    rows = slice(2, 4) if prior is None else slice(0, 2)  # of the data with gaps
    d = target.n_structural
    at, step = np.array([[0.3, -0.7, 0.2], [1.2, 0.4, -0.3]])[:, :d], 2e-3
    found = histories(target, at_once(target.derivatives(at)))
    assert found.shape == (2, d, rows.stop, N_STEPS)
    for coords, each in zip(at, found, strict=True):
        ahead, behind = (
            histories(target, at_once(target.run(coords + sign * step * np.eye(d))).numbers) for sign in (1.0, -1.0)
        )
        expected = (ahead - behind) / (2.0 * step)
        assert_close(each, expected)
        assert values is None or not each[:, rows][:, 0, 20:50].any()


def test_derivatives_at_other_times_than_the_response():
    model = FunctionModel(free_vibration, NAMES, CHANNELS, DT, N_STEPS, jacobian=slopes)
    values = free_vibration(TRUTH)[:, ::4]
    measured = Measurements(CHANNELS, 4 * DT, values + 1e-3 * np.abs(values).max(axis=1, keepdims=True))
    prior = {"stiffness": LogNormal(1.1, 0.3), "damping": Uniform(0.2, 2.0)}
    sigmas = {"sigma_top": HalfNormal(0.01), "sigma_base": HalfNormal(20.0)}
    target = ResponseTarget(Posterior(FELikelihood(model, measured).marginal(sigmas), prior))
    coords, step = np.array([0.3, -0.7]), 2e-3
    ahead, behind = (
        histories(target, at_once(target.run(coords + sign * step * np.eye(2))).numbers) for sign in (1.0, -1.0)
    )
    expected = (ahead - behind) / (2.0 * step)
    found = histories(target, at_once(target.derivatives(coords[None]))[0])
    assert found.shape == (2, 2, N_STEPS // 4)
    assert_close(found, expected)


# wrong derivatives -------------------------------------------------------------------------------------------


def of_shortened(theta):
    return slopes(theta)[:, :, 1:]


def not_finite(theta):
    return slopes(theta) * [[[1.0]], [[np.nan]]]


def fails(theta):
    raise ZeroDivisionError("no tangent")


@pytest.mark.parametrize("factors", [(-1.0, -1.0), (1.1, 1.1), (1.0, 0.0), (1.0, 1e3), (0.0, 0.0), None])
def test_wrong_derivatives_are_refused(factors):
    """Sign, scale, a row, unit, zero; exchanged ones."""
    scales = None if factors is None else np.array(factors)[:, None, None]
    with pytest.raises(ValueError, match=r"by \d+ % of the norm; .* by stiffness, damping, or leave jacobian out"):
        find_modes(
            posterior_of(lambda theta: slopes(theta)[::-1] if scales is None else scales * slopes(theta)), seed=1
        )


class QuietBeginning(Shortened):
    """The first third of the record does not depend on the parameters; the derivatives have the wrong sign."""

    def first(self, seconds):
        return QuietBeginning(self.respond, self.parameter_names, self.whole, round(seconds / self.dt) + 1)

    def jacobian(self, theta):
        return -np.array([self.simulate(one) - self.simulate(np.zeros(2)) for one in np.eye(2)])


def after_a_quiet_beginning(theta, phase):
    return (phase > 0.33) * (theta[0] * np.sin(40.0 * phase) + theta[1] * np.cos(33.0 * phase))


def test_wrong_derivatives_are_refused_where_the_first_comparison_shows_nothing():
    """It changes nothing at the beginning of a record, or its simulation fails."""
    model = QuietBeginning(after_a_quiet_beginning, NAMES)
    measured = noisy(model, np.array([1.2, 0.8]), np.array([0.05]))
    prior = {name: TruncatedNormal(1.0, 0.3) for name in NAMES} | {"sigma_top": HalfNormal(0.5)}
    fails = [False]

    def simulate(theta):
        if fails == [True]:
            fails.append(False)
            raise SimulationFailed("no convergence")
        return model.simulate(theta)

    def jacobian(theta):
        fails[:1] = [True]
        return model.jacobian(theta)

    fragile = FunctionModel(simulate, NAMES, model.channels, DT, model.n_steps, jacobian=jacobian)
    for each in (model, fragile):
        with pytest.raises(ValueError, match=r"by \d+ % of the norm"):
            find_modes(Posterior(FELikelihood(each, measured), prior), seed=1)
    assert len(fails) == 2


def minus_slopes(theta):
    return -slopes(theta)


def test_a_sampler_whose_search_raised_an_error_can_be_pickled():
    posterior = posterior_of(minus_slopes)
    sampler = SMCSampler(20, 2, posterior, vectorize=True, seed=1, guide=posterior.guide())
    with pytest.raises(ValueError, match="of the norm"):
        sampler.run_mcmc(None, 1)
    again = pickle.loads(pickle.dumps(sampler))
    assert again.guide.simulations == sampler.guide.simulations > 0


@pytest.mark.parametrize("prior", [0.3, 1e-4, 0.9])
def test_right_derivatives_are_accepted_for_any_width_of_the_prior(prior):
    """With a wide prior, a step of a share of its width is no small one for a vibration of many cycles."""
    channels, time = [Channel("top", "displacement", "m")], 0.01 * np.arange(4000)

    def respond(theta):
        return np.cos(40.0 * theta[0] * time)[None]

    def differentiate(theta):
        return -(40.0 * time * np.sin(40.0 * theta[0] * time))[None, None]

    model = FunctionModel(respond, ["frequency"], channels, 0.01, 4000, jacobian=differentiate)
    measured = Measurements(channels, 0.01, respond([1.0]) + 0.1 * np.random.default_rng(1).standard_normal((1, 4000)))
    prior = {"frequency": TruncatedNormal(1.0, prior), "sigma_top": HalfNormal(0.2)}
    find_modes(Posterior(FELikelihood(model, measured), prior), starts=2, seed=1, max_simulations=50)


def test_right_derivatives_of_many_parameters_are_accepted():
    """A step along all of 50 stiffnesses, whose changes partly cancel, has an error of 5 to 7 % from curvature."""
    assert not find_modes(shear_building(50, 3, jacobian=True), starts=1, seed=1, max_simulations=8).finished


@pytest.mark.parametrize(
    ("jacobian", "message"),
    [
        (
            of_shortened,
            r"of shape \(n_parameters, n_channels, n_steps\) = \(2, 2, 200\); got the shape \(2, 2, 199\) and the type",
        ),
        (lambda theta: np.moveaxis(slopes(theta), 0, -1), r"got the shape \(2, 200, 2\)"),
        (not_finite, "got values that are not finite for damping, at stiffness = "),
        (lambda theta: 1j * slopes(theta), "and the type complex128"),
        (fails, "got ZeroDivisionError: no tangent, at stiffness = .*: correct it, or leave it out"),
    ],
)
@pytest.mark.parametrize("pool", [None, pytest.param(2, marks=pytest.mark.slow)])
def test_derivatives_that_cannot_be_used(jacobian, message, pool):
    posterior = posterior_of(jacobian, pool=pool)
    with pytest.raises(ValueError, match=message):
        find_modes(posterior, starts=2, seed=1)
    if pool:
        posterior.likelihood.simulator.pool.close()


def test_a_jacobian_is_a_function_with_the_arguments_of_the_function():
    arguments = free_vibration, NAMES, CHANNELS, DT, N_STEPS
    with pytest.raises(ValueError, match="expected jacobian as a function with the arguments of function; got 3"):
        FunctionModel(*arguments, jacobian=3)
    assert not hasattr(FunctionModel(*arguments), "jacobian")
    isolated = FunctionModel(*arguments, jacobian=slopes, isolated=True)
    np.testing.assert_array_equal(isolated.jacobian([1.1, 0.9]), slopes(np.array([1.1, 0.9])))
    with pytest.raises(ValueError, match="expected one value for each of"):
        isolated.jacobian([1.1])

    def under(theta, record, factor=1.0):
        return factor * LinearOscillator(record).jacobian(theta)

    record = Record("noise", 0.02, np.random.default_rng(3).normal(size=60))
    channels = LinearOscillator.channels
    model = FunctionModel(
        lambda theta, record: LinearOscillator(record).simulate(theta), NAMES, channels, record=record,
        jacobian=partial(under, factor=2.0),
    )  # fmt: skip
    short = model.with_record(record.trim(0.0, 0.5))
    np.testing.assert_array_equal(short.jacobian([1.0, 1.0]), 2.0 * LinearOscillator(short.record).jacobian([1.0, 1.0]))
