"""Isolated bridge: reference results, closed forms, orders of convergence, energy, invariances, wrong arguments."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import IsolatedBridge, Record, SimulationFailed
from fe_likelihoods.models.isolated_bridge_bearings import OF_A_PIER, Bearing, Damper, Pier, Rubber, at_pier

PART = Path(__file__).parents[1] / "kernels" / "data" / "isolated_bridge.npz"
PIER_1, PIER_2 = (tuple(at_pier(name, i) for name in OF_A_PIER) for i in (1, 2))
LIMIT = 1e-3
"""Largest error of the default step, as a fraction of the peak of each channel."""
NO_RUBBER = Rubber(skeleton=(0.0,) * 6, half_loop=(0.0,) * 3)
FEEBLE = Damper(stiffness=1e-3, viscosity=1e-6)
STIFF = Pier(inertia=3.02e-1)
G = 9.81


def shaking(rng, duration=4.0, dt=0.005, peak=8.0) -> Record:
    """Record of smooth noise that starts and ends at zero."""
    n = round(duration / dt) + 1
    noise = np.convolve(rng.standard_normal(n), np.hanning(25), mode="same") * np.sin(np.linspace(0.0, np.pi, n))
    return Record("noise", dt, peak * noise / np.abs(noise).max())


def worst(response, reference, peak) -> float:
    """Largest error of any channel, as a fraction of its peak."""
    return float((np.abs(response - reference).max(axis=-1) / peak).max())


@pytest.fixture(scope="module")
def part():
    return np.load(PART)


# ------------------------------------------------------------------ reference results


def test_reference_results_in_the_repository(part):
    model = IsolatedBridge(Record("own", float(part["dt"]), part["ag"]), every=8, outputs=tuple(part["channels"]))
    for theta, reference, peak in zip(part["theta"], part["Y"], part["peak"], strict=True):
        assert worst(model.simulate(theta), reference, peak) < LIMIT


@pytest.mark.parametrize("file", ["setA", "own_records"])
def test_every_reference_case(shared, file):
    golden = np.load(shared / "golden" / "isolated_bridge" / f"{file}.npz")
    for k in (0, 1):
        record = Record("golden", float(golden[f"dt{k}"]), golden[f"ag{k}"])
        model = IsolatedBridge(record, every=2, outputs=tuple(golden["channels"]))
        batch = model.simulate_batch(golden["theta"])
        assert not any(batch.reasons)
        errors = [worst(y, *pair) for y, *pair in zip(batch.response, golden[f"Y{k}"], golden[f"peak{k}"], strict=True)]
        assert max(errors) < LIMIT


# ------------------------------------------------------------------ closed forms


def test_a_block_on_a_sliding_table():
    """Rigid piers, friction only: the deck slides at the acceleration a - mu g; below mu g it moves with the table."""
    mu = 0.1
    bearing = Bearing(load=70e3, f_min=mu, df=0.0)
    model = IsolatedBridge(
        Record("step", 0.01, np.full(101, 3.0)),
        deck_mass=140e3 / G,
        piers=(STIFF, STIFF),
        bearings=(bearing, bearing),
        dampers=(FEEBLE, FEEBLE),
        rubber=NO_RUBBER,
        friction="coulomb",
        step=0.25e-3,
        parameters=("fmin_1",),
        outputs=("Ud", "acc_d", "Ub_1"),
    )
    displacement, acceleration, _ = model.simulate([1.0])
    time = model.record.time
    late = 0.3e-3 / time[-1]  # the piers bend for a quarter of their period before the bearings slide
    np.testing.assert_allclose(displacement, -0.5 * (3.0 - mu * G) * time**2, atol=late * abs(displacement[-1]))
    np.testing.assert_allclose(acceleration[1:], mu * G, rtol=1e-6)
    gentle = model.with_record(Record("gentle", 0.01, 0.9 * mu * G * np.sin(np.linspace(0.0, 12.0, 101))))
    _, acceleration, bearing_displacement = gentle.simulate([1.0])
    assert np.abs(bearing_displacement).max() < 1e-7  # at rest at every step; the table reverses in between
    np.testing.assert_allclose(acceleration, gentle.record.acceleration, atol=0.01 * mu * G)  # corners shake the piers


# ------------------------------------------------------------------ convergence and energy


def test_the_instants_of_stick_and_slip_do_not_depend_on_the_step(rng):
    """Every sample of every channel agrees with a much smaller step: no sample is on the wrong side of a jump."""
    for scale in (0.1, 1.0):
        model = IsolatedBridge(shaking(rng, duration=4.0).scale(scale), friction="coulomb")
        fine = replace(model, step=5e-6).simulate(np.ones(10))
        peak = np.abs(fine).max(axis=1, keepdims=True)
        assert np.abs((model.simulate(np.ones(10)) - fine) / peak).max() < 1e-3
        # control: steps of a sample leave the oscillation of the stuck piers out
        assert np.abs((replace(model, step=model.record.dt).simulate(np.ones(10)) - fine) / peak).max() > 1e-3


# ------------------------------------------------------------------ invariances


def test_means_of_the_piers(rng):
    record = shaking(rng, duration=1.0)
    both = IsolatedBridge(record, outputs=PIER_1 + PIER_2).simulate(np.ones(10))
    names = ("mean_Ub", "mean_Fb", "mean_drift", "mean_shear", "mean_acc_p")
    np.testing.assert_allclose(
        IsolatedBridge(record, outputs=names).simulate(np.ones(10)), 0.5 * (both[:5] + both[5:]), rtol=1e-9, atol=1e-9
    )


def test_a_batch_equals_its_rows(rng):
    model = IsolatedBridge(shaking(rng, duration=1.0), outputs=PIER_1)
    thetas = rng.uniform(0.5, 1.5, (5, 10))
    thetas[3, 6] = -1.0
    batch = model.simulate_batch(thetas)
    assert "Kd_1" in batch.reasons[3]
    assert np.isnan(batch.response[3]).all()
    for i in (0, 1, 2, 4):
        np.testing.assert_array_equal(batch.response[i], model.simulate(thetas[i]))


def test_fingerprint_changes_with_what_changes_the_response(rng):
    model = IsolatedBridge(shaking(rng, duration=1.0))
    others = [
        replace(model, step=0.5e-3),
        replace(model, friction="coulomb"),
        replace(model, outputs=("Ub_1",)),
        replace(model, bearings=(Bearing(a=25.0), model.bearings[1])),
        replace(model, vertical=model.record.scale(0.1)),
        model.with_record(model.record.scale(1.01)),
    ]
    assert len({m.fingerprint for m in [model, *others]}) == 7
    assert model.fingerprint == replace(model).fingerprint


# ------------------------------------------------------------------ beyond the range, wrong arguments


def test_displacements_beyond_the_law_of_the_rubber_are_reported_once(rng, caplog):
    gentle = IsolatedBridge(shaking(rng), outputs=("Ub_1", "Ub_2"))
    assert np.abs(gentle.simulate(np.ones(10))).max() < 0.06
    assert not caplog.records
    violent = gentle.with_record(gentle.record.scale(6.0))
    assert 0.06 < np.abs(violent.simulate(np.ones(10))).max() < 6.0
    violent.simulate(np.ones(10))
    assert "exceeds the 60.0 mm" in caplog.text
    assert len(caplog.records) == 1, "one warning per model, not one per simulation"


@pytest.mark.parametrize("name", ["fmin_1", "df_2", "a_1", "Kd_2", "C0_1"])
def test_negative_parameters_fail(rng, name):
    model = IsolatedBridge(shaking(rng, duration=1.0))
    theta = np.ones(10)
    theta[model.parameter_names.index(name)] = -0.1
    with pytest.raises(SimulationFailed, match=name):
        model.simulate(theta)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"record": np.zeros(10)}, "Record"),
        ({"step": 0.3e-3}, "divides the record's 0.005"),
        ({"step": -1.0}, "positive step"),
        ({"outputs": ("Ub_1", "Ub_3")}, "Ub_3"),
        ({"outputs": 7}, "means over the piers"),
        ({"outputs": ("Ub_1", "Ub_1")}, "once"),
        ({"parameters": ("fmin",)}, "fmin_1"),
        ({"friction": "smooth"}, "bouc-wen"),
        ({"piers": (Pier(),)}, "two of Pier"),
        ({"every": 0}, "every"),
        ({"deck_mass": math.nan}, "deck_mass"),
        ({"bearings": (Bearing(), Bearing(gamma=0.8))}, "gamma"),
        ({"bearings": (Bearing(df=0.0), Bearing())}, "df_1"),
    ],
)
def test_wrong_arguments_are_rejected(rng, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(IsolatedBridge(shaking(rng, duration=1.0)), **changes)


def test_default_step_divides_any_step_of_a_record():
    for dt in (1e-5, 1e-3, 1.0 / 256.0, 5e-3, 0.02 / 3.0):
        model = IsolatedBridge(Record("flat", dt, np.zeros(5)))
        divisions = dt / model.integration_step
        assert divisions == pytest.approx(max(1, math.ceil(1e3 * dt / 0.25 - 1e-6)), rel=1e-9)
    assert replace(model, step=dt).integration_step == dt
    law = IsolatedBridge(Record("flat", 5e-3, np.zeros(5)))
    assert law.integration_step == 0.25e-3  # to the bit, where it divides


def test_vertical_motion_must_have_the_same_samples(rng):
    model = IsolatedBridge(shaking(rng, duration=1.0))
    with pytest.raises(ValueError, match="vertical"):
        replace(model, vertical=shaking(rng, duration=2.0))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Pier(length=-1.0),
        lambda: Bearing(f_min=0.0),
        lambda: Bearing(gamma=0.4),
        lambda: Damper(viscosity=math.inf),
        lambda: Damper(count=1.5),
        lambda: Rubber(skeleton=(1.0,)),
        lambda: Rubber(skeleton=(100.0, -5000.0, 0, 0, 0, 0)),
        lambda: Rubber(half_loop=(-1.0, 0.0, 0.0)),
    ],
)
def test_impossible_parts_are_rejected(make):
    with pytest.raises(ValueError, match="expected"):
        make()
