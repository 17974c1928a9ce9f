"""Shares of the response: densities against scipy, calibration, predictive draws, gaps, caches, reports."""

import pickle
import warnings

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    Channel,
    Events,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    LinearOscillator,
    Measurements,
    Posterior,
    Record,
    SimulationCache,
    TruncatedNormal,
    propagate,
)
from fe_likelihoods.emulation.target import ResponseTarget

N, DT = 240, 0.02
CHANNELS = (Channel("top", "acceleration", "m/s2"), Channel("base", "displacement", "mm"))
SENSOR, WINDOW = (0.02, 1e-4), 0.6
NOISE = GaussianNoise(CHANNELS, shares_of="response", window=WINDOW, sensor=SENSOR)
PARAMETERS = np.array([0.3, 0.1])


def response(theta, n=N, dt=DT):
    """A burst in two channels."""
    time = dt * np.arange(n)
    burst = np.exp(-(((time - 1.5) / 0.5) ** 2))
    return np.stack([theta[0] * burst * np.sin(30.0 * time), 0.01 * theta[0] * burst * np.cos(11.0 * time)])


MODEL = FunctionModel(response, ["factor"], CHANNELS, DT, N)


def measured(values, **options):
    return Measurements(CHANNELS, options.pop("dt", DT), values, **options)


def likelihood_of(values, **options):
    return FELikelihood(MODEL, measured(values), NOISE, **options)


def deviations(history, parameters, channel, dt=DT):
    """Standard deviations of the errors of one channel without gaps, from the definitions, with loops."""
    parts = np.floor(dt * np.arange(len(history)) / (WINDOW / 3.0) + 1e-9)
    envelope = [np.mean(history[np.abs(parts - part) <= 1] ** 2) for part in parts]
    level = 0.75 * np.mean(history**2) + 0.25 * np.array(envelope)
    return np.sqrt(SENSOR[channel] ** 2 + parameters[channel] ** 2 * level)


def exact(values, theta, parameters):
    simulated = response(theta)
    sds = np.stack([deviations(simulated[c], parameters, c) for c in range(2)])
    return stats.norm.logpdf(values, simulated, sds).sum()


def test_the_likelihood_is_the_normal_density(rng):
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    likelihood, parameters = likelihood_of(values), PARAMETERS
    for theta in (0.7, 1.0, 1.4):
        expected = exact(values, [theta], parameters)
        assert likelihood([theta, *parameters]) == pytest.approx(expected, rel=1e-11)
    # a change of the noise needs no simulation, and impossible noise none at all
    assert likelihood.simulations == 3
    likelihood(np.hstack([np.full((50, 1), 1.0), parameters * rng.uniform(0.5, 2.0, (50, 1))]))
    assert likelihood([1.1, *(-parameters)]) == -np.inf and likelihood.simulations == 3


def test_draws_have_the_deviations_of_the_density():
    """Predictions: per step."""
    likelihood, parameters, n = likelihood_of(response([1.0])), PARAMETERS, 600
    names = likelihood.noise.parameter_names
    posterior = Posterior(likelihood, {"factor": TruncatedNormal(1.0, 0.1)} | {name: HalfNormal(1.0) for name in names})
    samples = np.tile([1.0, *parameters], (n, 1))
    prediction = propagate(posterior, samples, noise=True, seed=1, progress=False)
    simulated = response([1.0])
    for c in range(len(CHANNELS)):
        sd = deviations(simulated[c], parameters, c)
        np.testing.assert_allclose(prediction.sd[c], sd, rtol=1e-9)
        quantiles = prediction.quantile(0.95)[c] - prediction.quantile(0.05)[c]
        assert np.mean(quantiles / (2.0 * 1.6449 * sd)) == pytest.approx(1.0, abs=0.04)
        assert sd.max() > 1.5 * sd.min()


def test_gaps_and_times_of_channels(rng):
    """The density has the samples that are there. One channel has its own step."""
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    gap, parameters, simulated = values.copy(), PARAMETERS, response([1.2])
    gap[0, 100:130] = np.nan
    likelihood = likelihood_of(gap)
    there = np.where(np.isnan(gap), np.nan, simulated)  # the envelope is that of the samples that are there
    sd = likelihood.noise.response_deviations(parameters, there)
    expected = np.nansum(stats.norm.logpdf(gap, simulated, sd))
    assert likelihood([1.2, *parameters]) == pytest.approx(expected, rel=1e-10)
    # every second sample of the second channel, padded with NaN
    own = values.copy()
    own[1, N // 2 :] = np.nan
    own[1, : N // 2] = values[1, ::2]
    other = FELikelihood(MODEL, Measurements(CHANNELS, (DT, 2.0 * DT), own), NOISE)
    pairs = (own[0], simulated[0], DT), (values[1, ::2], simulated[1, ::2], 2.0 * DT)
    expected = sum(
        stats.norm.logpdf(data, each, deviations(each, parameters, c, dt)).sum()
        for c, (data, each, dt) in enumerate(pairs)
    )
    assert other([1.2, *parameters]) == pytest.approx(expected, rel=1e-10)


def test_caches_pools_pickles_and_joint_likelihoods(rng, tmp_path):
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    parameters, points = PARAMETERS, rng.uniform(0.8, 1.2, 6)
    rows = np.column_stack([points, np.tile(parameters, (6, 1))])
    likelihood = likelihood_of(values, cache=tmp_path / "cache")
    expected = likelihood(rows)
    again = likelihood_of(values, cache=SimulationCache(tmp_path / "cache"))
    np.testing.assert_array_equal(again(rows), expected)
    assert again.simulations == 0 and again.simulator.disk_hits == 6
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(likelihood))(rows), expected)
    white = again.with_noise(GaussianNoise(CHANNELS))
    assert (
        white.simulator.fingerprint != likelihood.simulator.fingerprint
        and white.density_parts() != likelihood.density_parts()
    )
    joint = JointLikelihood({"one": likelihood, "two": again}, separate=likelihood.noise.parameter_names)
    point = np.concatenate([[1.1], parameters, parameters])
    assert joint(point) == pytest.approx(2.0 * likelihood([1.1, *parameters]), rel=1e-12)


