"""Reinforced-concrete column: arguments, batches, failures and wrong arguments; `tests.kernels` has its responses."""

import math
import pickle
from dataclasses import fields, replace

import numba
import numpy as np
import pytest

from fe_likelihoods import (
    Bars,
    ColumnAnalysis,
    Concrete,
    DisplacementHistory,
    Hoops,
    LowCycleFatigue,
    RCColumn,
    Record,
    SimulationFailed,
    Steel,
)
from fe_likelihoods.models.rc_column import PARAMETERS
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, bridge_column_data
from fe_likelihoods.signals.channels import relative_errors
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.units import G0
from tests.lines import misfit_batch

NOMINAL = np.ones(5)
PAPER = np.array(list(BRIDGE_COLUMN_MEANS.values()))
PUSHED = ("Ec", "Es", "ft")  # parameters that act under imposed displacement
TIGHT = ColumnAnalysis(tolerance=1e-11)


@pytest.fixture(scope="module")
def strong():
    """Five seconds around the peak of the bundled record, from rest."""
    part = bridge_column_data().record.trim(5.0, 10.0)
    return Record("strong part", part.dt, np.append(0.0, part.acceleration[1:]))


@pytest.fixture(scope="module")
def column(strong):
    return RCColumn.lhpost(strong)


def cycles(*amplitudes, points=20):
    """Reversed cycles of the given amplitudes [m], starting and ending at zero."""
    corners = [0.0] + [sign * a for a in amplitudes for sign in (1.0, -1.0)] + [0.0]
    legs = [np.linspace(a, b, points, endpoint=False) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return DisplacementHistory("cycles", np.concatenate([*legs, [0.0]]))


@pytest.fixture(scope="module")
def pushed():
    return RCColumn.lhpost(cycles(0.02, 0.08, 0.35), parameters=PUSHED)


# --- units and integration -----------------------------------------------------------------------------------


def test_substeps_equal_a_finer_record(strong, column):
    finer = replace(column, analysis=replace(TIGHT, substeps=4)).simulate(NOMINAL)
    resampled = replace(column, loading=strong.resample(strong.dt / 4), analysis=TIGHT).simulate(NOMINAL)
    assert relative_errors(finer - resampled[:, ::4], resampled[:, ::4]).max() < 1e-8
    assert 1e-5 < relative_errors(column.simulate(NOMINAL) - finer, finer).max() < 1e-2


def test_forces_in_the_history_are_in_equilibrium(strong):
    """Without damping, F = -m a at the top."""
    model = RCColumn.lhpost(strong.trim(0.0, 2.0), analysis=TIGHT, a0=0.0, a1=0.0, parameters=("Ec",))
    history = model.history([0.6])
    force = history["force"]
    np.testing.assert_allclose(force, -model.mass * history["absolute acceleration"], rtol=0, atol=1e-6 * np.ptp(force))
    assert np.corrcoef(history["base curvature"], history["base moment"])[0, 1] > 0.9


# --- arguments and parameters ----------------------------------------------------------------------------------------

OTHERS = dict(  # values of arguments that are not numbers, or that are None or zero by default
    axial_load=2.2e6,
    rotational_inertia=1e5,
    fatigue=LowCycleFatigue(),
    column_mass=2e4,
    geometry="linear",
    penetration=0.3,
    peak_strain=0.003,
    first_angle=0.1,
    spiral=True,
    mesh=42,
    area=None,
) | {"hoops.ultimate_strain": 0.1}
PARTS = {"concrete": Concrete, "steel": Steel, "bars": Bars, "hoops": Hoops, "analysis": ColumnAnalysis}
# without effect on one simulation, or too small a one: names, limits and tolerances
IDLE = {"loading", "units", "outputs", "parameters", "collapse_drift", "max_increment", "tolerance"}
ONE_LOADING = {"mass", "rotational_inertia", "a0", "a1", "substeps"}  # act under base acceleration only
VARIED = [(each.name, "") for each in fields(RCColumn) if each.name not in IDLE | {*PARTS}]
VARIED += [(name, each.name) for name, kind in PARTS.items() for each in fields(kind) if each.name not in IDLE]


def varied(model, name, value):
    inner = isinstance(value, dict) and name != "units"
    return replace(model, **{name: replace(getattr(model, name), **value) if inner else value})


@pytest.mark.parametrize(("name", "key"), VARIED)
def test_every_argument_changes_the_response_and_the_fingerprint(strong, pushed, name, key):
    shaken, found = RCColumn.lhpost(strong.scale(3.0)), []
    for model in [shaken] if (key or name) in ONE_LOADING else [shaken, pushed]:
        present = getattr(getattr(model, name), key) if key else getattr(model, name)
        usual = present + 1 if isinstance(present, int) else 1.05 * present if isinstance(present, float) else None
        value = OTHERS.get(f"{name}.{key}", OTHERS.get(key or name, usual))
        other, theta = varied(model, name, {key: value} if key else value), np.ones(len(model.parameters))
        found.append(relative_errors(other.simulate(theta) - model.simulate(theta), model.simulate(theta)).max() > 1e-6)
        assert other.fingerprint != model.fingerprint
    assert any(found)


def test_fingerprint_of_loading_units_and_outputs(strong, column, pushed):
    assert replace(column, loading=strong.scale(1.01)).fingerprint != column.fingerprint
    assert replace(column, loading=strong.trim(0.0, 4.0)).fingerprint != column.fingerprint
    assert replace(column, loading=Record("r", 0.004, strong.acceleration)).fingerprint != column.fingerprint
    assert replace(column, outputs=("displacement",)).fingerprint != column.fingerprint
    assert pushed.fingerprint != replace(pushed, loading=cycles(0.02)).fingerprint
    # display units and names of records do not change a response, hence not the fingerprint
    assert replace(column, units=(("acceleration", "m/s2"),)).fingerprint == column.fingerprint
    renamed = Record("another name", strong.dt, strong.acceleration, "another source")
    assert replace(column, loading=renamed).fingerprint == column.fingerprint
    assert replace(column).fingerprint == column.fingerprint


@pytest.mark.parametrize("name", PARAMETERS)
def test_parameters_are_multiples_of_nominal_values(strong, pushed, name):
    """A factor in theta has the same effect as the same factor on the argument."""
    factor = 1.1
    places = {"Ec": ("concrete", "ec"), "ft": ("concrete", "ft"), "fc": ("concrete", "fc"), "Es": ("steel", "es")}
    places |= {"fy": ("steel", "fy"), "fu": ("steel", "fu"), "Esh": ("steel", "esh")}
    base = RCColumn.lhpost(strong) if name in ("a0", "a1", "mass") else replace(pushed, loading=cycles(0.05, 0.3))
    base = replace(base, penetration=0.2)
    failing = {"Cf": ("fatigue", "cf"), "Cd": ("fatigue", "cd")}
    if name in failing:
        base = replace(base, fatigue=LowCycleFatigue(cf=0.04))
    places |= failing
    if name in places:
        group, key = places[name]
        other = varied(base, group, {key: factor * getattr(getattr(base, group), key)})
    else:
        other = replace(base, **{name: factor * getattr(base, name)})
    free = replace(base, parameters=(name,))
    # bit-equal: the same numbers reach the same kernels
    np.testing.assert_array_equal(free.simulate([factor]), other.simulate(np.ones(len(other.parameters))))
    assert relative_errors(free.simulate([factor]) - free.simulate([1.0]), free.simulate([1.0])).max() > 1e-6
    assert free.nominal[name] == base.nominal[name] > 0.0


def test_outputs_are_chosen_and_ordered(column):
    both = column.simulate(NOMINAL)
    turned = replace(column, outputs=["displacement", "acceleration"])
    assert [channel.name for channel in turned.channels] == ["displacement", "acceleration"]
    np.testing.assert_array_equal(turned.simulate(NOMINAL), both[::-1])
    one = replace(column, outputs=("displacement",))
    np.testing.assert_array_equal(one.simulate(NOMINAL), both[1:])
    assert misfit_batch(one, NOMINAL[None], both[1:]).misfit == 0.0


# --- batches, threads, processes -------------------------------------------------------------------------------------


@pytest.fixture
def threads():
    before = numba.get_num_threads()
    yield numba.set_num_threads
    numba.set_num_threads(before)


def test_a_batch_equals_its_rows_on_any_number_of_threads(column, rng, threads):
    thetas = rng.uniform(0.6, 1.6, size=(7, 5))
    thetas[3, 0] = -1.0
    singles = [None if i == 3 else column.simulate(theta) for i, theta in enumerate(thetas)]
    measured = column.simulate(PAPER)
    for n in {1, numba.config.NUMBA_NUM_THREADS}:
        threads(n)
        response, reasons = column.simulate_batch(thetas)
        misfit, misfit_reasons = misfit_batch(column, thetas, measured)
        assert response.shape == (7, 2, column.n_steps) and misfit.shape == (7, 2)
        assert reasons == misfit_reasons and [bool(reason) for reason in reasons] == [i == 3 for i in range(7)]
        assert np.isnan(response[3]).all() and np.isnan(misfit[3]).all()
        for i, single in enumerate(singles):
            if single is not None:
                np.testing.assert_array_equal(response[i], single)
                np.testing.assert_allclose(misfit[i], ((single - measured) ** 2).sum(axis=1), rtol=1e-13)
    assert column.simulate_batch(np.empty((0, 5))).response.shape == (0, 2, column.n_steps)
    assert misfit_batch(column, np.empty((0, 5)), measured).misfit.shape == (0, 2)


def test_copies_in_other_processes_give_the_same_response(column, pushed):
    for model, theta in ((column, PAPER), (pushed, PAPER[[0, 1, 4]])):
        copy = pickle.loads(pickle.dumps(model))
        assert copy.fingerprint == model.fingerprint
        np.testing.assert_array_equal(copy.simulate(theta), model.simulate(theta))


# --- imposed displacement --------------------------------------------------------------------------------------------


def test_imposed_displacement_is_followed(pushed):
    history = pushed.history(np.ones(3))
    np.testing.assert_allclose(history["displacement"], pushed.loading.displacement, rtol=0, atol=1e-12)
    force = pushed.simulate(np.ones(3))
    assert force.shape == (1, pushed.n_steps) == (1, pushed.loading.n_steps) and pushed.dt == 1.0
    np.testing.assert_array_equal(force[0], history["force"])
    assert abs(force[0, 0]) < 1.0  # [N] gravity causes no lateral force beyond round-off
    assert force[0, 1] > 1e4  # the first increment requires a force
    assert history["base axial force"][0] == pytest.approx(-pushed.mass * G0, rel=1e-6)


@pytest.mark.parametrize("n_elements", [1, 2, 5])
def test_strain_penetration_rotates_the_base(pushed, n_elements):
    """Uncracked, 1/k = H^3/(3 EI) + H^2 l/EI: the base rotates by its curvature times the length l."""
    small = DisplacementHistory("small", [0.0, 1e-7 * pushed.height, -1e-7 * pushed.height])
    analysis = ColumnAnalysis(geometry="linear", n_elements=n_elements)
    rigid = replace(pushed, loading=small, axial_load=0.0, analysis=analysis)
    for share in (0.05, 0.4):
        slipping = replace(rigid, penetration=share * pushed.height)
        forces = [model.simulate(np.ones(3))[0] for model in (rigid, slipping)]
        np.testing.assert_allclose(forces[0][1:] / forces[1][1:], 1.0 + 3.0 * share, rtol=1e-5)


# --- failures --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("theta", "words"),
    [
        ([-1, 1, 1, 1, 1], "Ec = -"),
        ([0, 1, 1, 1, 1], "Ec = 0"),
        ([1, 1, -0.1, 1, 1], "a0"),
        ([1, 1, 1, 1, -1], "ft"),
        ([math.nan, 1, 1, 1, 1], "nan"),
        ([1, math.inf, 1, 1, 1], "inf"),
        ([1, 0.2, 1, 1, 1], "plateau"),
        ([1, 1, 1, 1, 21], "is not below fc = 4.206e"),
        ([1, 1, 1, 1, 1000], "stronger in tension than in compression"),
        ([0.0018, 1, 1, 1, 1], "at a strain above 1: Ec"),
    ],
)
def test_parameters_that_describe_no_column_fail(column, theta, words):
    with pytest.raises(SimulationFailed, match=words) as failure:
        column.simulate(theta)
    assert words in failure.value.reason
    ((row,), (reason,)) = column.simulate_batch([theta])
    assert np.isnan(row).all() and reason == failure.value.reason


