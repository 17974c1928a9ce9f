"""The parts of emcee that are not its public interface: private attributes of a sampler, and the HDF5 schema.

They are used in this module only, and pinned by `tests.contract.test_emcee_contract`, which says what to change if a
later version of emcee (``emcee>=3.1.4,<4``) differs.
"""

from collections.abc import Sequence

import h5py
import numpy as np
from emcee import EnsembleSampler, State
from emcee.backends import Backend, HDFBackend
from emcee.moves import Move

from .journal import Step

__all__ = [
    "append_steps",
    "drop_last_step",
    "get_moves",
    "get_previous_state",
    "get_random",
    "holds_steps",
    "set_moves",
    "set_previous_state",
    "trim_chain",
]


def get_random(sampler: EnsembleSampler) -> np.random.RandomState:
    """The random generator of a sampler."""
    return sampler._random


def get_moves(sampler: EnsembleSampler) -> tuple[Sequence[Move], np.ndarray]:
    """The moves of a sampler, and the probability of each to be chosen."""
    return sampler._moves, sampler._weights


def set_moves(sampler: EnsembleSampler, moves: Sequence[Move], probabilities: np.ndarray | None = None) -> None:
    """Replace the moves of a sampler; their probabilities stay unless they are given."""
    sampler._moves = moves
    if probabilities is not None:
        sampler._weights = probabilities


def get_previous_state(sampler: EnsembleSampler) -> State | None:
    """The state from which ``run_mcmc(None, ...)`` continues."""
    return sampler._previous_state


def set_previous_state(sampler: EnsembleSampler, state: State | None) -> None:
    """Set the state from which ``run_mcmc(None, ...)`` continues; emcee sets it in some cases only."""
    sampler._previous_state = state


def append_steps(group: h5py.Group, steps: Sequence[Step]) -> None:
    """Write steps to the group of a chain, as repeated calls of ``HDFBackend.save_step`` would.

    Parameters
    ----------
    group : h5py.Group
        Group of the chain, in which ``HDFBackend.grow`` has made room.
    steps : sequence of Step
        At least one.
    """
    start, stop = group.attrs["iteration"], group.attrs["iteration"] + len(steps)
    group["chain"][start:stop] = np.stack([step.coords for step in steps])
    group["log_prob"][start:stop] = np.stack([step.log_prob for step in steps])
    if steps[0].blobs is not None:
        group["blobs"][start:stop] = np.stack([step.blobs for step in steps])
    group["accepted"][:] += np.sum([step.accepted for step in steps], axis=0)
    for i, value in enumerate(steps[-1].random_state):
        group.attrs[f"random_state_{i}"] = value
    group.attrs["iteration"] = stop


def drop_last_step(backend: Backend) -> None:
    """Remove the last step, for which no proposal was accepted, from the chain of a backend."""
    if isinstance(backend, HDFBackend):
        with backend.open("a") as file:
            file[backend.name].attrs["iteration"] -= 1
    else:
        backend.iteration -= 1
        trim_chain(backend)


def trim_chain(backend: Backend) -> None:
    """Remove the room for steps that were not made, which ``Backend.grow`` does not expect to find."""
    if not isinstance(backend, HDFBackend):
        for name in ("chain", "log_prob", "blobs"):
            values = vars(backend)[name]
            if values is not None:
                setattr(backend, name, values[: backend.iteration])


def holds_steps(group: h5py.Group, steps: Sequence[Step]) -> bool:
    """Whether the chain in a group consists of these steps, and has their blobs and the last random state."""
    if group.attrs["iteration"] != len(steps):
        return False
    if not steps:
        return True
    if ("blobs" in group) != (steps[0].blobs is not None):
        return False
    if steps[0].blobs is not None:
        blobs = group["blobs"][: len(steps)]
        if not _equal(blobs, np.stack([step.blobs for step in steps]).astype(blobs.dtype)):
            return False
    stored_random = (group.attrs.get(f"random_state_{i}") for i in range(len(steps[-1].random_state)))
    if not all(np.array_equal(a, b) for a, b in zip(stored_random, steps[-1].random_state, strict=True)):
        return False
    stored = group["chain"][: len(steps)], group["log_prob"][: len(steps)], group["accepted"][...]
    coords, log_prob = np.stack([step.coords for step in steps]), np.stack([step.log_prob for step in steps])
    expected = coords.astype(stored[0].dtype), log_prob.astype(stored[1].dtype), sum(step.accepted for step in steps)
    return all(_equal(a, b) for a, b in zip(stored, expected, strict=True))


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays of the same dtype are equal, where NaN equals NaN; fields are compared one by one."""
    if a.dtype.names is not None:
        return all(_equal(a[name], b[name]) for name in a.dtype.names)
    return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
