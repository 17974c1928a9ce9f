"""The posterior: its formula, the properties that clients rely on, and models that fail."""

import logging
import math
import warnings
from multiprocessing.pool import ThreadPool

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods.likelihood.failure_log import FailureLog, reason_without_numbers
from fe_likelihoods.likelihood.likelihood import FELikelihood
from fe_likelihoods.likelihood.posterior import Posterior
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.noise.gaussian import GaussianNoise
from fe_likelihoods.priors.distributions import HalfNormal, LogNormal, TruncatedNormal, Uniform
from fe_likelihoods.priors.priors import Prior
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import SimulationBatch, SimulationFailed, simulate_batch
from tests.lines import Batched, Line, misfit_batch

TRUTH = np.array([1.15, 0.8])
SIGMA = np.array([0.05, 0.001])


@pytest.fixture
def oscillator(rng):
    return LinearOscillator(Record("noise", 0.02, rng.normal(size=300)), period=0.6, damping_ratio=0.05)


@pytest.fixture
def measurements(oscillator, rng):
    values = oscillator.simulate(TRUTH) + SIGMA[:, None] * rng.normal(size=(2, oscillator.n_steps))
    return Measurements(oscillator.channels, oscillator.dt, values)


@pytest.fixture
def prior():
    return Prior(
        {
            "stiffness": TruncatedNormal(1.0, 0.3),
            "damping": TruncatedNormal(1.0, 0.6),
            "sigma_acceleration": HalfNormal(0.2),
            "sigma_displacement": HalfNormal(0.005),
        }
    )


@pytest.fixture
def posterior(oscillator, measurements, prior):
    return Posterior(FELikelihood(oscillator, measurements), prior)


class Polynomial:
    """Responses ``theta[0] + theta[1] t``, in two channels; fails at chosen points, and counts its runs."""

    parameter_names = ("offset", "slope")
    channels = (Channel("a", "acceleration", "m/s2"), Channel("b", "displacement", "m"))
    dt = 0.5
    n_steps = 8
    fingerprint = "polynomial"

    def __init__(self):
        self.runs = []

    def simulate(self, theta):
        offset, slope = theta
        self.runs.append(tuple(theta))
        theta[:] = np.nan  # a model that changes its input must not affect the caller
        if offset == 1.0:
            raise SimulationFailed("no convergence at step 3")
        if offset == 2.0:
            raise ZeroDivisionError("float division by zero")
        response = np.vstack([np.full(self.n_steps, offset), slope * self.dt * np.arange(self.n_steps)])
        if offset == 3.0:
            response[1, 5] = np.nan
        if offset == 4.0:
            response[0] = np.inf
        if offset == 5.0:
            return response[:, :-1]
        if offset == 6.0:
            return None
        if offset == 8.0:
            response *= 1e200
        if offset == 9.0:
            raise SimulationFailed("")
        return response


BAD = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 9.0)


def polynomial_posterior(model, pool=None):
    rng = np.random.default_rng(5)
    measurements = Measurements(model.channels, model.dt, rng.normal(size=(2, model.n_steps)))
    names = ("offset", "slope", "sigma_a", "sigma_b")
    distributions = (Uniform(-10.0, 10.0), TruncatedNormal(0.2, 1.0, -math.inf), HalfNormal(1.0), LogNormal(1.0, 0.3))
    return Posterior(FELikelihood(model, measurements, pool=pool), dict(zip(names, distributions, strict=True)))


# formula ------------------------------------------------------------------------------------------------------------


def test_equals_the_direct_formula(posterior, oscillator, measurements):
    x = np.array([1.1, 0.7, 0.06, 0.0012])
    residuals = measurements.values - oscillator.simulate(x[:2])
    log_likelihood = stats.norm.logpdf(residuals, scale=x[2:, None]).sum()
    log_prior = (
        stats.truncnorm.logpdf(x[0], -1 / 0.3, np.inf, 1.0, 0.3)
        + stats.truncnorm.logpdf(x[1], -1 / 0.6, np.inf, 1.0, 0.6)
        + stats.halfnorm.logpdf(x[2:], 0, [0.2, 0.005]).sum()
    )
    assert posterior.log_likelihood(x) == pytest.approx(log_likelihood, rel=1e-12)
    assert posterior.log_prior(x) == pytest.approx(log_prior, rel=1e-12)
    assert posterior(x) == posterior.log_prob(x) == pytest.approx(log_likelihood + log_prior, rel=1e-12)