def test_damping_and_tensile_strength_may_be_zero(column):
    assert np.isfinite(column.simulate([1, 1, 0, 0, 0])).all()


@pytest.mark.parametrize(
    ("theta", "words"), [([1.0, 0.735, 1.0], "too close to fy"), ([1.0, 1.0, 0.05], "hardening modulus Esh")]
)
def test_steel_whose_law_breaks_down_fails(strong, theta, words):
    """With fu = 1.001 fy, and with a falling hardening branch, the law had stresses up to 1e47 Pa."""
    with pytest.raises(SimulationFailed, match=words):
        RCColumn.lhpost(strong, parameters=("fy", "fu", "Esh")).simulate(theta)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"fu": 1.001 * 518.5e6}, "too close to fy"), ({"esh": 1e8}, "Esh"), ({"fy": 1e308, "es": 1e310}, "positive")],
)
def test_steel_whose_law_breaks_down_is_refused(change, words):
    values = dict(fy=518.5e6, fu=706e6, es=195.8e9, esh=3.144e9, hardening_strain=0.011, ultimate_strain=0.122)
    with pytest.raises(ValueError, match=words):
        Steel(**values | change)


def test_strains_beyond_the_fracture_of_bars_are_reported_once(pushed, caplog):
    """At a drift of 5 % the bars are within the law of the steel, at 20 % they would have fractured."""
    assert 0.3 < pushed.history([1, 1, 1]).beyond_range < 0.6
    assert not caplog.records
    violent = replace(pushed, loading=DisplacementHistory("push", np.linspace(0.0, 0.2 * pushed.height, 40)))
    history = violent.history([1, 1, 1])
    steel = np.abs(history["base axial strain"][-1] - history["base curvature"][-1] * violent.bar_circle_radius)
    assert history.beyond_range >= steel / violent.steel.ultimate_strain > 1.0
    violent.simulate([1, 1, 1])
    assert "exceeds the ultimate strain of the steel, 0.122" in caplog.text and "'Ec': 1.0" in caplog.text
    assert len(caplog.records) == 1, "one warning per model, not one per simulation"


