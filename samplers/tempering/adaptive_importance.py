"""Recycling: adaptive importance sampling from the prior to the posterior over all evaluated points.

All points evaluated so far, draws of the prior and of every proposal since, are weighted by the tempered target over
the mixture of all densities that they were drawn from (deterministic mixture weights, Owen & Zhou 2000). The next beta
keeps the effective sample size of *all* points at a target. A mixture fitted to the weighted points at that beta is the
next proposal. A beta is left only when the draws made at it have an effective sample size of three quarters of the
target: among many old points some have large weights by chance, and where the likelihood is rough, annealing that
follows these points ends in a local mode. Once beta = 1 is reached, points are drawn until the effective sample size
suffices. For a posterior that is nearly Gaussian, possibly after a transformation or split into components, this takes
a small part of the evaluations of annealing by moves.

Proposals that are adapted to their own weights can be confidently wrong. Therefore the last fit is checked with fresh
draws that it was not fitted to. The result is used only if their weights are well-behaved and their evidence agrees
(`Recycled.trusted`). If not, these draws join the other points and the next fit is checked, a few times. Points that
shaped later proposals end up with too little weight, and with them the smaller of two modes. Therefore the resulting
population consists only of draws made at beta = 1, each weighted by the one proposal that it was drawn from.

The constants, and why they have their values, are in `samplers.tempering.settings.RecyclingSettings`.

References
----------
Cornuet, Marin, Mira & Robert (2012), Scand. J. Stat. 39(4), doi:10.1111/j.1467-9469.2011.00756.x
Owen & Zhou (2000), JASA 95(449), doi:10.1080/01621459.2000.10473909 (deterministic mixture weights)
"""

from collections.abc import Generator, Sequence
from typing import NamedTuple

import numpy as np

from ..proposals.basins import find_basins, with_components
from ..proposals.mixture import Mixture, fit_mixture, log_density
from ..proposals.support_bounds import find_support_bounds
from .archive import Archive, StartingDensity
from .evidence_check import EvidenceCheck, draw_inside, evidence_from_weights
from .flights import Flight
from .population import Density, Population, Report, Stage, Sweep
from .rounds import round_shares, tail_variance
from .settings import RecyclingSettings
from .stopping import StoppedEarly, stop_at
from .weights import coarse_weights, effective_sample_size, log_mean_weight, next_beta

__all__ = ["Recycled", "most_running", "recycle", "stopped_at", "submit_start"]

# Factor by which beta is expected to grow from stage to stage, for the spread of draws over the stages.
EXPECTED_GROWTH = 3.0
# Largest share of the effective sample size that a stage keeps: else beta would hardly grow.
LARGEST_SHARE_KEPT = 0.9


class Recycled(NamedTuple):
    """Result of recycling.

    Attributes
    ----------
    doubt : str
        Why the result cannot be trusted; empty if it can.
    coords : (n, ndim) float
        The draws made at beta = 1, including those of the check.
    records : (n,) structured array
        Their records (log_prob, log_prior and, where there are any, blobs).
    log_weights : (n,) float
        Log-weights of the draws, round by round against the mixture of the round, which was not fitted to them. The
        share of a round depends on its number of draws and on the effective share of the round before it, not on its
        own weights (`samplers.tempering.rounds.round_shares`): a round with few points of large weight in a tail would
        have a small effective sample size, and the tail would be cut short.
    log_evidence, log_evidence_error : float
        Log-evidence from all points but those of the check, and its standard error.
    check : EvidenceCheck, optional
        The check with fresh draws; None if beta = 1 was not reached, or no check was wanted.
    archive : Archive, optional
        All evaluated points with all proposals; None without draws.
    log_evidence_below_one : float
        Log-evidence at the last beta below 1; 0 without such a stage.
    evaluations_below_one : int
        Evaluations up to the last stage below beta = 1, including those of the starting points; 0 without such a stage.
    """

    doubt: str
    coords: np.ndarray
    records: np.ndarray
    log_weights: np.ndarray
    log_evidence: float
    log_evidence_error: float
    check: EvidenceCheck | None
    archive: Archive | None = None
    log_evidence_below_one: float = 0.0
    evaluations_below_one: int = 0

    @property
    def proposals(self) -> Sequence[tuple[int, Mixture]]:
        """The proposals in order, and how many draws were made from each."""
        return () if self.archive is None else self.archive.proposals

    @property
    def trusted(self) -> bool:
        """Whether the result can be trusted."""
        return not self.doubt


