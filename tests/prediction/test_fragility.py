"""Fragility: a structure whose capacity is known, failed simulations, and points that determine no curve."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import BridgeDeck, EventRatios, IsolatedBridge, LinearStructure, Record, exceedance, propagate
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.prediction.fragility import fragility, peak_ground_acceleration
from fe_likelihoods.prediction.fragility_curve import fit_fragility
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.simulation.model import SimulationFailed
from fe_likelihoods.units import G0
from tests.prediction.flexible import DISPERSION, MEDIAN, Flexible


def test_a_known_fragility_is_found(record, rng):
    samples = rng.normal(0.0, DISPERSION, size=(800, 1))
    records = [record.scale(a * G0) for a in (0.15, 0.25, 0.35, 0.45, 0.6, 0.9)]
    settings = dict(unit="cm", seed=1, progress=False)
    result = fragility(Flexible(record), samples, records, peak("displacement"), 10.0, **settings)
    assert np.allclose(result.intensity, np.array([0.15, 0.25, 0.35, 0.45, 0.6, 0.9]) * G0)
    exact = stats.norm.cdf(np.log(result.intensity / MEDIAN) / DISPERSION)
    assert np.all(np.abs(result.probability - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / 800))
    curve = result.curve
    assert abs(curve.median - MEDIAN) < 4.0 * curve.median_error < 0.1 * MEDIAN
    assert abs(curve.dispersion - DISPERSION) < 4.0 * curve.dispersion_error < 0.3 * DISPERSION
    # All records share the samples, so that the error is that of the median of 800 lognormal draws.
    assert curve.median_error == pytest.approx(MEDIAN * DISPERSION / np.sqrt(800), rel=0.6)
    assert curve.probability(MEDIAN) == pytest.approx(0.5, abs=0.08)
    fewer = fragility(
        Flexible(record), samples, records, peak("displacement"), 10.0, effective_sample_size=200, **settings
    )
    assert fewer.curve.median_error == pytest.approx(2.0 * curve.median_error, rel=0.4)
    other = fragility(
        Flexible(record),
        samples,
        records,
        peak("displacement"),
        10.0,
        intensity=lambda r: np.std(r.acceleration),
        **settings,
    )
    scale = np.std(record.acceleration)
    assert other.curve.median == pytest.approx(scale * curve.median)


def test_a_curve_from_too_few_exceedances_has_an_infinite_error(record, rng):
    """One exceedance among 60 samples determines the slope, and a third of the resamplings do not contain it."""
    samples = np.linspace(-0.2, 0.2, 60)[:, None]
    records = [record.scale(MEDIAN * np.exp(-0.197)), record.scale(MEDIAN * np.exp(0.1))]
    curve = fragility(Flexible(record), samples, records, peak("displacement"), 0.1, progress=False).curve
    assert curve.median > 0.0 and np.isinf(curve.median_error) and np.isinf(curve.dispersion_error)


@pytest.mark.parametrize("ratios", [None, EventRatios([0.9, 1.0, 1.2])])
def test_collapse_is_an_exceedance_and_no_failure(record, rng, ratios):
    """Structures that collapse beyond 15 cm exceed 10 cm, also where all collapse; other failures are left out."""
    samples = rng.normal(0.0, DISPERSION, size=(300, 1))
    records = [record.scale(a * G0) for a in (0.3, 0.4, 0.6)]
    arguments = dict(quantity=peak("displacement"), threshold=0.1, ratios=ratios, noise=False, seed=1, progress=False)
    model = Flexible(record, limit=0.15, reason="collapse: the limit was exceeded")
    found = fragility(model, samples, records, **arguments)
    whole = fragility(Flexible(record), samples, records, **arguments)
    left_out = fragility(Flexible(record, limit=0.15), samples, records, **arguments)
    if ratios is None:
        np.testing.assert_array_equal(found.probability, whole.probability)
    assert left_out.probability[-1] < found.probability[-1] - 0.04
    assert found.n_collapsed[-1] > 100 and np.array_equal(found.n_collapsed, left_out.n_failed)
    assert not found.n_failed.any() and not left_out.n_collapsed.any()
    with pytest.raises(SimulationFailed, match="record 'motion': nothing to predict"):
        fragility(Flexible(record, limit=1e-6), samples, records, **arguments)
    assert "collapsed" in str(found)
    always = fragility(Flexible(record, 1e-6, "collapse"), samples, records, **arguments)
    assert always.probability.tolist() == [1.0] * 3 and always.n_collapsed.tolist() == [300] * 3
    prediction = propagate(model, samples, quantity=peak("displacement"), record=records[-1], progress=False)
    assert len(prediction.collapsed) == prediction.n_failed == found.n_collapsed[-1]
    assert f"the structure collapsed in {found.n_collapsed[-1]}" in str(prediction)
    alone = exceedance(prediction, 0.1, ratios=ratios, noise=False, seed=1)
    assert alone.probability == pytest.approx(found.probability[-1], abs=1e-12)
    assert alone.lower < alone.probability < alone.upper and alone.effective_sample_size == pytest.approx(300.0)
    assert f"{found.n_collapsed[-1]} of 300 structures collapsed" in str(alone)
    survivors = exceedance(prediction.values, 0.1, ratios=ratios, noise=False, seed=1)
    assert survivors.probability < alone.probability - 0.1


def test_excitations_of_several_components(record, monkeypatch):
    """Horizontal and vertical motion of a bridge; motions of the supports of a structure."""
    short = record.trim(0.0, 0.5).scale(0.2)
    vertical = Record("up", short.dt, 3.0 * short.acceleration)
    pairs = [(short.scale(k), vertical) for k in (0.5, 1.0)]
    bridge = IsolatedBridge(short, vertical=vertical)
    samples = np.ones((2, len(bridge.parameter_names)))
    arguments = peak(bridge.channels[0].name), 1e-9
    response = np.ones((len(bridge.channels), bridge.n_steps))
    monkeypatch.setattr(IsolatedBridge, "simulate", lambda self, theta: response * self.vertical.acceleration.max())
    found = fragility(bridge, samples, pairs, *arguments, from_state="virgin", progress=False)
    peaks = [np.abs(horizontal.acceleration).max() for horizontal, _ in pairs]
    assert found.names == (f"{short.name}, up",) * 2 and found.intensity.tolist() == peaks
    up = fragility(
        bridge,
        samples,
        pairs,
        *arguments,
        from_state="virgin",
        progress=False,
        intensity=lambda pair: peak_ground_acceleration(pair[1]),
    )
    assert up.intensity.tolist() == [np.abs(vertical.acceleration).max()] * 2
    deck = LinearStructure(BridgeDeck("ch7"), [short] * 3)
    supports = [[each.scale(k) for each in deck.supports] for k in (1.0, 2.0)]
    samples = np.array([[3.7, 0.09, 0.8]] * 2)
    found = fragility(deck, samples, supports, peak(deck.channels[0].name), 1e-9, progress=False)
    assert found.names[0] == ", ".join([short.name] * 3) and found.intensity[1] == 2.0 * found.intensity[0]


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
        ([1, 12, 2], "0 <= exceedances <= trials"),
        ([1, 2], "shapes"),
    ],
)
def test_points_that_do_not_determine_a_curve_are_refused(k, message):
    with pytest.raises(ValueError, match=message):
        fit_fragility([0.1, 0.2, 0.4], k, [9, 9, 9])


def test_refused_before_any_simulation(record, monkeypatch):
    model, samples = LinearOscillator(record), np.ones((5, 2))
    monkeypatch.setattr(LinearOscillator, "simulate", lambda self, theta: pytest.fail("no simulation may run"))

    def refused(message, quantity=peak("displacement"), threshold=0.1, records=(record,), samples=samples, **settings):
        with pytest.raises(ValueError, match=message):
            fragility(model, samples, records, quantity, threshold, progress=False, **settings)

    refused("expected a unit of displacement", unit="g")
    refused("one threshold; got an array", threshold=[0.1, 0.2])
    refused("one number as quantity", quantity="displacement")
    refused("one number as quantity", quantity=[peak("displacement"), peak("acceleration")])
    refused("no channel 'force'", quantity=peak("force"))
    refused("needs one record or more", records=[])
    refused("expected a Record as excitation", records=[record, 3.0])
    refused("must be positive and finite", records=[record, record.scale(0.0)])
    refused("2 parameters", samples=np.ones((5, 3)))
    refused("first is sample 0", samples=np.full((5, 2), np.nan))
    refused("sets record itself", record=record)
    refused("effective_sample_size", effective_sample_size=-1)
    refused("level", level=2.0)
