"""Loops that are left or that an error ends, and calls that Ctrl-C ends: the same script ends with the same chain."""

import gc
import logging
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import emcee
import numpy as np
import pytest

from samplers import SMCSampler
from samplers.storage.journal_contents import read_journal
from samplers.storage.lenient_file import LenientFile
from tests.contract.targets import Gaussian, WithBlobs
from tests.faults.interrupted import interrupt_lines, make, state_of

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


@pytest.fixture(autouse=True)
def python_handles_sigint():
    """Tests that run in the background of a shell start with an ignored SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Died(Exception):
    """Raised in the body of a loop."""


def view(sampler, state):
    """What a body can see of the chain and of the state."""
    seen = sampler.iteration, sampler.get_chain().tobytes(), sampler.acceptance_fraction.tobytes()
    return (*seen, sampler.get_last_sample().coords.tobytes(), state.coords.tobytes(), state.log_prob.tobytes())


def all_steps(sampler, body):
    for state in sampler.sample(None, iterations=9):
        body(view(sampler, state))


def left_by_count(sampler, body):
    """A break, and more steps from the state at which the loop was left."""
    for number, state in enumerate(sampler.sample(None, iterations=50), 1):
        body(view(sampler, state))
        if number == 6:
            break
    sampler.run_mcmc(state, 2)


def left_by_chain(sampler, body):
    """As in the documentation of emcee: the loop ends where a figure of the whole chain no longer changes."""
    old = np.inf
    for state in sampler.sample(None, iterations=50):
        body(view(sampler, state))
        if sampler.iteration % 2:
            continue
        new = sampler.get_chain().mean()
        if abs(new - old) < 0.1 or sampler.iteration == 12:
            break
        old = new
    sampler.run_mcmc(None, 2)


def left_and_reset(sampler, body):
    """Burn-in by a loop, a reset, and a loop that is left."""
    for state in sampler.sample(None, iterations=50):
        body((state.coords.tobytes(),))
        if state.log_prob.mean() > -50.0:
            break
    sampler.reset()
    for later in sampler.sample(state, iterations=5):
        body(view(sampler, later))


SCRIPTS = [(left_by_count, Died), (left_by_chain, Died), (left_and_reset, Died), (all_steps, KeyboardInterrupt)]


def run(path, script, dies_at=None, error=Died):
    """What the bodies of a script saw; `dies_at`: the body that ends with an error."""
    sampler, seen = make(path), []

    def body(value):
        seen.append(value)
        if len(seen) == dies_at:
            raise error

    try:
        script(sampler, body)
    finally:
        gc.collect()  # the generator of the loop is closed, as at the end of a process
        sampler.backend.close()
    return sampler, seen


@pytest.mark.parametrize(("script", "error"), SCRIPTS)
def test_a_loop_whose_body_ends_with_an_error_goes_on(script, error, tmp_path):
    """And sees the same states and the same chain; a script that is done adds nothing and evaluates nothing."""
    whole, expected = run(tmp_path / "whole.h5", script)
    path = tmp_path / "run.h5"
    for dies_at in (3, len(expected)):
        with pytest.raises(error):
            run(path, script, dies_at, error)
    for _ in range(2):
        sampler, seen = run(path, script)
        assert state_of(sampler) == state_of(whole)
        assert sampler.evaluations == whole.evaluations
        assert seen == expected
    assert sampler.report()["new_evaluations"] == 0


def test_a_loop_that_no_longer_leaves_goes_on_at_the_end_of_the_chain(tmp_path, caplog):
    path = tmp_path / "run.h5"
    before, _ = run(path, left_by_count)
    chain = before.get_chain()
    sampler, seen = run(path, all_steps_of_50)
    assert len(seen) == 50 and "goes on now" in caplog.text
    after = sampler.get_chain()
    assert np.array_equal(after[:8], chain) and len(after) == 8 + 44
    assert len({step.tobytes() for step in after}) == 52
    again, _ = run(path, all_steps_of_50)
    assert np.array_equal(again.get_chain(), after)


def all_steps_of_50(sampler, body):
    for state in sampler.sample(None, iterations=50):
        body((sampler.iteration, state.coords.tobytes()))


def test_a_loop_that_is_not_closed_yet_is_left_by_the_next_call(tmp_path):
    """A debugger or a notebook keeps the generator of a loop whose body raised an error."""
    sampler = make(tmp_path / "run.h5")
    loop = sampler.sample(None, iterations=50)
    for _ in range(4):
        next(loop)
    sampler.run_mcmc(None, 3)
    with pytest.raises(RuntimeError, match="this loop over sample"):
        next(loop)
    second = sampler.sample(None, iterations=2)
    next(second)
    loop.close()
    next(second)
    second.close()
    chain = sampler.get_chain()
    assert len(chain) == 9 and len({step.tobytes() for step in chain}) == 9
    calls = read_journal(sampler.backend.journal_path).script.calls
    assert [(call.steps, call.made, call.complete) for call in calls] == [(50, 4, False), (3, 3, True), (2, 2, True)]


def test_without_a_file_a_loop_that_is_left_goes_on_from_its_last_state():
    """As in emcee, within the process."""
    sampler = SMCSampler(6, 1, WithBlobs(ndim=1, sd=0.2), vectorize=True, seed=5, recycle=False)
    with pytest.raises(Died):
        for state in sampler.sample(None, iterations=50):
            last = state.coords.copy()
            if sampler.iteration == 4:
                raise Died
    evaluations = sampler.evaluations
    sampler.run_mcmc(None, 2)
    assert np.array_equal(sampler.get_chain()[3], last) and sampler.iteration == 6
    assert sampler.evaluations <= evaluations + 2 * 6


def test_ctrl_c_at_some_lines(tmp_path):
    count, wrong = interrupt_lines(tmp_path, stride=301, first=10)
    assert count >= 5 and not wrong


def test_ctrl_c_waits_while_hdf5_writes(tmp_path, monkeypatch):
    """It would be raised in a function that HDF5 calls, and leave the file in an unknown state."""
    path = tmp_path / "run.h5"
    sampler = make(path)
    sampler.run_mcmc(None, 2)
    write, left = LenientFile.write, [1]

    def interrupted(self, data):
        if left:
            left.pop()
            os.kill(os.getpid(), signal.SIGINT)
        return write(self, data)

    monkeypatch.setattr(LenientFile, "write", interrupted)
    with pytest.raises(KeyboardInterrupt, match="steps are kept in"):
        sampler.run_mcmc(None, 3)
    assert not left
    sampler.run_mcmc(None, 3)
    assert sampler.iteration == 5
    sampler.backend.close()
    again = make(path)
    again.run_mcmc(None, 2)
    again.run_mcmc(None, 3)
    assert state_of(again) == state_of(sampler)


@pytest.mark.slow
def test_ctrl_c_at_every_line(tmp_path):
    """Of the second call of a small script: the same call, and the same script, go on and add nothing twice."""
    count, wrong = interrupt_lines(tmp_path)
    assert count > 1000 and not wrong


@pytest.mark.parametrize("changes", [{"thin_by": 2}, {"tune": True}])
def test_a_call_with_other_options_is_another_call(tmp_path, changes, caplog):
    path = tmp_path / "run.h5"
    make(path).run_mcmc(None, 3)
    for _ in range(2):
        sampler = make(path)
        sampler.run_mcmc(None, 3, **changes)
        assert sampler.iteration == 6
        sampler.backend.close()
    assert "contains this call of 3 steps already" in caplog.text


def test_another_seed_has_no_effect_on_a_stored_run_and_says_so(tmp_path, caplog):
    path = tmp_path / "run.h5"
    make(path, seed=[5, 7]).run_mcmc(None, 1)
    make(path, seed=[5, 7])
    assert "seed" not in caplog.text
    make(path, seed=6)
    assert "contains a run with seed=[5, 7]: seed=6 has no effect" in caplog.text


def test_steps_of_a_script_that_is_edited(tmp_path):
    """Another number of steps is another call, which adds its steps once."""
    path, lengths = tmp_path / "run.h5", []
    for steps in (6, 6, 12, 12, 12):
        sampler = make(path)
        sampler.run_mcmc(None, steps)
        lengths.append(sampler.iteration)
        sampler.backend.close()
    assert lengths == [6, 6, 18, 18, 18]


@pytest.mark.parametrize("limits", [(20, 10_000), (20, 34, 10_000)])
def test_a_limit_that_is_raised_in_a_script(tmp_path, limits):
    """The calls that go on with the first one are repeated as well; a further one adds its steps, once."""

    def script(further=0):
        sampler = make(tmp_path / "run.h5", max_simulations=limits[0])
        for limit in limits:
            sampler.max_simulations = limit
            sampler.run_mcmc(None, 6)
        for _ in range(further):
            sampler.run_mcmc(None, 6)
        sampler.backend.close()
        return sampler

    first = script()
    again = script()
    assert state_of(first) == state_of(again) and again.report()["new_evaluations"] == 0
    assert [script(further).iteration for further in (0, 1, 1, 2, 0)] == [6, 12, 12, 18, 18]


def test_steps_that_are_not_stored_are_not_made_again(tmp_path, caplog):
    """A burn-in with store=False, at beta = 1 and together with the annealing."""

    def script(path):
        sampler = make(path)
        sampler.run_mcmc(None, 3, store=False)
        sampler.run_mcmc(None, 2)
        state = sampler.run_mcmc(None, 3, store=False)
        sampler.run_mcmc(state, 2)
        sampler.backend.close()
        return sampler

    whole = script(tmp_path / "run.h5")
    with caplog.at_level(logging.WARNING):
        again = script(tmp_path / "run.h5")
    assert state_of(again) == state_of(whole) and again.iteration == 4
    assert again.evaluations == whole.evaluations and again.report()["new_evaluations"] == 0


class Counted(Gaussian):
    """Takes one point, and is interrupted at a chosen one."""

    fingerprint = "counted"
    interrupted_at = 0

    def __call__(self, x):
        if self.calls + 1 == self.interrupted_at:
            raise KeyboardInterrupt
        return super().__call__(x)


@pytest.mark.parametrize(("at", "with_pool"), [(15, False), (62, True)])
def test_finished_points_of_a_batch_are_kept(at, with_pool, tmp_path, monkeypatch):
    """A function of one point: what was known a second before is not evaluated again, and nothing else changes."""
    monkeypatch.setattr("samplers.storage.evaluation.SECONDS_BETWEEN_NOTES", 0.0)

    def run(path, interrupted_at, pool):
        posterior = Counted(2)
        posterior.interrupted_at = interrupted_at
        backend = emcee.backends.HDFBackend(str(path))
        settings = {"seed": 5, "min_moves": 1, "max_moves": 1, "check_draws": 3, "recycle": False}
        sampler = SMCSampler(20, 2, posterior, pool=pool, backend=backend, **settings)
        try:
            sampler.run_mcmc(None, 2)
        except KeyboardInterrupt:
            sampler.backend.close()
            return None, posterior.calls
        return sampler, posterior.calls

    with ThreadPoolExecutor(1) as executor:
        pool = executor if with_pool else None
        whole, calls = run(tmp_path / "whole.h5", 0, pool)
        _, before = run(tmp_path / "run.h5", at, pool)
        sampler, after = run(tmp_path / "run.h5", 0, pool)
    assert before >= at - 1 and after <= calls - (at - 1)
    assert np.array_equal(sampler.get_chain(), whole.get_chain())
    assert (sampler.evaluations, sampler.log_evidence) == (whole.evaluations, whole.log_evidence)


def test_ctrl_c_without_a_file_says_that_nothing_is_kept():
    posterior = Gaussian(2, sd=0.1)

    def interrupted(x):
        if posterior.calls > 60:
            os.kill(os.getpid(), signal.SIGINT)
        return posterior(x)

    sampler = SMCSampler(40, 2, interrupted, log_prior_fn=posterior.log_prior, recycle=False, seed=1)
    with pytest.raises(KeyboardInterrupt, match="give the sampler a file"):
        sampler.run_mcmc(posterior.sample_prior(40, np.random.default_rng(1)), 1)
