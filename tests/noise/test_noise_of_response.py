"""Shares of the response, and bands of frequency: densities against scipy, calibration, predictive draws, gaps, caches,
reports."""

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
from fe_likelihoods.checks.screening import check_gaps
from fe_likelihoods.emulation.modes import find_modes
from fe_likelihoods.emulation.target import ResponseTarget

N, DT = 240, 0.02
CHANNELS = (Channel("top", "acceleration", "m/s2"), Channel("base", "displacement", "mm"))
SENSOR, EDGES, WINDOW = (0.02, 1e-4), (2.0, 8.0), 0.6
NOISES = {
    "modulated": GaussianNoise(CHANNELS, level="response", window=WINDOW, sensor=SENSOR),
    "shares in bands": GaussianNoise(CHANNELS, groups=EDGES, level="response", sensor=SENSOR),
    "levels in bands": GaussianNoise(CHANNELS, groups=EDGES, sensor=SENSOR),
}
PARAMETERS = {
    "modulated": np.array([0.3, 0.1]),
    "shares in bands": np.array([0.5, 0.1, 2.0, 0.2, 0.4, 0.9]),
    "levels in bands": np.array([0.2, 0.1, 0.05, 1e-3, 3e-3, 5e-4]),
}
EVERY = pytest.mark.parametrize("kind", list(NOISES))


def response(theta, n=N, dt=DT):
    """A burst in two channels."""
    time = dt * np.arange(n)
    burst = np.exp(-(((time - 1.5) / 0.5) ** 2))
    return np.stack([theta[0] * burst * np.sin(30.0 * time), 0.01 * theta[0] * burst * np.cos(11.0 * time)])


MODEL = FunctionModel(response, ["factor"], CHANNELS, DT, N)


def measured(values, **options):
    return Measurements(CHANNELS, options.pop("dt", DT), values, **options)


def likelihood_of(kind, values, **options):
    return FELikelihood(MODEL, measured(values), NOISES[kind], **options)


def covariance(kind, history, parameters, channel, dt=DT):
    """Covariance of the errors of one channel without gaps, from the definitions, with loops and a full matrix."""
    n, sensor = len(history), SENSOR[channel]
    if kind == "modulated":
        parts = np.floor(dt * np.arange(n) / (WINDOW / 3.0) + 1e-9)
        envelope = [np.mean(history[np.abs(parts - part) <= 1] ** 2) for part in parts]
        level = 0.75 * np.mean(history**2) + 0.25 * np.array(envelope)
        return np.diag(sensor**2 + parameters[channel] ** 2 * level)
    time = np.arange(n)
    basis = np.sqrt(2.0 / n) * np.cos(np.pi * np.outer(time, time + 0.5) / n)
    basis[0] /= np.sqrt(2.0)
    band = np.digitize(time / (2.0 * n * dt), EDGES)
    variances, coefficients = np.empty(n), basis @ history
    for b, level in enumerate(parameters[3 * channel : 3 * channel + 3]):
        inside = band == b
        size = np.mean(coefficients[inside] ** 2) if kind == "shares in bands" else n / inside.sum()
        variances[inside] = sensor**2 + level**2 * size
    return basis.T @ np.diag(variances) @ basis


def exact(kind, values, theta, parameters):
    simulated = response(theta)
    return sum(
        stats.multivariate_normal(simulated[c], covariance(kind, simulated[c], parameters, c)).logpdf(values[c])
        for c in range(2)
    )


@EVERY
def test_the_likelihood_is_the_multivariate_normal_density(kind, rng):
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    likelihood, parameters = likelihood_of(kind, values), PARAMETERS[kind]
    for theta in (0.7, 1.0, 1.4):
        expected = exact(kind, values, [theta], parameters)
        assert likelihood([theta, *parameters]) == pytest.approx(expected, rel=1e-11)
    noise, simulated = likelihood.noise, response([1.4])
    assert noise.log_densities(simulated - values, simulated, parameters).sum() == pytest.approx(expected, rel=1e-11)
    # a change of the noise needs no simulation, and impossible noise none at all
    assert likelihood.simulations == 3
    likelihood(np.hstack([np.full((50, 1), 1.0), parameters * rng.uniform(0.5, 2.0, (50, 1))]))
    assert likelihood([1.1, *(-parameters)]) == -np.inf and likelihood.simulations == 3


