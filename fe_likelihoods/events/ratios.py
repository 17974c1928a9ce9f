r"""Ratios of measured to predicted values in several events, and the distribution of the ratio in a new event.

A ratio contains what a model cannot fit in an event. The log ratios in K events are described by

.. math:: \ln r_k = f(\ln g_k) + s\, z_k, \qquad z_k \sim N(0, 1),

with the predicted value :math:`g_k`. `EventRatios` has a constant f. `LevelRatios` lets f depend on the predicted
value, as where a linear model meets motions of very different strength. Both integrate f and s out, so that the
logarithm of a new ratio has Student's t distribution, or a mixture of them. The equations are on the page
``docs/theory/prediction.rst``.

References
----------
A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd edition,
Chapman and Hall/CRC, sections 3.2, 3.3 and 14.2.
C. E. Rasmussen, C. K. I. Williams (2006), Gaussian Processes for Machine Learning, MIT Press, sections 2.2 and 2.7.
"""

import warnings
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ..text_tables import number, text_table

__all__ = ["EventRatios", "LevelRatios", "RatioPopulations", "standardised"]

FORMS = ("constant", "linear", "smooth")
_LEAST_EVENTS = {"constant": 1, "linear": 4, "smooth": 10}  # fewest events for a form to be averaged
_AMPLITUDES = (0.25, 1.0, 4.0, 16.0)  # of f over its range, as multiples of s
_LENGTHS = (0.7, 1.5, 3.0)  # of a smooth f, as multiples of the standard deviation of the log levels
_GRID = 48  # levels at which a drawn function is known
_SHOWN = 0.9  # probability of printed intervals
_REACH = 1e-9


class RatioPopulations(NamedTuple):
    """Posterior draws of the ratio distribution: its median as a function of the level, and s.

    Attributes
    ----------
    log_levels : ndarray, shape (n_levels,)
        Logarithms of the predicted value in equal steps, or a single one for a constant.
    center : ndarray, shape (n, n_levels)
        Logarithm of the median ratio at these levels.
    sd : ndarray, shape (n,)
        Standard deviation of log ratios between events.
    """

    log_levels: np.ndarray
    center: np.ndarray
    sd: np.ndarray

    def center_at(self, log_predicted: np.ndarray) -> np.ndarray:
        """Log median ratio at logarithms of predicted values (n, ...), a row for each draw."""
        draws = np.arange(len(self.sd)).reshape(-1, *(1,) * (log_predicted.ndim - 1))
        if len(self.log_levels) == 1:
            return self.center[draws, 0]
        step = self.log_levels[1] - self.log_levels[0]
        place = np.clip((log_predicted - self.log_levels[0]) / step, 0.0, len(self.log_levels) - 1.0)
        left = np.minimum(place.astype(int), len(self.log_levels) - 2)
        part = place - left
        return (1.0 - part) * self.center[draws, left] + part * self.center[draws, left + 1]


def _checked_ratios(kind: str, values: Any, prior_sd: float, prior_events: float, dimensions: tuple) -> np.ndarray:
    """Ratios as an array; ValueError if they, or the guess of their spread, cannot be used."""
    found = np.array(values, dtype=float)
    if found.ndim not in dimensions or not found.size or not ((found > 0.0) & (found < np.inf)).all():
        raise ValueError(f"{kind}: expected positive ratios, one row per event; got {values!r}")
    if not (0.0 < prior_sd < np.inf and 0.0 <= prior_events < np.inf):
        raise ValueError(
            f"{kind}: prior_sd must be positive and prior_events zero or more; got {prior_sd!r} and {prior_events!r}"
        )
    if len(found) < 2 and not prior_events:
        raise ValueError(
            f"{kind}: one event does not show how ratios differ between events; give a guess of their standard "
            "deviation, such as prior_sd=0.15, and the number of events that it is worth, prior_events=3"
        )
    if not prior_events and (np.ptp(np.log(found), axis=0) <= _REACH).any():
        warnings.warn(
            f"{kind}: the ratios of {len(found)} events are equal, so that nothing is left of the error of the model "
            "between events: intervals have no width, and probabilities are 0 or 1. Give a guess of the standard "
            "deviation, such as prior_sd=0.15, and the number of events that it is worth, prior_events=3",
            stacklevel=4,
        )
    return found