@pytest.mark.parametrize("load", [7e7, 2e8, 5e8])
def test_a_load_beyond_all_capacity_fails(column, load):
    """The squash load is about 60 MN. A crushed column must be a failure, not a response."""
    with pytest.raises(SimulationFailed):
        replace(column, axial_load=load).simulate(NOMINAL)


# --- wrong arguments -------------------------------------------------------------------------------------------------

WRONG = [
    # change, part of the message
    (dict(diameter=-1.2), "positive diameter"),
    (dict(diameter=(48, "in")), "positive diameter"),
    (dict(cover=-0.05), "cover"),
    (dict(cover=0.61), "cover smaller than the radius"),
    (dict(mass=math.inf), "positive mass"),
    (dict(axial_load=math.nan), "axial_load"),
    (dict(a0=-0.7), "a0"),
    (dict(a0=0.0), "non-zero nominal"),
    (dict(analysis=dict(n_elements=0)), "n_elements"),
    (dict(analysis=dict(n_points=1)), "n_points between 2 and 7"),
    (dict(analysis=dict(mesh=41)), "even number"),
    (dict(analysis=dict(geometry="corotationnal")), "geometry"),
    (dict(analysis=dict(substeps=0)), "substeps"),
    (dict(analysis=dict(max_increment=0.0)), "max_increment"),
    (dict(penetration=-0.1), "penetration"),
    (dict(analysis=dict(tolerance=0.0)), "tolerance"),
    (dict(analysis=dict(collapse_drift=0.0)), "collapse_drift"),
    (dict(parameters=("Ec", "Young")), "Young"),
    (dict(parameters=("Ec", "Ec")), "once"),
    (dict(parameters="Ec"), "parameters"),
    (dict(outputs=("force",)), "outputs"),
    (dict(outputs=("acceleration", "acceleration")), "outputs"),
    (dict(units=(("acceleration", "in"),)), "unit"),
    (dict(units={"acc": "g"}), "unit"),
    (dict(loading=np.zeros(10)), "Record or a DisplacementHistory"),
    (dict(concrete=dict(fc=-42e6)), "fc"),
    (dict(concrete=dict(fc=6.1)), "tensile strength between 0 and fc"),  # one of them in ksi
    (dict(concrete=dict(peak_strain=-0.002)), "peak_strain"),
    (dict(concrete=dict(softening_ratio=1.0)), "softening_ratio"),
    (dict(steel=dict(es=29000.0)), "fy/es"),  # one of them in ksi
    (dict(steel=dict(fu=5e8)), "fy < fu"),
    (dict(steel=dict(hardening_strain=0.001)), "hardening_strain"),
    (dict(bars=dict(number=2)), "three bars"),
    (dict(bars=dict(number=100)), "bars that fit"),
    (dict(bars=dict(area=0.0)), "area of bars"),
    (dict(bars=dict(area=1.0)), "area of bars"),  # larger than the section
    (dict(hoops=dict(spacing=0.0)), "spacing of hoops"),
    (dict(hoops=dict(spacing=0.01)), "larger than their diameter"),
    (dict(hoops=dict(spacing=5.0)), "spacing"),  # no confined core between hoops
]


