"""Annual rates and losses: the closed form of a power law, quadrature, and a structure whose fragility is known."""

import numpy as np
import pytest
from scipy import integrate, special

from fe_likelihoods import EventRatios, annual_risk, fragility, peak
from fe_likelihoods.prediction.annual_risk import annual_rate
from fe_likelihoods.prediction.fragility import Fragility
from fe_likelihoods.prediction.fragility_curve import FragilityCurve
from tests.prediction.flexible import DISPERSION, MEDIAN, Flexible

INTENSITY, RATE = np.array([0.3, 1.0, 3.0, 9.0]), np.array([0.2, 0.03, 2e-3, 3e-5])  # assumed; steeper to the right


def power_law(k0, k, median, dispersion):
    return k0 * median**-k * np.exp(0.5 * (k * dispersion) ** 2)


@pytest.mark.parametrize("k", [0.5, 2.5, 12.0])
def test_a_power_law_has_the_closed_form(k):
    """Also with points between and far from the capacity."""
    median, dispersion = np.array([0.4, 3.0, 80.0]), np.array([0.2, 0.5, 0.9])
    exact = power_law(1e-3, k, median, dispersion)
    for points in ([1.0, 2.0], [1e-3, 0.5, 0.6, 7.0, 1e4], [50.0, 60.0]):
        s = np.array(points)
        np.testing.assert_allclose(annual_rate(s, 1e-3 * s**-k, median, dispersion), exact, rtol=1e-11)
    without = power_law(1e-3, k, median, 0.0 * dispersion)  # control
    assert np.all(exact > without * 1.004)


@pytest.mark.parametrize("median", [0.2, 2.0, 30.0])
def test_other_hazard_curves_agree_with_quadrature(median):
    slopes = -np.diff(np.log(RATE)) / np.diff(np.log(INTENSITY))

    def density(t):
        k = min(max(np.searchsorted(INTENSITY, np.exp(t)) - 1, 0), 2)
        at = RATE[k] * (np.exp(t) / INTENSITY[k]) ** -slopes[k]
        return special.ndtr((t - np.log(median)) / 0.4) * at * slopes[k]

    def exact(low, high):
        edges = np.log([low, *INTENSITY[(INTENSITY > low) & (INTENSITY < high)], high])
        return sum(
            integrate.quad(density, *ends, epsabs=0.0, epsrel=1e-10, limit=200)[0]
            for ends in zip(edges[:-1], edges[1:], strict=True)
        )

    far = median * np.exp(-4.0), median * np.exp(8.0)  # ten and twenty dispersions
    np.testing.assert_allclose(annual_rate(INTENSITY, RATE, median, 0.4), exact(*far), rtol=1e-8)
    for low, high in ((0.1, 2.0), (1.0, 3.0), (2.0, 40.0)):
        np.testing.assert_allclose(annual_rate(INTENSITY, RATE, median, 0.4, low, high), exact(low, high), rtol=1e-8)


def test_losses_are_those_of_the_states():
    """Of a state an event counts only if it is in no severer one; without draws there are no errors."""
    curves = {"slight": FragilityCurve(1.0, 0.4), "severe": FragilityCurve(3.0, 0.4)}
    risk = annual_risk(curves, INTENSITY, RATE, {"slight": 2.0, "severe": 50.0})
    slight, severe = annual_rate(INTENSITY, RATE, [1.0, 3.0], 0.4)
    assert risk.loss == pytest.approx(2.0 * (slight - severe) + 50.0 * severe, rel=1e-12)
    np.testing.assert_allclose(risk.probability, 1.0 - np.exp(-risk.rate), rtol=1e-12)
    assert np.isinf(risk.standard_error).all() and np.isnan(risk.lower).all() and np.isnan(risk.loss_upper)
    alone = annual_risk(curves["severe"], INTENSITY, RATE)
    assert alone.states == ("exceedance",) and alone.rate[0] == severe and np.isnan(alone.loss)
    assert "Expected loss" not in str(alone) and "Expected loss per year: " in str(risk)


def known(record, rng, **options):
    samples = rng.normal(0.0, DISPERSION, size=(800, 1))
    records = [record.scale(MEDIAN * k) for k in (0.3, 0.5, 0.7, 0.9, 1.2, 1.6, 2.2)]
    settings = dict(unit="cm", seed=1, progress=False, noise=False) | options
    model = Flexible(record)
    return {name: fragility(model, samples, records, peak("displacement"), limit, **settings) for name, limit in STATES}


STATES = (("cracked", 6.0), ("yielded", 10.0))
K0, K = 2e-3, 2.3  # assumed
HAZARD = np.array([0.05, 20.0]), K0 * np.array([0.05, 20.0]) ** -K


