"""Kills by signal 9, after which the same script is started again until it ends: ``python -m tests.faults.kills 12 7``.

Kills come before, within or after a write to the record or to the HDF5 file (through a Python file), or in an
evaluation. The outcome must equal a run without kills, and only evaluations that were running are made again.
"""

import contextlib
import io
import logging
import os
import pickle
import random
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import h5py

import samplers.chain
import samplers.evaluation.evaluator
import samplers.record
from tests.faults.resumable_run import BURN_IN, KINDS, STEPS, N, calls, go_on, make, outcome

COMPARED = 2  # points by which a new sampler compares its function with the record


class Events:
    """Counts the writes and evaluations of a process, and kills it at one of them."""

    def __init__(self, at=None, mode="before"):
        self.at, self.mode, self.count = at, mode, 0

    def __call__(self, function=None, data=None):
        """Do ``function(data)``, and die where it was chosen."""
        self.count += 1
        arguments = () if data is None else (data,)
        if self.count != self.at:
            return None if function is None else function(*arguments)
        if function is not None and self.mode == "within" and data is not None:
            function(data[: len(data) // 2])
        elif function is not None and self.mode == "after":
            function(*arguments)
        os.kill(os.getpid(), signal.SIGKILL)

    def install(self):
        """Count the writes of this process from now on."""
        events, plain_open, File, replace = self, open, h5py.File, os.replace

        class Counted(io.RawIOBase):
            """A file whose writes are counted."""

            def __init__(self, file):
                self._file = file

            def __getattribute__(self, name):
                if name in ("write", "truncate", "_file"):
                    return object.__getattribute__(self, name)
                return getattr(self._file, name)

            def write(self, data):
                return events(self._file.write, bytes(data))

            def truncate(self, *size):
                return events(lambda: self._file.truncate(*size))

        class CountedFile(File):
            """An HDF5 file that is written through a counted file."""

            def __init__(self, name, mode="r", **kwargs):
                if isinstance(name, str | Path) and mode != "r":
                    kept = mode in ("a", "r+") and Path(name).exists()
                    name, mode = Counted(plain_open(name, "r+b" if kept else "w+b", buffering=0)), "r+" if kept else "w"
                super().__init__(name, mode, **kwargs)

        h5py.File = CountedFile
        samplers.record.open = samplers.chain.open = lambda *args, **kwargs: Counted(plain_open(*args, **kwargs))
        os.replace = lambda *args: self(lambda: replace(*args))


def fork(function):
    """Exit status, and what a function returned or wrote, in a forked process that leads its own group."""
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        status = 1
        with contextlib.suppress(BaseException):
            os.setsid()
            os.close(read)
            warnings.simplefilter("ignore")
            logging.disable(logging.CRITICAL)
            try:
                data = function() or b""
                while data:
                    data = data[os.write(write, data) :]
                status = 0
            except BaseException:
                os.write(write, traceback.format_exc().encode()[-1500:])
        os._exit(status)
    os.close(write)
    return pid, read


def end(pid, read):
    """Status and output of a forked process."""
    with os.fdopen(read, "rb") as stream:
        said = stream.read()
    status = os.waitpid(pid, 0)[1]
    return status, said


def script(kind, path, events=None, limit=None):
    """The script that is killed; returns its outcome."""
    samplers.evaluation.evaluator.SECONDS_BETWEEN_NOTES = 0.0  # so that no time of the machine decides
    log = path.with_name("log")
    changes = {} if kind != "limit" else {"max_simulations": limit}
    sampler = go_on(make(path, kind, log=log, event=events, **changes), kind)
    return pickle.dumps((outcome(sampler), sampler.iteration))


def whole_outcomes(kind, folder):
    """Outcomes of runs that are not killed, and the number of events."""
    events = Events()

    def counted():
        events.install()
        return pickle.dumps((script(kind, folder / "run.h5", events), events.count))

    folder.mkdir()
    status, said = end(*fork(counted))
    assert status == 0, said.decode()
    first, count = pickle.loads(said)
    found = [pickle.loads(first)[0]]
    if kind == "reset":
        # a kill in the burn-in is taken for one after the reset, and one directly after the reset repeats the burn-in
        found.append(pickle.loads(end(*fork(lambda: script("moves", folder / "moves.h5")))[1])[0])
        for repeated in (2, 3, 4):

            def longer(times=repeated):
                sampler = make(folder / f"{times}.h5", kind)
                sampler.run_mcmc(None, times * BURN_IN)
                sampler.reset()
                sampler.run_mcmc(None, STEPS)
                return pickle.dumps(outcome(sampler))

            found.append(pickle.loads(end(*fork(longer))[1]))
    return found, count


def evaluated_again(log, kind=""):
    """Points that were evaluated again although they were known: each process may repeat what ran, and compare."""
    by_process: dict[int, list[list[bytes]]] = {}
    for process, points in calls(log):
        by_process.setdefault(process, []).append(points)
    seen, running, lost = set(), set(), 0
    for made in by_process.values():
        points = {point for call in made for point in call}
        lost += max(len((points & seen) - running) - COMPARED, 0)
        # all points of a submission, or those that have ended while the sampler computed proposals
        last = {"asynchronous": 4 * N, "map": 8}.get(kind, 1)
        running |= {point for call in made[-last:] for point in call}
        seen |= points
    return lost


def trial(kind, folder, whole, count, choose, number):
    """One run with its kills: how many there were, and what went wrong."""
    folder.mkdir()
    path, kills = folder / "run.h5", 0
    limits = [choose.randint(20, 400) for _ in range(number)]
    for attempt in range(number):
        events = Events(choose.randint(1, max(count, 1)), choose.choice(("before", "within", "after")))

        def child(events=events, attempt=attempt):
            events.install()
            return script(kind, path, events, sorted(limits)[attempt])

        status, said = end(*fork(child))
        if os.WIFSIGNALED(status):
            kills += 1
        elif status != 0:
            return kills, f"stuck: {said.decode()}"
    status, said = end(*fork(lambda: script(kind, path)))
    if status != 0:
        return kills, f"stuck: {said.decode()}"
    found, steps = pickle.loads(said)
    if lost := evaluated_again(folder / "log", kind):
        return kills, f"lost: {lost} evaluations were made again"
    if kind == "reset":  # evaluations of a burn-in that was given up count, and so in the verdict
        found, whole = found[:5], [each[:5] for each in whole]
    if found not in whole:
        places = [place for place, (one, other) in enumerate(zip(found, whole[0], strict=True)) if one != other]
        return kills, f"wrong: {steps} steps, parts {places} of the outcome differ"
    return kills, ""


def kill(number, kind, seed):
    """Make kills of a kind of run; returns how many there were, and messages of what went wrong."""
    choose, made, messages = random.Random(seed), 0, []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None) as folder:
        whole, count = whole_outcomes(kind, Path(folder, "whole"))
        while made < number and len(messages) < number:
            where = Path(folder, "trial")
            kills, wrong = trial(kind, where, whole, count, choose, choose.randint(1, 3))
            made += kills
            messages += [wrong] * bool(wrong)
            shutil.rmtree(where)
    return made, messages


if __name__ == "__main__":  # kills of each kind of run, and a seed
    results = {each: kill(int(sys.argv[1]), each, int(sys.argv[2])) for each in KINDS}
    for each, (made, messages) in results.items():
        print(f"{each}: {made} kills", *messages, sep="\n    ")
    raise SystemExit(any(messages for _, messages in results.values()))
