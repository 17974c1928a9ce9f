"""Progress: what a terminal, a pipe and the log show, compared with the numbers of the sampler itself."""

import contextlib
import fcntl
import io
import json
import logging
import os
import re
import struct
import subprocess
import sys
import termios
from concurrent.futures import ThreadPoolExecutor

import emcee
import numpy as np
import pytest
import tqdm

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
from samplers import SMCSampler, Stage
from samplers.reporting import progress
from samplers.reporting.messages import messages_above
from samplers.tempering.expected_cost import expected_left
from tests.contract.targets import Gaussian

RUN = [sys.executable, "-m", "tests.reporting.progress_run"]


def figures(line):
    """The numbers of a state of the bar."""
    return dict(re.findall(r"([\w ]+)=([^,\]]+)", line.partition("[")[2]))


def check_last_states(states, numbers):
    """The last state of the annealing and of the sweeps, compared with the sampler."""
    annealing = [state for state in states if state.startswith("stage")][-1]
    assert annealing.startswith(f"stage {numbers['stages']}: ") and states[0].startswith("annealing: 0 evaluations")
    shown = {name.strip(): value for name, value in figures(annealing).items()}
    annealed = numbers["annealed"]
    assert f"100% {annealed}/{annealed} evaluations" in re.sub(r"\|.*?\|", "", annealing)
    assert shown["beta"] == "1" and shown["log Z"] == numbers["log Z"]
    assert "per hour" in shown and "left" not in shown
    assert states[-1].startswith("sweeps at beta = 1: ") and "2/2 sweeps" in states[-1]
    swept = {name.strip(): value for name, value in figures(states[-1]).items()}
    assert int(swept["evaluations"]) == numbers["evaluations"] - annealed


def run_in_a_terminal(*options):
    """What a run writes to a terminal, and the numbers that it prints to a pipe."""
    parent, terminal = os.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 250, 0, 0))
    process = subprocess.Popen([*RUN, *options], stdout=subprocess.PIPE, stderr=terminal)
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


def screen(written):
    """Lines that a terminal shows at the end, after carriage returns and line feeds."""
    lines, column = [""], 0
    for character in written:
        if character == "\r":
            column = 0
        elif character == "\n":
            lines.append("")
        else:
            lines[-1] = lines[-1][:column].ljust(column) + character + lines[-1][column + 1 :]
            column += 1
    return [line.rstrip() for line in lines]


def test_a_terminal_shows_a_bar():
    shown, numbers = run_in_a_terminal()
    assert "\r" in shown.replace("\r\n", "")
    check_last_states([state.strip() for state in re.split(r"[\r\n]+", shown) if state.strip()], numbers)


def test_messages_do_not_break_the_bar():
    """A warning, two log messages and a print, each between two states of the bar."""
    lines = screen(run_in_a_terminal("talking")[0])
    assert [line for line in lines if line.startswith(("stage", "sweeps"))] == lines[-3:-1]  # the last states alone
    assert sum("UserWarning: warned" in line for line in lines) == 1
    for message in ("logged by a handler", "logged without one", "printed"):
        assert lines.count(message) == 1, lines


def test_streams_are_restored():
    """Also where somebody else has replaced a stream meanwhile, which is left alone."""

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    terminal, other, handler = Terminal(), io.StringIO(), logging.StreamHandler()
    bar = tqdm.tqdm(total=10, file=terminal)
    with contextlib.redirect_stderr(terminal), contextlib.redirect_stdout(terminal):
        handler.setStream(sys.stderr)
        logging.getLogger("samplers").addHandler(handler)
        try:
            with messages_above(bar):
                assert sys.stderr is handler.stream is not terminal
                print("without an end", end="")
                sys.stderr = other
            assert handler.stream is sys.stdout is terminal and sys.stderr is other
        finally:
            logging.getLogger("samplers").removeHandler(handler)
    assert "without an end\n" in terminal.getvalue()
    bar.close()


