"""Shares of the parts of a posterior: the final points compared with weighted draws."""

import numpy as np
import pytest

from samplers.estimates.weights import normalised_weights
from samplers.judgement.checks import OF_SHARES, check_shares
from samplers.proposals.mixture import Mixture, draw, invert_roots, log_density
from samplers.tempering.anneal import check_population
from samplers.tempering.mutation import VisitedPoints
from samplers.tempering.population import Population

N, NDIM = 500, 3
MEANS = np.array([[-5.0] * NDIM, [5.0] * NDIM])
WIDE = np.repeat(1.5 * np.eye(NDIM)[None], 2, axis=0)
PROPOSAL = Mixture(np.array([0.5, 0.5]), MEANS, WIDE, invert_roots(WIDE), 6.0)


def log_modes(x, share):
    """Two standard Gaussian modes, not normalised; the first one has the given share."""
    parts = [np.log(w) - 0.5 * np.sum((x - m) ** 2, axis=1) for w, m in zip((share, 1.0 - share), MEANS, strict=True)]
    return np.logaddexp(*parts)


def population(share, random):
    first = int(round(share * N))
    coords = random.standard_normal((N, NDIM)) + np.repeat(MEANS, [first, N - first], axis=0)
    return Population(1.0, coords, None, N, (np.arange(N),))


def found_in(points_share, true_share, seed=1, family=1):
    random = np.random.RandomState(seed)
    drawn = draw(PROPOSAL, N, random)
    log_weights = log_modes(drawn, true_share) - log_density(PROPOSAL, drawn)
    founders = np.arange(N) // family
    weights = normalised_weights(log_weights)
    return check_shares(PROPOSAL, population(points_share, random).coords, founders, drawn, weights)


@pytest.mark.parametrize("share", [0.05, 0.3, 0.5])
def test_equal_shares_raise_no_doubt(share):
    assert not any(found_in(share, share, seed) for seed in range(20))
    assert not found_in(0.4, 0.65, family=100) and found_in(0.4, 0.65)  # five founders do not know it better


@pytest.mark.parametrize(("points", "truth"), [(0.0, 0.5), (0.5, 0.75), (1.0, 0.7)])
def test_different_shares_are_reported(points, truth):
    for seed in range(5):
        (doubt,) = found_in(points, truth, seed)
        assert doubt.severity == "care" and "a mode has been lost or has a wrong weight" in doubt.text
        assert doubt.numbers[OF_SHARES] == pytest.approx(abs(points - truth), abs=0.15)


class Modes:
    """Density of two modes with equal shares and a flat prior."""

    evaluations = 0
    map = map

    def evaluate(self, coords, observe=None):
        self.evaluations += len(coords)
        records = np.zeros(len(coords), [("log_prob", float), ("log_prior", float)])
        records["log_prob"] = log_modes(coords, 0.5)
        records["log_prob"][coords[:, 0] > 50.0] = -np.inf
        return records

    def inside(self, coords):
        return np.ones(len(coords), dtype=bool)


def visit(visited, density, coords):
    visited.add(coords, density.evaluate(coords))


@pytest.mark.parametrize("seen", [True, False])
def test_a_mode_that_only_earlier_points_show_is_reported(seen):
    """Without the earlier points nothing can be known, and nothing is reported: the control of the test."""
    random, density, visited = np.random.RandomState(3), Modes(), VisitedPoints()
    if seen:
        visit(visited, density, MEANS[1] + 4.0 * random.standard_normal((60, NDIM)))
    points = population(1.0, random)
    visit(visited, density, points.coords)
    check, found = check_population(points, density, random, visited, np.log(0.5) + 1.5 * np.log(2.0 * np.pi))
    assert bool(found) == seen == (check.mean is not None)
    if seen:  # the truth is 0, the walkers are at -5
        assert np.all(np.abs(check.mean) < 3.0 * np.array(check.mean_error) + 0.1) and max(check.mean_error) < 0.6
    truth = 1.5 * np.log(2.0 * np.pi) - (0.0 if seen else np.log(2.0))
    assert check.log_evidence == pytest.approx(truth, abs=0.15)
