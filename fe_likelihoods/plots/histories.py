"""Figures of records, measurements, responses, residuals and predictions, in the units of their channels.

What is drawn is told by what is handed over: nothing here runs a simulation, and nothing of the library is imported
but units and the checks of residuals, so that records, measurements and models can draw themselves. matplotlib is
imported where used. Figures of a model's own kind (sections, hysteresis) are in `fe_likelihoods.plots.structures`.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..units import find_unit, from_si

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..prediction.propagation import Prediction
    from ..prediction.reliability import Fragility
    from ..signals.channels import Channel, Measurements
    from ..signals.records import Record
    from ..signals.response_spectrum import ResponseSpectrum

__all__ = [
    "plot_bands",
    "plot_fragility",
    "plot_histories",
    "plot_loop",
    "plot_record",
    "plot_residuals",
    "plot_spectra",
]

BLUE, ORANGE, GREY = "#1f5a8c", "#d9822b", "#8a8f98"
_SHADES = (BLUE, ORANGE, "#5b8c5a", "#b03a48", GREY)


def plot_record(record: "Record", axes: "Axes | None" = None, unit: str = "g") -> "Axes":
    """Ground acceleration against time; the peak is marked and told.

    Parameters
    ----------
    record : Record
    axes : matplotlib Axes, optional
        Where to draw; by default a new figure.
    unit : str
        Of the acceleration, a unit of `fe_likelihoods.units`.

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ValueError
        If the unit is unknown or no unit of acceleration.
    """
    shown = from_si(record.acceleration, unit, "acceleration")
    axes = _axes(axes, (8.0, 2.6))
    peak = int(np.argmax(np.abs(shown)))
    axes.plot(record.time, shown, color=BLUE, linewidth=0.7)
    label = f"peak {abs(shown[peak]):.3g} {unit} at {record.time[peak]:.4g} s"
    axes.plot(record.time[peak], shown[peak], "o", color=ORANGE, markersize=6, fillstyle="none", label=label)
    axes.set(xlabel="time [s]", ylabel=f"ground acceleration [{unit}]", title=record.name)
    axes.set_xlim(0.0, record.duration)
    # room below for the legend, which would hide the peak above
    reach = 1.1 * np.abs(shown).max() or 1.0
    axes.set_ylim(-1.35 * reach, reach)
    axes.legend(frameon=False, fontsize="small", loc="lower right")
    axes.grid(alpha=0.25)
    return axes


def plot_spectra(
    spectra: "Sequence[ResponseSpectrum]",
    axes: "Axes | None" = None,
    quantity: str = "pseudo_acceleration",
    unit: str | None = None,
    title: str = "",
) -> "Axes":
    """Response spectra against period, one line a spectrum.

    Parameters
    ----------
    spectra : sequence of ResponseSpectrum
        Of one record with several damping ratios, for instance.
    axes : matplotlib Axes, optional
        Where to draw; by default a new figure.
    quantity : {"pseudo_acceleration", "pseudo_velocity", "displacement"}
        What is drawn.
    unit : str, optional
        Of the quantity; by default g, cm/s and cm.
    title : str, optional

    Returns
    -------
    matplotlib Axes

    Raises
    ------
    ValueError
        If there are no spectra, the quantity is none of the three, or the unit does not measure it.
    """
    units = {"pseudo_acceleration": "g", "pseudo_velocity": "cm/s", "displacement": "cm"}
    if quantity not in units or not len(spectra):
        raise ValueError(f"expected one spectrum or more, and a quantity of {', '.join(units)}; got {quantity!r}")
    unit = units[quantity] if unit is None else unit
    find_unit(unit, quantity.removeprefix("pseudo_"))
    axes = _axes(axes, (6.0, 3.8))
    for spectrum, shade in zip(spectra, [_SHADES[i % len(_SHADES)] for i in range(len(spectra))], strict=True):
        values = from_si(getattr(spectrum, quantity), unit)
        axes.plot(spectrum.periods, values, color=shade, linewidth=1.3, label=f"{100 * spectrum.damping_ratio:g} %")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set(xlabel="period [s]", ylabel=f"{quantity.replace('_', '-')} [{unit}]", title=title)
    axes.set_xlim(min(s.periods.min() for s in spectra), max(s.periods.max() for s in spectra))
    axes.set_ylim(bottom=0.0)
    axes.legend(frameon=False, fontsize="small", title="damping ratio", title_fontsize="small")
    axes.grid(alpha=0.25, which="both")
    return axes


def plot_histories(
    measurements: "Measurements | None" = None,
    response: "Measurements | None" = None,
    channels: Sequence[str] | None = None,
    label: str = "model",
    time_label: str = "time [s]",
) -> "Figure":
    """Histories of channels, one above another: what was measured, what a model answers, or both.

    Parameters
    ----------
    measurements : Measurements, optional
        What was measured.
    response : Measurements, optional
        What the model answers, on the same time axis; channels that are in one of the two only are drawn alone. Where
        step and length are the same, the relative root mean square error of the model is told.
    channels : sequence of str, optional
        Names of those to draw; by default those measured, without measurements all of the response.
    label : str
        Of the response.
    time_label : str
        Of the horizontal axis: "step" for a test without time.

    Returns
    -------
    matplotlib Figure

    Raises
    ------
    ValueError
        If both are missing, there is no such channel, or a channel measures different things in the two.
    """
    sources = [source for source in (measurements, response) if source is not None]
    if not sources:
        raise ValueError("nothing to draw: give measurements, a response, or both")
    known = {channel.name: channel for source in reversed(sources) for channel in source.channels}
    names = _wanted(channels, known, [channel.name for channel in sources[0].channels])
    figure, rows = _stack(len(names))
    for axes, name in zip(rows, names, strict=True):
        shown = [name in {c.name for c in source.channels} if source else False for source in (measurements, response)]
        if all(shown):
            _same_quantity(name, measurements, response)
        if shown[0]:
            values = from_si(measurements.channel(name), known[name].unit)
            width, shade = (1.8, ORANGE) if shown[1] else (0.8, BLUE)
            alpha = 0.65 if shown[1] else 1.0
            axes.plot(measurements.time, values, color=shade, linewidth=width, alpha=alpha, label="measured")
        if shown[1]:
            values = from_si(response.channel(name), known[name].unit)
            text = label + (_relative_error(name, measurements, response) if shown[0] else "")
            axes.plot(response.time, values, color=BLUE, linewidth=0.8, label=text)
        if all(shown):
            axes.legend(frameon=False, fontsize="small", ncols=2, loc="upper right", borderaxespad=0.1)
            low, high = axes.get_ylim()
            axes.set_ylim(low, high + 0.22 * (high - low))  # room for the legend
        axes.set_ylabel(_label(known[name]))
        axes.grid(alpha=0.25)
    _time_axis(rows, max(source.time[-1] for source in sources), time_label)
    if measurements is not None and measurements.description:
        _note(figure, measurements.description)
    return figure


def plot_loop(
    x: np.ndarray, y: np.ndarray, axes: "Axes | None" = None, *, x_label: str = "", y_label: str = "", title: str = ""
) -> "Axes":
    """A hysteresis loop: force against displacement, moment against curvature; a dot where it ends.

    Parameters
    ----------
    x, y : (n_steps,) float
        In the units of the labels.
    axes : matplotlib Axes, optional
        Where to draw; by default a new figure.
    x_label, y_label, title : str
        With units.

    Returns
    -------
    matplotlib Axes
    """
    axes = _axes(axes, (5.0, 4.0))
    for line in (axes.axhline, axes.axvline):
        line(0.0, color="0.75", linewidth=0.7, zorder=0)
    axes.plot(x, y, color=BLUE, linewidth=0.7)
    axes.plot(x[-1], y[-1], "o", color=ORANGE, markersize=4)
    axes.set(xlabel=x_label, ylabel=y_label, title=title)
    axes.grid(alpha=0.25)
    return axes


def plot_bands(
    prediction: "Prediction", measurements: "Measurements | None" = None, channels: Sequence[str] | None = None
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
    time = prediction.time
    names = [channel.name for channel in prediction.channels]
    wanted = _wanted(channels, names, names)
    measured = {} if measurements is None else _measured(prediction, measurements)
    low, high = (min(prediction.probabilities), max(prediction.probabilities)) if prediction.probabilities else (0, 0)

    figure, rows = _stack(len(wanted))
    for axes, name in zip(rows, wanted, strict=True):
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
    rows[0].legend(frameon=False, fontsize="small", ncols=3, loc="upper right")
    _time_axis(rows, time[-1])
    return figure


def plot_fragility(
    fragility: "Fragility", label: str = "peak ground acceleration", unit: str | None = "g", si_unit: str = "m/s2"
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


def plot_residuals(residuals: np.ndarray, channels: "Sequence[Channel]", dt: float) -> "Figure":
    """Residuals of each channel in time, their autocorrelation, and their quantiles against those of a normal.

    White residuals keep to the band of the autocorrelation (95 % of the lags, of independent samples), normal ones to
    the straight line.

    Parameters
    ----------
    residuals : (n_channels, n_steps) float
        Measured less simulated [SI], as `fe_likelihoods.probability.likelihood.FELikelihood.residuals` gives.
    channels : sequence of Channel
    dt : float
        Time step [s].

    Raises
    ------
    ValueError
        If there is not one channel for each row, and as `fe_likelihoods.probability.residuals.residual_checks`.
    """
    import matplotlib.pyplot as plt
    from scipy.special import ndtri

    from ..probability.residuals import autocorrelation, residual_checks

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


def _axes(axes: "Axes | None", size: tuple[float, float]) -> "Axes":
    """Axes as given, or those of a new figure."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, axes = plt.subplots(figsize=size, layout="constrained")
    return axes


