"""The matrix exponential against closed forms and scipy, and equal bits for any number of BLAS threads."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.linalg import expm

from fe_likelihoods.kernels.exponential import matrix_exponential


def exponential(a):
    out = np.empty_like(a)
    matrix_exponential(a, out, np.empty((2, *a.shape)))
    return out


@pytest.mark.parametrize("norm", [1e-3, 0.4, 3.0, 40.0])
def test_agrees_with_scipy(norm, rng):
    a = rng.normal(size=(18, 18))
    a *= norm / np.abs(a).sum(axis=1).max()
    both = exponential(a), expm(a)
    assert np.abs(both[0] - both[1]).max() < 1e-14 * max(1.0, norm) * np.abs(both[1]).max()
    np.testing.assert_allclose(both[0] @ exponential(-a), np.eye(18), atol=1e-14 * np.exp(norm / 2) ** 2)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_entries_that_are_not_finite_give_nan(bad):
    a = np.eye(3)
    a[1, 2] = bad
    assert np.isnan(exponential(a)).all()


@pytest.mark.slow
def test_response_of_the_bridge_has_the_same_bits_on_any_number_of_blas_threads():
    """Executors limit the threads of their workers. With scipy's expm the state matrices differed by 1e-15 here."""
    code = (
        "import hashlib, numpy as np; from fe_likelihoods import problems\n"
        "model = problems.isolated_bridge(step=1e-3).likelihood.model\n"
        "print(hashlib.sha256(model.simulate(np.full(10, 1.05)).tobytes()).hexdigest())"
    )
    found = {
        subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads},
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
        ).stdout
        for threads in ("1", "2", "4")
    }
    assert len(found) == 1, found
