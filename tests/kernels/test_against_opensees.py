"""The column compared with OpenSees, run here with the same record and the same fibers.

The stored reference results cover some cases. These tests run OpenSees itself for the bundled record, the preset of the
tested column and options of the model, under base acceleration and imposed displacement.
"""

import numpy as np
import pytest

from fe_likelihoods import rrmse
from fe_likelihoods.models.rc_column import Patches, RCColumn
from fe_likelihoods.problems import BRIDGE_COLUMN_MEANS, bridge_column_data
from fe_likelihoods.signals.records import DisplacementHistory
from tests.opensees_column import INCH, KIP, peer_of, push, require_opensees, shake

NOMINAL, PAPER = np.ones(5), np.array(list(BRIDGE_COLUMN_MEANS.values()))
TIGHT = dict(tolerance=1e-11, element_tolerance=1e-12 * KIP * INCH)
TOLERANCE = 1e-10  # OpenSees', in inch and radian
CASES = {
    "nominal": (NOMINAL, 1.0, {}),
    "paper": (PAPER, 1.0, {}),
    "strong": (PAPER, 4.0, {}),
    "linear geometry": (NOMINAL, 1.0, dict(geometry="linear")),
    "one element of five points": (NOMINAL, 1.0, dict(n_elements=1, n_points=5)),
    "four elements of four points": (PAPER, 1.0, dict(n_elements=4, n_points=4)),
    "rotational inertia, no vertical mass": (NOMINAL, 1.0, dict(rotational_inertia=1e6, vertical_mass=False)),
    "patches": (NOMINAL, 1.0, dict(mesh=Patches())),
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
    model = RCColumn.lhpost(record.scale(scale), **(TIGHT | changes))
    peer = shake(peer_of(model, theta), model.loading.acceleration / INCH, record.dt, TOLERANCE)
    assert peer.response.shape == (3, record.n_steps), "OpenSees did not finish"
    history = model.history(theta)
    names = ("relative displacement", "absolute acceleration", "vertical displacement")
    got = np.array([history[name] for name in names]) / INCH
    # events like cracks sometimes amplify round-off: two correct programs differ by up to 2.5e-4
    assert rrmse(got, peer.response).max() < 1e-3
    if scale == 1.0:
        assert rrmse(got, peer.response).max() < 1e-8


def test_a_wrong_material_is_detected(record):
    """Control: one per cent of one modulus changes far more than the two programs differ by."""
    model = RCColumn.lhpost(record, **TIGHT)
    peer = shake(peer_of(model, NOMINAL), record.acceleration / INCH, record.dt, TOLERANCE)
    other = model.simulate(NOMINAL + np.array([0.01, 0, 0, 0, 0]))
    assert rrmse(other[1] / INCH, peer.response[0]) > 1e-3


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
        geometry=geometry,
        max_increment=1.0,  # one step per target, as in OpenSees
        **TIGHT,
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
        assert rrmse(history[name] / unit, row) < 1e-7, name
    assert history["force"].max() / KIP > 100.0
