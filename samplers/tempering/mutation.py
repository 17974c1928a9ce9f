"""Mutation at a fixed beta: moves of the ensemble, and the rule that ends them.

Moving stops once the population is nearly uncorrelated with its resampled start (`_correlation`). In chains of
transitional Markov chain Monte Carlo, the leaders of long chains have large weights, so their first points have a bias,
which decreases with steps before points count (burn-in). With many copies, the next fit sees too few distinct points
(100 walkers, 12 parameters: means wrong by 1 to 6 standard deviations), so all points are swept together afterwards;
without a burn-in, the algorithm is as published.
"""

from collections.abc import Generator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..emcee_names import DESnookerMove, Model, Move, RedBlueMove, State
from ..estimates.weights import LOWEST
from ..judgement.checks import ROUNDING
from ..moves.population_moves import MixtureMove
from ..record import BudgetExhausted
from ..reports import Sweep
from ..settings import Settings
from .population import Density, Population

MOST_POINTS = 10_000  # kept by `VisitedPoints`


def needs_many_walkers(moves: Any) -> bool:
    """Whether `moves` (a move, or a sequence of moves or (move, weight) pairs) contains red-blue moves of emcee."""
    each = moves if isinstance(moves, Sequence) else [moves]
    return any(isinstance(move[0] if isinstance(move, Sequence) else move, RedBlueMove) for move in each)


def check_moves(moves: Sequence[Move], chains: str) -> None:
    """Raise ValueError for moves that cannot move chains from leaders (setting `chains`), and for
    ``emcee.moves.DESnookerMove``, whose exponent (3.1.6) is half of ndim - 1 (ter Braak & Vrugt 2008,
    doi:10.1007/s11222-008-9104-9).
    """
    if any(type(move) is DESnookerMove for move in moves):
        raise ValueError(
            "emcee.moves.DESnookerMove is refused: its acceptance has half of the exponent that the snooker update "
            "needs, so its samples are too narrow (variance 0.79 for 1 with three normal parameters), and it divides "
            "by zero between copies of a point. Use emcee.moves.DEMove, or the default moves"
        )
    red_blue = [type(move).__name__ for move in moves if isinstance(move, RedBlueMove)]
    if red_blue and chains == "leaders":
        raise ValueError(
            f'{", ".join(red_blue)} cannot move with chains="leaders": red-blue moves of emcee need several '
            'walkers, and chains from leaders are moved in small groups. Use chains="equal" or RandomWalkMove'
        )


class MoveSchedule(NamedTuple):
    """The mutation kernels of a sampler, and the probability (n_moves,) of each to be chosen for a sweep."""

    moves: Sequence[Move]
    probabilities: np.ndarray

    def choose(self, random: np.random.RandomState) -> Move:
        """The move of the next sweep."""
        return random.choice(self.moves, p=self.probabilities)

    def calibrate(self, *arguments: Any) -> None:
        """Fit the moves that can be fitted (`samplers.moves.population_moves`); emcee's own moves cannot."""
        for move in self.moves:
            if hasattr(move, "calibrate"):
                move.calibrate(*arguments)

    def follow(self, ancestors: np.ndarray) -> None:
        """Say from which of the points of the last calibration (by indices) each walker descends."""
        for move in self.mixtures:
            move.follow(ancestors)

    @property
    def mixtures(self) -> list[MixtureMove]:
        """The mixture moves, with fast sweeps or without."""
        return [each for move in self.moves if isinstance(each := getattr(move, "move", move), MixtureMove)]


class Mutated(NamedTuple):
    """A population after its moves at one beta, and whether the limit of simulations `stopped` them."""

    population: Population
    acceptance: float  # over all sweeps
    moves: int  # number of sweeps
    stopped: bool = False


def tempered_log_prob(records: np.ndarray, beta: float) -> np.ndarray:
    """(1 - beta) log_prior + beta log_prob of records (n,); -inf outside the support of the prior."""
    outside = records["log_prior"] == -np.inf
    log_prior = np.where(outside, 0.0, records["log_prior"])
    return np.where(outside, -np.inf, (1.0 - beta) * log_prior + beta * records["log_prob"])


class VisitedPoints:
    """Possible points that the annealing has evaluated, with rejected proposals, which may reveal a narrow mode.

    The next resampling replaces most of them; `samplers.proposals.basins` proposes draws there.
    """

    def __init__(self) -> None:
        self._parts: list[tuple[np.ndarray, ...]] = []

    def add(self, coords: np.ndarray, records: np.ndarray) -> None:
        """Add points (n, ndim) with log_prior and log_prob from their records (n,)."""
        possible = records["log_prob"] > -np.inf
        self._parts.append((coords[possible], records["log_prior"][possible], records["log_prob"][possible]))

    def at(self, beta: float) -> tuple[np.ndarray, np.ndarray]:
        """The points (n, ndim) and the logarithm (n,) of the tempered target there, not normalised.

        If there are more than 10 000 points, those with the lowest target are dropped.
        """
        coords, log_prior, log_prob = (np.concatenate(each) for each in zip(*self._parts, strict=True))
        log_target, highest = (1.0 - beta) * log_prior + beta * log_prob, slice(None)
        if len(coords) > MOST_POINTS:
            highest = np.sort(np.argpartition(-log_target, MOST_POINTS)[:MOST_POINTS])
        self._parts = [(coords[highest], log_prior[highest], log_prob[highest])]
        return coords[highest], log_target[highest]


