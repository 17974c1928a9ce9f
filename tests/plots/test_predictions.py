"""Figures of predictions: bands against the values that they show."""

import numpy as np
import pytest

from fe_likelihoods import (
    FELikelihood,
    HalfNormal,
    LinearOscillator,
    Measurements,
    Posterior,
    Prior,
    TruncatedNormal,
    peak,
    plot_bands,
    propagate,
)
from fe_likelihoods.units import G0
from tests.plots.reading import texts


@pytest.fixture
def posterior(record):
    model = LinearOscillator(record, period=0.6)
    prior = {name: TruncatedNormal(1.0, 0.5) for name in model.parameter_names}
    prior |= {f"sigma_{channel.name}": HalfNormal(1.0) for channel in model.channels}
    measured = Measurements(model.channels, model.dt, model.simulate([1.0, 1.0]))
    return Posterior(FELikelihood(model, measured), Prior(prior))


@pytest.fixture
def samples(rng):
    return np.hstack([rng.normal(1.0, 0.02, size=(40, 2)), np.full((40, 2), 0.01)])


def test_bands(posterior, samples):
    prediction = propagate(posterior, samples, noise=True, progress=False)
    figure = plot_bands(prediction, posterior.likelihood.measurements)
    acceleration, displacement = figure.axes
    assert acceleration.get_ylabel() == "acceleration [g]" and displacement.get_ylabel() == "displacement [cm]"
    assert texts(acceleration) == ["5-95 % with noise", "measured", "mean"]
    for axes, k, factor in ((acceleration, 0, 1 / G0), (displacement, 1, 100.0)):
        measured, mean = axes.lines
        np.testing.assert_allclose(mean.get_ydata(), factor * prediction.mean[k])
        np.testing.assert_allclose(measured.get_ydata(), factor * posterior.likelihood.measurements.values[k])
        band = axes.collections[0].get_paths()[0].vertices[:, 1]
        assert band.min() == pytest.approx(factor * prediction.quantile(0.05)[k].min())
        assert band.max() == pytest.approx(factor * prediction.quantile(0.95)[k].max())


def test_bands_beside_few_or_thinned_measurements(posterior, samples):
    prediction = propagate(posterior, samples, progress=False)
    measured = posterior.likelihood.measurements
    first, second = plot_bands(prediction, measured.select(["displacement"])).axes
    assert len(first.lines) == 1 and len(second.lines) == 2, "channels without measurements are drawn without them"
    assert texts(first) == ["5-95 %", "mean"]
    thinned = next(iter(plot_bands(prediction, measured.decimate(2)).axes)).lines[0]
    np.testing.assert_array_equal(thinned.get_xdata(), measured.time[::2])
    with pytest.raises(ValueError, match="histories"):
        plot_bands(propagate(posterior, samples, quantity=peak("displacement"), progress=False))
