"""Events that are predicted from the others: peaks within their intervals; an event beside the others as control."""

import importlib
import warnings

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    LogNormal,
    Measurements,
    Posterior,
    StoredPosterior,
    Varying,
    leave_one_out,
    peak,
    predict_new_event,
    share_within,
)
from tests.prediction.test_new_event import TOP, Amplified

without = importlib.import_module("fe_likelihoods.prediction.held_out")
PRIOR = {"gain": LogNormal(0.03, 1.0), "sigma_top": HalfNormal(0.01)}
SIGMA, SPREAD = 1e-3, 0.1


@pytest.fixture(scope="module")
def events():
    """Seven events of a structure whose gain differs by 10 %, and an eighth with three times the gain."""
    rng = np.random.default_rng(3)
    gains = 0.03 * np.exp(SPREAD * rng.standard_normal(8))
    gains[7] *= 3.0
    posteriors, tests = {}, {}
    for k, gain in enumerate(gains):
        model = Amplified(1.0 + 0.2 * k)  # each event has another strength
        data = model.simulate([gain]) + SIGMA * rng.standard_normal((1, 100))
        posteriors[f"EQ{k}"] = Posterior(FELikelihood(model, Measurements([TOP], model.dt, data)), PRIOR)
        draws = {"gain": gain * np.exp(0.01 * rng.standard_normal(300)), "sigma_top": np.full(300, SIGMA)}
        tests[f"EQ{k}"] = StoredPosterior(draws, posteriors[f"EQ{k}"].prior, log_evidence=0.0)
    posterior = HierarchicalPosterior(tests, {"gain": Varying(LogNormal(0.03, 0.5), HalfNormal(0.3))})
    grid = [each.ravel() for each in np.meshgrid(np.geomspace(0.02, 0.08, 60), np.linspace(0.02, 1.5, 60))]
    points = np.stack(grid, axis=1)

    def drawn(posterior):
        log_density = posterior.log_prob(points) + np.log(points[:, 0])  # the grid is even in the log of the median
        density = np.exp(log_density - log_density.max())
        rows = rng.choice(len(points), 1000, p=density / density.sum())
        return points[rows] * np.exp(0.01 * rng.standard_normal((1000, 2)))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = Hierarchy(posterior, drawn(posterior))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(without, "_sample", lambda posterior, seed: drawn(posterior))
            return hierarchy, posteriors, leave_one_out(hierarchy)


def test_each_event_is_scored_by_the_others(events):
    hierarchy, posteriors, left_out = events
    found = left_out.scores(posteriors, quantity=peak("top"), n=400, seed=1, prior_events=1e-9)
    measured = {name: np.abs(each.likelihood.measurements.values).max() for name, each in posteriors.items()}
    assert {name: each.scores.measured[0] for name, each in found.items()} == pytest.approx(measured)
    pit = [each.scores.pit[0] for each in found.values()]
    assert share_within(pit[:7], 0.9).value == 1.0
    assert pit[7] > 0.99  # the event beside the others is a surprise
    assert found["EQ7"].scores.interval_score[0] > 3.0 * max(
        each.scores.interval_score[0] for each in list(found.values())[:7]
    )
    assert "within 90%, 7 of 8: 53 to 98 %" in str(found)
    # control: the ratios of all events, with the data of this one, are not surprised
    own = {"model": posteriors["EQ7"], "quantity": peak("top"), "n": 400, "seed": 1, "prior_events": 1e-9}
    inside = predict_new_event(hierarchy, posteriors, None, **own)
    assert inside.score(measured["EQ7"]).pit[0] < 0.99
    # without it, the spread is that of the others
    gains = [stored.samples[:, 0].mean() for stored in list(hierarchy.posterior.tests.values())[:7]]
    spread = np.std(np.log(gains), ddof=1)
    values = np.log(found["EQ7"].prediction.values)
    assert spread < np.diff(np.quantile(values, stats.norm.cdf([-1, 1])))[0] / 2.0 < 2.0 * spread


def test_histories_are_scored_too(events):
    _, posteriors, left_out = events
    found = left_out.scores(posteriors, n=100)["EQ0"]
    assert found.scores.rrmse[0] < 0.4 and found.prediction.dt == 0.02


def test_missing_posteriors_are_refused(events):
    _, posteriors, left_out = events
    with pytest.raises(ValueError, match="posteriors of 'EQ1' are missing"):
        left_out.scores({name: each for name, each in posteriors.items() if name != "EQ1"})
