"""The figure of a fit: data, errors, windows and limits."""

from dataclasses import replace

import numpy as np
import pytest

from fe_likelihoods import Channel, Measurements, plot_fit
from fe_likelihoods.units import G0

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "mm"))


@pytest.fixture
def measured(rng):
    """Twenty seconds, the top strong from 12 s on and the drift from 3 s on."""
    time = 0.05 * np.arange(401)
    shapes = [np.exp(-(((time - center) / 2.0) ** 2)) for center in (14.5, 5.5)]
    return Measurements(CHANNELS, 0.05, np.array(shapes) * rng.normal(size=(2, 401)), "SYNTHETIC: bursts")


def test_rows_are_channels_and_columns_responses(measured):
    figure = plot_fit(measured, {"before": 0.0 * measured.values, "after": 1.07 * measured.values})
    rows = np.reshape(figure.axes, (2, 3))
    assert [axes.get_ylabel() for axes in rows[:, 0]] == ["top [g]", "drift [mm]"]
    assert figure.get_suptitle() == "SYNTHETIC: bursts"
    for k, factor in enumerate((1 / G0, 1e3)):
        before, after, zoom = rows[k]
        assert [axes.get_title() for axes in (before, after)] == ["before, RRMSE 100 %", "after, RRMSE 7.0 %"]
        np.testing.assert_allclose(before.lines[0].get_ydata(), factor * measured.values[k])
        np.testing.assert_allclose(after.lines[1].get_ydata(), 1.07 * factor * measured.values[k])
        assert before.lines[0].get_linewidth() > 2.0 * after.lines[1].get_linewidth(), "seen where the lines agree"
        (span,) = before.patches
        assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx(zoom.get_xlim())
    assert [np.round(axes.get_xlim(), 1).tolist() for axes in rows[:, 2]] == [
        pytest.approx([12.0, 17.0], abs=1.0),
        pytest.approx([3.0, 8.0], abs=1.0),
    ]


def test_short_histories_and_single_responses_have_no_window(measured):
    drift = measured.select(["drift"]).trim(0.0, 6.0)
    (axes,) = plot_fit(drift, {"model": drift.values}).axes
    assert axes.get_title() == "model, RRMSE 0.0 %" and axes.get_xlim() == (0.0, 6.0)
    figure = plot_fit(measured, 0.5 * measured.values, title="")
    assert figure.axes[0].get_title() == "model, RRMSE 50 %" and figure.get_suptitle() == ""


def test_missing_samples_do_not_count(measured):
    with_gap = measured.values.copy()
    with_gap[0, 100:200] = np.nan
    figure = plot_fit(replace(measured, values=with_gap), 1.1 * measured.values)
    assert figure.axes[0].get_title() == "model, RRMSE 10 %"


def test_wrong_arguments_are_refused(measured):
    with pytest.raises(ValueError, match=r"'before': expected the shape of the measured values, \(2, 401\)"):
        plot_fit(measured, {"before": np.zeros((2, 4))})
    with pytest.raises(ValueError, match="no response to draw"):
        plot_fit(measured, {})
