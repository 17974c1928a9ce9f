"""Figures of predictions and residuals, in the units of the channels. matplotlib is imported where used."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import ndtri

from .channels import Channel, Measurements
from .predictive import Prediction
from .reliability import Fragility
from .residuals import autocorrelation, residual_checks
from .units import from_si

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_bands", "plot_fragility", "plot_residuals"]

BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"


def plot_bands(
    prediction: Prediction, measurements: Measurements | None = None, channels: Sequence[str] | None = None
) -> "Figure":
    """Histories of channels: mean, the band between the outermost quantiles, and what was measured.

    Parameters
    ----------
    prediction : Prediction — of histories.
    measurements : Measurements, optional — of the same channels, step and length; those it lacks are drawn without.
    channels : names of those to draw, by default all.

    Raises
    ------
    ValueError
        If the prediction has no histories or no such channel, or the measurements do not fit.
    """
    import matplotlib.pyplot as plt

    time = prediction.time
    names = [channel.name for channel in prediction.channels]
    wanted = names if channels is None else [channels] if isinstance(channels, str) else list(channels)
    if not wanted or set(wanted) - set(names):
        raise ValueError(f"channels must be some of {', '.join(names)}; got {wanted}")
    measured = {} if measurements is None else _measured(prediction, measurements)
    low, high = (min(prediction.probabilities), max(prediction.probabilities)) if prediction.probabilities else (0, 0)

    figure, rows = plt.subplots(
        len(wanted), 1, sharex=True, squeeze=False, figsize=(8.0, 1.0 + 2.0 * len(wanted)), layout="constrained"
    )
    for axes, name in zip(rows[:, 0], wanted, strict=True):
        k = names.index(name)
        channel = prediction.channels[k]
        if low < high:
            band = [from_si(prediction.quantile(p)[k], channel.unit) for p in (low, high)]
            label = f"{100 * low:g}-{100 * high:g} %" + (" with noise" if prediction.noise else "")
            axes.fill_between(time, *band, color=BLUE, alpha=0.3, linewidth=0.0, label=label)
        if name in measured:
            axes.plot(
                time, from_si(measured[name], channel.unit), color=ORANGE, linewidth=2.2, alpha=0.6, label="measured"
            )
        axes.plot(time, from_si(prediction.mean[k], channel.unit), color=BLUE, linewidth=0.8, label="mean")
        axes.set_ylabel(_label(channel))
        axes.grid(alpha=0.25)
    rows[0, 0].legend(frameon=False, fontsize="small", ncols=3, loc="upper right")
    rows[-1, 0].set_xlabel("time [s]")
    rows[-1, 0].set_xlim(time[0], time[-1] if len(time) > 1 else None)
    return figure


def plot_fragility(
    fragility: Fragility, label: str = "peak ground acceleration", unit: str | None = "g", si_unit: str = "m/s2"
) -> "Figure":
    """Probability of an exceedance against intensity: the records with their intervals, and the lognormal curve.

    Parameters
    ----------
    fragility : Fragility
    label : str — what the intensity is.
    unit : str or None — in which it is drawn, a unit of `fe_likelihoods.units`; None: as it is, in `si_unit`.
    si_unit : str — unit of the intensities, for the label where `unit` is None.
    """
    import matplotlib.pyplot as plt

    def shown(values):
        return values if unit is None else from_si(values, unit)

    figure, axes = plt.subplots(figsize=(6.0, 4.0), layout="constrained")
    reach = np.stack([fragility.probability - fragility.lower, fragility.upper - fragility.probability])
    axes.errorbar(
        shown(fragility.intensity),
        fragility.probability,
        yerr=np.maximum(reach, 0.0),
        fmt="o",
        color=BLUE,
        markersize=4,
        linewidth=1,
        label="records",
    )
    if fragility.curve is not None:
        curve = fragility.curve
        x = np.geomspace(0.7 * fragility.intensity.min(), 1.2 * fragility.intensity.max(), 200)
        text = f"median {shown(curve.median):.3g}, dispersion {curve.dispersion:.2g}"
        axes.plot(shown(x), curve.probability(x), color=GREY, label=text)
    axes.set_xlabel(f"{label} [{si_unit if unit is None else unit}]")
    axes.set_ylabel("probability of exceedance [-]")
    axes.set_ylim(-0.02, 1.02)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize="small")
    return figure


def plot_residuals(residuals: np.ndarray, channels: Sequence[Channel], dt: float) -> "Figure":
    """Residuals of each channel in time, their autocorrelation, and their quantiles against those of a normal.

    White residuals keep to the band of the autocorrelation (95 % of the lags, of independent samples), normal ones to
    the straight line.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured less simulated [SI], as `fe_likelihoods.likelihood.FELikelihood.residuals` gives.
    channels : sequence of Channel
    dt : float
        Time step [s].

    Raises
    ------
    ValueError
        If there is not one channel for each row, and as `fe_likelihoods.residuals.residual_checks`.
    """
    import matplotlib.pyplot as plt

    checks, correlation = residual_checks(residuals), autocorrelation(residuals)
    n_channels, n = correlation.shape
    if len(channels) != n_channels:
        raise ValueError(f"expected one channel for each row of residuals; got {len(channels)} and {n_channels} rows")
    figure, rows = plt.subplots(
        n_channels,
        3,
        squeeze=False,
        figsize=(11.0, 1.0 + 2.0 * n_channels),
        layout="constrained",
        width_ratios=(2, 1, 1),
    )
    normal = ndtri((np.arange(n) + 0.5) / n)
    for k, (history, lags, quantiles) in enumerate(rows):
        values = from_si(np.asarray(residuals[k], dtype=float), channels[k].unit)
        history.plot(np.arange(n) * dt, values, color=BLUE, linewidth=0.7)
        history.set_ylabel(_label(channels[k]))
        # as far as it says something: some correlation times
        shown = min(n, 20 + int(10.0 * n / checks.n_effective[k]))
        lags.fill_between([0.0, (shown - 1) * dt], *(s * 1.96 / np.sqrt(n) for s in (-1, 1)), color=GREY, alpha=0.3)
        lags.plot(np.arange(shown) * dt, correlation[k, :shown], color=BLUE, linewidth=0.9)
        lags.set_title(f"lag one {checks.lag_one[k]:.2f}, worth {checks.n_effective[k]:.0f} of {n}", fontsize="small")
        quantiles.plot(normal, values.mean() + values.std() * normal, color=GREY, linewidth=0.9)
        quantiles.plot(normal, np.sort(values), ".", color=BLUE, markersize=2)
        for axes in (history, lags, quantiles):
            axes.grid(alpha=0.25)
    for axes, text in zip(rows[-1], ("time [s]", "lag [s]", "quantile of a standard normal [-]"), strict=True):
        axes.set_xlabel(text)
    return figure


def _measured(prediction: Prediction, measurements: Measurements) -> dict[str, np.ndarray]:
    if measurements.n_steps != prediction.mean.shape[1] or abs(measurements.dt - prediction.dt) > 1e-9 * prediction.dt:
        raise ValueError(
            f"the prediction has {prediction.mean.shape[1]} samples at {prediction.dt} s, the measurements have "
            f"{measurements.n_steps} at {measurements.dt} s; make them equal with Measurements.trim and decimate"
        )
    return {channel.name: measurements.channel(channel.name) for channel in measurements.channels}


def _label(channel: Channel) -> str:
    return f"{channel.name} [{channel.unit}]"
