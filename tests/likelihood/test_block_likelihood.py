"""Log-likelihood in blocks of time: the blocks add up to the whole, and each is the density of its samples."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    AutoregressiveNoise,
    Channel,
    Events,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    Record,
    SimulationFailed,
    TruncatedNormal,
    Uniform,
)
from fe_likelihoods.likelihood.predictive_draws import choose_blocks

DT, N = 0.1, 120
TIME = DT * np.arange(N)
CHANNELS = (Channel("top", "displacement", "mm"), Channel("base", "acceleration", "g"))


def respond(theta):
    return np.stack([theta[0] * np.sin(TIME), theta[1] * np.cos(1.7 * TIME)])


def measure(rng, missing=False, start=0.0, step=DT):
    times = start + step * np.arange(int(round((TIME[-1] - start) / step)) + 1)
    values = np.stack([np.sin(times), np.cos(1.7 * times)]) + rng.normal(0.0, 0.2, (2, len(times)))
    if missing:
        values[0, 10:25], values[1, :3] = np.nan, np.nan
    return Measurements(CHANNELS, step, values, start=start)


def model():
    return FunctionModel(respond, ["a", "b"], CHANNELS, DT, N)


STRUCTURAL = np.array([[1.0, 1.0], [0.9, 1.1], [1.2, 0.7]])
TWO = np.array([[0.2, 0.2], [0.15, 0.25], [0.4, 0.1]])
NOISES = {
    "white": (GaussianNoise(CHANNELS), TWO),
    "sensor": (GaussianNoise(CHANNELS, sensor=[0.1, 0.05]), TWO),
    "effective": (GaussianNoise(CHANNELS, effective_samples=[30.0, 500.0]), TWO),
    "shared": (GaussianNoise(CHANNELS, groups="all", scales=[1.0, 2.0]), TWO[:, :1]),
    "relative": (GaussianNoise(CHANNELS, level="measured", scales=[1.0, 2.0], effective_samples=[30.0, 500.0]), TWO),
    "autoregressive": (AutoregressiveNoise(CHANNELS), np.hstack([TWO, [[0.3, -0.2], [0.0, 0.8], [0.5, 0.5]]])),
}


@pytest.mark.parametrize("name", NOISES)
@pytest.mark.parametrize("data", [{}, {"missing": True}, {"step": 0.15, "start": 0.3}], ids=["all", "gaps", "times"])
def test_the_blocks_add_up_to_the_log_likelihood(name, data, rng):
    noise, parameters = NOISES[name]
    posterior = posterior_of(FELikelihood(model(), measure(rng, **data), noise))
    rows = np.hstack([STRUCTURAL, parameters])
    for seconds in (None, 0.35, 3.0, 100.0):
        blocks = posterior.predictive_draws(rows, seconds).blocks
        assert blocks.values.shape == (3, len(blocks.starts))
        assert np.allclose(blocks.values.sum(axis=1), posterior.log_likelihood(rows), rtol=1e-10)
    assert len(posterior.predictive_draws(rows, 3.0).blocks.starts) == 4
    assert len(blocks.starts) == 1


def posterior_of(likelihood):
    names = likelihood.parameter_names
    return Posterior(likelihood, {name: Uniform(-1.0, 5.0) for name in names})


def test_a_block_of_white_noise_is_the_density_of_its_samples(rng):
    measured = measure(rng, missing=True)
    posterior = posterior_of(FELikelihood(model(), measured))
    rows = np.hstack([STRUCTURAL, TWO])
    blocks = posterior.predictive_draws(rows, 2.0).blocks
    for k, (start, stop) in enumerate(zip(blocks.starts, blocks.stops, strict=True)):
        inside = (TIME > start - 1e-9) & (TIME < stop - 1e-9)
        for row, found in zip(rows, blocks.values[:, k], strict=True):
            density = stats.norm.logpdf(measured.values, respond(row[:2]), row[2:, None])[:, inside]
            assert found == pytest.approx(np.nansum(density), rel=1e-10)


def test_a_block_of_autoregressive_noise_is_conditional_on_those_before(rng):
    measured, (noise, parameters) = measure(rng), NOISES["autoregressive"]
    posterior = posterior_of(FELikelihood(model(), measured, noise))
    blocks = posterior.predictive_draws(np.hstack([STRUCTURAL, parameters]), 4.0).blocks
    ends = np.round(blocks.stops / DT).astype(int)
    for row, found in zip(np.hstack([STRUCTURAL, parameters]), blocks.values, strict=True):
        upto = np.zeros(len(ends))
        for channel in range(2):
            errors, sigma, rho = (measured.values - respond(row[:2]))[channel], row[2 + channel], row[4 + channel]
            covariance = sigma**2 * rho ** np.abs(np.subtract.outer(np.arange(N), np.arange(N))).astype(float)
            for k, end in enumerate(ends):
                upto[k] += stats.multivariate_normal(np.zeros(end), covariance[:end, :end]).logpdf(errors[:end])
        assert np.allclose(found, np.diff(upto, prepend=0.0), rtol=1e-8)


def test_noise_that_was_integrated_out_is_drawn(rng):
    likelihood = FELikelihood(model(), measure(rng))
    prior = {"a": TruncatedNormal(1.0, 0.3), "b": TruncatedNormal(1.0, 0.3)}
    full = Posterior(likelihood, prior | {"sigma_top": HalfNormal(1.0), "sigma_base": HalfNormal(1.0)})
    drawn = full.marginal().predictive_draws(np.repeat(STRUCTURAL[:1], 2000, axis=0), 3.0).blocks.values
    sigma = np.stack(list(full.marginal().draw_noise(np.repeat(STRUCTURAL[:1], 2000, axis=0), 5).values()), axis=1)
    expected = full.predictive_draws(sigma, 3.0).blocks.values
    error = np.hypot(drawn.std(axis=0), expected.std(axis=0)) / np.sqrt(2000)
    assert np.all(np.abs(drawn.mean(axis=0) - expected.mean(axis=0)) < 4.0 * error)


def test_levels_per_event_and_joint_likelihoods(rng):
    record = Record("quake", DT, rng.normal(size=50))
    events = Events([record, record], rest=2.0)

    long = FunctionModel(lambda theta, record: theta[0] * record.acceleration[None], ["a"], CHANNELS[1:], record=events)
    data = {
        name: Measurements(CHANNELS[1:], DT, record.acceleration[None] + rng.normal(0, 0.1, (1, 50)))
        for name in events.names
    }
    likelihood = FELikelihood(long, data, GaussianNoise(long.channels, groups="event"))
    rows = np.array([[1.0, 0.1, 0.2], [1.1, 0.15, 0.1]])
    blocks = posterior_of(likelihood).predictive_draws(rows, 1.0).blocks
    assert np.allclose(blocks.values.sum(axis=1), likelihood.log_likelihood(rows), rtol=1e-10)
    assert len(blocks.starts) < round(events.duration)  # the pause has no samples and is no observation

    joint = JointLikelihood({"events": likelihood, "other": FELikelihood(model(), measure(rng))}, separate=["a"])
    posterior = posterior_of(joint)
    point = dict.fromkeys(posterior.parameter_names, 0.9)
    row = np.array([[point[name] for name in posterior.parameter_names]])
    draws = posterior.predictive_draws(row, 1.0)
    assert draws.blocks.values.sum() == pytest.approx(float(posterior.log_likelihood(row)[0]), rel=1e-10)
    assert set(draws.blocks.parts) == {"events", "other"}
    assert set(draws.replicates) == {"events_base", "other_top", "other_base"}
    assert [each.name for each in posterior.measured_data().channels] == list(draws.replicates)


def test_replicates_have_the_noise_of_the_sample(rng):
    posterior = posterior_of(FELikelihood(model(), measure(rng, missing=True)))
    rows = np.repeat([[1.0, 1.0, 0.5, 0.1]], 400, axis=0)
    draws = posterior.predictive_draws(rows, seed=3)
    for channel, sigma in (("top", 0.5), ("base", 0.1)):
        there = ~np.isnan(posterior.likelihood.measurements.channel(channel))
        place = ["top", "base"].index(channel)
        assert np.allclose(draws.responses[channel], respond([1.0, 1.0])[place, there])
        errors = draws.replicates[channel] - draws.responses[channel]
        assert errors.std() == pytest.approx(sigma, rel=4.0 / np.sqrt(2.0 * errors.size))
    again = posterior.predictive_draws(rows, seed=3).replicates["top"]
    assert np.array_equal(again, draws.replicates["top"])


def test_blocks_are_as_long_as_errors_are_correlated(rng):
    measured = Measurements(CHANNELS[:1], DT, np.zeros((1, 4000)))
    errors = rng.standard_normal((1, 4000))
    slow = np.convolve(errors[0], np.ones(40) / np.sqrt(40.0), "same")[None]
    lengths = [np.max(np.subtract(*choose_blocks(measured, measured.values, each)[::-1])) for each in (errors, slow)]
    assert lengths[0] == pytest.approx(4.0)  # a hundredth of the measurements
    assert 5.0 * 20.0 * DT < lengths[1] < 5.0 * 40.0 * DT  # of a triangular correlation of 40 samples


def test_what_is_refused(rng):
    posterior = posterior_of(FELikelihood(model(), measure(rng)))
    rows = np.hstack([STRUCTURAL, TWO])
    with pytest.raises(ValueError, match="length of a block"):
        posterior.predictive_draws(rows, -1.0)
    with pytest.raises(ValueError, match="a, b, sigma_top, sigma_base"):
        posterior.predictive_draws(rows[:, :2])

    def failing(theta):
        raise SimulationFailed("it does not converge")

    broken = FELikelihood(FunctionModel(failing, ["a", "b"], CHANNELS, DT, N), measure(rng))
    with pytest.raises(SimulationFailed, match="3 of 3 samples .* does not converge"):
        posterior_of(broken).predictive_draws(rows)
