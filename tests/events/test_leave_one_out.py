"""Populations without one test against the exact density of the other tests on a grid."""

import importlib
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
    Uniform,
    Varying,
    leave_one_out,
)

module = importlib.import_module("fe_likelihoods.events.leave_one_out")
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


def check(left_out, posterior, name, measured) -> None:
    """Means, standard deviations and predictive density are those of the other tests, on the grid."""
    weights = on_grid(posterior.without(name))
    mean = weights @ GRID
    sd = np.sqrt(weights @ np.square(GRID - mean))
    samples = left_out.hierarchy.samples
    assert (np.abs(samples.mean(axis=0) - mean) < 4.0 * sd / np.sqrt(500.0)).all()
    np.testing.assert_allclose(samples.std(axis=0), sd, rtol=0.15)
    density = stats.norm.pdf(measured, GRID[:, 0], np.hypot(ERROR, GRID[:, 1]))
    assert abs(left_out.log_density - np.log(weights @ density)) < 4.0 * left_out.log_density_error + 0.05
    assert name not in left_out.hierarchy.posterior.tests


@pytest.mark.slow
def test_tests_are_left_out_by_new_runs():
    """Also one beside the others, where no hyper-sample of the whole population is."""
    hierarchy = hierarchy_of(ONE_BESIDE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = leave_one_out(hierarchy)
    for name, measured in (("T0", ONE_BESIDE[0]), ("T1", ONE_BESIDE[1]), ("T5", ONE_BESIDE[5])):
        check(found[name], hierarchy.posterior, name, measured)
    assert found["T5"].log_density < found["T0"].log_density - 4.0  # the others did not predict it
    # control: the population of all tests is not that without T5
    weights = on_grid(hierarchy.posterior.without("T5"))
    assert abs(hierarchy.samples[:, 1].mean() - weights @ GRID[:, 1]) > 0.2


def sampled_by(monkeypatch, sample):
    """A new run is a draw of the exact density."""
    monkeypatch.setattr(module, "_sample", lambda posterior, seed: sample(posterior))


def test_without_an_evidence_there_is_no_density_of_the_data(monkeypatch):
    sampled_by(monkeypatch, exact)
    found = leave_one_out(hierarchy_of(ALIKE, n=500, with_evidence=False))
    assert all(np.isnan(each.log_density) for each in found.values())


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
    np.testing.assert_allclose(
        rest.log_likelihood(points), alike.posterior.log_marginals(points)[:, [0, 2, 3]].sum(axis=1)
    )


def test_a_population_of_too_few_different_samples_is_refused():
    posterior = population(ALIKE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = Hierarchy(posterior, np.repeat([[1.0, 0.4], [1.1, 0.3]], 50, axis=0))
    with pytest.raises(ValueError, match="expected 4 different hyper-samples or more.*got 2"):
        leave_one_out(hierarchy)


CENTERS, WIDTH = {"A": 0.0, "B": 0.3, "C": 1.2}, 0.5  # means and standard deviation of a common parameter in each test
AXES = np.linspace(-0.6, 0.6, 9), np.linspace(0.02, 0.9, 9), np.linspace(-2.0, 3.0, 101)
CUBE = np.stack([each.ravel() for each in np.meshgrid(*AXES, indexing="ij")], axis=1)


def with_common(low: float, high: float) -> HierarchicalPosterior:
    """Three tests of a varying and a common parameter, of which the last has this prior of the common one."""
    rng, tests = np.random.default_rng(5), {}
    for name, center in CENTERS.items():
        bounds = (low, high) if name == "C" else (-5.0, 5.0)
        c = stats.truncnorm(*((np.array(bounds) - center) / WIDTH), center, WIDTH).rvs(1000, random_state=rng)
        prior = Prior({"a": TruncatedNormal(0.0, WIDE, -np.inf, np.inf), "c": Uniform(*bounds)})
        tests[name] = StoredPosterior(np.column_stack([0.3 * rng.standard_normal(1000), c]), prior, log_evidence=0.0)
    return HierarchicalPosterior(tests, {"a": LINEAR}, common={"c": Uniform(-5.0, 5.0)})


def on_cube(posterior: HierarchicalPosterior) -> np.ndarray:
    log_density = posterior.log_prob(CUBE)
    density = np.exp(log_density - log_density.max())
    return density / density.sum()


def drawn(posterior: HierarchicalPosterior, n: int = 3000) -> np.ndarray:
    return CUBE[np.random.default_rng(1).choice(len(CUBE), n, p=on_cube(posterior))]


def hierarchy_with_common(low: float, high: float) -> Hierarchy:
    posterior = with_common(low, high)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Hierarchy(posterior, drawn(posterior))


def check_without_c(left_out, posterior) -> None:
    weights = on_cube(posterior.without("C"))
    mean, samples = weights @ CUBE[:, 2], left_out.hierarchy.samples[:, 2]
    assert abs(mean - 0.15) < 0.05  # of two normal densities
    sd = np.sqrt(weights @ (CUBE[:, 2] - mean) ** 2)
    assert abs(samples.mean() - mean) < 4.0 * sd / np.sqrt(500.0)
    assert samples.std() == pytest.approx(sd, rel=0.15)
    exact = np.log(weights @ np.exp(posterior.log_marginals(CUBE)[:, 2]))
    assert abs(left_out.log_density - exact) < 4.0 * left_out.log_density_error
    assert left_out.log_density_error < 0.5


@pytest.mark.slow
def test_a_prior_of_a_common_parameter_that_is_narrower_than_the_others():
    """No hyper-sample is where only this test forbids the parameter."""
    hierarchy = hierarchy_with_common(1.0, 5.0)
    check_without_c(leave_one_out(hierarchy)["C"], hierarchy.posterior)


@pytest.mark.slow
def test_a_test_that_the_others_exclude_has_no_predictive_density(monkeypatch):
    hierarchy = hierarchy_with_common(1.0, 5.0)

    def below(posterior):
        samples = drawn(posterior)
        return samples if "C" in posterior.tests else samples[samples[:, 2] < 1.0]

    sampled_by(monkeypatch, below)
    with pytest.warns(UserWarning, match="test 'C'.*whose prior of c ends beside.*not known"):
        found = leave_one_out(hierarchy)
    assert np.isnan(found["C"].log_density) and np.isfinite(found["A"].log_density)


def test_hyper_samples_that_are_impossible_under_a_test_are_refused():
    posterior = with_common(1.0, 5.0)
    samples = drawn(posterior, 500)
    samples[:3, 2] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hierarchy = Hierarchy(posterior, samples)
    with pytest.raises(ValueError, match="3 of 500 hyper-samples are impossible under test 'C'"):
        leave_one_out(hierarchy)
