"""Ctrl-C and ``sys.exit`` in a run: it ends, nothing is stored for the interrupted point, and the run can go on."""

import os
import signal
import sys
import threading
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from multiprocessing import Pool
from multiprocessing.pool import ThreadPool

import emcee
import numpy as np
import pytest

from fe_likelihoods import Channel, FELikelihood, FunctionModel, Measurements
from fe_likelihoods.simulation.executors import LocalPool
from samplers import SMCSampler, TMCMCSampler
from samplers.interrupts import deferred_interrupts
from tests.contract.targets import Gaussian
from tests.faults import guided_run

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")

CHANNELS = (Channel("u", "displacement", "m"),)
THETAS = np.linspace(0.5, 1.5, 6)[:, None]
BAD = float(THETAS[2, 0])


def press_ctrl_c():
    signal.raise_signal(signal.SIGINT)


def interrupt():
    raise KeyboardInterrupt


def leave():
    sys.exit("bye")


def simulate(act, theta):
    if act is not None and theta[0] == BAD:
        act()
    return theta[0] * np.ones((1, 10))


def likelihood_of(act, cache=None, pool=None, **options):
    model = FunctionModel(partial(simulate, act), ("a",), CHANNELS, 0.1, 10, version="1", **options)
    return FELikelihood(model, Measurements(CHANNELS, 0.1, np.ones((1, 10))), cache=cache, pool=pool)


def check_nothing_is_stored(cache):
    """A healthy run on the same cache simulates the interrupted point."""
    again = likelihood_of(None, cache)
    np.testing.assert_allclose(again.misfit(THETAS).ravel(), 10 * (THETAS.ravel() - 1) ** 2, atol=1e-15)
    assert again.report()["simulations"] >= 1 and again.report()["failure_count"] == 0


# handlers of SIGINT --------------------------------------------------------------------------------------------------


def leaves(*arguments):
    sys.exit()


def raises(*arguments):
    raise KeyboardInterrupt


def raises_another(*arguments):
    raise RuntimeError("stop")


@pytest.mark.parametrize("handler", [signal.default_int_handler, leaves, raises, raises_another])
def test_ctrl_c_is_a_keyboard_interrupt_with_every_handler_that_raises(handler, tmp_path):
    signal.signal(signal.SIGINT, handler)
    likelihood = likelihood_of(press_ctrl_c, tmp_path / "cache.db")
    with pytest.raises(KeyboardInterrupt):
        likelihood.misfit(THETAS)
    assert signal.getsignal(signal.SIGINT) is handler
    assert likelihood.report()["failure_count"] == 0
    check_nothing_is_stored(tmp_path / "cache.db")


def test_a_handler_that_returns_has_dealt_with_ctrl_c():
    """Such as one that notes the wish to stop after the present step."""
    noted = []
    signal.signal(signal.SIGINT, lambda *arguments: noted.append(1))
    assert np.isfinite(likelihood_of(press_ctrl_c).misfit(THETAS)).all()
    assert noted


def test_a_handler_that_a_model_sets_stays():
    likelihood_of(lambda: signal.signal(signal.SIGINT, leaves)).misfit(THETAS)
    assert signal.getsignal(signal.SIGINT) is leaves


def test_deferred_ctrl_c_is_a_keyboard_interrupt_at_the_end():
    signal.signal(signal.SIGINT, leaves)
    done = []

    def function(x):
        with deferred_interrupts():
            press_ctrl_c()
            done.append(1)
        done.append(2)
        return 0.0

    sampler = SMCSampler(20, 2, None, log_likelihood_fn=function, log_prior_fn=Gaussian().log_prior, seed=1)
    with pytest.raises(KeyboardInterrupt):
        sampler.run_mcmc(Gaussian(2).sample_prior(20, np.random.RandomState(1)), 1)
    assert done == [1] and signal.getsignal(signal.SIGINT) is leaves


# pools ---------------------------------------------------------------------------------------------------------------