def test_guides_refuse_shares():
    likelihood = likelihood_of(response([1.0]))
    priors = {"factor": TruncatedNormal(1.0, 0.3)} | {
        name: HalfNormal(1.0) for name in likelihood.noise.parameter_names
    }
    with pytest.raises(ValueError, match="depends on the response.*without a guide"):
        ResponseTarget(Posterior(likelihood, priors))


def test_measurements_that_do_not_fit_are_refused():
    options, data = {"shares_of": "response", "sensor": SENSOR}, measured(response([1.0]))
    with pytest.raises(ValueError, match="at least three steps"):
        FELikelihood(MODEL, data, GaussianNoise(CHANNELS, window=0.05, **options))
    with pytest.raises(ValueError, match="needs the times of the samples"):
        NOISE.log_likelihood(np.zeros((1, 30)), N, np.ones((1, 2)))
    fitted, data = likelihood_of(response([1.0])).noise, response([1.0])
    with pytest.raises(ValueError, match=r"is for \[240, 240\] samples"):
        fitted.log_likelihood(np.zeros((1, len(fitted.statistic(data, data)))), 100, np.ones((1, 2)))


def test_events_have_levels_of_their_own_response(rng):
    """Two events with a pause, of which the second is ten times weaker: the shares belong to both."""
    time = DT * np.arange(400)
    strong = Record("EQ1", DT, np.exp(-(((time - 4.0) / 1.5) ** 2)) * rng.standard_normal(400))
    events = Events([strong, strong.scale(0.1)], rest=4.0, names=["EQ1", "EQ2"])
    model = LinearOscillator(events)
    simulated, sensor = model.simulate([1.0, 1.0]), {"acceleration": 1e-3, "displacement": 1e-6}
    noise = GaussianNoise(model.channels, shares_of="response", window=WINDOW, sensor=sensor)
    parameters = np.array([0.2, 0.3])
    single = {}
    for window in events.windows:
        part = simulated[:, window.samples]
        own = noise.with_measurements(Measurements(model.channels, DT, part))
        single[window.name] = Measurements(
            model.channels, DT, part + own.response_deviations(parameters, part) * rng.standard_normal(part.shape)
        )
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the pause is no gap
        likelihood = FELikelihood(model, single, noise)
    # in the likelihood and in a prediction of both, the level of each event is its own
    both = likelihood.noise.response_deviations(parameters, simulated, DT)
    for window in events.windows:
        part = simulated[:, window.samples]
        own = noise.with_measurements(Measurements(model.channels, DT, part))
        alone = own.response_deviations(parameters, part)
        # apart from the parts of the window at both ends, which contain samples of the pause
        np.testing.assert_allclose(both[:, window.samples][:, 30:-30], alone[:, 30:-30], rtol=0.02)
    assert likelihood.noise.under(LinearOscillator(strong)).of_parts == ()


def test_a_gap_makes_the_share_that_of_another_level(rng):
    """The share of the whole response is too large beside a gap in the strong part; the envelope is not."""
    motion = response([1.0])
    strong = slice(*np.searchsorted(np.cumsum(motion[0] ** 2) / np.sum(motion[0] ** 2), [0.2, 0.8]))
    shares = np.linspace(0.02, 1.0, 400)

    def found(local, gap):
        noise = GaussianNoise(CHANNELS, shares_of="response", window=WINDOW, sensor=SENSOR, local=local)
        values = motion.copy()
        exact = noise.with_measurements(Measurements(CHANNELS, DT, values))
        values += exact.response_deviations(np.array([0.2, 0.2]), motion) * rng.standard_normal(motion.shape)
        if gap:
            values[0, strong] = np.nan
        likelihood = FELikelihood(MODEL, Measurements(CHANNELS, DT, values), noise)
        grid = np.column_stack([np.ones(400), shares, np.full(400, 0.2)])
        return shares[np.argmax(likelihood(grid))]

    whole = [found(0.0, False) for _ in range(20)]
    nearby = [found(1.0, True) for _ in range(20)]
    beside = [found(0.0, True) for _ in range(20)]

    def differs(sample):
        return abs(np.mean(sample) - 0.2) / (np.std(sample, ddof=1) / np.sqrt(20))

    assert differs(whole) < 4.0 and differs(nearby) < 4.0
    assert differs(beside) > 4.0 and np.mean(beside) > 0.2
