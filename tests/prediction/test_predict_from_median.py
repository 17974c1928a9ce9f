"""Prediction by the middle of the population: closed form, coverage where errors are correlated; a control."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    EventRatios,
    FELikelihood,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Measurements,
    Prior,
    StoredPosterior,
    Varying,
    event_ratio,
    exceedance,
    peak,
    predict_from_median,
    predict_new_event,
    rms,
)
from tests.prediction.test_new_event import MEDIAN, SHAPE, SPREAD, TOP, Amplified

NOISE = GaussianNoise([TOP])
VARYING = {"gain": Varying(LogNormal(MEDIAN, 0.5), HalfNormal(0.3))}
LOGS = np.array([0.1, -0.2, 0.15, 0.3])  # of measured peaks over those at the median of the population
LARGEST = np.abs(SHAPE).max()


def likelihoods(peaks):
    """Events of increasing strength, with these measured peaks."""
    found = {}
    for k, value in enumerate(peaks):
        model = Amplified(1.0 + 0.3 * k)
        found[f"EQ{k}"] = FELikelihood(model, Measurements([TOP], model.dt, [value / LARGEST * SHAPE]), NOISE)
    return found


def population(names, rng):
    """A population of median 0.03 and spread 0.25; its tests have no influence on it."""
    prior = Prior({"gain": LogNormal(MEDIAN, 1.0)})
    tests = {name: StoredPosterior({"gain": MEDIAN * np.exp(0.3 * rng.standard_normal(200))}, prior) for name in names}
    posterior = HierarchicalPosterior(tests, VARYING)
    known = np.array([MEDIAN, SPREAD]) * np.exp(1e-6 * rng.standard_normal((50, 2)))
    return Hierarchy(posterior, known)


@pytest.fixture
def events(rng):
    measured = LARGEST * MEDIAN * (1.0 + 0.3 * np.arange(4)) * np.exp(LOGS)
    found = likelihoods(measured)
    return population(found, rng), found


def test_the_peak_has_the_t_distribution_of_the_ratios_at_the_median(events):
    hierarchy, posteriors = events
    options = {"quantity": peak("top"), "n": 20_000, "seed": 1}
    found = predict_from_median(hierarchy, posteriors, Amplified(), 2.0, **options)
    expected = stats.t(3, np.log(2.0 * MEDIAN * LARGEST) + LOGS.mean(), LOGS.std(ddof=1) * np.sqrt(1.25))
    assert stats.kstest(np.log(found.values), expected.cdf).pvalue > 1e-3
    assert found.noise and found.n_samples == 20_000
    assert "20000 samples, of measured values, by the ratios of 4 events;" in str(found)
    assert "with measurement noise" not in str(found)
    limit = np.exp(expected.ppf(0.9))
    exceeded = exceedance(found, limit)
    assert float(exceeded.probability) == pytest.approx(0.1, abs=1e-4)
    assert exceeded.lower < 0.05 and exceeded.upper > 0.2  # four events tell little about it
    again = predict_from_median(hierarchy, posteriors, Amplified(), 2.0, **options)
    np.testing.assert_array_equal(again.values, found.values)
    options["quantity"] = [peak("top"), rms("top")]
    both = predict_from_median(hierarchy, posteriors, Amplified(), 2.0, **options)
    assert both.values.shape == (20_000, 2)


def test_the_median_of_a_population_is_that_of_its_log_centers(events):
    hierarchy, _ = events
    expected = np.exp(np.log(hierarchy.samples[:, 0]).mean())
    assert hierarchy.median_test() == {"gain": pytest.approx(expected, rel=1e-12)}


@pytest.mark.slow
@pytest.mark.parametrize("correlation", (0.0, -0.8))
@pytest.mark.parametrize("n_events", (5, 10))
def test_intervals_cover_new_events_whose_ratio_goes_with_their_parameters(n_events, correlation, rng):
    sets, new = 200, 20
    hierarchy = population([f"EQ{k}" for k in range(n_events)], rng)
    scales = 1.0 + 0.3 * np.arange(n_events)
    mixing = np.array([[SPREAD, 0.0], [0.1 * correlation, 0.1 * np.sqrt(1.0 - correlation**2)]])
    together, apart = np.empty((2, sets, new))
    for row in range(sets):
        gains, ratios = np.exp(mixing @ rng.standard_normal((2, n_events + new)))
        peaks = MEDIAN * LARGEST * gains * ratios
        posteriors = likelihoods(scales * peaks[:n_events])
        options = {"quantity": peak("top"), "n": 400, "seed": row}
        found = predict_from_median(hierarchy, posteriors, Amplified(), 1.0, **options)
        together[row] = np.searchsorted(np.sort(found.values), peaks[n_events:]) / 400.0
        if row < 40:  # control: the true population, and ratios that are independent of the parameters
            known = EventRatios(ratios[:n_events])
            found = predict_new_event(hierarchy, Amplified(), 1.0, ratios=known, **options)
            apart[row] = np.searchsorted(np.sort(found.values), peaks[n_events:]) / 400.0
    for level in (0.5, 0.9):
        assert abs((np.abs(together - 0.5) <= 0.5 * level).mean() - level) < 0.03
    inside = (np.abs(apart[:40] - 0.5) <= 0.25).mean()
    assert inside > 0.6 if correlation else inside < 0.58


@pytest.mark.parametrize("scatter, lowest", ((0.3, 0.88), (0.6, 0.86)))
@pytest.mark.parametrize("correlation", (0.0, -0.8))
@pytest.mark.parametrize("n_events", (5, 10))
def test_intervals_are_nearly_right_where_sensitivities_differ(n_events, correlation, scatter, lowest):
    """Three parameters, whose derivatives of the log peak scatter between events; closed form of the prediction."""
    rng = np.random.default_rng(1)
    sd, slope = np.array([0.05, 0.4, 0.15]), np.array([1.0, -0.3, 0.5])
    direction = slope * sd / np.linalg.norm(slope * sd)
    pit = np.empty(4000)
    for row in range(len(pit)):
        slopes = slope * (1.0 + scatter * rng.standard_normal((n_events + 1, 3)))
        z = rng.standard_normal((n_events + 1, 3))
        independent = rng.standard_normal(n_events + 1)
        log_ratios = 0.1 * (correlation * z @ direction + np.sqrt(1.0 - correlation**2) * independent)
        fitted = sd * z[:-1] + 0.05 * rng.standard_normal((n_events, 3))
        logs = log_ratios + ((sd * z - fitted.mean(axis=0)) * slopes).sum(axis=1)
        ratios = EventRatios(np.exp(logs[:-1]))
        t = (logs[-1] - np.log(ratios.median)) / ratios.scale
        pit[row] = stats.t.cdf(t, ratios.degrees_of_freedom)
    assert abs((np.abs(pit - 0.5) < 0.25).mean() - 0.5) < 0.03
    assert lowest < (np.abs(pit - 0.5) < 0.45).mean() < 0.9


def test_what_has_no_median_is_refused(events):
    hierarchy, posteriors = events
    options = {"quantity": peak("top")}
    with pytest.raises(ValueError, match="posteriors of 'EQ0', 'EQ1' are missing"):
        predict_from_median(hierarchy, {k: posteriors[k] for k in ("EQ2", "EQ3")}, Amplified(), 1.0, **options)
    with pytest.raises(ValueError, match="needs numbers"):
        predict_from_median(hierarchy, posteriors, Amplified(), 1.0, quantity=None)
    other = Amplified()
    other.parameter_names = ["stiffness"]
    with pytest.raises(ValueError, match="stiffness belong"):
        predict_from_median(hierarchy, posteriors, other, 1.0, **options)
    one = population(["EQ0"], np.random.default_rng(1))
    with pytest.raises(ValueError, match="one event does not show"):
        predict_from_median(one, posteriors, Amplified(), 1.0, **options)
    guess = predict_from_median(one, posteriors, Amplified(), 1.0, prior_sd=0.2, prior_events=3.0, **options)
    at_median = event_ratio(posteriors["EQ0"], [[MEDIAN]], peak("top"))
    assert np.median(guess.values) == pytest.approx(MEDIAN * LARGEST * at_median, rel=0.05)
