r"""Stiffness loss between two states of a structure, from a calibration before and a calibration after an event.

Each calibration gives a posterior of the same stiffnesses. On the scale of logarithms :math:`x`, each posterior over
its prior is a likelihood, which is taken as normal. The stiffnesses of both states belong together,

.. math::

   x_i^{\mathrm{after}} = x_i^{\mathrm{before}} + g + e_i + \delta_i, \qquad
   g \sim N(0, \gamma^2), \quad e_i \sim N(0, \sigma^2),

with a factor g that all stiffnesses share (temperature, mass), a scatter e that has nothing to do with damage, and
:math:`\delta_i`, which is zero for an intact stiffness and normal for a damaged one. Given the damaged stiffnesses,
everything is normal, so the evidence of each set of damaged stiffnesses has a closed form. All sets of up to `most`
stiffnesses are enumerated, and nothing is simulated. The *loss* of a stiffness is
:math:`1 - \exp(e_i + \delta_i)`; the common factor is no loss.

Calibrations with a wrong model state errors that are too small. Both likelihoods therefore have errors that are f times
as large as stated, with an unknown factor f, about which the differences of the many intact stiffnesses inform. See
``docs/stiffness_loss.rst``.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..checks.finding import Finding, judge, labelled
from ..checks.stiffness import check_most, check_normal
from ..priors.distributions import Distribution, HalfNormal, LogNormal
from ..priors.priors import Prior
from ..text_tables import text_table
from .scales import scales_of
from .stored_posterior import StoredPosterior, on_scale

__all__ = ["StiffnessLoss", "stiffness_loss"]

_LEAST_INFORMATION = 1.0  # of the data about a direction, relative to the prior, below which it is left to the prior
_FEWEST_SAMPLES = 5  # effective ones per stiffness, for their covariance
_NODES = 8, 12  # of the distributions of the spread and of the factor of the errors
_PRIOR_DRAWS = 20_000  # for the moments of a joint prior
_BATCH = 50_000  # sets of damaged stiffnesses at a time


class StiffnessLoss(NamedTuple):
    """Stiffness losses between two states, as draws of their joint posterior; ``str`` gives a table and sentences.

    Attributes
    ----------
    names : tuple of str
        The stiffnesses.
    loss : ndarray[n_draws, n]
        Losses [-]: one minus the ratio of after to before, without the common factor. Negative for a gain.
    common : ndarray[n_draws]
        Factor that all stiffnesses share [-], after to before.
    count : ndarray[n_draws]
        Number of damaged stiffnesses.
    error : ndarray[n_draws]
        Factor by which the errors of the calibrations exceed the stated ones [-].
    findings : tuple of Finding
        What speaks against the result; empty if nothing was found.
    """

    names: tuple[str, ...]
    loss: np.ndarray
    common: np.ndarray
    count: np.ndarray
    error: np.ndarray
    findings: tuple[Finding, ...]

    @property
    def status(self) -> str:
        """ "use", "use with care" or "do not use", by the most severe finding."""
        return judge(self.findings).status

    def probability(self, limit: float = 0.1) -> np.ndarray:
        """Probability (n,) of each stiffness that its loss exceeds a limit."""
        return (self.loss > limit).mean(axis=0)

    def presence(self, limit: float = 0.1) -> float:
        """Probability that at least one loss exceeds a limit."""
        return float((self.loss > limit).any(axis=1).mean())

    def location(self, limit: float = 0.1) -> np.ndarray:
        """Probability (n,) of each stiffness to have the largest loss, above a limit; their sum is the presence."""
        largest = self.loss.argmax(axis=1)[self.loss.max(axis=1) > limit]
        return np.bincount(largest, minlength=len(self.names)) / len(self.loss)

    def extent(self, probabilities: Sequence[float] = (0.05, 0.5, 0.95)) -> np.ndarray:
        """Quantiles (n_probabilities, n) of the losses [-]."""
        return np.quantile(self.loss, probabilities, axis=0)

    def __str__(self) -> str:
        columns = self.probability(), self.location(), *self.extent()
        rows = [("stiffness", "P(loss > 10 %)", "P(largest, > 10 %)", "loss 5 %", "median", "95 %")]
        for name, sure, first, *quantiles in zip(self.names, *columns, strict=True):
            rows.append((name, f"{sure:.2f}", f"{first:.2f}", *(f"{value:+.1%}" for value in quantiles)))
        low, median, high = np.quantile(self.common, (0.05, 0.5, 0.95))
        lines = [
            text_table(rows),
            f"Probability of a loss above 10 % anywhere: {self.presence():.2f}; common factor {median:.3f} ({low:.3f} "
            f"to {high:.3f}); errors of the calibrations as stated times {np.median(self.error):.1f}.",
        ]
        return "\n".join([*lines, *labelled(self.findings)])

    __repr__ = __str__


def stiffness_loss(
    before: StoredPosterior,
    after: StoredPosterior,
    names: Sequence[str],
    *,
    presence: float = 0.5,
    damaged: LogNormal = LogNormal(0.75, 0.25),  # noqa: B008 - frozen
    spread: Distribution | float = HalfNormal(0.02),  # noqa: B008
    common: float = 0.05,
    error: Distribution | float = LogNormal(1.5, 0.7),  # noqa: B008
    most: int = 3,
    n_draws: int = 10_000,
    seed: int = 0,
) -> StiffnessLoss:
    """Probabilities of stiffness losses from the posteriors before and after an event; nothing is simulated.

    Parameters
    ----------
    before, after : StoredPosterior
        Calibrations of the same structure with data from before and after the event (`StoredPosterior.from_run`). Their
        priors must be wide enough for both states; they are taken out.
    names : sequence of str
        The stiffnesses, positive parameters of both. Other parameters, such as damping, may differ between the states.
    presence : float
        Prior probability that any stiffness is damaged, between 0 and 1. Each one is equally probable.
    damaged : LogNormal
        Prior of the ratio after / before of a damaged stiffness, without the common factor.
    spread : Distribution or float
        Standard deviation of the logarithm of an undamaged stiffness between the states [-], without the common factor:
        its prior, or a known value.
    common : float
        Prior standard deviation of the logarithm of the factor that all stiffnesses share.
    error : Distribution or float
        Factor by which the errors of both calibrations exceed the stated ones: its prior, or a known value. 1 where the
        model is right.
    most : int
        Largest number of damaged stiffnesses.
    n_draws : int
        Number of draws of the result. The Monte Carlo error of a probability p is sqrt(p (1 - p) / n_draws).
    seed : int
        Seed of the draws.

    Returns
    -------
    StiffnessLoss
        With the findings of both calibrations.

    Raises
    ------
    ValueError
        If a stiffness is unknown, not positive or constant, has a joint prior with other parameters, an argument is out
        of range, or there are fewer than five effective samples per stiffness.

    Examples
    --------
    >>> draw, wide = np.random.default_rng(1).normal, Prior({"k_1": LogNormal(1.0, 0.5), "k_2": LogNormal(1.0, 0.5)})
    >>> before = StoredPosterior(draw([1.0, 1.0], 0.03, size=(500, 2)), wide)
    >>> after = StoredPosterior(draw([0.7, 1.0], 0.03, size=(500, 2)), wide)
    >>> found = stiffness_loss(before, after, ["k_1", "k_2"])
    >>> found.probability(0.1).round(1)  # of a loss of 10 % or more, in each storey
    array([0.9, 0. ])
    """
    names = tuple(names)
    _check(names, presence, damaged, common, most, n_draws)
    states = [_state(stored, names) for stored in (before, after)]
    sets = _sets(len(names), min(most, len(names)), presence)
    nodes = [
        _node(*states, factor, scatter, common)
        for factor in _nodes(error, _NODES[1], "error")
        for scatter in _nodes(spread, _NODES[0], "spread")
    ]
    evidence = np.array([each.log_evidence + _log_evidence_of_sets(each, sets, damaged) for each in nodes])
    weights = np.exp(evidence - evidence.max())
    drawn = _draw(nodes, sets, weights / weights.sum(), damaged, common, n_draws, np.random.default_rng(seed))
    findings = [
        each._replace(text=f"In the calibration {when}: {each.text}")
        for when, state in zip(("before", "after"), states, strict=True)
        for each in state.findings
    ]
    return StiffnessLoss(names, *drawn, (*findings, *check_most(drawn[2], most, len(names))))


class _State(NamedTuple):
    """Likelihood of one state, exp(-(x - peak)' information (x - peak) / 2), of the logarithms x (d,), and its prior.

    `seen` is the number of directions about which the data say more than the prior; the likelihood is flat in others.
    """

    peak: np.ndarray
    information: np.ndarray
    seen: int
    center: np.ndarray
    covariance: np.ndarray
    findings: tuple[Finding, ...]


def _state(stored: StoredPosterior, names: tuple[str, ...]) -> _State:
    prior, points = on_scale(stored, names, scales_of(["log"] * len(names)))
    weights, n, d = np.exp(stored.log_weights), stored.effective_sample_size, len(names)
    mean = weights @ points
    apart = points - mean
    covariance = (weights * apart.T) @ apart
    if constant := [name for name, each in zip(names, np.diag(covariance), strict=True) if not each > 0.0]:
        raise ValueError(f"stiffness_loss: all samples have the same value of {', '.join(constant)}")
    if n < (fewest := _FEWEST_SAMPLES * d):
        raise ValueError(f"stiffness_loss: {d} stiffnesses need at least {fewest} effective samples; got {n:.0f}")
    covariance *= (n - 1.0) / (n - d - 2.0)  # so that its inverse is right on average
    center, prior_covariance = _prior_moments(prior)
    factor = np.linalg.cholesky(prior_covariance)
    whitened = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T)
    variances, directions = np.linalg.eigh(0.5 * (whitened + whitened.T))
    precisions = 1.0 / np.maximum(variances, np.finfo(float).tiny)
    gained = np.where(precisions - 1.0 > _LEAST_INFORMATION, precisions - 1.0, 0.0)
    seen = gained > 0.0
    offset = directions.T @ np.linalg.solve(factor, mean - center)
    peak = center + factor @ directions @ np.where(seen, offset * precisions / np.where(seen, gained, 1.0), 0.0)
    back = np.linalg.solve(factor.T, directions)
    scores = np.column_stack([apart, apart @ back[:, seen]])
    scores /= np.sqrt(weights @ np.square(scores))
    normal = check_normal(weights @ scores**3, weights @ scores**4 - 3.0)
    findings = (*stored.findings, *normal)
    return _State(peak, back * gained @ back.T, int(seen.sum()), center, prior_covariance, findings)


def _prior_moments(prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Mean (d,) and covariance (d, d) of the logarithms under a prior."""
    if set(prior.distributions) == set(prior.names):  # independent
        z, weights = np.polynomial.hermite_e.hermegauss(40)
        weights = weights / weights.sum()
        logs = np.log(prior.from_normal(np.repeat(z[:, None], prior.dim, axis=1)))
        center = weights @ logs
        return center, np.diag(weights @ np.square(logs - center))
    logs = np.log(prior.rvs(_PRIOR_DRAWS, random_state=0))
    return logs.mean(axis=0), np.cov(logs.T)


class _Node(NamedTuple):
    """Likelihood exp(log_evidence + vector' T - T' matrix T / 2) of the change T (d,) of the damaged stiffnesses.

    The scatter and the common factor are integrated out; `covariance` is their posterior covariance if T = 0, and
    `alone` has the matrix and the vector without them.
    """

    matrix: np.ndarray
    vector: np.ndarray
    log_evidence: float
    covariance: np.ndarray
    alone: tuple[np.ndarray, np.ndarray]
    error: float
    scatter: float


def _node(before: _State, after: _State, factor: float, scatter: float, common: float) -> _Node:
    """The likelihood with a factor of the errors and a scatter, the stiffnesses before integrated out."""
    center, d = before.center, len(before.center)
    first, second = before.information / factor**2, after.information / factor**2
    peak, later = before.peak - center, after.peak - center
    precision = np.linalg.inv(before.covariance) + first
    covariance = np.linalg.inv(precision)
    mean = covariance @ (first @ peak)
    # x_before ~ N(mean, covariance), and the likelihood after of x_before + T
    spread = np.eye(d) + second @ covariance
    matrix = _symmetric(np.linalg.solve(spread, second))
    vector = matrix @ (later - mean)
    of_before = mean @ precision @ mean - peak @ first @ peak - np.linalg.slogdet(precision)[1]
    of_after = -np.linalg.slogdet(spread)[1] - (later - mean) @ vector
    # densities of the peaks, whose errors grow with the factor
    log_evidence = 0.5 * (of_before + of_after) - (before.seen + after.seen) * np.log(factor)
    variance = scatter**2 * np.eye(d) + common**2
    both = np.eye(d) + matrix @ variance
    damaged = np.linalg.solve(both, vector)
    log_evidence += 0.5 * vector @ variance @ damaged - 0.5 * np.linalg.slogdet(both)[1]
    of_scatter = _symmetric(variance @ np.linalg.inv(both))
    of_damage = _symmetric(np.linalg.solve(both, matrix))
    return _Node(of_damage, damaged, float(log_evidence), of_scatter, (matrix, vector), factor, scatter)


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


def _nodes(value: Distribution | float, n: int, name: str) -> np.ndarray:
    """Quantiles of equal weight of a positive quantity with a distribution, or its known value."""
    nodes = value.ppf((np.arange(n) + 0.5) / n) if isinstance(value, Distribution) else np.array([float(value)])
    if not (np.isfinite(nodes).all() and (nodes > 0.0).all()):
        raise ValueError(
            f"stiffness_loss: expected {name} as a positive number, or a distribution of one; got {value!r}"
        )
    return nodes


class _Sets(NamedTuple):
    """Sets of m stiffnesses (n, m) for each m, and the logarithms (n,) of their prior probabilities."""

    members: list[np.ndarray]
    log_prior: list[np.ndarray]


def _sets(d: int, most: int, presence: float) -> _Sets:
    members = [
        np.array(list(itertools.combinations(range(d), m)), dtype=int).reshape(math.comb(d, m), m)
        for m in range(most + 1)
    ]
    share = 1.0 - (1.0 - presence) ** (1.0 / d)  # of each stiffness, independent
    odds = [m * np.log(share / (1.0 - share)) for m in range(1, most + 1)]
    total = np.log(sum(len(each) * np.exp(odd) for each, odd in zip(members[1:], odds, strict=True)))
    logs = [np.log(1.0 - presence), *(np.log(presence) + odd - total for odd in odds)]
    return _Sets(members, [np.full(len(each), log) for each, log in zip(members, logs, strict=True)])


def _given_sets(change: _Node, members: np.ndarray, damaged: LogNormal) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Precision (n, m, m), mean (n, m) and log-evidence (n,) of the damage of sets (n, m), relative to no damage."""
    m = members.shape[1]
    mean, variance = np.log(damaged.median), damaged.log_sd**2
    precision = change.matrix[members[:, :, None], members[:, None, :]] + np.eye(m) / variance
    vector = change.vector[members] + mean / variance
    found = np.linalg.solve(precision, vector[:, :, None])[:, :, 0]
    log_evidence = 0.5 * (vector * found).sum(axis=1) - 0.5 * np.linalg.slogdet(precision)[1]
    return precision, found, log_evidence - 0.5 * m * (np.log(variance) + mean**2 / variance)


def _log_evidence_of_sets(change: _Node, sets: _Sets, damaged: LogNormal) -> np.ndarray:
    """Logarithms (n_sets,) of prior times evidence of all sets, in order."""
    found = [sets.log_prior[0]]
    for members, log_prior in zip(sets.members[1:], sets.log_prior[1:], strict=True):
        parts = [members[k : k + _BATCH] for k in range(0, len(members), _BATCH)]
        found.append(log_prior + np.concatenate([_given_sets(change, part, damaged)[2] for part in parts]))
    return np.concatenate(found)


def _draw(
    nodes: list[_Node],
    sets: _Sets,
    weights: np.ndarray,
    damaged: LogNormal,
    common: float,
    n: int,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Losses (n, d), common factors, numbers of damaged stiffnesses and factors of the errors (n,)."""
    cumulative = np.cumsum(weights.ravel())
    chosen = np.searchsorted(cumulative / cumulative[-1], (np.arange(n) + rng.random()) / n)
    node, number = np.unravel_index(np.minimum(chosen, weights.size - 1), weights.shape)
    d = len(nodes[0].vector)
    damage, change, factors = np.zeros((n, d)), np.empty((n, d)), np.empty(n)
    count = np.empty(n, dtype=int)
    for k in np.unique(node):
        for rows, members in _rows_by_size(np.flatnonzero(node == k), number, sets):
            count[rows] = members.shape[1]
            if members.shape[1]:
                precision, mean, _ = _given_sets(nodes[k], members, damaged)
                upper = np.linalg.cholesky(precision).transpose(0, 2, 1)
                noise = np.linalg.solve(upper, rng.standard_normal((*mean.shape, 1)))[:, :, 0]
                damage[rows[:, None], members] = mean + noise
        rows = np.flatnonzero(node == k)
        each, factor = nodes[k], np.linalg.cholesky(nodes[k].covariance)
        pull = each.alone[1] - damage[rows] @ each.alone[0]
        other = pull @ each.covariance + rng.standard_normal((len(rows), d)) @ factor.T
        precision = 1.0 / common**2 + d / each.scatter**2
        shared = other.sum(axis=1) / each.scatter**2 / precision + rng.standard_normal(len(rows)) / np.sqrt(precision)
        factors[rows], change[rows] = np.exp(shared), damage[rows] + other - shared[:, None]
    return -np.expm1(change), factors, count, np.array([nodes[k].error for k in node])


def _rows_by_size(rows: np.ndarray, number: np.ndarray, sets: _Sets) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Draws (n,) whose sets have the same size, and their sets (n, m)."""
    ends = np.cumsum([len(each) for each in sets.members])
    size = np.searchsorted(ends, number[rows], side="right")
    for m in np.unique(size):
        same = rows[size == m]
        yield same, sets.members[m][number[same] - (ends[m - 1] if m else 0)]


def _check(names: tuple[str, ...], presence: float, damaged: LogNormal, common: float, most: int, n: int) -> None:
    if len(names) < 2 or len(set(names)) != len(names):
        raise ValueError(f"stiffness_loss: expected the names of two or more different stiffnesses; got {names}")
    if not 0.0 < presence < 1.0:
        raise ValueError(f"stiffness_loss: presence must be a probability between 0 and 1; got {presence}")
    if not isinstance(damaged, LogNormal):
        raise ValueError(f"stiffness_loss: damaged must be a LogNormal distribution of the ratio; got {damaged!r}")
    if not 0.0 < common < np.inf:
        raise ValueError(f"stiffness_loss: common must be a positive standard deviation; got {common}")
    if not (isinstance(most, int) and most >= 1 and isinstance(n, int) and n >= 100):
        raise ValueError(f"stiffness_loss: expected most of at least 1 and n_draws of at least 100; got {most}, {n}")
