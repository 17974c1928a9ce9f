"""Figures of load tests and modes, as bars and points with error bars."""

import numpy as np
import pytest

from fe_likelihoods import Channel, LogNormal, Measurements, ModalData, ModalLikelihood, Posterior, ShearFrame
from fe_likelihoods.plots.modes_and_load_tests import plot_modes, plot_points

CHANNELS = (Channel("quarter", "displacement", "mm"), Channel("middle", "displacement", "mm"))
CASES = ("truck left", "truck right")
VALUES = 1e-3 * np.array([[1.0, 2.0], [3.0, 4.0]])


def test_load_cases_are_bars_with_names_and_error_bars():
    measured = Measurements(CHANNELS, 1.0, VALUES, axis="load case", points=CASES)
    figure = plot_points(measured, {"before": 2.0 * VALUES, "after": 1.1 * VALUES}, np.full((2, 1), 1e-4))
    (axes,) = figure.axes
    assert [bar.get_height() for bar in axes.patches] == pytest.approx([1.1, 2.2, 3.3, 4.4])
    names = [text.get_text() for text in axes.get_xticklabels()]
    assert names == ["quarter\ntruck left", "quarter\ntruck right", "middle\ntruck left", "middle\ntruck right"]
    assert axes.get_ylabel() == "[mm]"
    (measured_bars,) = axes.containers[1:]
    low, high = measured_bars[2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((0.9, 1.1))


def test_positions_are_an_axis():
    positions = (0.0, 5.0)
    measured = Measurements(CHANNELS, 1.0, VALUES, axis="position [m]", points=positions)
    axes = plot_points(measured, {"after": VALUES}).axes
    assert [each.get_xlabel() for each in axes] == ["position [m]"] * 2
    assert axes[0].lines[0].get_xdata().tolist() == [0.0, 5.0]


def test_frequencies_and_shapes_of_modes():
    frame = ShearFrame({"first": 1, "roof": 2}, [1.0, 1.0], [100.0, 100.0])
    data = ModalData([0.98, 2.6], [[0.62, 1.0], [-1.0, 0.6]], ("first", "roof"), frequency_cv=0.01, shape_error=0.02)
    likelihood = ModalLikelihood(frame, data)
    posterior = Posterior(likelihood, {"stiffness_1": LogNormal(1.0, 0.1), "stiffness_2": LogNormal(1.0, 0.1)})
    modes = likelihood.predict_modes(posterior.sample_prior(20, 1))
    figure = plot_modes(modes, modes)
    figure.canvas.draw()
    low, high = figure.legends[0].get_window_extent().intervalx
    assert figure.bbox.x0 <= low < high <= figure.bbox.x1  # not cut off
    first, *shapes = figure.axes
    assert [text.get_text() for text in first.get_xticklabels()] == ["mode 1\n0.98 Hz", "mode 2\n2.6 Hz"]
    assert [axes.get_title().split(",")[0] for axes in shapes] == ["shape of mode 1", "shape of mode 2"]
    heights = [bar.get_height() for bar in shapes[0].patches]
    np.testing.assert_allclose(heights, np.median(modes.shapes[:, 0], axis=0))
    np.testing.assert_allclose(modes.shapes[:, 0] @ data.shapes[0, 0], modes.assurance[:, 0])
    ends = np.array([segment[:, 1] for segment in first.containers[1][2][0].get_segments()]).T
    np.testing.assert_allclose(ends, modes.interval() / data.mean_frequencies)  # with the errors of a frequency
    alone = ModalLikelihood(frame, ModalData([0.98, 2.6], frequency_cv=0.01)).predict_modes(np.ones((1, 2)))
    assert len(plot_modes(alone).axes) == 1
