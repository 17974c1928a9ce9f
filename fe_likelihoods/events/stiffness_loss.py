r"""Stiffness loss between two states of a structure, from a calibration before and a calibration after an event.

Each posterior over its prior is a likelihood of the logarithms of the stiffnesses, which is taken as normal. The
logarithms change by a factor that all share, a scatter, and the damage of a few stiffnesses. Given the damaged ones,
everything is normal, so that the evidence of each set of them has a closed form; all sets of up to `most` are
enumerated. The equations are on the page ``docs/stiffness_loss.rst``.
"""

import itertools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ..checks.finding import Finding, judge, labelled
from ..checks.transfer import check_most, check_normal
from ..priors.distributions import Distribution, HalfNormal, LogNormal
from ..text_tables import text_table
from .scales import Scales
from .stored_posterior import StoredPosterior, on_scale

__all__ = ["StiffnessLoss", "stiffness_loss"]

_LEAST_INFORMATION = 1.0  # of the data about a direction, relative to the prior, below which it is left to the prior
_FEWEST_SAMPLES = 5  # effective ones per stiffness, for their covariance
_NODES = 8, 12  # of the distributions of the spread and of the factor of the errors
_PRIOR_DRAWS = 20_000  # for the moments of the priors
_NUMBERS = 5_000_000  # of matrices at a time


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
    slopes: Mapping[str, Distribution] = MappingProxyType({}),
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
    slopes : mapping of str to Distribution
        Prior of the change of this logarithm per unit of a covariate that both calibrations state, such as a
        temperature: ``StoredPosterior(..., covariates={"temperature": 2.0})`` and a prior of -0.002 to 0 per degree.
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
        of range, a covariate is missing, or there are fewer than five effective samples per stiffness.

    Examples
    --------
    >>> draw, wide = np.random.default_rng(1).normal, Prior({"k_1": LogNormal(1.0, 0.5), "k_2": LogNormal(1.0, 0.5)})
    >>> before = StoredPosterior(draw([1.0, 1.0], 0.03, size=(500, 2)), wide)
    >>> after = StoredPosterior(draw([0.7, 1.0], 0.03, size=(500, 2)), wide)
    >>> found = stiffness_loss(before, after, ["k_1", "k_2"])
    >>> found.probability(0.1).round(1)  # of a loss of 10 % or more, in each storey
    array([0.9, 0. ])
    """
    names, d = tuple(names), len(tuple(names))
    for good, text in (
        (d > 1 and len(set(names)) == d, f"the names of two or more different stiffnesses; got {names}"),
        (0.0 < presence < 1.0, f"presence between 0 and 1; got {presence}"),
        (isinstance(damaged, LogNormal), f"damaged as a LogNormal distribution of the ratio; got {damaged!r}"),
        (0.0 < common < np.inf, f"common as a positive standard deviation; got {common}"),
        (isinstance(most, int) and most >= 1, f"most of at least 1; got {most}"),
        (isinstance(n_draws, int) and n_draws >= 100, f"n_draws of at least 100; got {n_draws}"),
        (
            all(name in state.covariates for name in slopes for state in (before, after)),
            f"the covariates {', '.join(slopes)} in both calibrations; got {before.covariates} and {after.covariates}",
        ),
    ):
        if not good:
            raise ValueError(f"stiffness_loss: expected {text}")
    first, second = states = [_state(stored, names) for stored in (before, after)]
    warmer = {name: after.covariates[name] - before.covariates[name] for name in slopes}
    shift = sum(warmer[name] * each.moments[0] for name, each in slopes.items())
    second = second._replace(peak=second.peak - shift)
    common = float(np.hypot(common, np.linalg.norm([warmer[name] * each.moments[1] for name, each in slopes.items()])))
    sets = [np.array([*itertools.combinations(range(d), m)], dtype=int) for m in range(min(most, d) + 1)]
    damage = np.concatenate([(each[:, :, None] == np.arange(d)).any(axis=1) for each in sets])
    share = 1.0 - (1.0 - presence) ** (1.0 / d)  # of each stiffness, independent
    log_prior = damage.sum(axis=1) * np.log(share / (1.0 - share))
    log_prior += np.log(presence) - np.logaddexp.reduce(log_prior[1:])
    log_prior[0] = np.log(1.0 - presence)
    nodes = [
        _Node(*_change(first, second, factor), scatter, common, damaged, factor)
        for factor in _nodes(error, _NODES[1], "error")
        for scatter in _nodes(spread, _NODES[0], "spread")
    ]
    evidence = np.array([log_prior + node.log_evidences(sets) for node in nodes])
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(np.exp(evidence - evidence.max()))
    chosen = np.searchsorted(cumulative / cumulative[-1], (np.arange(n_draws) + rng.random()) / n_draws)
    of_node, of_set = np.unravel_index(np.minimum(chosen, evidence.size - 1), evidence.shape)
    damage, change = damage[of_set], np.empty((n_draws, d + 1))
    for k in np.unique(of_node):
        rows = np.flatnonzero(of_node == k)
        for part in np.array_split(rows, 1 + len(rows) * (d + 1) ** 2 // _NUMBERS):
            change[part] = nodes[k].draw(damage[part], rng)
    findings = [
        each._replace(text=f"In the calibration {when}: {each.text}")
        for when, state in zip(("before", "after"), states, strict=True)
        for each in state.findings
    ]
    count, factors = damage.sum(axis=1), np.array([node.error for node in nodes])[of_node]
    findings += check_most(count, most, d)
    common_factor = np.exp(change[:, -1] + shift)
    return StiffnessLoss(names, -np.expm1(change[:, :-1]), common_factor, count, factors, tuple(findings))


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
    prior, points = on_scale(stored, names, Scales(np.ones(len(names), dtype=bool)))
    weights, n, d = np.exp(stored.log_weights), stored.effective_sample_size, len(names)
    mean = weights @ points
    apart = points - mean
    covariance = (weights * apart.T) @ apart
    if constant := [name for name, each in zip(names, np.diag(covariance), strict=True) if not each > 0.0]:
        raise ValueError(f"stiffness_loss: all samples have the same value of {', '.join(constant)}")
    if n < (fewest := _FEWEST_SAMPLES * d):
        raise ValueError(f"stiffness_loss: {d} stiffnesses need at least {fewest} effective samples; got {n:.0f}")
    covariance *= (n - 1.0) / (n - d - 2.0)  # so that its inverse is right on average
    z = np.random.default_rng(0).standard_normal((_PRIOR_DRAWS, prior.dim))
    z -= z.mean(axis=0)
    logs = np.log(prior.from_normal(np.linalg.solve(np.linalg.cholesky(z.T @ z / len(z)), z.T).T))
    center, prior_covariance = logs.mean(axis=0), np.cov(logs.T, bias=True)  # exact for lognormal priors
    factor = np.linalg.cholesky(prior_covariance)
    whitened = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T)
    variances, directions = np.linalg.eigh(_symmetric(whitened))
    precisions = 1.0 / np.maximum(variances, np.finfo(float).tiny)
    seen = precisions - 1.0 > _LEAST_INFORMATION
    gained = precisions[seen] - 1.0
    offset = directions[:, seen].T @ np.linalg.solve(factor, mean - center)
    peak = center + factor @ directions[:, seen] @ (offset * precisions[seen] / gained)
    back = np.linalg.solve(factor.T, directions[:, seen])
    scores = np.column_stack([apart, apart @ back])
    scores /= np.sqrt(weights @ np.square(scores))
    normal = check_normal(weights @ scores**3, weights @ scores**4 - 3.0)
    findings = (*stored.findings, *normal)
    return _State(peak, back * gained @ back.T, int(seen.sum()), center, prior_covariance, findings)


class _Node(NamedTuple):
    """Likelihood exp(evidence + vector' T - T' matrix T / 2) of the change T (d,), and the parts of the change."""

    matrix: np.ndarray
    vector: np.ndarray
    evidence: float
    scatter: float
    common: float
    damaged: LogNormal
    error: float

    def log_evidences(self, sets: list[np.ndarray]) -> np.ndarray:
        """Of all sets of damaged stiffnesses; scatter and common factor are integrated out."""
        d, mean, variance = len(self.vector), np.log(self.damaged.median), self.damaged.log_sd**2
        both = np.eye(d) + self.matrix @ (other := self.scatter**2 * np.eye(d) + self.common**2)
        vector = np.linalg.solve(both, self.vector)
        matrix = _symmetric(np.linalg.solve(both, self.matrix))
        none = self.evidence + 0.5 * self.vector @ other @ vector - 0.5 * np.linalg.slogdet(both)[1]
        found = []
        for members in sets:
            m = members.shape[1]
            for part in np.array_split(members, 1 + members.size * m // _NUMBERS):
                precision = matrix[part[:, :, None], part[:, None, :]] + np.eye(m) / variance
                of_part = vector[part] + mean / variance
                gain = (of_part * np.linalg.solve(precision, of_part[:, :, None])[:, :, 0]).sum(axis=1)
                found.append(none + 0.5 * (gain - np.linalg.slogdet(precision)[1]))
                found[-1] -= 0.5 * m * (np.log(variance) + mean**2 / variance)
        return np.concatenate(found)

    def draw(self, damage: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Changes (n, d + 1) of the stiffnesses without the common one, and the common one; damage where (n, d)."""
        n, d = damage.shape
        parts = np.column_stack([np.eye(d), np.ones(d)])
        mean = np.column_stack([np.log(self.damaged.median) * damage, np.zeros(n)])
        own = self.scatter**2 + self.damaged.log_sd**2 * damage
        weights = 1.0 / np.column_stack([own, np.full(n, self.common**2)])
        precision = parts.T @ self.matrix @ parts + weights[:, :, None] * np.eye(d + 1)
        vector = self.vector @ parts + weights * mean
        noise = np.linalg.cholesky(precision) @ rng.standard_normal((n, d + 1, 1))  # its covariance is the precision
        return np.linalg.solve(precision, vector[:, :, None] + noise)[:, :, 0]


def _change(before: _State, after: _State, factor: float) -> tuple[np.ndarray, np.ndarray, float]:
    """Matrix, vector and log-evidence of a node: the stiffnesses before are integrated out."""
    first, second = before.information / factor**2, after.information / factor**2
    peak, later = before.peak - before.center, after.peak - before.center
    precision = np.linalg.inv(before.covariance) + first
    covariance = np.linalg.inv(precision)
    mean = covariance @ (first @ peak)
    # x_before ~ N(mean, covariance), and the likelihood after of x_before + T
    spread = np.eye(len(mean)) + second @ covariance
    matrix = _symmetric(np.linalg.solve(spread, second))
    vector = matrix @ (later - mean)
    of_before = mean @ precision @ mean - peak @ first @ peak - np.linalg.slogdet(precision)[1]
    of_after = -np.linalg.slogdet(spread)[1] - (later - mean) @ vector
    # densities of the peaks, whose errors grow with the factor
    return matrix, vector, 0.5 * (of_before + of_after) - (before.seen + after.seen) * np.log(factor)


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