def standardised(difference: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Differences divided by a scale. If the scale is zero: infinite, with negative sign for a difference of zero."""
    positive = np.asarray(scale) > 0.0
    return np.where(positive, difference / np.where(positive, scale, 1.0), np.where(difference > 0.0, np.inf, -np.inf))


@dataclass(frozen=True, eq=False)
class EventRatios:
    r"""Ratios of measured to fitted values in several events, and the distribution of the ratio in a new event.

    Parameters
    ----------
    values : (n_events,) or (n_events, n_quantities) array_like
        Positive ratios, one row per calibration event, see `event_ratio`.
    prior_sd : float
        Guess, made before these events, of how much log ratios scatter between events (standard deviation).
    prior_events : float
        Number of events that this guess is worth; 0 for none. A guess is required if there is one event only.

    Raises
    ------
    ValueError
        If a ratio is not positive, the guess is not, or neither two events nor a guess are given.

    Warns
    -----
    UserWarning
        If all ratios of a quantity are equal and there is no guess: their spread is then zero.

    Notes
    -----
    The log ratios are normal with unknown mean and variance. With a flat prior for the mean and a scaled inverse
    chi-squared prior for the variance (`prior_events` degrees of freedom, scale `prior_sd`), the log ratio in a new
    event has Student's t distribution (Gelman et al. 2013, section 3.2-3.3) with

    .. math:: \nu = \nu_0 + K - 1, \qquad s^2 = \frac{\nu_0 s_0^2 + \sum_k (\ln r_k - m)^2}{\nu}

    degrees of freedom, the mean m of the K logarithms as its center and the scale :math:`s \sqrt{1 + 1 / K}`. The ratio
    itself has no mean and no variance, because the tails of its logarithm are heavier than exponential: use medians and
    other quantiles. The CRPS, a mean of distances, is computed from the draws; for small K it may be large by chance.

    References
    ----------
    A. Gelman, J. B. Carlin, H. S. Stern, D. B. Dunson, A. Vehtari, D. B. Rubin (2013), Bayesian Data Analysis, 3rd
    edition, Chapman and Hall/CRC.

    Examples
    --------
    >>> EventRatios([0.95, 1.08, 0.99, 1.04]).factor(0.9)  # ends of the 90 % interval: median times or divided by this
    """

    values: ArrayLike
    prior_sd: float = 0.1
    prior_events: float = 0.0

    def __post_init__(self) -> None:
        values = _checked_ratios("EventRatios", self.values, self.prior_sd, self.prior_events, (1, 2))
        object.__setattr__(self, "values", values)

    def __str__(self) -> str:
        factors, medians = np.atleast_1d(self.factor(_SHOWN)), np.atleast_1d(self.median)
        rows = [("number", "median of the ratio", f"{_SHOWN:.0%} interval of a new event")]
        for k, (median, factor) in enumerate(zip(medians, factors, strict=True)):
            rows.append((f"{k + 1}", number(median), f"{number(median / factor)} to {number(median * factor)}"))
        guess = f"; guess {self.prior_sd:g} worth {self.prior_events:g} events" if self.prior_events else ""
        return f"Ratios of measured to fitted values in {len(self.values)} events{guess}\n{text_table(rows)}"

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom for Student's t distribution."""
        return self.prior_events + len(self.values) - 1.0

    @property
    def median(self) -> np.ndarray:
        """Median ratio in a new event, shaped like one row: the geometric mean of the ratios."""
        return np.exp(np.log(self.values).mean(axis=0))

    @property
    def scale(self) -> np.ndarray:
        """Scale of the t distribution for the log ratio in a new event."""
        return self._sd() * np.sqrt(1.0 + 1.0 / len(self.values))

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the quantity that the ratios are for."""
        return self.values.shape[1:]

    def of_quantity(self, k: int) -> "EventRatios":
        """Ratios for quantity `k` of several."""
        return EventRatios(self.values[:, k], self.prior_sd, self.prior_events)

    def factor(self, level: float = 0.9) -> np.ndarray:
        """Factor by which the ends of the central interval at a level are above and below the median."""
        if not 0.0 < level < 1.0:
            raise ValueError(f"EventRatios.factor: level must be between 0 and 1; got {level!r}")
        return np.exp(special.stdtrit(self.degrees_of_freedom, 0.5 + 0.5 * level) * self.scale)

    def draw(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Draw ratios of a new event, shape (n,) or (n, n_quantities); independent between quantities."""
        return self.median * np.exp(self.scale * rng.standard_t(self.degrees_of_freedom, (n, *self.shape)))

    def draw_at(self, predicted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw one ratio for each predicted value (n, ...); it does not depend on the value."""
        return self.draw(len(predicted), rng)

    def probability_above(self, ratio: np.ndarray, log_predicted: np.ndarray) -> np.ndarray:
        """Probability that the ratio of a new event exceeds `ratio`, whatever the predicted value is."""
        return special.stdtr(self.degrees_of_freedom, standardised(np.log(self.median) - np.log(ratio), self.scale))

    def draw_populations(self, n: int, rng: np.random.Generator, log_predicted: np.ndarray) -> RatioPopulations:
        """Draw the mean and the standard deviation of log ratios from their posterior; one quantity."""
        if self.shape:
            raise ValueError(f"expected the ratios of one quantity, (n_events,); got {self.values.shape}")
        nu = self.degrees_of_freedom
        sd = self._sd() * np.sqrt(nu / rng.chisquare(nu, n))
        center = np.log(self.median) + sd / np.sqrt(len(self.values)) * rng.standard_normal(n)
        return RatioPopulations(np.zeros(1), center[:, None], sd)

    def _sd(self) -> np.ndarray:
        logs = np.log(self.values)
        squares = np.square(logs - logs.mean(axis=0)).sum(axis=0) + self.prior_events * self.prior_sd**2
        return np.sqrt(squares / self.degrees_of_freedom)


class _Kernel(NamedTuple):
    """Covariance of f in units of s, as a function of standardised log levels."""

    form: str
    amplitude: float = 0.0
    length: float = 1.0

    def matrix(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Covariances (m, n) of f between levels (m,) and (n,)."""
        if self.form == "linear":
            return self.amplitude**2 * np.outer(a, b)
        if self.form == "smooth":
            return self.amplitude**2 * np.exp(-0.5 * np.square((a[:, None] - b) / self.length))
        return np.zeros((len(a), len(b)))

    def diagonal(self, a: np.ndarray) -> np.ndarray:
        """Variances (m,) of f at levels (m,)."""
        return self.amplitude**2 * (np.square(a) if self.form == "linear" else np.ones_like(a))


_KERNELS = {
    "constant": (_Kernel("constant"),),
    "linear": tuple(_Kernel("linear", a) for a in _AMPLITUDES),
    "smooth": tuple(_Kernel("smooth", a, length) for a in _AMPLITUDES for length in _LENGTHS),
}


class _Regression(NamedTuple):
    """Regression of the log ratios with one kernel, and a flat prior of the mean."""

    kernel: _Kernel
    z: np.ndarray  # standardised log levels of the events
    inverse: np.ndarray  # of the covariance of the log ratios, in units of s
    mean: float
    residuals: np.ndarray
    squares: float  # of the residuals and of the guess
    log_evidence: float

    def predict(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Mean of f (m,), its covariances with the events (m, K), and the weight (m,) of the mean's error."""
        covariance = self.kernel.matrix(z, self.z)
        left = (1.0 - covariance @ self.inverse.sum(axis=1)) / np.sqrt(self.inverse.sum())
        return self.mean + covariance @ self.inverse @ self.residuals, covariance, left


def _regression(kernel: _Kernel, z: np.ndarray, logs: np.ndarray, prior_sd: float, prior_events: float) -> _Regression:
    """Integrate mean and variance out (Gelman et al. 2013, section 14.2, with the covariance of a Gaussian process)."""
    covariance = np.eye(len(z)) + kernel.matrix(z, z)
    inverse = np.linalg.inv(covariance)
    precision = inverse.sum()
    mean = inverse.sum(axis=0) @ logs / precision
    residuals = logs - mean
    squares = residuals @ inverse @ residuals + prior_events * prior_sd**2
    nu = prior_events + len(z) - 1.0
    # The priors of mean and variance are the same for all kernels, so that their constants cancel.
    tiny = np.finfo(float).tiny
    log_evidence = -0.5 * (np.linalg.slogdet(covariance)[1] + np.log(precision) + nu * np.log(max(squares, tiny)))
    return _Regression(kernel, z, inverse, float(mean), residuals, float(squares), float(log_evidence))


@dataclass(frozen=True, eq=False)
class LevelRatios:
    r"""Ratios of measured to fitted values that depend on the predicted value.

    Parameters
    ----------
    values : (n_events,) array_like
        Positive ratios of the calibration events, see `event_ratio`.
    levels : (n_events,) array_like
        Predicted values of the quantity in these events, see `event_level`; positive.
    form : {"constant", "linear", "smooth"}, optional
        How the log ratio depends on the logarithm of the level: not, along a straight line, or along a smooth curve (a
        Gaussian process). Default: all that the number of events permits, weighted by their evidence: "constant", with
        4 events "linear" and with 10 events "smooth".
    prior_sd, prior_events : float
        As for `EventRatios`: a guess of the standard deviation of the logarithm around the curve.

    Attributes
    ----------
    forms : dict of str to float
        Posterior probability of each form.

    Raises
    ------
    ValueError
        As `EventRatios`; if the levels are not positive, there is not one for each ratio, or they are all equal
        although `form` needs different levels.

    Notes
    -----
    For given amplitude and length of the curve, the logarithm of a new ratio has Student's t distribution with
    :math:`\nu_0 + K - 1` degrees of freedom, whose scale grows with the distance from the levels of the events. The
    distribution is the mixture over four amplitudes (0.25 to 16 times s) and, for smooth curves, three lengths (0.7,
    1.5 and 3 standard deviations of the log levels). The three forms have equal prior probabilities. With
    ``form="constant"`` the distribution is the same as with `EventRatios`. See ``docs/theory/prediction.rst``.

    Examples
    --------
    >>> ratios = LevelRatios([1.3, 1.2, 1.1, 0.98, 0.9], levels=[0.1, 0.3, 0.5, 1.0, 2.0])
    >>> ratios.quantile(0.5, 0.2)  # the median at a predicted value of 0.2
    """

    values: ArrayLike
    levels: ArrayLike
    form: str | None = None
    prior_sd: float = 0.1
    prior_events: float = 0.0

    def __post_init__(self) -> None:
        values = _checked_ratios("LevelRatios", self.values, self.prior_sd, self.prior_events, (1,))
        levels = np.array(self.levels, dtype=float)
        if levels.shape != values.shape or not ((levels > 0.0) & (levels < np.inf)).all():
            raise ValueError(
                f"LevelRatios: expected one positive predicted value for each of {len(values)} ratios; got "
                f"{self.levels!r}"
            )
        if self.form is not None and self.form not in FORMS:
            raise ValueError(f"LevelRatios: form must be one of {', '.join(FORMS)}, or None; got {self.form!r}")
        logs = np.log(levels)
        different = bool(np.ptp(logs) > _REACH)
        if self.form in FORMS[1:] and not (different and len(values) >= 2):
            raise ValueError(
                f"LevelRatios: a {self.form} dependence needs events of different levels; got {self.levels!r}: use "
                "EventRatios"
            )
        center, width = logs.mean(), logs.std() if different else 1.0
        possible = [form for form in FORMS if len(values) >= _LEAST_EVENTS[form] and (different or form == FORMS[0])]
        parts, log_weights = [], []
        for form in possible if self.form is None else [self.form]:
            for kernel in _KERNELS[form]:
                z, guess = (logs - center) / width, (self.prior_sd, self.prior_events)
                parts.append(_regression(kernel, z, np.log(values), *guess))
                log_weights.append(parts[-1].log_evidence - np.log(len(_KERNELS[form])))
        weights = np.exp(np.array(log_weights) - max(log_weights))
        fields = {"values": values, "levels": levels, "_center": center, "_width": width}
        for name, value in (fields | {"_parts": parts, "_weights": weights / weights.sum()}).items():
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        levels = np.unique(np.array(self.levels, dtype=float)[[np.argmin(self.levels), np.argmax(self.levels)]])
        rows = [("predicted value [SI]", "median of the ratio", f"{_SHOWN:.0%} interval of a new event")]
        for level in levels:
            low, median, high = (
                number(float(self.quantile(p, level))) for p in (0.5 - 0.5 * _SHOWN, 0.5, 0.5 + 0.5 * _SHOWN)
            )
            rows.append((number(level), median, f"{low} to {high}"))
        forms = ", ".join(f"{name} {share:.2f}" for name, share in self.forms.items())
        return f"Ratios by level in {len(self.values)} events; probabilities of the forms: {forms}\n{text_table(rows)}"

    @property
    def degrees_of_freedom(self) -> float:
        """Degrees of freedom for the t distributions."""
        return self.prior_events + len(self.values) - 1.0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the quantity that the ratios are for: one number."""
        return ()

    @property
    def forms(self) -> dict[str, float]:
        """Posterior probability of each form."""
        found = dict.fromkeys(FORMS, 0.0)
        for weight, part in zip(self._weights, self._parts, strict=True):
            found[part.kernel.form] += float(weight)
        return found

    def probability_above(self, ratio: np.ndarray, log_predicted: np.ndarray) -> np.ndarray:
        """Probability that the ratio of a new event exceeds `ratio`, at logarithms of predicted values."""
        logs, predicted = np.broadcast_arrays(np.log(ratio), log_predicted)
        return self._above(logs.ravel(), self._components(predicted.ravel())).reshape(logs.shape)

    def quantile(self, probability: float, predicted: ArrayLike) -> np.ndarray:
        """Quantile of the ratio in a new event, at predicted values and in their shape.

        Raises
        ------
        ValueError
            If the probability is not between 0 and 1, or a predicted value is not positive.
        """
        predicted = np.asarray(predicted, dtype=float)
        if not 0.0 < probability < 1.0 or not ((predicted > 0.0) & (predicted < np.inf)).all():
            raise ValueError(
                f"LevelRatios.quantile: expected a probability between 0 and 1 and positive predicted values; got "
                f"{probability!r} and {predicted}"
            )
        components = self._components(np.log(predicted).ravel())
        t = special.stdtrit(self.degrees_of_freedom, probability)
        ends = [center + scale * t for center, scale in components]
        low, high = np.min(ends, axis=0), np.max(ends, axis=0)
        for _ in range(60):  # bisection: the quantile of a mixture is between its parts' quantiles
            middle = 0.5 * (low + high)
            further = self._above(middle, components) > 1.0 - probability
            low, high = np.where(further, middle, low), np.where(further, high, middle)
        return np.exp(0.5 * (low + high)).reshape(predicted.shape)

    def draw_at(self, predicted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Draw one ratio of a new event for each predicted value (n,), which is positive."""
        part = rng.choice(len(self._parts), size=len(predicted), p=self._weights)
        t = rng.standard_t(self.degrees_of_freedom, len(predicted))
        center, scale = (np.array(each) for each in zip(*self._components(np.log(predicted)), strict=True))
        rows = np.arange(len(predicted))
        return np.exp(center[part, rows] + scale[part, rows] * t)

    def draw_populations(self, n: int, rng: np.random.Generator, log_predicted: np.ndarray) -> RatioPopulations:
        """Draw the curve f over the range of predicted values, and s, from their posterior."""
        grid = np.linspace(np.min(log_predicted) - _REACH, np.max(log_predicted) + _REACH, _GRID)
        z, nu = (grid - self._center) / self._width, self.degrees_of_freedom
        part = rng.choice(len(self._parts), size=n, p=self._weights)
        center, sd = np.empty((n, _GRID)), np.empty(n)
        for k, each in enumerate(self._parts):
            rows = np.flatnonzero(part == k)
            if not rows.size:
                continue
            mean, covariance, left = each.predict(z)
            spread = each.kernel.matrix(z, z) - covariance @ each.inverse @ covariance.T + np.outer(left, left)
            values, vectors = np.linalg.eigh(spread)
            sd[rows] = np.sqrt(each.squares / rng.chisquare(nu, rows.size))
            normal = rng.standard_normal((rows.size, _GRID)) * np.sqrt(np.maximum(values, 0.0))
            center[rows] = mean + sd[rows, None] * (normal @ vectors.T)
        return RatioPopulations(grid, center, sd)

    def _above(self, logs: np.ndarray, components: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Probability of the mixture above log ratios (m,)."""
        nu = self.degrees_of_freedom
        parts = zip(self._weights, components, strict=True)
        return sum(w * special.stdtr(nu, standardised(c - logs, s)) for w, (c, s) in parts)

    def _components(self, log_predicted: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        """Center and scale of each t distribution in the mixture, at log levels (m,)."""
        z, found = (log_predicted - self._center) / self._width, []
        for part in self._parts:
            mean, covariance, left = part.predict(z)
            variance = 1.0 + part.kernel.diagonal(z) + np.square(left)
            variance -= np.einsum("ij,jk,ik->i", covariance, part.inverse, covariance)
            found.append((mean, np.sqrt(part.squares / self.degrees_of_freedom * variance)))
        return found
