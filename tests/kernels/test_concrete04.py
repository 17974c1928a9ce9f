"""Concrete04 against reference histories of OpenSees, and with a modulus below the secant."""

import numpy as np
import pytest

from fe_likelihoods.kernels.concrete04 import envelope

from . import golden

FC, _, ECU, EC, FT, ETU, _ = range(7)


def deviation(args, history):
    """Return the largest deviations of stress / fc and, away from the corners of the law, of tangent / Ec."""
    strain, stress, tangent = history
    out = np.zeros((5, strain.size))
    golden.concrete_history(strain, golden.concrete_constants(args), out)
    fixed = [0.0, args[ECU]] + ([args[FT] / args[EC], args[ETU]] if len(args) > 4 else [])
    corners = np.vstack([out[2:], *(np.full(strain.size, corner) for corner in fixed)])
    smooth = np.abs(strain - corners).min(axis=0) > 1e-13
    return (
        np.abs(out[0] - stress).max() / -args[FC],
        np.abs(out[1] - tangent)[smooth].max() / args[EC],
        smooth.mean(),
    )


def test_reference_histories(reference):
    arrays = golden.load(reference, "materials")
    results = {key: deviation(args, history) for key, args, history in golden.histories(arrays, "concrete")}
    assert len(results) >= 3
    assert not {key: r for key, r in results.items() if not max(r[:2]) < golden.STRICT}
    assert np.mean([r[2] for r in results.values()]) > 0.9  # few strains are at corners


@pytest.mark.parametrize("ecu", [-0.008, -0.06])
def test_modulus_below_the_secant_stays_finite(ecu, rng):
    """With r = 400, eta^400 overflows a double at strains that large trial steps reach."""
    args = (-6.0, -0.0026, ecu, 1958.8, 0.744, 0.00138, 0.1)
    c = golden.concrete_constants(args)
    strain = np.concatenate([np.linspace(-0.05, 0.002, 4000), rng.uniform(-0.05, 0.002, 2000)])
    out = np.zeros((5, strain.size))
    golden.concrete_history(strain, c, out)
    assert np.isfinite(out).all()
    assert np.abs(out[0]).max() <= 6.0 * (1 + 1e-12)
    # the virgin envelope as well
    out = np.array([envelope(x, c) for x in strain])
    assert np.isfinite(out).all()
