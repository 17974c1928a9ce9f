"""Slopes over a temperature or an amplitude: twins with known slopes, of populations, of new events and of losses."""

import warnings

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Measurements,
    ModalData,
    ModalLikelihood,
    Posterior,
    Prior,
    ShearFrame,
    StoredPosterior,
    TruncatedNormal,
    Varying,
    leave_one_out,
    peak,
    predict_new_event,
    stiffness_loss,
)

TOP = Channel("top", "displacement", "mm")
SHAPE = np.sin(0.1 * np.arange(100))
SLOPE = TruncatedNormal(0.0, 0.01, -np.inf, np.inf)  # of the logarithm, per degree
VARYING = {"gain": Varying(LogNormal(1.0, 0.2), HalfNormal(0.05), slopes={"temperature": SLOPE})}
ERROR = 0.02


class Gain(FunctionModel):
    """A response that is proportional to its parameter."""

    def __init__(self):
        super().__init__(lambda theta: [theta[0] * SHAPE], ["gain"], [TOP], 0.02, len(SHAPE))
        self.path_dependent = False

    def with_record(self, record):
        return self


def stored(log_gain, temperature, rng, n=300):
    """Posterior of an event whose logarithm was observed with an error of 2 %."""
    draws = log_gain + ERROR * (rng.standard_normal() + rng.standard_normal((n, 1)))
    return StoredPosterior(np.exp(draws), Prior({"gain": LogNormal(1.0, 3.0)}), covariates={"temperature": temperature})


def twin(seed, temperatures, slope=None):
    """Truth (median, spread, slope), drawn from the prior, and the log gains of events at these temperatures."""
    rng = np.random.default_rng(seed)
    median, spread = 0.2 * rng.standard_normal(), np.abs(0.05 * rng.standard_normal())
    slope = 0.01 * rng.standard_normal() if slope is None else slope
    apart = temperatures - np.mean(temperatures[:6])
    return (median, spread, slope), median + slope * apart + spread * rng.standard_normal(len(apart)), rng


def population(gains, temperatures, rng, varying=VARYING):
    """Posterior of the population, and samples of its hyper-parameters by weighted draws of the prior."""
    tests = {f"E{k}": stored(*each, rng) for k, each in enumerate(zip(gains, temperatures, strict=True))}
    posterior = HierarchicalPosterior(tests, varying)
    points = posterior.sample_prior(20_000, rng)
    weights = np.exp((logs := posterior.log_likelihood(points)) - logs.max())
    chosen = rng.choice(len(points), 300, p=weights / weights.sum())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Hierarchy(posterior, points[chosen])


@pytest.mark.slow
def test_slopes_of_fifty_twins_and_their_new_events_are_covered():
    """Six events of -5 to 30 °C, and a seventh at -20 °C; without the temperature (control) it is missed."""
    temperatures = np.array([-5.0, 2.0, 9.0, 16.0, 23.0, 30.0, -20.0])
    ranks, new, alone = [], [], []
    for seed in range(50):
        truth, gains, rng = twin(seed, temperatures)
        hierarchy = population(gains[:6], temperatures[:6], rng)
        assert hierarchy.posterior.parameter_names[-1] == "slope_temperature_gain"
        ranks.append((hierarchy.samples < [np.exp(truth[0]), *truth[1:]]).mean(axis=0))
        draws = hierarchy.new_test(1000, rng=rng, covariates={"temperature": -20.0})["gain"]
        new.append((draws < np.exp(gains[6])).mean())
        plain = {"gain": Varying(LogNormal(1.0, 0.2), HalfNormal(0.05))}
        without = population(gains[:6], temperatures[:6], rng, plain)
        alone.append((without.new_test(1000, rng=rng)["gain"] < np.exp(gains[6])).mean())
    for level, allowed in ((0.9, 6), (0.5, 12)):  # three standard errors
        inside = (np.abs(np.column_stack([ranks, new]) - 0.5) < 0.5 * level).sum(axis=0)
        assert (np.abs(inside - 50 * level) <= allowed).all()
    assert (np.abs(np.array(alone) - 0.5) < 0.45).sum() < 36


