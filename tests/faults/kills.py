"""Kills by signal 9 at every write, and what the same script makes of what they leave.

``python -m tests.faults.kills --kills 1000`` prints a table of the kills by window.

A script runs in a forked process, in which every write, truncation and renaming is counted: those of the journal, of
the lock, and those that HDF5 makes, which go through a Python file. At a chosen one the process kills itself, before
it, in the middle of the written bytes, or after it. The same script is then started again, perhaps killed again, and at
last left to end. Its chain, ladder, evidence, counts and failures must be those of a run that was not killed, and a
further start must add nothing.
"""

import argparse
import contextlib
import itertools
import logging
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import emcee
import h5py
import numpy as np

import samplers.storage.journal as journal_module
from samplers import SMCSampler, TMCMCSampler
from tests.contract.targets import WithBlobs

MODES = ("before", "within", "after")
WINDOWS = {
    "_replace": "file created or rebuilt",
    "append_steps": "steps into the file",
    "grow": "room for steps, blobs",
    "write_stage": "stage into the file",
    "write_check": "check into the file",
    "write_verdict": "verdict into the file",
    "drop_last_step": "shown step removed",
    "write_marks": "marks into the file",
    "_mark": "marks into the file",
    "create": "journal created",
    "_write": "block into the journal",
    "_acquire": "lock",
    "release": "lock",
    "begin": "journal set aside",
    "set_aside": "file set aside",
}


class Fragile(WithBlobs):
    """Raises an exception for some points; takes a point or a batch."""

    def __call__(self, x):
        if np.ndim(x) == 2:
            return np.array([self(row) for row in x]) if np.all(x[:, 0] >= 0.1) else self._fail()
        return super().__call__(x) if x[0] >= 0.1 else self._fail()

    @staticmethod
    def _fail():
        raise ArithmeticError("no equilibrium")


def _sampler(path, Sampler=SMCSampler, n=6, **settings):
    settings = {"seed": 5, "max_failure_share": 0.98, **settings}
    backend = emcee.backends.HDFBackend(str(path))
    return Sampler(n, 1, Fragile(ndim=1, sd=0.2), backend=backend, **settings)


def burn_in(path):
    """Moves, a burn-in, a reset, and the steps that count."""
    sampler = _sampler(path, recycle=False, min_moves=1, max_moves=1)
    state = sampler.run_mcmc(None, 2)
    sampler.reset()
    sampler.run_mcmc(state, 3)
    return sampler


def recycling(path):
    """Recycling, batches, and two calls."""
    sampler = _sampler(path, n=12, recycle=True, vectorize=True)
    sampler.run_mcmc(None, 1)
    sampler.run_mcmc(None, 2)
    return sampler


def two_annealings(path):
    """TMCMC from two starts in one file."""
    sampler = _sampler(path, TMCMCSampler, min_moves=1, max_moves=1)
    sampler.run_mcmc(np.random.default_rng(1).standard_normal((6, 1)), 1)
    sampler.run_mcmc(np.random.default_rng(2).standard_normal((6, 1)), 2)
    return sampler


def limited(path):
    """A limit of simulations that ends the annealing; its state is shown by a step."""
    sampler = _sampler(path, recycle=False, min_moves=1, max_moves=1, max_simulations=14)
    sampler.run_mcmc(None, 3)
    return sampler


def limited_steps(path):
    """A limit of simulations that ends the steps at beta = 1."""
    sampler = _sampler(path, recycle=False, min_moves=1, max_moves=1, max_simulations=32)
    sampler.run_mcmc(None, 9)
    return sampler


SCRIPTS = (burn_in, recycling, two_annealings, limited, limited_steps)


# ---------------------------------------------------------------------- the writes of a process


