r"""Ratios of measured to predicted values in several events, and the distribution of the ratio in a new event.

A ratio contains everything in which an event differs from its prediction: what the model cannot fit, and parameters
that differ from event to event. The log ratios in K events are described by

.. math:: \ln r_k = m + b\, (\ln g_k - \overline{\ln g}) + s\, z_k, \qquad z_k \sim N(0, 1),

with the predicted value :math:`g_k`; the slope b is zero in the form "constant". The prior of m and b is flat. The
prior of s is a scaled inverse chi-squared distribution, because few events do not know how much events scatter. All are
integrated out, so that the logarithm of a new ratio has Student's t distribution. The equations are on the page
``docs/theory/prediction.rst``.

References
----------
A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd edition,
Chapman and Hall/CRC, sections 3.2, 3.3 and 14.2.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ..checks.finding import warn
from ..checks.stored_posteriors import check_equal_ratios
from ..text_tables import number, text_table

__all__ = ["PRIOR_EVENTS", "PRIOR_SD", "EventRatios", "RatioPopulations", "standardised"]

PRIOR_SD = 0.12
"""Default prior of the scatter between events: typical standard deviation of log ratios (docs/hierarchy.rst)."""
PRIOR_EVENTS = 6.0
"""Number of events that this prior is worth."""
_FORMS = ("constant", "linear")
_SHOWN = 0.9  # probability of printed intervals
_REACH = 1e-9


class RatioPopulations(NamedTuple):
    """Posterior draws (n,) of the ratio distribution of one quantity."""

    center: np.ndarray  # mean log ratio at the mean log level of the events
    slope: np.ndarray  # change of the mean log ratio per unit of the log level
    sd: np.ndarray  # of log ratios between events
    log_level: float  # mean logarithm of the predicted values of the events

    def center_at(self, log_predicted: np.ndarray) -> np.ndarray:
        """Mean log ratio at logarithms of predicted values (n, ...), a row for each draw."""
        center, slope = (each.reshape(-1, *(1,) * (log_predicted.ndim - 1)) for each in (self.center, self.slope))
        return center + slope * (log_predicted - self.log_level)


def standardised(difference: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Differences divided by a scale. If the scale is zero: infinite, with negative sign for a difference of zero."""
    positive = np.asarray(scale) > 0.0
    return np.where(positive, difference / np.where(positive, scale, 1.0), np.where(difference > 0.0, np.inf, -np.inf))


