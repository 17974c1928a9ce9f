"""Steel coupon: the law of the bars of the column against its closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    Measurements,
    Posterior,
    SimulationFailed,
    Steel,
    TruncatedNormal,
    plot_response,
    propagate,
)
from fe_likelihoods.kernels import reinforcing_steel
from tutorials.steel_coupon import PARAMETERS, SteelCoupon

STEEL = Steel(fy=450e6, fu=650e6, es=200e9, esh=5e9, hardening_strain=0.01, ultimate_strain=0.12)
FIELDS = dict(zip(PARAMETERS, ("fy", "fu", "es", "esh", "hardening_strain", "ultimate_strain"), strict=True))
CYCLES = np.concatenate([np.linspace(a, b, 15) for a, b in ((0, 0.02), (0.02, -0.015), (-0.015, 0.01), (0.01, -0.03))])


@pytest.fixture(scope="module")
def coupon():
    return SteelCoupon(CYCLES, STEEL)


def test_monotonic_loading_reproduces_the_defining_values(coupon):
    """Slope Es at the start, fy on the plateau, fu and zero slope at the ultimate strain."""
    strain = np.array([0.0, 5e-4, 0.005, 0.01, 0.1199, 0.12, 0.1201])
    stress = coupon.with_record(strain).simulate(np.ones(6))[0]
    assert stress[0] == 0.0
    assert stress[1] == pytest.approx(200e9 * 5e-4, rel=5e-3)
    assert stress[2:4] == pytest.approx(450e6, rel=0.01)
    assert stress[5] == pytest.approx(650e6, rel=1e-9)
    assert np.abs(np.diff(stress[4:])).max() < 1e-4 * 650e6
    np.testing.assert_allclose(coupon.with_record(-strain[:4]).simulate(np.ones(6))[0], -stress[:4], rtol=0.03)


def test_cycles_equal_those_of_a_bar_of_the_column(coupon):
    constants, state = np.zeros(reinforcing_steel.N_CONSTANTS), np.zeros(reinforcing_steel.N_STATE)
    reinforcing_steel.constants(450e6, 650e6, 200e9, 5e9, 0.01, 0.12, constants)
    stress = [reinforcing_steel.update(strain, state, constants)[0] for strain in CYCLES]
    np.testing.assert_array_equal(coupon.simulate(np.ones(6))[0], stress)
    assert (
        np.trapezoid(stress[15:], CYCLES[15:]) > 450e6 * 0.05
    )  # dissipated energy, about 2 fy times the plastic strain


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_are_multiples_of_nominal_values(coupon, name):
    field = FIELDS[name]
    other = replace(coupon, steel=replace(STEEL, **{field: 1.1 * getattr(STEEL, field)}))
    one = replace(coupon, parameters=(name,))
    np.testing.assert_array_equal(one.simulate([1.1]), other.simulate(np.ones(6)))
    assert np.abs(one.simulate([1.1]) - one.simulate([1.0])).max() > 1e5
    assert other.fingerprint != coupon.fingerprint != one.fingerprint
    assert one.nominal == coupon.nominal


def test_the_response_is_plotted_per_step(coupon):
    pytest.importorskip("matplotlib").use("agg")
    (axes,) = plot_response(coupon, np.ones(6)).axes
    assert axes.get_xlabel() == "step" and "MPa" in axes.get_ylabel()


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ([-1, 1, 1, 1, 1, 1], "fy = -"),
        ([1, 1, np.nan, 1, 1, 1], "Es = nan"),
        ([1, 0.5, 1, 1, 1, 1], "no hardening"),
        ([1, 0.695, 1, 1, 1, 1], "too close to fy"),
        ([1, 1, 1, 0.01, 1, 1], "Esh = 5e"),
        ([1, 1, 0.1, 1, 1, 1], "plateau"),
        ([1, 1, 1, 1, 20, 1], "plateau"),
    ],
)
def test_parameters_that_describe_no_steel_fail(coupon, theta, words):
    with pytest.raises(SimulationFailed, match=words):
        coupon.simulate(theta)


def test_a_coupon_works_as_a_model(coupon, rng):
    """Likelihood, posterior and prediction under other strains; the true parameters are the most probable of three."""
    model = replace(coupon, parameters=("fy", "Es"))
    truth = np.array([1.05, 0.98])
    stress = model.simulate(truth)
    data = Measurements(model.channels, 1.0, stress + 5e6 * rng.standard_normal(stress.shape))
    prior = {"fy": TruncatedNormal(1.0, 0.1), "Es": TruncatedNormal(1.0, 0.1), "sigma_stress": HalfNormal(2e7)}
    posterior = Posterior(FELikelihood(model, data), prior)
    points = np.array([[*truth, 5e6], [1.05, 1.08, 5e6], [1.0, 0.98, 5e6]])
    log_prob = posterior(points)
    assert log_prob[0] > log_prob[1:].max() + 5.0
    ahead = propagate(posterior, points, record=CYCLES[:20], from_state="virgin", progress=False)
    np.testing.assert_allclose(
        ahead.mean[0], np.mean([model.simulate(p[:2])[0, :20] for p in points], axis=0), rtol=1e-6
    )