class Kernel(NamedTuple):
    """What moves need: density, random numbers, the moves and their settings, and where they keep visited points."""

    density: Density
    random: np.random.RandomState
    schedule: MoveSchedule
    settings: Settings
    visited: VisitedPoints


def _tempered_model(kernel: Kernel, beta: float) -> Model:
    """The tempered density as emcee's moves evaluate it; the records of the points are its blobs."""

    def tempered(coords: np.ndarray, records: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        kernel.visited.add(coords, records)
        return tempered_log_prob(records, beta), records

    density = kernel.density
    return Model(density.evaluate, partial(density.evaluate, then=tempered), map, kernel.random)


def _centred(coords: np.ndarray, records: np.ndarray) -> np.ndarray:
    """Parameters and log-likelihoods (n, ndim + 1) of points minus their means; the next weights depend on the last."""
    log_likelihood = np.maximum(records["log_prob"] - records["log_prior"], LOWEST)  # whose squares are finite
    columns = np.column_stack([coords, log_likelihood])
    rounding = np.zeros(columns.shape[1])  # a constant log-likelihood differs by the rounding errors of log_prob
    known = np.isfinite(records["log_prob"])
    rounding[-1] = ROUNDING * np.abs(records["log_prob"][known]).max(initial=1.0)
    return np.where(np.ptp(columns, axis=0) > rounding, columns - columns.mean(axis=0), 0.0)


def _correlation(start: np.ndarray, now: np.ndarray) -> float:
    """Largest correlation of centred columns (n, k) over the walkers, between points after resampling and later."""
    scale = np.sqrt(np.sum(start**2, axis=0) * np.sum(now**2, axis=0))
    varied = scale > 0.0
    return float(np.max(np.abs(np.sum(start * now, axis=0)[varied] / scale[varied]), initial=0.0))


def _moved_enough(correlations: list[float], settings: Settings) -> bool:
    """Whether to stop moving: `max_moves` made, or low correlation after `min_moves`."""
    made = len(correlations)
    return made >= settings.max_moves or (made >= settings.min_moves and correlations[-1] < settings.max_correlation)


def move_together(
    population: Population, kernel: Kernel, made: int = 0, start: np.ndarray | None = None
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Move equally weighted points equally often, until they are nearly uncorrelated with their start; yields each
    sweep. Chains may have `made` moves before, from a `start` as `_centred` returns it.
    """
    beta, records = population.beta, population.records
    model = _tempered_model(kernel, beta)
    now = _centred(population.coords, records)
    start, correlations = (now, []) if start is None else (start, [_correlation(start, now)])
    state = State(population.coords, log_prob=tempered_log_prob(records, beta), blobs=records)
    acceptance = []
    while not _moved_enough(correlations, kernel.settings):
        move = kernel.schedule.choose(kernel.random)
        try:
            state, accepted = move.propose(model, state)
        except BudgetExhausted:
            return Mutated(population, float(np.mean(acceptance or 0.0)), made + len(acceptance), True)
        move.tune(state, accepted)
        correlations.append(_correlation(start, _centred(state.coords, state.blobs)))
        acceptance.append(float(np.mean(accepted)))
        population = population._replace(coords=state.coords, records=state.blobs)
        yield population, Sweep(acceptance[-1])
    return Mutated(population, float(np.mean(acceptance)), made + len(acceptance))


def grow_chains(
    population: Population, ancestors: np.ndarray, kernel: Kernel
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Grow a chain from each distinct point (leader), one step per copy of it, after ``settings.burn_in`` steps of all.

    `ancestors` (n,) are equal for copies; with a burn-in, sweeps over all points follow if these are still correlated
    with the resampled points.
    """
    beta, coords, records = population.beta, population.coords, population.records
    model, schedule, settings = _tempered_model(kernel, beta), kernel.schedule, kernel.settings
    _, first, owner, counts = np.unique(ancestors, return_index=True, return_inverse=True, return_counts=True)
    place = np.argsort(owner, kind="stable")
    begin = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chains = State(coords[first], log_prob=tempered_log_prob(records[first], beta), blobs=records[first])
    start = _centred(coords, records)
    coords, records = coords.copy(), records.copy()
    population = population._replace(coords=coords, records=records)
    accepted_steps, steps = 0, 0
    for length in range(-settings.burn_in, int(counts.max())):
        growing = np.flatnonzero(counts > length)
        schedule.follow(ancestors[first[growing]])
        move = schedule.choose(kernel.random)
        state = State(chains.coords[growing], log_prob=chains.log_prob[growing], blobs=chains.blobs[growing])
        try:
            state, accepted = move.propose(model, state)
        except BudgetExhausted:
            return Mutated(population, accepted_steps / max(steps, 1), 0, True)
        move.tune(state, accepted)
        chains.coords[growing], chains.log_prob[growing] = state.coords, state.log_prob
        chains.blobs[growing] = state.blobs
        if length >= 0:
            rows = place[begin[growing] + length]
            coords[rows], records[rows] = state.coords, state.blobs
        accepted_steps, steps = accepted_steps + int(np.sum(accepted)), steps + len(growing)
        yield population, Sweep(float(np.mean(accepted)))
    grown = Mutated(population, accepted_steps / steps, settings.burn_in + 1)
    if settings.burn_in == 0 or _correlation(start, _centred(coords, records)) < settings.max_correlation:
        return grown
    schedule.follow(ancestors)
    return (yield from move_together(population, kernel, grown.moves, start))
