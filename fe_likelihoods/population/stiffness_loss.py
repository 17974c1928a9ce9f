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
from ..checks.transfer import check_common, check_most
from ..priors.distributions import Distribution, HalfNormal, LogNormal
from ..text_tables import text_table
from .scales import Scales
from .stored_posterior import StoredPosterior, on_scale

__all__ = ["StiffnessLoss", "stiffness_loss"]

_LEAST_INFORMATION = 1.0  # of the data about a direction, relative to the prior, below which it is left to the prior
_UNSEEN = 1e-6  # information about such a direction
_FEWEST_SAMPLES = 5  # effective ones per stiffness, for their covariance
_NODES = 8, 12  # of the distributions of the spread and of the factor of the errors
_PRIOR_DRAWS = 20_000  # for the moments of the priors


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

    def extent(self, probabilities: Sequence[float] = (0.05, 0.5, 0.95)) -> np.ndarray:
        """Quantiles (n_probabilities, n) of the losses [-]."""
        return np.quantile(self.loss, probabilities, axis=0)

    def __str__(self) -> str:
        columns = self.probability(), self.location(), *self.extent()
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
        Calibrations of the same structure (`StoredPosterior.from_run`). Their priors must be wide enough for both
        states; they are taken out.
    names : sequence of str
        The stiffnesses, positive parameters of both. Other parameters, such as damping, may differ between the states.
    presence, most : float, int
        Prior probability that any stiffness is damaged, each one equally probable, and their largest number.
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
    if d < 2 or len(set(names)) < d or not all(name in each.covariates for name in slopes for each in states):
        raise ValueError(
            f"stiffness_loss: expected two or more different stiffnesses, and the covariates of slopes "
            f"({', '.join(slopes)}) in both calibrations; got {names}, {before.covariates} and {after.covariates}"
        )
    if not (0.0 < presence < 1.0 and common > 0.0 and most >= 1 and isinstance(damaged, LogNormal)):
        raise ValueError(
            "stiffness_loss: expected presence between 0 and 1, common as a positive number, most of at least 1 and "
            f"damaged as a LogNormal; got {presence}, {common}, {most} and {damaged!r}"
        )
    first, second = (_state(each, names) for each in states)
    moved = [(after.covariates[name] - before.covariates[name], each.moments) for name, each in slopes.items()]
    shift = sum(change * mean for change, (mean, _) in moved)
    common = float(np.linalg.norm([common, *(change * sd for change, (_, sd) in moved)]))
    second = second._replace(peak=second.peak - shift)
    sets = [each for m in range(min(most, d) + 1) for each in itertools.combinations(range(d), m)]
    members = np.array([(*each, *[d] * (most - len(each))) for each in sets])  # d stands for no stiffness
    sizes = (members < d).sum(axis=1)
    share = 1.0 - (1.0 - presence) ** (1.0 / d)  # of each stiffness, independent
    log_prior = sizes * np.log(share / (1.0 - share))
    log_prior += np.log(presence) - np.logaddexp.reduce(log_prior[1:])
    log_prior[0] = np.log(1.0 - presence)
    nodes = [
        _Node(first, second, factor, scatter**2, common**2, damaged)
        for factor in _quantiles(error, _NODES[1], "error")
        for scatter in _quantiles(spread, _NODES[0], "spread")
    ]
    evidence = np.array([log_prior + node.log_evidences(members) for node in nodes])
    rng = np.random.default_rng(seed)
    cumulative = np.cumsum(np.exp(evidence - evidence.max()))
    chosen = np.searchsorted(cumulative / cumulative[-1], (np.arange(n_draws) + rng.random()) / n_draws)
    of_node, of_set = np.unravel_index(np.minimum(chosen, evidence.size - 1), evidence.shape)
    change, count = np.empty((n_draws, d + 1)), sizes[of_set]
    for k in sorted(set(of_node.tolist())):
        rows = np.flatnonzero(of_node == k)
        change[rows] = nodes[k].draw(members[of_set[rows]], rng)
    findings = [
        each._replace(text=f"In the calibration {when}: {each.text}")
        for when, state in (("before", first), ("after", second))
        for each in state.findings
    ]
    factors, common_factor = np.array([node.error for node in nodes])[of_node], np.exp(change[:, -1] + shift)
    findings += check_common(common_factor, float(np.exp(shift)), common) + check_most(count, most, d)
    return StiffnessLoss(names, -np.expm1(change[:, :-1]), common_factor, count, factors, tuple(findings))


class _State(NamedTuple):
    """Likelihood of one state, normal in the logarithms x (d,) of the stiffnesses, and their prior.

    The data say more than the prior about all directions but some `unseen` ones, whose errors are a thousand times the
    deviations of the prior.
    """

    peak: np.ndarray
    errors: np.ndarray  # covariance (d, d) of the peak
    unseen: int
    center: np.ndarray
    prior: np.ndarray  # covariance (d, d)
    findings: tuple[Finding, ...]


