"""Parts of emcee outside its public interface: private attributes of a sampler, and the HDF5 schema.

They are used in this module only, and pinned by `tests.contract.test_emcee_contract`, which says what to change if a
later version of emcee (``emcee>=3.1.4,<4``) differs.
"""

from collections.abc import Sequence

import numpy as np
from emcee import EnsembleSampler, State
from emcee.backends import Backend, HDFBackend
from emcee.moves import Move

__all__ = [
    "cut_chain",
    "get_moves",
    "get_previous_state",
    "get_random",
    "set_moves",
    "set_previous_state",
    "type_of_blobs",
]


def get_random(sampler: EnsembleSampler) -> np.random.RandomState:
    """The random generator of a sampler."""
    return sampler._random


def get_moves(sampler: EnsembleSampler) -> tuple[Sequence[Move], np.ndarray]:
    """The moves of a sampler, and the probability of each to be chosen."""
    return sampler._moves, sampler._weights


def set_moves(sampler: EnsembleSampler, moves: Sequence[Move], probabilities: np.ndarray) -> None:
    """Replace the moves of a sampler, and the probability of each to be chosen."""
    sampler._moves, sampler._weights = moves, probabilities


def get_previous_state(sampler: EnsembleSampler) -> State | None:
    """The state from which ``run_mcmc(None, ...)`` continues."""
    return sampler._previous_state


def set_previous_state(sampler: EnsembleSampler, state: State | None) -> None:
    """Set the state from which ``run_mcmc(None, ...)`` continues; emcee sets it in some cases only."""
    sampler._previous_state = state


def cut_chain(backend: Backend, steps: int, accepted: np.ndarray) -> None:
    """Set a chain's number of steps and its counts of accepted proposals (nwalkers,).

    What an interrupted step or allocation has left, from which emcee's backends cannot grow, is removed.
    """
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            group = file[backend.name]
            group.attrs["iteration"] = steps
            group["accepted"][...] = accepted
            group.attrs["has_blobs"] &= steps > 0
            if not group.attrs["has_blobs"]:  # emcee sets it after it has made the dataset
                group.pop("blobs", None)
        return
    backend.iteration, backend.accepted = steps, np.array(accepted)
    backend.chain, backend.log_prob = backend.chain[:steps], backend.log_prob[:steps]
    backend.blobs = None if backend.blobs is None or steps == 0 else backend.blobs[:steps]


def type_of_blobs(backend: Backend) -> np.dtype | None:
    """The type of the blobs of a chain; None without any."""
    if not isinstance(backend, HDFBackend):
        return None if backend.blobs is None else backend.blobs.dtype
    with backend.open() as file:
        group = file[backend.name]
        return group["blobs"].dtype.base if group.attrs["has_blobs"] else None
