"""Ctrl-C in asynchronous runs with a file: what has been evaluated is in the record, and the same script goes on."""

from concurrent.futures import ThreadPoolExecutor, wait

import emcee
import numpy as np
import pytest

from samplers import SMCSampler
from tests.contract.targets import Gaussian
from tests.faults.records import points_of

N, NDIM, WORKERS = 40, 2, 3

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


class Threads(ThreadPoolExecutor):
    """Threads that keep their futures."""

    def __init__(self):
        super().__init__(WORKERS)
        self.futures = []

    def submit(self, *arguments):
        self.futures.append(super().submit(*arguments))
        return self.futures[-1]


class Noted(Gaussian):
    """Notes the points as they are evaluated."""

    fingerprint = "of this target"  # a run that is continued need not compare values

    def __init__(self):
        super().__init__(NDIM, sd=0.05)
        self.evaluated = []

    def __call__(self, x):
        value = super().__call__(x)
        self.evaluated.append(np.asarray(x).tobytes())
        return value


def make(path, posterior, pool=None, **settings):
    backend = emcee.backends.HDFBackend(str(path))
    settings = {"seed": 5, "recycle": True, "asynchronous": True, **settings}
    return SMCSampler(N, posterior.ndim, posterior, pool=pool, backend=backend, **settings)


def interrupted_when_all_has_ended(sampler, pool, monkeypatch, before, method="submit"):
    """Raise KeyboardInterrupt in the parent, at a call of its evaluator, when all that it has submitted has ended."""
    called = getattr(type(sampler._evaluator), method)

    def interrupt(evaluator, argument):
        if len(pool.futures) >= before:
            wait(pool.futures)
            raise KeyboardInterrupt
        return called(evaluator, argument)

    with monkeypatch.context() as patch:
        patch.setattr(type(sampler._evaluator), method, interrupt)
        with pytest.raises(KeyboardInterrupt):
            sampler.run_mcmc(None, 1)


@pytest.mark.parametrize("before", [1, 3 * N])
def test_points_of_a_pool_that_have_ended_are_kept(before, tmp_path, monkeypatch):
    path, posterior = tmp_path / "run.h5", Noted()
    with Threads() as pool:
        sampler = make(path, posterior, pool)
        interrupted_when_all_has_ended(sampler, pool, monkeypatch, before)
        sampler._record.close()
        known = points_of(path)
        assert sorted(known) == sorted(posterior.evaluated) and len(known) >= max(before, N)
        again = make(path, posterior, pool)
        again.run_mcmc(None, 1)
    new = posterior.evaluated[len(known) :]
    assert not set(new) & set(known)
    assert abs(again.log_evidence - posterior.log_evidence) < 4 * again.log_evidence_error


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit, RuntimeError])
def test_points_beside_one_that_ends_the_run_are_kept(kind, tmp_path):
    """A worker that raises what is no failure of a point ends the run; all other points that have ended are kept."""

    class Ends(Noted):
        def __call__(self, x):
            if len(self.evaluated) == 2 * N:
                error = kind("changed")
                error.ends_run = True
                raise error
            return super().__call__(x)

    path, posterior = tmp_path / "run.h5", Ends()
    with Threads() as pool:
        sampler = make(path, posterior, pool)
        with pytest.raises(kind, match="changed"):
            sampler.run_mcmc(None, 1)
        sampler._record.close()
        known = points_of(path)
    # points that still ran have ended since
    assert 2 * N - WORKERS <= len(known) and set(known) <= set(posterior.evaluated)