class Writes:
    """Counts what a process writes, and kills it at the chosen place.

    Parameters
    ----------
    number : int, optional
        The write at which to kill; never by default.
    mode : {"before", "within", "after"}
        When.
    report : int, optional
        Descriptor to which the window of the kill is written.
    """

    def __init__(self, number=None, mode="before", report=None):
        self.number, self.mode, self.report, self.count = number, mode, report, 0

    def do(self, function, data=None):
        """Call ``function(data)``, or ``function()`` without data, and die where it was chosen."""
        self.count += 1
        if self.count != self.number:
            return function() if data is None else function(data)
        if self.mode == "within" and data is not None:
            function(bytes(data)[: len(data) // 2])
        elif self.mode == "after":
            function() if data is None else function(data)
        names, frame = [], sys._getframe()
        while frame is not None:
            names.append(frame.f_code.co_name)
            frame = frame.f_back
        window = next((WINDOWS[name] for name in names if name in WINDOWS), "close of the file")
        os.write(self.report, window.encode())
        os.kill(os.getpid(), signal.SIGKILL)

    def install(self):
        """Count the writes of this process from now on."""
        plain_open, File, replace, unlink = open, h5py.File, os.replace, os.unlink
        pwrite, write_bytes = os.pwrite, Path.write_bytes
        counted = self

        class Counted:
            """A file whose writes are counted."""

            def __init__(self, file):
                self._file = file

            def __getattr__(self, name):
                return getattr(self._file, name)

            def write(self, data):
                return counted.do(self._file.write, bytes(data))

            def truncate(self, *size):
                return counted.do(lambda: self._file.truncate(*size))

        class CountedFile(File):
            """An HDF5 file that HDF5 reads and writes through a counted file."""

            def __init__(self, name, mode="r", **kwargs):
                if mode == "r+":
                    name = Counted(name)
                super().__init__(name, mode, **kwargs)

        h5py.File = CountedFile
        journal_module.open = lambda *args, **kwargs: Counted(plain_open(*args, **kwargs))
        os.replace = lambda *args: self.do(lambda: replace(*args))
        os.unlink = lambda *args: self.do(lambda: unlink(*args))
        os.pwrite = lambda file, data, place: self.do(lambda part: pwrite(file, part, place), data)
        Path.write_bytes = lambda path, data: self.do(lambda part: write_bytes(path, part), data)


# ---------------------------------------------------------------------- runs


class Outcome(NamedTuple):
    """What a run ended with, to be compared with another one."""

    chain: tuple
    ladder: tuple
    counts: tuple
    failures: tuple
    adds: str


def outcome(script, path):
    """Run a script to its end, and once more."""
    sampler = script(path)
    chain = [sampler.get_chain(), sampler.get_log_prob(), sampler.get_blobs(), sampler.backend.accepted]
    chain.append(sampler.random_state[1])
    stages = [stage._replace(seconds=0) for stage in sampler.ladder]
    ladder = tuple(repr(v) for v in (stages, sampler.log_evidence, sampler.log_evidence_error, sampler.verdict))
    failures = tuple((f["parameters"].tobytes(), f["reason"]) for f in sampler.failures)
    counts = sampler.evaluations, sampler.simulations, sampler.failure_count
    sampler.backend.close()
    before = sampler.iteration, sampler.backend.journal_path.read_bytes().count(b"EVAL")
    again = script(path)
    after = again.iteration, again.backend.journal_path.read_bytes().count(b"EVAL")
    adds = "" if before == after else f"{before} became {after}"
    return Outcome(tuple(values.tobytes() for values in chain), ladder, counts, failures, adds)


def fork(function):
    """Exit status and what a function returned or wrote, run in a forked process."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = 1
        with contextlib.suppress(BaseException):
            os.close(read)
            warnings.simplefilter("ignore")
            logging.disable(logging.CRITICAL)
            try:
                data = function(write) or b""
                while data:
                    data = data[os.write(write, data) :]
                status = 0
            except BaseException:
                os.write(write, traceback.format_exc().encode()[-1500:])
        os._exit(status)
    os.close(write)
    with os.fdopen(read, "rb") as stream:
        said = stream.read()
    return os.waitpid(pid, 0)[1], said


def run_killed(script, path, number, mode):
    """Run a script that is killed at a write: the window, or None if it ended before."""

    def child(report):
        Writes(number, mode, report).install()
        script(path)

    status, said = fork(child)
    if os.WIFSIGNALED(status):
        return said.decode()
    if status != 0:
        raise RuntimeError(said.decode())
    return None


def count_writes(script, path):
    """Number of writes of a script that is not killed."""

    def child(_):
        writes = Writes()
        writes.install()
        script(path)
        return str(writes.count).encode()

    status, said = fork(child)
    assert status == 0, said.decode()
    return int(said)


def kill(number_of_kills, seed=1, show=None):
    """Make kills and compare the outcomes.

    Parameters
    ----------
    number_of_kills : int
        At least so many; first one at every write of every script, in all modes, then two or three per run at random.
    seed : int
        Of the choice.
    show : callable, optional
        Called with a line of progress.

    Returns
    -------
    kills : Counter
        Number of kills by window.
    bad : Counter
        What went wrong, by "could not go on", "failures lost", "chains wrong", "counts wrong", "added when repeated".
    messages : list of str
        The first lines of what went wrong.
    """
    choose, kills, bad, messages = random.Random(seed), Counter(), Counter(), []
    folder = Path(tempfile.mkdtemp(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    try:
        whole, writes = {}, {}
        for script in SCRIPTS:
            status, said = fork(lambda _, s=script: pickle.dumps(outcome(s, folder / f"whole_{s.__name__}.h5")))
            assert status == 0, said.decode()
            whole[script] = pickle.loads(said)
            assert not whole[script].adds, (script.__name__, whole[script].adds)
            writes[script] = count_writes(script, folder / f"counted_{script.__name__}.h5")
        every = [(script, n, mode) for script in SCRIPTS for n in range(1, writes[script] + 1) for mode in MODES]
        choose.shuffle(every)
        plans = [(script, [(n, mode)]) for script, n, mode in every]
        for plan in itertools.chain(plans, iter(lambda: None, 0)):
            if sum(kills.values()) >= number_of_kills:
                break
            if plan is None:
                script = choose.choice(SCRIPTS)
                places = [choose.randint(1, writes[script]) for _ in range(choose.choice((2, 3)))]
                plan = script, [(place, choose.choice(MODES)) for place in places]
            known = len(messages)
            trial(plan, folder / "trial", whole, kills, bad, messages)
            if show is not None:
                for message in messages[known:]:
                    show(message)
                if sum(kills.values()) % 200 == 0:
                    show(f"{sum(kills.values())} kills, wrong: {dict(bad)}")
    finally:
        shutil.rmtree(folder)
    return kills, bad, messages


def trial(plan, folder, whole, kills, bad, messages):
    """One run with its kills."""
    script, places = plan
    folder.mkdir()
    path, windows = folder / "run.h5", []
    try:
        for number, mode in places:
            window = run_killed(script, path, number, mode)
            if window is None:
                break
            windows.append(f"{window}, {mode}")
            kills[window] += 1
        status, said = fork(lambda _: pickle.dumps(outcome(script, path)))
        if status != 0:
            raise RuntimeError(said.decode())
    except RuntimeError as error:
        bad["could not go on"] += 1
        messages.append(f"{script.__name__}, {windows}: {error}")
    else:
        found, right = pickle.loads(said), whole[script]
        wrong = {
            "chains wrong": found.chain != right.chain or found.ladder != right.ladder,
            "failures lost": found.failures != right.failures,
            "counts wrong": found.counts != right.counts,
            "added when repeated": bool(found.adds),
        }
        bad.update(name for name, is_wrong in wrong.items() if is_wrong)
        if any(wrong.values()):
            messages.append(
                f"{script.__name__}, {places}, {windows}: {[n for n, w in wrong.items() if w]} {found.adds}"
            )
    finally:
        shutil.rmtree(folder)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    start = time.perf_counter()
    kills, bad, _ = kill(args.kills, args.seed, print)
    for window, count in sorted(kills.items()):
        print(f"{window:32s}{count:6d}")
    print(f"{'kills':32s}{sum(kills.values()):6d}   in {time.perf_counter() - start:.0f} s")
    for name in ("could not go on", "failures lost", "chains wrong", "counts wrong", "added when repeated"):
        print(f"{name:32s}{bad[name]:6d}")
    return 1 if bad else 0


if __name__ == "__main__":
    raise SystemExit(main())
