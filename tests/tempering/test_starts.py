"""Tests of starting points: what they find, and how often they are wrong."""

import itertools

import numpy as np
import pytest

from samplers.evaluation.starts import compare_with_draws, draws_to_compare
from tests.tempering.priors import PRIORS, Correlated, LogNormal, Prior, Uniform, ball, refused


@pytest.mark.parametrize("make", [Prior, Uniform, LogNormal])
@pytest.mark.parametrize("ndim", [1, 3, 10])
@pytest.mark.parametrize(("n", "by"), [(30, "draws"), (250, "draws"), (100, "density"), (250, "density")])
def test_balls_are_found(make, ndim, n, by, seed):
    """Of 0.001 to 0.5 standard deviations, at the centre of the prior and elsewhere."""
    random, prior = np.random.RandomState(seed), make(ndim)
    for scale, centred in itertools.product((0.001, 0.01, 0.1, 0.2), (True, False)):
        assert refused(ball(prior, n, scale, random, centred), prior, by), (scale, centred)
    if n == 250 and ndim > 1:
        assert refused(ball(prior, n, 0.5, random, True), prior, by)


@pytest.mark.parametrize("by", ["draws", "density"])
def test_honest_starts_pass(by, seed):
    """A few of the starts of `test_false_alarms`; about one of a thousand may be refused by chance."""
    random = np.random.RandomState(seed)
    found = [
        refused(prior.draw(n, random), prior, by, seed)
        for prior in (make(ndim) for make, ndim in itertools.product(PRIORS, (1, 2, 5)))
        for n in (12, 40, 300)
    ]
    assert sum(map(bool, found)) <= 1, found


def test_the_worst_parameter_is_named(rng):
    points = rng.standard_normal((100, 4))
    points[:, 2] = 0.3 + 0.05 * points[:, 2]
    fresh = Prior(4).draw(draws_to_compare(100), rng)
    for names, name in ((), "2"), (["a", "b", "c"], "2"), (["a", "b", "c", "d"], "c"):
        found = compare_with_draws(points, fresh, names)
        assert f"range of parameter {name} is 0.0" in found and "the median differs by 0.2" in found


def test_other_shapes_are_found(rng):
    n, prior = 300, Prior(3)
    along_a_line = rng.standard_normal((n, 1)) + 0.1 * rng.standard_normal((n, 3))
    assert "together" in refused(along_a_line / np.std(along_a_line, axis=0), prior)
    assert refused(rng.standard_normal((n, 3)), Correlated(3))
    assert refused(2.0 * rng.standard_normal((n, 3)), prior)
    assert refused(rng.standard_normal((n, 3)) + 1.0, prior)


def test_copies_are_found(rng):
    points = rng.standard_normal((100, 2))
    points[50:] = points[:50]
    assert refused(points, Prior(2)) == "only 50 of 100 points are different"
    points = rng.standard_normal((40, 2))
    points[:, 1] = 0.1
    assert refused(points, Prior(2)) == "only 1 of 40 values of parameter 1 are different"
    assert refused(points, Prior(2), by="density") == "a parameter has the same value in all points"


def test_priors_with_copies_may_have_copies(rng):
    """Parameters that are whole numbers, and a mass at one value."""

    class Counts(Prior):
        def draw(self, n, random):
            return np.column_stack([random.randint(3, size=n), random.poisson(2.0, size=n)]).astype(float)

    assert not refused(Counts(2).draw(200, np.random.RandomState(5)), Counts(2))
    assert refused(np.ones((200, 2)), Counts(2))
