"""Reinforcing steel against reference histories of OpenSees, and far beyond them."""

import math

import numpy as np
import pytest

from fe_likelihoods.kernels.reinforcing_steel import N_STATE, update

from . import golden

# fy, fu, Es, Esh, eps_sh, eps_u
MATERIALS = {
    "nominal": golden.STEEL,
    "other": (60.0, 90.0, 29000.0, 1200.0, 0.008, 0.1),
    "stiff": (75.2, 102.0, 2.5 * 28400.0, 1000.0, 0.011, 0.12),
    "soft": (75.2, 102.0, 0.2 * 28400.0, 1000.0, 0.0165, 0.12),
    "early": (75.2, 102.0, 28400.0, 1000.0, 0.00275, 0.12),  # the transition to hardening begins below yield
    "SI": (518.5e6, 706.0e6, 1.958e11, 3.14e9, 0.011, 0.122),
}


def follow(strain, args):
    """Stress, tangent and branch (3, n) along a history."""
    out = np.zeros((3, len(strain)))
    golden.steel_history(np.ascontiguousarray(strain, dtype=float), golden.steel_constants(args), out)
    return out


def deviation(args, history):
    """Return the largest deviation of stress / fy and the median deviation of tangent / Es."""
    out = follow(history[0], args)
    return np.abs(out[0] - history[1]).max() / args[0], np.median(np.abs(out[1] - history[2])) / args[2]


def test_reference_histories(reference):
    """Round-off decides in a few histories whether a slope is clipped; these may differ more."""
    arrays = golden.load(reference, "materials")
    results = {key: deviation(args, history) for key, args, history in golden.histories(arrays, "steel")}
    assert len(results) >= 3
    loose = {key: r for key, r in results.items() if not r[0] < golden.STRICT}
    assert len(loose) <= 3
    assert not {key: r for key, r in loose.items() if not r[0] < golden.ILL_CONDITIONED}
    assert not {key: r for key, r in results.items() if not r[1] < golden.STRICT}


@pytest.mark.parametrize("material", MATERIALS)
def test_large_random_walks_stay_finite(material, seed):
    rng, largest = np.random.default_rng(seed), 0.0
    for amplitude in (0.003, 0.01, 0.03, 0.1):
        for strain in golden.random_walks(rng, 500, 200, amplitude):
            assert np.isfinite(follow(strain, MATERIALS[material])).all()
            largest = max(largest, np.abs(strain).max())
    assert largest > 0.2


def test_impossible_strain_is_not_a_number():
    """ln(1 + eps) ends at eps = -1; the result is NaN, which the caller counts as a failed iteration."""
    for eps in (-0.96, -1.5, math.nan, math.inf):
        assert math.isnan(update(eps, np.zeros(N_STATE), golden.steel_constants(golden.STEEL))[0])


# Constants, strains and stresses of OpenSees 3.7.1, for returning curves whose chord is steeper than the slope at the
# reversal. Such a curve is a straight line.
STEEP_CHORDS = [
    (
        (75.2, 102.0, 5680.0, 1000.0, 0.0165, 0.12),
        [0.0, -0.017, -0.015, -0.018, -0.017, 0.0],
        [0.0, -78.6359407703, -68.0027848179, -79.8307551636, -74.5298114827, 13.1744798592],
    ),
    (
        (75.2, 102.0, 5680.0, 1000.0, 0.0165, 0.12),
        [0.0, 0.0163, 0.015, 0.017, 0.0168, 0.0],
        [0.0, 75.2026068408, 68.7272441113, 75.6964424379, 74.7287555482, -8.64816065963],
    ),
    (
        (75.2, 102.0, 8520.0, 1000.0, 0.011, 0.12),
        [0.0, -0.0169, -0.0096, -0.0174, -0.0163, 0.0],
        [0.0, -83.6612158328, -27.3355736045, -84.1886443625, -75.4829731444, 50.1763343466],
    ),
]


@pytest.mark.parametrize(("args", "strain", "stress"), STEEP_CHORDS)
def test_chord_steeper_than_the_reversal(args, strain, stress):
    np.testing.assert_allclose(follow(strain, args)[0], stress, rtol=1e-10)
