"""Progress: what a terminal, a pipe and the log show, compared with the numbers of the sampler itself."""

import fcntl
import json
import os
import re
import struct
import subprocess
import sys
import termios

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    JointLikelihood,
    Measurements,
    Posterior,
    TruncatedNormal,
)
from samplers import SMCSampler
from samplers.reporting import progress

RUN = [sys.executable, "-m", "tests.reporting.progress_run"]


def figures(line):
    """The numbers of a state of the bar."""
    return dict(re.findall(r"([\w ]+)=([^,\]]+)", line.partition("[")[2]))


def check_last_states(states, numbers):
    """The last state of the annealing and of the sweeps, compared with the sampler."""
    annealing = [state for state in states if state.startswith("stage")][-1]
    assert annealing.startswith(f"stage {numbers['stages']}: {numbers['annealed']} evaluations [")
    shown = {name.strip(): value for name, value in figures(annealing).items()}
    assert shown["beta"] == "1" and shown["log Z"] == numbers["log Z"] and "running" not in shown
    assert states[-1].startswith("sweeps at beta = 1: 100%") and "2/2 sweeps" in states[-1]


def run_in_a_terminal():
    """What a run writes to a terminal, and the numbers that it prints to a pipe."""
    parent, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 250, 0, 0))
    process = subprocess.Popen(RUN, stdout=subprocess.PIPE, stderr=terminal)
    os.close(terminal)
    shown = b""
    while True:
        try:
            part = os.read(parent, 65536)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        shown += part
    os.close(parent)
    numbers = json.loads(process.communicate()[0])
    assert process.returncode == 0
    return shown.decode(), numbers


def test_a_terminal_shows_a_bar():
    shown, numbers = run_in_a_terminal()
    assert "\r" in shown.replace("\r\n", "")
    check_last_states([state.strip() for state in re.split(r"[\r\n]+", shown) if state.strip()], numbers)


def test_a_pipe_gets_lines():
    done = subprocess.run(RUN, capture_output=True, check=True)
    lines = done.stderr.decode().splitlines()
    assert b"\r" not in done.stderr and all(line == line.strip() for line in lines)
    assert len(lines) == 2  # the last state of each bar: the runs take less than a minute
    check_last_states(lines, json.loads(done.stdout))


class Bar:
    """A bar that keeps what it is told."""

    def __init__(self):
        self.total, self.n, self.shown = None, 0, []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass

    def set_description_str(self, text, refresh):
        pass

    def set_postfix(self, figures, refresh):
        self.figures = figures

    def update(self, n):
        self.n += n
        self.shown.append((self.n, self.total, self.figures))


@pytest.fixture
def bars(monkeypatch):
    """All bars; every point is shown, however fast it is evaluated."""
    made = []

    def make(display, total, **kwargs):
        made.append(Bar())
        return made[-1]

    monkeypatch.setattr("samplers.tempered.get_progress_bar", make)
    monkeypatch.setattr(progress, "get_progress_bar", make)
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_FIGURES", -1.0)
    return made


def oscillating(names=("a", "b")):
    """A likelihood of a cheap model, whose simulations fail where `a` is above 1.6."""
    channels = (Channel("top", "displacement", "mm"),)

    def response(theta):
        if theta[0] > 1.6:
            raise ArithmeticError("too stiff")
        return 0.01 * np.array([theta[0], theta[1], theta[0] * theta[1]])[None]

    model = FunctionModel(response, names, channels, dt=0.01, n_steps=3, version="1")
    return FELikelihood(model, Measurements(channels, 0.01, response([1.1, 0.9])))


def posterior_of(likelihood):
    names = [name for name in likelihood.parameter_names if not name.startswith("sigma")]
    sigmas = [name for name in likelihood.parameter_names if name.startswith("sigma")]
    return Posterior(
        likelihood, {name: TruncatedNormal(1.0, 0.3) for name in names} | {name: HalfNormal(0.002) for name in sigmas}
    )


def test_figures_of_a_bar_are_those_since_it_began(bars):
    """Simulations and failures of the annealing, and of the sweeps of each call."""
    posterior = posterior_of(oscillating())
    sampler = SMCSampler(32, posterior.ndim, posterior, vectorize=True, seed=1, recycle=True)
    counts = [(0, 0)]
    for steps in (0, 3, 3):
        sampler.run_mcmc(None, steps, progress=True)
        report = posterior.report()
        counts.append((report["simulations"], report["failure_count"]))
    shown = [[int(bar.figures.get(name, 0)) for name in ("simulations", "failures")] for bar in bars]
    shown = [figures for figures in shown if any(figures)]
    assert shown == np.diff(counts, axis=0).tolist()
    assert shown[0][1] > 0 and all(simulations > 0 for simulations, _ in shown[1:])


def test_parts_of_a_joint_likelihood_are_parts_of_a_point():
    posterior = posterior_of(JointLikelihood({"one": oscillating(), "two": oscillating(("a", "c"))}))
    points, heard = posterior.sample_prior(5, np.random.RandomState(1)), []
    points[:, 0] = np.minimum(points[:, 0], 1.5)
    posterior.when_simulated(heard.append)
    silent = posterior_of(JointLikelihood({"one": oscillating(), "two": oscillating(("a", "c"))}))
    assert np.array_equal(posterior(points), silent(points))
    assert sum(heard) == pytest.approx(5.0) and len(heard) > 2
    posterior.when_simulated(None)
    posterior(points + 0.01)
    assert sum(heard) == pytest.approx(5.0)
