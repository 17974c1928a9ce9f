"""Figures of structures: responses, hysteresis loops and sections, against the values of the models."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import Bars, plot_hysteresis, plot_section, plot_sensors
from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.models.rc_column import RCColumn
from fe_likelihoods.problems import bridge_column_data, isolated_bridge_data
from fe_likelihoods.signals.records import DisplacementHistory
from tests.plots.reading import shows, texts


def test_hysteresis_of_the_bridge():
    bridge = IsolatedBridge(isolated_bridge_data().record.trim(0.0, 2.0), every=2, step=1e-3)
    first, second = plot_hysteresis(bridge, np.ones(10)).axes
    moved, force = replace(bridge, every=1, outputs=("Ub_2", "Fb_2")).simulate(np.ones(10))
    x, y = second.lines[2].get_data()  # after the two lines through the origin
    np.testing.assert_allclose(x, 1e3 * moved)
    np.testing.assert_allclose(y, 1e-3 * force)
    assert shows(second, [second.lines[2]])
    assert second.get_xlabel() == "bearing displacement [mm]" and first.get_ylabel() == "isolator force [kN]"


def test_hysteresis_of_a_shaken_column():
    motion = bridge_column_data().record.resample(8 / 256).trim(5.0, 8.0)
    column = RCColumn.lhpost(motion, parameters=("Ec",))
    history = column.history([0.6])
    section, top = plot_hysteresis(column, [0.6]).axes
    assert section.get_xlabel() == "curvature [1/in]" and section.get_ylabel() == "moment [kip in]"
    kip = 4448.2216152605
    x, y = section.lines[2].get_data()
    np.testing.assert_allclose(x, 0.0254 * history["base curvature"])
    np.testing.assert_allclose(y, history["base moment"] / (kip * 0.0254))
    x, y = top.lines[2].get_data()
    np.testing.assert_allclose(x, history["relative displacement"] / 0.0254)
    np.testing.assert_allclose(y, history["force"] / kip)
    assert np.polyfit(x, y, 1)[0] > 0.0 and np.ptp(y) > 10.0
    assert shows(section, [section.lines[2]]) and shows(top, [top.lines[2]])


def test_section(record):
    column = RCColumn.lhpost(record)
    axes = plot_section(column)
    cover, core = axes.patches
    assert 2 * cover.radius == pytest.approx(48.0) and 2 * core.radius == pytest.approx(48.0 - 4.0 - 0.625)
    lines, bars = axes.collections
    steel = column.section.fibers()[2]
    centers = np.array([path.get_extents().get_points().mean(axis=0) for path in bars.get_paths()])
    assert len(centers) == 18
    np.testing.assert_allclose(np.unique(np.round(centers[:, 0], 9)), np.unique(np.round(steel[:, 0] / 0.0254, 9)))
    assert len(lines.get_segments()) == 39 and "18 bars, diameter 1.41 in" in texts(axes)


def test_the_first_bar_is_drawn_where_it_acts():
    """Of three bars the first is on the side that positive displacements put in tension, as its strain shows."""
    push = DisplacementHistory("push", np.linspace(0.0, 0.1, 12))
    column = RCColumn.lhpost(push, parameters=("Ec",), bars=Bars(3, 0.05, area=0.006))
    bars = plot_section(column).collections[1]
    centers = [path.get_extents().get_points().mean(axis=0)[0] * 0.0254 for path in bars.get_paths()]
    assert min(centers) == pytest.approx(-column.bar_circle_radius) and max(centers) < 0.3
    turned = replace(column, bars=replace(column.bars, first_angle=np.pi))
    one_in_tension, two_in_tension = (each.simulate([1.0])[0, -1] for each in (column, turned))
    assert two_in_tension > 1.2 * one_in_tension
    sensor = replace(column, outputs=(f"strain@0:{min(centers)}",))
    assert sensor.simulate([1.0])[0, -1] > 0.005


def test_sensors_are_drawn_at_their_places(record):
    outputs = ("acceleration", "base_moment", "strain@0.3:-0.5", "curvature@2", "rotation@0.1:0.7")
    axes = plot_sensors(RCColumn.lhpost(record, outputs=outputs))
    assert sorted(text.get_text() for text in axes.texts) == sorted(outputs)
    assert len({text.get_position() for text in axes.texts}) == 5, "no label covers another"
    drawn = [np.round(np.column_stack(line.get_data()), 9).tolist() for line in axes.lines]
    assert [[-0.5, 0.3]] in drawn and [[-0.6096, 2.0], [0.6096, 2.0]] in drawn
    assert [[0.73152, 0.1], [0.73152, 0.7]] in drawn
    assert [[0.0, 7.3152]] in drawn and [[0.0, 0.0]] in drawn
    (sections,) = axes.collections
    np.testing.assert_allclose([s[0, 1] for s in sections.get_segments()], [0.0, 1.8288, 3.6576, 5.4864, 7.3152])


def test_ranks_are_at_the_places_of_their_sensors(record):
    """The chosen sensors are numbered; others have no label."""
    bar = RCColumn.lhpost(record).bar_circle_radius
    outputs = ("acceleration", "displacement@2.5", f"bar_stress@0:{bar:.3f}", "strain@0.3:-0.5", "velocity")
    axes = plot_sensors(RCColumn.lhpost(record, outputs=outputs), ranks=(outputs[2], outputs[1]))
    assert {text.get_text() for text in axes.texts} == {f"1. {outputs[2]}", "2. displacement@2.5"}
    drawn = {
        tuple(np.column_stack(line.get_data())[0]): line.get_alpha()
        for line in axes.lines
        if len(line.get_xdata()) == 1
    }
    assert drawn == {(0.0, 7.3152): 0.35, (0.0, 2.5): 1.0, (round(bar, 3), 0.0): 1.0, (-0.5, 0.3): 0.35}


def test_ranks_of_other_channels_are_refused(record):
    with pytest.raises(ValueError, match="unknown channels strain; the channels are acceleration, displacement"):
        plot_sensors(RCColumn.lhpost(record), ranks=("strain",))
