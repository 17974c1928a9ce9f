"""Stiffness loss between two states of a structure, from a calibration before and a calibration after an event.

Each posterior over its prior is taken as a normal likelihood of the logarithms of the stiffnesses, so that the evidence
of each set of damaged ones has a closed form; all sets are enumerated. Equations: ``docs/stiffness_loss.rst``.
"""

import itertools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy import special

from samplers.resampling import systematic

from ..checks.finding import Finding, judge, labelled
from ..checks.population import check_common, check_most
from ..priors.distributions import Distribution, HalfNormal, LogNormal
from ..text_tables import text_table
from .stored_posterior import NormalLikelihood, StoredPosterior, normal_likelihood

__all__ = ["StiffnessLoss", "stiffness_loss"]

_NODES = 8, 12  # of the distributions of the spread and of the factor of the errors


class StiffnessLoss(NamedTuple):
    """Stiffness losses between two states, as draws of their joint posterior; ``str`` gives a table and sentences."""

    names: tuple[str, ...]  # the stiffnesses
    loss: np.ndarray  # (n_draws, n) one minus the ratio of after to before, without the common factor; < 0 for a gain
    common: np.ndarray  # (n_draws,) factor that all stiffnesses share, after to before
    count: np.ndarray  # (n_draws,) number of damaged stiffnesses
    error: np.ndarray  # (n_draws,) factor by which the errors of the calibrations exceed the stated ones
    findings: tuple[Finding, ...]  # what speaks against the result

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

    def __str__(self) -> str:
        columns = self.probability(), self.location(), *np.quantile(self.loss, (0.05, 0.5, 0.95), axis=0)
        rows = [("stiffness", "P(loss > 10 %)", "P(largest, > 10 %)", "loss 5 %", "median", "95 %")]
        for name, sure, first, *quantiles in zip(self.names, *columns, strict=True):
            rows.append((name, f"{sure:.2f}", f"{first:.2f}", *(f"{value:+.1%}" for value in quantiles)))
        low, median, high = np.quantile(self.common, (0.05, 0.5, 0.95))
        said = (
            f"Probability of a loss above 10 % anywhere: {self.presence():.2f}; common factor {median:.3f} ({low:.3f} "
            f"to {high:.3f}); errors of the calibrations as stated times {np.median(self.error):.1f}."
        )
        return "\n".join([text_table(rows), said, *labelled(self.findings)])

    __repr__ = __str__