POOLS = {
    "none": lambda: None,
    "LocalPool": lambda: LocalPool(1),
    "ProcessPoolExecutor": lambda: ProcessPoolExecutor(1),
    "multiprocessing": lambda: Pool(1),
    "threads": lambda: ThreadPoolExecutor(2),
    "multiprocessing.pool.ThreadPool": lambda: ThreadPool(2),
}
IN_PROCESSES = ("LocalPool", "ProcessPoolExecutor", "multiprocessing")


@pytest.fixture(params=POOLS)
def pool(request):
    pool = POOLS[request.param]()
    yield request.param, pool
    if hasattr(pool, "terminate"):
        pool.terminate()
    elif pool is not None:
        pool.__exit__(None, None, None)


def test_interrupts_in_pools_of_a_likelihood(pool, tmp_path):
    name, pool = pool
    for number, (act, kind) in enumerate([(interrupt, KeyboardInterrupt), (leave, SystemExit)]):
        cache = tmp_path / f"{number}.db"
        likelihood = likelihood_of(act, cache, pool)
        if kind is SystemExit and name in IN_PROCESSES:
            assert np.isnan(likelihood.misfit(THETAS)).ravel().tolist() == [0, 0, 1, 0, 0, 0]
            (failure,) = likelihood.report()["failures"]
            assert failure["reason"].startswith("SystemExit: bye")
            continue
        with pytest.raises(kind):
            likelihood.misfit(THETAS)
        assert likelihood.report()["failure_count"] == 0
        check_nothing_is_stored(cache)


def test_ctrl_c_while_the_pool_works(pool, tmp_path):
    """The terminal sends SIGINT to the main thread, which waits for a pool."""
    name, pool = pool
    signal.signal(signal.SIGINT, leaves)
    likelihood = likelihood_of(partial(os.kill, os.getpid(), signal.SIGINT), tmp_path / "cache.db", pool)
    with pytest.raises(KeyboardInterrupt):
        likelihood.misfit(THETAS)
        threading.Event().wait(1.0)  # a signal that comes after the result
    assert likelihood.report()["failure_count"] == 0
    assert np.isfinite(likelihood_of(None, tmp_path / "cache.db").misfit(THETAS)).all()


class Once(Gaussian):
    """Does something in one call, which is no call of the samplers' first checks."""

    fingerprint = "of this target"

    def __init__(self, act, at=70):
        super().__init__(2)
        self.act, self.at, self.points = act, at, []

    def __call__(self, x):
        self.points.append(np.asarray(x).tobytes())
        if len(self.points) == self.at and self.act is not None:
            self.act()
        return super().__call__(x)


@pytest.mark.parametrize("sampler", [SMCSampler, TMCMCSampler])
@pytest.mark.parametrize("act", [interrupt, press_ctrl_c, leave])
def test_a_run_of_a_plain_function_goes_on_from_its_file(sampler, act, tmp_path):
    signal.signal(signal.SIGINT, leaves)
    whole = sampler(40, 2, Gaussian(2), seed=3)
    whole.run_mcmc(None, 2)

    def make(target):
        return sampler(40, 2, target, seed=3, backend=emcee.backends.HDFBackend(str(tmp_path / "run.h5")))

    first = Once(act)
    with pytest.raises(SystemExit if act is leave else KeyboardInterrupt):
        make(first).run_mcmc(None, 2)
    assert signal.getsignal(signal.SIGINT) is leaves
    second = Once(None)
    again = make(second)
    again.run_mcmc(None, 2)
    assert first.points[-1] in second.points and again.failure_count == 0
    assert again.get_chain().tolist() == whole.get_chain().tolist()
    assert again.log_evidence == whole.log_evidence


def wrapped(act):
    try:
        act()
    except BaseException as error:
        raise ValueError("the solver stopped") from error


@pytest.mark.parametrize("act", [interrupt, leave, partial(wrapped, interrupt), partial(wrapped, leave)])
@pytest.mark.parametrize("vectorize", [False, True])
def test_interrupts_of_a_plain_function_are_no_failed_evaluations(act, vectorize):
    target = Once(act, at=3)
    sampler = SMCSampler(40, 2, target, seed=3, vectorize=vectorize)
    with pytest.raises((KeyboardInterrupt, SystemExit)):
        sampler.run_mcmc(None, 1)
    assert sampler.failure_count == 0


