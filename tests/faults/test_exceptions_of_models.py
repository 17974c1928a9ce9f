"""Whatever a model raises is a failed simulation; Ctrl-C of the user ends the run."""

import os
import signal
import sys

import numpy as np
import pytest

from fe_likelihoods.models.function import FunctionModel
from fe_likelihoods.simulation.executors import LocalPool
from fe_likelihoods.simulation.faults import MisfitReason, TransientReason
from fe_likelihoods.simulation.model import SimulationFailed, simulate_batch
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, Treacherous, line


class Strange(BaseException):
    """An exception of a user that no `except Exception` catches."""


RAISED = {
    "SystemExit: bye": lambda: sys.exit("bye"),
    "KeyboardInterrupt: ": lambda: exec("raise KeyboardInterrupt"),
    "GeneratorExit: ": lambda: exec("raise GeneratorExit"),
    "Strange: so": lambda: exec("raise Strange('so')", globals()),
}


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


@pytest.mark.parametrize("reason", RAISED)
@pytest.mark.parametrize("make", [Plain, Batched, of_function, lambda act: of_function(act, isolated=True)])
@pytest.mark.parametrize("workers", [None, 1])
def test_any_exception_of_a_model_is_a_failed_simulation(reason, make, workers):
    pool = None if workers is None else LocalPool(workers)
    batch = simulate_batch(make(RAISED[reason]), THETAS, pool)
    assert [bool(why) for why in batch.reasons] == [False, True, False]
    assert batch.reasons[1].startswith(reason)
    assert np.isfinite(batch.response[[0, 2]]).all()
    if pool is not None:
        pool.close()


def turned():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt:
        sys.exit("interrupted")


def repeated():
    try:
        signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt as error:
        raise RuntimeError("the solver was interrupted") from error


def press():
    os.kill(os.getpid(), signal.SIGINT)
    for _ in range(10**8):
        pass


@pytest.fixture
def usual_handler():
    """Another test of this process may have left another handler."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("usual_handler")
@pytest.mark.parametrize("make", [Plain, Batched, of_function])
@pytest.mark.parametrize("act", [press, lambda: signal.raise_signal(signal.SIGINT), turned, repeated])
def test_ctrl_c_ends_the_run(make, act):
    with pytest.raises(KeyboardInterrupt):
        simulate_batch(make(act), THETAS)


def test_ctrl_c_with_a_handler_of_the_user_ends_the_run():
    def handler(number, frame):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            simulate_batch(Plain(press), THETAS)
    finally:
        signal.signal(signal.SIGINT, before)


def forks():
    os.fork()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="NO fork ON THIS SYSTEM")
def test_a_model_that_forks_returns_once_in_a_worker():
    with LocalPool(1) as pool:
        for _ in range(3):
            batch = simulate_batch(Plain(forks), THETAS, pool)
            np.testing.assert_array_equal(batch.response, [line(theta) for theta in THETAS])


class Talkative(Batched):
    """Its batch method gives the reason itself."""

    def simulate_batch(self, thetas):
        return np.array([line(theta) for theta in thetas]), ["", LONG, ""]


def fail(reason):
    raise SimulationFailed(reason)


LONG = "A line that a program has printed.\n" * 10_000


@pytest.mark.parametrize(
    ("make", "kind"),
    [(Plain, str), (Plain, MisfitReason), (Plain, TransientReason), (of_function, str), (Talkative, str)],
)
def test_a_reason_that_is_the_output_of_a_program_is_cut(make, kind):
    """A run keeps a thousand reasons in memory, and shows them in its report."""
    _, reason, _ = simulate_batch(make(lambda: fail(kind(LONG))), THETAS).reasons
    assert reason == f"{LONG[:2000]} ..." and type(reason) is kind