def stiffness_loss(
    before: StoredPosterior,
    after: StoredPosterior,
    names: Sequence[str],
    *,
    presence: float = 0.5,
    damaged: LogNormal = LogNormal(0.75, 0.25),
    spread: Distribution | float = HalfNormal(0.02),
    common: float = 0.05,
    slopes: Mapping[str, Distribution] = MappingProxyType({}),
    error: Distribution | float = LogNormal(1.5, 0.7),
    most: int = 3,
    n_draws: int = 10_000,
    seed: int = 0,
) -> StiffnessLoss:
    """Probabilities of stiffness losses from the posteriors before and after an event; nothing is simulated.

    Parameters
    ----------
    before, after : StoredPosterior
        Calibrations of the same structure, with priors that are wide enough for both states; they are taken out.
    names : sequence of str
        The stiffnesses, positive parameters of both. Other parameters, such as damping, may differ between the states.
    presence, most : float, int
        Prior probability that any stiffness is damaged, each one equally probable, and their largest number.
    damaged : LogNormal
        Prior of the ratio after / before of a damaged stiffness, without the common factor.
    spread : Distribution or float
        Standard deviation of the logarithm of an undamaged stiffness between the states [-]: its prior, or its value.
    common : float
        Prior standard deviation of the logarithm of the factor that all stiffnesses share.
    slopes : mapping of str to Distribution
        Prior of the change of this logarithm per unit of a covariate of both calibrations (`StoredPosterior`), such as
        ``{"temperature": TruncatedNormal(-0.001, 0.0005, -0.01, 0.0)}`` per degree.
    error : Distribution or float
        Factor by which the errors of the calibrations exceed the stated ones: its prior, or its value (1: as stated).
    n_draws, seed : int
        Number of draws, and their seed. The Monte Carlo error of a probability p is sqrt(p (1 - p) / n_draws).

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
    names, states, d = tuple(names), (before, after), len(names)
    known = all(name in each.covariates for name in slopes for each in states)
    usable = 0.0 < presence < 1.0 and common > 0.0 and most >= 1 and isinstance(damaged, LogNormal)
    if d < 2 or len(set(names)) < d or not (known and usable):
        raise ValueError(
            "stiffness_loss: expected two or more different stiffnesses, presence between 0 and 1, common as a "
            "positive number, most of at least 1, damaged as a LogNormal, and the covariates of slopes "
            f"({', '.join(slopes)}) in both calibrations; got {names}, {presence}, {common}, {most}, {damaged!r}, "
            f"{before.covariates} and {after.covariates}"
        )
    likelihoods = [normal_likelihood(each, names) for each in states]
    moved = [(after.covariates[name] - before.covariates[name], each.moments) for name, each in slopes.items()]
    shift = sum(change * mean for change, (mean, _) in moved)
    likelihoods[1] = likelihoods[1]._replace(peak=likelihoods[1].peak - shift)
    common = float(np.linalg.norm([common, *(change * sd for change, (_, sd) in moved)]))
    members = [each for m in range(min(most, d) + 1) for each in itertools.combinations(range(d), m)]
    members = np.array([(*each, *[d] * (most - len(each))) for each in members])  # d stands for no stiffness
    sizes = (members < d).sum(axis=1)
    log_prior = sizes * np.log((1.0 - presence) ** (-1.0 / d) - 1.0)  # odds of each stiffness, independent
    log_prior += np.log(presence) - np.logaddexp.reduce(log_prior[1:])
    log_prior[0] = np.log(1.0 - presence)
    nodes = [
        _Node(likelihoods, members, factor, scatter**2, common**2, damaged)
        for factor in _quantiles(error, _NODES[1], "error")
        for scatter in _quantiles(spread, _NODES[0], "spread")
    ]
    weights, rng = special.softmax([log_prior + node.log_evidences for node in nodes]), np.random.default_rng(seed)
    of_node, of_set = np.divmod(systematic(weights.ravel(), rng, n_draws), len(members))
    change, count = np.empty((n_draws, d + 1)), sizes[of_set]
    for k in np.unique(of_node):
        change[of_node == k] = nodes[k].draw(members[of_set[of_node == k]], rng)
    common_factor, errors = np.exp(change[:, -1] + shift), np.array([node.error for node in nodes])[of_node]
    findings = [
        each._replace(text=f"In the calibration {when}: {each.text}")
        for when, state in zip(("before", "after"), states, strict=True)
        for each in state.findings
    ]
    findings += check_common(common_factor, float(np.exp(shift)), common) + check_most(count, most, d)
    return StiffnessLoss(names, -np.expm1(change[:, :-1]), common_factor, count, errors, tuple(findings))


class _Node:
    """The change of the logarithms as it was observed, at one factor of the errors and one spread.

    Given the stiffnesses before, the `observed` change is the damage, a scatter, the common factor, of given variances,
    and `errors` of a covariance. `log_evidences` are of the sets (n, m) of damaged stiffnesses.
    """

    def __init__(
        self,
        states: Sequence[NormalLikelihood],
        members: np.ndarray,
        error: float,
        scatter: float,
        common: float,
        damaged: LogNormal,
    ) -> None:
        self.error, self.scatter, self.common, self.damaged = error, scatter, common, damaged
        (before, after), most = states, members.shape[1]
        apart, of_peak = before.peak - before.center, before.prior + error**2 * before.errors
        gain = np.linalg.solve(of_peak, before.prior).T
        self.observed = after.peak - before.center - gain @ apart
        self.errors = before.prior - gain @ before.prior + error**2 * after.errors
        inverse = np.linalg.inv(self.errors + scatter * np.eye(len(apart)) + common)
        pull = inverse @ self.observed
        total = np.linalg.slogdet(inverse)[1] - np.linalg.slogdet(of_peak)[1]
        total -= apart @ np.linalg.solve(of_peak, apart) + self.observed @ pull  # of the two peaks without damage,
        total += 2.0 * (before.unseen + after.unseen) * np.log(error)  # but not of directions that were not seen
        inverse, pull = np.pad(inverse, (0, 1)), np.append(pull, 0.0)
        mean, variance = np.log(damaged.median), damaged.log_sd**2
        precision = inverse[members[:, :, None], members[:, None, :]] + np.eye(most) / variance
        vector = pull[members] + mean / variance
        total += (vector * np.linalg.solve(precision, vector[:, :, None])[:, :, 0]).sum(axis=1)
        total -= most * (np.log(variance) + mean**2 / variance) + np.linalg.slogdet(precision)[1]
        self.log_evidences = 0.5 * total

    def draw(self, members: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Changes (n, d + 1) of the stiffnesses without the common one, and the common one, for sets (n, m)."""
        n, d = len(members), len(self.observed)
        hit = (members[:, :, None] == np.arange(d)).any(axis=1)
        variances = self.scatter + hit * self.damaged.log_sd**2
        own = hit * np.log(self.damaged.median) + np.sqrt(variances) * rng.standard_normal((n, d))
        shared = np.sqrt(self.common) * rng.standard_normal((n, 1))
        errors = rng.standard_normal((n, d)) @ np.linalg.cholesky(self.errors).T
        total = self.errors + self.common + variances[:, :, None] * np.eye(d)
        # draws of the prior and of the errors are moved by what they differ from the observed change
        pull = np.linalg.solve(total, (self.observed - own - shared - errors)[:, :, None])[:, :, 0]
        return np.hstack([own + variances * pull, shared + self.common * pull.sum(axis=1, keepdims=True)])


def _quantiles(value: Distribution | float, n: int, name: str) -> np.ndarray:
    """Quantiles of equal weight of a positive quantity with a distribution, or its known value."""
    nodes = value.ppf((np.arange(n) + 0.5) / n) if isinstance(value, Distribution) else np.array([float(value)])
    if not (np.isfinite(nodes).all() and (nodes > 0.0).all()):
        raise ValueError(f"stiffness_loss: expected {name} as a positive number, or its distribution; got {value!r}")
    return nodes
