r"""White noise whose standard deviation follows the simulated response in time, in the likelihood and in predictions.

The error of a model grows with the response: it is larger in the strong part of a motion than before and after it.
`ModulatedNoise` is Gaussian and independent from sample to sample, with the standard deviation

.. math:: \sigma_{ck}^2 = s_c^2 + (a_c\, l_{ck}(\theta))^2

of sample k of channel c: the known noise :math:`s_c` of the sensor, and the unknown share :math:`a_c` of the level
:math:`l_{ck}` of the simulated response. Its square is a mean of the squared envelope, a moving root mean square, and
of the mean square of the whole response, because errors last longer than the strong response that causes them. Because
the level is that of the simulation, the likelihood is a normalised density of the measurements, and a prediction has
the same noise. In a test with an imposed deformation, the level also grows with the largest deformation reached.

See ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.events import find_events
from .gaussian import HALF_LOG_TWO_PI, PerChannel, as_number, options_repr, set_channels, weighted
from .grouped import MeasuredLayout, grouped_log_likelihood, per_channel, split_sums, without_layout
from .levels import Excited, excited_parts, squared_levels
from .sample_counts import SampleCounts

__all__ = ["ModulatedNoise", "PartSums"]

_PARTS = 3  # parts of a window, in steps of which it moves
_ROUND_OFF = 1e-6  # of a part
_GROWTH = 0.25  # see docs/theory/noise.rst
_LARGEST_GAP = 0.05  # part of the samples of a channel


@dataclass(frozen=True)
class PartSums:
    """Statistic of the residuals and of the response: sums of squares in short parts of the time.

    Parameters
    ----------
    part : float
        Length of a part [s].
    steps, starts : tuple of float
        Time step and time of the first sample of each channel [s].
    """

    part: float
    steps: tuple[float, ...]
    starts: tuple[float, ...]

    of_response: ClassVar[bool] = True

    def __call__(self, residuals: np.ndarray, response: np.ndarray) -> np.ndarray:
        """Return the sums (n_numbers,) [SI unit of the channel, squared].

        Those of the residuals of all samples, then those of the residuals in each part, then those of the response in
        each part; (n_channels,) each. Samples with residuals of NaN are left out.
        """
        places, there = self.places(residuals.shape[1]), ~np.isnan(residuals)
        squares = [np.square(residuals), np.square(response)]
        sums = [sums_of_parts(each, places, there) for each in squares]
        return np.concatenate([np.nansum(squares[0], axis=1), *(each.ravel() for each in sums)])

    def places(self, n_steps: int) -> np.ndarray:
        """Part of each sample (n_channels, n_steps)."""
        return _places(self, n_steps)


@lru_cache(maxsize=64)  # the same for every simulation
def _places(sums: PartSums, n_steps: int) -> np.ndarray:
    times = np.array(sums.starts)[:, None] + np.array(sums.steps)[:, None] * np.arange(n_steps)
    places = np.maximum(np.floor(times / sums.part + _ROUND_OFF).astype(int), 0)
    places.flags.writeable = False
    return places


def sums_of_parts(values: np.ndarray, places: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Sums (n_parts, n_channels) of the values (n_channels, n_steps) that are there in each part."""
    n_parts = int(places.max()) + 1
    return np.stack(
        [
            np.bincount(place[known], row[known], minlength=n_parts)
            for row, place, known in zip(values, places, there, strict=True)
        ],
        axis=1,
    )


