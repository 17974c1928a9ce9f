"""Agreement of tests: p-values of twins that share the truth, power for twins that do not, and limits in words."""

import numpy as np
import pytest
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    LogNormal,
    MultivariateNormal,
    Prior,
    StoredPosterior,
    TruncatedNormal,
    Uniform,
    compare_tests,
)
from fe_likelihoods.events import agreement

ROOT = np.array([[0.2, 0.0], [0.1, 0.3]])  # of the covariance of the errors of the first test
SETS = 200


def normal(sd: float) -> TruncatedNormal:
    return TruncatedNormal(0.0, sd, -np.inf, np.inf)


def twin(
    rng: np.random.Generator,
    *,
    n_tests: int = 2,
    n: int = 300,
    prior_sd: float = 2.0,
    difference: float = 0.0,
    scale: float = 1.0,
) -> dict[str, StoredPosterior]:
    """Exact samples of tests with normal errors of different sizes; the first differs by `difference` sd in a."""
    tests = {}
    for k in range(n_tests):
        root = scale * (1.0 + 0.5 * k) * ROOT
        sd = scale * 0.2 * np.hypot(1.0, 1.5)  # of the difference of a between the first two tests
        truth = np.array([0.3 + (difference * sd if k == 0 else 0.0), -0.2])
        measured, precision = truth + root @ rng.standard_normal(2), np.linalg.inv(root @ root.T)
        covariance = np.linalg.inv(precision + np.eye(2) / prior_sd**2)
        samples = rng.multivariate_normal(covariance @ precision @ measured, covariance, n)
        tests[f"T{k}"] = StoredPosterior(samples, Prior({"a": normal(prior_sd), "b": normal(prior_sd)}))
    return tests


def uniform(p_values: list[float]) -> bool:
    """Kolmogorov's test, and the number of false alarms at 0.05 within four standard errors."""
    error = np.sqrt(0.05 * 0.95 / len(p_values))
    return (
        stats.kstest(p_values, "uniform").pvalue > 1e-3 and abs(np.mean(np.array(p_values) < 0.05) - 0.05) < 4 * error
    )


SLOW = ({"n": 300}, {"n_tests": 4}, {"prior_sd": 0.8, "n": 1000})


@pytest.mark.parametrize(
    "options", [{"n": 40}, *(pytest.param(each, marks=pytest.mark.slow) for each in SLOW)], ids=str
)
def test_p_values_are_uniform_where_tests_share_the_truth(options, rng):
    p_values = [compare_tests(twin(rng, **options), ["a", "b"], seed=k).p_value for k in range(SETS)]
    assert uniform(p_values)


def test_control_a_prior_that_is_left_in_pulls_the_wider_posterior(rng):
    truth, prior = 2.0, Prior({"a": normal(1.0)})
    pulled, corrected = [], []
    for k in range(100):
        tests = {}
        for name, sd in (("T0", 0.1), ("T1", 0.6)):
            precision = 1.0 / sd**2
            post = 1.0 / (precision + 1.0)
            mean = post * precision * (truth + sd * rng.standard_normal())
            tests[name] = StoredPosterior(mean + np.sqrt(post) * rng.standard_normal((2000, 1)), prior)
        corrected.append(compare_tests(tests, ["a"], seed=k).p_value)
        wide = {name: StoredPosterior(each.samples, Prior({"a": normal(50.0)})) for name, each in tests.items()}
        pulled.append(compare_tests(wide, ["a"], seed=k).p_value)
    assert np.mean(np.array(pulled) < 0.05) > 0.1 and not uniform(pulled)
    assert uniform(corrected)


