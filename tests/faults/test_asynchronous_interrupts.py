"""Ctrl-C in asynchronous runs with a file: what has been evaluated is in the record, and the same script goes on."""

import sys
from concurrent.futures import ThreadPoolExecutor, wait

import emcee
import numpy as np
import pytest

from samplers import SMCSampler
from samplers.evaluation import asynchronous
from tests.contract.targets import Gaussian
from tests.faults.records import points_of
from tests.faults.test_ctrl_c import is_deferred
from tests.faults.treacherous import Treacherous, posterior_of

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


def test_points_of_a_posterior_that_have_ended_are_kept(tmp_path, monkeypatch):
    """The pool is that of the likelihood, which has no cache on disk."""
    path = tmp_path / "run.h5"
    with Threads() as pool:
        posterior = posterior_of(Treacherous(), pool=pool)
        sampler = make(path, posterior, vectorize=True)
        interrupted_when_all_has_ended(sampler, pool, monkeypatch, 2 * N, "wait")
        sampler._record.close()
        known = points_of(path)
    # on a busy machine some are run again, since the model counts its runs
    assert len(known) == len(set(known)) >= len(pool.futures) - posterior.report()["verifications"]


class Interrupt:
    """Raises KeyboardInterrupt at a line of the two modules that receive points, counted from the start.

    Lines of ``submit`` do not count: points that begin have not ended.
    """

    files = {asynchronous.__file__}
    left_out = {"submit", "__init__", "reset", "close"}  # with what they call

    def __init__(self, line, evaluated):
        self.line, self.count, self.evaluated, self.known = line, 0, evaluated, None

    def __enter__(self):
        sys.settrace(self._enter)
        return self

    def __exit__(self, *error):
        sys.settrace(None)

    def _enter(self, frame, event, value):
        if frame.f_code.co_filename not in self.files:
            return None
        caller = frame
        while caller is not None:
            if caller.f_code.co_filename in self.files and caller.f_code.co_name in self.left_out:
                return None
            caller = caller.f_back
        return self._trace

    def _trace(self, frame, event, value):
        if event == "line" and not is_deferred():
            self.count += 1
            if self.count == self.line:
                sys.settrace(None)
                self.known = list(self.evaluated)
                raise KeyboardInterrupt
        return self._trace


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_ctrl_c_at_any_line_keeps_what_has_ended(every, tmp_path):
    """Each thread may just have ended a point and not have said so."""
    lines = 0
    for line in [*range(1, 90), *range(90, 2000, 61)][::every]:
        path, posterior = tmp_path / f"{line}.h5", Noted()
        with ThreadPoolExecutor(WORKERS) as pool:
            sampler, interrupt = make(path, posterior, pool), Interrupt(line, posterior.evaluated)
            try:
                with interrupt:
                    sampler.run_mcmc(None, 0)
            except KeyboardInterrupt:
                lines += 1
        sampler._record.close()
        if interrupt.known is not None:
            known = points_of(path)
            assert len(known) == len(set(known))
            assert len(set(interrupt.known) - set(known)) <= WORKERS, (line, len(interrupt.known), len(known))
    assert lines > 100 // every


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
        message = "the pool cannot go on: RuntimeError: changed" if kind is RuntimeError else "changed"
        with pytest.raises(kind, match=message):
            sampler.run_mcmc(None, 1)
        sampler._record.close()
        known = points_of(path)
    # points that still ran have ended since
    assert 2 * N - WORKERS <= len(known) and set(known) <= set(posterior.evaluated)
