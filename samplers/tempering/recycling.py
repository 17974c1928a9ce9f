"""Recycling: adaptive multiple importance sampling (AMIS) from the prior to the posterior (``docs/theory/recycling``).

All points are weighted by the tempered target over the mixture of all densities that they were drawn from; each round
chooses the next beta, fits a mixture, and adds draws from it. Beta is increased only when the draws made at it have an
effective sample size of three quarters of the target: annealing that follows few old points of large weight ends in a
local mode. The result consists only of draws made at beta = 1, each weighted by its own proposal. Constants without a
reference were chosen by trials on posteriors with known answers. The *efficiency* of a round is the effective share of
its fresh draws.
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np

from ..estimates.importance import EvidenceCheck, evidence_from_weights
from ..estimates.weights import coarse_weights, effective_sample_size, log_mean_weight, next_beta, normalised_weights
from ..judgement.rounds import doubt_recycling
from ..proposals.basins import find_basins, with_components
from ..proposals.mixture import POINTS_PER_DIMENSION, Mixture, draw_inside, fit_mixture, log_density
from ..proposals.transforms import find_support_bounds
from ..reports import Report, Stage, Sweep
from .mutation import tempered_log_prob
from .population import Density, PendingPoints, Population, stop_at

# Wanted effective sample size at each beta (the target), as a share of the number of starting points. A small target
# allows large steps of beta; the fresh draws of a round then restore the effective sample size.
TARGET_SHARE = 0.2
# Smallest target per dimension (and one more) of each component, once a fit has had several: with fewer, the shares of
# modes drift. And per number of a mean and a covariance: with .25, draws in 40 dimensions have an efficiency of 2 %.
POINTS_PER_COMPONENT, POINTS_PER_NUMBER = 8.0, 0.5
# Draws of a round, as a multiple of the target.
DRAWS_PER_TARGET = 3.0
# Draws that find narrow modes, of the prior, and spread over the stages below beta = 1, as a multiple of the walkers;
# of each kind at least this multiple or 1000. Widths 1:6 and 1:8 in three dimensions and 1:3 in five, 250 walkers: a
# mode was lost in 21 of 72 runs with 250 and 1500, in 2 of 96 with 1000 and 1000. With 32 and 50 walkers and at most
# 1500 simulations, 15 of 18 runs are usable; with 1000 and 1000, none of 6.
DRAWS_SHARE, LEAST_DRAWS = 4, 1000
# A beta is left once the draws made at it have an effective sample size of this share of the target.
FRESH_SHARE = 0.75
# Share of a proposal's weight that is spread evenly over its components, so that small components receive draws too:
# without, 48 runs on several modes take 5 % more evaluations.
EVEN_SHARE = 0.25
# Factor on the volume of the components of a fit to a bent population, or to several modes: a fit to few points leaves
# out the thin ends of an arm, whose draws the next fit would need (counts are in `docs/theory/recycling`).
WIDER_VOLUME = 2.0
# Before the check, unexplained parts of the target are explored once, with this number of draws for each: a mode may
# have been met late. Of 70 asynchronous runs whose narrow mode takes 100 times as long, 1 lost it, without this 15.
DRAWS_PER_BASIN = 30
# A failed check is repeated, and so is one after which the draws do not suffice: moves cost up to seven times as much.
MOST_CHECKS = 4
# Expected share of distinct points among the walkers above which they are as good as independent draws.
ENOUGH_DISTINCT = 0.9
# Factor by which beta is expected to grow from stage to stage, for the spread of draws over the stages; with 10, 1 of
# 48 runs on several modes lost one.
EXPECTED_GROWTH = 3.0
# Largest share of the effective sample size that a stage keeps: else beta would hardly grow.
LARGEST_SHARE_KEPT = 0.9


class Recycled(NamedTuple):
    """Result of recycling: draws made at beta = 1 with those of the check, with log-weights over the density of their
    round. `reason` says why it is not reliable, `independent` whether walkers resampled from it are independent draws.
    """

    reason: str
    points: Population
    log_evidence: float
    log_evidence_error: float
    check: EvidenceCheck | None
    proposal: Mixture | None = None
    log_evidence_below_one: float = 0.0
    independent: bool = False


def recycle(
    pending: PendingPoints, n: int, density: Density, random: np.random.RandomState
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Anneal draws of the prior to beta = 1 by adaptive importance sampling, to the effective sample size `n`.

    Yields all weighted points with a `Stage` for each beta below 1 before its draws are made, then a `Sweep`; raises
    StoppedEarly at the limit of simulations.
    """
    first, ndim = pending.coords.shape
    share = DRAWS_SHARE * n
    left = float(max(share - first_draws(n), min(share, LEAST_DRAWS)))  # further draws that search for narrow modes
    enlarged, explored = 1.0, False
    numbers = ndim * (ndim + 3) / 2.0  # of a mean and a covariance
    of_numbers = min(POINTS_PER_NUMBER * numbers, LARGEST_SHARE_KEPT * n)
    target = least = max(TARGET_SHARE * n, POINTS_PER_DIMENSION * (ndim + 1.0), of_numbers)
    points, bounds = WeightedPoints(pending), find_support_bounds(density.inside, pending.coords)
    beta, efficiencies, increments, checks, most = 0.0, [], [], 0, 1
    drawn: list[_Drawn] = []  # at the present beta
    if (alive := effective_sample_size(points.log_weights(0.0))) < target:
        density.wait(0)
        points.update()
        alive = effective_sample_size(points.log_weights(0.0))
    if alive < target:
        reason = f"{alive:.0f} of {first} starting points have a likelihood above zero, fewer than {target:.0f}"
        return Recycled(reason, Population(0.0, *pending.arrived_part(), alive), float("-inf"), float("inf"), None)
    while True:
        # choose beta
        points.update()
        fresh = sum(effective_sample_size(draws.log_weights(beta)) for draws in drawn)
        log_weights, last_beta = points.log_weights(beta), beta
        effective = effective_sample_size(log_weights)
        if beta < 1.0 and effective >= target and (beta == 0.0 or fresh >= FRESH_SHARE * target):
            if points.running(latest=False) > 0:
                # otherwise a mode with long evaluations would be left out of every proposal
                density.wait(points.running() - 1)
                continue
            # more draws shall not make larger steps: it is their number per step that finds narrow modes
            kept = max(target, min(enlarged * target, LARGEST_SHARE_KEPT * effective))
            following = next_beta(points.log_ratio, beta, kept, log_weights)
            if following == 1.0 and points.running() > 0:  # the draws at beta = 1 are the result
                density.wait(0)
                continue
            beta, drawn = following, []
            log_weights = points.log_weights(beta)
            effective = effective_sample_size(log_weights)

        # evidence; proposals were chosen by weights with an effective sample size of `least`, whose error remains
        inherited = 1.0 / least if efficiencies else 0.0
        log_evidence, error = _evidence(log_weights, inherited)
        if last_beta < beta < 1.0:
            increments.append(log_evidence - sum(increments))
            acceptance = efficiencies[-1] if efficiencies else effective / first
            stage = Stage(beta, effective, acceptance, 0, int(effective), increments[-1], error)
            population = Population(beta, points.coords, points.records, effective, (), log_weights)
            yield population, stage
            yield population, Sweep(acceptance)

        # fit a proposal
        mixture = fit_mixture(points.coords, coarse_weights(log_weights), bounds)
        if len(mixture.weights) > 1 or mixture.shears:
            mixture = mixture.widened(WIDER_VOLUME ** (1.0 / ndim))
        mixture = _with_even_share(mixture, EVEN_SHARE)
        most = max(most, len(mixture.weights))
        target = max(least, POINTS_PER_COMPONENT * (ndim + 1.0) * most) if most > 1 else least
        finished, basins = beta == 1.0 and effective >= n, None
        if not (finished and explored):
            basins = find_basins(mixture, points.coords, points.log_target(beta) - log_evidence)
        if exploring := finished and basins is not None:
            mixture, explored = _with_even_share(basins, 1.0), True
            wanted = DRAWS_PER_BASIN * len(basins.weights)
        else:
            mixture = with_components(mixture, basins)
            wanted = n if finished else DRAWS_PER_TARGET * target
        if last_beta < beta < 1.0:
            # those left are spread evenly over the stages still expected
            extra = left / max(-np.log(beta) / np.log(EXPECTED_GROWTH), 1.0)
            left, enlarged, wanted = left - extra, 1.0 + extra / wanted, wanted + extra

        # draw
        new, made = draw_inside(mixture, int(round(wanted)), random, density.inside)
        pending = density.submit(new)
        if pending.refused:
            density.wait(0)
            points.update()
            if (few := len(pending.coords)) > 0:
                points.add(mixture, made * few / len(new), pending)
            log_weights = points.log_weights(1.0)
            known = Population(beta, points.coords, points.records, 0.0, (), log_weights)
            raise stop_at(known, np.log(len(log_weights)), inherited, sum(increments))
        checking = finished and not exploring
        density.wait(0 if checking else most_running(density, len(new)))
        if exploring:
            points.add(mixture, made, pending)
            continue
        drawn.append(draws := _Drawn(mixture, made, pending))
        new_weights = draws.log_weights(beta)
        efficiencies.append(effective_sample_size(new_weights) / max(len(new_weights), 1))

        # check
        check, checks = evidence_from_weights(new_weights, made) if checking else None, checks + checking
        if checking:  # every point has arrived
            points.update()
            log_evidence, error = _evidence(points.log_weights(beta), inherited)
        reason = doubt_recycling(check, efficiencies)
        # draws that contradict a fit also improve it: check again, as long as that is cheap
        independent = checking and not reason
        if independent:  # are `n` points resampled from the draws as good as independent draws of the posterior?
            weights = normalised_weights(_result(drawn, 1.0).log_weights)
            independent = bool(np.minimum(n * weights, 1.0).sum() >= ENOUGH_DISTINCT * n)
        ends = independent or checks == MOST_CHECKS if checking else bool(reason)
        if ends:
            if not checking:
                density.wait(0)
                points.update()
                log_evidence, error = _evidence(points.log_weights(beta), inherited)
            result = _result(drawn if beta == 1.0 else [draws], beta)
            return Recycled(reason, result, log_evidence, error, check, mixture, sum(increments), independent)
        points.add(mixture, made, pending)


