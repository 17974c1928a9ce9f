"""Recycling: a ladder climbed by importance sampling, on which nothing evaluated is thrown away.

Every point so far, draws of the prior and of all proposals since, is weighted by the target over the mixture of all
densities it could have come from (deterministic mixture weights). The next beta keeps the effective sample size of
*all* points at a target; a mixture fitted to them at that beta is the next proposal. A rung is left only when the draws
made on it are themselves worth three quarters of the target: of many old points some look good by luck, and where the
likelihood is rough a climb led by the luckiest ends on a summit of its own. Once beta = 1 is reached, draws are added
until the effective sample size suffices. A posterior that is nearly Gaussian, straightened or split if need be, takes a
small part of the evaluations of moves this way.

Proposals adapted to their own weights can be confidently wrong. So the last fit is tried on fresh draws that had no
part in it, and the result is used only if their weights behave and their evidence agrees (`Recycled.trusted`). If they
do not, they join the other points, and the next fit is tried, a few times. Points that shaped later proposals end up
with too little weight, and the smaller of two modes with them: the population that is handed on consists of the draws
made at beta = 1 only, each weighted by the one proposal it came from.

References
----------
Cornuet, Marin, Mira & Robert (2012), Scand. J. Stat. 39(4), doi:10.1111/j.1467-9469.2011.00756.x
Owen & Zhou (2000), JASA 95(449), doi:10.1080/01621459.2000.10473909 (deterministic mixture weights)
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from ..proposals.mixture import Mixture, fit_mixture, log_density
from ..proposals.support_bounds import find_support_bounds
from .evidence_check import EvidenceCheck, draw_inside, evidence_from_weights
from .weights import coarse_weights, effective_sample_size, log_mean_weight, next_beta

__all__ = ["Recycled", "recycle"]

TARGET_SHARE = 0.2
POINTS_PER_DIMENSION = 5
FRESH_SHARE = 0.75
LOW_YIELD = 0.03
LEAST_YIELD = 0.25
HIGH_YIELD = 0.5
PATIENCE = 6
MOST_STAGES = 200
LARGEST_DIFFERENCE = 0.25
MOST_CHECKS = 4
EVENED = 0.25
MOST_COMPONENTS = 8


class Start(NamedTuple):
    """Where a climb by recycling sets out: a density that points were drawn from.

    Attributes
    ----------
    made : int — draws made of it, those outside the support of the prior counted.
    log_density : function of points (n, ndim) and their records (n,) that returns the logarithm of it, (n,).
    """

    made: int
    log_density: Callable[[np.ndarray, np.ndarray], np.ndarray]


class Recycled(NamedTuple):
    """Outcome of a climb by recycling.

    Attributes
    ----------
    doubt : str — why the result may not be trusted; empty if it may.
    coords : (n, ndim) float — the draws made at beta = 1, those of the check among them.
    records : (n,) — their records (log_prob, log_prior[, blobs]).
    log_weights : (n,) float — round by round against the one mixture of the round, whose fit they had no part in; a
        round counts by its effective sample size.
    log_evidence, log_evidence_error : float — by the ladder: all points but those of the check.
    check : EvidenceCheck, or None if beta = 1 was not reached, or a check was not wanted.
    proposals : list of (int, Mixture) — the mixtures drawn from, in order, and how many draws were made of each.
    """

    doubt: str
    coords: np.ndarray
    records: np.ndarray
    log_weights: np.ndarray
    log_evidence: float
    log_evidence_error: float
    check: EvidenceCheck | None
    proposals: Sequence[tuple[int, Mixture]] = ()

    @property
    def trusted(self) -> bool:
        """Whether the weights may be used."""
        return not self.doubt


class _Pool:
    """All points, their records, and the log of the mixture of all densities they were drawn from."""

    def __init__(self, coords: np.ndarray, records: np.ndarray, start: Start):
        self.coords, self.records, self._start = coords, records, start
        self.proposals: list[tuple[int, Mixture]] = []
        self._log_made = np.log(start.made)
        self._log_start = start.log_density(coords, records)
        self._log_mixture = self._log_made + self._log_start

    def add(self, mixture: Mixture, made: int, coords: np.ndarray, records: np.ndarray) -> None:
        """Enter the draws (n, ndim) that `made` draws of a mixture left inside the support."""
        log_start = self._start.log_density(coords, records)
        log_mixture = self._log_made + log_start
        for count, earlier in self.proposals:
            log_mixture = np.logaddexp(log_mixture, np.log(count) + log_density(earlier, coords))
        self.proposals.append((made, mixture))
        self.coords = np.concatenate([self.coords, coords])
        self.records = np.concatenate([self.records, records])
        self._log_start = np.concatenate([self._log_start, log_start])
        self._log_mixture = np.logaddexp(
            np.concatenate([self._log_mixture, log_mixture]), np.log(made) + log_density(mixture, self.coords)
        )

    @property
    def log_ratio(self) -> np.ndarray:
        """Log of the posterior over the start: from the prior, the log-likelihood."""
        return self.records["log_prob"] - self._log_start

    def log_weights(self, beta: float) -> np.ndarray:
        """Log of the tempered target over the mixture, (n,); their sum estimates the evidence at beta."""
        alive = self.records["log_prob"] > -np.inf
        tempered = self._log_start + beta * np.where(alive, self.log_ratio, 0.0) - self._log_mixture
        return np.where(alive, tempered, -np.inf)


def recycle(
    coords: np.ndarray,
    records: np.ndarray,
    evaluate: Callable[[np.ndarray], np.ndarray],
    inside: Callable[[np.ndarray], np.ndarray],
    random: np.random.RandomState,
    enter: Callable[..., None],
    start: Start | None = None,
    wanted: int | None = None,
    finish: bool = True,
) -> Recycled:
    """Climb from draws of the prior, or of another start, to beta = 1 by adaptive mixture importance sampling.

    Parameters
    ----------
    coords, records : (n, ndim) and (n,) — draws of the prior and their records; n sets the size of everything.
    evaluate : function of points (m, ndim) that returns their records (m,).
    inside : function of points (m, ndim) that tells which lie in the support of the prior.
    random : RandomState
    enter : called for each beta below 1, before its draws are made, with the keywords of a `Stage` that are known here:
        beta, effective_sample_size, acceptance (the share of the latest draws that their weights are worth),
        log_evidence and log_evidence_error (both so far).
    start : Start, optional — what the points were drawn from instead of the prior; the path from it to the posterior is
        start^(1 - beta) posterior^beta, and the evidence remains that of the posterior.
    wanted : int, optional — what sets the size of everything, if not the number of points.
    finish : bool — False: end as soon as the draws at beta = 1 are worth as much as those of a rung.
    """
    ndim, n = coords.shape[1], len(coords) if wanted is None else wanted
    start = Start(len(coords), lambda _, records: records["log_prior"]) if start is None else start
    target = max(TARGET_SHARE * len(coords), POINTS_PER_DIMENSION * (ndim + 1.0))
    pool = _Pool(coords, records, start)
    edges = find_support_bounds(inside, coords)
    beta, fresh, yields, checks = 0.0, 0.0, [], 0
    final: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    alive = effective_sample_size(pool.log_weights(0.0))
    if alive < target:
        doubt = f"only {alive:.0f} of {len(coords)} first draws have a likelihood above zero"
        return Recycled(doubt, coords, records, np.zeros(len(coords)), float("-inf"), float("inf"), None)
    while True:
        log_weights, last_beta = pool.log_weights(beta), beta
        effective = effective_sample_size(log_weights)
        if beta < 1.0 and effective >= target and (beta == 0.0 or fresh >= FRESH_SHARE * target):
            beta, fresh = next_beta(pool.log_ratio, beta, target, log_weights), 0.0
            log_weights = pool.log_weights(beta)
            effective = effective_sample_size(log_weights)
        log_evidence = float(log_mean_weight(log_weights) + np.log(len(log_weights)))
        # proposals were chosen by weights worth `target` points: their luck lives on in all that follows
        luck = 1.0 / target if yields else 0.0
        error = float(np.sqrt(max(1.0 / effective - 1.0 / len(log_weights), 0.0) + luck))
        if last_beta < beta < 1.0:
            share = yields[-1] if yields else effective / len(coords)
            enter(
                beta=beta,
                effective_sample_size=effective,
                acceptance=share,
                log_evidence=log_evidence,
                log_evidence_error=error,
            )
        mixture = _evened(fit_mixture(pool.coords, coarse_weights(log_weights), MOST_COMPONENTS, edges))
        finished = beta == 1.0 and effective >= n
        new, made = draw_inside(mixture, n if finished else int(round(2.0 * target)), random, inside)
        new_records = evaluate(new)
        new_weights = _against(mixture, new_records, new, start, beta)
        worth = effective_sample_size(new_weights)
        fresh += worth
        yields.append(worth / max(len(new), 1))
        pool.add(mixture, made, new, new_records)
        if beta == 1.0:
            final.append((new, new_records, _of_round(new_weights)))
        checks += finished
        check = evidence_from_weights(new_weights, made) if finished else None
        doubt = _doubt(check, log_evidence, beta, yields)
        # draws that tell a fit from the truth also mend it: check again, as long as that is cheap
        reached = not finish and beta == 1.0 and effective >= target and fresh >= FRESH_SHARE * target
        if (finished and (not doubt or checks == MOST_CHECKS)) or (doubt and not finished) or reached:
            columns = (
                np.concatenate(column) for column in zip(*final or [(new, new_records, new_weights)], strict=True)
            )
            return Recycled(doubt, *columns, log_evidence, error, check, pool.proposals)


def _evened(mixture: Mixture) -> Mixture:
    """The mixture with a quarter of its weight spread evenly: a small component is not missed by few draws."""
    weights = (1.0 - EVENED) * mixture.weights + EVENED / len(mixture.weights)
    return mixture._replace(weights=weights)


def _of_round(log_weights: np.ndarray) -> np.ndarray:
    """Log-weights whose sum is their effective sample size."""
    effective = effective_sample_size(log_weights)
    if effective == 0.0:
        return log_weights
    return log_weights - log_mean_weight(log_weights) - np.log(len(log_weights)) + np.log(effective)


def _doubt(check: EvidenceCheck | None, log_evidence: float, beta: float, yields: list[float]) -> str:
    """Why to give up, or not to use what was reached; empty if there is no reason."""
    recent = float(np.mean(yields[-PATIENCE:]))
    if len(yields) >= PATIENCE and recent < LOW_YIELD:
        return f"new draws are worth {100 * recent:.2g} % of their number"
    if check is None:
        return f"beta = {beta:.3g} only after {MOST_STAGES} rounds" if len(yields) >= MOST_STAGES else ""
    if not check.reliable and yields[-1] < HIGH_YIELD:
        return f"the weights of fresh draws have a Pareto shape of {check.pareto_shape:.2g}"
    if yields[-1] < LEAST_YIELD:
        return f"fresh draws are worth {100 * yields[-1]:.2g} % of their number"
    if abs(check.log_evidence - log_evidence) > LARGEST_DIFFERENCE:
        return f"fresh draws change the log-evidence by {check.log_evidence - log_evidence:.2g}"
    return ""


def _against(mixture: Mixture, records: np.ndarray, coords: np.ndarray, start: Start, beta: float) -> np.ndarray:
    """Log-weights of draws against the one mixture they came from."""
    alive = records["log_prob"] > -np.inf
    log_prob = np.where(alive, records["log_prob"], 0.0)
    tempered = (1.0 - beta) * start.log_density(coords, records) + beta * log_prob - log_density(mixture, coords)
    return np.where(alive, tempered, -np.inf)
