"""What figures draw: the data, in the units that their labels name, and all of it. Pixels are not looked at."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.models.isolated_bridge import IsolatedBridge
from fe_likelihoods.models.linear_oscillator import LinearOscillator
from fe_likelihoods.models.rc_column import Patches, RCColumn
from fe_likelihoods.plots.histories import plot_histories, plot_spectra
from fe_likelihoods.problems import bridge_column_data, isolated_bridge_data
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import DisplacementHistory, Record
from fe_likelihoods.units import G0

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "mm"))


@pytest.fixture(autouse=True)
def quiet_figures():
    matplotlib.use("Agg")
    yield
    matplotlib.pyplot.close("all")


@pytest.fixture
def record(rng):
    return Record("noise", 0.02, rng.normal(size=300))


@pytest.fixture
def measured(rng):
    return Measurements(CHANNELS, 0.1, rng.normal(size=(2, 50)), "SYNTHETIC: white noise")


def texts(axes) -> list[str]:
    return [text.get_text() for text in axes.get_legend().get_texts()]


def test_record(record):
    axes = record.plot()
    history, peak = axes.lines
    np.testing.assert_allclose(history.get_ydata(), record.acceleration / G0)
    np.testing.assert_allclose(history.get_xdata(), record.time)
    where = np.argmax(np.abs(record.acceleration))
    assert peak.get_xdata()[0] == record.time[where]
    assert texts(axes) == [f"peak {abs(record.acceleration[where]) / G0:.3g} g at {record.time[where]:.4g} s"]
    assert axes.get_ylabel() == "ground acceleration [g]" and axes.get_title() == "noise"
    assert record.plot(axes, unit="m/s2") is axes
    np.testing.assert_allclose(axes.lines[2].get_ydata(), record.acceleration)
    with pytest.raises(ValueError, match="expected a unit of acceleration, got 'mm'"):
        record.plot(unit="mm")
    assert Record("rest", 0.1, np.zeros(5)).plot().get_ylim()[1] > 0.0


def test_spectrum(record):
    periods = [0.1, 0.5, 2.0]
    axes = record.plot_spectrum(periods, (0.02, 0.1))
    assert texts(axes) == ["2 %", "10 %"] and axes.get_ylabel() == "pseudo-acceleration [g]"
    np.testing.assert_allclose(axes.lines[1].get_ydata(), record.spectrum(periods, 0.1).pseudo_acceleration / G0)
    axes = record.plot_spectrum(periods, quantity="displacement", unit="in")
    np.testing.assert_allclose(axes.lines[1].get_ydata(), record.spectrum(periods, 0.05).displacement / 0.0254)
    assert axes.get_ylabel() == "displacement [in]"
    with pytest.raises(ValueError, match="expected a unit of displacement"):
        record.plot_spectrum(periods, quantity="displacement", unit="g")
    with pytest.raises(ValueError, match="one of the quantities pseudo_acceleration"):
        plot_spectra([record.spectrum(periods)], quantity="acceleration")
    with pytest.raises(ValueError, match="one spectrum or more"):
        plot_spectra([])


def test_measurements(measured):
    figure = measured.plot()
    assert [axes.get_ylabel() for axes in figure.axes] == ["top [g]", "drift [mm]"]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), measured.values[0] / G0)
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), 1e3 * measured.values[1])
    assert figure.axes[1].get_xlabel() == "time [s]" and figure.get_suptitle() == "SYNTHETIC: white noise"
    (only,) = measured.plot(channels=["drift"]).axes
    assert only.get_ylabel() == "drift [mm]"
    with pytest.raises(ValueError, match="channels must be some of top, drift; got \\['Top'\\]"):
        measured.plot(channels="Top")
    with pytest.raises(ValueError, match="nothing to draw"):
        plot_histories()


def test_measurements_beside_a_response(measured):
    response = replace(measured, values=1.1 * measured.values)
    axes = measured.plot(response, label="at the mean").axes[1]
    assert [line.get_label() for line in axes.lines] == ["measured", "at the mean, RRMSE 10 %"]
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 1.1e3 * measured.values[1])
    axes = measured.plot(response.decimate(2)).axes[0]
    assert texts(axes) == ["measured", "model"], "other instants: an error would not be one"
    other = replace(response, channels=(Channel("top", "velocity", "m/s"), CHANNELS[1]))
    with pytest.raises(ValueError, match="'top' is 'absolute acceleration' in the measurements, 'velocity' in"):
        measured.plot(other)


def test_response_of_any_model(record, measured):
    oscillator = LinearOscillator(record)
    figure = oscillator.plot_response([1.2, 0.8])
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), 100.0 * oscillator.simulate([1.2, 0.8])[1])
    function = FunctionModel(lambda theta: theta[0] * measured.values, ("gain",), CHANNELS, 0.1, 50)
    axes = function.plot_response([2.0], measured.select(["drift"])).axes
    assert len(axes) == 1 and texts(axes[0]) == ["measured", "model, RRMSE 100 %"]


def test_response_of_the_bridge():
    data = isolated_bridge_data()
    bridge = IsolatedBridge(data.record.trim(0.0, 2.0), outputs=10, every=2, step=1e-3)
    figure = bridge.plot_response(np.ones(10), data.measurements.trim(0.0, 2.0))
    assert [axes.get_ylabel() for axes in figure.axes][:2] == ["Ub_1 [mm]", "Fb_1 [kN]"] and len(figure.axes) == 10
    assert all("RRMSE" in texts(axes)[1] for axes in figure.axes)
    first, second = bridge.plot_hysteresis(np.ones(10)).axes
    history = replace(bridge, every=1).history(np.ones(10))
    x, y = second.lines[2].get_data()  # after the two lines of the origin
    np.testing.assert_allclose(x, 1e3 * history["Ub_2"])
    np.testing.assert_allclose(y, 1e-3 * history["Fb_2"])
    assert second.get_xlabel() == "bearing displacement [mm]" and first.get_ylabel() == "isolator force [kN]"


def test_hysteresis_of_a_shaken_column():
    motion = bridge_column_data().record.resample(8 / 256).trim(5.0, 8.0)
    column = RCColumn.lhpost(motion, parameters=("Ec",))
    history = column.history([0.6])
    section, top = column.plot_hysteresis([0.6]).axes
    assert section.get_xlabel() == "curvature [1/in]" and section.get_ylabel() == "moment [kip in]"
    kip = 4448.2216152605
    x, y = section.lines[2].get_data()
    np.testing.assert_allclose(x, 0.0254 * history["base curvature"])
    np.testing.assert_allclose(y, history["base moment"] / (kip * 0.0254))
    x, y = top.lines[2].get_data()
    np.testing.assert_allclose(x, history["relative displacement"] / 0.0254)
    np.testing.assert_allclose(y, history["force"] / kip)
    assert np.polyfit(x, y, 1)[0] > 0.0 and np.ptp(y) > 10.0


def test_a_pushed_column_is_drawn_over_steps():
    history = DisplacementHistory("push", np.linspace(0.0, 0.1, 12))
    column = RCColumn.lhpost(history, parameters=("Ec",), units=(("force", "MN"),))
    (axes,) = column.plot_response([1.0]).axes
    assert axes.get_xlabel() == "step" and axes.get_ylabel() == "force [MN]"
    section, top = column.plot_hysteresis([1.0]).axes
    assert section.get_ylabel() == "moment [MN m]" and top.get_xlabel() == "displacement [m]"
    np.testing.assert_allclose(top.lines[2].get_xdata(), history.displacement, atol=1e-12)


@pytest.mark.parametrize("mesh", [40, Patches(20, 10, 2)])
def test_section(record, mesh):
    column = RCColumn.lhpost(record, mesh=mesh)
    axes = column.plot_section()
    cover, core = axes.patches
    assert 2 * cover.radius == pytest.approx(48.0) and 2 * core.radius == pytest.approx(48.0 - 4.0 - 0.625)
    lines, bars = axes.collections
    concrete, _, steel = column.section.fibers()
    centers = np.array([path.get_extents().get_points().mean(axis=0) for path in bars.get_paths()])
    assert len(centers) == 18
    np.testing.assert_allclose(np.unique(np.round(centers[:, 0], 9)), np.unique(np.round(steel[:, 0] / 0.0254, 9)))
    if mesh == 40:
        edges = np.array([segment[0, 0] for segment in lines.get_segments()])
        assert len(edges) == 39
        inside = np.searchsorted(edges, concrete[:, 0] / 0.0254)
        assert np.all(np.bincount(inside, minlength=40) <= 1), "no strip holds two fibers of the core"
    else:
        assert len(lines.get_segments()) == 9 + 1 + 20
    assert axes.get_aspect() == 1.0 and "18 bars, diameter 1.41 in" in texts(axes)
