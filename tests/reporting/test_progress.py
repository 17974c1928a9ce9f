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

from fe_likelihoods import (
    Channel,
    FELikelihood,
    FunctionModel,
    HalfNormal,
    Measurements,
    Posterior,
    TruncatedNormal,
)

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