def recycle(
    flight: Flight,
    density: Density,
    random: np.random.RandomState,
    settings: RecyclingSettings,
    start: StartingDensity | None = None,
    size: int | None = None,
    finish: bool = True,
) -> Generator[tuple[Population, Report], None, Recycled]:
    """Anneal draws of the prior, or of another starting density, to beta = 1 by adaptive importance sampling.

    Parameters
    ----------
    flight : Flight
        Starting points, most of which have arrived.
    density : Density
        Evaluates points.
    random : RandomState
        Source of random numbers.
    settings : RecyclingSettings
        Constants.
    start : StartingDensity, optional
        What the points were drawn from; the prior by default. The path from it to the posterior is
        start^(1 - beta) posterior^beta; the evidence is that of the posterior in any case.
    size : int, optional
        Effective sample size wanted at beta = 1, and number of draws of the check; n by default.
    finish : bool
        False: end as soon as the draws at beta = 1 satisfy the rule by which a beta is left.

    Yields
    ------
    Population, Stage or Sweep
        For each beta below 1, before its draws are made: all points with their weights, and the stage. Its acceptance
        is the yield of the latest draws. Then the same points and a `Sweep`, as a tick of the progress bar.

    Returns
    -------
    Recycled
    """
    n, ndim = flight.coords.shape
    size = n if size is None else size
    # another starting density was fitted by a search of its own
    search, basin_rounds = _Search(settings.search_draws * n if start is None else 0.0), 0
    start = StartingDensity(n, lambda _, records: records["log_prior"]) if start is None else start
    target = max(settings.target_share * n, settings.points_per_dimension * (ndim + 1.0))
    enough_fresh = settings.fresh_share * target
    archive = Archive(flight, start)
    bounds = find_support_bounds(density.inside, flight.coords)
    beta, yields, checks = 0.0, [], 0
    increments: list[float] = []
    evaluations_before, evaluations_below_one = density.evaluations - int(flight.arrived.sum()), 0
    drawn: list[_Drawn] = []  # at the present beta
    alive = effective_sample_size(archive.log_weights(0.0))
    if alive < target and not flight.complete:
        density.wait(0)
        archive.update()
        alive = effective_sample_size(archive.log_weights(0.0))
    if alive < target:
        density.wait(0)
        doubt = f"only {alive:.0f} of {n} starting points have a likelihood above zero"
        return Recycled(doubt, *flight.landed_part(), np.zeros(n), float("-inf"), float("inf"), None)
    while True:
        archive.update()
        fresh = sum(effective_sample_size(draws.log_weights(start, beta)) for draws in drawn)
        log_weights, last_beta = archive.log_weights(beta), beta
        effective = effective_sample_size(log_weights)
        if beta < 1.0 and effective >= target and (beta == 0.0 or fresh >= enough_fresh):
            if archive.running(latest=False) > 0:
                # a mode whose evaluations take long would otherwise be left out of every proposal
                density.wait(archive.running() - 1)
                continue
            # more draws shall not make larger steps: it is their number per step that finds narrow modes
            kept = max(target, min(search.increase * target, LARGEST_SHARE_KEPT * effective))
            following = next_beta(archive.log_ratio, beta, kept, log_weights)
            if following == 1.0 and archive.running() > 0:  # what is drawn at beta = 1 is the result
                density.wait(0)
                continue
            beta, drawn = following, []
            log_weights = archive.log_weights(beta)
            effective = effective_sample_size(log_weights)
        # proposals were chosen by weights with an effective sample size of `target`: this error stays in what follows
        inherited = 1.0 / target if yields else 0.0
        log_evidence, error = _evidence(log_weights, inherited)
        if last_beta < beta < 1.0:
            increments.append(log_evidence - sum(increments))
            evaluations_below_one = density.evaluations - evaluations_before
            stage = Stage(
                beta=beta,
                effective_sample_size=effective,
                acceptance=yields[-1] if yields else effective / n,
                moves=0,
                distinct_ancestors=int(effective),
                log_evidence_increment=increments[-1],
                log_evidence_error=error,
            )
            population = Population(beta, archive.coords, archive.records, effective, (), log_weights)
            yield population, stage
            yield population, Sweep(stage.acceptance)
        fitted = fit_mixture(archive.coords, coarse_weights(log_weights), settings.max_components, bounds)
        mixture = _with_even_share(fitted, settings.even_share)
        finished = beta == 1.0 and effective >= size
        basins = None
        if settings.max_basins > 0 and (not finished or basin_rounds < settings.max_basin_rounds):
            log_target = archive.log_target(beta) - log_evidence
            basins = find_basins(mixture, archive.coords, log_target, settings.max_basins, settings.basin_share)
        exploring = finished and basins is not None
        if exploring:
            mixture, basin_rounds = _with_even_share(basins, 1.0), basin_rounds + 1
            wanted = settings.draws_per_basin * len(basins.weights)
        else:
            mixture = with_components(mixture, basins)
            wanted = size if finished else settings.draws_per_target * target
        if last_beta < beta < 1.0:
            wanted = search.enlarge(wanted, beta)
        new, made = draw_inside(mixture, int(round(wanted)), random, density.inside)
        flight = density.submit(new)
        if flight.refused:
            density.wait(0)
            archive.update()
            if (few := len(flight.coords)) > 0:
                archive.add(mixture, made * few / len(new), flight)
            raise stopped_at(archive, beta, sum(increments), inherited)
        draws = _Drawn(mixture, made, flight)
        if exploring:
            density.wait(most_running(density, len(new)))
            archive.add(mixture, made, flight)
            continue
        drawn.append(draws)
        density.wait(0 if finished else most_running(density, len(new)))
        new_weights = draws.log_weights(start, beta)
        fresh_size = effective_sample_size(new_weights)
        fresh += fresh_size
        yields.append(fresh_size / max(len(new_weights), 1))
        checks += finished
        if finished:  # every point has arrived
            archive.update()
            log_evidence, error = _evidence(archive.log_weights(beta), inherited)
        check = evidence_from_weights(new_weights, made) if finished else None
        doubt = _doubt(settings, check, log_evidence, beta, yields)
        # draws that contradict a fit also improve it: check again, as long as that is cheap
        reached = not finish and beta == 1.0 and effective >= target and fresh >= enough_fresh
        if (finished and (not doubt or checks == settings.max_checks)) or (doubt and not finished) or reached:
            if not finished:
                density.wait(0)
                archive.update()
                log_evidence, error = _evidence(archive.log_weights(beta), inherited)
            archive.add(mixture, made, flight)
            return Recycled(
                doubt,
                *_result(drawn if beta == 1.0 else [draws], start, beta),
                log_evidence,
                error,
                check,
                archive,
                sum(increments),
                evaluations_below_one,
            )
        archive.add(mixture, made, flight)


