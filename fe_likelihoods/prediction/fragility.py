r"""Fragility: probability that a response exceeds a limit, against the intensity of the shaking.

Under each record the probability of an exceedance is that of `fe_likelihoods.exceedance`. A lognormal curve

.. math:: P(\text{exceed} \mid x) = \Phi\!\left(\frac{\ln (x / m)}{s}\right)

with the median :math:`m` and the dispersion :math:`s` is fitted to these points by maximum likelihood. See
``docs/theory/prediction.rst``.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from ..population.event_ratios import EventRatios
from ..text_tables import number, text_table
from .exceedance import Estimate, Exceedance, estimate, inputs
from .prediction import Prediction

logger = logging.getLogger(__name__)

_REPLICATES = 100  # resamplings for the errors of the curve


class FragilityCurve(NamedTuple):
    """Lognormal fragility curve, P(exceed | intensity) = Phi(ln(intensity / median) / dispersion).

    The errors are for fixed records, without the effect of other records: from the uncertainty of ratios and event
    population, if there are any; otherwise Monte Carlo errors, by resampling the samples (which all records share).
    They are inf if more than a tenth of the resamplings do not determine a curve.
    """

    median: float  # intensity at which the probability is one half
    dispersion: float  # standard deviation of the log capacity in terms of intensity [-]
    median_error: float = np.inf
    dispersion_error: float = np.inf

    def __str__(self) -> str:
        median, dispersion = number(self.median), number(self.dispersion)
        if np.isfinite(self.median_error) and np.isfinite(self.dispersion_error):
            median += f" +- {number(self.median_error, 2)}"
            dispersion += f" +- {number(self.dispersion_error, 2)}"
        return f"lognormal fragility curve: median {median}, dispersion {dispersion}"

    def probability(self, intensity: ArrayLike) -> np.ndarray:
        """Return the probability of an exceedance at positive intensities."""
        return special.ndtr(np.log(np.asarray(intensity, dtype=float) / self.median) / self.dispersion)


class Fragility(NamedTuple):
    """Probability of an exceedance against intensity.

    Attributes
    ----------
    intensity : ndarray, shape (n_records,)
        Intensities of the records.
    exceedance : Exceedance
        The probabilities, arrays (n_records,).
    n_failed : ndarray of int, shape (n_records,)
        Number of samples whose simulation failed, without those whose structure collapsed.
    n_collapsed : ndarray of int, shape (n_records,)
        Number of samples whose structure collapsed (`fe_likelihoods.SimulationFailed` with a reason that begins with
        "collapse"). They count as exceedances.
    curve : FragilityCurve or None
        The fitted curve, None if the points do not determine one (the reason is logged as a warning).
    """

    intensity: np.ndarray
    exceedance: Exceedance
    n_failed: np.ndarray
    n_collapsed: np.ndarray
    curve: FragilityCurve | None

    def __str__(self) -> str:
        rows, found = [("intensity", "P(exceed)", "MC error", "interval", "failed", "collapsed")], self.exceedance
        for k, at in enumerate(self.intensity):
            cells = number(at), number(found.probability[k]), number(found.standard_error[k], 2)
            ends = f"{number(found.lower[k])} to {number(found.upper[k])}"
            rows.append((*cells, ends, f"{self.n_failed[k]}", f"{self.n_collapsed[k]}"))
        unit = "" if found.unit == "1" else f" {found.unit}"
        curve = "no curve: the points do not determine one" if self.curve is None else f"{self.curve}"
        lines = [f"Probability to exceed {number(found.threshold)}{unit}", text_table(rows), curve]
        return "\n".join([*lines, f"The probabilities contain {found.uncertainty}."])

    __repr__ = __str__


def fragility(
    predictions: Sequence[Prediction],
    intensity: ArrayLike,
    threshold: float,
    *,
    unit: str | None = None,
    ratios: EventRatios | None = None,
    noise: bool | None = None,
    interval_probability: float = 0.95,
    seed: int = 0,
) -> Fragility:
    """Estimate the probability that a quantity exceeds a threshold under each of several records, and fit a curve.

    Parameters
    ----------
    predictions : sequence of Prediction
        Predictions of one number, such as ``peak("displacement")``, from the same samples under each record: results of
        `propagate`, or, for a population of events, of `predict_new_event`, which have the scatter that each record
        makes of the parameters.
    intensity : (n_records,) array_like
        Positive intensity of each record, such as its peak acceleration [m/s²].
    threshold : float
        The threshold; positive if there are ratios.
    unit, ratios, noise, interval_probability, seed
        As for `exceedance`.

    Returns
    -------
    Fragility
        Probabilities per record, and the curve.

    Raises
    ------
    ValueError
        As `exceedance`. Also if there are no predictions, they are not of one number or of as many samples, or the
        intensities are not one positive number for each.

    Warns
    -----
    UserWarning
        As `exceedance`.

    Examples
    --------
    >>> motions = [record.scale(factor) for factor in (0.8, 0.9, 1.0, 1.1, 1.2)]
    >>> peaks = [propagate(posterior, samples, quantity=peak("displacement"), record=each) for each in motions]
    >>> strongest = [np.abs(each.acceleration).max() for each in motions]  # m/s²
    >>> ratios = EventRatios([0.93, 1.10, 1.02, 0.99])  # measured to predicted peaks of earlier events
    >>> print(fragility(peaks, strongest, 8.0, unit="cm", ratios=ratios))  # doctest: +SAMPLED
    Probability to exceed 0.08 m
    intensity  P(exceed)  MC error          interval  failed  collapsed
    0.74          0.0777   0.00061  0.00138 to 0.372       0          0
    0.833          0.295    0.0017   0.0528 to 0.699       0          0
    0.925          0.624    0.0019    0.255 to 0.924       0          0
    1.02           0.856     0.001    0.515 to 0.992       0          0
    1.11           0.952   0.00039        0.734 to 1       0          0
    lognormal fragility curve: median 0.89 +- 0.054, dispersion 0.129 +- 0.028
    The probabilities contain the uncertainty of the parameters and the error of the model, from the ratios of 4
    events.
    """
    predictions, intensities = list(predictions), np.atleast_1d(np.asarray(intensity, dtype=float))
    if not predictions or not all(isinstance(each, Prediction) for each in predictions):
        raise ValueError(
            "fragility needs a prediction for each record, such as [propagate(posterior, samples, record=each, "
            f"quantity=peak(channel)) for each in records]; got {predictions!r}"
        )
    if not np.all((intensities > 0.0) & (intensities < np.inf)) or intensities.shape != (len(predictions),):
        raise ValueError(
            f"intensities must be positive and finite, one for each of {len(predictions)} predictions; got {intensity}"
        )
    if odd := [each for each in predictions if each.mean.shape or each.values is None]:
        raise ValueError(f"fragility needs predictions of one number, such as peak(channel); got {odd[0]!r}")
    if len(sizes := {each.n_samples + each.n_failed for each in predictions}) > 1:
        raise ValueError(f"fragility needs predictions from the same samples; got {sorted(sizes)} samples")
    estimates, contains = [], {}
    for k, each in enumerate(predictions):  # what a prediction does not contain is said once
        known, limit, own = inputs(each, threshold, unit, ratios, noise, "" if k else "fragility")
        if limit.shape:
            raise ValueError(f"fragility needs one threshold; got an array of shape {limit.shape}")
        if own is not None and own.shape:
            raise ValueError(f"fragility needs ratios of one quantity, (n_events,); got {own.values.shape}")
        estimates.append(estimate(known.values, limit, own, known.effective, interval_probability, seed))
        contains[known.contents.partition(";")[0]] = known
    if len(contains) > 1:
        raise ValueError(f"fragility needs predictions of one kind; their probabilities contain {' / '.join(contains)}")
    arrays = zip(*(each.exceedance[1:5] for each in estimates), strict=True)
    found = Exceedance(limit, *map(np.array, arrays), known.effective, *contains, known.unit)
    collapsed = np.array([len(each.collapsed) for each in predictions])
    failed = np.array([each.n_failed for each in predictions]) - collapsed
    try:
        curve = _curve_with_errors(intensities, estimates, known.effective, np.random.default_rng(seed))
    except ValueError as reason:
        logger.warning("no fragility curve: %s", reason)
        curve = None
    return Fragility(intensities, found, failed, collapsed, curve)


def fit_fragility(intensity: np.ndarray, exceedances: np.ndarray, trials: np.ndarray) -> FragilityCurve:
    """Fit a lognormal curve to numbers (n,) of exceedances in trials by maximum likelihood (Baker 2015, binomial).

    The numbers need not be whole. ValueError if the points do not determine a rising curve: fewer than two intensities,
    none or all of the trials exceed, every intensity with an exceedance is above every one without, or the probability
    decreases with intensity.
    """
    some, not_all = intensity[exceedances > 0.0], intensity[exceedances < trials]
    if not some.size or not not_all.size:
        raise ValueError(f"{'all' if some.size else 'none'} of the trials exceed: use records of other intensities")
    if np.ptp(intensity[trials > 0.0]) == 0.0 or some.min() >= not_all.max():
        raise ValueError(
            "the points do not determine the slope: use more intensities between those where none and all exceed"
        )
    from scipy.optimize import minimize  # slow to import

    logs = np.log(intensity)
    centre, width = logs.mean(), logs.std()
    x = (logs - centre) / width

    def loss(ab: np.ndarray) -> tuple[float, np.ndarray]:
        z = ab[0] + ab[1] * x
        above, below = special.log_ndtr(z), special.log_ndtr(-z)
        density = -0.5 * z**2 - 0.5 * np.log(2.0 * np.pi)
        slope = exceedances * np.exp(density - above) - (trials - exceedances) * np.exp(density - below)
        value = exceedances @ above + (trials - exceedances) @ below
        return -value / trials.sum(), -np.array([slope.sum(), slope @ x]) / trials.sum()

    found = minimize(loss, np.array([0.0, 1.0]), jac=True, method="BFGS", options={"gtol": 1e-8})
    offset, slope = found.x
    if not (np.isfinite(found.x).all() and slope > 0.0):
        raise ValueError(
            "the probability does not rise with intensity, so that no fragility curve fits: check the intensities"
        )
    return FragilityCurve(float(np.exp(centre - width * offset / slope)), float(width / slope))


def _curve_with_errors(
    intensity: np.ndarray, estimates: Sequence[Estimate], effective: float, rng: np.random.Generator
) -> FragilityCurve:
    """Fit the curve to the probabilities of the samples under each record, with errors by 100 further fits.

    These are to the draws of populations, or to resampled samples, of which `effective` are independent. ValueError as
    `fit_fragility`.
    """
    single, counted = (np.array([getattr(each, name) for each in estimates]) for name in ("single", "counted"))
    curve = fit_fragility(intensity, (single * counted).sum(axis=1), counted.sum(axis=1))
    if estimates[0].draws is None:
        n = single.shape[1]
        weights = rng.multinomial(max(int(round(effective)), 1), np.full(n, 1.0 / n), size=_REPLICATES)
        points = [((single * counted) @ each, counted @ each) for each in weights]
    else:
        draws = np.stack([each.draws for each in estimates], axis=1)
        whole = draws[np.isfinite(draws).all(axis=1)]
        rows = np.linspace(0, len(whole) - 1, min(len(whole), _REPLICATES)).astype(int)
        points = [(each, np.ones(len(intensity))) for each in whole[rows]]
    found = []
    for each in points:
        try:
            found.append(fit_fragility(intensity, *each)[:2])
        except ValueError:
            continue
    if not found or len(found) < 0.9 * len(points):  # those with a curve would be a biased selection
        return curve
    return FragilityCurve(*curve[:2], *np.std(found, axis=0).tolist())
