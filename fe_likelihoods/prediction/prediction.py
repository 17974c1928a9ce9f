"""A prediction: the distribution of a quantity over samples, accumulated from responses that arrive in batches.

Mean and variance need one pass, over differences to the first response: "mean square minus squared mean" of the values
themselves loses digits. Quantiles need the values. See ``docs/theory/prediction.rst``.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks.finding import Finding, labelled
from ..noise.draws import SampleNoise
from ..population.event_ratios import EventRatios
from ..signals.channels import Channel, Comparison, Measurements, compare_with
from ..text_tables import number, text_table
from ..units import find_unit
from .model_and_motion import ModelError
from .quantities import Evaluator, measured_quantity
from .scores import HistoryScores, QuantityScores, check_probability, score_histories, score_values

if TYPE_CHECKING:
    import xarray

_IN_DOUBLE = 2**29  # bytes of histories; larger ones are kept in single precision, which has seven digits
_MOST = 2**32  # bytes in single precision: 500 samples of 20 channels with 100 000 steps
_CHUNK = 2**18  # values that are sorted at once


class RunningMoments:
    """Running mean (None before the first sample) and variance of `count` equally shaped arrays."""

    def __init__(self) -> None:
        self.count, self._first, self._sum, self._squares = 0.0, None, 0.0, 0.0

    def add(self, values: np.ndarray, counts: np.ndarray) -> None:
        """Add results `values` (m, ...) that stand for `counts` (m,) samples each."""
        self._first = values[0].copy() if self._first is None else self._first
        self.count += float(counts.sum())
        with np.errstate(over="ignore"):  # unstable responses may have an infinite variance
            shifted = values - self._first
            self._sum = self._sum + np.tensordot(counts, shifted, axes=1)
            self._squares = self._squares + np.tensordot(counts, np.square(shifted, out=shifted), axes=1)

    @property
    def mean(self) -> np.ndarray | None:
        """Mean, shape (...)."""
        return None if self._first is None else self._first + self._sum / self.count

    @property
    def variance(self) -> np.ndarray:
        """Mean squared deviation from the mean, shape (...)."""
        with np.errstate(over="ignore", invalid="ignore"):
            variance = np.maximum(self._squares / self.count - np.square(self._sum / self.count), 0.0)
        return np.where(np.isfinite(self._squares), variance, np.inf)


class Accumulator:
    """Evaluates a quantity of responses and keeps its values: one per response, with noise one per sample.

    `members` are the sample indices of each distinct parameter set; histories are kept if `keep`, for their quantiles.
    """

    def __init__(
        self,
        quantity: Evaluator,
        members: Sequence[np.ndarray],
        noise: SampleNoise | ModelError | None,
        keep: bool,
        entropy: int,
        n_steps: int,
    ) -> None:
        self.quantity, self.members, self.noise, self.keep = quantity, members, noise, keep
        n = sum(len(each) for each in members)
        self.result_of_sample = np.arange(n)  # with noise
        if noise is None:
            for row, each in enumerate(members):
                self.result_of_sample[each] = row
        self.moments = RunningMoments()  # of histories without the noise
        self.noise_variance = RunningMoments()  # of histories; per step for some noises
        self.failed: list[np.ndarray] = []  # indices of samples that are left out
        self.collapsed: list[np.ndarray] = []  # indices of samples whose structure collapsed
        self.reasons: Counter = Counter()  # samples left out per reason, without durations
        self.shape: tuple[int, ...] | None = None  # of a value; None until it is known
        self._entropy = entropy
        shape = quantity.shape if quantity.rows is None else (len(quantity.rows), n_steps)
        if shape is not None:
            self._allocate(shape)

    def _allocate(self, shape: tuple[int, ...]) -> None:
        """Memory for the values, once their shape is known; ValueError for histories beyond the limit."""
        self.shape, histories = shape, self.quantity.rows is not None
        if histories and not self.keep:
            return
        n = self.result_of_sample.max() + 1
        values = n * int(np.prod(shape))
        if histories and 4 * values > _MOST:
            raise ValueError(
                f"quantiles of these histories need {4e-9 * values:.1f} GB, at most {1e-9 * _MOST:.1f} are used: "
                "predict fewer channels, take fewer samples, or use quantiles=() for mean and variance only"
            )
        dtype = np.float32 if histories and 8 * values > _IN_DOUBLE else np.float64
        self._kept = np.empty((n, *shape), dtype=dtype)

    def add(self, start: int, responses: np.ndarray, reasons: list[str]) -> None:
        """Add responses (m, n_channels, n_steps) [SI] of the distinct parameters from index `start` on.

        The reasons say why each simulation failed, empty for a success.
        """
        members, rows = self.members[start : start + len(responses)], self.quantity.rows
        usable = np.array([j for j, reason in enumerate(reasons) if not reason], dtype=int)
        for j, reason in enumerate(reasons):
            if reason:
                self._leave_out(members[j], reason)
        if not len(usable):
            return
        if rows is not None:
            every = len(usable) == len(responses) and rows == list(range(responses.shape[1]))
            histories = responses if every else responses[np.ix_(usable, rows)]
            self.moments.add(histories, np.array([len(members[j]) for j in usable]))
            if self.noise is not None:
                self._add_noisy(histories, responses[usable], [members[j] for j in usable])
            elif self.keep:
                self._keep(start + usable, histories)
        elif self.noise is None:
            values = [self._value(responses[j]) for j in usable]
            self._add_values(values, start + usable, [members[j] for j in usable])
        else:
            for j in usable:
                values = [self._value(responses[j] + self._noise(i, responses[j])) for i in members[j]]
                self._add_values(values, members[j], [np.array([i]) for i in members[j]])

    def _add_noisy(self, histories: np.ndarray, responses: np.ndarray, members: list[np.ndarray]) -> None:
        """Variance of the noise, and a draw of it for each sample, for all channels whichever are wanted."""
        rows, noise = self.quantity.rows, self.noise
        if noise.of_response is None:
            samples = np.concatenate(members)
            self.noise_variance.add(np.square(noise.deviations[samples][..., rows]), np.ones(len(samples)))
        for history, response, samples in zip(histories, responses, members, strict=True):
            for i in samples:
                if noise.of_response is not None:
                    variance = np.square(noise.of_response(noise.deviations[i], response)[rows])
                    self.noise_variance.add(variance[None], np.ones(1))
                if self.keep:
                    self._keep([i], (history + self._noise(i, response)[rows])[None])

    def _add_values(self, values: list[np.ndarray], results: np.ndarray, members: list[np.ndarray]) -> None:
        finite = np.array([bool(np.isfinite(value).all()) for value in values])
        for usable, samples in zip(finite, members, strict=True):
            if not usable:
                self._leave_out(samples, "the quantity is not finite")
        if finite.any():
            rows = np.array(values)[finite]
            self.moments.add(rows, np.array([len(samples) for samples in members])[finite])
            self._keep(np.asarray(results)[finite], rows)

    def _keep(self, results: Sequence[int], values: np.ndarray) -> None:
        largest = float(np.finfo(self._kept.dtype).max)  # unstable responses stay finite in single precision
        self._kept[results] = np.clip(values, -largest, largest)

    def _value(self, response: np.ndarray) -> np.ndarray:
        value = np.asarray(self.quantity.function(response), dtype=float)
        if self.shape is None:
            self._allocate(value.shape)
        if value.shape != self.shape:
            raise ValueError(f"quantity must return one shape for every response; got {self.shape}, then {value.shape}")
        return value

    def _noise(self, sample: int, response: np.ndarray) -> np.ndarray:
        # Each sample has its own random stream, so that its noise depends neither on batches nor on failures.
        rng = np.random.default_rng(np.random.SeedSequence(self._entropy, spawn_key=(1, int(sample))))
        return self.noise.draw(int(sample), response.shape[1], rng, response)

    def _leave_out(self, samples: np.ndarray, reason: str) -> None:
        self.failed.append(samples)
        if reason.startswith("collapse"):
            self.collapsed.append(samples)
        self.reasons[reason] += len(samples)

    def values_of(self, samples: np.ndarray) -> np.ndarray:
        """Values (m, ...) of samples that did not fail."""
        return self._kept[self.result_of_sample[samples]]

    def quantiles(self, samples: np.ndarray, probabilities: Sequence[float]) -> np.ndarray:
        """Quantiles (n_probabilities, ...) over samples that did not fail.

        The k-th of n ordered samples is the quantile k / (n + 1), so a further sample lies inside a band with the
        probability of the band; by numpy's default, 20 samples have bands of 90 % that hold 81 %. Hyndman & Fan (1996),
        The American Statistician 50, 361-365, definition 6.
        """
        kept = self._kept.reshape(len(self._kept), -1)
        results, out = self.result_of_sample[samples], np.empty((len(probabilities), kept.shape[1]))
        columns = max(1, _CHUNK // len(results))
        for start in range(0, kept.shape[1], columns):
            part = slice(start, start + columns)
            out[:, part] = np.quantile(kept[results, part].astype(float), probabilities, axis=0, method="weibull")
        return out.reshape(len(probabilities), *self.shape)


_MOST_ROWS = 50  # of a printed table


@dataclass(frozen=True, eq=False)
class Prediction:
    """Moments and quantiles of a quantity over samples of the parameters.

    The shape of the quantity is written (...): (n_channels, n_steps) for histories, () for a peak. Values are in SI
    units.

    Attributes
    ----------
    mean : ndarray, shape (...)
        Mean. NaN with ratios of events (`fe_likelihoods.EventRatios`), as variance and standard error: the distribution
        has no mean, however many draws are made. Use the median and other quantiles.
    variance : ndarray, shape (...)
        Variance.
    standard_error : ndarray, shape (...)
        Monte Carlo error of `mean`: standard deviation / sqrt(effective sample size).
    probabilities : tuple of float
        Probabilities of the quantiles.
    quantiles : ndarray, shape (n_probabilities, ...)
        Quantiles.
    values : ndarray, shape (n_samples, ...), or None
        The quantity of every sample that did not fail, in their order. None for histories.
    n_samples : int
        Number of samples that did not fail.
    effective_sample_size : float
        Effective number of independent samples, for the Monte Carlo errors.
    failed : ndarray of int, shape (n_failed,)
        Indices of the samples that are left out, because the simulation failed or the quantity is not finite.
    collapsed : ndarray of int, shape (n_collapsed,)
        Indices of the failed samples whose structure collapsed. Mean and quantiles are those of the other structures,
        NaN if there are none.
    failure_reasons : dict of str to int
        Number of samples left out for each reason, without the durations of the simulations.
    channels : tuple of Channel
        Channels of the histories, or the channels whose quantities the values are. Empty for a function of the whole
        response.
    dt : float or None
        Time step of the histories [s], None for other quantities.
    noise : bool
        Whether the measurement noise, or the model error, is included.
    from_state : str
        State of the structure at the beginning: "virgin", before any excitation, or "end", after the excitation with
        which the model was made.
    quantity : object
        The quantity as it was given to `fe_likelihoods.propagate`.
    ratios : EventRatios or None
        Ratios by which the values predict measurements of a new event (`fe_likelihoods.predict_new_event`), else None.
    predicted : ndarray, shape (...), or None
        The value in the new event that the ratios multiply.
    findings : tuple of Finding
        What speaks against the prediction, each with what to do; the warnings of `fe_likelihoods.propagate`.
    data : Measurements or None
        What was measured, if it is along another axis than time, such as load cases, and the histories are along it.
    """

    mean: np.ndarray
    variance: np.ndarray
    standard_error: np.ndarray
    probabilities: tuple[float, ...]
    quantiles: np.ndarray
    values: np.ndarray | None
    n_samples: int
    effective_sample_size: float
    failed: np.ndarray
    failure_reasons: dict[str, int]
    channels: tuple[Channel, ...] = ()
    dt: float | None = None
    noise: bool = False
    from_state: str = "virgin"
    quantity: object = None
    ratios: EventRatios | None = None
    predicted: np.ndarray | None = None
    findings: tuple[Finding, ...] = ()
    collapsed: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    data: Measurements | None = None

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation, shape (...)."""
        return np.sqrt(self.variance)

    @property
    def n_failed(self) -> int:
        """Number of samples that are left out."""
        return len(self.failed)

    @property
    def time(self) -> np.ndarray:
        """Times of the histories, from zero, shape (n_steps,) [s]; ValueError for other quantities."""
        if self.dt is None:
            raise ValueError("this needs the histories of channels: propagate with quantity=None or names of channels")
        return np.arange(self.mean.shape[1]) * self.dt

    def quantile(self, probability: float) -> np.ndarray:
        """Return the quantile, shape (...), for one of the `probabilities`; raise ValueError for another one.

        Examples
        --------
        >>> prediction.quantile(0.95).shape
        (2, 200)
        """
        if probability not in self.probabilities:
            raise ValueError(
                f"no quantile {probability!r} in this prediction, it has {self.probabilities}: propagate with "
                f"quantiles=(..., {probability!r})"
            )
        return self.quantiles[self.probabilities.index(probability)]

    def score(
        self, measured: Measurements | ArrayLike, interval_probability: float = 0.9, part: slice = slice(None)
    ) -> HistoryScores | QuantityScores:
        """Compute proper scores, coverage and sharpness; ``print(prediction.score(measurements))`` is a table.

        Parameters
        ----------
        measured : Measurements or array_like
            Measurements of all channels, over the time of the histories. Missing samples are left out. Where a channel
            has times of its own, the histories are interpolated there (quantiles too, which is approximate). For
            quantities other than histories also the measured values themselves [SI], in the shape of the quantity. From
            `Measurements` the quantity, such as a peak, is computed as it was from the responses.
        interval_probability : float
            Probability of the scored intervals, between 0 and 1. For histories, the prediction must have the quantiles
            with the probabilities (1 - p) / 2 and (1 + p) / 2, which a default prediction has for 0.9.
        part : slice
            The samples of the histories to score. Default: all.

        Returns
        -------
        HistoryScores or QuantityScores
            Scores per channel for histories, per quantity for other quantities.

        Raises
        ------
        ValueError
            If the measurements lack a channel or have samples outside the histories, a measured channel is zero or has
            no sample in the part, or the histories are from one sample or have no such quantiles. For other quantities:
            if the measured values have another shape, samples of the channel are missing, or measurements are given
            for a function of the whole response. If less than one sample is expected on each side of the intervals (20
            samples for 0.9).

        Notes
        -----
        Measurements contain the model error and sensor noise: score a prediction with ``noise=True``. A band of the
        response alone covers fewer of them. For histories, the CRPS is computed for normal
        distributions with the predicted means and standard deviations, because the samples of histories are not kept.

        Examples
        --------
        >>> scores = prediction.score(measurements)
        >>> print(scores)
        channel       unit    RMS  RRMSE    CRPS  interval score ...
        acceleration     g ...
        displacement    cm ...
        """
        check_probability(interval_probability)
        if self.dt is None:
            return self._score_values(measured, interval_probability)
        if not isinstance(measured, Measurements):
            raise ValueError(f"score: a prediction of histories needs Measurements; got {type(measured).__name__}")
        compared = self._compared(measured)
        own_times = isinstance(compared, Comparison)
        values, at = (compared.values, compared.at_samples) if own_times else (compared, np.asarray)
        half = 0.5 * interval_probability
        ends = self._near_quantile(0.5 - half), self._near_quantile(0.5 + half)
        # Interpolated ends of a narrow band may cross: their order is nearer to the true quantiles (Chernozhukov,
        # Fernandez-Val and Galichon, 2010, doi:10.3982/ECTA7880).
        lower, upper = np.sort([at(each) for each in ends], axis=0)
        _check_number(self.n_samples, 2, interval_probability)
        values, mean, sd, lower, upper = (each[:, part] for each in (values, at(self.mean), at(self.sd), lower, upper))
        return score_histories(self.channels, values, (mean, sd), (lower, upper), interval_probability)

    def _score_values(self, measured: Measurements | ArrayLike, probability: float) -> QuantityScores:
        """Scores of numbers against the same numbers of measurements."""
        _check_number(len(self.values), 3, probability)
        observed = measured_quantity(self.quantity, measured) if isinstance(measured, Measurements) else measured
        observed = np.asarray(observed, dtype=float)
        if observed.shape != self.mean.shape or not np.isfinite(observed).all():
            raise ValueError(
                f"score: expected finite measured values of the shape of the quantity, {self.mean.shape}; got "
                f"{observed.shape}"
            )
        known = len(self.channels) == observed.size
        names = [c.name for c in self.channels] if known else [str(k) for k in range(observed.size)]
        units = [c.unit for c in self.channels] if known else ["SI"] * observed.size
        values = self.values.reshape(len(self.values), -1)
        return score_values(names, units, values, observed.ravel(), probability, self.effective_sample_size)

    def to_xarray(self) -> "xarray.Dataset":
        """Mean, standard deviation and quantiles with their coordinates, and `values` where they are kept.

        Returns
        -------
        xarray.Dataset
            Of a history ``<channel>_mean`` and ``<channel>_sd`` over ``time`` [s], ``<channel>_quantiles`` over
            ``probability`` and ``time``; else ``mean``, ``sd``, ``quantiles`` and ``values``. In SI units; the group
            ``predictions`` of `samplers.to_arviz`.

        Examples
        --------
        >>> predicted = propagate(posterior, samples[:40], progress=False).to_xarray()
        >>> predicted["displacement_mean"].dims, predicted["time"].attrs["units"]
        (('time',), 's')
        """
        import xarray

        attributes = {name: getattr(self, name) for name in ("n_samples", "n_failed", "from_state")}
        attributes["noise"] = int(self.noise)
        columns: dict[str, Any] = {"probability": np.array(self.probabilities)}
        if self.dt is not None:
            columns["time"] = ("time", self.time, {"units": "s", "long_name": "time [s]"})
            variables: dict[str, Any] = {}
            for row, channel in enumerate(self.channels):
                name, unit = channel.name, channel.si_unit
                about = {"units": unit, "long_name": f"{name} [{unit}]", "quantity": channel.quantity}
                variables[f"{name}_mean"] = ("time", self.mean[row], about)
                variables[f"{name}_sd"] = ("time", self.sd[row], about)
                variables[f"{name}_quantiles"] = (("probability", "time"), self.quantiles[:, row], about)
            return xarray.Dataset(variables, columns, attributes)
        dims = tuple(f"quantity_dim_{i}" for i in range(np.ndim(self.mean)))
        variables = {"mean": (dims, self.mean), "sd": (dims, self.sd)}
        variables["quantiles"] = (("probability", *dims), self.quantiles)
        if self.values is not None:
            variables["values"] = (("sample", *dims), self.values)
        return xarray.Dataset(variables, columns, attributes)

    def _near_quantile(self, probability: float) -> np.ndarray:
        """The quantile for a probability that is known up to round-off."""
        return self.quantile(next((p for p in self.probabilities if abs(p - probability) < 1e-9), probability))

    def __str__(self) -> str:
        noise = f"with the spread of the parameters {'and measurement noise' if self.noise else 'only'}"
        if self.ratios is not None:
            noise = f"of measured values, by the ratios of {len(self.ratios.values)} events"
        noise += "" if self.from_state == "virgin" else f", from_state={self.from_state!r}"
        along = "of histories" if self.data is None else f"along {self.data.axis!r}"
        title = "Prediction" if self.dt is None else f"Prediction {along}"
        size = f"effective sample size {self.effective_sample_size:.0f}"
        lines = [f"{title}: {self.n_samples} samples, {noise}; {size}"]
        if self.ratios is not None:
            share = np.mean(self.ratios.prior_share)
            lines.append(f"the ratio of a new event has no mean: use the quantiles; {share:.0%} of their squared width")
            lines[-1] += " is due to the prior of the scatter between events"
        if self.n_failed:
            collapse = f" (the structure collapsed in {len(self.collapsed)})" if len(self.collapsed) else ""
            lines.append(f"{self.n_failed} samples failed{collapse} and are left out")
        lines += labelled(self.findings)
        known = [(c.name, c.unit, find_unit(c.unit, c.dimension).factor) for c in self.channels]
        if self.dt is not None:
            rows = [("channel", "unit", "largest mean", "at" if self.data else "at [s]", "its sd", "mean sd")]
            for (name, unit, factor), mean, sd in zip(known, self.mean, self.sd, strict=True):
                at = int(np.argmax(np.abs(mean)))
                place = f"{self.data.points[at]}" if self.data else number(at * self.dt)
                largest, *others = (number(each / factor) for each in (mean[at], sd[at], sd.mean()))
                rows.append((name, unit, largest, place, *others))
        elif self.mean.size > _MOST_ROWS:
            lines.append(f"{self.mean.size} values of shape {self.mean.shape}: mean, sd and quantiles are attributes")
            return "\n".join(lines)
        else:
            if len(known) != self.mean.size:
                known = [(f"{k}", "SI", 1.0) for k in range(self.mean.size)]
            rows = [("value", "unit", "mean", "MC error", "sd", *(f"{100 * p:g} %" for p in self.probabilities))]
            table = np.vstack([np.ravel(each) for each in (self.mean, self.standard_error, self.sd, *self.quantiles)])
            for (name, unit, factor), column in zip(known, table.T, strict=True):
                column /= factor
                digits, mean, sd = 3, abs(column[0]), column[2]
                if sd > 1e-12 * mean > 0.0:
                    digits = max(digits, int(np.floor(np.log10(mean)) - np.floor(np.log10(sd))) + 1)  # shows the sd
                rows.append((name, unit, *(number(each, digits) for each in column)))
        return "\n".join([*lines, text_table(rows)])

    __repr__ = __str__

    def _compared(self, measurements: Measurements) -> np.ndarray | Comparison:
        """Return what the histories are compared with, in the order of `channels`."""
        chosen = measurements.select([channel.name for channel in self.channels])
        for predicted, measured in zip(self.channels, chosen.channels, strict=True):
            if predicted.dimension != measured.dimension:
                raise ValueError(
                    f"channel {predicted.name!r} is {predicted.quantity!r} in the prediction, {measured.quantity!r} in "
                    "the measurements"
                )
        return compare_with(chosen, self.dt, self.mean.shape[1])


def _check_number(n_samples: int, least: int, probability: float) -> None:
    """Raise ValueError for fewer samples than `least`, or if the ends of an interval are beyond all samples."""
    least = max(least, math.ceil(2.0 / (1.0 - probability) - 1e-9))
    if n_samples < least:
        raise ValueError(f"score: expected {least} samples or more for intervals of {probability:g}; got {n_samples}")