# shapes, names, orders ----------------------------------------------------------------------------------------------


def test_points_and_batches(posterior, rng):
    x = posterior.sample_prior(7, rng)
    for density in (posterior, posterior.log_prob, posterior.log_prior, posterior.log_likelihood):
        batch = density(x)
        assert batch.shape == (7,)
        assert batch.dtype == float
        assert density(x[:0]).shape == (0,)
        assert type(density(x[0])) is float
        assert [density(row) for row in x] == batch.tolist()  # to the last bit
        assert density(x[:1]).tolist() == [batch[0]]
    u = rng.random((5, 4))
    np.testing.assert_array_equal(posterior.prior_transform(u)[2], posterior.prior_transform(u[2]))
    np.testing.assert_array_equal(posterior.sample_prior(3, 8), posterior.prior.rvs(3, 8))


def test_named_values(posterior, rng):
    x = posterior.sample_prior(3, rng)
    named = [dict(zip(posterior.parameter_names[::-1], row[::-1], strict=True)) for row in x]
    assert [posterior(point) for point in named] == posterior(x).tolist()
    columns = dict(zip(posterior.parameter_names, x.T, strict=True))
    assert posterior(columns).tolist() == posterior(x).tolist()
    with pytest.raises(ValueError, match="stiffness, damping.*got the names stiffness"):
        posterior({"stiffness": 1.0})


def test_prior_is_put_in_the_order_of_the_parameters(posterior, oscillator, measurements, prior):
    assert posterior.parameter_names == ["stiffness", "damping", "sigma_acceleration", "sigma_displacement"]
    assert posterior.fast_parameters == (2, 3)
    assert posterior.ndim == posterior.prior.dim == 4
    turned = Posterior(FELikelihood(oscillator, measurements), prior.reorder(prior.names[::-1]))
    x = posterior.sample_prior(4, 1)
    np.testing.assert_array_equal(turned.log_prior(x), posterior.log_prior(x))
    np.testing.assert_array_equal(turned(x), posterior(x))


def test_prior_of_other_parameters_is_refused(oscillator, measurements, prior):
    likelihood = FELikelihood(oscillator, measurements)
    more = Prior({**prior.distributions, "extra": HalfNormal(1.0)})
    fewer = Prior({name: prior.distributions[name] for name in prior.names[1:]})
    with pytest.raises(ValueError, match=r"'extra'.*'sigma_displacement'\];.*unknown: \['extra'\]"):
        Posterior(likelihood, more)
    with pytest.raises(ValueError, match=r"without a prior: \['stiffness'\]"):
        Posterior(likelihood, fewer)
    with pytest.raises(ValueError, match="expects a non-empty mapping"):
        Posterior(likelihood, None)


# measurements against the model --------------------------------------------------------------------------------------


def test_channels_are_matched_by_name(oscillator, measurements):
    turned = measurements.select(["displacement", "acceleration"])
    x = np.array([1.1, 0.7, 0.06, 0.0012])
    straight = FELikelihood(oscillator, measurements)
    likelihood = FELikelihood(oscillator, turned)
    assert likelihood.log_likelihood(x) == straight.log_likelihood(x)
    assert likelihood.simulator.fingerprint == straight.simulator.fingerprint


def test_measurements_that_do_not_fit_are_refused(oscillator, measurements):
    cases = {
        "select": measurements.select(["acceleration"]),
        "correct the step": Measurements(measurements.channels, 2.0 * measurements.dt, measurements.values),
        "trim": measurements.trim(0.0, 3.0),
        "relative acceleration": Measurements(
            (Channel("acceleration", "relative acceleration", "g"), measurements.channels[1]),
            measurements.dt,
            measurements.values,
        ),
        "in the measurements": Measurements(
            (Channel("acceleration", "force", "kN"), measurements.channels[1]), measurements.dt, measurements.values
        ),
    }
    for advice, case in cases.items():
        with pytest.raises(ValueError, match=advice):
            FELikelihood(oscillator, case)
    with pytest.raises(ValueError, match="map"):
        FELikelihood(oscillator, measurements, pool="four")