@dataclass(frozen=True)
class ModulatedNoise:
    """Independent Gaussian noise with an unknown share of the level of the simulated response per channel.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the model.
    window : float
        Length of the window [s] in which the root mean square of the response is taken: longer than a period of the
        response, and shorter than the strong part of the motion. In a test without time [steps].
    sensor : mapping of channel names to float, or sequence of float
        Known standard deviation of the noise of each sensor [SI unit of the channel], positive: the standard deviation
        of the error where the level is zero.
    local : float
        Part of the variance that follows the envelope of the response, from 0 to 1; the other part is that of the whole
        response. 0 is one level for the whole motion, 1 the envelope alone.
    deformation : float, optional
        For a test with an imposed deformation: the deformation at which the standard deviation is the share of the
        level [m; - for a strain], such as 1 % of the height of a column. The standard deviation is then proportional to
        a power of the largest deformation reached. Give specimens of different size each their own.
    growth : float, optional
        This power, 0.25 by default. Only with `deformation`.
    layout : MeasuredLayout, optional
        Times of the samples; set by the likelihood (`with_measurements`).
    excited : Excited, optional
        Events and imposed deformation; set by the likelihood and by predictions (`under`).

    Raises
    ------
    ValueError
        If the window is not positive, a channel has no sensor noise, `local` is not between 0 and 1, the deformation is
        not positive, or `growth` is given without it.

    Notes
    -----
    The window moves in steps of a third of its length, so that the level is constant within these parts of the time::

        l^2 = ((1 - local) R^2 + local e^2) (d / deformation)^(2 growth)

    with the mean square e^2 of the response in a part and its two neighbours, the mean square R^2 of the response in
    the whole motion, and the largest deformation d up to the middle of the part; without `deformation` the last factor
    is one. Parts start at the time zero. Two sums of squares per part and channel, of the residuals and of the
    response, are then sufficient, and a change of the share needs no simulation. A simulation is cached with
    1 + 6 T / window numbers per channel, for a duration of T: 2.9 kB for 60 s and a window of 1 s. `local`,
    `deformation` and `growth` do not change what is cached.

    The mean square R^2 is that of the samples that are there; under `fe_likelihoods.Events` each event, and each
    pause, has its own. The share is the ratio of the root mean squares of error and response, for every `local`, and
    may exceed one. A share that was found in a part of a motion, beside a gap or with a long quiet end therefore
    belongs to another R^2 than the whole motion has: calibrate and predict whole motions, with quiet ends of about the
    same part of the duration, or use ``local=1``, which does not depend on R^2 (``docs/theory/noise.rst``).

    The level depends on the structural parameters, not on the measurements. The likelihood is therefore a normalised
    density, and evidences can be compared with those of `GaussianNoise` and others, unlike those of `RelativeNoise`.

    With the default values of `local` and `growth` the predictions of 13 of 15 cases of real tests are better than with
    noise in SI units, one is equal and one worse (``docs/predictions.rst``). The defaults were chosen on these cases,
    so they are no independent test of them, and coupon and columns were given a `deformation`.

    Do not choose `local` by the evidence alone: where the model is wrong, the likelihood with a `local` near 1 may
    prefer a response that is too large, because it permits larger errors. Compare the RRMSE of the fit with that under
    `GaussianNoise` (`fit_measures`); predictions warn of it.

    The statistics are not quadratic in the residuals, so samplers cannot use a guide (`fe_likelihoods.ResponseGuide`).
    Sums over the samples that are there take the place of all where samples are missing.

    Examples
    --------
    >>> noise = ModulatedNoise(model.channels, window=1.0, sensor={"top": 0.005})
    >>> posterior = Posterior(FELikelihood(model, measurements, noise), prior | {"share_top": HalfNormal(0.5)})
    >>> propagate(posterior, samples, record=weaker, noise=True)  # noise of the weaker response
    """

    channels: tuple[Channel, ...]
    window: float
    sensor: tuple[float, ...]
    local: float
    deformation: float | None
    growth: float | None
    layout: MeasuredLayout | None
    excited: Excited

    def __init__(
        self,
        channels: Sequence[Channel],
        *,
        window: float,
        sensor: PerChannel,
        local: float = 0.25,
        deformation: float | None = None,
        growth: float | None = None,
        layout: MeasuredLayout | None = None,
        excited: Excited = Excited(),
    ) -> None:
        window = as_number(self, "window", window, "[s]")
        if not 0.0 < window < math.inf:
            raise ValueError(f"ModulatedNoise: window must be a positive length [s]; got {window!r}")
        object.__setattr__(self, "window", window)
        set_channels(self, channels, sensor)
        if self.sensor is None or not all(value > 0.0 for value in self.sensor):
            raise ValueError(
                "ModulatedNoise needs the noise of the sensor of each channel, a positive standard deviation in SI "
                f"units, for the parts where the response is zero; got {sensor!r}. Take it from the quiet part before "
                "the motion, or from the resolution of the sensor"
            )
        local = as_number(self, "local", local, "[-]")
        if not 0.0 <= local <= 1.0:
            raise ValueError(
                f"ModulatedNoise: local must be from 0 (one level for the motion) to 1 (the envelope); got {local:g}"
            )
        if deformation is None and growth is not None:
            raise ValueError(
                f"ModulatedNoise: growth is the power of a deformation; got growth={growth!r} without deformation=, "
                "the one at which the standard deviation is the share of the level: give it, or leave growth out"
            )
        if deformation is not None:
            growth = as_number(self, "growth", _GROWTH if growth is None else growth, "[-]")
            if not 0.0 <= growth < math.inf:
                raise ValueError(f"ModulatedNoise: growth must be an exponent, zero or more; got {growth}")
            deformation = as_number(self, "deformation", deformation, "[m; - for a strain]")
            if not 0.0 < deformation < math.inf:
                raise ValueError(
                    "ModulatedNoise: deformation must be a positive deformation, such as 1 % of the height of a "
                    f"column; got {deformation}"
                )
        object.__setattr__(self, "local", local)
        object.__setattr__(self, "deformation", deformation)
        object.__setattr__(self, "growth", growth)
        object.__setattr__(self, "layout", layout)
        object.__setattr__(self, "excited", excited)

    def __repr__(self) -> str:
        # display units change no value; layout and excitation are those of the measurements and of the model
        named = [f"{channel.name}: {channel.quantity}" for channel in self.channels]
        named += [f"window={self.window!r}", *options_repr(self.sensor), f"local={self.local!r}"]
        if self.deformation is not None:
            named += [f"deformation={self.deformation!r}", f"growth={self.growth!r}"]
        return f"ModulatedNoise({', '.join(named)})"

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """``share_<channel>``: standard deviations as shares of the level of the response [-]."""
        return tuple(f"share_{channel.name}" for channel in self.channels)

    @property
    def statistic(self) -> PartSums:
        """Statistic of the residuals and of the response."""
        if self.layout is None:
            raise without_layout(self)
        return PartSums(self.window / _PARTS, self.layout.steps, self.layout.starts)

    def with_measurements(self, measurements: Measurements) -> "ModulatedNoise":
        """The same noise for the times of these measurements.

        Raises
        ------
        ValueError
            If the window is shorter than three time steps.
        """
        self._check_step(max(measurements.steps))
        sums = PartSums(self.window / _PARTS, tuple(measurements.steps), tuple(measurements.starts))
        there = ~np.isnan(measurements.values)
        counts = sums_of_parts(there.astype(float), sums.places(there.shape[1]), there).astype(int)
        return replace(self, layout=MeasuredLayout(sums.steps, sums.starts, tuple(map(tuple, counts.tolist()))))

    def _check_step(self, dt: float) -> None:
        if self.window < (_PARTS - _ROUND_OFF) * dt:
            raise ValueError(
                f"ModulatedNoise: the window of {self.window:g} s must be at least three steps of {dt:g} s; give a "
                "longer one, or a motion with a shorter time step (Record.resample)"
            )

    def remark_on_gaps(self) -> str:
        """What to say of channels whose share is that of the mean square of a part of the motion, or of an event.

        Empty for a noise without measurements, for ``local=1``, and if at most 5 % of the samples are missing within
        the measured motion. An event without any sample of a channel is no gap of it, since each event has a mean
        square of its own. The events are those of `excited`, which must be those of the measurements.
        """
        if self.layout is None or self.local == 1.0:
            return ""
        named, counts, events = [], np.array(self.layout.counts), self.excited.events
        for channel, step, row in zip(self.channels, self.layout.steps, counts.T, strict=True):
            known = np.flatnonzero(row)
            inside = np.arange(known[0] + 1, known[-1]) if known.size else known  # whole parts
            if events:  # odd numbers; nothing needs to be measured in the pauses
                numbers = np.array(events)[np.minimum(np.arange(len(row)), len(events) - 1)]
                measured = np.unique(numbers[row > 0])  # each event has its own mean square
                inside = inside[(numbers[inside] % 2 == 1) & np.isin(numbers[inside], measured)]
            expected = self.window / _PARTS / step * inside.size
            share = 1.0 - row[inside].sum() / expected if inside.size else 0.0
            named += [f"{channel.name!r} ({share:.0%})"] if share > _LARGEST_GAP else []
        if not named:
            return ""
        return (
            f"ModulatedNoise: samples are missing within the channels {', '.join(named)}. The share is that of the "
            "mean square of the other samples. If the strong part of the motion is missing, the share is too large "
            "and predictions of whole motions too wide: use local=1, whose level is that of samples near by"
        )

    def under(self, model: Any, first: int = 0) -> "ModulatedNoise":
        """The same noise under the excitation of a model, whose response begins at the step `first`.

        Raises
        ------
        ValueError
            If the noise grows with a deformation, and none is imposed on the model; if the window is shorter than three
            time steps of the model, or longer than one of its `fe_likelihoods.Events`.
        """
        self._check_step(model.dt)
        events = find_events(model)
        for each in () if events is None else events.windows:
            if self.window > each.end - each.start + (1.0 + _ROUND_OFF) * model.dt:
                raise ValueError(
                    f"ModulatedNoise: the window of {self.window:g} s must not be longer than an event; {each.name!r} "
                    f"has {each.end - each.start:g} s: give a shorter window, or leave out this event"
                )
        excited = excited_parts(model, self.window / _PARTS, first)
        if self.deformation is not None and not excited.reached:
            raise ValueError(
                "ModulatedNoise: deformation= is for a model under an imposed deformation, with a DisplacementHistory "
                "in its attribute loading or record, or an array (n_steps,) in its attribute deformation or strain; "
                f"this {type(model).__name__} has none: leave deformation out"
            )
        return replace(self, excited=excited)

    def log_likelihood(self, statistics: np.ndarray, n_samples: int | SampleCounts, shares: np.ndarray) -> np.ndarray:
        """Log-likelihood of the measurements.

        Parameters
        ----------
        statistics : (n, n_numbers) float
            Those of `PartSums` [SI unit of the channel, squared]; NaN where the simulation failed.
        n_samples : int or SampleCounts
            Number of samples of every channel, or those of each channel where samples are missing.
        shares : (n, n_channels) float
            Parameters of the noise.

        Returns
        -------
        (n,) float
            -inf for negative shares, and where the statistics are not finite; never NaN.
        """
        if self.layout is None:
            raise without_layout(self)
        counts = np.array(self.layout.counts)
        squares, powers = split_sums(statistics, counts)
        levels = self._levels(powers, counts)
        shares = np.asarray(shares, dtype=float)[:, None]
        return grouped_log_likelihood(squares, counts, self._deviations(shares, levels), n_samples)

    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) of the errors where the level is zero [SI]; NaN for negative shares.

        Elsewhere they depend on the response, see `response_deviations`.
        """
        parameters = np.asarray(parameters, dtype=float)
        return self._deviations(parameters, np.zeros_like(parameters))

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> "tuple[ModulatedNoise, np.ndarray]":
        """Noise of other channels, and the weights of the parameters in its own; see `Noise`."""
        return replace(self, channels=channels, sensor=weighted(self.sensor, weights), layout=None), weights

    def response_deviations(
        self, shares: np.ndarray, response: np.ndarray, dt: float | Sequence[float] | None = None
    ) -> np.ndarray:
        """Standard deviations of the errors of a simulated response.

        Parameters
        ----------
        shares : (n_channels,) float
            Parameters of the noise.
        response : (n_channels, n_steps) float
            Response [SI unit of each channel]; NaN where a sample is missing.
        dt : float or sequence of float, optional
            Its time step [s], of a response from the time zero. Default: the response is at the measured samples.

        Returns
        -------
        (n_channels, n_steps) float
            [SI unit of each channel]; NaN where the response is.
        """
        response = np.asarray(response, dtype=float)
        if dt is None:
            sums = self.statistic
        else:
            steps = per_channel(dt, len(response))
            sums = PartSums(self.window / _PARTS, steps, (0.0,) * len(steps))
        places, there = sums.places(response.shape[1]), ~np.isnan(response)
        power = sums_of_parts(np.square(response), places, there)
        counts = sums_of_parts(np.ones_like(response), places, there)
        levels = np.take_along_axis(self._levels(power[None], counts)[0].T, places, axis=1)
        deviations = self._deviations(np.asarray(shares, dtype=float)[:, None], levels, axis=0)
        return np.where(there, deviations, np.nan)

    def whitened(self, residuals: np.ndarray, response: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Residuals divided by their standard deviations: white, with a standard deviation of one, if the noise fits.

        Parameters
        ----------
        residuals, response : (n_channels, n_samples) float
            At the measured samples [SI unit of each channel]; NaN where a sample is missing.
        shares : (n_channels,) float
            Parameters of the noise.

        Returns
        -------
        (n_channels, n_samples) float
            [-], for `fe_likelihoods.residual_checks`.
        """
        response = np.where(np.isnan(residuals), np.nan, response)
        return residuals / self.response_deviations(shares, response)

    def log_densities(self, residuals: np.ndarray, response: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """Log-density (n_channels, n_samples) of each sample, arguments as for `whitened`; zero where it is missing."""
        response = np.where(np.isnan(residuals), np.nan, response)
        deviations = self.response_deviations(shares, response)
        terms = -HALF_LOG_TWO_PI - np.log(deviations) - 0.5 * np.square(residuals / deviations)
        return np.nan_to_num(terms, nan=0.0)

    def _levels(self, sums: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Levels (n, n_parts, n_channels) from sums of squares of the response."""
        if self.deformation is not None and not self.excited.reached:
            raise without_layout(self)
        with np.errstate(invalid="ignore"):
            return np.sqrt(squared_levels(sums, counts, self.local, self.excited, self.deformation, self.growth))

    def _deviations(self, shares: np.ndarray, levels: np.ndarray, axis: int = -1) -> np.ndarray:
        """Sensor noise and share of the level together; `axis` is that of the channels."""
        floor = np.array(self.sensor)
        floor = floor[:, None] if axis == 0 else floor
        with np.errstate(invalid="ignore"):
            return np.where(shares >= 0.0, np.hypot(floor, shares * levels), np.nan)
