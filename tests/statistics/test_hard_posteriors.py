"""The small hard posteriors and their brute-force references, against the posterior itself and against quadrature."""

import numpy as np
import pytest

from tests.statistics.guided_runs import compare, run

from .brute_force import Reference, log_prob_function
from .hard_posteriors import CASES


@pytest.mark.parametrize("name", CASES)
def test_the_vectorised_density_is_that_of_the_posterior(name):
    posterior = CASES[name].posterior(3)
    log_prior, log_likelihood = log_prob_function(CASES[name], 3)
    x = posterior.sample_prior(200, 1)
    expected = posterior(x)
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(log_prior(x) + log_likelihood(x), expected, rtol=1e-9)
    if name.startswith("failing"):
        assert 0.03 < np.mean(~np.isfinite(expected)) < 0.3


KNOWN = {  # reference(CASES[name], 1)
    "late_wave": Reference(
        449.011,
        0.0016,
        np.array([1.10047, 1.0003, 0.500033]),
        np.array([8.5e-06, 4.5e-06, 0.0004]),
        np.array([0.003735, 0.001993, 0.2695]),
        np.array([6.8e-06, 3.4e-06, 0.00018]),
        np.array([0.1738, 0.212, 0.2274, 0.2128, 0.1739]),
        np.array([0.00055, 0.00065, 0.0007, 0.00074, 0.00053]),
        216392,
        500000,
    ),
    "misleading": Reference(
        630.039,
        0.0034,
        np.array([0.786633, 0.997387, 1.01355]),
        np.array([8.4e-06, 1.6e-05, 1.9e-05]),
        np.array([0.001808, 0.003379, 0.003392]),
        np.array([6.4e-06, 1.2e-05, 1.6e-05]),
        np.array([1.0, 0.0]),
        np.zeros(2),
        46678,
        200000,
    ),
}


@pytest.mark.slow  # a minute and more
@pytest.mark.parametrize("name", KNOWN)
def test_a_posterior_that_is_decided_late_is_right_or_refused(name):
    case = CASES[name]
    outcome = run(case.posterior(1, name), 1, 500)
    errors = compare(outcome, KNOWN[name], case.labels)
    print(errors, outcome.status, outcome.reasons)
    assert errors.judgement in ("right", "refused")
