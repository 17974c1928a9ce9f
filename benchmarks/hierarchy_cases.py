"""Hard cases of the hierarchical posterior, with normal tests whose hierarchical likelihood has a closed form.

Two correlated parameters. Each row has the largest error of the posterior mean of a hyper-parameter: the samples of a
run of SMC are weighted with the ratio of the exact likelihood to that from the stored samples. The note has the error
that `Hierarchy.checks` states, the ratio of standard deviations, the error of the log-evidence, and the tests that a
warning names.
"""

import re
import warnings

import numpy as np
from scipy import stats

from fe_likelihoods import (
    HalfNormal,
    HierarchicalPosterior,
    Hierarchy,
    Prior,
    StoredPosterior,
    TruncatedNormal,
    Varying,
)
from samplers import SMCSampler

from .rows import Row

__all__ = ["cases"]

_CENTER = np.array([1.0, 0.0])
_ERRORS = np.diag([0.2, 0.3]) @ np.array([[1.0, 0.5], [0.5, 1.0]]) @ np.diag([0.2, 0.3])
_CASES = {  # tests, spread, factor of the errors, samples per test, standard deviation of their prior, weighted
    "2 tests": (2, 0.3, 1.0, 1000, 2.0, False),
    "3 tests of 200 samples": (3, 0.3, 1.0, 200, 2.0, False),
    "5 tests": (5, 0.3, 1.0, 1000, 2.0, False),
    "5 tests, weighted samples": (5, 0.3, 1.0, 2000, 2.0, True),
    "5 tests, errors 30 times smaller": (5, 0.3, 1.0 / 30.0, 1000, 2.0, False),
    "30 tests": (30, 0.3, 1.0, 1000, 2.0, False),
    "10 tests, no spread": (10, 0.0, 1.0, 1000, 2.0, False),
    "10 tests, spread three times the prior": (10, 3.0, 1.0, 1000, 1.0, False),
    "6 tests, the same, hardly informed": (6, 3.0, 8.0, 1000, 1.0, False),
}


def cases(repeats: int = 1) -> list[Row]:
    """One row per case and seed."""
    return [_case(name, seed) for name in _CASES for seed in range(repeats)]


def _case(name: str, seed: int) -> Row:
    n_tests, spread, factor, n_samples, sd, weighted = _CASES[name]
    rng = np.random.default_rng(seed)
    errors, wide = factor**2 * _ERRORS, sd**2 * np.eye(2)
    root = np.linalg.cholesky(errors)
    data = _CENTER + spread * rng.standard_normal((n_tests, 2)) + rng.standard_normal((n_tests, 2)) @ root.T
    covariance = np.linalg.inv(np.linalg.inv(errors) + np.linalg.inv(wide))
    prior = Prior({each: TruncatedNormal(0.0, sd, -np.inf, np.inf) for each in ("a", "b")})
    tests = {}
    for k, row in enumerate(data):
        mean, log_weights = covariance @ np.linalg.solve(errors, row), None
        if weighted:
            wider = stats.multivariate_t(mean, 1.5 * covariance, df=5)
            draws = wider.rvs(n_samples, random_state=rng)
            log_weights = stats.multivariate_normal(mean, covariance).logpdf(draws) - wider.logpdf(draws)
        else:
            draws = rng.multivariate_normal(mean, covariance, n_samples)
        evidence = stats.multivariate_normal(np.zeros(2), errors + wide).logpdf(row)
        tests[f"T{k + 1}"] = StoredPosterior(draws, prior, log_weights, evidence)
    varying = Varying(TruncatedNormal(0.0, 2.0, -np.inf, np.inf), HalfNormal(1.0), "linear")
    posterior = HierarchicalPosterior(tests, {"a": varying, "b": varying})
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sampler = SMCSampler(300, posterior.ndim, posterior, vectorize=True, seed=seed)
        sampler.run_mcmc(None, 4, progress=False)
        samples = sampler.get_chain(flat=True)
        checks = Hierarchy(posterior, samples).checks
    named = sorted({found[1] for each in caught if (found := re.match(r"test '(\w+)'", str(each.message)))})
    exact = np.array(
        [
            stats.multivariate_normal([m_a, m_b], errors + np.diag([s_a**2, s_b**2])).logpdf(data).sum()
            for m_a, s_a, m_b, s_b in samples
        ]
    )
    change = exact - posterior.log_likelihood(samples)
    weights = np.exp(change - change.max())
    weights /= weights.sum()
    mean = weights @ samples
    shift = np.abs(mean - samples.mean(axis=0)) / samples.std(axis=0)
    ratio = samples.std(axis=0) / np.sqrt(weights @ np.square(samples - mean))
    note = f"stated {max(checks.mean_errors.values()):.2f}; sd ratios {ratio.min():.2f} to {ratio.max():.2f}; "
    note += f"log Z {-np.log(np.mean(np.exp(change))):+.2f}, stated {checks.log_evidence_error:.2f}; "
    note += f"warned of {', '.join(named)}" if named else "no test warned of"
    return Row("largest error of a mean", f"{name}, seed {seed}", float(shift.max()), "sd", note)
