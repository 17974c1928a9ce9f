"""The ready-made posteriors: bundled data, priors, options, and simulations that do not fail."""

from dataclasses import replace

import numpy as np
import pytest
from fe_likelihoods.data import make_bridge_column_eq1
from scipy import stats

from fe_likelihoods import GaussianNoise, check_result, problems
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.problems import (
    BRIDGE_COLUMN_MEANS,
    BRIDGE_COLUMN_NOISE,
    bridge_column,
    bridge_column_data,
    bridge_column_prior,
)
from fe_likelihoods.signals.channels import Channel, Measurements, relative_errors
from fe_likelihoods.signals.datasets import Dataset, read_dataset, write_dataset
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.units import G0, to_si
from tests.emulation.problems import guided
from tests.scipy_bridge import exchange_piers

INCH = to_si(1.0, "in").item()
TRUTH = np.array(list(BRIDGE_COLUMN_MEANS.values()))
NOISE = np.array(list(BRIDGE_COLUMN_NOISE.values()))
PAPER_CV = np.array([0.30, 0.10, 1.2, 9.2, 0.68]) / 100  # CV of the posterior, Ec Es a0 a1 ft
REAL_RECORD = "loma_prieta_1989_apeel2_redwood_city_133.csv"


@pytest.fixture(scope="module")
def data():
    return bridge_column_data()


@pytest.fixture(scope="module")
def strong(data):
    """Five seconds around the peak of the bundled record, twice as strong."""
    return data.record.trim(5.0, 10.0).scale(2.0)


# --- the bundled data ------------------------------------------------------------------------------------------------


def test_the_data_have_the_features_of_the_paper(data):
    record, measurements, attributes = data
    assert (record.dt, record.n_steps) == (1 / 256, 12800)
    assert np.abs(record.acceleration).max() / G0 == pytest.approx(0.2, abs=0.02)
    assert (measurements.n_channels, measurements.n_steps, measurements.dt) == (2, 12800, 1 / 256)
    assert 1.5 < np.abs(measurements.channel("displacement")).max() / INCH < 3.0
    # The velocity is zero at the end. A stochastic record easily has a drift of velocity.
    velocity = np.cumsum(record.acceleration) * record.dt
    assert abs(velocity[-1]) < 0.02 * np.abs(velocity).max()


@pytest.mark.slow
def test_the_data_set_can_be_made_again(data, tmp_path, monkeypatch):
    written = {}
    monkeypatch.setattr(make_bridge_column_eq1, "write_dataset", lambda *arguments: written.update(all=arguments))
    make_bridge_column_eq1.main()
    _, record, measurements, attributes = written["all"]
    np.testing.assert_allclose(measurements.values, data.measurements.values, rtol=0, atol=1e-6)
    write_dataset(tmp_path / "again.h5", record, measurements, attributes)
    again = read_dataset(tmp_path / "again.h5")
    assert again.attributes == data.attributes


@pytest.mark.slow
def test_the_first_example_finds_its_truth_and_can_be_used():
    posterior = bridge_column(data="short")
    truth = bridge_column_data("short").attributes["truth"]
    sampler = guided(posterior)
    samples = sampler.get_chain(flat=True)
    low, high = np.quantile(samples, [0.05, 0.95], axis=0)
    known = np.array([truth[name] for name in posterior.parameter_names])
    assert ((low < known) & (known < high)).sum() >= 6  # of seven 90 % intervals
    assert check_result(sampler).status == "use"


# --- prior and posterior ---------------------------------------------------------------------------------------------


def test_the_prior_is_that_of_the_paper():
    prior = bridge_column_prior()
    cvs = dict(Ec=0.30, Es=0.20, a0=0.60, a1=0.60, ft=0.40)
    peers = {name: stats.truncnorm(-1 / cv, np.inf, loc=1.0, scale=cv) for name, cv in cvs.items()}
    peers["sigma_acceleration"] = stats.halfnorm(scale=0.1 * G0)
    peers["sigma_displacement"] = stats.halfnorm(scale=1.2 * INCH)
    assert list(prior.names) == list(peers)
    rng = np.random.default_rng(0)
    points = np.column_stack([peer.rvs(500, random_state=rng) for peer in peers.values()])
    expected = sum(peer.logpdf(column) for peer, column in zip(peers.values(), points.T, strict=True))
    np.testing.assert_allclose(prior.logpdf(points), expected, rtol=1e-10)
    assert np.isneginf(prior.logpdf(np.where(np.eye(7, dtype=bool), -0.01, points[:7]))).all()


