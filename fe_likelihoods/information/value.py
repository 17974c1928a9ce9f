r"""What information is worth: the loss that a decision is expected to avoid if something is known before it is taken.

Each option d has a loss :math:`L_d(\theta)`, known at draws of what is uncertain. Without more data the best option has
the smallest mean loss. With x known before the choice, the expected loss falls by

.. math:: V(x) = \min_d E[L_d] - E_x \left[\min_d E[L_d \mid x]\right].

With :math:`x = \theta` this is the expected value of perfect information (EVPI), with some of the parameters its part
for them (EVPPI), and with data of a test that was simulated at each draw it is the expected value of sample
information (EVSI). The conditional means are polynomial regressions of loss differences on x, over all draws, so that
nothing is simulated again (Strong, Oakley & Brennan 2014 for parameters; Strong, Oakley, Brennan & Breeze 2015 for
data). The maximum over fitted means is too large on average, most of all if x tells nothing. Therefore the draws are
divided into ten parts: in each part the option is chosen by regressions that were fitted to the other nine, and V is
the mean of the losses that these choices avoid. It is the value of a rule that can be used, never above the EVPI, and
near zero for noise.

References
----------
M. Strong, J. E. Oakley, A. Brennan (2014), Estimating multiparameter partial expected value of perfect information from
a probabilistic sensitivity analysis sample, Medical Decision Making 34(3), 311-326, doi:10.1177/0272989X13505910.
M. Strong, J. E. Oakley, A. Brennan, P. Breeze (2015), Estimating the expected value of sample information using the
probabilistic sensitivity analysis sample, Medical Decision Making 35(5), 570-583, doi:10.1177/0272989X15575286.
"""

from collections.abc import Mapping
from itertools import combinations_with_replacement
from math import comb
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..text_tables import number, text_table

__all__ = ["ValueOfInformation", "simulate_summary", "value_of_information"]

FOLDS = 10
DEGREES = (1, 2, 3, 4)  # of the polynomials; no regression is possible too
DRAWS_PER_TERM = 10  # fewest
SMALLEST_SHARE = 1e-12  # of the largest precision: below, a direction is not measured


class ValueOfInformation(NamedTuple):
    """What perfect and partial information is worth before a decision; ``str`` is a sentence and a table.

    All values are in the unit of the losses, with standard errors of a finite number of draws.

    Attributes
    ----------
    options : tuple of str
        The options.
    loss, loss_error : (n_options,) float
        Expected loss of each option.
    best : str
        The option with the smallest expected loss.
    lead, lead_error : float
        What the next best option is expected to lose more. If it is less than two errors, the draws do not decide.
    perfect, perfect_error : float
        Expected value of perfect information (EVPI): nothing that is learned before the decision is worth more.
    learned : tuple of str
        What could be learned.
    value, value_error : (n_learned,) float
        What each is worth before the decision. A value below zero, by its error, is zero.
    """

    options: tuple[str, ...]
    loss: np.ndarray
    loss_error: np.ndarray
    best: str
    lead: float
    lead_error: float
    perfect: float
    perfect_error: float
    learned: tuple[str, ...]
    value: np.ndarray
    value_error: np.ndarray

    def __str__(self) -> str:
        k = self.options.index(self.best)
        lines = [
            f"Without more information the best option is {self.best!r}: its expected loss is "
            f"{_pair(self.loss[k], self.loss_error[k])}, {_pair(self.lead, self.lead_error)} less than the next one. "
            f"Perfect information before the decision is worth {_pair(self.perfect, self.perfect_error)}."
        ]
        if self.learned:
            rows = [("learned before the decision", "worth", "of perfect information")]
            for name, value, error in zip(self.learned, self.value, self.value_error, strict=True):
                share = f"{value / self.perfect:.0%}" if self.perfect > 0.0 else "-"
                rows.append((name, _pair(value, error), share))
            lines.append(text_table(rows))
        return "\n".join(lines)


def _pair(value: float, error: float) -> str:
    return f"{number(value)} ± {number(error, 2)}"


def value_of_information(
    losses: Mapping[str, ArrayLike],
    learned: Mapping[str, ArrayLike] | None = None,
    *,
    effective_sample_size: float | None = None,
) -> ValueOfInformation:
    """Estimate how much of the expected loss further information could remove.

    Parameters
    ----------
    losses : mapping of str to (n,) array_like
        Loss of each option, two or more, at n draws of what is uncertain: of the prior or of a posterior. What no test
        can tell, such as the next motion, must be averaged over at each draw.
    learned : mapping of str to (n,) or (n, k) array_like, optional
        What could be learned before the decision, at the same draws: some parameters, or data that were simulated with
        their noise (`simulate_summary` for sensors). Standard normal coordinates (`Prior.to_normal`) suit the
        polynomials best.
    effective_sample_size : float, optional
        Effective number of independent draws, for the standard errors. Default: n.

    Returns
    -------
    ValueOfInformation

    Raises
    ------
    ValueError
        If there are fewer than two options or 50 draws, or an array has other draws or is not finite.

    Examples
    --------
    >>> coords = prior.to_normal(samples)
    >>> losses = {"leave": 50.0 * annual_losses, "retrofit": 0.3 + 50.0 * annual_losses_after}
    >>> print(value_of_information(losses, {"Ec": coords[:, :1], "all parameters": coords}))
    """
    names = tuple(losses)
    table = np.stack([_rows(name, losses[name], None)[:, 0] for name in names], axis=1) if names else np.empty((0, 0))
    n = len(table)
    if len(names) < 2 or n < 50:
        raise ValueError(f"expected the losses of two options or more at 50 draws or more; got {len(names)} at {n}")
    effective = float(n if effective_sample_size is None else effective_sample_size)
    if not 1.0 <= effective <= n:
        raise ValueError(f"effective_sample_size must be from 1 to the {n} draws; got {effective_sample_size!r}")
    known = {name: _rows(name, each, n) for name, each in (learned or {}).items()}
    order = np.argsort(table.mean(axis=0), kind="stable")
    best = order[0]
    avoided = table[:, best] - table.min(axis=1)
    values = [_mean_and_error(_avoided(table, best, x), effective) for x in known.values()]
    value, value_error = np.array(values).reshape(-1, 2).T
    return ValueOfInformation(
        names,
        *_mean_and_error(table, effective),
        names[best],
        *map(float, _mean_and_error(table[:, order[1]] - table[:, best], effective)),
        *map(float, _mean_and_error(avoided, effective)),
        tuple(known),
        value,
        value_error,
    )