@EVERY
def test_draws_have_the_covariance_of_the_density(kind, rng):
    """Predictions and replicated measurements: per step, and correlation from step to step, against the matrix."""
    likelihood, parameters, n = likelihood_of(kind, response([1.0])), PARAMETERS[kind], 600
    names = likelihood.noise.parameter_names
    posterior = Posterior(likelihood, {"factor": TruncatedNormal(1.0, 0.1)} | {name: HalfNormal(1.0) for name in names})
    samples = np.tile([1.0, *parameters], (n, 1))
    prediction = propagate(posterior, samples, noise=True, seed=1, progress=False)
    draws = posterior.predictive_draws(samples)
    simulated = response([1.0])
    for c, channel in enumerate(CHANNELS):
        matrix = covariance(kind, simulated[c], parameters, c)
        sd = np.sqrt(np.diag(matrix))
        np.testing.assert_allclose(prediction.sd[c], sd, rtol=1e-9)
        errors = (draws.replicates[channel.name] - draws.responses[channel.name]) / sd
        # variances of n draws have a relative standard error of sqrt(2 / n)
        assert np.abs(errors.var(axis=0) - 1.0).max() < 5.0 * np.sqrt(2.0 / n)
        lag_one = np.diag(matrix, 1) / (sd[1:] * sd[:-1])
        assert np.abs((errors[:, 1:] * errors[:, :-1]).mean(axis=0) - lag_one).max() < 5.0 * np.sqrt(2.0 / n)
        quantiles = prediction.quantile(0.95)[c] - prediction.quantile(0.05)[c]
        assert np.mean(quantiles / (2.0 * 1.6449 * sd)) == pytest.approx(1.0, abs=0.04)
        if kind == "modulated":
            assert sd.max() > 1.5 * sd.min() and np.abs(lag_one).max() == 0.0
        elif channel.name == "top":
            assert np.abs(lag_one).mean() > 0.2


def draw(noise, parameters, simulated, rng):
    normal = rng.standard_normal(simulated.shape)
    if noise.n_bands > 1:
        return noise.response_errors(parameters, simulated, normal)
    return noise.response_deviations(parameters, simulated) * normal


