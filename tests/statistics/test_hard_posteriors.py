"""The small hard posteriors and their brute-force references, against the posterior itself and against quadrature."""

import numpy as np
import pytest
from scipy.special import logsumexp

from tests.statistics.guided_runs import compare, run

from .brute_force import Reference, log_prob_function, reference
from .hard_posteriors import CASES, hash_uniform
from .late_posteriors import LATE_CASES


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


@pytest.mark.parametrize("name", LATE_CASES)
def test_a_shortened_model_gives_the_first_samples(name):
    posterior = CASES[name].posterior(1)
    model = posterior.likelihood.model
    theta = posterior.sample_prior(1, 1)[0, : len(model.parameter_names)]
    part = model.first(100 * model.dt)
    assert part.n_steps == 101 and part.fingerprint != model.fingerprint
    np.testing.assert_array_equal(part.simulate(theta), model.simulate(theta)[:, :101])


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


def test_hashes_are_uniform_and_repeatable(rng):
    x = rng.standard_normal((20_000, 3))
    u = hash_uniform(x)
    assert np.array_equal(u, hash_uniform(x.copy()))
    assert abs(u.mean() - 0.5) < 0.01 and abs(u.std() - 1 / np.sqrt(12)) < 0.01
    assert abs(np.corrcoef(u, hash_uniform(x, 1))[0, 1]) < 0.03
    near = hash_uniform(np.nextafter(x, np.inf))
    assert abs(np.corrcoef(u, near)[0, 1]) < 0.03


def quadrature(name: str, seed: int) -> tuple[float, np.ndarray]:
    """Evidence and mode shares of a case with three parameters, from the normal equations of its features."""
    case = CASES[name]
    posterior = case.posterior(seed)
    measured = posterior.likelihood.measurements.values.ravel()
    shapes = case.shapes.reshape(len(case.target), -1)
    gram, along, square = shapes @ shapes.T, shapes @ measured, measured @ measured
    # the likelihood depends on the sum of squares alone: a table of it makes a point cost nothing
    sums = np.geomspace(0.5, 50.0, 4000) * case.noise**2 * case.n_steps
    table = posterior.likelihood.noise.log_likelihood(sums[:, None], case.n_steps)
    step = 2e-5
    a = np.arange(0.0, 3.0, step) + 0.5 * step
    b, c = np.linspace(0.97, 1.03, 61), np.linspace(0.97, 1.03, 61)
    grid = np.stack(np.meshgrid(b, c, indexing="ij"), axis=-1).reshape(-1, 2)
    possible = np.abs(case.features(np.column_stack([a, np.ones_like(a), np.ones_like(a)]))[:, 0] - 0.8) < 0.05
    logs, labels = [], []
    for value in a[possible]:
        x = np.column_stack([np.full(len(grid), value), grid])
        f = case.features(x)
        misfit = square - 2.0 * f @ along + np.einsum("ni,ij,nj->n", f, gram, f)
        logs.append(logsumexp(np.interp(misfit, sums, table) + posterior.log_prior(x)))
        labels.append(case.labels(x[:1])[0])
    logs = np.array(logs) + np.log(step * (b[1] - b[0]) * (c[1] - c[0]))
    total = logsumexp(logs)
    shares = [np.exp(logsumexp(logs[np.array(labels) == mode]) - total) for mode in range(case.n_modes)]
    return total, np.array(shares)


@pytest.mark.slow
def test_brute_force_agrees_with_quadrature():
    found = reference(CASES["far"], 1, draws=40_000)
    total, shares = quadrature("far", 1)
    print(found.log_evidence - total, found.log_evidence_error, found.shares - shares, found.shares_error)
    assert abs(found.log_evidence - total) < 4.0 * found.log_evidence_error
    assert np.all(np.abs(found.shares - shares) < 4.0 * found.shares_error)
