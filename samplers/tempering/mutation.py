"""Moving at a fixed beta: the tempered density, when a population has moved enough, and chains grown from leaders."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from emcee import State
from emcee.model import Model
from emcee.moves import Move

from .settings import Settings

__all__ = ["Memory", "Moved", "grow_chains", "move_together", "tempered_log_prob"]

STALL_SWEEPS = 3


class Moved(NamedTuple):
    """A population after its moves at one beta.

    Attributes
    ----------
    coords, records : (n, ndim) and (n,) — the population.
    acceptance : float — mean over the sweeps.
    moves : int — number of sweeps.
    memory : float — largest correlation with the start that is left (see `Memory`).
    """

    coords: np.ndarray
    records: np.ndarray
    acceptance: float
    moves: int
    memory: float


def tempered_log_prob(records: np.ndarray, beta: float) -> np.ndarray:
    """(1 - beta) log_prior + beta log_prob of records (n,) with these fields; -inf outside the prior's support."""
    outside = records["log_prior"] == -np.inf
    log_prior = np.where(outside, 0.0, records["log_prior"])
    return np.where(outside, -np.inf, (1.0 - beta) * log_prior + beta * records["log_prob"])


class Memory:
    """How well a population still remembers where it started, sweep after sweep.

    Remembered are the parameters and the log-likelihood, which the next weights depend on. The measure is the largest
    of their correlations, over the walkers, between start and now.

    Parameters
    ----------
    coords : (n, ndim) float — points right after the resampling, of finite log-likelihood.
    records : (n,) with the fields log_prob and log_prior.
    """

    def __init__(self, coords: np.ndarray, records: np.ndarray):
        self._start = self._centred(coords, records)
        self.correlations: list[float] = []

    @staticmethod
    def _centred(coords: np.ndarray, records: np.ndarray) -> np.ndarray:
        remembered = np.column_stack([coords, records["log_prob"] - records["log_prior"]])
        return remembered - remembered.mean(axis=0)

    def update(self, coords: np.ndarray, records: np.ndarray) -> None:
        """Enter the population after a sweep."""
        now = self._centred(coords, records)
        scale = np.sqrt(np.sum(self._start**2, axis=0) * np.sum(now**2, axis=0))
        varied = scale > 0.0
        correlation = np.abs(np.sum(self._start * now, axis=0)[varied] / scale[varied])
        self.correlations.append(float(np.max(correlation, initial=0.0)))

    def enough(self, settings: Settings) -> bool:
        """Whether to stop: the most moves made, the start forgotten, or nothing more forgotten for three sweeps."""
        sweeps = self.correlations
        if len(sweeps) < settings.min_moves:
            return False
        if len(sweeps) >= settings.max_moves or sweeps[-1] < settings.max_correlation:
            return True
        return len(sweeps) > STALL_SWEEPS and min(sweeps[:-STALL_SWEEPS]) <= min(sweeps[-STALL_SWEEPS:])


def move_together(
    coords: np.ndarray,
    records: np.ndarray,
    beta: float,
    model: Model,
    pick: Callable[[], Move],
    settings: Settings,
    show: Callable[[float], None],
) -> Moved:
    """Move equally weighted points at beta until they have forgotten where they started, as the settings say.

    Parameters
    ----------
    coords, records : (n, ndim) and (n,) — the population.
    beta : float
    model : emcee Model — its function gives the tempered density and, as blobs, the records.
    pick : returns the move of the next sweep.
    settings : Settings
    show : called with the acceptance of each sweep.
    """
    memory = Memory(coords, records)
    state = State(coords, log_prob=tempered_log_prob(records, beta), blobs=records)
    acceptance = []
    while not memory.enough(settings):
        move = pick()
        state, accepted = move.propose(model, state)
        move.tune(state, accepted)
        memory.update(state.coords, state.blobs)
        acceptance.append(float(np.mean(accepted)))
        show(acceptance[-1])
    return Moved(state.coords, state.blobs, float(np.mean(acceptance)), len(acceptance), memory.correlations[-1])


def grow_chains(
    coords: np.ndarray,
    records: np.ndarray,
    ancestors: np.ndarray,
    beta: float,
    model: Model,
    pick: Callable[[], Move],
    settings: Settings,
    show: Callable[[float], None],
) -> Moved:
    """Grow a chain from each leader, as long as the leader was drawn often (Ching & Chen 2007).

    All chains make ``settings.burn_in`` steps first; then every step of a chain is a point of the new population.
    Chains of the same age move together, so the moves must be able to move any number of points.

    Parameters
    ----------
    coords, records, ancestors : (n, ndim), (n,), (n,) int — the resampled population and where each point came from.
    beta, model, pick, settings, show : as in `move_together`, which returns the same.
    """
    _, first, owner, counts = np.unique(ancestors, return_index=True, return_inverse=True, return_counts=True)
    place = np.argsort(owner, kind="stable")
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    chains = State(coords[first], log_prob=tempered_log_prob(records[first], beta), blobs=records[first])
    memory = Memory(coords, records)
    coords, records = coords.copy(), records.copy()
    accepted_steps, steps = 0, 0
    for age in range(-settings.burn_in, int(counts.max())):
        growing = np.flatnonzero(counts > age)
        move = pick()
        state = State(chains.coords[growing], log_prob=chains.log_prob[growing], blobs=chains.blobs[growing])
        state, accepted = move.propose(model, state)
        move.tune(state, accepted)
        chains.coords[growing], chains.log_prob[growing] = state.coords, state.log_prob
        chains.blobs[growing] = state.blobs
        if age >= 0:
            rows = place[start[growing] + age]
            coords[rows], records[rows] = state.coords, state.blobs
        accepted_steps, steps = accepted_steps + int(np.sum(accepted)), steps + len(growing)
        show(float(np.mean(accepted)))
    memory.update(coords, records)
    return Moved(coords, records, accepted_steps / steps, settings.burn_in + 1, memory.correlations[-1])
