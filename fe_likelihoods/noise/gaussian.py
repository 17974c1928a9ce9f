r"""Gaussian noise: levels per channel or event, in SI units or as shares of a signal.

The errors, differences between a measured and a simulated response, are Gaussian and independent between channels. The
likelihood then needs only a few sums of the residuals per channel (sufficient statistics,
`fe_likelihoods.noise.groups`) instead of the response, so a changed noise parameter needs no simulation. The variance
of a sample is

.. math:: \sigma^2 = s^2 + (a\, l)^2

with the known sensor noise :math:`s`, an unknown parameter :math:`a`, and a reference :math:`l`, which is one
(standard deviations in SI units), the level of the measured channel (``shares_of="measured"``) or the level of the
simulated response (``shares_of="response"``).

Real measurements differ from a model by more than sensor noise, and the differences are correlated in time. White noise
counts the n samples of a channel as n independent observations, which makes the posterior too narrow:
`fe_likelihoods.noise.residuals` has checks of this assumption and estimates the effective number of samples. Equations
and sources are on the page ``docs/theory/noise.rst``.
"""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, fields, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..priors.truncated_normal_integrals import HALF_LOG_TWO_PI
from ..signals.channels import Channel, Measurements
from ..signals.records import EventWindow, events_of, find_events
from ..signals.sampling import SAME_TIME
from .groups import EventSums, GroupSums, Layout, PartSums, split_sums
from .option_checks import (
    PerChannel,
    as_number,
    checked_channels,
    only_if,
    per_channel,
    sensor_levels,
    shown,
    weighted,
)
from .response_level import events_of_parts, local_level, squared_levels
from .sufficient_statistics import SampleCounts, samples_per_channel

_PARTS = 3  # parts of a window; the window moves by one part
_LOCAL = 0.25  # see docs/theory/noise.rst
_RESPONSE, _SHARES = 'shares_of="response"', 'shares_of="measured" or "response"'