def test_the_default_posterior(data):
    posterior = bridge_column()
    assert posterior.parameter_names == ["Ec", "Es", "a0", "a1", "ft", "sigma_acceleration", "sigma_displacement"]
    assert posterior.fast_parameters == (5, 6)
    nominal, truth = (posterior.likelihood.model.simulate(theta) for theta in (np.ones(5), TRUTH))
    # Errors about as large as in the paper (94 and 89 %); at the truth only noise and mesh are left.
    assert (relative_errors(nominal - data.measurements.values, data.measurements.values) > 0.6).all()
    assert (relative_errors(truth - data.measurements.values, data.measurements.values) < 0.35).all()
    log_likelihood = posterior.log_likelihood(np.append(TRUTH, NOISE))
    n = data.measurements.n_steps
    misfit = ((truth - data.measurements.values) ** 2).sum(axis=1)
    expected = np.sum(-0.5 * misfit / NOISE**2 - n * np.log(NOISE) - 0.5 * n * np.log(2 * np.pi))
    assert log_likelihood == pytest.approx(expected, rel=1e-10)
    assert log_likelihood > posterior.log_likelihood(np.append(np.ones(5), NOISE)) + 1000


def test_measurements_must_fit(data, strong):
    record, measurements = data.record.trim(0.0, 2.0), data.measurements.trim(0.0, 2.0)
    force = Measurements((Channel("force", "force", "kip"),), record.dt, np.zeros((1, record.n_steps)))
    for arguments, message in (
        ({"data": Dataset(record, data.measurements.trim(0.0, 1.5), {})}, "samples.*use the same part"),
        ({"data": Dataset(record, replace(measurements, dt=2.0 * measurements.dt), {})}, "step.*use the same part"),
        ({"data": Dataset(record, force, {})}, "channels are acceleration, displacement, the measurements' are force"),
        ({"data": "eq2"}, "eq1"),
        ({"duration": 51.0}, "duration"),
        ({"every": 1.5, "duration": 2.0}, "factor"),
        ({"duration": 2.0, "analysis": {}}, "ColumnAnalysis"),
    ):
        with pytest.raises(ValueError, match=message):
            bridge_column(**arguments)
    assert bridge_column(data=Dataset(record, measurements, {})).ndim == 7


# --- failures --------------------------------------------------------------------------------------------------------


def failures(model, thetas):
    """Reasons of the failed simulations. All other responses are finite."""
    response, reasons = model.simulate_batch(thetas)
    failed = np.array([bool(reason) for reason in reasons])
    assert np.isfinite(response[~failed]).all() and np.isnan(response[failed]).all()
    return [f"{theta}: {reason}" for theta, reason in zip(thetas, reasons, strict=True) if reason]


def test_strong_shaking_does_not_fail(strong, rng):
    draws = bridge_column_prior().rvs(100, rng)[:, :5]
    # One failure in a hundred is ten times the share that the slow test allows.
    failed = failures(RCColumn.lhpost(strong), draws)
    assert len(failed) <= 1, failed


@pytest.mark.slow
@pytest.mark.parametrize(("which", "allowed"), [("prior", 2), ("posterior", 0)])
def test_simulations_do_not_fail_on_the_real_record(shared, rng, which, allowed):
    """Simulations that fail inside the bulk of the posterior would bias it."""
    n = 400
    record = read_record(shared / "records" / REAL_RECORD).scale(0.85)
    model = RCColumn.lhpost(record)
    draws = TRUTH * (1 + PAPER_CV * rng.standard_normal((n, 5)))
    draws = bridge_column_prior().rvs(n, rng)[:, :5] if which == "prior" else draws
    failed = [reason for part in np.split(draws, range(100, n, 100)) for reason in failures(model, part)]
    assert len(failed) <= allowed, failed


