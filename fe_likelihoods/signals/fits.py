"""Figure of how well responses fit measurements, such as a model before and after its update, with the errors."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .channels import Measurements

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot_fit", "strongest_window"]


def plot_fit(
    measurements: Measurements,
    responses: "Mapping[str, Measurements | np.ndarray] | Measurements | np.ndarray",
    channels: Sequence[str] | None = None,
    *,
    window: float | None = 5.0,
    time_label: str = "time [s]",
    title: str | None = None,
) -> "Figure":
    """Plot measurements with the response of a model, such as before and after an update.

    Each channel has a row: one axes per response with the whole history and the relative root mean square error (RRMSE)
    in the title, then one axes with all responses in the strongest five seconds.

    Parameters
    ----------
    measurements : Measurements
        The measured histories.
    responses : mapping of str to (Measurements or ndarray), or one of these
        Responses by their titles. An array has the shape, samples and channels of ``measurements.values`` [SI], such as
        ``measurements.values - posterior.likelihood.residuals(x)`` for parameters x.
    channels : sequence of str, optional
        Names of the channels to draw. Default: all.
    window : float, optional
        Length [s] of the strongest part, which is shown again on a longer scale. It is not shown for None or more than
        two thirds of the history.
    time_label : str
        Label of the horizontal axes, for example "step" for a test without time.
    title : str, optional
        Title of the figure. Default: the description of the measurements.

    Returns
    -------
    matplotlib Figure
        With axes of shape (n_channels, n_responses + 1), or (n_channels, n_responses) without strongest parts.

    Raises
    ------
    ValueError
        If there is no response, an array has another shape than the measurements, a channel is unknown, or `window` is
        not positive.

    Examples
    --------
    >>> likelihood = posterior.likelihood
    >>> points = {"before the update": nominal, "posterior mean": samples.mean(axis=0)}
    >>> responses = {title: measured.values - likelihood.residuals(x) for title, x in points.items()}
    >>> plot_fit(measured, responses).savefig("fit.png")
    """
    from ..plots.fits import draw_fit

    if window is not None and not window > 0.0:
        raise ValueError(f"window must be a positive number of seconds or None; got {window!r}")
    given = responses if isinstance(responses, Mapping) else {"model": responses}
    if not given:
        raise ValueError("no response to draw: pass a mapping of titles to responses")
    shown = {str(text): _as_measurements(measurements, response, text) for text, response in given.items()}
    errors = {text: measurements.rrmse_of(response) for text, response in shown.items()}
    windows = {}
    for channel in measurements.channels if window is not None else ():
        times = measurements.times(channel.name)
        if window <= (times[-1] - times[0]) / 1.5:
            windows[channel.name] = strongest_window(times, measurements.channel(channel.name), window)
    if channels is not None:
        wanted = [channels] if isinstance(channels, str) else channels
        windows = {name: windows[name] for name in wanted if name in windows}
    return draw_fit(measurements, shown, errors, windows, channels, time_label, title)


def strongest_window(times: np.ndarray, values: np.ndarray, length: float) -> tuple[float, float]:
    """Begin and end [s] of the part with the largest sum of squares.

    Parameters
    ----------
    times : (n,) float
        Times of the samples [s], with equal steps.
    values : (n,) float
        Any unit; NaN where a sample is missing.
    length : float
        Length of the part [s].
    """
    step = times[1] - times[0]
    size = min(len(times), max(1, round(length / step)))
    total = np.concatenate([[0.0], np.cumsum(np.nan_to_num(values) ** 2)])
    first = int(np.argmax(total[size:] - total[:-size]))
    return float(times[first]), float(times[first] + length)


def _as_measurements(measurements: Measurements, response: Measurements | np.ndarray, text: str) -> Measurements:
    if isinstance(response, Measurements):
        return response
    values = np.asarray(response, dtype=float)
    if values.shape != np.shape(measurements.values):
        raise ValueError(
            f"response {text!r}: an array must have the shape of the measured values, {np.shape(measurements.values)}; "
            f"got {values.shape}. Pass Measurements for a response with other channels or times"
        )
    return replace(measurements, values=values, description="")
