"""Value of information: closed forms of two options with normal losses, sensors, and controls that tell nothing."""

import numpy as np
import pytest
from scipy.stats import norm

from fe_likelihoods import rank_sensors, value_of_information
from fe_likelihoods.information.value import simulate_summary
from tests.information.test_sensors import LINEAR, NOISE, PRIOR

SEEDS = 40
GRADIENT, MEAN = np.array([1.0, 0.6, 0.3]), 0.4
PRECISION = np.array([[2.0, 0.5, 0.0], [0.5, 0.5, 0.0], [0.0, 0.0, 0.0]])  # tells nothing of the third parameter


def worth(variance, mean=MEAN):
    """Value of information that explains this variance of a normal loss difference: sd times the unit normal loss."""
    sd = np.sqrt(variance)
    return sd * (norm.pdf(mean / sd) - mean / sd * norm.sf(mean / sd))


def explained(precision, gradient=GRADIENT):
    return gradient @ (np.eye(3) - np.linalg.inv(np.eye(3) + precision)) @ gradient


@pytest.fixture(scope="module")
def runs():
    """Results for two options with normal losses; the losses of the options do not have their mean in common."""
    found = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        x, common = rng.standard_normal((1000, 3)), rng.standard_normal(1000)
        data = simulate_summary(x, PRECISION, seed)
        learned = {"x": x[:, 0], "data": data, "again": np.hstack([data, data]), "all": x}
        learned["noise"] = rng.standard_normal((1000, 2))
        learned["with noise"] = np.hstack([data, learned["noise"]])
        found.append(value_of_information({"leave": MEAN + x @ GRADIENT + common, "act": common}, learned))
    return found


def within(values, errors, exact, scatter=(0.7, 1.4)):
    """Mean within four standard errors of the exact value, and stated errors as large as the scatter."""
    values, errors = np.array(values), np.array(errors)
    stated = np.sqrt(np.mean(np.square(errors)))
    assert abs(values.mean() - exact) < 4.0 * values.std() / np.sqrt(SEEDS)
    assert scatter[0] < stated / values.std() < scatter[1]


def test_two_normal_options_have_the_closed_form(runs):
    whole = worth(GRADIENT @ GRADIENT)
    within([run.perfect for run in runs], [run.perfect_error for run in runs], whole)
    for name, exact in {"x": worth(1.0), "data": worth(explained(PRECISION)), "all": whole}.items():
        k = runs[0].learned.index(name)
        within([run.value[k] for run in runs], [run.value_error[k] for run in runs], exact)
    assert worth(1.0) < 0.8 * whole and worth(explained(PRECISION)) < 0.75 * whole  # the cases differ
    assert all(run.best == "act" for run in runs)
    within([run.lead for run in runs], [run.lead_error for run in runs], MEAN)
    assert all(np.all(run.value <= run.perfect + 1e-12) for run in runs)


def test_what_tells_nothing_is_worth_nothing(runs):
    """Noise, data that are repeated, and noise beside data."""
    values = np.array([run.value for run in runs])
    noise, data, again, both = (
        values[:, runs[0].learned.index(name)] for name in ("noise", "data", "again", "with noise")
    )
    assert abs(noise.mean()) < 4.0 * noise.std() / np.sqrt(SEEDS) and noise.std() < 0.1 * data.std()
    np.testing.assert_allclose(again, data, atol=1e-12)
    difference = both - data
    assert abs(difference.mean()) < 4.0 * difference.std() / np.sqrt(SEEDS)
    # control: the maximum over means that are fitted to all draws finds a value in noise
    rng = np.random.default_rng(1)
    loss, x = rng.standard_normal(1000), rng.standard_normal((1000, 30))
    loss -= loss.mean()
    fitted = x @ np.linalg.lstsq(x, loss, rcond=None)[0]
    naive = -np.minimum(fitted, 0.0).mean()
    honest = value_of_information({"a": loss, "b": np.zeros(1000)}, {"noise": x})
    assert naive > 0.05 and abs(honest.value[0]) < 4.0 * max(honest.value_error[0], 1e-3)