def test_a_known_structure_has_its_rate_within_its_error(record, rng):
    states = known(record, rng)
    risk = annual_risk(states, *HAZARD, {"cracked": 1.0, "yielded": 8.0})
    exact = power_law(K0, K, MEDIAN * np.array([0.6, 1.0]), DISPERSION)
    assert np.all(np.abs(risk.rate - exact) < 4.0 * risk.standard_error)
    # the error of a mean of lognormal draws: the fit is nearly as good as the sample mean of H(capacity)
    single = exact * np.sqrt(np.expm1((K * DISPERSION) ** 2) / 800)
    assert np.all((risk.standard_error > 0.5 * single) & (risk.standard_error < 1.3 * single))
    loss = exact @ [1.0, 7.0]
    assert abs(risk.loss - loss) < 4.0 * risk.loss_error and risk.loss_lower < risk.loss < risk.loss_upper
    # the states have the same samples, so that their errors add
    assert risk.loss_error > 0.9 * (risk.standard_error @ [1.0, 7.0])
    assert risk.uncertainty == "the Monte Carlo error only"
    curve = states["yielded"].curve
    within = annual_rate(*HAZARD, *curve[:2], 0.3 * MEDIAN, 2.2 * MEDIAN)
    assert risk.outside[1] == pytest.approx(1.0 - within / risk.rate[1]) and 0.05 < risk.outside[1] < 0.2
    assert states["yielded"].of_samples.shape == (800, 7) and set(states["yielded"].of_samples.flat) == {0.0, 1.0}
    np.testing.assert_allclose(states["yielded"].of_samples.mean(axis=0), states["yielded"].probability)
    wrong = power_law(K0, K, MEDIAN, 0.0)  # control: the median structure
    assert abs(risk.rate[1] - wrong) > 4.0 * risk.standard_error[1]
    fewer = annual_risk({"yielded": known(record, rng, effective_sample_size=200)["yielded"]}, *HAZARD)
    assert fewer.standard_error[0] == pytest.approx(2.0 * risk.standard_error[1], rel=0.4)


def test_what_is_unknown_of_the_ratios_widens_the_interval(record, rng):
    """With a known spread of ratios the rate has the larger dispersion; the mean of the ratios is unknown."""
    ratios = EventRatios([1.0, 1.0], prior_sd=0.3, prior_events=1e8)
    risk = annual_risk(known(record, rng, ratios=ratios), *HAZARD)
    spread = np.sqrt(DISPERSION**2 + 0.3**2 + 0.3**2 / 2.0)
    exact = power_law(K0, K, MEDIAN * np.array([0.6, 1.0]), spread)
    assert np.all(np.abs(risk.rate / exact - 1.0) < 4.0 * risk.standard_error / exact + 0.02)  # curve: nearly lognormal
    assert np.all(risk.upper - risk.lower > 10.0 * risk.standard_error) and "ratios" in risk.uncertainty
    # draws: capacity and mean of the ratios unknown, the spread between events known
    logs = np.log(risk.draws[:, 1])
    assert logs.std() == pytest.approx(K * np.sqrt(DISPERSION**2 + 0.3**2 / 2.0), rel=4.0 / np.sqrt(2 * len(logs)))


def test_a_rate_beyond_the_hazard_curve_is_extrapolated(record, rng):
    found, table = known(record, rng)["yielded"], np.array([0.8, 1.1]) * MEDIAN
    short, whole = annual_risk(found, table, K0 * table**-K), annual_risk(found, *HAZARD)
    assert short.rate == pytest.approx(whole.rate, rel=1e-12)
    inside = annual_rate(*HAZARD, *found.curve[:2], *table)
    assert short.outside[0] == pytest.approx(1.0 - inside / short.rate[0]) and short.outside[0] > 0.5
    assert f"{short.outside[0]:.0%}" in str(short)
    assert "in the unit of the fragilities?" in str(short) and "CAUTION" not in str(whole)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((1.0, 2.0), (0.1, 0.2)), "decreasing positive annual rates"),
        (((2.0, 1.0), (0.2, 0.1)), "increasing positive intensities"),
        (((1.0,), (0.2,)), "two or more intensities"),
        ((INTENSITY, RATE, {"b": 1.0}), "a loss for each state, a, b"),
        ((INTENSITY, RATE, {"a": np.nan, "b": 1.0}), "losses that are finite"),
        ((INTENSITY, RATE, {"a": -1.0, "b": 1.0}), "not negative"),
        ((INTENSITY, RATE, {"a": 2.0, "b": 1.0}), "not smaller in severer states"),
    ],
)
def test_impossible_arguments_are_refused(arguments, message):
    curves = {"a": FragilityCurve(1.0, 0.4), "b": FragilityCurve(2.0, 0.4)}
    with pytest.raises(ValueError, match=message):
        annual_risk(curves, *arguments)


def test_states_have_an_order_and_curves():
    curves = {"a": FragilityCurve(2.0, 0.4), "b": FragilityCurve(1.0, 0.4)}
    with pytest.raises(ValueError, match="from slight to severe"):
        annual_risk(curves, INTENSITY, RATE)
    empty = np.empty(0)
    none = Fragility((), *[empty] * 7, None, 1.0)
    with pytest.raises(ValueError, match="determine no fragility curve"):
        annual_risk({"a": none}, INTENSITY, RATE)
