"""Exceedance and fragility: closed forms, intervals, and a structure whose capacity is known."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.plots.predictions import plot_fragility
from fe_likelihoods.prediction.fragility import fit_fragility, fragility
from fe_likelihoods.prediction.propagation import propagate
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.prediction.reliability import exceedance
from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.signals.records import Record
from fe_likelihoods.simulation.model import SimulationFailed
from fe_likelihoods.units import G0

MEDIAN, DISPERSION = 0.4 * G0, 0.35


class Flexible:
    """Displacement = flexibility times base acceleration: exceeds a limit where the flexibility does, lognormal."""

    parameter_names = ("log_flexibility",)
    channels = (Channel("displacement", "relative displacement", "cm"),)
    fingerprint = "flexible"

    def __init__(self, record, collapse=np.inf):
        self.record, self.collapse = record, collapse
        self.dt, self.n_steps = record.dt, record.n_steps

    def with_record(self, record):
        if not isinstance(record, Record):
            raise ValueError(f"expected a Record; got {type(record).__name__}")
        return type(self)(record, self.collapse)

    def simulate(self, theta):
        displacement = 0.1 / MEDIAN * np.exp(theta[0]) * self.record.acceleration
        if np.abs(displacement).max() > self.collapse:
            raise SimulationFailed("collapse")
        return displacement[None]


@pytest.fixture
def record(rng):
    samples = rng.normal(size=50)
    return Record("motion", 0.02, samples / np.abs(samples).max())


def test_exceedance_of_a_gaussian(rng):
    values = rng.normal(size=4000)
    limits = np.array([-1.0, 0.0, 1.5, 2.5])
    result = exceedance(values, limits)
    exact = stats.norm.sf(limits)
    assert np.all(np.abs(result.probability - exact) < 4.0 * np.sqrt(exact * (1.0 - exact) / 4000))
    assert np.all((result.lower < result.probability) & (result.probability < result.upper))
    # the interval is the classical one where counts are whole
    k = int(round(result.probability[2] * 4000))
    interval = stats.binomtest(k, 4000).proportion_ci(0.95, method="exact")
    assert np.allclose((result.lower[2], result.upper[2]), interval, rtol=1e-6)
    quarter = exceedance(values, limits, effective_sample_size=1000)
    assert np.allclose(quarter.standard_error, 2.0 * result.standard_error)
    assert np.all(quarter.upper - quarter.lower > 1.5 * (result.upper - result.lower))


def test_none_and_all_still_have_a_bound():
    none = exceedance(np.zeros(100), 1.0)
    assert none.probability == 0.0 and none.lower == 0.0
    assert none.upper == pytest.approx(1.0 - 0.025 ** (1 / 100))
    everything = exceedance(np.zeros(100), -1.0)
    assert everything.upper == 1.0 and everything.lower == pytest.approx(0.025 ** (1 / 100))
    assert exceedance(np.zeros(10), 0.0).probability == 0.0  # as large is not larger


def test_intervals_cover(rng):
    """Of many runs of 60 samples, at least 95 % of the intervals hold the true probability."""
    p = stats.norm.sf(1.3)
    runs = exceedance(rng.normal(size=(60, 2000)), 1.3)
    inside = np.mean((runs.lower <= p) & (p <= runs.upper))
    assert inside > 0.95 - 4.0 * np.sqrt(0.95 * 0.05 / 2000)


def test_units_and_shapes_of_thresholds(record, rng):
    samples = rng.normal(0.0, DISPERSION, size=(200, 1))
    model = Flexible(record.scale(MEDIAN))
    p = propagate(model, samples, quantity=peak("displacement"), progress=False)
    assert np.array_equal(exceedance(p, 10.0, unit="cm").probability, exceedance(p, 0.1).probability)
    assert exceedance(p, [[0.05, 0.1], [0.15, 0.2]]).probability.shape == (2, 2)
    with pytest.raises(ValueError, match="expected a unit of displacement, got 'kN'"):
        exceedance(p, 10.0, unit="kN")
    with pytest.raises(ValueError, match="unknown unit"):
        exceedance(p, 10.0, unit="furlong")
    with pytest.raises(ValueError, match="finite"):
        exceedance(p, np.nan)
    with pytest.raises(ValueError, match="must be numbers"):
        exceedance(p, "10 cm")
    with pytest.raises(ValueError, match=r"shape \(3,\); got shape \(2,\)"):
        exceedance(np.zeros((50, 3)), [1.0, 2.0])
    assert exceedance(np.zeros((50, 3)), [1.0, -1.0, 2.0]).probability.tolist() == [0.0, 1.0, 0.0]
    with pytest.raises(ValueError, match="quantity, such as peak"):
        exceedance(propagate(model, samples, progress=False), 0.1)
    with pytest.raises(ValueError, match="values must be finite"):
        exceedance([1.0, np.nan], 0.1)
    with pytest.raises(ValueError, match="level"):
        exceedance(p, 0.1, level=95)


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
    # the samples are shared by all records: the error of the median is that of the median of 800 lognormal draws
    assert curve.median_error == pytest.approx(MEDIAN * DISPERSION / np.sqrt(800), rel=0.6)
    assert curve.probability(MEDIAN) == pytest.approx(0.5, abs=0.08)
    figure = plot_fragility(result)
    assert figure.axes[0].get_xlabel() == "peak ground acceleration [g]" and len(figure.axes[0].lines) == 2
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


def test_a_curve_from_too_little_has_no_error(record, rng):
    """One exceedance among 60 samples holds the slope: a third of the resamplings lose it."""
    samples = np.linspace(-0.2, 0.2, 60)[:, None]
    records = [record.scale(MEDIAN * np.exp(-0.197)), record.scale(MEDIAN * np.exp(0.1))]
    curve = fragility(Flexible(record), samples, records, peak("displacement"), 0.1, progress=False).curve
    assert curve.median > 0.0 and np.isinf(curve.median_error) and np.isinf(curve.dispersion_error)


def test_collapse_may_count(record, rng):
    """A simulation that fails beyond the limit hides exceedances, unless it counts as one."""
    samples = rng.normal(0.0, DISPERSION, size=(300, 1))
    records = [record.scale(a * G0) for a in (0.3, 0.4, 0.6)]
    model = Flexible(record, collapse=0.15)
    arguments = (samples, records, peak("displacement"), 0.1)
    whole = fragility(Flexible(record), *arguments, progress=False)
    counted = fragility(model, *arguments, progress=False, failures_exceed=True)
    assert np.allclose(counted.probability, whole.probability)
    left_out = fragility(model, *arguments, progress=False)
    assert left_out.probability[-1] < whole.probability[-1] - 0.04
    assert np.array_equal(left_out.n_failed, counted.n_failed) and left_out.n_failed[-1] > 100
    with pytest.raises(SimulationFailed, match="record 'motion': nothing to predict"):
        fragility(Flexible(record, collapse=1e-6), *arguments, progress=False)
    assert fragility(Flexible(record, collapse=1e-6), *arguments, progress=False, failures_exceed=True).curve is None


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
def test_no_curve_where_the_points_give_none(k, message):
    with pytest.raises(ValueError, match=message):
        fit_fragility([0.1, 0.2, 0.4], k, [9, 9, 9])


def test_refused_before_any_simulation(record, monkeypatch):
    model, samples = LinearOscillator(record), np.ones((5, 2))
    monkeypatch.setattr(LinearOscillator, "simulate", lambda self, theta: pytest.fail("nothing may be simulated"))

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
