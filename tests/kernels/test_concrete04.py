"""Concrete04 against reference histories, its formulas, and differences."""

import numpy as np
import pytest

from fe_likelihoods.kernels.concrete04 import envelope, stress_tangent, unloading

from . import golden

# fc, e0, ecu, Ec, ft, etu, beta
MATERIALS = {
    "core": golden.CORE,
    "cover": golden.COVER,  # r = 2
    "softer than its secant": (-6.0, -0.0026, -0.05, 1958.8, 0.744, 0.00138, 0.1),  # r = 400
    "slow softening": (-5.0, -0.003, -0.01, 4000.0, 0.4, 0.002, 0.3),
    "no tension": (-6.0, -0.0036, -0.006, 3320.0),
}

FC, E0, ECU, EC, FT, ETU, BETA = range(7)


@pytest.fixture(params=MATERIALS)
def args(request):
    return MATERIALS[request.param] + (0.0, 1.0, 0.1) * (len(MATERIALS[request.param]) == 4)


def popovics(strain, args):
    """Return stress and tangent of Popovics' envelope in compression."""
    secant = args[FC] / args[E0]
    r = 400.0 if secant >= args[EC] else args[EC] / (args[EC] - secant)
    eta = strain / args[E0]
    with np.errstate(over="ignore", invalid="ignore"):
        stress = args[FC] * eta * r / (r - 1 + eta**r)
        tangent = secant * r * (r - 1) * (1 - eta**r) / (r - 1 + eta**r) ** 2
    nothing = (strain < args[ECU]) | ~np.isfinite(tangent)  # eta^400 is out of range; the limit is zero
    return np.where(nothing, 0.0, stress), np.where(nothing, 0.0, tangent)


def softening(strain, args):
    """Return stress and tangent of the envelope in tension."""
    cracked = args[FT] / args[EC]
    rate = np.log(args[BETA]) / (args[ETU] - cracked)
    stress = args[FT] * args[BETA] ** ((strain - cracked) / (args[ETU] - cracked))
    stress = np.where(strain <= cracked, args[EC] * strain, np.where(strain <= args[ETU], stress, 0.0))
    return stress, np.where(strain <= cracked, args[EC], rate * stress)


def histories(arrays):
    for key in arrays:
        if key.startswith("concrete/") and not key.endswith("/args"):
            yield key, arrays[key.rsplit("/", 1)[0] + "/args"], arrays[key]


def deviation(args, history, c=None):
    """Return the largest deviations of stress / fc and, away from the corners of the law, of tangent / Ec."""
    strain, stress, tangent = history
    out = np.zeros((5, strain.size))
    c = golden.concrete_constants(args) if c is None else c
    golden.concrete_history(strain, c, out)
    fixed = [0.0, args[ECU]] + ([args[FT] / args[EC], args[ETU]] if len(args) > 4 else [])
    corners = np.vstack([out[2:], *(np.full(strain.size, corner) for corner in fixed)])
    smooth = np.abs(strain - corners).min(axis=0) > 1e-13
    return (
        np.abs(out[0] - stress).max() / -args[FC],
        np.abs(out[1] - tangent)[smooth].max() / args[EC],
        smooth.mean(),
    )


def test_reference_histories(reference):
    results = {key: deviation(args, history) for key, args, history in histories(golden.load(reference, "materials"))}
    assert len(results) >= 3
    assert not {key: r for key, r in results.items() if not r[0] < golden.STRICT}
    assert not {key: r for key, r in results.items() if not r[1] < golden.STRICT}
    assert np.mean([r[2] for r in results.values()]) > 0.9  # few strains are at corners


def test_a_strength_one_percent_off_is_detected():
    cracked = 0
    for _, args, history in histories(golden.load(golden.BUNDLED, "materials")):
        changed = np.array(args)
        changed[FC] *= 1.01
        assert deviation(args, history, golden.concrete_constants(changed))[0] > 1e-4
        if len(args) > 4 and history[0].max() > args[FT] / args[EC]:
            cracked += 1
            changed = np.array(args)
            changed[FT] *= 1.01
            assert deviation(args, history, golden.concrete_constants(changed))[0] > 1e-4
    assert cracked >= 2


