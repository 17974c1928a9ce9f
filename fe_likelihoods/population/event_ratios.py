r"""Ratios of measured to predicted values in several events, and the distribution of the ratio in a new event.

A ratio contains everything in which an event differs from its prediction: what the model cannot fit, and parameters
that differ from event to event. The log ratios in K events are described by

.. math:: \ln r_k = m + b\, (x_k - \bar x) + \sqrt{\lambda}\, s_k\, z_k, \qquad z_k \sim N(0, 1), \quad x_k = \ln g_k,

with the predicted value :math:`g_k` and the scatter :math:`s_k` that is expected before the events. The factor
:math:`\lambda` says how much more, or less, this structure scatters. All unknowns are integrated out, so that the
logarithm of a new ratio has Student's t distribution. The equations are on the page ``docs/theory/prediction.rst``.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ..text_tables import number, text_table

__all__ = ["PRIOR_EVENTS", "PRIOR_SD", "SLOPE_SD", "EventRatios", "RatioPopulations"]

PRIOR_SD = 0.12
"""Scatter of log ratios of peaks where nothing else is known of it: 0.03 to 0.15 in five structures."""
PRIOR_EVENTS = 6.0
"""Number of events that the expected scatter is worth: 90 % of the structures are within factors of 0.7 and 1.9."""
SLOPE_SD = 0.05
"""Slope of log ratio over log prediction: best are 0.03 to 0.08 for a bridge in eleven events, 0.02 to 0.9 g."""
_SHOWN = 0.9  # probability of printed intervals


class RatioPopulations(NamedTuple):
    """Posterior draws (n,) or (n, n_quantities) of the ratio distribution."""

    center: np.ndarray  # mean log ratio at the mean log predicted value of the events
    slope: np.ndarray  # change of the mean log ratio per unit of the log predicted value
    sd: np.ndarray  # of log ratios between events
    log_predicted: np.ndarray  # mean logarithm of the predicted values of the events

    def probability_above(self, ratio: np.ndarray, log_predicted: np.ndarray) -> np.ndarray:
        """Probability that a ratio from each population exceeds `ratio` (n, ...), at logarithms of predicted values."""
        rows = (..., *(None,) * (log_predicted.ndim - self.center.ndim))
        center, slope, sd = self.center[rows], self.slope[rows], self.sd[rows]
        center = center + slope * (log_predicted - self.log_predicted)
        return special.ndtr((center - np.log(ratio)) / sd)


@dataclass(frozen=True, eq=False)
class EventRatios:
    r"""Ratios of measured to predicted values in several events, and the distribution of the ratio in a new event.

    Parameters
    ----------
    values : (n_events,) or (n_events, n_quantities) array_like
        Positive ratios, one row per calibration event, see `event_ratios`.
    prior_sd : float, (n_quantities,) or as values, array_like
        Scatter that is expected before these events: standard deviation of log ratios between events. An Arias
        intensity or an energy scatters twice as much as a peak. `event_ratios` computes it for each event and quantity.
    prior_events : float
        Number of events that the expected scatter is worth, positive. See `prior_share`.
    predicted : array_like, optional
        Predicted values of the events, in the shape of `values`; positive. The log ratio may then follow a line in
        their logarithm, because a linear model may be right for weak motions and predict too large peaks for strong
        ones. The interval of a new ratio grows with the distance from the predicted values.
    slope_sd : float
        Standard deviation of the slope of this line before the events, around zero.
    at : mapping of str to float, optional
        Parameters at which the values were predicted; predictions by these ratios use the same.
    new_sd : float or (n_quantities,) array_like, optional
        Expected scatter of the new event. Default: root mean square of `prior_sd` over the events.
    spread : mapping of str to float, optional
        Standard deviations of log parameters between events, from which predictions find the scatter of their motion.
    remainder : float or (n_quantities,) array_like, optional
        Variance of log ratios that this spread does not explain.

    Raises
    ------
    ValueError
        If a ratio, a predicted value or a scatter is not positive, or shapes differ.

    Notes
    -----
    With weights :math:`w_k = 1 / s_k^2`, a flat prior of the mean m, the prior :math:`b \sim N(0, \lambda \tau^2)` of
    the slope and a scaled inverse chi-squared prior of :math:`\lambda` with :math:`\nu_0` (`prior_events`) degrees of
    freedom and scale 1, the log ratio in a new event at x with the expected scatter s has Student's t distribution with

    .. math::

       \nu = \nu_0 + K - 1, \qquad
       \hat\lambda = \frac{1}{\nu} \left[ \nu_0 + \sum_k w_k (\ln r_k - m - b (x_k - \bar x))^2 + b^2 / \tau^2 \right]

    degrees of freedom, the center :math:`m + b (x - \bar x)`, and the squared scale
    :math:`\hat\lambda [s^2 + 1 / \sum_k w_k + (x - \bar x)^2 / (\sum_k w_k (x_k - \bar x)^2 + 1 / \tau^2)]`
    (Gelman et al. 2013, section 14.8). The ratio has no mean and no variance, because the tails of its logarithm are
    heavier than exponential: use medians and other quantiles.

    References
    ----------
    A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd
    edition, Chapman and Hall/CRC.

    Examples
    --------
    >>> ratios = EventRatios([0.95, 1.08, 0.99, 1.04])
    >>> [round(float(ratios.quantile(p)), 2) for p in (0.05, 0.5, 0.95)]  # of a new ratio
    [0.82, 1.01, 1.25]
    """

    values: ArrayLike
    prior_sd: ArrayLike = PRIOR_SD
    prior_events: float = PRIOR_EVENTS
    predicted: ArrayLike | None = None
    slope_sd: float = SLOPE_SD
    at: Mapping[str, float] | None = None
    new_sd: ArrayLike | None = None
    spread: Mapping[str, float] | None = None
    remainder: ArrayLike = 0.0

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float)
        if values.ndim not in (1, 2) or not values.size or not _positive(values):
            raise ValueError(f"EventRatios: expected positive ratios, one row per event; got {self.values!r}")
        sd = np.asarray(self.prior_sd, dtype=float)
        if not (_positive(sd) and 0.0 < self.prior_events < np.inf and 0.0 <= self.slope_sd < np.inf):
            raise ValueError(
                "EventRatios: prior_sd and prior_events must be positive, slope_sd zero or more; got "
                f"{self.prior_sd!r}, {self.prior_events!r} and {self.slope_sd!r}"
            )
        if sd.shape not in ((), values.shape[1:], values.shape):
            raise ValueError(
                f"EventRatios: expected one prior_sd, one per quantity, {values.shape[1:]}, or one per ratio, "
                f"{values.shape}; got {sd.shape}"
            )
        predicted = np.ones(values.shape) if self.predicted is None else np.array(self.predicted, dtype=float)
        if predicted.shape != values.shape or not _positive(predicted):
            raise ValueError(
                f"EventRatios: expected one positive predicted value for each ratio, {values.shape}; got "
                f"{self.predicted!r}"
            )
        degrees = self.prior_events + len(values) - 1.0
        sd = np.broadcast_to(sd, values.shape)
        new_sd = np.sqrt(np.square(sd).mean(axis=0)) if self.new_sd is None else np.asarray(self.new_sd, dtype=float)
        if not _positive(new_sd) or new_sd.shape not in ((), values.shape[1:]):
            raise ValueError(f"EventRatios: new_sd must be positive, one or one per quantity; got {self.new_sd!r}")
        logs, x, weights = np.log(values), np.log(predicted), 1.0 / np.square(sd)
        total = weights.sum(axis=0)
        log_predicted, mean = (weights * x).sum(axis=0) / total, (weights * logs).sum(axis=0) / total
        offsets = x - log_predicted
        slope_sd = 0.0 if self.predicted is None else self.slope_sd
        gain = slope_sd**2 / (1.0 + slope_sd**2 * (weights * np.square(offsets)).sum(axis=0))
        slope = gain * (weights * offsets * logs).sum(axis=0)
        squares = (weights * np.square(logs - mean - slope * offsets)).sum(axis=0)
        squares = squares + (np.square(slope) / slope_sd**2 if slope_sd else 0.0)
        found = {"values": values, "degrees_of_freedom": degrees, "new_sd": new_sd, "_log_predicted": log_predicted}
        found |= {"_mean": mean, "_slope": slope, "_gain": gain, "_total": total, "_squares": squares}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        rows = [("number", "at a predicted value of", "median", f"{_SHOWN:.0%} interval", "expected scatter", "by it")]
        known = np.unique(np.log(self.predicted), axis=0) if self.predicted is not None else self._log_predicted[None]
        for predicted in np.exp(known[[0, -1]] if len(known) > 1 else known):
            ends = [self.quantile(p, predicted) for p in (0.5, 0.5 - 0.5 * _SHOWN, 0.5 + 0.5 * _SHOWN)]
            columns = np.broadcast_arrays(predicted, *ends, self.new_sd, self.prior_share)
            for k, (at, median, low, high, sd, share) in enumerate(zip(*map(np.atleast_1d, columns), strict=True)):
                place = "any" if self.predicted is None else number(at)
                cells = number(median), f"{number(low)} to {number(high)}", number(sd, 2), f"{share:.0%}"
                rows.append((f"{k + 1}", place, *cells))
        first = f"Ratios of measured to predicted values in {len(self.values)} events, and in a new one"
        said = f"the expected scatter is worth {self.prior_events:g} events; by it: its share of the squared width"
        return f"{first}; {said}\n{text_table(rows)}"

    @property
    def prior_share(self) -> np.ndarray:
        """Share of the squared width of intervals that is due to the expected scatter, shaped like one row."""
        return self.prior_events / (self.prior_events + self._squares)

    @property
    def sd(self) -> np.ndarray:
        """Estimated standard deviation of the log ratio in the new event, shaped like one row."""
        return np.sqrt((self._squares + self.prior_events) / self.degrees_of_freedom) * self.new_sd

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the quantity that the ratios are for."""
        return self.values.shape[1:]

    def quantile(self, probability: ArrayLike, predicted: ArrayLike = 1.0) -> np.ndarray:
        """Quantile of the ratio in a new event.

        Parameters
        ----------
        probability : float or array_like
            Between 0 and 1.
        predicted : (...) array_like
            Predicted values, positive; without effect if the ratios have none.

        Returns
        -------
        ndarray
            In the shape that probability, predicted values and one row of the ratios have together.

        Raises
        ------
        ValueError
            If a probability is not between 0 and 1, or a predicted value is not positive.

        Examples
        --------
        >>> round(float(EventRatios([0.95, 1.08, 0.99, 1.04]).quantile(0.95)), 2)
        1.25
        """
        predicted, probability = np.asarray(predicted, dtype=float), np.asarray(probability, dtype=float)
        if not ((0.0 < probability) & (probability < 1.0)).all() or not _positive(predicted):
            raise ValueError(
                f"EventRatios.quantile: expected probabilities between 0 and 1 and positive predicted values; got "
                f"{probability} and {predicted}"
            )
        center, scale = self._center_and_scale(np.log(predicted))
        return np.exp(center + scale * special.stdtrit(self.degrees_of_freedom, probability))

    def probability_above(self, ratio: np.ndarray, log_predicted: np.ndarray) -> np.ndarray:
        """Probability that the ratio of a new event exceeds `ratio`, at logarithms of predicted values."""
        center, scale = self._center_and_scale(log_predicted)
        return special.stdtr(self.degrees_of_freedom, (center - np.log(ratio)) / scale)

    def draw_populations(self, n: int, rng: np.random.Generator) -> RatioPopulations:
        """Draw the line and the standard deviation of log ratios from their posterior."""
        shape = (n, *self.shape)
        factor = (
            self.sd / self.new_sd * np.sqrt(self.degrees_of_freedom / rng.chisquare(self.degrees_of_freedom, shape))
        )
        center = self._mean + factor / np.sqrt(self._total) * rng.standard_normal(shape)
        slope = self._slope + factor * np.sqrt(self._gain) * rng.standard_normal(shape)
        return RatioPopulations(center, slope, factor * self.new_sd, self._log_predicted)

    def _center_and_scale(self, log_predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Center and scale of the t distribution of a new log ratio at log predicted values (...)."""
        offset = np.where(self._gain > 0.0, log_predicted - self._log_predicted, 0.0)
        own = np.square(self.new_sd)
        scale = self.sd * np.sqrt((own + 1.0 / self._total + self._gain * np.square(offset)) / own)
        return self._mean + self._slope * offset, scale


def _positive(values: np.ndarray) -> bool:
    return bool(((values > 0.0) & (values < np.inf)).all())
