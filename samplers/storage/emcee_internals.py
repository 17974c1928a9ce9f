"""The parts of emcee that are not its public interface: private attributes of a sampler, and the HDF5 schema.

They are used in this module only, and pinned by `tests.contract.test_emcee_contract`, which says what to change if a
later version of emcee (``emcee>=3.1.4,<4``) differs.
"""

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import h5py
import numpy as np
from emcee import EnsembleSampler, State
from emcee.backends import Backend, HDFBackend
from emcee.moves import Move

from .journal import Step

__all__ = [
    "Chain",
    "append_steps",
    "begins_with",
    "checksum",
    "drop_last_step",
    "ends_with",
    "get_moves",
    "get_previous_state",
    "get_random",
    "read_chain",
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


def append_steps(group: h5py.Group, steps: Sequence[Step], accepted: np.ndarray, start: int | None = None) -> None:
    """Write steps to the group of a chain, as repeated calls of ``HDFBackend.save_step`` would.

    The same call after one that was interrupted leaves the same group.

    Parameters
    ----------
    group : h5py.Group
        Group of the chain, in which ``HDFBackend.grow`` has made room.
    steps : sequence of Step
        At least one.
    accepted : (n,) float
        Number of accepted proposals per walker before them.
    start : int, optional
        Number of steps before them; those in the group by default. An interrupted call is repeated with its number.
    """
    start = group.attrs["iteration"] if start is None else start
    stop = start + len(steps)
    for name in ("chain", "log_prob", *(() if steps[0].blobs is None else ("blobs",))):
        if len(group[name]) < stop:  # a file that was rebuilt has room for its steps only
            group[name].resize(stop, axis=0)
    group["chain"][start:stop] = np.stack([step.coords for step in steps])
    group["log_prob"][start:stop] = np.stack([step.log_prob for step in steps])
    if steps[0].blobs is not None:
        group["blobs"][start:stop] = np.stack([step.blobs for step in steps])
    group["accepted"][:] = accepted + np.sum([step.accepted for step in steps], axis=0)
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


class Chain(NamedTuple):
    """The chain in a group.

    Attributes
    ----------
    coords : (n_steps, n, ndim) float
        Positions of the walkers.
    log_prob : (n_steps, n) float
        Their log-probabilities.
    blobs : (n_steps, n, ...) array, or None
        Their blobs.
    accepted : (n,) float
        Number of accepted proposals per walker.
    random_state : tuple, or None
        State of the random generator after the last step.
    consistent : bool
        Whether the parts of the group agree with each other.
    """

    coords: np.ndarray
    log_prob: np.ndarray
    blobs: np.ndarray | None
    accepted: np.ndarray
    random_state: tuple | None
    consistent: bool


def read_chain(group: h5py.Group) -> Chain:
    """The chain in a group; KeyError, OSError, RuntimeError, TypeError or ValueError if it is damaged."""
    n, nwalkers, ndim = (int(group.attrs[name]) for name in ("iteration", "nwalkers", "ndim"))
    coords, log_prob, accepted = group["chain"][:n], group["log_prob"][:n], group["accepted"][...]
    blobs = group["blobs"][:n] if "blobs" in group else None
    consistent = coords.shape == (n, nwalkers, ndim) and log_prob.shape == (n, nwalkers)
    consistent = consistent and accepted.shape == (nwalkers,) and bool(group.attrs["has_blobs"]) == (blobs is not None)
    consistent = consistent and (blobs is None or len(blobs) == n)
    random = tuple(group.attrs.get(f"random_state_{i}") for i in range(5))
    return Chain(coords, log_prob, blobs, accepted, None if random[0] is None else random, consistent)


def begins_with(chain: Chain, steps: Sequence[Step]) -> bool:
    """Whether the first steps of a chain, at least `steps`, are these, with their blobs."""
    m = len(steps)
    if m == 0:
        return True
    if not chain.consistent or (chain.blobs is None) != (steps[0].blobs is None):
        return False
    pairs = [(chain.coords, [s.coords for s in steps]), (chain.log_prob, [s.log_prob for s in steps])]
    if chain.blobs is not None:
        pairs.append((chain.blobs, [s.blobs for s in steps]))
    return all(_equal(stored[:m], np.stack(expected).astype(stored.dtype)) for stored, expected in pairs)


def ends_with(chain: Chain, steps: Sequence[Step]) -> bool:
    """Whether acceptance and random state of a chain are those after these steps."""
    if not chain.consistent or not np.array_equal(chain.accepted, sum((s.accepted for s in steps), 0 * chain.accepted)):
        return False
    if not steps or chain.random_state is None:
        return not steps
    return all(np.array_equal(a, b) for a, b in zip(chain.random_state, steps[-1].random_state, strict=True))


def checksum(group: h5py.Group, start: int, stop: int, value: int = 0) -> int:
    """CRC-32 of steps of the chain in a group, continued from that of the steps before."""
    names = [name for name in ("chain", "log_prob", "blobs") if name in group]
    rows = [group[name][start:stop] for name in names]
    for i in range(stop - start):
        for values in rows:
            value = zlib.crc32(np.ascontiguousarray(values[i]).tobytes(), value)
    return value


def _equal(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays of the same dtype are equal, where NaN equals NaN; fields are compared one by one."""
    if a.dtype.names is not None:
        return all(_equal(a[name], b[name]) for name in a.dtype.names)
    return np.array_equal(a, b, equal_nan=a.dtype.kind in "fc")
