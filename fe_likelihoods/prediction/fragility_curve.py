r"""Lognormal fragility curves, fitted by maximum likelihood.

The curve

.. math:: P(\text{exceed} \mid x) = \Phi\!\left(\frac{\ln (x / m)}{s}\right)

has the median :math:`m` and the dispersion :math:`s` (Baker 2015). See ``docs/theory/prediction.rst``.

References
----------
J. W. Baker (2015), Efficient analytical fragility function fitting using dynamic structural analysis, Earthquake
Spectra 31(1), 579-599, doi:10.1193/021113EQS025M.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from ..text_tables import number

__all__ = ["FragilityCurve", "curve_with_errors", "fit_fragility"]

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
    unit: str = ""  # of the intensities; empty where it is not known

    def __str__(self) -> str:
        median, dispersion = number(self.median), number(self.dispersion)
        if np.isfinite(self.median_error) and np.isfinite(self.dispersion_error):
            median += f" +- {number(self.median_error, 2)}"
            dispersion += f" +- {number(self.dispersion_error, 2)}"
        unit = f" {self.unit}" if self.unit else ""
        return f"lognormal fragility curve: median {median}{unit}, dispersion {dispersion}"

    def probability(self, intensity: ArrayLike) -> np.ndarray:
        """Return the probability of an exceedance at positive intensities."""
        return special.ndtr(np.log(np.asarray(intensity, dtype=float) / self.median) / self.dispersion)


def fit_fragility(intensity: ArrayLike, exceedances: ArrayLike, trials: ArrayLike) -> FragilityCurve:
    """Fit a lognormal fragility curve by maximum likelihood (Baker 2015: binomial at each intensity).

    Parameters
    ----------
    intensity : (n,) array_like
        Positive intensities.
    exceedances : (n,) array_like
        Number of exceedances at each intensity, not necessarily a whole number.
    trials : (n,) array_like
        Number of trials at each intensity, not necessarily a whole number.

    Returns
    -------
    FragilityCurve
        The curve, without errors (inf) and without a unit.

    Raises
    ------
    ValueError
        If the points do not determine a rising curve: fewer than two intensities, none or all of the trials exceed,
        every intensity with an exceedance is above every one without, or the probability decreases with intensity.

    Examples
    --------
    >>> from fe_likelihoods.prediction.fragility_curve import fit_fragility
    >>> curve = fit_fragility([1.0, 2.0, 4.0], [1, 10, 19], [20, 20, 20])  # 20 trials at each intensity
    >>> round(float(curve.median), 2)
    2.0
    """
    intensity, exceedances, trials = (np.asarray(each, dtype=float) for each in (intensity, exceedances, trials))
    if not intensity.shape == exceedances.shape == trials.shape or intensity.ndim != 1:
        raise ValueError(
            f"expected one number of exceedances and of trials for each intensity; got shapes {intensity.shape}, "
            f"{exceedances.shape}, {trials.shape}"
        )
    if not (np.all(intensity > 0.0) and np.all((exceedances >= 0.0) & (exceedances <= trials + 1e-9))):
        raise ValueError(
            f"expected positive intensities and 0 <= exceedances <= trials; got {intensity}, {exceedances}, {trials}"
        )
    some, not_all = intensity[exceedances > 0.0], intensity[exceedances < trials]
    if not some.size or not not_all.size:
        raise ValueError(f"{'all' if some.size else 'none'} of the trials exceed: use records of other intensities")
    if np.ptp(intensity[trials > 0.0]) == 0.0 or some.min() >= not_all.max():
        raise ValueError(
            "the points do not determine the slope: use more intensities between those where none and all exceed"
        )

    logs = np.log(intensity)
    centre, width = logs.mean(), logs.std()
    x = (logs - centre) / width
    total = trials.sum()

    def loss(ab: np.ndarray) -> tuple[float, np.ndarray]:
        z = ab[0] + ab[1] * x
        above, below = special.log_ndtr(z), special.log_ndtr(-z)
        density = -0.5 * z**2 - 0.5 * np.log(2.0 * np.pi)
        slope = exceedances * np.exp(density - above) - (trials - exceedances) * np.exp(density - below)
        value = exceedances @ above + (trials - exceedances) @ below
        return -value / total, -np.array([slope.sum(), slope @ x]) / total

    found = optimize.minimize(loss, np.array([0.0, 1.0]), jac=True, method="BFGS", options={"gtol": 1e-8})
    offset, slope = found.x
    if not (np.isfinite(found.x).all() and slope > 0.0):
        raise ValueError(
            "the probability does not rise with intensity, so that no fragility curve fits: check the intensities"
        )
    return FragilityCurve(float(np.exp(centre - width * offset / slope)), float(width / slope))


def curve_with_errors(
    intensity: np.ndarray,
    exceeds: np.ndarray,
    counted: np.ndarray,
    effective: float,
    draws: np.ndarray | None,
    rng: np.random.Generator,
) -> FragilityCurve:
    """Fit the curve to samples' probabilities to exceed (n_records, n_samples); `counted` is 1 where a sample counts.

    The errors come from curves fitted to `draws` (n_draws, n_records) of the probabilities; None: the samples are
    resampled, of which `effective` are independent. ValueError as `fit_fragility`.
    """
    n = exceeds.shape[1]
    curve = fit_fragility(intensity, exceeds.sum(axis=1), counted.sum(axis=1))
    if draws is None:
        chosen = rng.multinomial(max(int(round(effective)), 1), np.full(n, 1.0 / n), size=_REPLICATES)
        found = _fits(intensity, [(exceeds @ weights, counted @ weights) for weights in chosen])
    else:
        whole = draws[np.isfinite(draws).all(axis=1)]
        rows = np.linspace(0, len(whole) - 1, min(len(whole), _REPLICATES)).astype(int)
        found = _fits(intensity, [(n * whole[row], np.full(len(intensity), float(n))) for row in rows])
    determined = found[np.isfinite(found).all(axis=1)]
    if not len(found) or len(determined) < 0.9 * len(found):  # those with a curve would be a biased selection
        return curve
    return curve._replace(
        **dict(zip(("median_error", "dispersion_error"), determined.std(axis=0).tolist(), strict=True))
    )


def _fits(intensity: np.ndarray, points: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Median and dispersion (n, 2) of curves fitted to exceedances and trials; NaN where they determine no curve."""
    found = np.full((len(points), 2), np.nan)
    for k, each in enumerate(points):
        try:
            found[k] = fit_fragility(intensity, *each)[:2]
        except ValueError:
            continue
    return found