def test_data_fingerprint_knows_the_measurements_only(oscillator, measurements, prior):
    likelihood = FELikelihood(oscillator, measurements)
    model = LinearOscillator(oscillator.record, 0.7)
    turned = measurements.select(["displacement", "acceleration"])
    noise = GaussianNoise(measurements.channels, groups="all")
    same = [FELikelihood(model, measurements), FELikelihood(oscillator, turned), likelihood.with_noise(noise)]
    other = Measurements(measurements.channels, measurements.dt, measurements.values * 1.01)
    assert {one.data_fingerprint for one in same} == {likelihood.data_fingerprint}
    assert Posterior(likelihood, prior).data_fingerprint == likelihood.data_fingerprint
    assert Posterior(likelihood, prior).marginal().data_fingerprint == likelihood.data_fingerprint
    assert FELikelihood(oscillator, other).data_fingerprint != likelihood.data_fingerprint


# failures ------------------------------------------------------------------------------------------------------------


def test_an_object_that_is_no_model_is_refused_with_the_missing_members(oscillator, measurements):
    class Incomplete:
        parameter_names, channels = oscillator.parameter_names, oscillator.channels
        dt, n_steps = oscillator.dt, oscillator.n_steps

    with pytest.raises(ValueError, match="Incomplete is not a model, because it has no fingerprint, simulate; a model"):
        FELikelihood(Incomplete(), measurements)
    with pytest.raises(ValueError, match="function is not a model, because it has no parameter_names, channels, dt"):
        FELikelihood(lambda theta: theta, measurements)


@pytest.mark.parametrize("threads", [0, 2])
def test_a_failed_simulation_is_minus_infinity_with_its_reason(threads, caplog):
    model = Polynomial()
    x = np.array([[offset, 0.1, 0.5, 1.0] for offset in (*BAD, 0.5)])
    with warnings.catch_warnings(), caplog.at_level(logging.WARNING), ThreadPool(max(threads, 1)) as pool:
        warnings.simplefilter("error")
        posterior = polynomial_posterior(model, pool if threads else None)
        values = posterior(x)
    assert np.isneginf(values[:-1]).all()
    assert np.isfinite(values[-1])
    report = posterior.report()
    reasons = {failure["parameters"]["offset"]: failure["reason"] for failure in report["failures"]}
    assert list(reasons) == list(BAD)
    assert reasons[1.0] == "no convergence at step 3"
    assert reasons[2.0] == "ZeroDivisionError: float division by zero"
    assert reasons[3.0] == "the response of channel 'b' is not finite"
    assert reasons[4.0] == "the response of channel 'a' is not finite"
    assert reasons[8.0] == "the misfit of channel 'a' is not finite"
    assert "shape (2, 7), expected (n_channels, n_steps) = (2, 8)" in reasons[5.0]
    assert "shape" in reasons[6.0]
    assert reasons[9.0] == "no reason given"
    assert report["failures"][0]["parameters"] == {"offset": 1.0, "slope": 0.1}
    assert report["simulations"] == len(BAD) + 1
    assert report["failure_count"] == sum(report["failure_reasons"].values()) == len(BAD)
    assert report["cache_hits"] == 0
    assert report["seconds"] > 0.0
    assert len(caplog.records) == 1  # only the first failure is logged
    assert "(no convergence at step 3) at offset = 1, slope = 0.1" in caplog.text

    assert posterior(x[0]) == -np.inf
    assert type(posterior.log_likelihood(x[0])) is float
    assert len(caplog.records) == 1


@pytest.mark.parametrize(
    ("reason", "text"),
    [
        ("no convergence at step 31, residual -2.5e-03", "no convergence at step #, residual #"),
        ("[1. .5 -2]: 3 s after 0x7fA1", "[# # #]: # s after #"),
        ("Steel02 of section_3 in model.04: step-7", "Steel02 of section_3 in model.04: step-#"),
        ("no reason given", "no reason given"),
        ("failed at step 31. Reduce dt, 2 is", "failed at step #. Reduce dt, # is"),
        ("failed at step 31.", "failed at step #."),
        ("see /tmp/ab12/3.log: 2.e-3, 1.5", "see /tmp/ab12/#.log: #, #"),
    ],
)
def test_reasons_without_their_numbers(reason, text):
    assert reason_without_numbers(reason) == text


