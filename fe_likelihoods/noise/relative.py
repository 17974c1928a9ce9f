r"""White noise whose standard deviation is a share of the response level, so that it transfers to other motions.

The error of a model grows with the response. A standard deviation in m/s², calibrated with a strong motion, makes the
prediction of a motion that is ten times weaker ten times too wide. `RelativeNoise` has the parameters

.. math:: \sigma_c^2 = s_c^2 + (a_c\, l_c)^2,

the share :math:`a_c` of the level :math:`l_c` of each channel, with the known noise :math:`s_c` of the sensor as a
floor. The level is the root mean square of the measured channel, so that the share is the ratio of error to signal and
the sum of squared residuals is all that is needed. A measured channel contains response and error. In a prediction, the
root mean square :math:`R_c` of the simulated response is known, of each sample and under each motion, and the level
follows from :math:`l_c^2 = R_c^2 + \sigma_c^2`:

.. math:: \sigma_c^2 = \frac{s_c^2 + a_c^2 R_c^2}{1 - a_c^2}.

See ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..signals.channels import Channel, Measurements
from .gaussian import (
    PerChannel,
    as_number,
    numbers,
    options_repr,
    set_channels,
    set_effective,
    total_deviations,
    weighted,
    white_log_likelihood,
)
from .sample_counts import SampleCounts

__all__ = ["RelativeNoise", "local_level"]


@dataclass(frozen=True)
class RelativeNoise:
    """Independent white Gaussian noise with an unknown share of the response level per channel.

    Make it with `RelativeNoise.of`.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the sums of squared residuals.
    levels : sequence of float
        Response level of each channel in the measurements [SI unit of the channel], positive.
    window : float, optional
        Length of a window [s]: the noise of a prediction follows the root mean square of the response within it, so
        that it is large in the strong part of the motion. Default: one level for the whole motion. The likelihood has
        one level in both cases.
    sensor, effective_samples : optional
        As for `GaussianNoise`. The noise of the sensor is the floor of the standard deviation where the response is
        small.

    Raises
    ------
    ValueError
        If there is not one positive level per channel, the window is not positive, and as `GaussianNoise`.

    Notes
    -----
    The likelihood is that of `GaussianNoise` with other parameters: ``share_top = 0.2`` is a standard deviation of 20 %
    of the root mean square of the measured channel "top". Shares of 1 or more are impossible (the model would explain
    nothing): their log-likelihood is -inf, and `propagate` refuses them with ``noise=True``. Of a parameter near 1, the
    predicted variance is very large.

    The likelihood is not a normalised density of the measurements, because the level is computed from them. For two
    samples, its integral over the measurements is 1.01 at a share of 0.1 and 1.11 at 0.3. Evidences therefore compare
    shares with each other and with other noises approximately only.

    Examples
    --------
    >>> noise = RelativeNoise.of(measurements, window=2.0, sensor={"top": 0.005})
    >>> posterior = Posterior(FELikelihood(model, measurements, noise), prior | {"share_top": HalfNormal(0.5)})
    >>> propagate(posterior, samples, record=weaker, noise=True)  # noise of the weaker response
    """

    channels: tuple[Channel, ...]
    levels: tuple[float, ...]
    window: float | None
    sensor: tuple[float, ...] | None
    effective_samples: tuple[float, ...] | None

    def __init__(
        self,
        channels: Sequence[Channel],
        levels: Sequence[float],
        *,
        window: float | None = None,
        sensor: PerChannel = None,
        effective_samples: PerChannel = None,
    ) -> None:
        channels = tuple(channels)
        object.__setattr__(self, "levels", numbers(self, "levels", levels, "[SI unit of the channel]"))
        if len(self.levels) != len(channels) or not all(0.0 < level < math.inf for level in self.levels):
            raise ValueError(
                f"RelativeNoise expects one positive response level for each of {len(channels)} channels; got "
                f"{self.levels}: leave out channels without a signal"
            )
        window = None if window is None else as_number(self, "window", window, "[s], or None")
        if window is not None and not 0.0 < window < math.inf:
            raise ValueError(f"RelativeNoise: window must be a positive length [s], or None; got {window!r}")
        object.__setattr__(self, "window", window)
        set_channels(self, channels, sensor)
        set_effective(self, effective_samples)

    @classmethod
    def of(cls, measurements: Measurements, *, window: float | None = None, **options: PerChannel) -> "RelativeNoise":
        """Noise with the root mean squares of the measured channels as levels.

        Parameters
        ----------
        measurements : Measurements
            Missing samples are left out.
        window : float, optional
            As for the class.
        **options
            `sensor` and `effective_samples`, as for the class.
        """
        levels = np.sqrt(np.nanmean(np.square(measurements.values), axis=1))
        return cls(measurements.channels, levels, window=window, **options)

    def __repr__(self) -> str:
        named = [f"{c.name}: {c.quantity} / {level!r}" for c, level in zip(self.channels, self.levels, strict=True)]
        named += [] if self.window is None else [f"window={self.window!r}"]
        return f"RelativeNoise({', '.join(named + options_repr(self.sensor, self.effective_samples))})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``share_<channel>``: standard deviations as shares of the response levels [-]."""
        return tuple(f"share_{channel.name}" for channel in self.channels)

    def log_likelihood(self, misfit: np.ndarray, n_samples: int | SampleCounts, shares: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        misfit : (n, n_channels) float
            Sums of squared residuals over the samples [SI unit of the channel, squared]; NaN where the simulation
            failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel where samples are missing.
        shares : (n, n_channels) float
            Parameters of the noise.

        Returns
        -------
        (n,) float
            As `GaussianNoise.log_likelihood`; -inf for impossible shares, negative or 1 or more.
        """
        return white_log_likelihood(misfit, n_samples, self.standard_deviations(shares), self.effective_samples)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) of the errors of the measurements [SI], sensor noise included.

        NaN for shares of 1 or more, and for negative ones where sensor noise is given.
        """
        shares = np.asarray(parameters, dtype=float)
        return total_deviations(np.where(shares < 1.0, shares, np.nan) * np.array(self.levels), self.sensor)

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> "tuple[RelativeNoise, np.ndarray]":
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`."""
        levels, sensor = weighted(self.levels, weights), weighted(self.sensor, weights)
        return RelativeNoise(channels, levels, window=self.window, sensor=sensor), weights

    def response_deviations(self, shares: np.ndarray, response: np.ndarray, dt: float) -> np.ndarray:
        """Standard deviations of the errors of a simulated response.

        Parameters
        ----------
        shares : (n_channels,) float
            Parameters of the noise, below 1.
        response : (n_channels, n_steps) float
            Response [SI unit of each channel].
        dt : float
            Its time step [s].

        Returns
        -------
        (n_channels, n_steps) float
            Sensor noise and share of the level together [SI unit of each channel]: the level is that of response and
            error, sigma^2 = (sensor^2 + share^2 R^2) / (1 - share^2) with the root mean square R of the response.
        """
        floor = np.zeros(len(self.channels)) if self.sensor is None else np.array(self.sensor)
        level = local_level(response, None if self.window is None else self.window / dt)
        shares = np.asarray(shares, dtype=float)[:, None]
        return np.hypot(floor[:, None], shares * level) / np.sqrt((1.0 - shares) * (1.0 + shares))


def local_level(response: np.ndarray, steps: float | None) -> np.ndarray:
    """Root mean square of histories within a window around each step.

    Parameters
    ----------
    response : (n_channels, n_steps) float
        Histories.
    steps : float or None
        Length of the window in steps, rounded to an odd number; None for all steps. At the ends of the histories the
        window contains the steps that are there.

    Returns
    -------
    (n_channels, n_steps) float
    """
    squares = np.square(response)
    n = squares.shape[1]
    if steps is None or steps >= 2 * n:
        return np.broadcast_to(np.sqrt(squares.mean(axis=1, keepdims=True)), squares.shape)
    half = round(0.5 * (steps - 1.0)) if steps > 1.0 else 0
    sums = np.concatenate([np.zeros((len(squares), 1)), np.cumsum(squares, axis=1)], axis=1)
    first, stop = np.maximum(np.arange(n) - half, 0), np.minimum(np.arange(n) + half + 1, n)
    means = (sums[:, stop] - sums[:, first]) / (stop - first)
    return np.sqrt(np.maximum(means, 0.0))
