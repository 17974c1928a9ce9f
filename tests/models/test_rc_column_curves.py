"""Stress-strain and moment-curvature curves of the column: closed forms, the simulated column, wrong arguments."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    ColumnAnalysis,
    DisplacementHistory,
    RCColumn,
    SimulationFailed,
    material_curves,
    moment_curvature,
)

ANALYSIS = ColumnAnalysis(geometry="linear", max_increment=1.0, tolerance=1e-11)
REVERSALS = (0.05, -0.05, 0.1, -0.08)  # [m]; beyond, crushing cover has two states of equilibrium


@pytest.fixture(scope="module")
def column():
    corners = np.array([0.0, *REVERSALS])
    history = np.interp(np.linspace(0.0, 4.0, 161), np.arange(5), corners)
    arguments = dict(parameters=("Ec", "Es", "ft"), analysis=ANALYSIS)
    return RCColumn.lhpost(DisplacementHistory("cycles", history), **arguments)


def test_strengths_and_strains_of_the_materials(column):
    core, cover, steel = material_curves(column, np.ones(3))
    peak = 2.0 * column.concrete.fc / column.concrete.ec
    assert -cover.stress.min() == pytest.approx(column.concrete.fc, rel=1e-4)
    assert cover.strain[cover.stress.argmin()] == pytest.approx(-peak, rel=0.02)
    assert -core.stress.min() == pytest.approx(column.confinement.strength_ratio * column.concrete.fc, rel=1e-6)
    assert core.stress.max() == pytest.approx(column.concrete.ft, rel=0.02)  # it cracks between the cycles
    _, _, steel = material_curves(column, np.ones(3), [0.005, column.steel.ultimate_strain])
    assert steel.stress[200] == pytest.approx(column.steel.fy, rel=1e-3)  # on the plateau
    assert steel.stress[-1] == pytest.approx(column.steel.fu, rel=1e-9)
    stiffer = material_curves(column, [1.0, 1.2, 1.0], [1e-5])[2]
    assert stiffer.stress[-1] == pytest.approx(1.2 * column.steel.es * 1e-5, rel=5e-3)


def test_moment_curvature_is_that_of_the_simulated_base(column):
    """The curvatures of the base of a simulated column give its moments and axial strains, through three reversals."""
    history = column.history([1.0, 1.0, 1.0])
    curve = moment_curvature(column, [1.0, 1.0, 1.0], -history["base curvature"])
    assert curve.axial_force == pytest.approx(history["base axial force"][0], rel=1e-9)
    np.testing.assert_allclose(curve.moment, -history["base moment"], atol=1e-6 * np.ptp(history["base moment"]))
    assert np.ptp(curve.moment) > 8e6  # it has yielded
    halved = moment_curvature(column, [1.0, 1.0, 1.0], -history["base curvature"], axial_force=-1e6)
    assert halved.moment.max() < 0.95 * curve.moment.max()


def test_large_curvature_steps_are_divided(column):
    fine = moment_curvature(column, np.ones(3), np.linspace(0.0, 0.04, 100))
    (moment,) = moment_curvature(column, np.ones(3), [0.04]).moment
    assert moment == pytest.approx(fine.moment[-1], rel=0.02)


def test_a_section_that_cannot_carry_its_load_fails(column):
    with pytest.raises(SimulationFailed, match="cannot carry the axial force -9e"):
        moment_curvature(column, np.ones(3), [0.01], axial_force=-9e7)
    with pytest.raises(SimulationFailed, match="Ec"):
        moment_curvature(column, [-1.0, 1.0, 1.0], [0.01])


def test_wrong_arguments(column):
    for curvature in ([[0.01]], [np.nan]):
        with pytest.raises(ValueError, match="vector of finite curvatures"):
            moment_curvature(column, np.ones(3), curvature)
    with pytest.raises(ValueError, match="strains between"):
        material_curves(column, np.ones(3), [5.0])
    with pytest.raises(ValueError, match="one value for each"):
        material_curves(replace(column), np.ones(2))
