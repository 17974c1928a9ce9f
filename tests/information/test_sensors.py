"""Expected information of sensors: closed forms of linear models, repeated sensors, targets, and the column."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from fe_likelihoods import (
    Channel,
    FunctionModel,
    LinearOscillator,
    LogNormal,
    Prior,
    SimulationFailed,
    TruncatedNormal,
    peak,
    problems,
    rank_sensors,
)
from fe_likelihoods.information.sensors import slopes_at

TIME = np.linspace(0.0, 1.0, 40)
SHAPES = np.stack([np.sin(5.0 * TIME), np.cos(3.0 * TIME), np.ones(40)])
MIXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.3, 0.0], [0.5, 0.0, 0.5], [1.0, 0.0, 0.0]])  # the last repeats the first
NAMES = ("a", "b", "ac", "again")
SDS = np.array([2.0, 0.5, 1.0])
NOISE = dict(zip(NAMES, [0.5, 0.2, 0.4, 0.5], strict=True))
PRIOR = Prior({name: norm(0.5, sd) for name, sd in zip("xyz", SDS, strict=True)})
CHANNELS = tuple(Channel(name, "displacement", "mm") for name in NAMES)
LINEAR = FunctionModel(lambda theta: MIXES @ (theta[:, None] * SHAPES), ("x", "y", "z"), CHANNELS, 0.02, 40)


def products(name):
    jacobian = MIXES[NAMES.index(name)][:, None] * SHAPES * SDS[:, None]
    return jacobian @ jacobian.T / NOISE[name] ** 2


def closed_form(*names):
    """Information and posterior covariance of the coordinates."""
    precision = np.eye(3) + sum(products(name) for name in names)
    return 0.5 * np.linalg.slogdet(precision)[1], np.linalg.inv(precision)


def test_a_linear_model_has_the_closed_form():
    ranking = rank_sensors(LINEAR, PRIOR, noise=NOISE, draws=3, n_sensors=4)
    np.testing.assert_allclose(ranking.alone, [closed_form(name)[0] for name in NAMES], rtol=1e-6)
    for k in range(4):
        information, covariance = closed_form(*ranking.chosen[: k + 1])
        np.testing.assert_allclose(ranking.information[k], information, rtol=1e-6)
        np.testing.assert_allclose(
            [shares[k] for shares in ranking.left.values()], np.sqrt(np.diag(covariance)), rtol=1e-6
        )
    best_of_rest = sorted(closed_form(name)[0] for name in NAMES)[-2:]
    np.testing.assert_allclose(ranking.lead[0], best_of_rest[1] - best_of_rest[0], rtol=1e-6)
    assert np.isnan(ranking.lead[-1]) and ranking.counts == {"draws": 3, "failed": 0, "simulations": 12}
    assert np.abs(ranking.errors["information"]).max() < 1e-6  # derivatives are the same at all draws
    assert "4 of 4 sensors, from derivatives at 3 draws (12 simulations)" in str(ranking)


def test_a_sensor_that_repeats_another_is_worth_what_its_noise_averages():
    """Two sensors with the same response are one sensor with half the noise variance."""
    both = rank_sensors(LINEAR, PRIOR, ["again"], noise=NOISE, draws=2, installed=["a"])
    averaged = rank_sensors(LINEAR, PRIOR, ["a"], noise=NOISE | {"a": 0.5 / np.sqrt(2.0)}, draws=2)
    np.testing.assert_allclose(closed_form("a")[0] + both.gains[0], averaged.alone[0], rtol=1e-6)
    assert rank_sensors(LINEAR, PRIOR, noise=NOISE, draws=2, n_sensors=4).chosen[-1] in ("a", "again")


def test_variance_of_a_target_has_the_closed_form():
    """The target prefers a sensor that the information puts last."""
    ranking = rank_sensors(LINEAR, PRIOR, noise=NOISE, draws=3, target=lambda response: response[1].mean())
    gradient = 0.3 * SDS[1] * SHAPES[1].mean() * np.eye(3)[1]
    for k in range(4):
        left = gradient @ closed_form(*ranking.chosen[: k + 1])[1] @ gradient
        np.testing.assert_allclose(ranking.target_left[k], left / (gradient @ gradient), rtol=1e-6)
    assert ranking.chosen[0] == "b"
    assert rank_sensors(LINEAR, PRIOR, noise=NOISE, draws=2, n_sensors=1).chosen != ("b",)


def test_samples_are_what_is_known():
    """A second test of the same sensors adds less, and as much as the closed form says."""
    covariance = closed_form("a", "b")[1]
    draws = 0.5 + SDS * np.random.default_rng(1).multivariate_normal(np.zeros(3), covariance, 20_000)
    ranking = rank_sensors(LINEAR, PRIOR, noise=NOISE, samples=draws, draws=4)
    after = [closed_form("a", "b", name)[0] - closed_form("a", "b")[0] for name in NAMES]
    np.testing.assert_allclose(ranking.alone, after, rtol=0.05)
    prior = Prior(PRIOR.distributions | {"sigma": LogNormal(1.0, 0.1)})
    whole = np.column_stack([draws, np.ones(len(draws))])
    np.testing.assert_array_equal(rank_sensors(LINEAR, prior, noise=NOISE, samples=whole, draws=4).alone, ranking.alone)


def test_correlated_samples_and_shares_of_the_response():
    few = rank_sensors(LINEAR, PRIOR, ["a"], noise=NOISE, draws=2, effective_samples=10.0)
    wide = rank_sensors(LINEAR, PRIOR, ["a"], noise=NOISE | {"a": 1.0}, draws=2)
    np.testing.assert_allclose(few.alone, wide.alone, rtol=1e-6)  # 10 of 40 samples: twice the noise
    share = rank_sensors(LINEAR, PRIOR, ["a"], noise=0.1, draws=50)
    rms = np.sqrt((0.5**2 + SDS[0] ** 2) * np.mean(SHAPES[0] ** 2))
    stated = rank_sensors(LINEAR, PRIOR, ["a"], noise=NOISE | {"a": 0.1 * rms}, draws=2)
    ratios = [np.sqrt(np.trace(each.precisions["a"])) for each in (stated, share)]  # of one over the noise
    assert abs(ratios[0] / ratios[1] - 1.0) < 4.0 / np.sqrt(100)


def test_standard_errors_cover_another_set_of_draws():
    """Of a model whose derivatives vary, with failures left out."""

    def respond(theta):
        if theta[0] > 2.5:
            raise SimulationFailed("too large")
        return np.stack([np.exp(0.5 * theta[0]) * SHAPES[0], theta[0] ** 2 * SHAPES[1]])

    model = FunctionModel(respond, ("x",), CHANNELS[:2], 0.02, 40)
    prior = {"x": norm(1.0, 1.0)}
    noise = {"a": 0.1, "b": 0.1}
    first, second = (rank_sensors(model, prior, noise=noise, draws=200, seed=seed) for seed in (1, 2))
    error = np.hypot(first.errors["alone"], second.errors["alone"])
    assert (np.abs(first.alone - second.alone) < 4.0 * error).all() and (error > 0.01).all()
    assert 0 < first.counts["failed"] < 40 and f"{first.counts['failed']} more were left out" in str(first)


def test_derivatives_of_the_model_replace_differences():
    """Of an oscillator with bounded and correlated parameters: the slopes equal fine differences."""
    motion = problems.table_motion().trim(0.0, 4.0).resample(0.02)
    model = LinearOscillator(motion, 0.5)
    without = FunctionModel(model.simulate, model.parameter_names, model.channels, model.dt, model.n_steps)
    design, target = model.with_record(motion.scale(2.0)), peak("displacement")
    prior = Prior({("stiffness", "damping"): multivariate_normal([1.0, 1.0], [[0.04, 0.03], [0.03, 0.09]])})
    bounded = Prior({"stiffness": TruncatedNormal(1.0, 0.2), "damping": TruncatedNormal(1.0, 0.3)})
    for known in (prior, bounded):
        coords = 0.5 * np.random.default_rng(1).standard_normal((4, 2))
        fine = slopes_at(without, known, coords, np.full((4, 2), 1e-5), lambda response: response[0, 50])
        own = slopes_at(model, known, coords, np.full((4, 2), 1e-5), lambda response: response[0, 50])
        for one, other in zip(own, fine, strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=2e-4 * np.abs(other).max())
    exact, rough = (
        rank_sensors(each, bounded, target=target, target_model=design, draws=10, step=0.01)
        for each in (model, without)
    )
    assert exact.chosen == rough.chosen and (exact.counts["simulations"], rough.counts["simulations"]) == (40, 50)
    np.testing.assert_allclose(exact.target_left, rough.target_left, rtol=0.03)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"candidates": ["q"]}, "unknown channels q; the channels of the model are a, b, ac, again"),
        ({"candidates": ["a", "a"]}, "candidates must be different channels"),
        ({"noise": {"a": 0.1}}, "noise must be a positive number for every channel; give one for b, ac, again"),
        ({"noise": {"q": 0.1}}, "noise has the unknown channels q"),
        ({"noise": 0.0}, "noise must be a positive number"),
        ({"draws": 1}, "draws at least 2"),
        ({"target": "a"}, "target must be one number of the response"),
        ({"target": lambda response: response[0]}, "target must be one number of the response"),
        ({"target": lambda response: 1.0}, "a target that depends on the parameters"),
        ({"samples": np.ones((5, 3))}, "at least 30 samples, for 3 parameters"),
        ({"samples": np.ones((50, 3))}, "samples that do not differ"),
    ],
)
def test_errors_say_what_to_do(arguments, message):
    with pytest.raises(ValueError, match=message):
        rank_sensors(LINEAR, PRIOR, **{"noise": NOISE, "draws": 2} | arguments)


@pytest.mark.parametrize("arguments", [{"noise": -0.1}, {"effective_samples": 0.0}, {"effective_samples": {"q": 3.0}}])
def test_levels_and_numbers_of_samples_are_checked_before_a_simulation(arguments):
    def response(theta):
        raise AssertionError("simulated")

    model = FunctionModel(response, LINEAR.parameter_names, LINEAR.channels, LINEAR.dt, LINEAR.n_steps)
    with pytest.raises(ValueError, match=next(iter(arguments))):
        rank_sensors(model, PRIOR, **{"noise": NOISE} | arguments)
