"""Mutation at a fixed beta: moves of the ensemble, and the rule that ends them.

Resampling copies points, and the moves separate the copies. Moving stops once the population is nearly uncorrelated
with the resampled one it started from (`StartCorrelation`). With ``chains="leaders"``, chains grow from the distinct
points instead, as in Ching & Chen (2007), doi:10.1061/(ASCE)0733-9399(2007)133:7(816).
"""

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import Move, RedBlueMove

from ..moves.fast_parameters import WithFastSweeps
from ..moves.kernels import MixtureMove, calibrate_move
from ..proposals.mixture import Mixture
from .budget import BudgetExhausted
from .population import Density, Population, Sweep
from .settings import Settings

__all__ = [
    "MoveSchedule",
    "Mutated",
    "StartCorrelation",
    "check_moves",
    "grow_chains",
    "move_together",
    "tempered_log_prob",
]

STALL_SWEEPS = 3


def check_moves(moves: Sequence[Move], chains: str) -> None:
    """Raise ValueError for moves that cannot move chains from leaders (setting `chains`)."""
    red_blue = [type(move).__name__ for move in moves if isinstance(move, RedBlueMove)]
    if red_blue and chains == "leaders":
        raise ValueError(
            f'{", ".join(red_blue)} cannot move with chains="leaders": red-blue moves of emcee need several '
            'walkers, and chains from leaders are moved in small groups. Use chains="equal" or RandomWalkMove'
        )


class MoveSchedule(NamedTuple):
    """The moves of a sampler.

    Attributes
    ----------
    moves : sequence of emcee Move
        Mutation kernels.
    probabilities : (n_moves,) float
        Probability of each move to be chosen for a sweep.
    """

    moves: Sequence[Move]
    probabilities: np.ndarray

    def choose(self, random: np.random.RandomState) -> Move:
        """The move of the next sweep."""
        return random.choice(self.moves, p=self.probabilities)

    def calibrate(
        self,
        coords: np.ndarray,
        weights: np.ndarray,
        inside: Callable[[np.ndarray], np.ndarray] | None,
        mixture: Mixture | None = None,
    ) -> None:
        """Fit the moves that can be fitted to points (n, ndim) with normalised weights (n,); or use a `mixture`."""
        for move in self.moves:
            calibrate_move(move, coords, weights, inside, mixture)

    def cover_basins(self, coords: np.ndarray, log_target: np.ndarray) -> None:
        """Let the moves that can use it propose points in parts of the target that their fits do not cover.

        Parameters
        ----------
        coords : (n, ndim) float
            Points, also those of earlier stages.
        log_target : (n,) float
            Logarithm of the target of the stage, scaled so that its integral is about 1.
        """
        for move in self.moves:
            if isinstance(move, MixtureMove | WithFastSweeps):
                move.cover_basins(coords, log_target)

    def expect_independence(self) -> None:
        """Tell the moves that can use it that the points are independent draws of the target already."""
        for move in self.moves:
            if isinstance(move, MixtureMove | WithFastSweeps):
                move.expect_independence()


class Mutated(NamedTuple):
    """A population after its moves at one beta.

    Attributes
    ----------
    population : Population
        The moved points.
    acceptance : float
        Share of accepted proposals over all sweeps.
    moves : int
        Number of sweeps.
    correlation : float
        Largest correlation left with the resampled population (`StartCorrelation`); 1 if no sweep was made.
    stopped : bool
        Whether the limit of simulations ended the moves.
    """

    population: Population
    acceptance: float
    moves: int
    correlation: float
    stopped: bool = False


def tempered_log_prob(records: np.ndarray, beta: float) -> np.ndarray:
    """(1 - beta) log_prior + beta log_prob of records (n,); -inf outside the support of the prior."""
    outside = records["log_prior"] == -np.inf
    log_prior = np.where(outside, 0.0, records["log_prior"])
    return np.where(outside, -np.inf, (1.0 - beta) * log_prior + beta * records["log_prob"])