def test_displacements_in_millimetres_are_rejected(pushed):
    largest = 0.6 * pushed.height
    with pytest.raises(
        ValueError, match=r"up to half the height of .* m in 'mm', a drift of 0\.6; convert other units"
    ):
        pushed.with_record(DisplacementHistory("mm", [0.0, 0.1, -largest]))
    assert pushed.with_record(DisplacementHistory("m", [0.0, 0.1, -0.8 * largest])).n_steps == 3


@pytest.mark.parametrize(("change", "words"), [pytest.param(*case, id=str(case[0])) for case in WRONG])
def test_wrong_arguments_are_rejected(column, change, words):
    ((name, value),) = change.items()
    with pytest.raises(ValueError, match="expected .*; got .*; .*") as error:
        varied(column, name, value)
    assert words in str(error.value)


def test_damping_is_no_parameter_under_imposed_displacement():
    with pytest.raises(ValueError, match="expected parameters that act .* got .*'a0', 'a1'.* leave damping out"):
        RCColumn.lhpost(cycles(0.01))


@pytest.mark.parametrize("theta", [np.ones(4), np.ones(6), np.ones((1, 5)), 1.0])
def test_theta_of_the_wrong_length(column, theta):
    with pytest.raises(ValueError, match=r"expected one value for each of .*'Ec'.*\(5,\); got \("):
        column.simulate(theta)


def test_a_jump_of_the_steel_law_is_crossed(shared):
    """The stress of a bar jumps by 35 MPa at zero stress: there is no equilibrium on either side, for any step size."""
    path = shared / "records" / "loma_prieta_1989_apeel2_redwood_city_133.csv"
    record = read_record(path).scale(0.85).trim(0.0, 12.0)
    theta = [0.5284587364146686, 1.0214677685625493, 0.32405312400652414, 0.9625611775286573, 1.432206729992988]
    crossed = RCColumn.lhpost(record).history(theta)
    assert crossed.retries == 11  # of the step, its half, ..., its 1024th part; a larger tolerance is never reached
    response = crossed.values[:2]
    finer = RCColumn.lhpost(record, analysis=ColumnAnalysis(substeps=2)).history(theta).values[:2]
    error = np.sqrt(np.sum((response - finer) ** 2, axis=1) / np.sum(finer**2, axis=1))
    assert np.all(error < 0.02), error
