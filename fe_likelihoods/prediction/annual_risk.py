r"""Annual rates of exceedance, probabilities and losses: hazard times fragility times consequence.

A hazard curve :math:`H(s)` is the annual rate of events whose intensity exceeds s. With the fragility curve
:math:`P(s)`, a damage state is reached at the mean annual rate

.. math:: \lambda = \int_0^\infty P(s)\, \left|dH(s)\right| .

Between the points of the hazard curve, log H is linear in log s, :math:`H = c\, s^{-k}`, as beyond its ends. With a
lognormal P (median m, dispersion :math:`\beta`), integration by parts then gives the integral exactly, as a sum of

.. math::

   c\, m^{-k} e^{k^2 \beta^2 / 2} \left[\Phi\!\left(\frac{\ln (s / m)}{\beta} + k \beta\right)\right]_{s_i}^{s_{i+1}} .

For one power law this is the closed form of Cornell et al. (2002). Events are a Poisson process, and the structure is
repaired before the next event.

References
----------
C. A. Cornell, F. Jalayer, R. O. Hamburger, D. A. Foutch (2002), Probabilistic basis for 2000 SAC Federal Emergency
Management Agency steel moment frame guidelines, Journal of Structural Engineering 128(4), 526-533,
doi:10.1061/(ASCE)0733-9445(2002)128:4(526).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ..text_tables import number, text_table
from .fragility import Fragility
from .fragility_curve import FragilityCurve
from .reliability import check_level

__all__ = ["AnnualRisk", "annual_rate", "annual_risk"]


FAR = 0.5  # share of a rate outside the hazard curve or the records, above which a caution says so


class AnnualRisk(NamedTuple):
    """Annual rates of damage states, and the annual loss; ``str`` is a table and a sentence.

    Intervals contain what is unknown of the ratios and the parameters, where a `Fragility` has `draws`; otherwise the
    Monte Carlo error only. The hazard curve and the losses are taken as known.

    Attributes
    ----------
    states : tuple of str
        Names of the n damage states, from slight to severe.
    rate : (n,) float
        Mean annual rate at which each state is reached or exceeded [1/year].
    standard_error : (n,) float
        Monte Carlo error of the rates, of a finite number of simulations [1/year].
    lower, upper : (n,) float
        Interval of the rates [1/year].
    outside : (n,) float
        Share of each rate from intensities outside the hazard curve or, where a `Fragility` was given, outside its
        records. This share is extrapolated.
    loss, loss_error, loss_lower, loss_upper : float
        Expected annual loss, its Monte Carlo error and its interval, in the unit of the losses; NaN without losses.
    draws : (n_draws, n) float
        Rates whose quantiles are the intervals [1/year]; NaN where a draw determines no curve.
    level : float
        Probability of the intervals.
    uncertainty : str
        What the intervals contain.
    """

    states: tuple[str, ...]
    rate: np.ndarray
    standard_error: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    outside: np.ndarray
    loss: float
    loss_error: float
    loss_lower: float
    loss_upper: float
    draws: np.ndarray
    level: float
    uncertainty: str

    @property
    def probability(self) -> np.ndarray:
        """Probability (n,) that each state is reached in a year, 1 - exp(-rate)."""
        return -np.expm1(-self.rate)

    def __str__(self) -> str:
        head = ("state", "rate [1/year]", "MC error", f"{self.level:.0%} interval", "P in a year", "extrapolated")
        rows = [head]
        for k, name in enumerate(self.states):
            ends = f"{number(self.lower[k])} to {number(self.upper[k])}"
            cells = number(self.rate[k]), number(self.standard_error[k], 2), ends, number(self.probability[k])
            rows.append((name, *cells, f"{self.outside[k]:.0%}"))
        lines = [text_table(rows)]
        if far := [name for name, share in zip(self.states, self.outside, strict=True) if share > FAR]:
            lines.append(
                f"CAUTION: most of the rate of {', '.join(far)} comes from intensities outside the hazard curve or the "
                "records. Is the hazard curve in the unit of the fragilities?"
            )
        if np.isfinite(self.loss):
            lines.append(
                f"Expected loss per year: {number(self.loss)} ± {number(self.loss_error, 2)} (Monte Carlo), "
                f"{self.level:.0%} interval {number(self.loss_lower)} to {number(self.loss_upper)}."
            )
        return "\n".join(
            [*lines, f"The intervals contain {self.uncertainty}, not the uncertainty of the hazard curve."]
        )


def annual_rate(
    intensity: ArrayLike,
    rate: ArrayLike,
    median: ArrayLike,
    dispersion: ArrayLike,
    low: float = 0.0,
    high: float = np.inf,
) -> np.ndarray:
    """Mean annual rate at which a lognormal fragility curve is exceeded, by the closed form of each hazard segment.

    Parameters
    ----------
    intensity : (n,) array_like
        Increasing positive intensities of the hazard curve.
    rate : (n,) array_like
        Annual rates at which they are exceeded, decreasing [1/year].
    median, dispersion : array_like
        Parameters of fragility curves, of the same shape: (...), such as draws. The median has the unit of
        `intensity`.
    low, high : float
        Only events with intensities in this range are counted. Default: all.

    Returns
    -------
    (...) ndarray
        Rates [1/year].

    Raises
    ------
    ValueError
        If the hazard curve does not have two points or more, is not positive, or does not decrease.
    """
    s, h = (np.asarray(each, dtype=float) for each in (intensity, rate))
    if s.shape != h.shape or s.ndim != 1 or len(s) < 2:
        raise ValueError(
            f"a hazard curve needs two or more intensities with an annual rate each; got shapes {s.shape} and {h.shape}"
        )
    if not (np.all(np.diff(s) > 0.0) and np.all(np.diff(h) < 0.0) and s[0] > 0.0 and h[-1] > 0.0 and h[0] < np.inf):
        raise ValueError(
            "a hazard curve needs increasing positive intensities, and decreasing positive annual rates at which they "
            f"are exceeded; got intensities {s} and rates {h}"
        )
    m, beta = np.broadcast_arrays(np.asarray(median, dtype=float), np.asarray(dispersion, dtype=float))
    slopes = -np.diff(np.log(h)) / np.diff(np.log(s))
    ends = np.clip(np.concatenate([[0.0], s[1:-1], [np.inf]]), low, high)

    def standard(x: float) -> np.ndarray:
        with np.errstate(divide="ignore"):
            return np.log(x / m) / beta

    def exceeding(x: float) -> np.ndarray:
        """P(x) H(x), which vanishes at 0 and infinity."""
        if x in (0.0, np.inf):
            return np.zeros(m.shape)
        k = int(np.clip(np.searchsorted(s, x) - 1, 0, len(slopes) - 1))
        return special.ndtr(standard(x)) * h[k] * (x / s[k]) ** -slopes[k]

    total = exceeding(low) - exceeding(high)
    for k, slope in enumerate(slopes):
        if ends[k] < ends[k + 1]:
            at = [standard(x) + slope * beta for x in ends[k : k + 2]]
            power = np.log(h[k]) - slope * np.log(m / s[k]) + 0.5 * (slope * beta) ** 2
            total = total + np.exp(power + _log_between(*at))
    return total


def _log_between(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """log(Phi(high) - Phi(low)), accurate in both tails."""
    upper = low > 0.0
    small, large = np.where(upper, -high, low), np.where(upper, -low, high)
    most = special.log_ndtr(large)
    with np.errstate(divide="ignore"):
        return most + np.log(-np.expm1(np.minimum(special.log_ndtr(small) - most, 0.0)))


def annual_risk(
    fragilities: Fragility | FragilityCurve | Mapping[str, Fragility | FragilityCurve],
    intensity: ArrayLike,
    rate: ArrayLike,
    losses: float | Mapping[str, float] | None = None,
    *,
    level: float = 0.9,
) -> AnnualRisk:
    """Combine fragility with a hazard curve and with losses: annual rates, probabilities and the expected loss.

    Parameters
    ----------
    fragilities : Fragility, FragilityCurve, or mapping of names to them
        One result of `fragility`, or several damage states from slight to severe. Give the same samples and the same
        `seed` to each `fragility`, so that the error of the loss contains their correlation.
    intensity : (n,) array_like
        Increasing intensities of the hazard curve, in the unit of the fragilities (m/s² for the default of
        `fragility`). Between and beyond them, the logarithm of the rate is linear in the logarithm of the intensity.
    rate : (n,) array_like
        Mean annual rates at which these intensities are exceeded [1/year].
    losses : float, or mapping of names to float, optional
        Loss of each state, in any unit of money, time or lives: of an event after which the structure is in this state
        and in no severer one.
    level : float
        Probability of the intervals, between 0 and 1.

    Returns
    -------
    AnnualRisk

    Raises
    ------
    ValueError
        For an impossible hazard curve (`annual_rate`), a fragility without a curve, states that are not ordered from
        slight to severe, or losses of other states, negative ones, or ones that decrease with severity.

    Examples
    --------
    >>> states = {"cracked": fragility(..., threshold=0.02, seed=1), "yielded": fragility(..., threshold=0.05, seed=1)}
    >>> print(annual_risk(states, [0.5, 2.0, 8.0], [0.1, 0.01, 2e-4], {"cracked": 1.0, "yielded": 10.0}))
    """
    check_level(level)
    given = dict(fragilities) if isinstance(fragilities, Mapping) else {"exceedance": fragilities}
    names = tuple(given)
    amounts = losses if isinstance(losses, Mapping) or losses is None else dict.fromkeys(names, losses)
    if not given or (amounts is not None and set(amounts) != set(names)):
        raise ValueError(f"expected a loss for each state, {', '.join(names) or 'of one or more'}; got {losses!r}")
    if wrong := [name for name, each in given.items() if not isinstance(each, Fragility | FragilityCurve)]:
        raise ValueError(f"expected a Fragility or FragilityCurve for each state; got something else for {wrong}")
    amount = np.array([] if amounts is None else [amounts[name] for name in names], dtype=float)
    if not (np.isfinite(amount).all() and (amount >= 0.0).all() and (np.diff(amount) >= 0.0).all()):
        raise ValueError(
            "expected losses that are finite, not negative, and not smaller in severer states (the loss of a state is "
            f"the whole loss of an event that ends in it); got {losses!r}"
        )
    curves = {name: each.curve if isinstance(each, Fragility) else each for name, each in given.items()}
    if missing := [name for name, curve in curves.items() if curve is None]:
        raise ValueError(
            f"the points of {', '.join(missing)} determine no fragility curve: use records of more intensities, "
            "between those where none and all of the samples exceed"
        )
    rates = np.array([float(annual_rate(intensity, rate, *curve[:2])) for curve in curves.values()])
    if np.any(np.diff(rates) > 0.0):
        raise ValueError(
            "expected states from slight to severe, each reached less often than the state before it; got annual rates "
            + ", ".join(f"{number(value)} of {name}" for name, value in zip(names, rates, strict=True))
        )
    s = np.asarray(intensity, dtype=float)
    outside = np.empty(len(names))
    for k, (name, curve) in enumerate(curves.items()):
        points = given[name].intensity if isinstance(given[name], Fragility) else s
        ends = max(s[0], points.min()), min(s[-1], points.max())
        within = float(annual_rate(intensity, rate, *curve[:2], *ends)) if ends[0] < ends[1] else 0.0
        outside[k] = max(1.0 - within / rates[k], 0.0)
    resampled = _of_curves(intensity, rate, [curve.resampled for curve in curves.values()])
    of_events = all(curve.drawn is not None for curve in curves.values())
    draws = _of_curves(intensity, rate, [curve.drawn for curve in curves.values()]) if of_events else resampled
    said = "what is unknown of the ratios, the events and the parameters" if of_events else "the Monte Carlo error only"
    weights = np.diff(
        amount if len(amount) else np.full(len(names), np.nan), prepend=0.0
    )  # sum of losses (rate of a state less the rate of the next) by rates
    lower, upper = _interval(draws, rates, level)
    loss = float(rates @ weights)
    loss_lower, loss_upper = _interval((draws @ weights)[:, None], np.array([loss]), level)
    return AnnualRisk(
        states=names,
        rate=rates,
        standard_error=_scatter(resampled),
        lower=lower,
        upper=upper,
        outside=outside,
        loss=loss,
        loss_error=np.nan if amounts is None else float(_scatter((resampled @ weights)[:, None])[0]),
        loss_lower=float(loss_lower[0]),
        loss_upper=float(loss_upper[0]),
        draws=draws,
        level=level,
        uncertainty=said,
    )


def _of_curves(intensity: ArrayLike, rate: ArrayLike, curves: list[np.ndarray | None]) -> np.ndarray:
    """Rates (n_draws, n) of the draws (n_draws, 2) of n curves; no draws where a curve has none."""
    if any(each is None for each in curves):
        return np.empty((0, len(curves)))
    fewest = min(len(each) for each in curves)
    return np.stack([annual_rate(intensity, rate, *each[:fewest].T) for each in curves], axis=1)


def _whole(draws: np.ndarray) -> np.ndarray:
    """The draws without NaN; none if more than a tenth have NaN, since the others would be a biased selection."""
    finite = draws[np.isfinite(draws).all(axis=1)]
    return finite if len(finite) >= 0.9 * len(draws) else finite[:0]


def _scatter(draws: np.ndarray) -> np.ndarray:
    """Standard deviation (n,) of draws (n_draws, n); inf where too few are known."""
    whole = _whole(draws)
    return whole.std(axis=0) if len(whole) else np.full(draws.shape[1], np.inf)


def _interval(draws: np.ndarray, value: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Quantiles of draws (n_draws, n), extended to the value (n,); NaN where too few draws are known."""
    whole = _whole(draws)
    if not len(whole):
        return np.full(len(value), np.nan), np.full(len(value), np.nan)
    lower, upper = np.quantile(whole, [0.5 - 0.5 * level, 0.5 + 0.5 * level], axis=0)
    return np.minimum(lower, value), np.maximum(upper, value)