def events(slope, temperatures, seed=0):
    """Hierarchy and likelihoods of events whose gain has this slope."""
    _, gains, rng = twin(seed, temperatures, slope)
    hierarchy = population(gains, temperatures, rng)
    measured = {f"E{k}": Measurements([TOP], 0.02, [np.exp(gain) * SHAPE]) for k, gain in enumerate(gains)}
    prior = {"gain": LogNormal(1.0, 3.0), "sigma_top": HalfNormal(1.0)}
    return hierarchy, {
        k: Posterior(FELikelihood(Gain(), each, GaussianNoise([TOP])), prior) for k, each in measured.items()
    }


def test_numbers_of_a_new_event_follow_the_slope_and_widen_beyond_the_events():
    temperatures = np.array([-5.0, 2.0, 9.0, 16.0, 23.0, 30.0])
    hierarchy, posteriors = events(0.02, temperatures)
    options = {"quantity": peak("top"), "spread": {"gain": 0.04}, "n": 100, "seed": 1, "calibrated": ()}
    found = {
        t: predict_new_event(hierarchy, posteriors, 1.0, covariates={"temperature": t}, **options) for t in (12.5, 72.5)
    }
    near, far = (np.log(each.quantiles) for each in found.values())
    slopes = hierarchy.samples[:, 2]
    assert far[1] - near[1] == pytest.approx(60.0 * slopes.mean(), abs=0.02)
    widths = [found[t].ratios.new_sd for t in found]
    assert widths[1] ** 2 - widths[0] ** 2 == pytest.approx((60.0 * slopes.std()) ** 2, rel=0.02)
    assert far[2] - far[0] > 1.1 * (near[2] - near[0])
    default = predict_new_event(hierarchy, posteriors, 1.0, **options)
    np.testing.assert_allclose(default.quantiles, found[12.5].quantiles, rtol=1e-6)
    assert default.ratios.sd < 0.1  # each event beside its own median; they are 0.25 apart by their temperatures


@pytest.mark.slow
def test_each_event_is_predicted_at_its_own_temperature():
    hierarchy, posteriors = events(0.02, np.array([-5.0, 2.0, 9.0, 16.0, 23.0, 30.0]))
    scores = leave_one_out(hierarchy).scores(posteriors, quantity=peak("top"), spread={"gain": 0.04})
    measured = [float(each.scores.measured[0]) for each in scores.values()]
    medians = [float(each.prediction.quantiles[1]) for each in scores.values()]
    np.testing.assert_allclose(np.log(medians), np.log(measured), atol=0.2)  # 0.7 apart by their temperatures


def test_frequencies_of_days_with_other_temperatures_have_a_slope():
    """Eight days of a frame whose stiffness falls by 0.4 % per degree; without it the days differ by 5 %."""
    rng, degrees = np.random.default_rng(2), np.linspace(-10.0, 32.0, 8)
    frame, prior, tests = ShearFrame({"roof": 1}, [20e3], [30e6]), {"stiffness_1": LogNormal(1.0, 0.5)}, {}
    for k, truth in enumerate(np.exp(-0.004 * (degrees - degrees.mean()) + 0.01 * rng.standard_normal(8))):
        frequency = np.sqrt(truth * 30e6 / 20e3) / (2.0 * np.pi) * np.exp(0.005 * rng.standard_normal())
        data = ModalData([frequency], [[1.0]], ("roof",), frequency_cv=0.005, shape_error=0.02)
        posterior = Posterior(ModalLikelihood(frame, data), prior)
        apart = 0.05 * rng.standard_normal((400, 1))
        samples = truth * np.exp(apart)
        weights = posterior(samples) + 0.5 * np.square(apart[:, 0] / 0.05) + np.log(samples[:, 0])
        each = StoredPosterior(samples, posterior.prior, weights, covariates={"temperature": degrees[k]})
        tests[f"day {k}"] = each
    spreads = []
    for slopes in ({"temperature": SLOPE}, {}):
        varying = {"stiffness_1": Varying(LogNormal(1.0, 0.1), HalfNormal(0.05), slopes=slopes)}
        posterior = HierarchicalPosterior(tests, varying)
        points = posterior.sample_prior(20_000, 1)
        weights = np.exp((logs := posterior.log_likelihood(points)) - logs.max())
        means = weights @ points / weights.sum()
        spreads.append(means[1])
        if slopes:
            error = np.sqrt(weights @ np.square(points[:, 2] - means[2]) / weights.sum())
            assert abs(means[2] + 0.004) < 3.0 * error < 0.003
    assert spreads[1] > 0.04 > 2.0 * spreads[0]


