"""The column compared with OpenSees, run here with the same record and the same fibers.

The stored reference results cover some cases. These tests run OpenSees itself for the bundled record, the preset of the
tested column and options of the model, under base acceleration and imposed displacement.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.models.rc_column_materials import ColumnAnalysis
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, bridge_column_data
from fe_likelihoods.signals.channels import relative_errors
from fe_likelihoods.signals.records import DisplacementHistory
from tests.opensees_column import CORE, INCH, KIP, STEEL, peer_of, push, require_opensees, shake

NOMINAL, PAPER = np.ones(5), np.array(list(BRIDGE_COLUMN_MEANS.values()))
tight = partial(ColumnAnalysis, tolerance=1e-11)
TOLERANCE = 1e-10  # OpenSees', in inch and radian
CASES = {
    "nominal": (NOMINAL, 1.0, {}),
    "paper": (PAPER, 1.0, {}),
    "strong": (PAPER, 4.0, {}),
    "linear geometry": (NOMINAL, 1.0, dict(analysis=tight(geometry="linear"))),
    "one element of five points": (NOMINAL, 1.0, dict(analysis=tight(n_elements=1, n_points=5))),
    "four elements of four points": (PAPER, 1.0, dict(analysis=tight(n_elements=4, n_points=4))),
    "rotational inertia": (NOMINAL, 1.0, dict(rotational_inertia=1e6)),
}


@pytest.fixture(scope="module", autouse=True)
def opensees():
    require_opensees()


@pytest.fixture(scope="module")
def record():
    """The first six seconds of the bundled record, which include the peak."""
    return bridge_column_data().record.trim(0.0, 6.0)


@pytest.mark.parametrize("case", CASES)
def test_base_acceleration(record, case):
    theta, scale, changes = CASES[case]
    model = RCColumn.lhpost(record.scale(scale), **(dict(analysis=tight()) | changes))
    peer = shake(peer_of(model, theta), model.loading.acceleration / INCH, record.dt, TOLERANCE)
    assert peer.response.shape == (3, record.n_steps), "OpenSees did not finish"
    history = model.history(theta)
    names = ("relative displacement", "absolute acceleration", "vertical displacement")
    got = np.array([history[name] for name in names]) / INCH
    # events like cracks sometimes amplify round-off: two correct programs differ by up to 2.5e-4
    assert relative_errors(got - peer.response, peer.response).max() < 1e-3
    if scale == 1.0:
        assert relative_errors(got - peer.response, peer.response).max() < 1e-8


def sensors(model):
    """Outputs of `model`, and for each the recorders of OpenSees, the factor of their sum, and its unit.

    The element of OpenSees has its second axis against the direction of loading, and counts rotations anticlockwise.
    """
    per_element = model.analysis.n_points
    half, radius = model.height / model.analysis.n_elements, 0.5 * model.diameter
    bar = model.bar_circle_radius

    def at(section, row):  # of all sections, from the base
        element, point = divmod(section, per_element)
        return (element + 1, "section", point + 1, "deformation", row)

    def fiber(section, position, material):
        element, point = divmod(section, per_element)
        return (element + 1, "section", point + 1, "fiber", -position / INCH, 0.0, material, "stressStrain", 1)

    heights = model.section_heights
    core, _, bars = model.section.fibers()
    inner = core[-3, 0]
    assert abs(bars[0, 0] + bar) < 1e-12 * radius  # the outermost bar of the other side
    return {
        "base_moment": ([(1, "section", 1, "force", 1)], -1.0, KIP * INCH),
        "base_shear": ([(1, "globalForce", 0)], -1.0, KIP),
        "axial_force": ([(1, "section", 1, "force", 0)], 1.0, KIP),
        "curvature@0": ([at(0, 1)], -1.0, 1.0 / INCH),
        f"curvature@{heights[1]}": ([at(1, 1)], -1.0, 1.0 / INCH),
        f"curvature@{heights[-2]}": ([at(len(heights) - 2, 1)], -1.0, 1.0 / INCH),
        f"strain@0:{bar}": ([fiber(0, bar, STEEL)], 1.0, 1.0),
        f"strain@0:{-bar}": ([fiber(0, -bar, STEEL)], 1.0, 1.0),
        f"strain@{heights[1]}:{-inner}": ([fiber(1, -inner, CORE)], 1.0, 1.0),
        "strain@0:0": ([at(0, 0)], 1.0, 1.0),
        f"rotation@0:{half}": ([("nodeDisp", 2, 3)], -1.0, 1.0),
        f"rotation@0:{model.height}": ([("nodeDisp", model.analysis.n_elements + 1, 3)], -1.0, 1.0),
    }


def deviations(model, theta, recorded, wanted):
    """Relative root mean square difference of each sensor from the recorder of OpenSees."""
    response = model.simulate(theta)
    return {
        name: float(relative_errors(row / unit - factor * column, factor * column))
        for (name, (_, factor, unit)), row, column in zip(wanted.items(), response, recorded.T, strict=True)
    }


def test_sensors_under_base_acceleration(record):
    """Forces, curvatures, strains of bars and concrete, and rotations are what OpenSees records."""
    model = RCColumn.lhpost(record, analysis=tight())
    wanted = sensors(model)
    recorders = [recorder for column, _, _ in wanted.values() for recorder in column]
    peer = shake(peer_of(model, PAPER), record.acceleration / INCH, record.dt, TOLERANCE, recorders)
    errors = deviations(replace(model, outputs=tuple(wanted)), PAPER, peer.recorded, wanted)
    assert max(errors.values()) < 1e-8, errors


def test_motions_and_stresses_over_the_height(record):
    """Of a column with a mass: its nodes move, and its bars and its concrete are stressed, as in OpenSees."""
    model = RCColumn.lhpost(record.scale(2.0), column_mass=2.05e4, analysis=tight(n_elements=3))
    heights, bar = model.height / 3.0 * np.arange(1, 4), model.bar_circle_radius
    core = model.section.fibers()[0][-3, 0]
    wanted = {}
    for node, height in enumerate(heights, 2):
        for kind, recorder in (("displacement", "Disp"), ("velocity", "Vel"), ("relative_acceleration", "Accel")):
            wanted[f"{kind}@{height}"] = ([(f"node{recorder}", node, 1)], 1.0, INCH)
    for name, position, material in (("bar", bar, STEEL), ("bar", -bar, STEEL), ("concrete", -core, CORE)):
        for section, height in ((0, 0.0), (1, heights[0] / 2.0)):
            fiber = ("section", section + 1, "fiber", -position / INCH, 0.0, material, "stressStrain", 0)
            wanted[f"{name}_stress@{height}:{position}"] = ([(1, *fiber)], 1.0, KIP / INCH**2)
    recorders = [recorder for column, _, _ in wanted.values() for recorder in column]
    peer = shake(peer_of(model, PAPER), model.loading.acceleration / INCH, record.dt, TOLERANCE, recorders)
    errors = deviations(replace(model, outputs=tuple(wanted)), PAPER, peer.recorded, wanted)
    assert max(errors.values()) < 1e-6, errors
    assert np.abs(peer.recorded[:, list(wanted).index(f"bar_stress@0.0:{bar}")]).max() > 0.3 * 75.2, "control"


def test_a_wrong_material_is_detected(record):
    """Control: one per cent of one modulus changes far more than the two programs differ by."""
    model = RCColumn.lhpost(record, analysis=tight())
    peer = shake(peer_of(model, NOMINAL), record.acceleration / INCH, record.dt, TOLERANCE)
    other = model.simulate(NOMINAL + np.array([0.01, 0, 0, 0, 0]))
    assert relative_errors(other[1] / INCH - peer.response[0], peer.response[0]) > 1e-3


@pytest.mark.parametrize(
    ("changes", "limit"),
    [({}, 1e-8), (dict(n_elements=3, n_points=4, geometry="linear"), 1e-6)],
    ids=["2 x 3", "3 x 4"],
)
def test_sensors_under_imposed_displacement(changes, limit):
    """Up to a drift of 2 %, with yielding bars; OpenSees stops the fit of their curves after reversals at 1e-4."""
    targets = np.concatenate([np.arange(0.0, 3.0, 0.05), np.arange(3.0, -6.0, -0.05), [-6.0]])
    arguments = dict(parameters=("Ec", "Es", "ft"), analysis=tight(max_increment=1.0, **changes))
    model = RCColumn.lhpost(DisplacementHistory("cycle", targets * INCH), **arguments)
    wanted = sensors(model)
    recorders = [recorder for column, _, _ in wanted.values() for recorder in column]
    peer = push(peer_of(model, NOMINAL[:3]), targets, TOLERANCE, recorders)
    errors = deviations(replace(model, outputs=tuple(wanted)), NOMINAL[:3], peer.recorded, wanted)
    assert max(errors.values()) < limit, errors


@pytest.mark.parametrize("geometry", ["corotational", "linear"])
@pytest.mark.parametrize("theta", [NOMINAL, PAPER], ids=["nominal", "paper"])
def test_imposed_displacement(theta, geometry):
    """Cracking, yielding and reversals, up to a drift of 2 %."""
    corners = [0.0, 1.0, -1.0, 3.0, -3.0, 6.0, -2.0]  # in
    legs = [
        np.linspace(a, b, round(abs(b - a) / 0.05), endpoint=False)
        for a, b in zip(corners[:-1], corners[1:], strict=True)
    ]
    targets = np.append(np.concatenate(legs), corners[-1])
    model = RCColumn.lhpost(
        DisplacementHistory("cycles", targets * INCH),
        parameters=("Ec", "Es", "ft"),
        analysis=tight(geometry=geometry, max_increment=1.0),  # one step per target, as in OpenSees
    )
    peer = push(peer_of(model, theta[[0, 1, 4]]), targets, TOLERANCE)
    assert peer.response.shape == (5, len(targets)), "OpenSees did not finish"
    history = model.history(theta[[0, 1, 4]])
    units = {
        "displacement": INCH,
        "force": KIP,
        "vertical displacement": INCH,
        "rotation": 1.0,
        "base moment": KIP * INCH,
    }
    for row, (name, unit) in zip(peer.response, units.items(), strict=True):
        assert relative_errors(history[name] / unit - row, row) < 1e-7, name
    assert history["force"].max() / KIP > 100.0
