"""Populations without one test against the exact density of the other tests on a grid."""

import warnings

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    Prior,
    StoredPosterior,
    TruncatedNormal,
    Varying,
    leave_one_out,
)

ERROR, WIDE = 0.2, 2.0  # standard deviations of a measurement and of the prior of a test
LINEAR = Varying(TruncatedNormal(0.0, 2.0, -np.inf, np.inf), HalfNormal(1.0), "linear")
GRID = np.stack([each.ravel() for each in np.meshgrid(np.linspace(-1, 3, 80), np.linspace(0.01, 2.4, 80))], axis=1)
ALIKE = (0.7, 1.4, 1.0, 1.5)
ONE_BESIDE = (1.0, 1.2, 0.9, 1.1, 1.0, 3.0)


def population(measured, with_evidence=True) -> HierarchicalPosterior:
    """Tests with one normal measurement each, from exact samples of their posteriors."""
    sd, tests = 1.0 / np.sqrt(1.0 / ERROR**2 + 1.0 / WIDE**2), {}
    for k, each in enumerate(measured):
        draws = np.random.default_rng(k).normal(sd**2 / ERROR**2 * each, sd, (400, 1))
        evidence = stats.norm(0.0, np.hypot(ERROR, WIDE)).logpdf(each) if with_evidence else None
        prior = Prior({"a": TruncatedNormal(0.0, WIDE, -np.inf, np.inf)})
        tests[f"T{k}"] = StoredPosterior(draws, prior, log_evidence=evidence)
    return HierarchicalPosterior(tests, {"a": LINEAR})


def on_grid(posterior: HierarchicalPosterior) -> np.ndarray:
    log_density = posterior.log_prob(GRID)
    density = np.exp(log_density - log_density.max())
    return density / density.sum()


def exact(posterior: HierarchicalPosterior) -> np.ndarray:
    return GRID[np.random.default_rng(1).choice(len(GRID), 1000, p=on_grid(posterior))]


def hierarchy_of(measured, n=2000, seed=0, **options) -> Hierarchy:
    posterior = population(measured, **options)
    rows = np.random.default_rng(seed).choice(len(GRID), n, p=on_grid(posterior))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Hierarchy(posterior, GRID[rows])


def check(left_out, posterior, name) -> None:
    """Means and standard deviations are from the other tests, on the grid."""
    weights = on_grid(posterior.without(name))
    mean = weights @ GRID
    sd = np.sqrt(weights @ np.square(GRID - mean))
    samples = left_out.samples
    assert (np.abs(samples.mean(axis=0) - mean) < 4.0 * sd / np.sqrt(500.0)).all()
    np.testing.assert_allclose(samples.std(axis=0), sd, rtol=0.15)
    assert name not in left_out.posterior.tests


@pytest.mark.slow
def test_tests_are_left_out_by_new_runs():
    """Also one beside the others, where no hyper-sample of the whole population is."""
    hierarchy = hierarchy_of(ONE_BESIDE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = leave_one_out(hierarchy)
    for name in ("T0", "T1", "T5"):
        check(found[name], hierarchy.posterior, name)
    # control: the population of all tests is not that without T5
    weights = on_grid(hierarchy.posterior.without("T5"))
    assert abs(hierarchy.samples[:, 1].mean() - weights @ GRID[:, 1]) > 0.2


def test_a_single_test_cannot_be_left_out():
    alike = hierarchy_of(ALIKE, n=100)
    single = hierarchy_of(ALIKE[:1], n=100)
    with pytest.raises(ValueError, match="leave_one_out needs two tests"):
        leave_one_out(single)
    with pytest.raises(ValueError, match="expected one of two tests or more, 'T0'; got 'T0'"):
        single.posterior.without("T0")
    with pytest.raises(ValueError, match="got 'T9'"):
        alike.posterior.without("T9")
    rest = alike.posterior.without("T1")
    points = GRID[::700]
    assert list(rest.tests) == ["T0", "T2", "T3"] and rest.fingerprint != alike.posterior.fingerprint
    left_out = HierarchicalPosterior({"T1": alike.posterior.tests["T1"]}, alike.posterior.varying)
    np.testing.assert_allclose(
        rest.log_likelihood(points) + left_out.log_likelihood(points), alike.posterior.log_likelihood(points)
    )