class WeightedPoints:
    """All arrived points (n, ndim), their records, and the log-mixture over all densities they were drawn from. It
    counts every submitted draw, so while some are running, the sum of the weights is smaller than the evidence.
    """

    def __init__(self, pending: PendingPoints):
        self._batches = [pending]
        self._proposals: list[tuple[float, Mixture]] = []
        self._log_mixture_of_all = np.log(len(pending.coords)) + pending.log_prior
        self.update()

    def add(self, mixture: Mixture, made: float, pending: PendingPoints) -> None:
        """Add the draws inside the support, of `made` draws from a mixture."""
        coords = pending.coords
        log_mixture = np.log(len(self._batches[0].coords)) + pending.log_prior
        for count, earlier in self._proposals:
            log_mixture = np.logaddexp(log_mixture, np.log(count) + log_density(earlier, coords))
        self._proposals.append((made, mixture))
        self._batches.append(pending)
        coords_of_all = np.concatenate([pending.coords for pending in self._batches])
        self._log_mixture_of_all = np.logaddexp(
            np.concatenate([self._log_mixture_of_all, log_mixture]), np.log(made) + log_density(mixture, coords_of_all)
        )
        self.update()

    def update(self) -> None:
        """Add the points that have arrived."""
        parts = [pending.arrived_part() for pending in self._batches]
        parts = [part for part in parts if len(part[0]) > 0] or parts[:1]
        self.coords = np.concatenate([coords for coords, _ in parts])
        self.records = np.concatenate([records for _, records in parts])
        arrived = np.concatenate([pending.arrived for pending in self._batches])
        self._log_mixture = self._log_mixture_of_all[arrived]

    def running(self, latest: bool = True) -> int:
        """Number of points that have not arrived; without the latest draws if not `latest`."""
        batches = self._batches if latest else self._batches[:-1]
        return sum(pending.running for pending in batches)

    @property
    def log_ratio(self) -> np.ndarray:
        """Log-likelihood (n,)."""
        return self.records["log_prob"] - self.records["log_prior"]

    def log_target(self, beta: float) -> np.ndarray:
        """Logarithm (n,) of the tempered target, not normalised."""
        alive = self.records["log_prob"] > -np.inf
        return np.where(alive, self.records["log_prior"] + beta * np.where(alive, self.log_ratio, 0.0), -np.inf)

    def log_weights(self, beta: float) -> np.ndarray:
        """Logarithm of the tempered target over the mixture, (n,); the sum of the weights estimates the evidence."""
        return self.log_target(beta) - self._log_mixture