@pytest.mark.parametrize("option", [(), pytest.param(("log",), marks=pytest.mark.slow)])
def test_a_pipe_gets_lines(option):
    done = subprocess.run([*RUN, *option], capture_output=True, check=True)
    lines = done.stderr.decode().splitlines()
    assert b"\r" not in done.stderr and all(line == line.strip() for line in lines)
    if option:
        assert all(line.startswith("samplers.") for line in lines)
        lines = [line.partition("|")[2] for line in lines if line.startswith("samplers.reporting.progress|")]
    assert len(lines) == 4  # the first and the last state of each bar: the runs take less than a minute
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


def pointwise(ndim=3):
    """A log-density of single points with its prior."""
    gaussian = Gaussian(ndim, 0.3)

    def log_prob(x):
        return gaussian(x)

    log_prob.log_prior, log_prob.sample_prior, log_prob.ndim = gaussian.log_prior, gaussian.sample_prior, ndim
    return log_prob


@pytest.mark.parametrize("kind", ["serial", "pool", "asynchronous"])
def test_the_bar_moves_with_every_point(bars, kind):
    with ThreadPoolExecutor(4) as pool:
        options = {} if kind == "serial" else {"pool": pool, "asynchronous": kind == "asynchronous"}
        sampler = SMCSampler(60, 3, pointwise(), seed=1, recycle=True, **options)
        sampler.run_mcmc(None, 0, progress=True)
    counts = [n for n, _, _ in bars[0].shown]
    assert counts[-1] == sampler.evaluations and counts == sorted(counts)
    if kind != "asynchronous":  # whose points may arrive together
        assert set(range(sampler.evaluations + 1)) == set(counts)
    running = [int(shown.get("running", 0)) for _, _, shown in bars[0].shown]
    assert max(running) >= 60 and running[-1] == 0
    shares = [float(shown["busy"].rstrip(" %")) for _, _, shown in bars[0].shown if "busy" in shown]
    assert bool(shares) is (kind != "serial") and all(0.0 <= share <= 100.0 for share in shares)


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


def test_the_bar_moves_within_a_batch(bars):
    posterior = posterior_of(oscillating())
    sampler = SMCSampler(32, posterior.ndim, posterior, vectorize=True, seed=1, recycle=True)
    sampler.run_mcmc(None, 0, progress=True)
    shown = bars[0].shown
    counts = {n for n, _, _ in shown}
    assert shown[-1][0] == sampler.evaluations
    assert any(0 < n < 32 for n in counts)  # within the first batch
    assert int(shown[-1][2]["failures"]) == posterior.report()["failure_count"] > 0
    assert int(shown[-1][2]["simulations"]) == posterior.report()["simulations"]
    assert posterior.likelihood.when_simulated is None


def test_figures_of_a_bar_are_those_since_it_began(bars):
    """Evaluations, simulations and failures of the annealing, and of the sweeps of each call."""
    posterior = posterior_of(oscillating())
    sampler = SMCSampler(32, posterior.ndim, posterior, vectorize=True, seed=1, recycle=True)
    counts = [(0, 0, 0)]
    for steps in (0, 3, 3):
        sampler.run_mcmc(None, steps, progress=True)
        report = posterior.report()
        counts.append((sampler.evaluations, report["simulations"], report["failure_count"]))
    shown = [[int(bar.figures.get(name, 0)) for name in ("evaluations", "simulations", "failures")] for bar in bars]
    shown = [figures for figures in shown if any(figures)]
    shown[0][0] = bars[0].n  # the annealing counts evaluations
    assert shown == np.diff(counts, axis=0).tolist()
    assert shown[0][2] > 0 and all(0 < simulations <= evaluations for evaluations, simulations, _ in shown[1:])


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