class _Drawn(NamedTuple):
    """Draws of a mixture.

    Attributes
    ----------
    mixture : Mixture
        What they were drawn from.
    made : int
        Number of draws, including those outside the support of the prior.
    flight : Flight
        The draws inside.
    """

    mixture: Mixture
    made: int
    flight: Flight

    def log_weights(self, start: StartingDensity, beta: float) -> np.ndarray:
        """Log-weights (m,) of the draws that have arrived, against the mixture that they were drawn from."""
        coords, records = self.flight.landed_part()
        return _weights_against(self.mixture, records, coords, start, beta)


def _result(drawn: Sequence[_Drawn], start: StartingDensity, beta: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, records and log-weights of rounds of draws that have all arrived, as in `Recycled`."""
    parts = [draws.flight.landed_part() for draws in drawn]
    log_weights = [draws.log_weights(start, beta) for draws in drawn]
    sizes = [draws.made for draws in drawn]
    shares = round_shares(sizes, [effective_sample_size(w) / n for w, n in zip(log_weights, sizes, strict=True)])
    scaled = [w + np.log(share / n) for w, share, n in zip(log_weights, shares, sizes, strict=True)]
    return np.concatenate([c for c, _ in parts]), np.concatenate([r for _, r in parts]), np.concatenate(scaled)


def _evidence(log_weights: np.ndarray, inherited: float) -> tuple[float, float]:
    """Log-evidence from the weights of an archive, and its standard error; `inherited`: variance of earlier choices."""
    n, effective = len(log_weights), effective_sample_size(log_weights)
    log_evidence = float(log_mean_weight(log_weights) + np.log(n))
    return log_evidence, float(np.sqrt(max(1.0 / effective - 1.0 / n, 0.0) + inherited))


def submit_start(
    coords: np.ndarray, density: Density, start: StartingDensity | None = None, whole: bool = False
) -> Flight:
    """Begin to evaluate the points (n, ndim) that an annealing starts from.

    Parameters
    ----------
    coords : (n, ndim) float
        The points.
    density : Density
        Evaluates them.
    start : StartingDensity, optional
        What they were drawn from; the prior by default.
    whole : bool
        Whether to wait for all of them; by default some may be running.

    Raises
    ------
    StoppedEarly
        If the limit of simulations does not allow all points: with those that it allows.
    """
    flight = density.submit(coords)
    density.wait(0 if flight.refused or whole else most_running(density, len(coords)))
    if flight.refused:
        few, records = flight.landed_part()
        log_start = None if start is None else start.log_density(few, records)
        raise stop_at(Population(0.0, few, records, float(len(few))), 0.0, 0.0, log_start=log_start)
    return flight


def most_running(density: Density, submitted: int) -> int:
    """How many points may still run when the next proposal is made: as many as there are workers.

    Then no point waits for a worker, and each that ends leaves one idle. Half of the points that were submitted last
    must have arrived, since there would be too little to learn from otherwise.
    """
    return min(density.workers, submitted // 2)


class _Search:
    """Draws beyond those that the annealing needs, spread over its stages.

    Parameters
    ----------
    left : float
        Number of draws.

    Attributes
    ----------
    increase : float
        Draws of the latest stage, as a multiple of those that the annealing needs.
    """

    def __init__(self, left: float) -> None:
        self._left, self.increase = left, 1.0

    def enlarge(self, draws: float, beta: float) -> float:
        """The draws of a stage, with an equal share of those left for each of the stages that are still expected."""
        share = self._left / (1.0 - np.log(beta) / np.log(EXPECTED_GROWTH))
        self._left -= share
        self.increase = 1.0 + share / draws
        return draws + share


def stopped_at(archive: Archive, beta: float, of_stages: float, inherited: float) -> StoppedEarly:
    """All points, weighted by the posterior over the mixture of their densities.

    Parameters
    ----------
    archive : Archive
        The points.
    beta : float
        Tempering exponent that was reached.
    of_stages : float
        Part of the log-evidence that is in stages already reported.
    inherited : float
        Variance of the log-evidence from the weights by which the proposals were chosen.
    """
    log_weights = archive.log_weights(1.0)
    n, effective = len(log_weights), effective_sample_size(log_weights)
    known = Population(1.0, archive.coords, archive.records, effective, (), log_weights)
    log_evidence = float(log_mean_weight(log_weights) + np.log(n))
    variance = max(1.0 / effective - 1.0 / n, 0.0) + inherited + tail_variance(log_weights)
    return StoppedEarly(known, log_evidence, float(np.sqrt(variance)), beta, of_stages)


def _with_even_share(mixture: Mixture, share: float) -> Mixture:
    """The mixture with a share of its weight spread evenly over its components."""
    weights = (1.0 - share) * mixture.weights + share / len(mixture.weights)
    return mixture._replace(weights=weights)


def _doubt(
    settings: RecyclingSettings, check: EvidenceCheck | None, log_evidence: float, beta: float, yields: list[float]
) -> str:
    """Why to give up, or not to use the result; empty if there is no reason."""
    recent = float(np.mean(yields[-settings.patience :]))
    if len(yields) >= settings.patience and recent < settings.min_yield:
        return f"the effective sample size of fresh draws is {100 * recent:.2g} % of their number"
    if check is None:
        too_long = len(yields) >= settings.max_rounds
        return f"only beta = {beta:.3g} was reached in {settings.max_rounds} rounds" if too_long else ""
    if not check.reliable and yields[-1] < settings.high_yield:
        return f"the weights of fresh draws have a Pareto shape of {check.pareto_shape:.2g}"
    if yields[-1] < settings.trusted_yield:
        return f"the effective sample size of the draws of the check is {100 * yields[-1]:.2g} % of their number"
    if abs(check.log_evidence - log_evidence) > settings.max_evidence_difference:
        return f"fresh draws change the log-evidence by {check.log_evidence - log_evidence:.2g}"
    return ""


def _weights_against(
    mixture: Mixture, records: np.ndarray, coords: np.ndarray, start: StartingDensity, beta: float
) -> np.ndarray:
    """Log-weights of draws against the mixture that they were drawn from."""
    alive = records["log_prob"] > -np.inf
    log_prob = np.where(alive, records["log_prob"], 0.0)
    tempered = (1.0 - beta) * start.log_density(coords, records) + beta * log_prob - log_density(mixture, coords)
    return np.where(alive, tempered, -np.inf)
