"""Ctrl-C at any line of `samplers` or emcee, then the missing steps in the same process, in memory and with a file."""

import random
import signal
import sys
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import emcee
import numpy as np
import pytest

import samplers
from tests.faults.kills import evaluated_again
from tests.faults.resumable_run import STEPS, N, go_on, make, outcome, points_of

FOLDERS = tuple(str(Path(package.__file__).parent) for package in (samplers, emcee))

pytestmark = pytest.mark.filterwarnings("ignore::samplers.SamplingWarning")


def is_deferred():
    """Whether Ctrl-C takes effect at the end of a `deferred_interrupts` context."""
    return "deferred_interrupts" in getattr(signal.getsignal(signal.SIGINT), "__qualname__", "")


class Interrupt:
    """Raises KeyboardInterrupt at a line, counted from the start, except where Ctrl-C is deferred."""

    def __init__(self, line=None):
        self.line, self.count = line, 0

    def __enter__(self):
        sys.settrace(self._enter)
        return self

    def __exit__(self, *error):
        sys.settrace(None)

    def _enter(self, frame, event, value):
        return self._trace if frame.f_code.co_filename.startswith(FOLDERS) else None

    def _trace(self, frame, event, value):
        name = frame.f_code.co_name
        if event == "line" and not is_deferred() and name != "deferred_interrupts":
            self.count += 1
            if self.count == self.line:
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._trace


def run(path, kind, log, lines=()):
    """A run that is interrupted at some lines, each counted from the interrupt before."""
    sampler, interrupts = make(path, kind, log=log), 0
    for line in lines:
        try:
            with Interrupt(line):
                go_on(sampler, kind)
        except KeyboardInterrupt:
            interrupts += 1
    return go_on(sampler, kind), interrupts


@cache
def whole_run(kind):
    """A run without interrupts, the points that it evaluates, and the number of lines that it traces."""
    with TemporaryDirectory() as folder:
        whole, _ = run(None, kind, Path(folder) / "log")
        points = set(points_of(Path(folder) / "log"))
    with Interrupt() as counted:
        go_on(make(None, kind), kind)
    return whole, points, counted.count


@pytest.mark.parametrize("stored", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["file", "memory"])
@pytest.mark.parametrize(
    "kind",
    ["smc", *(pytest.param(k, marks=pytest.mark.slow) for k in ("guided", "map", "moves", "asynchronous", "thin"))],
)
def test_the_missing_steps_are_those_of_a_run_without_interrupt(kind, stored, tmp_path):
    whole, evaluated, lines_traced = whole_run(kind)
    choose, interrupts = random.Random(kind), 0
    for trial in range(2):
        path = tmp_path / f"{trial}.h5" if stored else None
        # the last lines are those of the steps
        lines = [choose.randint(1, lines_traced), int((0.7 + 0.3 * choose.random()) * lines_traced)]
        sampler, more = run(path, kind, tmp_path / f"log {trial}", lines)
        interrupts += more
        assert sampler.iteration == STEPS
        if kind == "asynchronous":  # which points have arrived at a decision that Ctrl-C prevents is a matter of chance
            error = np.hypot(sampler.log_evidence_error, whole.log_evidence_error)
            assert abs(sampler.log_evidence - whole.log_evidence) < 4.0 * error
            points = points_of(tmp_path / f"log {trial}")
            # at most a submission for each interrupt, since this pool evaluates points when they are submitted
            assert len(points) - len(set(points)) <= 4 * N * more
        else:
            assert outcome(sampler) == outcome(whole)
            assert set(points_of(tmp_path / f"log {trial}")) == evaluated
    assert interrupts >= 2


def test_points_of_a_batch_that_ctrl_c_ends_are_kept(tmp_path):
    """KeyboardInterrupt in the function, of single points that return blobs: only that point is evaluated again."""
    for path in (None, tmp_path / "run.h5"):
        log = tmp_path / f"log {path is None}"
        sampler, left = make(path, "map", log=log), [300]

        def event(left=left):
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt

        sampler.log_prob_fn.f.event = event
        with pytest.raises(KeyboardInterrupt):
            go_on(sampler, "map")
        go_on(sampler, "map")
        points = points_of(log)
        assert len(points) - sampler.evaluations <= 1  # that point
    assert evaluated_again(log) == 0
