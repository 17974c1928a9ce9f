"""Tools that measure samplers with few simulations: references, and the stored references."""

import numpy as np
import pytest

from benchmarks import few_simulations
from benchmarks.few_simulations_problems import PROBLEMS
from benchmarks.many_stiffnesses import shear_building, shear_truth


def test_stored_references_are_complete_and_precise():
    for key, entry in few_simulations.load().items():
        name, seed = key.split()
        assert name in PROBLEMS and int(seed) > 0
        assert len(entry["mean"]) == len(entry["sd"])
        assert entry["log_evidence_error"] < 0.15, key


def test_a_problem_and_seed_have_a_reference_or_none():
    posterior = PROBLEMS["oscillator"].posterior(2)
    assert np.isfinite(few_simulations.reference_of("oscillator", 2, posterior).log_evidence)
    assert few_simulations.reference_of("oscillator", 99, posterior) is None


@pytest.mark.parametrize("storeys", [3, 20])
def test_derivatives_of_the_shear_building(storeys):
    model = shear_building(storeys, 1, jacobian=True).likelihood.model
    theta, step = shear_truth(storeys, 1), 1e-5
    expected = [(model.simulate(theta + e) - model.simulate(theta - e)) / (2.0 * step) for e in step * np.eye(storeys)]
    np.testing.assert_allclose(model.jacobian(theta), expected, rtol=0, atol=1e-6 * np.abs(expected).max())
