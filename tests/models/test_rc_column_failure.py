"""Columns whose bars lose strength and fracture: options, parameters, failures and warnings."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import (
    ColumnAnalysis,
    DisplacementHistory,
    EventRatios,
    LowCycleFatigue,
    RCColumn,
    SimulationFailed,
    material_curves,
    moment_curvature,
)
from fe_likelihoods.kernels import bar_fatigue
from fe_likelihoods.models.rc_column_analysis import _reason as reason_of_failure
from fe_likelihoods.prediction.quantities import find_failure
from fe_likelihoods.problems import bridge_column_data
from fe_likelihoods.units import G0
from tests.kernels import golden
from tests.models.tested_columns import read_column

WEAK = LowCycleFatigue(cf=0.09, cd=0.389)


def cycles(*drifts, height=7.3152, points=30):
    """Two reversed cycles of each drift."""
    corners = [0.0, *(sign * drift * height for drift in drifts for _ in range(2) for sign in (1.0, -1.0)), 0.0]
    legs = [np.linspace(a, b, points, endpoint=False) for a, b in zip(corners[:-1], corners[1:], strict=True)]
    return DisplacementHistory("cycles", np.concatenate([*legs, [0.0]]))


@pytest.fixture(scope="module")
def column():
    """Cycles to a drift of 7 %."""
    arguments = dict(parameters=("Ec",), penetration=0.3, analysis=ColumnAnalysis(max_increment=0.01))
    return RCColumn.lhpost(cycles(0.01, 0.03, 0.05, 0.07), **arguments)


def test_outer_bars_fracture_first(column):
    damage = replace(column, fatigue=WEAK).history([1.0]).bar_damage
    y = column.section.fibers()[2][:, 0]
    assert damage.shape == y.shape
    order = np.argsort(np.abs(y))
    assert damage[order[-1]] > 1.0
    assert damage[order[0]] < 0.5
    assert column.history([1.0]).bar_damage is None


@pytest.mark.parametrize("cf", [0.036, 0.039])
def test_the_column_goes_on_after_it_has_lost_bars(column, cf):
    """Steps in which bars fractured had no equilibrium nearby, and both simulations failed."""
    model = replace(column, fatigue=LowCycleFatigue(cf=cf, cd=0.389), analysis=ColumnAnalysis(max_increment=0.02))
    history = model.history([1.0])
    assert (history.bar_damage > 1.0).sum() >= 7
    np.testing.assert_allclose(history["displacement"], model.loading.displacement, atol=1e-12)
    # equilibrium at every sample, with the weight and its moment
    weight = model.mass * G0
    np.testing.assert_allclose(history["base axial force"], -weight, rtol=0.03)
    moment = history["force"] * (model.height + history["vertical displacement"]) + weight * history["displacement"]
    np.testing.assert_allclose(-history["base moment"], moment, atol=1e-5 * np.abs(moment).max())


def test_a_loss_of_strength_beyond_all_strength_fails(column):
    model = replace(column, fatigue=WEAK, parameters=("Cd",))
    with pytest.raises(SimulationFailed, match=r"Cd = 0\.0389 is below Cf = 0\.09"):
        model.simulate([0.1])


def test_the_prior_of_fatigue_is_the_population_of_columns_and_bars():
    """Geometric mean of three columns of a series, a column of another one, and bars."""
    series = (0.161 * 0.138 * 0.138) ** (1 / 3)
    population = EventRatios(np.array([series, 0.207, 0.26]), prior_sd=0.25, prior_events=6)
    for fatigue in (LowCycleFatigue(), LowCycleFatigue(cf=0.1)):
        (prior,) = fatigue.prior().values()
        probabilities = [0.05, 0.25, 0.5, 0.75, 0.95]
        stated = fatigue.cf * prior.ppf(probabilities)
        np.testing.assert_allclose(stated, population.quantile(probabilities), rtol=0.05)


@pytest.mark.parametrize("history", ["2017_Lehman_415", "2013_Hose_SRPH1", "2019_Lehman_1015", "2020_Lehman_407"])
def test_measured_columns_fail_within_the_prior_of_fatigue(shared, history):
    """Displacement paths until failure of real columns, at the 5 and 95 % quantiles of `Cf`; others are nominal."""
    model, measured, _ = read_column(shared / "measured" / "rc_column_cyclic", f"{history}.csv", 8)
    displacement = model.loading.displacement

    def path(force):
        return np.abs(np.diff(displacement[: find_failure(force, displacement)])).sum()

    (prior,) = model.fatigue.prior().values()
    low, literature, high = (path(model.simulate([cf])[0]) for cf in (prior.ppf(0.05), 1.0, prior.ppf(0.95)))
    assert low < path(measured) < literature <= high


def test_a_drift_beyond_the_limit_is_a_collapse():
    """The simulation ends at the first sample beyond the limit; other limits change no bit."""
    record = bridge_column_data().record.scale(3.0).trim(5.0, 11.0)
    model = RCColumn.lhpost(record)
    whole = model.simulate(np.ones(5))
    drift = np.abs(whole[1]) / model.height
    with pytest.raises(SimulationFailed) as error:
        limited = replace(model, analysis=ColumnAnalysis(collapse_drift=0.5 * drift.max()))
        limited.simulate(np.ones(5))
    first = np.argmax(drift > 0.5 * drift.max())
    assert error.value.reason.startswith("collapse")
    assert f"at t = {first * model.dt:.4g} s" in error.value.reason
    before = limited.first((first - 1) * model.dt)
    np.testing.assert_array_equal(before.simulate(np.ones(5)), whole[:, :first])
    higher = replace(model, analysis=ColumnAnalysis(collapse_drift=1.001 * drift.max()))
    np.testing.assert_array_equal(higher.simulate(np.ones(5)), whole)


def test_a_column_without_its_bars_has_collapsed_and_one_with_most_of_them_has_failed(column):
    """The simulation that fails has lost three quarters of its bars; the reason is the one that the larger part has."""
    model = replace(column, fatigue=LowCycleFatigue(cf=0.036, cd=0.389), analysis=ColumnAnalysis(max_increment=0.02))
    with pytest.raises(SimulationFailed, match="bars with 78% of the area") as error:
        replace(model, axial_load=16e6).simulate([1.0])
    assert error.value.reason.startswith("collapse")
    sections = golden.column(golden.circle(), bars_fail=True).sections
    for fractured, collapsed in ((1, False), (sections.steel_memory.shape[1], True)):
        sections.steel_memory[0, :fractured, bar_fatigue.FRACTURED] = 1.0
        reason = reason_of_failure(7, 20, "", 3, sections)
        assert "had fractured before" in reason and reason.startswith("collapse") == collapsed


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(analysis=None), r"expected ColumnAnalysis\(...\) as analysis"),
        (dict(parameters=("Cf",)), "add fatigue=LowCycleFatigue"),
        (dict(fatigue=0.26), r"expected LowCycleFatigue\(...\) as fatigue"),
    ],
)
def test_wrong_options(column, changes, message):
    with pytest.raises(ValueError, match=message):
        replace(column, **changes)


def test_wrong_values():
    for values, message in (
        ({"cf": 0.0}, "positive cf"),
        ({"alpha": 2.0}, "alpha of at most 1"),
        ({"cf": 0.26, "cd": 0.2}, "cd of at least cf"),
    ):
        with pytest.raises(ValueError, match=message):
            LowCycleFatigue(**values)


def test_the_warning_about_fracture_names_the_option(column, caplog):
    """Without fatigue, and with a fatigue under which no bar fractures; there is none where a bar fractures."""
    brittle = replace(column.steel, ultimate_strain=0.03)
    for fatigue, advice in ((None, r"fatigue=LowCycleFatigue()"), (LowCycleFatigue(cf=5.0, cd=10.0), "a smaller cf")):
        model = replace(column, steel=brittle, fatigue=fatigue)
        with caplog.at_level(logging.WARNING):
            caplog.clear()
            assert model.history([1.0]).beyond_range > 1.0
        assert advice in caplog.text
        assert advice in model.range_remark
    model = replace(column, steel=brittle, fatigue=WEAK)
    assert model.history([1.0]).bar_damage.max() > 1.0
    assert not model.range_remark


def test_material_and_section_curves_include_the_failure(column):
    model = replace(column, fatigue=WEAK)
    strains = [0.03, -0.03] * 6
    curves = [material_curves(m, [1.0], strains)[2].stress for m in (column, model)]
    assert np.abs(curves[0] - curves[1]).max() > 50e6

    there = np.interp(np.arange(161) / 20, np.arange(9), [0.0, *[0.04, -0.04] * 4])
    moments = [moment_curvature(m, [1.0], there).moment for m in (column, model)]
    assert abs(moments[1][-1]) < 0.9 * abs(moments[0][-1])
