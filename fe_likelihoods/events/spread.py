r"""Probability of an exceedance in a new event: per sample, and per draw of the event population.

The value in a new event is :math:`r\, g(\theta)`, with a ratio r for the model error, and parameters that belong to the
structure, or to one event drawn from a population. Given the population :math:`h`, the probability of an exceedance is
a number :math:`P_h`. Its mean over the posterior of :math:`h` is the probability that is reported, and its quantiles
are the interval. See ``docs/theory/prediction.rst``.
"""

from typing import NamedTuple

import numpy as np
from scipy import special

from .ratios import EventRatios, RatioPopulations, standardised

__all__ = ["EventSpread", "exceedance_draws", "exceedance_of_samples"]

_DRAWS = 1000  # of the population, where the samples have no weights
_CHUNK = 2**20  # values of a temporary array


class EventSpread(NamedTuple):
    """Unknowns on which the probability of an exceedance in a new event depends.

    The weights are importance weights of the samples under each of several populations
    (`Hierarchy.population_weights`), None if the parameters are the same in all events. Ratios contain the model error.
    """

    values: np.ndarray  # (n_samples, ...), not yet multiplied by a ratio
    weights: np.ndarray | None = None  # (n_populations, n_samples)
    ratios: EventRatios | None = None


def exceedance_of_samples(
    values: np.ndarray, limits: np.ndarray, ratios: EventRatios | None, below: bool = False
) -> np.ndarray:
    """Probability (n, ...) of each sample that its value in a new event exceeds the limit; 0 or 1 without ratios.

    Limits have the shape of the values (n, ...), and are positive if there are ratios of the quantity. With `below`,
    values below a limit exceed it.
    """
    if ratios is None:
        return (values < limits if below else values > limits).astype(float)
    positive = values > 0.0  # times a ratio, others stay below a positive limit
    known = np.where(positive, values, 1.0)
    above = np.where(positive, ratios.probability_above(limits / known, np.log(known)), 0.0)
    return 1.0 - above if below else above


def exceedance_draws(
    values: np.ndarray,
    limits: np.ndarray,
    spread: EventSpread,
    rng: np.random.Generator,
    below: bool = False,
    failed: np.ndarray | None = None,
    exceeding: np.ndarray | None = None,
) -> np.ndarray:
    """Draws (n_draws, ...) of the probability that the value in a new event exceeds the limit, one per population.

    Weights and ratios are those of `spread`, and all entries of the values have the same draws. Failed values (n, ...)
    count as exceedances where `exceeding`; the others are left out, and a draw of such a sample is NaN.
    """
    failed, exceeding = (np.zeros(values.shape, dtype=bool) if each is None else each for each in (failed, exceeding))
    known = np.where(failed, np.nanmax(np.where(failed, -np.inf, values), initial=-np.inf), values)
    if spread.weights is None:  # each draw has one of the samples
        rows = rng.permutation(np.resize(rng.permutation(len(values)), _DRAWS))[:, None]
    else:  # each draw has all samples, with the weights of its population
        rows = np.tile(np.arange(len(values)), (len(spread.weights), 1))
    populations = None if spread.ratios is None else spread.ratios.draw_populations(len(rows), rng)
    found = np.empty((len(rows), *values.shape[1:]))
    size = max(1, _CHUNK // (rows.shape[1] * max(1, known[0].size)))
    for first in range(0, len(rows), size):
        chunk = slice(first, first + size)
        at = rows[chunk]
        if populations is None:
            single = exceedance_of_samples(known[at], limits[at], None, below)
        else:
            part = RatioPopulations(*(each[chunk] for each in populations[:3]), populations.log_level)
            single = _given_populations(known[at], limits[at], part, below)
        counted = np.ones(single.shape)
        single = np.where(exceeding[at], 1.0, single)
        counted[failed[at] & ~exceeding[at]] = 0.0
        weights = np.ones(at.shape) if spread.weights is None else spread.weights[chunk]
        total = np.einsum("hj,hj...->h...", weights, counted)
        share = np.einsum("hj,hj...->h...", weights, single * counted)
        found[chunk] = np.where(total > 0.0, share / np.where(total > 0.0, total, 1.0), np.nan)
    return found


def _given_populations(
    values: np.ndarray, limits: np.ndarray, populations: RatioPopulations, below: bool
) -> np.ndarray:
    """Probability that values (n_draws, m, ...) times a ratio from their draw's population exceed limits."""
    positive = values > 0.0
    logs = np.log(np.where(positive, values, 1.0))
    sd = populations.sd.reshape(-1, *(1,) * (values.ndim - 1))
    differences = logs - np.log(limits) + populations.center_at(logs)
    above = np.where(positive, special.ndtr(standardised(differences, sd)), 0.0)
    return 1.0 - above if below else above
