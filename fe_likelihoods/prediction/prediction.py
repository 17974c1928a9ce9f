"""The result of uncertainty propagation: mean, variance and quantiles of a quantity."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..checks.finding import Finding, labelled
from ..population.event_ratios import EventRatios
from ..signals.channels import Channel, Measurements
from ..signals.comparison import Comparison, compare_with
from ..text_tables import number, text_table
from ..units import find_unit
from .quantities import measured_quantity
from .scores import HistoryScores, QuantityScores, check_probability, score_histories, score_values

if TYPE_CHECKING:
    import xarray

__all__ = ["Prediction"]

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
                rows.append((name, unit, *map(number, column / factor)))
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