@dataclass(frozen=True, repr=False)
class GaussianNoise:
    r"""Gaussian noise with one unknown level per channel, or per channel and event.

    Parameters
    ----------
    channels : sequence of Channel
        The measured channels, in the order of the model.
    groups : {"channel", "all", "event"}
        What has a level: each channel; all channels together; or each channel in each event, for a model whose
        excitation is `fe_likelihoods.Events`.
    shares_of : {"measured", "response"}, optional
        Levels are shares of the measured root mean square, in predictions of the simulated one; or of the simulated
        response level. Default: they are standard deviations in the SI unit of the channel.
    window : float, optional
        Length of the moving window for the root mean square of the response [s; steps in a test without time]. Longer
        than a period of the response, shorter than the strong part of the motion. Needed for shares of the response.
        For shares of the measured channel it is used in predictions only, by default the whole motion.
    local : float, optional
        For shares of the response: weight of the response envelope in the variance, from 0 to 1 (0.25). The rest is the
        weight of the mean square over the whole response.
    sensor : mapping of channel names to float, or sequence of float, optional
        Known standard deviations of the sensor noise [SI unit of the channel], one per channel; zero for names that are
        left out. The parameters are then levels of the model error, and may be zero. ``shares_of="response"`` needs
        positive values: they are the standard deviations where the response is zero.
    effective_samples : mapping of channel names to float, or sequence of float, optional
        Number of independent samples that each channel is worth (`residual_checks(...).n_effective`), at most the
        number of samples, which is also the default for names that are left out.
    scales, layout, events, measured, of_parts
        Root mean squares of the measured channels [SI], of which the level of ``groups="all"`` and the shares of
        ``shares_of="measured"`` are multiples; sample times; events; the measured (event, channel) pairs; the events of
        parts of the time. Set by the likelihood (`with_measurements`, `under`) and by predictions.

    Raises
    ------
    ValueError
        For no channel, an unknown channel, an impossible combination, or a missing or impossible option.

    Notes
    -----
    =========== ============== =========================== =======================================================
    groups      shares_of      parameters                  for
    =========== ============== =========================== =======================================================
    "channel"   None           ``sigma_<channel>``         synthetic data, thinned measurements
    "all"       None           ``sigma``                   one noise-to-signal ratio
    "event"     None           ``sigma_<channel>_<event>`` sensors and errors that change from test to test
    "channel"   "measured"     ``share_<channel>``         predictions of weaker or stronger motions
    "channel"   "response"     ``share_<channel>``         the same, and evidences: a normalised density
    "all"       as "channel"   ``share``                   one share for all channels
    =========== ============== =========================== =======================================================

    Equations and sources are on the page ``docs/theory/noise.rst``.

    With effective samples, the term of a channel is multiplied by n_eff / n, which has the effect of thinning without
    discarding any. The result is not a density of the measurements, so evidences can be compared only between models
    with the same n_eff.

    Shares of the measured channel must be below 1, since the model would explain nothing. Evidences compare them with
    other noises only approximately, because the level is computed from the measurements.

    A share of the response that was calibrated on a part of a motion, with a gap, or with a long quiet end refers to
    another mean square than the whole motion has: calibrate and predict whole motions, or use ``local=1``. Do not
    choose `local` by the evidence alone: where the model is wrong, a `local` near 1 may prefer a response that is too
    large, because it permits larger errors. Compare the RRMSE of the fit without shares. The
    statistics are not quadratic in the residuals, so samplers cannot use a guide.

    Examples
    --------
    >>> GaussianNoise(model.channels).parameter_names
    ('sigma_acceleration', 'sigma_displacement')

    Errors that grow with the response, beside a known noise of the sensors [SI]:

    >>> shares = GaussianNoise(model.channels, shares_of="response", window=1.0, sensor=[0.01, 0.001])
    >>> shares.parameter_names
    ('share_acceleration', 'share_displacement')
    """

    channels: Sequence[Channel]
    _: KW_ONLY
    groups: Literal["channel", "all", "event"] = "channel"
    shares_of: Literal["measured", "response"] | None = None
    window: float | None = None
    local: float | None = None
    sensor: PerChannel = None
    effective_samples: PerChannel = None
    scales: tuple[float, ...] | None = None
    layout: Layout | None = None
    events: tuple[EventWindow, ...] = ()
    measured: tuple[tuple[int, int], ...] = ()
    of_parts: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", checked_channels(self, self.channels))
        for name, known in (("groups", ("channel", "all", "event")), ("shares_of", (None, "measured", "response"))):
            if getattr(self, name) not in known:
                raise ValueError(f"GaussianNoise: {name} must be one of {known}; got {getattr(self, name)!r}")
        if self.groups == "event" and self.shares_of:
            raise ValueError('GaussianNoise: groups="event" has levels in SI units alone; leave shares_of out')
        self._check_options()

    def _check_options(self) -> None:
        """Set options as floats, with their defaults; ValueError if one is missing or has no meaning here."""
        positive, local = lambda x: 0.0 < x < math.inf, "from 0 (one level for the motion) to 1 (the envelope)"
        for name, means, default, where, meaning, possible in (
            ("window", self.shares_of is not None, None, _SHARES, "a positive length [s]", positive),
            ("local", self.shares_of == "response", _LOCAL, _RESPONSE, local, lambda x: 0.0 <= x <= 1.0),
        ):
            if (value := self._option(name, means, where, default)) is not None:
                object.__setattr__(self, name, as_number(self, name, value, meaning, possible))
        if self.shares_of == "response" and self.window is None:
            raise ValueError(
                'GaussianNoise: shares_of="response" needs window=, a length [s] in which the level of the response is '
                "taken: longer than a period of the response, shorter than the strong part of the motion"
            )
        object.__setattr__(self, "sensor", sensor_levels(self, self.channels, self.sensor))
        if self.shares_of == "response" and not all(level > 0.0 for level in self.sensor or (0.0,)):
            raise ValueError(
                'GaussianNoise: shares_of="response" needs the noise of the sensor of each channel, a positive '
                f"standard deviation in SI units, for parts in which the response is zero; got {self.sensor!r}. Take "
                "it from the quiet part before the motion, or from the resolution of the sensor, or use levels in SI "
                "units"
            )
        whole = 'groups="channel" and "all", without shares_of or with shares_of="measured"'
        given = self._option("effective_samples", self._whole, whole)
        values = per_channel(self, self.channels, "effective_samples", given, math.inf, "of samples")
        if values is not None and not all(value > 0.0 for value in values):
            raise ValueError(f"GaussianNoise: effective_samples must be positive numbers of samples; got {given!r}")
        object.__setattr__(self, "effective_samples", values)
        object.__setattr__(self, "scales", None if self.scales is None else tuple(map(float, self.scales)))

    def _option(self, name: str, means: bool, where: str, default: float | None = None) -> Any:
        """A given option, else its default; ValueError for one that is given and has no meaning here."""
        given = getattr(self, name)
        if given is not None and not means:
            raise ValueError(
                f"GaussianNoise: {name}= is for {where}; got {name}={given!r} with groups={self.groups!r} and "
                f"shares_of={self.shares_of!r}: leave it out"
            )
        return default if given is None and means else given

    # ------------------------------------------------------------------ kind and names

    @cached_property
    def _whole(self) -> bool:
        """Whether the sums of squares over all samples are sufficient."""
        return self.groups != "event" and self.shares_of != "response"

    @cached_property
    def _scaled(self) -> bool:
        """Whether parameters are multiples of channel scales."""
        return self.shares_of == "measured" or (self.shares_of is None and self.groups == "all")

    @cached_property
    def white(self) -> bool:
        """Whether errors are white, with levels in SI units for the whole measurements."""
        return self._whole and self.shares_of is None

    @property
    def title(self) -> str:
        """Class and options, without channels and numbers per channel, for reports."""
        options = shown((), self._options(("groups", "shares_of", "window", "local")))
        return type(self).__name__ + (f"({options})" if options else "")

    def __repr__(self) -> str:
        # measurements and model determine the fields left out, so fingerprints need not contain them
        bound = ("channels", "layout", "events", "measured", "of_parts")
        names = [field.name for field in fields(self) if field.name not in bound]
        return f"{type(self).__name__}({shown(self.channels, self._options(names))})"

    def _options(self, names: Sequence[str]) -> dict[str, Any]:
        default = {"groups": "channel"}
        return {name: getattr(self, name) for name in names if getattr(self, name) != default.get(name)}

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """``sigma_...`` [SI unit of the channel] or ``share_...`` [-], see the table of the class.

        Levels per event are known when the likelihood has set the events; ValueError before.
        """
        kind, names = "sigma" if self.shares_of is None else "share", [channel.name for channel in self.channels]
        if self.groups == "all":
            return (kind,)
        if self.groups == "event":
            self._bound(self.events)
            return tuple(f"{kind}_{names[row]}_{self.events[event].name}" for event, row in self.measured)
        return tuple(f"{kind}_{name}" for name in names)

    @property
    def parameter_channels(self) -> dict[str, Channel]:
        """Channels by the names of parameters that are standard deviations in the channel's unit."""
        if self.shares_of is not None or self.groups == "all":
            return {}
        rows = [row for _, row in self.measured] if self.groups == "event" else range(len(self.channels))
        return {name: self.channels[row] for name, row in zip(self.parameter_names, rows, strict=True)}

    @property
    def statistic(self) -> GroupSums | None:
        """Sufficient statistic of the residuals; None if the sums of squares over all samples are sufficient."""
        return None if self._whole else self._sums()

    def _sums(self, dt: float | Sequence[float] | None = None) -> Any:
        """Sums in groups of the measured samples, or of a response with the step `dt` from time zero."""
        if dt is not None:
            steps = tuple(np.broadcast_to(np.asarray(dt, dtype=float), len(self.channels)).tolist())
            layout = Layout(steps, (0.0,) * len(steps), ())
        else:
            layout = self._bound(self.layout)
        if self.groups == "event":
            step = layout.steps[0]
            return EventSums(
                tuple(
                    (math.ceil(each.start / step - SAME_TIME), math.floor(each.end / step + SAME_TIME) + 1)
                    for each in self.events
                )
            )
        return PartSums(self.window / _PARTS, layout.steps, layout.starts)

    def _bound(self, value: Any) -> Any:
        if not value:
            raise ValueError(
                f"{self.title} needs the times of the samples, their root mean squares and the excitation: take the "
                "noise of a likelihood, FELikelihood(model, measurements, noise).noise"
            )
        return value

    # ------------------------------------------------------------------ measurements and excitation

    def under(self, model: Any, first: int = 0) -> "GaussianNoise":
        """The same noise under the excitation of a model, whose response begins at the step `first`.

        Raises
        ------
        ValueError
            If the noise has levels per event and the excitation is not `fe_likelihoods.Events`; if the window is
            shorter than three time steps of the model or longer than an event.
        """
        if self.groups == "event" and not self.events:
            return replace(self, events=events_of(model).windows)
        if self.shares_of != "response":
            return self
        self._check_step(model.dt)
        events = find_events(model)
        for each in () if events is None else events.windows:
            if self.window > each.end - each.start + (1.0 + SAME_TIME) * model.dt:
                raise ValueError(
                    f"GaussianNoise: the window of {self.window:g} s must not be longer than an event; {each.name!r} "
                    f"has {each.end - each.start:g} s: give a shorter window, or leave out this event"
                )
        return replace(self, of_parts=events_of_parts(model, self.window / _PARTS, first))

    def with_measurements(self, measurements: Measurements) -> "GaussianNoise":
        """The same noise with the sample times of these measurements, and their scales if none are set.

        Raises
        ------
        ValueError
            If the channels are different; the window is shorter than three time steps; or with events, if channels have
            different times or a sample is outside of every event.
        """
        names, got = ([channel.name for channel in each.channels] for each in (self, measurements))
        if names != got:
            raise ValueError(f"expected measurements of {', '.join(names)}; got {', '.join(got)}: select({names!r})")
        if self._scaled and self.scales is None:
            if silent := [name for name, rms in zip(names, measurements.root_mean_squares, strict=True) if not rms]:
                raise ValueError(f"GaussianNoise: {', '.join(silent)} is zero at all samples: leave it out, select()")
            return replace(self, scales=measurements.root_mean_squares)
        if self._whole:
            return self
        layout = Layout(tuple(measurements.steps), tuple(measurements.starts), ())
        placed, there = replace(self, layout=layout), ~np.isnan(measurements.values)
        sums = placed._sums()
        if self.groups == "event":
            self._check_events(measurements, there, sums)
        else:
            self._check_step(max(layout.steps))
        counts = sums.counts(there)
        measured = self.measured
        if self.groups == "event":
            found = tuple(zip(*(each.tolist() for each in np.nonzero(counts)), strict=True))
            measured = measured or found
            if unknown := [self.channels[row].name for event, row in found if (event, row) not in measured]:
                raise ValueError(
                    f"the noise has no level for {', '.join(unknown)} in an event in which they are measured: make a "
                    'new GaussianNoise(model.channels, groups="event")'
                )
        return replace(placed, layout=layout._replace(counts=tuple(map(tuple, counts.tolist()))), measured=measured)

    def _check_step(self, dt: float) -> None:
        if self.window < (_PARTS - SAME_TIME) * dt:
            raise ValueError(
                f"GaussianNoise: the window of {self.window:g} s must be at least three steps of {dt:g} s; give a "
                "longer one, or a motion with a shorter time step (Record.resample)"
            )

    def _check_events(self, measurements: Measurements, there: np.ndarray, sums: EventSums) -> None:
        if not measurements.simultaneous or measurements.start != 0.0:
            raise ValueError(
                'groups="event" needs channels with the same times, from the first sample of the record; use '
                "Events.join, or a noise for all events"
            )
        outside = there.copy()
        for first, stop in sums.windows:
            outside[:, first:stop] = False
        if outside.any():
            place = int(np.argmax(outside.any(axis=0)))
            raise ValueError(
                f"{int(outside.sum())} measured samples are outside of every event, the first at "
                f"{place * measurements.dt:g} s; the events are at "
                f"{', '.join(f'{e.start:g} to {e.end:g} s' for e in self.events)}: put NaN there, as Events.join does, "
                "or use a noise for all samples"
            )

    def with_channels(self, channels: Sequence[Channel], weights: np.ndarray) -> "tuple[GaussianNoise, np.ndarray]":
        """Noise of other channels, with the weights of the parameters; see `fe_likelihoods.noise.protocol.Noise`.

        With events, a channel's level in an event is the weighted mean level of the channels measured in this event.
        """
        others = replace(
            self,
            channels=channels,
            sensor=weighted(self.sensor, weights),
            scales=weighted(self.scales, weights),
            effective_samples=None,
            layout=None,
        )
        if self.groups != "event":
            return others, np.eye(1) if self.groups == "all" else np.asarray(weights, dtype=float)
        measured, rows = [], []
        for event in range(len(self.events)):
            known = np.array([row if number == event else -1 for number, row in self.measured])
            for other, of_channels in enumerate(weights):
                row = np.where(known >= 0, of_channels[known], 0.0)
                if row.any():
                    measured.append((event, other))
                    rows.append(row / row.sum())
        return replace(others, measured=tuple(measured)), np.array(rows).reshape(-1, len(self.measured))

    # ------------------------------------------------------------------ densities

    def log_likelihood(
        self, statistics: np.ndarray, n_samples: int | SampleCounts, parameters: np.ndarray
    ) -> np.ndarray:
        """Log-likelihood (n,) of the measurements, as of `fe_likelihoods.noise.protocol.Noise`; never NaN.

        Parameters are impossible if they are negative, zero without sensor noise, or for shares of the measured channel
        1 or more. ValueError if the noise does not know the measurements, or knows others.
        """
        statistics, n_channels = np.asarray(statistics, dtype=float), len(self.channels)
        samples, power = samples_per_channel(n_samples), None
        if self._whole:
            counts, squares = samples, statistics[:, None]
        else:
            counts = np.array(self._bound(self.layout).counts)
            if (counts.sum(axis=0) != samples).any():
                raise ValueError(
                    f"the noise is for {counts.sum(axis=0).tolist()} samples per channel, the measurements have "
                    f"{samples}: take the noise of a likelihood of these measurements"
                )
            squares, *powers = split_sums(statistics, n_channels, len(counts))
            power = powers[0] if powers else None
        deviations = self._deviations(parameters, counts, power)
        with np.errstate(all="ignore"):
            # the ratio is squared instead of sigma: the square of a tiny sigma would be zero, and 0 / 0 for zero misfit
            ratio = np.sqrt(squares) / deviations
            terms = -counts * (HALF_LOG_TWO_PI + np.log(deviations)) - 0.5 * ratio * ratio
            if self.effective_samples is not None:
                terms = terms * np.minimum(np.array(self.effective_samples) / counts, 1.0)
        # a channel without samples in a stretch has the level zero there, which nothing is compared with
        possible = ((deviations > 0.0) | (counts == 0)) & (deviations < np.inf) & np.isfinite(squares)
        return np.where(possible, np.where(counts > 0, terms, 0.0), -np.inf).sum(axis=(1, 2))

    def _deviations(self, parameters: np.ndarray, counts: np.ndarray, power: np.ndarray | None = None) -> np.ndarray:
        """Standard deviations (n, n_groups, n_channels) of the coordinates; NaN for impossible parameters.

        `counts` (n_groups, n_channels) are the numbers of coordinates, `power` (n, n_groups, n_channels) is the
        response's sums of squares.
        """
        values, levels = self._values(parameters, 1.0), np.ones(1)
        if self.white and self.sensor is None and not self._scaled:
            return np.where(values >= 0.0, values, np.nan)  # the usual noise takes the short way
        if self._scaled:
            levels = self._scales
        elif self.shares_of == "response":
            with np.errstate(invalid="ignore"):
                levels = np.sqrt(squared_levels(power, counts, self.local, self.of_parts))
        return self._with_sensor(values, levels)

    def _with_sensor(self, values: np.ndarray, levels: np.ndarray) -> np.ndarray:
        """Sensor noise and model error together; NaN for impossible parameters."""
        with np.errstate(invalid="ignore"):
            impossible = ~(values >= 0.0) | ((values >= 1.0) & (self.shares_of == "measured"))
            return np.where(impossible, np.nan, np.hypot(self._floor, values * levels))

    def _values(self, parameters: np.ndarray, unknown: float) -> np.ndarray:
        """Parameters (n, n_noise) by group and channel, (n, events or 1, n_channels or 1)."""
        parameters = np.asarray(parameters, dtype=float)
        if self.groups != "event":
            return parameters[:, None, :]
        values = np.full((len(parameters), len(self.events), len(self.channels)), unknown)
        for column, (event, row) in enumerate(self.measured):
            values[:, event, row] = parameters[:, column]
        return values

    @cached_property
    def _floor(self) -> np.ndarray:
        return np.zeros(len(self.channels)) if self.sensor is None else np.array(self.sensor)

    @cached_property
    def _scales(self) -> np.ndarray:
        return np.array(self._bound(self.scales))

    # ------------------------------------------------------------------ predictions and checks

    @only_if(lambda noise: noise.groups != "event")
    def standard_deviations(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_channels) [SI] of the errors, sensor noise included; NaN for impossible parameters.

        With shares of the response, the sensor noise alone: see `response_deviations`.
        """
        values, levels = self._values(parameters, 1.0), np.ones(1)
        if self.shares_of == "response":
            levels = np.zeros(1)
        elif self._scaled:
            levels = self._scales
        return self._with_sensor(values, levels)[:, 0]

    @only_if(lambda noise: noise.groups == "event")
    def deviations_per_event(self, parameters: np.ndarray) -> np.ndarray:
        """Standard deviations (n, n_events, n_channels) of the errors [SI]; NaN where there is no level.

        Negative parameters, which are impossible, are returned unchanged.
        """
        values = self._values(parameters, np.nan)
        return np.where(values < 0.0, values, np.hypot(self._floor, values))

    @only_if(lambda noise: noise.shares_of is not None)
    def response_deviations(
        self, parameters: np.ndarray, response: np.ndarray, dt: float | Sequence[float] | None = None
    ) -> np.ndarray:
        """Standard deviations (n_channels, n_steps) [SI] of the errors for a simulated response; NaN where it is NaN.

        A response with a step `dt` [s] begins at time zero; by default it is at the measured samples. Shares of the
        measured channel need the step.
        """
        if self.shares_of == "measured":
            level = local_level(response, None if self.window is None else self.window / dt)
            shares = np.asarray(parameters, dtype=float)[:, None]
            return np.hypot(self._floor[:, None], shares * level) / np.sqrt((1.0 - shares) * (1.0 + shares))
        response = np.asarray(response, dtype=float)
        sums, deviations = self._of_response(parameters, response, dt)
        return sums.in_time(deviations, ~np.isnan(response))

    def _of_response(
        self, parameters: np.ndarray, response: np.ndarray, dt: float | Sequence[float] | None
    ) -> tuple[Any, np.ndarray]:
        """The groups of a response, and the standard deviations (n_groups, n_channels) of one sample."""
        sums, there = self._sums(dt), ~np.isnan(response)
        power = sums.powers(response, there)[None]
        return sums, self._deviations(np.asarray(parameters, dtype=float)[None], sums.counts(there), power)[0]

    @only_if(lambda noise: noise.shares_of == "response")
    def whitened(self, residuals: np.ndarray, response: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        """Residuals (n_channels, n_samples) by their standard deviations.

        They are white, with a standard deviation of one, if the noise fits. All at the measured samples [SI].
        """
        sums, deviations = self._of_response(parameters, np.where(np.isnan(residuals), np.nan, response), None)
        return sums.whitened(residuals, deviations)
