"""Replicated measurements: response plus a draw of the noise of each sample, for every noise and several data sets."""

import numpy as np
import pytest

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


def posterior_of(likelihood):
    names = likelihood.parameter_names
    return Posterior(likelihood, {name: Uniform(-1.0, 5.0) for name in names})


@pytest.mark.parametrize("data", [{}, {"missing": True}, {"step": 0.15, "start": 0.3}], ids=["all", "gaps", "times"])
@pytest.mark.parametrize(("options", "rho"), [({}, ()), ({"sensor": [0.3, 0.05]}, ()), (None, (0.5, -0.3))])
def test_replicates_have_the_noise_of_the_sample(options, rho, data, rng):
    noise = AutoregressiveNoise(CHANNELS) if options is None else GaussianNoise(CHANNELS, **options)
    posterior = posterior_of(FELikelihood(model(), measure(rng, **data), noise))
    rows = np.repeat([[1.0, 1.0, 0.4, 0.1, *rho]], 400, axis=0)
    draws = posterior.predictive_draws(rows, seed=3)
    floors = (options or {}).get("sensor", (0.0, 0.0))
    for place, history in enumerate(posterior.measured_data()):
        name, sigma = history.name, np.hypot(floors[place], rows[0, 2 + place])
        errors = draws[name] - _at(place, history.time)
        assert errors.std() == pytest.approx(sigma, rel=8.0 / np.sqrt(2.0 * errors.size))
        if rho and not data:
            found = np.mean(errors[:, 1:] * errors[:, :-1]) / sigma**2
            assert found == pytest.approx(rho[place], abs=8.0 / np.sqrt(errors.size))
    assert np.array_equal(posterior.predictive_draws(rows, seed=3)["top"], draws["top"])


def _at(place, times):
    """Response with unit parameters."""
    return np.sin(times) if place == 0 else np.cos(1.7 * times)


def test_noise_that_was_integrated_out_is_drawn(rng):
    likelihood = FELikelihood(model(), measure(rng))
    prior = {"a": TruncatedNormal(1.0, 0.3), "b": TruncatedNormal(1.0, 0.3)}
    full = Posterior(likelihood, prior | {"sigma_top": HalfNormal(1.0), "sigma_base": HalfNormal(1.0)}).marginal()
    points = np.ones((2000, 2))
    draws, sigma = full.predictive_draws(points), full.draw_noise(points, 5)["sigma_top"]
    drawn = (draws["top"] - _at(0, TIME)).std(axis=1)
    assert drawn.mean() == pytest.approx(sigma.mean(), rel=0.01)
    # the spread of the standard deviations, and of the estimate from 120 samples
    assert drawn.std() == pytest.approx(np.hypot(sigma.std(), sigma.mean() / np.sqrt(2 * N)), rel=0.15)


def test_levels_per_event_and_joint_likelihoods(rng):
    record = Record("quake", DT, rng.normal(size=50))
    events = Events([record, record], rest=2.0)
    long = FunctionModel(lambda theta, record: theta[0] * record.acceleration[None], ["a"], CHANNELS[1:], record=events)
    data = {
        name: Measurements(CHANNELS[1:], DT, record.acceleration[None] + rng.normal(0, 0.1, (1, 50)))
        for name in events.names
    }
    likelihood = FELikelihood(long, data, GaussianNoise(long.channels, groups="event"))
    joint = JointLikelihood({"events": likelihood, "other": FELikelihood(model(), measure(rng))}, separate=["a"])
    posterior = posterior_of(joint)
    levels = dict(zip(likelihood.noise.parameter_names, (0.1, 0.3), strict=True))
    point = dict.fromkeys(posterior.parameter_names, 0.9) | levels
    draws = posterior.predictive_draws(np.repeat([[point[n] for n in posterior.parameter_names]], 100, axis=0))
    assert (
        [each.name for each in posterior.measured_data()] == list(draws) == ["events_base", "other_top", "other_base"]
    )
    errors = draws["events_base"] - 0.9 * np.tile(record.acceleration, 2)
    assert [errors[:, :50].std(), errors[:, -50:].std()] == pytest.approx([0.1, 0.3], rel=0.05)


def test_what_is_refused(rng):
    posterior, rows = posterior_of(FELikelihood(model(), measure(rng))), np.full((3, 4), 0.5)
    with pytest.raises(ValueError, match="a, b, sigma_top, sigma_base"):
        posterior.predictive_draws(rows[:, :2])

    def failing(theta):
        raise SimulationFailed("it does not converge")

    broken = FELikelihood(FunctionModel(failing, ["a", "b"], CHANNELS, DT, N), measure(rng))
    with pytest.raises(SimulationFailed, match="3 of 3 samples .* does not converge"):
        posterior_of(broken).predictive_draws(rows)