def test_covariates_that_are_missing_are_refused():
    rng, temperatures = np.random.default_rng(1), np.array([-5.0, 10.0, 30.0])
    hierarchy = population(np.zeros(3), temperatures, rng)
    for covariates in ({}, {"temperature": np.nan}, {"pga": 0.1}):
        with pytest.raises(ValueError, match=r"depends on temperature: .*covariates="):
            hierarchy.new_test(10, covariates=covariates)
    tests = hierarchy.posterior.tests | {"E0": StoredPosterior(np.ones((5, 1)), Prior({"gain": LogNormal(1.0, 1.0)}))}
    with pytest.raises(ValueError, match="expected the covariate temperature in every test.*'E0' lack it"):
        HierarchicalPosterior(tests, VARYING)
    with pytest.raises(ValueError, match="Distribution"):
        Varying(LogNormal(1.0, 0.2), HalfNormal(0.05), slopes={"temperature": 0.01})


D = 4
NAMES = [f"k_{i}" for i in range(D)]


def state(logs, temperature, rng):
    """Posterior of stiffnesses observed with an error of 2 %."""
    draws = np.exp(logs + 0.02 * (rng.standard_normal(D) + rng.standard_normal((400, D))))
    prior = Prior({name: LogNormal(1.0, 3.0) for name in NAMES})
    return StoredPosterior(draws, prior, covariates={"temperature": temperature})


@pytest.mark.slow
def test_losses_between_two_temperatures_of_fifty_twins():
    """60 K with a slope of -0.4 % per degree, stated within a tenth: three of four stiffnesses have lost 20 %.

    Control: without the temperature, the losses take a part of what it has changed.
    """
    slope = {"temperature": TruncatedNormal(-0.004, 0.0004, -np.inf, np.inf)}
    named, inside, of_common = [], {True: [], False: []}, []

    def is_inside(draws, truth):
        return np.abs(np.mean(draws < truth, axis=0) - 0.5) < 0.45

    for seed in range(50):
        rng = np.random.default_rng(seed)
        change = np.log(0.8) * (np.arange(D) != seed % D) + 0.01 * rng.standard_normal(D)
        drift = 60.0 * (-0.004 + 0.0004 * rng.standard_normal()) + 0.01 * rng.standard_normal()
        states = state(np.zeros(D), -20.0, rng), state(change + drift, 40.0, rng)
        for stated in (True, False):
            options = {"slopes": slope if stated else {}, "common": 0.01 if stated else 0.05}
            each = stiffness_loss(*states, NAMES, spread=0.01, error=1.0, n_draws=1000, **options)
            inside[stated].append(is_inside(each.loss, 1.0 - np.exp(change)))
            if stated:
                named.append(np.all((each.probability() > 0.5) == (np.arange(D) != seed % D)))
                of_common.append(is_inside(each.common, np.exp(drift)))
    assert np.mean(named) > 0.9 and abs(np.sum(of_common) - 45) <= 6
    assert np.mean(inside[True]) > 0.84 and np.mean(inside[False]) < 0.7


def test_covariates_of_both_states_are_needed():
    rng = np.random.default_rng(1)
    bare = StoredPosterior(state(np.zeros(D), 0.0, rng).samples, Prior({name: LogNormal(1.0, 3.0) for name in NAMES}))
    with pytest.raises(ValueError, match="covariates of slopes .temperature. in both calibrations"):
        stiffness_loss(bare, state(np.zeros(D), 0.0, rng), NAMES, slopes={"temperature": SLOPE})