def _state(stored: StoredPosterior, names: tuple[str, ...]) -> _State:
    prior, points = on_scale(stored, names, Scales(np.ones(len(names), dtype=bool)))
    weights, n, d = np.exp(stored.log_weights), stored.effective_sample_size, len(names)
    mean = weights @ points
    apart = points - mean
    covariance = (weights * apart.T) @ apart
    if n < (fewest := _FEWEST_SAMPLES * d) or not (np.diag(covariance) > 0.0).all():
        raise ValueError(
            f"stiffness_loss: {d} stiffnesses need at least {fewest} effective samples; got {n:.0f}, with the standard "
            f"deviations {np.sqrt(np.diag(covariance)).tolist()} of the logarithms"
        )
    covariance *= (n - 1.0) / (n - d - 2.0)  # so that its inverse is right on average
    z = np.random.default_rng(0).standard_normal((_PRIOR_DRAWS, prior.dim))
    z -= z.mean(axis=0)
    logs = np.log(prior.from_normal(np.linalg.solve(np.linalg.cholesky(z.T @ z / len(z)), z.T).T))
    center, prior_covariance = logs.mean(axis=0), np.cov(logs.T, bias=True)  # exact for lognormal priors
    factor = np.linalg.cholesky(prior_covariance)
    whitened = np.linalg.solve(factor, np.linalg.solve(factor, covariance).T)
    variances, directions = np.linalg.eigh(_symmetric(whitened))
    information = 1.0 / np.maximum(variances, np.finfo(float).tiny) - 1.0  # of the data, relative to the prior
    seen = information > _LEAST_INFORMATION
    information = np.where(seen, information, _UNSEEN)
    offset = directions.T @ np.linalg.solve(factor, mean - center) * seen
    axes = factor @ directions
    peak, errors = center + axes @ (offset * (1.0 + 1.0 / information)), axes / information @ axes.T
    return _State(peak, errors, int((~seen).sum()), center, prior_covariance, tuple(stored.findings))


class _Node:
    """The change of the logarithms as it was observed, at one factor of the errors and one spread.

    Given the stiffnesses before, the `observed` change is the damage, a scatter, the common factor, of given variances,
    and `errors` of a covariance; `total` is the covariance of all but the damage.
    """

    def __init__(
        self, before: _State, after: _State, error: float, scatter: float, common: float, damaged: LogNormal
    ) -> None:
        self.error, self.scatter, self.common, self.damaged = error, scatter, common, damaged
        apart, of_peak = before.peak - before.center, before.prior + error**2 * before.errors
        gain = np.linalg.solve(of_peak, before.prior).T
        self.observed = after.peak - before.center - gain @ apart
        self.errors = _symmetric(before.prior - gain @ before.prior + error**2 * after.errors)
        self.total = self.errors + scatter * np.eye(len(apart)) + common
        self.inverse = np.linalg.inv(self.total)
        squares = apart @ np.linalg.solve(of_peak, apart) + self.observed @ self.inverse @ self.observed
        logs = np.linalg.slogdet(of_peak)[1] + np.linalg.slogdet(self.total)[1]
        # of the two peaks, but not of directions that were not seen
        self.evidence = (before.unseen + after.unseen) * np.log(error) - 0.5 * (squares + logs)

    def log_evidences(self, members: np.ndarray) -> np.ndarray:
        """Of sets (n, m) of damaged stiffnesses."""
        mean, variance, most = np.log(self.damaged.median), self.damaged.log_sd**2, members.shape[1]
        inverse, pull = np.pad(self.inverse, (0, 1)), np.append(self.inverse @ self.observed, 0.0)
        precision = inverse[members[:, :, None], members[:, None, :]] + np.eye(most) / variance
        vector = pull[members] + mean / variance
        gain = (vector * np.linalg.solve(precision, vector[:, :, None])[:, :, 0]).sum(axis=1)
        gain -= most * (np.log(variance) + mean**2 / variance) + np.linalg.slogdet(precision)[1]
        return self.evidence + 0.5 * gain

    def draw(self, members: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Changes (n, d + 1) of the stiffnesses without the common one, and the common one, for sets (n, m).

        Draws of the prior and of the errors are moved by what they differ from the observed change.
        """
        n, d = len(members), len(self.observed)
        hit = (members[:, :, None] == np.arange(d)).any(axis=1)
        variances = self.scatter + hit * self.damaged.log_sd**2
        own = hit * np.log(self.damaged.median) + np.sqrt(variances) * rng.standard_normal((n, d))
        shared = np.sqrt(self.common) * rng.standard_normal((n, 1))
        errors = rng.standard_normal((n, d)) @ np.linalg.cholesky(self.errors).T
        total = self.errors + self.common + variances[:, :, None] * np.eye(d)
        pull = np.linalg.solve(total, (self.observed - own - shared - errors)[:, :, None])[:, :, 0]
        return np.hstack([own + variances * pull, shared + self.common * pull.sum(axis=1, keepdims=True)])


def _symmetric(matrix: np.ndarray) -> np.ndarray:
    return 0.5 * (matrix + matrix.T)


def _quantiles(value: Distribution | float, n: int, name: str) -> np.ndarray:
    """Quantiles of equal weight of a positive quantity with a distribution, or its known value."""
    nodes = value.ppf((np.arange(n) + 0.5) / n) if isinstance(value, Distribution) else np.array([float(value)])
    if not (np.isfinite(nodes).all() and (nodes > 0.0).all()):
        raise ValueError(
            f"stiffness_loss: expected {name} as a positive number, or a distribution of one; got {value!r}"
        )
    return nodes
