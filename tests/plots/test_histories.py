"""Figures of records, histories and residuals: the data they show, the units of the labels, and the limits."""

import numpy as np
import pytest

from fe_likelihoods import plot_histories, plot_record, plot_residuals, plot_spectrum
from fe_likelihoods.checks.model import describe_residuals
from fe_likelihoods.noise.residuals import autocorrelation, residual_checks
from fe_likelihoods.signals.channels import Channel, Measurements
from fe_likelihoods.signals.records import Record
from fe_likelihoods.units import G0
from tests.plots.reading import shows, texts

CHANNELS = (Channel("top", "absolute acceleration", "g"), Channel("drift", "relative displacement", "mm"))


@pytest.fixture
def measured(rng):
    return Measurements(CHANNELS, 0.1, rng.normal(size=(2, 50)), "SYNTHETIC: white noise")


def test_record(record):
    axes = plot_record(record)
    history, peak = axes.lines
    np.testing.assert_allclose(history.get_ydata(), record.acceleration / G0)
    np.testing.assert_allclose(history.get_xdata(), record.time)
    where = np.argmax(np.abs(record.acceleration))
    assert peak.get_xdata()[0] == record.time[where]
    assert texts(axes) == [f"peak {abs(record.acceleration[where]) / G0:.3g} g at {record.time[where]:.4g} s"]
    assert axes.get_ylabel() == "ground acceleration [g]" and shows(axes, axes.lines)
    assert plot_record(Record("rest", 0.1, np.zeros(5))).get_ylim()[1] > 0.0


def test_spectrum(record):
    periods = [0.1, 0.5, 2.0]
    axes = plot_spectrum(record, periods, (0.02, 0.1))
    assert texts(axes) == ["2 %", "10 %"] and axes.get_ylabel() == "pseudo-acceleration [g]"
    np.testing.assert_allclose(axes.lines[1].get_ydata(), record.spectrum(periods, 0.1).pseudo_acceleration / G0)
    with pytest.raises(ValueError, match="one damping ratio or more"):
        plot_spectrum(record, damping_ratios=())


def test_measurements(measured):
    figure = plot_histories(measured)
    assert [axes.get_ylabel() for axes in figure.axes] == ["top [g]", "drift [mm]"]
    np.testing.assert_allclose(figure.axes[0].lines[0].get_ydata(), measured.values[0] / G0)
    np.testing.assert_allclose(figure.axes[1].lines[0].get_ydata(), 1e3 * measured.values[1])
    assert figure.get_suptitle() == "SYNTHETIC: white noise"


def test_residuals(rng):
    residuals = np.cumsum(rng.normal(size=(2, 300)), axis=1)
    figure = plot_residuals(residuals, CHANNELS, 0.02)
    checks, correlation = residual_checks(residuals), autocorrelation(residuals)
    for k, factor in enumerate((1 / G0, 1e3)):
        history, lags, quantiles = figure.axes[3 * k : 3 * k + 3]
        assert history.get_ylabel() == f"{CHANNELS[k].name} [{CHANNELS[k].unit}]"
        np.testing.assert_allclose(history.lines[0].get_ydata(), factor * residuals[k])
        shown = lags.lines[0].get_ydata()
        np.testing.assert_allclose(shown, correlation[k, : len(shown)])
        assert f"lag-one correlation {checks.lag_one[k]:.2f}" in lags.get_title()
        assert f"{checks.n_effective[k]:.0f} effective samples of 300" in lags.get_title()
        np.testing.assert_allclose(quantiles.lines[1].get_ydata(), np.sort(factor * residuals[k]))
        assert history.get_title(loc="left").replace("\n", " ") == describe_residuals(checks)[k]
