"""Whatever a model raises is a failed simulation, apart from KeyboardInterrupt and, in this process, SystemExit."""

import os
import signal
import sys
from functools import partial

import numpy as np
import pytest

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.failure_reasons import MisfitReason, TransientReason
from fe_likelihoods.simulation.model import SimulationFailed, simulate_batch
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Treacherous, line


class Strange(BaseException):
    """An exception of a user that no `except Exception` catches."""


def strange():
    raise Strange("so")


class Plain(Treacherous):
    """A model without protection that does something in the second of three simulations."""

    fingerprint = "plain"

    def __init__(self, act):
        self.act = act

    def simulate(self, theta):
        if theta[0] == 2.0:
            self.act()
        return line(theta)


class Batched(Plain):
    def simulate_batch(self, thetas):
        responses = np.array([self.simulate(theta) for theta in thetas])
        return responses, [""] * len(thetas)


THETAS = np.array([[1.0, 0.1], [2.0, 0.1], [3.0, 0.1]])


def of_function(act, **options):
    return FunctionModel(Plain(act).simulate, ("a", "b"), CHANNELS, DT, N_STEPS, version="1", **options)


def isolated(act):
    return of_function(act, isolated=True)


@pytest.fixture(scope="module")
def pool():
    with LocalPool(1) as pool:
        yield pool


def check_failure(batch, reason):
    assert [bool(why) for why in batch.reasons] == [False, True, False]
    assert batch.reasons[1].startswith(reason)
    assert np.isfinite(batch.response[[0, 2]]).all()


@pytest.mark.parametrize("make", [Plain, Batched, of_function, isolated])
def test_any_exception_of_a_model_is_a_failed_simulation(make, pool):
    for where in (None, pool):
        check_failure(simulate_batch(make(strange), THETAS, where), "Strange: so")


def leave():
    sys.exit("bye")


def leave_with_another_error():
    try:
        sys.exit("bye")
    except SystemExit as error:
        raise ValueError("the solver ended") from error


@pytest.mark.parametrize("act", [leave, leave_with_another_error])
@pytest.mark.parametrize("make", [Plain, Batched, of_function])
def test_sys_exit_in_this_process_ends_the_run_with_advice(make, act, caplog):
    with pytest.raises(SystemExit, match="bye"):
        simulate_batch(make(act), THETAS)
    assert [record.message.count("isolated=True") for record in caplog.records] == [1]


@pytest.mark.parametrize(
    ("make", "in_pool"), [(Plain, True), (Batched, True), (of_function, True), (isolated, False), (isolated, True)]
)
def test_sys_exit_in_a_worker_is_a_failed_simulation(make, in_pool, pool):
    pool = pool if in_pool else None
    check_failure(simulate_batch(make(leave), THETAS, pool), "SystemExit: bye")
    check_failure(simulate_batch(make(leave_with_another_error), THETAS, pool), "ValueError: the solver ended")


def test_sys_exit_in_a_function_of_a_pool_does_not_end_this_process(pool):
    with pytest.raises(RuntimeError, match="SystemExit: bye"):
        pool.map(lambda item: leave(), [1])


def test_keyboard_interrupt_in_an_isolated_process_ends_the_run(pool):
    for where in (pool, None):
        with pytest.raises(KeyboardInterrupt):
            simulate_batch(isolated(interrupt), THETAS, where)


def interrupt():
    raise KeyboardInterrupt


def turned():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        sys.exit("interrupted")


def hidden():
    try:
        signal.raise_signal(signal.SIGINT)
    except BaseException:
        raise SimulationFailed("the solver was interrupted") from ValueError("another cause")


def press():
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(10**8):
        pass


@pytest.mark.parametrize("make", [Plain, Batched, of_function])
@pytest.mark.parametrize("act", [press, interrupt, turned, hidden])
def test_ctrl_c_ends_the_run(make, act):
    with pytest.raises(KeyboardInterrupt):
        simulate_batch(make(act), THETAS)


def test_failures_after_an_interrupt_are_failures():
    """Where a run is repeated in an except clause, Python makes its exception the context of all later errors."""
    for interrupted in (KeyboardInterrupt, SystemExit):
        try:
            raise interrupted
        except interrupted:
            for make in (Plain, Batched, of_function):
                check_failure(simulate_batch(make(lambda: fail("a reason")), THETAS), "a reason")


def forks():
    os.fork()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_model_that_forks_returns_once_in_a_worker():
    with LocalPool(1) as pool:
        batch = simulate_batch(Plain(forks), THETAS, pool)
        np.testing.assert_array_equal(batch.response, [line(theta) for theta in THETAS])


def fail(reason):
    raise SimulationFailed(reason)


def test_a_long_reason_is_cut_and_keeps_its_kind():
    """It may be the output of a program; a run keeps a thousand reasons in memory."""
    text = "A line that a program has printed.\n" * 10_000
    for kind in (str, MisfitReason, TransientReason):
        _, reason, _ = simulate_batch(Plain(partial(fail, kind(text))), THETAS).reasons
        assert reason == f"{text[:2000]} ..." and type(reason) is kind
