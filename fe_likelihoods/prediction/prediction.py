"""The result of uncertainty propagation: mean, variance and quantiles of a quantity."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..signals.channels import Channel, Measurements
from ..signals.comparison import Comparison, compare_shifted, compare_with
from ..signals.error_measures import rrmse

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.figure import Figure

__all__ = ["Prediction"]


@dataclass(frozen=True, eq=False)
class Prediction:
    """Moments and quantiles of a quantity over samples of the parameters.

    The shape of the quantity is written (...): (n_channels, n_steps) for histories, () for a peak. Values are in SI
    units.

    Attributes
    ----------
    mean : ndarray, shape (...)
        Mean.
    variance : ndarray, shape (...)
        Variance.
    standard_error : ndarray, shape (...)
        Monte Carlo error of `mean`: standard deviation / sqrt(effective sample size).
    probabilities : tuple of float
        Probabilities of the quantiles.
    quantiles : ndarray, shape (n_probabilities, ...)
        Quantiles.
    quantile_error : ndarray, shape (n_probabilities, ...)
        Monte Carlo errors of the quantiles.
    values : ndarray, shape (n_samples, ...), or None
        The quantity of every sample that did not fail, in their order. None for histories, and for arrays that exceed
        the limit of memory.
    n_samples : int
        Number of samples used for mean and variance.
    n_quantile : int
        Number of samples used for the quantiles, smaller if not all of them fitted into the limit of memory.
    effective_sample_size : float
        Effective number of independent samples, for the Monte Carlo errors.
    failed : ndarray of int, shape (n_failed,)
        Indices of the samples that are left out, because the simulation failed or the quantity is not finite.
    failure_reasons : dict of str to int
        Number of samples left out for each reason.
    channels : tuple of Channel
        Channels of the histories, or the channels whose quantities the values are. Empty for a function of the whole
        response.
    dt : float or None
        Time step of the histories [s], None for other quantities.
    noise : bool
        Whether the measurement noise is included.
    from_state : str
        State of the structure at the beginning: "virgin", that of the model before any excitation, or "end", that after
        the excitation with which the model was made.
    shifted : tuple of str
        Channels of the measurements with unknown time shifts (`fe_likelihoods.TimeShiftNoise`). The histories are those
        of the response, without a shift.
    quantity : object
        The quantity as it was given to `fe_likelihoods.propagate`.
    """

    mean: np.ndarray
    variance: np.ndarray
    standard_error: np.ndarray
    probabilities: tuple[float, ...]
    quantiles: np.ndarray
    quantile_error: np.ndarray
    values: np.ndarray | None
    n_samples: int
    n_quantile: int
    effective_sample_size: float
    failed: np.ndarray
    failure_reasons: dict[str, int]
    channels: tuple[Channel, ...] = ()
    dt: float | None = None
    noise: bool = False
    from_state: str = "virgin"
    shifted: tuple[str, ...] = ()
    quantity: object = None

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
        self._need_histories()
        return np.arange(self.mean.shape[1]) * self.dt

    def quantile(self, probability: float) -> np.ndarray:
        """Return the quantile, shape (...), of one of the `probabilities`; raise ValueError for another one."""
        if probability not in self.probabilities:
            raise ValueError(
                f"no quantile {probability!r} in this prediction, it has {self.probabilities}: propagate with "
                f"quantiles=(..., {probability!r})"
            )
        return self.quantiles[self.probabilities.index(probability)]

    def rrmse(
        self,
        measurements: Measurements,
        part: slice = slice(None),
        time_shifts: "Mapping[str, float] | None" = None,
    ) -> np.ndarray:
        """Compute the relative root mean square error of the mean.

        Parameters
        ----------
        measurements : Measurements
            Measurements of all channels, over the time of the histories. Missing samples are left out. Where a channel
            has times of its own, the histories are interpolated there.
        part : slice
            The samples of the history to compare. Default: all.
        time_shifts : mapping of str to float, optional
            Time [s] by which the measurements of a channel are later than the response, needed for the channels of
            `shifted`: for instance the posterior means of their shifts. Samples beyond the histories are left out.

        Returns
        -------
        ndarray, shape (n_channels,)
            The errors [-] in the order of `channels`, see `fe_likelihoods.signals.error_measures.rrmse`.

        Raises
        ------
        ValueError
            If the prediction has no histories, a shift of `shifted` is not given, the measurements lack a channel or
            have samples outside of the histories, or a measured channel is zero, or has no sample, in the part.
        """
        compared = self._compared(measurements, time_shifts)
        measured, mean = _values_of(compared), _at_samples(compared, self.mean)
        return rrmse(mean[:, part], measured[:, part], [channel.name for channel in self.channels])

    def coverage(
        self,
        measurements: Measurements,
        lower: float = 0.05,
        upper: float = 0.95,
        part: slice = slice(None),
        time_shifts: "Mapping[str, float] | None" = None,
    ) -> np.ndarray:
        """Compute the fraction of the measured samples between two quantiles.

        Parameters
        ----------
        measurements : Measurements
            Measurements of all channels, over the time of the histories. Missing samples are left out. Where a channel
            has times of its own, the histories are interpolated there.
        lower, upper : float
            Probabilities of the two quantiles.
        part : slice
            The samples of the history to compare. Default: all.
        time_shifts : mapping of str to float, optional
            As for `rrmse`.

        Returns
        -------
        ndarray, shape (n_channels,)
            The fractions [-] in the order of `channels`. A prediction with noise should have about ``upper - lower``.
            A prediction without noise is a band of the response, not of the measurements, and covers fewer of them.

        Raises
        ------
        ValueError
            As `rrmse`, and if the prediction lacks one of the quantiles or `lower` is not below `upper`.

        Notes
        -----
        Between the samples of the histories, the quantiles are interpolated, which is approximate.
        """
        if not lower < upper:
            raise ValueError(f"coverage needs lower < upper; got {lower} and {upper}")
        compared = self._compared(measurements, time_shifts)
        measured = _values_of(compared)[:, part]
        below, above = (_at_samples(compared, self.quantile(p))[:, part] for p in (lower, upper))
        samples = np.isfinite(measured).sum(axis=1)
        if not samples.all():
            empty = [c.name for c, n in zip(self.channels, samples, strict=True) if not n]
            raise ValueError(f"channels {', '.join(empty)} have no sample in this part; choose another one")
        return ((below <= measured) & (measured <= above)).sum(axis=1) / samples

    def plot(
        self,
        measurements: Measurements | None = None,
        channels: "Sequence[str] | None" = None,
        time_shifts: "Mapping[str, float] | None" = None,
    ) -> "Figure":
        """Plot mean, band and measurements, see `fe_likelihoods.plots.predictions.plot_bands`.

        Parameters
        ----------
        measurements : Measurements, optional
            Measurements, drawn at their own times.
        channels : sequence of str, optional
            Names of the channels to draw. Default: all.
        time_shifts : mapping of str to float, optional
            As for `rrmse`: mean and band of these channels are drawn later by these times [s], where they are compared
            with the measurements. Needed for measured channels of `shifted`.

        Returns
        -------
        matplotlib Figure
        """
        from ..plots.predictions import plot_bands

        measured = [] if measurements is None else [channel.name for channel in measurements.channels]
        drawn = [channel.name for channel in self.channels] if channels is None else channels
        shifts = self._shifts([name for name in measured if name in drawn], time_shifts)
        return plot_bands(self, measurements, channels, shifts)

    def _need_histories(self) -> None:
        if self.dt is None:
            raise ValueError("this needs the histories of channels: propagate with quantity=None or names of channels")

    def _shifts(self, measured: "Sequence[str]", time_shifts: "Mapping[str, float] | None") -> dict[str, float]:
        """Return the given time shifts; raise ValueError if one of a measured channel is missing, or is unknown."""
        shifts, names = dict(time_shifts or {}), [channel.name for channel in self.channels]
        if missing := [name for name in names if name in self.shifted and name in measured and name not in shifts]:
            raise ValueError(
                f"the channels {', '.join(missing)} have unknown time shifts: give time_shifts={{name: seconds}}, for "
                "instance the posterior means of their parameters time_shift_<channel>"
            )
        if unknown := sorted(set(shifts) - set(names)):
            raise ValueError(f"time_shifts has {', '.join(unknown)}, the prediction has {', '.join(names)}")
        return shifts

    def _compared(
        self, measurements: Measurements, time_shifts: "Mapping[str, float] | None"
    ) -> np.ndarray | Comparison:
        """Return what the histories are compared with, in the order of `channels`."""
        self._need_histories()
        chosen = measurements.select([channel.name for channel in self.channels])
        for predicted, measured in zip(self.channels, chosen.channels, strict=True):
            if predicted.dimension != measured.dimension:
                raise ValueError(
                    f"channel {predicted.name!r} is {predicted.quantity!r} in the prediction, {measured.quantity!r} in "
                    "the measurements"
                )
        shifts = self._shifts([channel.name for channel in self.channels], time_shifts)
        compared = compare_with(chosen, self.dt, self.mean.shape[1])
        return compare_shifted(chosen, compared, self.dt, self.mean.shape[1], shifts) if shifts else compared


def _values_of(compared: np.ndarray | Comparison) -> np.ndarray:
    return compared.values if isinstance(compared, Comparison) else compared


def _at_samples(compared: np.ndarray | Comparison, histories: np.ndarray) -> np.ndarray:
    return compared.at_samples(histories) if isinstance(compared, Comparison) else histories