def test_reasons_are_bounded_and_later_ones_are_counted_apart():
    log = FailureLog(["x"])
    for k in range(300):
        log.add(np.array([k]), f"no convergence at step {k}")
    log.add(np.array([0.0]), "buckled")
    assert log.reasons["no convergence at step #"] == 200 and log.reasons["buckled"] == 1
    for k in range(900):
        log.add(np.array([k]), f"error {'a' * k}")
    assert len(log.reasons) == 201 and log.reasons["other reasons"] == 802 and log.reasons.total() == log.count == 1201
    assert len(log.records) == 1000


def test_nan_from_a_noise_is_a_failure():
    class BadNoise:
        parameter_names = ("scale",)

        def log_likelihood(self, misfit, n_steps, parameters):
            return np.full(len(misfit), np.nan)

    model = Polynomial()
    measurements = Measurements(model.channels, model.dt, np.ones((2, model.n_steps)))
    likelihood = FELikelihood(model, measurements, noise=BadNoise())
    assert likelihood.parameter_names == ("offset", "slope", "scale")
    assert likelihood.log_likelihood([0.5, 0.1, np.nan]) == -np.inf
    assert likelihood.simulator.failures.records == []
    assert likelihood.log_likelihood([0.5, 0.1, 1.0]) == -np.inf
    assert likelihood.simulator.failures.records[0]["reason"] == "the log-likelihood of the noise is nan"


# number of simulations ------------------------------------------------------------------------------------------------


def test_nothing_is_simulated_outside_the_support():
    model = Polynomial()
    posterior = polynomial_posterior(model)
    good = [0.5, 0.1, 0.5, 1.0]
    x = np.tile(good, (9, 1))
    x[0, 0], x[1, 0] = 10.1, -10.1
    x[2, 2], x[3, 3] = -0.1, -1.0
    x[4, 0], x[5, 1], x[6, 2], x[7, 3] = np.nan, np.inf, np.nan, -np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for density in (posterior, posterior.log_likelihood):
            values = density(x)
            assert np.isneginf(values[:8]).all()
            assert np.isfinite(values[8])
            assert [density(row) for row in x[:8]] == [-np.inf] * 8
    assert set(model.runs) == {(0.5, 0.1)}
    assert posterior.report()["simulations"] == len(model.runs) == 1
    assert posterior.report()["failure_count"] == 0


# batch methods --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("broken", ["", "raises", "shape"])
def test_a_batch_method_gives_the_values_of_single_simulations_also_where_it_fails(broken, caplog):
    """A row that is not finite fails alone; a batch that fails as a whole is run row by row."""

    class Model(Batched):
        def simulate_batch(self, thetas):
            response, reasons = super().simulate_batch(thetas)
            if broken == "raises":
                raise MemoryError("too many")
            response[thetas[:, 0] == 0.7, 1, 5] = np.nan
            return SimulationBatch(response[:, :1] if broken == "shape" else response, reasons)

    thetas = np.array([[0.5, 0.1], [1.0, 2.0], [0.6, 0.3], [0.7, 0.2]])
    expected = simulate_batch(Line(), thetas)
    single = misfit_batch(Line(), thetas, np.ones((2, 8)))
    with caplog.at_level(logging.WARNING):
        batch, misfit = simulate_batch(Model(), thetas), misfit_batch(Model(), thetas, np.ones((2, 8)))
    fine = slice(0, 4 if broken else 3)
    np.testing.assert_array_equal(batch.response[fine], expected.response[fine])
    np.testing.assert_array_equal(misfit.misfit[fine], single.misfit[fine])
    assert batch.reasons[fine] == misfit.reasons[fine] == expected.reasons[fine]
    assert ("one by one" in caplog.text) == bool(broken)
    if not broken:
        assert batch.reasons[3] == misfit.reasons[3] == "the response of channel 'b' is not finite"
        assert np.isnan(batch.response[3]).all() and np.isnan(misfit.misfit[3]).all()


@pytest.mark.parametrize("model", [Line(), Batched()], ids=["single", "batch"])
def test_an_empty_batch(model):
    assert simulate_batch(model, np.empty((0, 2))).response.shape == (0, 2, 8)
    assert misfit_batch(model, np.empty((0, 2)), np.ones((2, 8))).misfit.shape == (0, 2) and model.runs == 0
