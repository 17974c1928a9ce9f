"""Logarithm and exponential of the bars against the library's, compiled and in pure Python."""

import math

import numpy as np
import pytest

from fe_likelihoods.kernels.elementary import exp, log


@pytest.mark.parametrize("kind", ["compiled", "py_func"])
def test_logarithm_and_exponential_have_a_few_units_in_the_last_place(rng, kind):
    own_log, own_exp = (getattr(f, "py_func", f) if kind == "py_func" else f for f in (log, exp))
    for v in [*np.exp(rng.uniform(-460.0, 600.0, 2000)), *rng.uniform(0.5, 2.0, 2000), 1.0, math.sqrt(0.5), 1e-200]:
        assert abs(own_log(v) - math.log(v)) <= 4.0 * math.ulp(math.log(v))
    for y in [*rng.uniform(-690.0, 690.0, 2000), *rng.uniform(-1.0, 1.0, 2000), 0.0, 690.0, -690.0]:
        assert abs(own_exp(y) - math.exp(y)) <= 4.0 * math.ulp(math.exp(y))