class Fails(Gaussian):
    """Ends at some points, in any process."""

    fingerprint = "of this target"

    def __init__(self, act):
        super().__init__(2)
        self.act = act

    def __call__(self, x):
        if 0.5 < x[0] < 0.7:
            self.act()
        return super().__call__(x)


def test_interrupts_in_pools_of_a_sampler(pool):
    name, pool = pool
    for act, kind in ((leave, SystemExit), (interrupt, KeyboardInterrupt)):
        sampler = SMCSampler(40, 2, Fails(act), seed=3, pool=pool)
        if kind is SystemExit and name in IN_PROCESSES:
            sampler.run_mcmc(None, 1)
            assert {each["reason"] for each in sampler.failures} == {"SystemExit: bye"}
            continue
        with pytest.raises(kind):
            sampler.run_mcmc(None, 1)
        assert sampler.failure_count == 0


def test_a_posterior_in_the_processes_of_another_sampler_counts_sys_exit():
    """A process of `multiprocessing.Pool` that ended would be waited for for ever."""
    with Pool(1) as pool:
        values = pool.map(likelihood_of(leave).misfit, [THETAS])[0]
    assert np.isnan(values).ravel().tolist() == [0, 0, 1, 0, 0, 0]


@pytest.fixture(scope="module")
def guided_evidence(tmp_path_factory):
    """Log-evidence of a guided run without interrupt."""
    whole, _ = guided_run.make(tmp_path_factory.mktemp("whole") / "cache.db")
    whole.run_mcmc(None, 0)
    return whole.log_evidence


@pytest.mark.parametrize("act", [press_ctrl_c, pytest.param(leave, marks=pytest.mark.slow)])
def test_a_guided_run_goes_on_after_an_interrupt_in_the_search(act, guided_evidence, tmp_path, monkeypatch):
    signal.signal(signal.SIGINT, leaves)
    simulate, calls = guided_run.Vibration.simulate, []

    def interrupted(model, theta):
        calls.append(theta)
        if len(calls) == 8:
            act()
        return simulate(model, theta)

    monkeypatch.setattr(guided_run.Vibration, "simulate", interrupted)
    with pytest.raises(SystemExit if act is leave else KeyboardInterrupt):
        guided_run.make(tmp_path / "cache.db")[0].run_mcmc(None, 0)
    assert len(calls) == 8 and signal.getsignal(signal.SIGINT) is leaves
    again, _ = guided_run.make(tmp_path / "cache.db")
    again.run_mcmc(None, 0)
    assert again.failure_count == 0 and any(np.array_equal(calls[7], theta) for theta in calls[8:])
    assert again.log_evidence == guided_evidence


class FailingPool:
    """A pool that fails once, at its `at`-th call."""

    def __init__(self, at):
        self.at, self.calls = at, 0

    def map(self, function, items):
        self.calls += 1
        if self.calls == self.at:
            raise OSError("no space left on device")
        return list(map(function, items))


@pytest.mark.parametrize("stored", [False, True])
def test_an_exception_says_that_the_run_is_kept_and_goes_on(stored, tmp_path):
    def sampler(at, name):
        backend = emcee.backends.HDFBackend(tmp_path / name) if stored else None
        return SMCSampler(30, 2, Gaussian(2), pool=FailingPool(at), backend=backend, seed=1)

    whole, broken = sampler(0, "whole.h5"), sampler(4, "broken.h5")
    whole.run_mcmc(None, 3)
    with pytest.raises(OSError, match="no space left") as caught:
        broken.run_mcmc(None, 3)
    (note,) = caught.value.__notes__
    assert "330 evaluations and 0 steps are kept in" in note and "The same call goes on" in note
    assert ("broken.h5" in note) == stored
    broken.run_mcmc(None, 3)
    np.testing.assert_array_equal(broken.get_chain(), whole.get_chain())
    assert broken.evaluations == whole.evaluations
