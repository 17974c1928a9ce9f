"""Fragility: a structure whose capacity is known, failed simulations, and points that determine no curve."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import EventRatios, SimulationFailed, exceedance, fragility, peak, propagate
from fe_likelihoods.prediction.fragility import fit_fragility
from fe_likelihoods.units import G0
from tests.prediction.flexible import DISPERSION, MEDIAN, Flexible, strongest, under


def test_a_known_fragility_is_found(record, rng):
    samples = rng.normal(0.0, DISPERSION, size=(800, 1))
    records = [record.scale(a * G0) for a in (0.15, 0.25, 0.35, 0.45, 0.6, 0.9)]
    settings = dict(threshold=10.0, unit="cm", seed=1, noise=False)
    result = fragility(under(records, Flexible(record), samples), strongest(records), **settings)
    exact = stats.norm.cdf(np.log(result.intensity / MEDIAN) / DISPERSION)
    assert np.all(np.abs(result.exceedance.probability - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / 800))
    curve = result.curve
    assert abs(curve.median - MEDIAN) < 4.0 * curve.median_error < 0.1 * MEDIAN
    assert abs(curve.dispersion - DISPERSION) < 4.0 * curve.dispersion_error < 0.3 * DISPERSION
    # All records share the samples, so that the error is that of the median of 800 lognormal draws.
    assert curve.median_error == pytest.approx(MEDIAN * DISPERSION / np.sqrt(800), rel=0.6)
    assert curve.probability(MEDIAN) == pytest.approx(0.5, abs=0.08)
    fewer = under(records, Flexible(record), samples, effective_sample_size=200)
    few = fragility(fewer, strongest(records), **settings).curve
    assert few.median_error == pytest.approx(2.0 * curve.median_error, rel=0.4)
    other = fragility(fewer, np.array(strongest(records)) / 3.0, **settings)
    assert other.curve.median == pytest.approx(curve.median / 3.0)


def test_a_curve_from_too_few_exceedances_has_an_infinite_error(record):
    """One exceedance among 60 samples determines the slope, and a third of the resamplings do not contain it."""
    samples = np.linspace(-0.2, 0.2, 60)[:, None]
    records = [record.scale(MEDIAN * np.exp(-0.197)), record.scale(MEDIAN * np.exp(0.1))]
    curve = fragility(under(records, Flexible(record), samples), strongest(records), 0.1, noise=False).curve
    assert curve.median > 0.0 and np.isinf(curve.median_error) and np.isinf(curve.dispersion_error)


@pytest.mark.parametrize("ratios", [None, EventRatios([0.9, 1.0, 1.2])])
def test_collapse_is_an_exceedance_and_no_failure(record, rng, ratios):
    """Structures that collapse beyond 15 cm exceed 10 cm, also where all collapse; other failures are left out."""
    samples = rng.normal(0.0, DISPERSION, size=(300, 1))
    records = [record.scale(a * G0) for a in (0.3, 0.4, 0.6)]
    options = dict(ratios=ratios, noise=False, seed=1)

    def of(model):
        predictions = under(records, model, samples)
        return fragility(predictions, strongest(records), 0.1, **options), predictions[-1]

    model = Flexible(record, limit=0.15, reason="collapse: the limit was exceeded")
    (found, prediction), (whole, _), (left_out, _) = map(of, (model, Flexible(record), Flexible(record, limit=0.15)))
    if ratios is None:
        np.testing.assert_array_equal(found.exceedance.probability, whole.exceedance.probability)
    assert left_out.exceedance.probability[-1] < found.exceedance.probability[-1] - 0.04
    assert np.all(left_out.exceedance.lower < left_out.exceedance.probability)
    assert found.n_collapsed[-1] > 100 and np.array_equal(found.n_collapsed, left_out.n_failed)
    assert not found.n_failed.any() and not left_out.n_collapsed.any() and "collapsed" in str(found)
    with pytest.raises(SimulationFailed, match="nothing to predict"):
        under(records, Flexible(record, limit=1e-6), samples)
    with pytest.raises(SimulationFailed, match="nothing to predict"):  # a history has no value of a collapse
        propagate(Flexible(record, 1e-6, "collapse"), samples, progress=False)
    always, last = of(Flexible(record, 1e-6, "collapse"))
    assert always.exceedance.probability.tolist() == [1.0] * 3 and always.n_collapsed.tolist() == [300] * 3
    assert np.isnan(last.mean) and np.isnan(last.quantiles).all() and "collapsed in 300" in str(last)
    assert len(prediction.collapsed) == prediction.n_failed == found.n_collapsed[-1]
    assert f"the structure collapsed in {found.n_collapsed[-1]}" in str(prediction)
    alone = exceedance(prediction, 0.1, **options)
    assert alone.probability == found.exceedance.probability[-1] and alone.lower == found.exceedance.lower[-1]
    assert alone.lower < alone.probability < alone.upper and alone.effective_sample_size == pytest.approx(300.0)
    assert f"{found.n_collapsed[-1]} of 300 structures collapsed" in str(alone)
    survivors = exceedance(prediction.values, 0.1, **options)
    assert survivors.probability < alone.probability - 0.1


def test_fit_is_the_maximum_of_the_likelihood(rng):
    x, n = np.array([0.1, 0.2, 0.3, 0.5, 0.8]), np.full(5, 40.0)
    k = np.array([1.0, 9.0, 17.0, 31.0, 38.0])
    curve = fit_fragility(x, k, n)

    def log_likelihood(median, dispersion):
        return stats.binom.logpmf(k, n, stats.norm.cdf(np.log(x / median) / dispersion)).sum()

    best = log_likelihood(curve.median, curve.dispersion)
    for step in (0.99, 1.01):
        assert log_likelihood(step * curve.median, curve.dispersion) < best
        assert log_likelihood(curve.median, step * curve.dispersion) < best


@pytest.mark.parametrize(
    ("k", "message"),
    [
        ([0, 0, 0], "none of the trials exceed"),
        ([9, 9, 9], "all of the trials exceed"),
        ([0, 0, 9], "do not determine the slope"),
        ([0, 4, 9], "do not determine the slope"),
        ([8, 4, 1], "does not rise"),
        ([9, 9, 0], "does not rise"),
    ],
)
def test_points_that_do_not_determine_a_curve_are_refused(k, message):
    with pytest.raises(ValueError, match=message):
        fit_fragility(np.array([0.1, 0.2, 0.4]), np.array(k), np.full(3, 9))


def test_what_is_no_fragility_is_refused(record):
    records, samples = [record, record.scale(2.0)], np.zeros((5, 1))
    model = Flexible(record)
    peaks = under(records, model, samples)
    histories = [propagate(model, samples, record=each, progress=False) for each in records]
    two = under(records, model, samples, quantity=[peak("displacement")])
    other = [peaks[0], *under(records[1:], model, samples[:3])]
    mixed = [peaks[0], replace(peaks[1], noise=True)]
    for given, intensity, threshold, message, options in (
        (peaks, [1.0, 2.0], 0.1, "expected a unit of displacement", {"unit": "g"}),
        (peaks, [1.0, 2.0], [0.1, 0.2], "one threshold; got an array", {}),
        (histories, [1.0, 2.0], 0.1, "predictions of one number", {}),
        (two, [1.0, 2.0], 0.1, "predictions of one number", {}),
        ([], [], 0.1, "needs a prediction for each record", {}),
        (peaks, [0.0, 1.0], 0.1, "must be positive and finite", {}),
        (peaks, [1.0], 0.1, "one for each of 2 predictions", {}),
        (other, [1.0, 2.0], 0.1, "from the same samples", {}),
        (mixed, [1.0, 2.0], 0.1, "predictions of one kind", {}),
        (peaks, [1.0, 2.0], 0.1, "interval_probability", {"interval_probability": 2.0}),
        (peaks, [1.0, 2.0], 0.1, "ratios of one quantity", {"ratios": EventRatios([[1.0, 1.0]] * 2)}),
        (peaks, [1.0, 2.0], -0.1, "thresholds must be positive", {"ratios": EventRatios([1.0, 1.1])}),
    ):
        with pytest.raises(ValueError, match=message):
            fragility(given, intensity, threshold, **options)