@dataclass(frozen=True, eq=False)
class EventRatios:
    r"""Ratios of measured to predicted values in several events, and the distribution of the ratio in a new event.

    Parameters
    ----------
    values : (n_events,) or (n_events, n_quantities) array_like
        Positive ratios, one row per calibration event, see `event_ratios`.
    prior_sd : float or (n_quantities,) array_like
        Prior of the scatter: typical standard deviation of log ratios between events, known before these events.
    prior_events : float
        Number of events that the prior is worth; 0 for none, which needs two events or more. See `prior_share`.
    levels : array_like, optional
        Predicted values of the events, in the shape of `values`; positive. Needed for ``form="linear"``.
    form : {"constant", "linear"}
        Whether the log ratio is the same for all predicted values, or follows a line in their logarithm: a linear model
        may be right for weak motions and predict too large peaks for strong ones. The interval of a new ratio then
        grows with the distance from the levels of the events.
    at : mapping of str to float, optional
        Parameters at which the values were predicted; predictions by these ratios use the same.
    widening : float or (n_quantities,) array_like
        Factor on the scatter of the new event, 1 or more: where its motion is of another kind than the motions of the
        events (`predict_new_event`).

    Raises
    ------
    ValueError
        If a ratio or a level is not positive, the prior is out of range, or the events are too few, or their levels
        too equal, for the form.

    Warns
    -----
    UserWarning
        If all ratios of a quantity are equal and there is no prior: their spread is then zero.

    Notes
    -----
    The variance has a scaled inverse chi-squared prior with :math:`\nu_0` (`prior_events`) degrees of freedom and the
    scale :math:`s_0` (`prior_sd`), the mean a flat one. The log ratio in a new event has Student's t distribution
    (Gelman et al. 2013, section 3.2-3.3) with

    .. math:: \nu = \nu_0 + K - 1, \qquad s^2 = \frac{\nu_0 s_0^2 + \sum_k (\ln r_k - m)^2}{\nu}

    degrees of freedom, the mean m of the K logarithms as its center and the scale :math:`s \sqrt{1 + 1 / K}`; the slope
    of a line takes one degree of freedom. The ratio itself has no mean and no variance, because the tails of its
    logarithm are heavier than exponential: use medians and other quantiles. The CRPS, a mean of distances, is computed
    from the draws; for small K it may be large by chance.

    References
    ----------
    A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd
    edition, Chapman and Hall/CRC.

    Examples
    --------
    >>> EventRatios([0.95, 1.08, 0.99, 1.04]).quantile(0.95)  # upper end of the 90 % interval of a new ratio
    """

    values: ArrayLike
    prior_sd: ArrayLike = PRIOR_SD
    prior_events: float = PRIOR_EVENTS
    levels: ArrayLike | None = None
    form: str = "constant"
    at: Mapping[str, float] | None = None
    widening: ArrayLike = 1.0

    def __post_init__(self) -> None:
        values = np.array(self.values, dtype=float)
        if values.ndim not in (1, 2) or not values.size or not ((values > 0.0) & (values < np.inf)).all():
            raise ValueError(f"EventRatios: expected positive ratios, one row per event; got {self.values!r}")
        sd, logs = np.asarray(self.prior_sd, dtype=float), np.log(values)
        if not (((sd > 0.0) & (sd < np.inf)).all() and 0.0 <= self.prior_events < np.inf):
            raise ValueError(
                f"EventRatios: prior_sd must be positive and prior_events zero or more; got {self.prior_sd!r} and "
                f"{self.prior_events!r}"
            )
        if sd.shape not in ((), values.shape[1:]):
            raise ValueError(
                f"EventRatios: expected one prior_sd, or one per quantity, {values.shape[1:]}; got {sd.shape}"
            )
        offsets, line = self._offsets(values.shape), self.form == "linear"
        degrees = self.prior_events + len(values) - 1.0 - line
        if not degrees > 0.0:
            raise ValueError(
                f"EventRatios: {len(values)} events do not show how ratios scatter between events; leave the prior of "
                f"the scatter in, such as prior_sd={PRIOR_SD:g}, prior_events={PRIOR_EVENTS:g}"
            )
        gain = 1.0 / np.square(offsets).sum(axis=0) if line else np.zeros(values.shape[1:])
        mean, slope = logs.mean(axis=0), gain * (offsets * logs).sum(axis=0)
        squares = np.square(logs - mean - slope * offsets).sum(axis=0)
        if not self.prior_events:
            warn(check_equal_ratios(len(values), float(np.sqrt(squares.min())), _REACH), stacklevel=3)
        found = {"values": values, "prior_sd": sd, "degrees_of_freedom": degrees}
        found |= {"_mean": mean, "_slope": slope, "_gain": gain, "_squares": squares}
        for name, value in found.items():
            object.__setattr__(self, name, value)

    def _offsets(self, shape: tuple[int, ...]) -> np.ndarray:
        """Log levels of the events minus their mean (n_events, ...), zero without levels; ValueError if unusable."""
        if self.form not in _FORMS:
            raise ValueError(f"EventRatios: form must be one of {', '.join(_FORMS)}; got {self.form!r}")
        if self.levels is None:
            levels = np.ones(shape)
        else:
            levels = np.array(self.levels, dtype=float)
            if levels.shape != shape or not ((levels > 0.0) & (levels < np.inf)).all():
                raise ValueError(
                    f"EventRatios: expected one positive predicted value for each ratio, {shape}; got {self.levels!r}"
                )
        logs = np.log(levels)
        if self.form == "linear" and (np.ptp(logs, axis=0) <= _REACH).any():
            raise ValueError(
                f"EventRatios: a linear form needs levels= of events that differ; got {self.levels!r}: use "
                'form="constant"'
            )
        object.__setattr__(self, "_log_level", logs.mean(axis=0))
        return logs - logs.mean(axis=0)

    def __str__(self) -> str:
        rows = [
            ("number", "at a predicted value of", "median", f"{_SHOWN:.0%} interval of a new event", "due to prior")
        ]
        levels = [np.exp(self._log_level)]
        if self.form == "linear":
            levels = [np.min(self.levels, axis=0), np.max(self.levels, axis=0)]
        shares = np.atleast_1d(self.prior_share)
        for level in levels:
            ends = [np.atleast_1d(self.quantile(p, level)) for p in (0.5, 0.5 - 0.5 * _SHOWN, 0.5 + 0.5 * _SHOWN)]
            for k, (median, low, high, at) in enumerate(zip(*ends, np.atleast_1d(level), strict=True)):
                place = "any" if self.form == "constant" else number(at)
                rows.append((f"{k + 1}", place, number(median), f"{number(low)} to {number(high)}", f"{shares[k]:.0%}"))
        prior = ", ".join(f"{each:g}" for each in np.atleast_1d(self.prior_sd))
        first = f"Ratios of measured to predicted values in {len(self.values)} events, form {self.form}"
        said = f"prior of the scatter {prior}, worth {self.prior_events:g} events: its share of the squared width"
        return f"{first}; {said}\n{text_table(rows)}"

    @property
    def prior_share(self) -> np.ndarray:
        """Share of the squared width of intervals that the prior of the scatter has, shaped like one row."""
        given = self.prior_events * np.square(self.prior_sd)
        total = given + self._squares
        return np.where(total > 0.0, given / np.where(total > 0.0, total, 1.0), 0.0)

    @property
    def sd(self) -> np.ndarray:
        """Estimated standard deviation of log ratios between events, s, shaped like one row."""
        return np.sqrt((self._squares + self.prior_events * np.square(self.prior_sd)) / self.degrees_of_freedom)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the quantity that the ratios are for."""
        return self.values.shape[1:]

    def of_quantity(self, k: int) -> "EventRatios":
        """Ratios for quantity `k` of several."""
        levels = None if self.levels is None else np.asarray(self.levels)[:, k]
        return replace(
            self,
            values=self.values[:, k],
            levels=levels,
            prior_sd=np.broadcast_to(self.prior_sd, self.shape)[k],
            widening=np.broadcast_to(self.widening, self.shape)[k],
        )

    def quantile(self, probability: ArrayLike, predicted: ArrayLike = 1.0) -> np.ndarray:
        """Quantile of the ratio in a new event.

        Parameters
        ----------
        probability : float or array_like
            Between 0 and 1.
        predicted : (...) array_like
            Predicted values, positive; without effect for the form "constant".

        Returns
        -------
        ndarray
            In the shape that probability, predicted values and one row of the ratios have together.

        Raises
        ------
        ValueError
            If a probability is not between 0 and 1, or a predicted value is not positive.
        """
        predicted, probability = np.asarray(predicted, dtype=float), np.asarray(probability, dtype=float)
        if (
            not ((0.0 < probability) & (probability < 1.0)).all()
            or not ((predicted > 0.0) & (predicted < np.inf)).all()
        ):
            raise ValueError(
                f"EventRatios.quantile: expected probabilities between 0 and 1 and positive predicted values; got "
                f"{probability} and {predicted}"
            )
        center, scale = self._center_and_scale(np.log(predicted))
        return np.exp(center + scale * special.stdtrit(self.degrees_of_freedom, probability))

    def draw(self, predicted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw a ratio of a new event for each predicted value (n, ...), which is positive; all are independent."""
        center, scale = self._center_and_scale(np.log(predicted))
        return np.exp(center + scale * rng.standard_t(self.degrees_of_freedom, np.shape(predicted)))

    def probability_above(self, ratio: np.ndarray, log_predicted: np.ndarray) -> np.ndarray:
        """Probability that the ratio of a new event exceeds `ratio`, at logarithms of predicted values."""
        center, scale = self._center_and_scale(log_predicted)
        return special.stdtr(self.degrees_of_freedom, standardised(center - np.log(ratio), scale))

    def draw_populations(self, n: int, rng: np.random.Generator) -> RatioPopulations:
        """Draw the line and the standard deviation of log ratios from their posterior; ValueError for quantities."""
        if self.shape:
            raise ValueError(f"expected the ratios of one quantity, (n_events,); got {self.values.shape}")
        sd = self.sd * np.sqrt(self.degrees_of_freedom / rng.chisquare(self.degrees_of_freedom, n))
        center = self._mean + sd / np.sqrt(len(self.values)) * rng.standard_normal(n)
        slope = self._slope + sd * np.sqrt(self._gain) * rng.standard_normal(n)
        return RatioPopulations(center, slope, sd * self.widening, float(self._log_level))

    def _center_and_scale(self, log_predicted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Center and scale of the t distribution of a new log ratio at log predicted values (...)."""
        offset: Any = log_predicted - self._log_level
        own = np.square(self.widening)
        scale = self.sd * np.sqrt(own + 1.0 / len(self.values) + self._gain * np.square(offset))
        return self._mean + self._slope * offset, scale
