"""Ctrl-C at every line: what the same call, and the same script, make of it.

``python -m tests.faults.interrupted`` raises KeyboardInterrupt at every line of `samplers` that a call of a script
executes, one after another, makes the same call again, and then starts the same script again.
"""

import argparse
import shutil
import signal
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path

import emcee

import samplers
from samplers import SMCSampler
from tests.contract.targets import WithBlobs

FOLDER = str(Path(samplers.__file__).parent)
CALLS = (2, 3)


def make(path, **changes):
    """A small sampler with a file."""
    backend = emcee.backends.HDFBackend(str(path))
    settings = {"seed": 5, "min_moves": 1, "max_moves": 1, "check_draws": 3, "recycle": False, **changes}
    return SMCSampler(6, 1, WithBlobs(ndim=1, sd=0.2), vectorize=True, backend=backend, **settings)


def state_of(sampler):
    """What must be equal to the last bit."""
    return sampler.get_chain().tobytes(), sampler.get_blobs().tobytes(), sampler.backend.accepted.tobytes()


class Interrupt:
    """Raises KeyboardInterrupt at a line of `samplers`, counted from the start."""

    def __init__(self, line=None):
        self.line, self.count, self.place = line, 0, ""
        self.handler = signal.getsignal(signal.SIGINT)

    def __enter__(self):
        sys.settrace(self._enter)
        return self

    def __exit__(self, *error):
        sys.settrace(None)

    def _enter(self, frame, event, value):
        return self._trace if frame.f_code.co_filename.startswith(FOLDER) else None

    def _trace(self, frame, event, value):
        if event == "line" and signal.getsignal(signal.SIGINT) is self.handler:  # otherwise Ctrl-C is deferred
            self.count += 1
            if self.count == self.line:
                self.place = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
                sys.settrace(None)
                raise KeyboardInterrupt
        return self._trace


def trial(folder, line, expected):
    """Interrupt the second call of the script at a line; what is wrong afterwards, and where it was."""
    path = folder / "run.h5"
    for name in folder.glob("run.h5*"):
        name.unlink()
    for name in folder.glob("first.h5*"):
        shutil.copy(name, folder / name.name.replace("first", "run"))
    sampler = make(path)
    sampler.run_mcmc(None, CALLS[0])
    interrupt = Interrupt(line)
    try:
        with interrupt:
            sampler.run_mcmc(None, CALLS[1])
        return "", interrupt.count if line is None else None
    except KeyboardInterrupt:
        pass
    wrong = []
    try:
        sampler.run_mcmc(None, CALLS[1])
        if state_of(sampler) != expected:
            wrong.append(f"the same call: {sampler.iteration} steps")
        sampler.backend.close()
    except Exception as error:
        wrong.append(f"the same call: {type(error).__name__}: {error}")
    try:
        again = make(path)
        for steps in CALLS:
            again.run_mcmc(None, steps)
        if state_of(again) != expected:
            wrong.append(f"the same script: {again.iteration} steps")
        again.backend.close()
    except Exception as error:
        wrong.append(f"the same script: {type(error).__name__}: {error}")
    return "; ".join(wrong), interrupt.place


def interrupt_lines(folder, stride=1, first=1):
    """Interrupt every `stride`-th line.

    Returns
    -------
    count : int
        Number of interrupts.
    wrong : list of str
        Where something was wrong afterwards, and what.
    """
    whole = make(folder / "first.h5")
    whole.run_mcmc(None, CALLS[0])
    whole.backend.close()
    for name in list(folder.glob("first.h5*")):
        shutil.copy(name, folder / name.name.replace("first", "whole"))
    whole = make(folder / "whole.h5")
    for steps in CALLS:
        whole.run_mcmc(None, steps)
    expected = state_of(whole)
    whole.backend.close()
    _, lines = trial(folder, None, expected)
    count, wrong = 0, []
    for line in range(first, lines + 1, stride):
        what, place = trial(folder, line, expected)
        if place is None:
            continue
        count += 1
        if what:
            wrong.append(f"{place} (line {line} of {lines}): {what}")
    return count, wrong


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--stride", type=int, default=1)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    start = time.perf_counter()
    folder = Path(tempfile.mkdtemp())
    try:
        count, wrong = interrupt_lines(folder, args.stride)
    finally:
        shutil.rmtree(folder)
    for message, number in Counter(wrong).items():
        print(number, message)
    print(f"{count} interrupts, {len(wrong)} wrong, in {time.perf_counter() - start:.0f} s")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