def _model(density: Density, beta: float, random: np.random.RandomState) -> Model:
    """The tempered density as emcee's moves evaluate it; the records of the points are its blobs."""

    def compute_log_prob(coords: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        records = density.evaluate(coords)
        return tempered_log_prob(records, beta), records

    return Model(density.evaluate, compute_log_prob, density.map, random)


class StartCorrelation:
    """Correlation of a population with the points it started from, sweep by sweep.

    The largest absolute correlation, over the walkers, between start and now of the parameters and of the
    log-likelihood, which the next weights depend on.

    Parameters
    ----------
    coords : (n, ndim) float
        Points directly after the resampling, with finite log-likelihoods.
    records : (n,) structured array
        With the fields log_prob and log_prior.

    Attributes
    ----------
    values : list of float
        The correlation after each sweep.
    """

    def __init__(self, coords: np.ndarray, records: np.ndarray):
        self._start = self._centred(coords, records)
        self.values: list[float] = []

    @staticmethod
    def _centred(coords: np.ndarray, records: np.ndarray) -> np.ndarray:
        columns = np.column_stack([coords, records["log_prob"] - records["log_prior"]])
        return columns - columns.mean(axis=0)

    def update(self, coords: np.ndarray, records: np.ndarray) -> None:
        """Enter the population after a sweep."""
        now = self._centred(coords, records)
        scale = np.sqrt(np.sum(self._start**2, axis=0) * np.sum(now**2, axis=0))
        varied = scale > 0.0
        correlation = np.abs(np.sum(self._start * now, axis=0)[varied] / scale[varied])
        self.values.append(float(np.max(correlation, initial=0.0)))

    def is_low_enough(self, settings: Settings) -> bool:
        """Whether to stop moving: `max_moves` made, low correlation, or no decrease over the last three sweeps."""
        values = self.values
        if len(values) < settings.min_moves:
            return False
        if len(values) >= settings.max_moves or values[-1] < settings.max_correlation:
            return True
        return len(values) > STALL_SWEEPS and min(values[:-STALL_SWEEPS]) <= min(values[-STALL_SWEEPS:])


def move_together(
    population: Population,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Move all points equally often, until they are nearly uncorrelated with their start.

    Parameters
    ----------
    population : Population
        Equally weighted points, with the beta at which they are moved.
    density : Density
        Evaluates points.
    random : RandomState
        Source of random numbers.
    schedule : MoveSchedule
        The moves.
    settings : Settings
        Of these, `min_moves`, `max_moves` and `max_correlation`.

    Yields
    ------
    Population, Sweep
        After each sweep.

    Returns
    -------
    Mutated
    """
    beta, records = population.beta, population.records
    model = _model(density, beta, random)
    correlation = StartCorrelation(population.coords, records)
    state = State(population.coords, log_prob=tempered_log_prob(records, beta), blobs=records)
    acceptance = []
    while not correlation.is_low_enough(settings):
        move = schedule.choose(random)
        try:
            state, accepted = move.propose(model, state)
        except BudgetExhausted:
            share, left = (np.mean(acceptance), correlation.values[-1]) if acceptance else (0.0, 1.0)
            return Mutated(population, float(share), len(acceptance), left, True)
        move.tune(state, accepted)
        correlation.update(state.coords, state.blobs)
        acceptance.append(float(np.mean(accepted)))
        population = population._replace(coords=state.coords, records=state.blobs)
        yield population, Sweep(acceptance[-1])
    return Mutated(population, float(np.mean(acceptance)), len(acceptance), correlation.values[-1])


def grow_chains(
    population: Population,
    ancestors: np.ndarray,
    density: Density,
    random: np.random.RandomState,
    schedule: MoveSchedule,
    settings: Settings,
) -> Generator[tuple[Population, Sweep], None, Mutated]:
    """Grow a chain from each distinct point (leader), one step per copy of it (Ching & Chen 2007).

    All chains first make ``settings.burn_in`` steps; then every step of a chain is a point of the new population.
    Chains of the same length move together, so the moves must be able to move any number of points.

    Parameters
    ----------
    population : Population
        Resampled points, with the beta at which they are moved.
    ancestors : (n,) int
        Index of each point before the resampling; equal for copies.
    density, random, schedule, settings
        As in `move_together`.

    Yields
    ------
    Population, Sweep
        After each step of the chains; points that their chain has not reached yet are those of the start.

    Returns
    -------
    Mutated
    """
    beta, coords, records = population.beta, population.coords, population.records
    model = _model(density, beta, random)
    _, first, owner, counts = np.unique(ancestors, return_index=True, return_inverse=True, return_counts=True)
    place = np.argsort(owner, kind="stable")
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chains = State(coords[first], log_prob=tempered_log_prob(records[first], beta), blobs=records[first])
    correlation = StartCorrelation(coords, records)
    coords, records = coords.copy(), records.copy()
    population = population._replace(coords=coords, records=records)
    accepted_steps, steps = 0, 0
    for length in range(-settings.burn_in, int(counts.max())):
        growing = np.flatnonzero(counts > length)
        move = schedule.choose(random)
        state = State(chains.coords[growing], log_prob=chains.log_prob[growing], blobs=chains.blobs[growing])
        try:
            state, accepted = move.propose(model, state)
        except BudgetExhausted:
            return Mutated(population, accepted_steps / max(steps, 1), 0, 1.0, True)
        move.tune(state, accepted)
        chains.coords[growing], chains.log_prob[growing] = state.coords, state.log_prob
        chains.blobs[growing] = state.blobs
        if length >= 0:
            rows = place[start[growing] + length]
            coords[rows], records[rows] = state.coords, state.blobs
        accepted_steps, steps = accepted_steps + int(np.sum(accepted)), steps + len(growing)
        yield population, Sweep(float(np.mean(accepted)))
    correlation.update(coords, records)
    return Mutated(population, accepted_steps / steps, settings.burn_in + 1, correlation.values[-1])