def _stack(n: int) -> "tuple[Figure, np.ndarray]":
    """A figure of `n` axes above one another with one time axis."""
    import matplotlib.pyplot as plt

    figure, rows = plt.subplots(n, 1, sharex=True, squeeze=False, figsize=(8.0, 1.0 + 2.0 * n), layout="constrained")
    return figure, rows[:, 0]


def _time_axis(rows: np.ndarray, end: float, label: str = "time [s]") -> None:
    rows[-1].set_xlabel(label)
    rows[-1].set_xlim(0.0, end if end > 0.0 else None)


def _note(figure: "Figure", text: str) -> None:
    """What the data are, on as many lines as they need above the axes."""
    figure.suptitle(text, fontsize="small", wrap=True)


def _wanted(channels: Sequence[str] | None, known: Sequence[str], default: list[str]) -> list[str]:
    names = default if channels is None else [channels] if isinstance(channels, str) else list(channels)
    if not names or set(names) - set(known):
        raise ValueError(f"channels must be some of {', '.join(known)}; got {names}")
    return names


def _same_quantity(name: str, first: "Measurements", second: "Measurements") -> None:
    a, b = (next(c for c in source.channels if c.name == name) for source in (first, second))
    if a.dimension != b.dimension:
        raise ValueError(f"channel {name!r} is {a.quantity!r} in the measurements, {b.quantity!r} in the response")


def _relative_error(name: str, measured: "Measurements", response: "Measurements") -> str:
    """Root of sum (response - measured)^2 / sum measured^2 in words; nothing where the instants differ."""
    data, answer = measured.channel(name), response.channel(name)
    if data.shape != answer.shape or abs(measured.dt - response.dt) > 1e-9 * measured.dt or not data.any():
        return ""
    return f", RRMSE {100 * np.sqrt(np.sum((answer - data) ** 2) / np.sum(data**2)):.3g} %"


def _measured(prediction: "Prediction", measurements: "Measurements") -> dict[str, np.ndarray]:
    if measurements.n_steps != prediction.mean.shape[1] or abs(measurements.dt - prediction.dt) > 1e-9 * prediction.dt:
        raise ValueError(
            f"the prediction has {prediction.mean.shape[1]} samples at {prediction.dt} s, the measurements have "
            f"{measurements.n_steps} at {measurements.dt} s; make them equal with Measurements.trim and decimate"
        )
    return {channel.name: measurements.channel(channel.name) for channel in measurements.channels}


def _label(channel: "Channel") -> str:
    return f"{channel.name} [{channel.unit}]"