def test_without_progress_nothing_listens():
    posterior, heard = posterior_of(oscillating()), []
    posterior.when_simulated(heard.append)
    sampler = SMCSampler(20, posterior.ndim, posterior, vectorize=True, seed=1)
    silent = emcee.pbar.get_progress_bar(False, None)
    with progress.Progress(silent, sampler._evaluator, "", posterior, None, (20, posterior.ndim)):
        assert sampler._evaluator.observer is None
        posterior(posterior.sample_prior(2))
    assert sum(heard) == 2  # the listener of somebody else is kept


def test_points_of_the_journal_are_shown_at_once(bars, tmp_path):
    calls = []

    class Interrupted(Gaussian):
        def __call__(self, x):
            calls.append(len(np.atleast_2d(x)))
            if len(calls) == 4:
                raise KeyboardInterrupt
            return super().__call__(x)

    def run():
        backend = emcee.backends.HDFBackend(str(tmp_path / "run.h5"))
        sampler = SMCSampler(60, 3, Interrupted(3, 0.02), vectorize=True, seed=1, recycle=True, backend=backend)
        sampler.run_mcmc(None, 0, progress=True)
        return sampler

    with pytest.raises(KeyboardInterrupt):
        run()
    kept = sum(calls[:3])
    sampler = run()
    counts = [n for n, _, _ in bars[1].shown]
    assert counts[-1] == sampler.evaluations > kept
    assert kept in counts
    # the rate is that of this process
    assert all("per hour" not in shown for n, _, shown in bars[1].shown if n < kept)


@pytest.mark.parametrize("ndim", [2, 5])
def test_the_expected_total_holds(bars, ndim):
    """The range after every stage contains what was evaluated afterwards; that for a wrong beta does not."""
    posterior = Gaussian(ndim, 0.01)
    sampler = SMCSampler(250, ndim, posterior, vectorize=True, seed=1)
    sampler.run_mcmc(None, 0, progress=True)
    ladder, held = sampler.ladder, []
    for known in range(1, len(ladder)):
        choice = sampler.settings, 250, ndim, True
        expected = expected_left(*choice, ladder[known - 1].beta, ladder[:known])
        left = sampler.evaluations - sum(stage.evaluations for stage in ladder[:known])
        held.append(expected.low <= left <= expected.high)
    assert np.mean(held) >= 0.5 and held[0]
    mistaken = expected_left(sampler.settings, 250, ndim, True, 1.0)
    assert mistaken.likely < 0.7 * (sampler.evaluations - ladder[0].evaluations)
    totals = [total for _, total, _ in bars[0].shown if total is not None]
    assert totals[-1] == sampler.evaluations
    assert 0.5 * sampler.evaluations < totals[0] < 2.5 * sampler.evaluations
    assert any(shown.get("left", "").startswith("about ") for _, _, shown in bars[0].shown)


def test_measured_stages_replace_the_expected_ones():
    settings = SMCSampler(250, 3, Gaussian(3), vectorize=True, seed=1).settings
    slow = [Stage(beta, 50.0, 0.5, 0, 50, 0.0, 0.1, evaluations) for beta, evaluations in ((1e-3, 250), (1.2e-3, 900))]
    few, many = (expected_left(settings, 250, 3, True, 1.2e-3, stages) for stages in ((), slow))
    assert many.likely > 2.0 * few.likely


@pytest.mark.parametrize(
    ("low", "high", "text"),
    [
        (2.1 * 3600, 3.4 * 3600, "about 2.1 to 3.4 h"),
        (5.0, 5.0, "about 5 s"),
        (30.0, 150.0, "about 0.5 to 2.5 min"),
        (40 * 3600, 300 * 3600, "about 1.7 to 12 d"),
        (0.0, 100.0, "about 0 to 100 s"),
    ],
)
def test_durations_as_text(low, high, text):
    assert progress.as_duration(low, high) == text


def test_a_bar_is_closed_when_a_loop_is_left(bars):
    sampler = SMCSampler(20, 3, Gaussian(3), vectorize=True, seed=1)
    for _ in sampler.sample(None, iterations=5, progress=True):
        break
    assert sampler._evaluator.observer is None