def test_a_curved_loss_and_three_options():
    """The value of one parameter, by quadrature: losses that a line does not describe."""
    grid = np.linspace(-8.0, 8.0, 20_001)
    weight = norm.pdf(grid) * (grid[1] - grid[0])
    exact = {"a": 0.0 * grid, "b": grid**2 - 1.2, "c": 1.0 - np.cos(grid) + 0.1 * grid}
    means = {name: loss @ weight for name, loss in exact.items()}
    value = min(means.values()) - np.min(list(exact.values()), axis=0) @ weight
    estimates, errors = [], []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        x = rng.standard_normal(2000)
        other = rng.standard_normal((3, 2000))  # not learned
        losses = {"a": other[0], "b": x**2 - 1.2 + other[1], "c": 1.0 - np.cos(x) + 0.1 * x + other[2]}
        found = value_of_information(losses, {"x": x})
        estimates.append(found.value[0])
        errors.append(found.value_error[0])
    within(estimates, errors, value)


def test_sensors_of_a_linear_model_have_the_closed_form():
    """From the ranking to the value: a useful sensor, one of another parameter, and one that repeats the first."""
    ranking = rank_sensors(LINEAR, PRIOR, noise=NOISE, draws=2)
    gradient = np.array([0.3, 0.0, 0.4])
    coords = PRIOR.to_normal(PRIOR.rvs(40_000, random_state=1))
    losses = {"leave": 0.2 + coords @ gradient, "act": np.zeros(len(coords))}
    precisions = ranking.precisions | {"a and again": ranking.precisions["a"] + ranking.precisions["again"]}
    learned = {name: simulate_summary(coords, precision, 2) for name, precision in precisions.items()}
    found = value_of_information(losses, learned)
    for name, value, error in zip(found.learned, found.value, found.value_error, strict=True):
        exact = worth(explained(precisions[name], gradient), 0.2) if name != "b" else 0.0
        assert abs(value - exact) < 4.0 * max(error, 1e-4), name
    assert found.value[found.learned.index("ac")] > 2.0 * found.value[found.learned.index("a")] > 0.01
    assert "Without more information the best option is 'act'" in str(found) and "of perfect information" in str(found)


def test_a_sensor_without_response_has_no_data():
    coords = np.random.default_rng(1).standard_normal((100, 2))
    assert simulate_summary(coords, np.zeros((2, 2))).shape == (100, 0)
    found = value_of_information({"a": coords[:, 0], "b": coords[:, 1]}, {"nothing": np.empty((100, 0))})
    assert found.value[0] == found.value_error[0] == 0.0 and found.perfect > 0.0


def test_errors_of_data_are_independent_of_draws_with_the_same_seed():
    coords = np.random.default_rng(3).standard_normal((20_000, 2))
    errors = simulate_summary(coords, np.diag([4.0, 1.0]), 3) - coords[:, ::-1]
    cross = np.corrcoef(np.hstack([coords, errors]), rowvar=False)[:2, 2:]
    assert np.abs(cross).max() < 4.0 / np.sqrt(20_000)
    np.testing.assert_allclose(errors.std(axis=0), [1.0, 0.5], rtol=4.0 / np.sqrt(40_000))


@pytest.mark.parametrize(
    ("losses", "learned", "message"),
    [
        ({"a": np.zeros(60)}, None, "two options or more"),
        ({"a": np.zeros(20), "b": np.zeros(20)}, None, "50 draws or more"),
        ({"a": np.zeros(60), "b": np.full(60, np.nan)}, None, "b: expected finite values"),
        ({"a": np.zeros(60), "b": np.zeros(60)}, {"x": np.zeros(59)}, "one row per draw"),
    ],
)
def test_impossible_arguments_are_refused(losses, learned, message):
    with pytest.raises(ValueError, match=message):
        value_of_information(losses, learned)


def test_impossible_precisions_are_refused():
    for matrix, message in (
        (np.eye(3), "of the same d"),
        (np.diag([1.0, -1.0]), "positive semi-definite"),
        (np.array([[1.0, 2.0], [0.0, 1.0]]), "symmetric"),
    ):
        with pytest.raises(ValueError, match=message):
            simulate_summary(np.zeros((5, 2)), matrix)