@EVERY
def test_gaps_and_times_of_channels(kind, rng):
    """A gap divides a channel; samples that are there are those of the density. One channel has its own step."""
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    gap, parameters = values.copy(), PARAMETERS[kind]
    gap[0, 100:130] = np.nan
    likelihood = likelihood_of(kind, gap)
    named = check_gaps(likelihood.noise)
    assert len(named) == (kind == "modulated") and all([*each.numbers] == ["top"] for each in named)
    simulated = response([1.2])
    if kind == "modulated":  # the envelope is that of the samples that are there
        there = np.where(np.isnan(gap), np.nan, simulated)
        sd = likelihood.noise.response_deviations(parameters, there)
        expected = np.nansum(stats.norm.logpdf(gap, simulated, sd))
    else:  # two stretches, and the channel without a gap
        expected = stats.multivariate_normal(simulated[1], covariance(kind, simulated[1], parameters, 1)).logpdf(gap[1])
        for part in (slice(0, 100), slice(130, N)):
            matrix = covariance(kind, simulated[0, part], parameters, 0)
            expected += stats.multivariate_normal(simulated[0, part], matrix).logpdf(gap[0, part])
    assert likelihood([1.2, *parameters]) == pytest.approx(expected, rel=1e-10)
    terms = likelihood.noise.log_densities(simulated - gap, simulated, parameters)
    assert terms.sum() == pytest.approx(expected, rel=1e-10) and (terms[0, 100:130] == 0.0).all()
    # every second sample of the second channel, padded with NaN
    own = values.copy()
    own[1, N // 2 :] = np.nan
    own[1, : N // 2] = values[1, ::2]
    other = FELikelihood(MODEL, Measurements(CHANNELS, (DT, 2.0 * DT), own), NOISES[kind])
    matrices = [
        covariance(kind, simulated[0], parameters, 0),
        covariance(kind, simulated[1, ::2], parameters, 1, 2 * DT),
    ]
    expected = sum(
        stats.multivariate_normal(each, matrix).logpdf(data)
        for each, matrix, data in zip(
            (simulated[0], simulated[1, ::2]), matrices, (own[0], values[1, ::2]), strict=True
        )
    )
    assert other([1.2, *parameters]) == pytest.approx(expected, rel=1e-10)


@EVERY
def test_caches_pools_pickles_and_joint_likelihoods(kind, rng, tmp_path):
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    parameters, points = PARAMETERS[kind], rng.uniform(0.8, 1.2, 6)
    rows = np.column_stack([points, np.tile(parameters, (6, 1))])
    likelihood = likelihood_of(kind, values, cache=tmp_path / "cache")
    expected = likelihood(rows)
    again = likelihood_of(kind, values, cache=SimulationCache(tmp_path / "cache"))
    np.testing.assert_array_equal(again(rows), expected)
    assert again.simulations == 0 and again.simulator.disk_hits == 6
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(likelihood))(rows), expected)
    white = again.with_noise(GaussianNoise(CHANNELS))
    assert white.fingerprint != likelihood.fingerprint and white.density_parts() != likelihood.density_parts()
    joint = JointLikelihood({"one": likelihood, "two": again}, separate=likelihood.noise.parameter_names)
    point = np.concatenate([[1.1], parameters, parameters])
    assert joint(point) == pytest.approx(2.0 * likelihood([1.1, *parameters]), rel=1e-12)


def test_guides_take_levels_in_si_units_and_refuse_shares(rng):
    values = response([1.0]) + rng.standard_normal((2, N)) * [[0.1], [0.001]]
    priors = {"factor": TruncatedNormal(1.0, 0.3)}

    def posterior_of(kind):
        likelihood = likelihood_of(kind, values)
        return Posterior(likelihood, priors | {name: HalfNormal(1.0) for name in likelihood.noise.parameter_names})

    mode = find_modes(posterior_of("levels in bands"), 4, seed=1).modes[0]
    assert mode.parameters[0] == pytest.approx(1.0, abs=0.1)
    for kind in ("modulated", "shares in bands"):
        with pytest.raises(ValueError, match="depends on the response.*without a guide"):
            ResponseTarget(posterior_of(kind))


def test_measurements_that_do_not_fit_are_refused():
    options, data = {"level": "response", "sensor": SENSOR}, measured(response([1.0]))
    with pytest.raises(ValueError, match="at least three steps"):
        FELikelihood(MODEL, data, GaussianNoise(CHANNELS, window=0.05, **options))
    with pytest.raises(ValueError, match="below 25 Hz"):
        FELikelihood(MODEL, data, GaussianNoise(CHANNELS, groups=(2.0, 25.0), **options))
    gaps = response([1.0])
    gaps[0, ::7] = np.nan
    with pytest.raises(ValueError, match=r"divide channel 'top' into 35 stretches.*AutoregressiveNoise"):
        likelihood_of("levels in bands", gaps)
    for noise in NOISES.values():
        with pytest.raises(ValueError, match="needs the times of the samples"):
            noise.log_likelihood(np.zeros((1, 30)), N, np.ones((1, len(noise.parameter_names))))
    fitted = likelihood_of("modulated", response([1.0])).noise
    with pytest.raises(ValueError, match=r"is for \[240, 240\] samples"):
        fitted.log_likelihood(np.zeros((1, len(fitted.statistic(gaps, gaps)))), 100, np.ones((1, 2)))