def test_p_values_are_uniform_for_skewed_likelihoods_and_those_of_chi_squared_are_not(rng):
    """Errors with a gamma distribution of shape 0.5, whose tail is that of no normal distribution."""
    error, p_values, naive = stats.gamma(0.5, scale=0.3), [], []
    for k in range(SETS):
        tests = {}
        for name in ("T0", "T1"):
            measured = 1.0 + (error.rvs(random_state=rng) if name == "T0" else 0.02 * rng.standard_normal())
            own = error.rvs(2000, random_state=rng) if name == "T0" else 0.02 * rng.standard_normal(2000)
            tests[name] = StoredPosterior((measured - own)[:, None], Prior({"a": normal(50.0)}))
        found = compare_tests(tests, ["a"], seed=k)
        p_values.append(found.p_value)
        naive.append(stats.chi2.sf(found.pairs[0].distance ** 2, 1))
    assert uniform(p_values)
    assert not stats.kstest(naive, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("difference", (2.0, pytest.param(4.0, marks=pytest.mark.slow)))
def test_power_is_that_of_the_noncentral_distribution(difference, rng):
    """Two tests that differ by 2 and 4 standard deviations, at a level of 0.05."""
    found = [compare_tests(twin(rng, difference=difference), ["a"], level=0.05, seed=k) for k in range(SETS)]
    share = np.mean([not each.agree for each in found])
    expected = stats.ncx2.sf(stats.chi2.isf(0.05, 1), 1, difference**2)
    assert abs(share - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / SETS)
    detectable = stats.norm.isf(0.025) + stats.norm.ppf(0.8)
    ratios = [each.detectable["a"] / each.pairs[0].standard_deviations["a"] for each in found]
    np.testing.assert_allclose(ratios, detectable)
    assert np.mean([each.pairs[0].differences["a"] for each in found]) == pytest.approx(
        -difference, abs=4.0 / np.sqrt(SETS) + 0.05 * difference
    )


def test_sentence_names_the_tests_the_parameter_and_the_consequence(rng):
    prior = Prior({"frequency": LogNormal(5.0, 0.5), "damping": LogNormal(0.1, 0.5), "sigma": HalfNormal(1.0)})

    def event(frequency: float) -> StoredPosterior:
        z = rng.standard_normal((1000, 3))
        return StoredPosterior([frequency, 0.1, 0.5] * np.exp([0.01, 0.05, 0.1] * z), prior)

    two = compare_tests({"EQ1": event(5.0), "EQ2": event(5.5)}, ["frequency", "damping"])
    assert not two.agree and two.logarithmic == ("frequency", "damping")
    assert two.pairs[0].differences["frequency"] == pytest.approx(np.log(1.1) / np.hypot(0.01, 0.01), abs=0.5)
    assert "'EQ1' and 'EQ2' disagree by 6." in two.sentence and "standard deviations in frequency" in two.sentence
    assert "spread between the tests (Hierarchy), not the error of their mean" in two.sentence
    three = compare_tests({"A": event(5.0), "B": event(5.0), "C": event(5.5)}, ["frequency"])
    assert "2 of 3 pairs of tests disagree" in three.sentence and three.scatter > 3.0
    assert three.sentence in str(three)
    same = compare_tests({"A": event(5.0), "B": event(5.0)}, ["frequency", "damping"])
    assert same.agree and "No disagreement was found" in same.sentence and "of frequency" in same.sentence


def test_distance_of_two_tests_is_the_mahalanobis_distance(rng):
    tests = twin(rng, n=1000, prior_sd=100.0)
    (pair,) = compare_tests(tests, ["a", "b"]).pairs
    first, second = (each.samples for each in tests.values())
    delta = second.mean(axis=0) - first.mean(axis=0)
    expected = np.sqrt(delta @ np.linalg.solve(np.cov(first.T) + np.cov(second.T), delta))
    assert pair.distance == pytest.approx(expected, rel=0.01)


def test_probabilities_are_corrected_as_holm_says_and_have_a_floor(rng):
    assert agreement._holm([0.01, 0.04, 0.03, 0.5]) == pytest.approx([0.04, 0.09, 0.09, 0.5])
    far = compare_tests(twin(rng, difference=60.0), ["a", "b"])
    assert far.p_value == 1e-12 and "p < 2e-12" in far.sentence


def test_what_limits_a_comparison_is_said(rng):
    tests = twin(rng, n=1000)
    wide = StoredPosterior(2.0 * rng.standard_normal((1000, 2)), tests["T0"].prior)  # the prior itself
    limited = compare_tests(tests | {"W": wide}, ["a", "b"])
    assert len(limited.pairs) == 1 and np.isnan(limited.p_value)
    assert sum("'W' says too little about" in text for text in limited.messages) == 2
    assert limited.agree is None and limited.left_out == {"W": ("a", "b")}
    assert "not known: a, b of 'W' could not be compared" in limited.sentence
    assert compare_tests(tests, ["a", "b"]).agree is True  # control: nothing was left out
    apart = compare_tests(twin(rng, difference=30.0) | {"W": wide}, ["a", "b"])
    assert apart.agree is False and apart.left_out == limited.left_out
    bounded = Prior({"a": Uniform(0.0, 1.0)})
    at_bound = StoredPosterior(1.0 - np.abs(0.05 * rng.standard_normal((500, 1))), bounded)
    inside = StoredPosterior(0.5 + 0.05 * rng.standard_normal((500, 1)), bounded)
    found = compare_tests({"A": at_bound, "B": inside}, ["a"], scales={"a": "linear"})
    assert len(found.messages) == 1 and "'A': its samples of a reach a bound" in found.messages[0]
    narrow = StoredPosterior(0.69 * rng.standard_normal((300, 2)), Prior({"a": normal(1.0), "b": normal(1.0)}))
    texts = compare_tests(tests | {"N": narrow}, ["a", "b"]).messages
    assert any("cannot be taken out" in text or "says too little" in text for text in texts)


def test_what_cannot_be_compared_is_refused(rng):
    tests = twin(rng)
    with pytest.raises(ValueError, match="two or more names"):
        compare_tests({"A": tests["T0"]}, ["a"])
    with pytest.raises(ValueError, match="different names of parameters"):
        compare_tests(tests, "a")
    with pytest.raises(ValueError, match="'T0' has no parameters c"):
        compare_tests(tests, ["a", "c"])
    with pytest.raises(ValueError, match="scales are 'log' or 'linear'"):
        compare_tests(tests, ["a"], scales={"a": "cubic"})
    with pytest.raises(ValueError, match="level is a small probability"):
        compare_tests(tests, ["a"], level=95.0)
    with pytest.raises(ValueError, match="logarithmic scale needs positive"):
        compare_tests(tests, ["a"], scales={"a": "log"})
    few = StoredPosterior(tests["T0"].samples, tests["T0"].prior, effective_sample_size=10)
    with pytest.raises(ValueError, match="test 'F': a comparison needs 20 effective samples"):
        compare_tests(tests | {"F": few}, ["a"])
    joint = Prior({("a", "b"): MultivariateNormal([0.0, 0.0], [[4.0, 1.0], [1.0, 4.0]])})
    together = {name: StoredPosterior(each.samples, joint) for name, each in tests.items()}
    assert compare_tests(together, ["b", "a"]).pairs
    with pytest.raises(ValueError, match="test 'T0'"):
        compare_tests(together, ["a"])
