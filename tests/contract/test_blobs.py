"""Blobs are stored as floats, objects or what is declared, or refused: never cut or rounded, in memory and in a file.

The function returns other types of blobs where the first parameter is large: in the first evaluations, which are draws
of the prior, or only near the posterior.
"""

from collections import Counter
from contextlib import nullcontext

import emcee
import numpy as np
import pytest

from samplers import SMCSampler
from tests.contract.targets import Gaussian

N, NDIM, BIG = 24, 2, 2**60 + 1
FIRST, LATER = -0.6, 1.9  # places that draws of the prior reach, and that only the posterior reaches
pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")  # 24 walkers are few


class Changing(Gaussian):
    """Returns one blob of a type below a place, and of another type above; notes the points that it evaluates."""

    def __init__(self, below, above, place):
        super().__init__(NDIM, centre=2.0, sd=0.3)
        self.below, self.above, self.place, self.seen = below, above, place, Counter()

    def blob(self, x):
        return (self.above if x[0] > self.place else self.below)(x)

    def __call__(self, x):
        if np.ndim(x) == 2:
            return [self(row) for row in x]
        self.seen[x.tobytes()] += 1
        return super().__call__(x), self.blob(x)


def draws():
    return np.clip(np.random.default_rng(1).standard_normal((N, NDIM)), -LATER, LATER - 0.2)


def make(posterior, path=None, Sampler=SMCSampler, **kwargs):
    backend = None if path is None else emcee.backends.HDFBackend(str(path))
    return Sampler(N, NDIM, posterior, backend=backend, seed=1, **kwargs)


def run(posterior, path=None, nsteps=3, **kwargs):
    sampler = make(posterior, path, **kwargs)
    sampler.run_mcmc(draws(), nsteps)
    return sampler


def exact(sampler, as_stored=lambda value: value):
    """Whether every blob of the chain is the blob of its point."""
    posterior = sampler.log_prob_fn.f
    chain, blobs = sampler.get_chain(flat=True), sampler.get_blobs(flat=True)
    expected = [as_stored(posterior.blob(x)) for x in chain]
    changed = {x[0] > posterior.place for x in chain}
    assert True in changed
    return all(np.array_equal(found, value) for found, value in zip(blobs.tolist(), expected, strict=True))


ints, floats = (lambda x: int(100 * x[0])), (lambda x: float(x[0]))
PAIRS = {
    "float after int": (ints, floats),
    "int after float": (floats, lambda x: BIG),
    "larger int": (ints, lambda x: 2**70),
    "longer text": (lambda x: "a", lambda x: f"text of {x[0]!r}"),
    "None": (floats, lambda x: None),
    "object": (ints, lambda x: {"x": x[0]}),
    "text after number": (ints, lambda x: "many"),
    "longer array": (lambda x: [1.0, x[0]], lambda x: [1.0, x[0], x[1]]),
    "more digits": (lambda x: np.float32(x[0]), floats),
}
NUMBERS = ("float after int", "more digits")


@pytest.mark.parametrize("vectorize", [False, True])
@pytest.mark.parametrize(("place", "in_file"), [(FIRST, False), (FIRST, True), (LATER, False), (LATER, True)])
@pytest.mark.parametrize("pair", PAIRS)
def test_numbers_are_floats_and_other_values_are_objects_or_refused(pair, place, in_file, vectorize, tmp_path):
    """In memory; in a file, numbers alone."""
    posterior, path = Changing(*PAIRS[pair], place), tmp_path / "run.h5" if in_file else None
    if pair in NUMBERS or (pair == "longer text" and not in_file):
        assert exact(run(posterior, path, vectorize=vectorize))
        return
    with (
        pytest.raises(ValueError, match="cannot be stored in a file|of one type and shape")
        if (place == LATER or in_file or pair == "longer array")
        else nullcontext()
    ):
        assert exact(run(posterior, path, vectorize=True))


def test_another_declared_type_is_another_run(tmp_path):
    run(Changing(ints, ints, LATER), tmp_path / "run.h5", vectorize=True)
    with pytest.raises(ValueError, match="blobs_dtype was None, is int64"):
        make(Changing(ints, ints, LATER), tmp_path / "run.h5", vectorize=True, blobs_dtype=int).run_mcmc(None, 3)


@pytest.mark.parametrize(
    ("pair", "dtype"),
    [
        ((ints, floats), int),
        ((floats, lambda x: 1e300), np.float32),
        ((lambda x: "a", lambda x: "abcdef"), "S5"),
        ((lambda x: "a", lambda x: 1.5), "S9"),
        ((ints, lambda x: BIG), np.int32),
        ((floats, lambda x: BIG), float),
        ((floats, lambda x: {}), float),
        ((lambda x: True, ints), bool),
        ((lambda x: [1.0, 2.0], lambda x: [1.0]), float),
    ],
)
@pytest.mark.parametrize("place", [FIRST, LATER])
def test_a_value_that_a_declared_type_cannot_hold_is_refused(pair, dtype, place, tmp_path):
    for path in (None, tmp_path / "run.h5"):
        with pytest.raises(ValueError, match="blobs_dtype|of one type and shape"):
            run(Changing(*pair, place), path, blobs_dtype=dtype)


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("where", ["memory", "file"])
def test_blobs_of_some_points_only_are_refused(where, first, tmp_path):
    posterior = Changing(ints, ints, LATER)
    posterior.__class__ = type(
        "Some", (Changing,), {"__call__": lambda self, x: Gaussian.__call__(self, x) if (x[0] > LATER) == first else
                              (Gaussian.__call__(self, x), 1)}
    )  # fmt: skip
    with pytest.raises(ValueError, match="with every point or with none"):
        run(posterior, tmp_path / "run.h5" if where == "file" else None)