# --- the isolated bridge ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["twin", "means"])
def test_the_data_of_the_bridge_say_that_they_are_synthetic(name):
    record, measurements, attributes = problems.isolated_bridge_data(name)
    assert "SYNTHETIC" in record.source
    assert measurements.description.startswith("SYNTHETIC, nominal values assumed")
    assert "NOT measured data, nominal values assumed" in attributes["title"]
    assert set(attributes["truth"]) == set(problems.isolated_bridge(data=name).parameter_names)
    assert attributes["truth"]["sigma"] == {"twin": 0.05, "means": 0.1}[name]
    assert (record.dt, measurements.dt, measurements.n_steps) == (0.005, 0.01, 1501)
    np.testing.assert_allclose(record.acceleration, problems.table_motion().acceleration, atol=1e-11)


def test_the_likelihood_of_the_bridge_has_one_sigma_for_normalised_channels():
    """One sigma for channels that are divided by their measured root mean squares."""
    posterior = problems.isolated_bridge(step=0.5e-3)
    assert posterior.parameter_names[-1] == "sigma" and posterior.ndim == 11
    x = np.append(np.full(10, 1.05), 0.07)
    y = posterior.likelihood.measurements.values
    residuals = posterior.likelihood.model.simulate(x[:10]) - y
    rms = np.sqrt(np.mean(y**2, axis=1))
    n_channels, n = y.shape
    expected = (
        -n_channels * n * np.log(0.07)
        - np.sum(np.sum(residuals**2, axis=1) / rms**2) / (2 * 0.07**2)
        - 0.5 * n_channels * n * np.log(2 * np.pi)
        - n * np.log(rms).sum()
    )
    assert posterior.log_likelihood(x) == pytest.approx(expected, rel=1e-12)
    assert posterior.log_prob(np.append(np.full(10, 1.05), 0.0005)) == -np.inf
    assert posterior.log_prob(np.append(np.full(10, 0.19), 0.05)) == -np.inf
    assert posterior.report()["simulations"] == 1, "no simulation outside of the support"


def test_channels_and_noise_of_the_bridge_can_be_chosen():
    channels = problems.isolated_bridge_data().measurements.channels
    names = tuple(channel.name for channel in channels)
    each = problems.isolated_bridge(channels=names, noise=GaussianNoise(channels))
    assert each.ndim == 20
    rms = np.sqrt(np.mean(each.likelihood.measurements.values**2, axis=1))
    shared = problems.isolated_bridge(channels=names)
    x = np.full(10, 1.1)
    assert each.log_likelihood(np.append(x, 0.06 * rms)) == pytest.approx(
        shared.log_likelihood(np.append(x, 0.06)), rel=1e-12
    )
    assert problems.isolated_bridge(channels=("acc_p1", "Ub_2")).likelihood.model.outputs == ("acc_p1", "Ub_2")


def test_the_means_do_not_distinguish_the_piers():
    posterior = problems.isolated_bridge(data="means")
    model = posterior.likelihood.model
    values = problems.isolated_bridge_data("means").attributes["truth"]
    truth = np.array([values[name] for name in model.parameter_names])
    other = exchange_piers(model, truth)
    assert np.abs(other - truth).max() > 0.4
    at = [posterior.log_likelihood(np.append(theta, 0.1)) for theta in (truth, other, 0.5 * (truth + other))]
    assert at[0] == pytest.approx(at[1], abs=1e-6)
    assert at[2] < at[0] - 100.0
    one_pier = problems.isolated_bridge(channels=("Ub_1", "Fb_1", "acc_p1"))
    at = [one_pier.log_likelihood(np.append(theta, 0.1)) for theta in (truth, other)]
    assert abs(at[0] - at[1]) > 100.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"data": "tests"}, "twin"),
        ({"channels": ("Ub_9",)}, "Ub_9"),
        ({"data": "means", "channels": ("Ub_1",)}, "Ub_1"),
        ({"step": 0.3e-3}, "divides"),
    ],
)
def test_bad_arguments_of_the_bridge_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        problems.isolated_bridge(**arguments)


def test_the_free_vibration_has_its_stated_truth():
    posterior = problems.free_vibration()
    residuals = posterior.likelihood.residuals_of(posterior.likelihood.model.simulate([1.1, 0.8]))
    assert 0.0018 < np.sqrt(np.mean(residuals**2)) < 0.0022  # 2 mm within twice the standard error of 200 samples
    assert posterior([1.1, 0.8, 0.002]) > posterior([[1.0, 1.0, 0.002], [1.1, 0.8, 0.004]]).max()
    assert posterior.likelihood.first(0.5).model.n_steps == 51