class _Drawn(NamedTuple):
    """The draws from a mixture that lie inside the support of the prior, out of `made` draws."""

    mixture: Mixture
    made: int
    pending: PendingPoints

    def log_weights(self, beta: float) -> np.ndarray:
        """Log-weights (m,) of the draws that have arrived, relative to the mixture that they were drawn from."""
        coords, records = self.pending.arrived_part()
        return tempered_log_prob(records, beta) - log_density(self.mixture, coords)


def _result(drawn: Sequence[_Drawn], beta: float) -> Population:
    """Points of complete rounds with their log-weights, as in `Recycled`."""
    parts = [draws.pending.arrived_part() for draws in drawn]
    log_weights = [draws.log_weights(beta) for draws in drawn]
    sizes = np.array([draws.made for draws in drawn])
    effective = [effective_sample_size(w) / n for w, n in zip(log_weights, sizes, strict=True)]
    # each round counts by the effective share of the one before it, which its own weights do not determine
    shares = np.maximum(sizes * [effective[0], *effective[:-1]], 1.0)
    scaled = [w + x for w, x in zip(log_weights, np.log(shares / shares.sum() / sizes), strict=True)]
    coords, records = (np.concatenate(each) for each in zip(*parts, strict=True))
    weights = np.concatenate(scaled)
    return Population(beta, coords, records, effective_sample_size(weights), (), weights)