def simulate_summary(coords: ArrayLike, precision: ArrayLike, seed: int | None = 0) -> np.ndarray:
    """Data that a linear measurement would give at each draw, reduced to what they tell of the parameters.

    Gaussian data y = J x + e with the precision W of e tell as much as the weighted means :math:`(J^T W J)^{-1} J^T W
    y`, in the directions that are measured: the coordinates plus Gaussian errors with the precision J^T W J.

    Parameters
    ----------
    coords : (n, d) array_like
        Draws of the parameters, in the coordinates of `precision`.
    precision : (d, d) array_like
        J^T W J of the measurement, such as ``SensorRanking.precisions`` of one sensor, or the sum over several sensors
        with independent errors, in standard normal coordinates.
    seed : int, optional
        Seed of the errors. The same seed for several measurements makes their comparison more precise.

    Returns
    -------
    (n, r) ndarray
        Coordinates with errors along the r measured eigenvectors of the precision; r = 0 for a sensor that tells
        nothing.

    Raises
    ------
    ValueError
        If the shapes do not fit, or the precision is not finite, symmetric and positive semi-definite.
    """
    x, matrix = np.asarray(coords, dtype=float), np.asarray(precision, dtype=float)
    if x.ndim != 2 or matrix.shape != (x.shape[1],) * 2:
        raise ValueError(
            f"expected coordinates (n, d) and a precision (d, d) of the same d; got {x.shape} and {matrix.shape}"
        )
    if not (np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=1e-6)):
        raise ValueError(f"expected a finite symmetric precision; got {matrix}")
    values, vectors = np.linalg.eigh(matrix)
    if values[0] < -1e-9 * max(values[-1], 0.0):
        raise ValueError(f"expected a positive semi-definite precision; its smallest eigenvalue is {values[0]:g}")
    # a stream of its own: draws of the parameters may come from default_rng(seed)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    errors = rng.standard_normal(x.shape)[:, ::-1]  # the first errors are of the best measured direction
    measured = values > max(SMALLEST_SHARE * values[-1], 0.0)
    return x @ vectors[:, measured] + errors[:, measured] / np.sqrt(values[measured])


def _rows(name: str, values: ArrayLike, n: int | None) -> np.ndarray:
    """Values as a finite array (n, k)."""
    found = np.asarray(values, dtype=float)
    found = found[:, None] if found.ndim == 1 else found
    if found.ndim != 2 or (n is not None and len(found) != n) or (n is None and found.shape[1] != 1):
        shape = "(n,)" if n is None else f"({n},) or ({n}, k)"
        raise ValueError(f"{name}: expected an array {shape}, one row per draw; got shape {np.shape(values)}")
    if not np.isfinite(found).all():
        raise ValueError(f"{name}: expected finite values at every draw; leave out draws whose simulation failed")
    return found


def _mean_and_error(values: np.ndarray, effective: float) -> tuple[np.ndarray, np.ndarray]:
    return values.mean(axis=0), values.std(axis=0) / np.sqrt(effective)


def _avoided(table: np.ndarray, best: int, x: np.ndarray) -> np.ndarray:
    """Loss (n,) that is avoided at each draw by the option that regressions on x (n, k) of other draws choose."""
    n = len(table)
    differences = table - table[:, [best]]
    means = differences.mean(axis=0)  # of all draws: without regression, all parts choose the best option
    part = np.random.default_rng(0).permutation(np.arange(n) % FOLDS)
    scale = x.std(axis=0)
    z = (x - x.mean(axis=0))[:, scale > 0.0] / scale[scale > 0.0]
    expected, least = np.tile(means, (n, 1)), np.square(differences - means).sum(axis=0)
    for degree in DEGREES if z.shape[1] else ():
        if comb(z.shape[1] + degree, degree) * DRAWS_PER_TERM > n:
            break
        terms = _monomials(z, degree)
        predicted = np.empty(differences.shape)
        for k in range(FOLDS):
            here = part == k
            slopes = np.linalg.lstsq(terms[~here], (differences - means)[~here], rcond=None)[0]
            predicted[here] = means + terms[here] @ slopes
        errors = np.square(predicted - differences).sum(axis=0)
        better = errors < least
        expected[:, better], least = predicted[:, better], np.minimum(errors, least)
    choice = expected.argmin(axis=1)
    return table[:, best] - table[np.arange(n), choice]


def _monomials(z: np.ndarray, degree: int) -> np.ndarray:
    """Monomials (n, terms) of columns z (n, k) up to a total degree, without their means."""
    powers = (
        each for order in range(1, degree + 1) for each in combinations_with_replacement(range(z.shape[1]), order)
    )
    terms = np.stack([z[:, list(each)].prod(axis=1) for each in powers], axis=1)
    return terms - terms.mean(axis=0)