@pytest.mark.parametrize("kind", ["modulated", "shares in bands"])
def test_events_have_levels_of_their_own_response(kind, rng):
    """Two events with a pause, of which the second is ten times weaker: the shares are those of both."""
    time = DT * np.arange(400)
    strong = Record("EQ1", DT, np.exp(-(((time - 4.0) / 1.5) ** 2)) * rng.standard_normal(400))
    events = Events([strong, strong.scale(0.1)], rest=4.0, names=["EQ1", "EQ2"])
    model = LinearOscillator(events)
    simulated, sensor = model.simulate([1.0, 1.0]), {"acceleration": 1e-3, "displacement": 1e-6}
    noise = {
        "modulated": GaussianNoise(model.channels, level="response", window=WINDOW, sensor=sensor),
        "shares in bands": GaussianNoise(model.channels, groups=(5.0,), level="response", sensor=sensor),
    }[kind]
    parameters = np.array([0.2, 0.3] if kind == "modulated" else [0.2, 0.3, 0.4, 0.2])
    single = {}
    for window in events.windows:
        part = simulated[:, window.samples]
        own = noise.with_measurements(Measurements(model.channels, DT, part))
        single[window.name] = Measurements(model.channels, DT, part + draw(own, parameters, part, rng))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # the pause is no gap
        likelihood = FELikelihood(model, single, noise)
    if kind == "modulated":  # in the likelihood and in a prediction of both, the level of each event is its own
        both = likelihood.noise.response_deviations(parameters, simulated, DT)
        for window in events.windows:
            part = simulated[:, window.samples]
            own = noise.with_measurements(Measurements(model.channels, DT, part))
            alone = own.response_deviations(parameters, part)
            # apart from the parts of the window at both ends, which contain samples of the pause
            np.testing.assert_allclose(both[:, window.samples][:, 30:-30], alone[:, 30:-30], rtol=0.02)
        assert likelihood.noise.under(LinearOscillator(strong)).of_parts == ()
    if kind == "shares in bands":  # each event is a stretch, and its density that of its own
        expected = 0.0
        for window in events.windows:
            part = simulated[:, window.samples]
            own = noise.with_measurements(single[window.name])
            expected += own.log_densities(part - single[window.name].values, part, parameters).sum()
        assert likelihood([1.0, 1.0, *parameters]) == pytest.approx(expected, rel=1e-10)


def test_a_gap_makes_the_share_that_of_another_level_and_is_named(rng):
    """The share of the whole response is too large beside a gap in the strong part; that of the envelope is not."""
    motion = response([1.0])
    strong = slice(*np.searchsorted(np.cumsum(motion[0] ** 2) / np.sum(motion[0] ** 2), [0.2, 0.8]))
    shares = np.linspace(0.02, 1.0, 400)

    def found(local, gap):
        noise = GaussianNoise(CHANNELS, level="response", window=WINDOW, sensor=SENSOR, local=local)
        values = motion.copy()
        exact = noise.with_measurements(Measurements(CHANNELS, DT, values))
        values += exact.response_deviations(np.array([0.2, 0.2]), motion) * rng.standard_normal(motion.shape)
        if gap:
            values[0, strong] = np.nan
        likelihood = FELikelihood(MODEL, Measurements(CHANNELS, DT, values), noise)
        assert [each.kind for each in check_gaps(likelihood.noise)] == ["Gaps in the data"] * (gap and local == 0.0)
        grid = np.column_stack([np.ones(400), shares, np.full(400, 0.2)])
        return shares[np.argmax(likelihood(grid))]

    whole = [found(0.0, False) for _ in range(20)]
    nearby = [found(1.0, True) for _ in range(20)]
    beside = [found(0.0, True) for _ in range(20)]

    def differs(sample):
        return abs(np.mean(sample) - 0.2) / (np.std(sample, ddof=1) / np.sqrt(20))

    assert differs(whole) < 4.0 and differs(nearby) < 4.0
    assert differs(beside) > 4.0 and np.mean(beside) > 0.2