def _evidence(log_weights: np.ndarray, inherited: float) -> tuple[float, float]:
    """Log-evidence from the weights of all points, and its standard error; `inherited`: variance of earlier choices."""
    n, effective = len(log_weights), effective_sample_size(log_weights)
    log_evidence = float(log_mean_weight(log_weights) + np.log(n))
    return log_evidence, float(np.sqrt(max(1.0 / effective - 1.0 / n, 0.0) + inherited))


def submit_start(coords: np.ndarray, density: Density, whole: bool = False) -> PendingPoints:
    """Begin to evaluate the draws (n, ndim) of the prior that an annealing starts from; `whole`: wait for all draws.

    Raises StoppedEarly if the limit of simulations does not allow all points.
    """
    pending = density.submit(coords)
    density.wait(0 if pending.refused or whole else most_running(density, len(coords)))
    if pending.refused:
        few, records = pending.arrived_part()
        raise stop_at(Population(0.0, few, records, float(len(few))), 0.0, 0.0)
    return pending


def first_draws(size: int) -> int:
    """Number of draws of the prior that a run starts from, for a number of walkers."""
    return max(size, min(DRAWS_SHARE * size, LEAST_DRAWS))


def most_running(density: Density, submitted: int) -> int:
    """How many points may still run when the next proposal is made: as many as there are workers.

    Half the points that were submitted last must have arrived: fewer would improve a proposal too little.
    """
    return min(density.workers, submitted // 2)


def _with_even_share(mixture: Mixture, share: float) -> Mixture:
    """The mixture with a share of its weight spread evenly over its components."""
    weights = (1.0 - share) * mixture.weights + share / len(mixture.weights)
    return mixture._replace(weights=weights)