def test_envelope_is_the_formula(args, rng):
    c = golden.concrete_constants(args)
    strain = rng.uniform(1.2 * args[ECU], 0.0, 500)
    out = np.array([envelope(x, c) for x in strain]).T
    expected = popovics(strain, args)
    r_minus_1 = 400.0 if args[FC] / args[E0] >= args[EC] else 1.0
    np.testing.assert_allclose(out[0], expected[0], rtol=1e-12 * r_minus_1, atol=1e-14)
    np.testing.assert_allclose(out[1], expected[1], rtol=1e-12 * r_minus_1, atol=1e-9)
    peak, slope = envelope(args[E0], c)
    assert peak == pytest.approx(args[FC], rel=1e-14)
    assert abs(slope) < 1e-12 * args[EC]
    strain = rng.uniform(0.0, 1.2 * max(args[ETU], 1e-3), 500)
    out = np.array([envelope(x, c) for x in strain]).T
    np.testing.assert_allclose(out, softening(strain, args), rtol=1e-12, atol=1e-14)


def test_unloading_is_karsan_and_jirsa(args):
    c = golden.concrete_constants(args)
    for eta in (0.1, 0.5, 1.0, 1.5, 1.99, 2.5):
        eps_min = eta * args[E0]
        if eps_min < args[ECU]:
            continue
        plastic = args[E0] * (0.145 * eta**2 + 0.13 * eta if eta < 2 else 0.707 * (eta - 2) + 0.834)
        stress, _ = envelope(eps_min, c)
        eps_end, slope, _ = unloading(eps_min, 0.0, c)
        if stress / (eps_min - plastic) <= args[EC]:
            assert eps_end == pytest.approx(plastic, rel=1e-14)
        else:
            assert slope == args[EC]
        assert slope * (eps_min - eps_end) == pytest.approx(stress, rel=1e-13)
        assert slope <= args[EC]
    # crushed: no stress is left
    assert unloading(1.5 * args[ECU], 0.0, c)[1] == 0.0


def test_tangent_is_the_derivative(args, rng):
    c = golden.concrete_constants(args)
    step = 1e-9
    tested = 0
    for _ in range(4000):
        eps_min = rng.uniform(1.1 * args[ECU], 0.0) * (rng.random() < 0.8)
        eps_max = rng.uniform(0.0, 1.2 * max(args[ETU], 1e-3)) * (rng.random() < 0.8)
        memory = eps_min, eps_max, *unloading(eps_min, eps_max, c)
        strain = rng.uniform(1.3 * args[ECU], 1.3 * max(args[ETU], 1e-3))
        corners = (eps_min, eps_max, memory[2], 0.0, args[ECU], args[FT] / args[EC], args[ETU])
        if min(abs(strain - corner) for corner in corners) < 2 * step:
            continue
        difference = (stress_tangent(strain + step, *memory, c)[0] - stress_tangent(strain - step, *memory, c)[0]) / (
            2 * step
        )
        tangent = stress_tangent(strain, *memory, c)[1]
        # the limits allow for round-off over the step and for the third derivative (r^2/e0^2 times the stress)
        assert tangent == pytest.approx(difference, rel=1e-6, abs=1e-5 * args[EC])
        tested += 1
    assert tested > 3900


def test_tension_closes_to_zero_strain_and_a_gap_stays_open():
    """After crushing and cracking the stress is zero between the plastic strain and zero; tension starts at zero."""
    c = golden.concrete_constants(golden.COVER)
    eps_end, slope, tension_slope = unloading(-0.003, 0.0005, c)
    memory = -0.003, 0.0005, eps_end, slope, tension_slope
    assert eps_end < -1e-4
    assert stress_tangent(0.5 * eps_end, *memory, c) == (0.0, 0.0)
    assert stress_tangent(0.0002, *memory, c)[0] == pytest.approx(0.4 * envelope(0.0005, c)[0], rel=1e-14)


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
