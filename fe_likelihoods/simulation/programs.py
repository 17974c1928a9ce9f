"""Programs that run under a supervisor, which kills all processes that they leave behind.

See `fe_likelihoods.simulation.program_supervisor`. A supervisor runs one program at a time and is kept for the next
program, since its start takes about 50 ms.
"""

import json
import os
import subprocess
import sys
import time
import weakref
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from multiprocessing.connection import wait
from pathlib import Path

from . import program_supervisor
from .faults import RunFailed, TransientReason
from .shared_files import of_this_library

__all__ = ["run_program"]

_MOST_IDLE = 16  # supervisors that are kept
_STOP_SECONDS = 15.0  # longer than a supervisor tries to kill a program
_idle: "list[_Supervisor]" = []


class _Supervisor:
    """A supervisor process, seen from the process that uses it."""

    def __init__(self) -> None:
        with of_this_library():
            self._process = subprocess.Popen(
                [sys.executable, "-I", "-S", program_supervisor.__file__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
                bufsize=0,
                cwd="/",
            )
        self._owner = os.getpid()
        self._end = weakref.finalize(self, _end, self._process, self._owner)

    @property
    def alive(self) -> bool:
        """Whether the supervisor runs and is a child of this process (not of a process this one was forked from)."""
        return self._owner == os.getpid() and self._process.poll() is None

    def send(self, request: dict | None) -> None:
        """Send a request, as `program_supervisor.main` describes it."""
        with suppress(OSError):  # `receive` reports that the supervisor has died
            self._process.stdin.write(json.dumps(request).encode() + b"\n")

    def receive(self, seconds: float) -> dict:
        """Next answer, empty if there is none within `seconds`; RunFailed if the supervisor has died."""
        if not wait([self._process.stdout], seconds):
            return {}
        line = self._process.stdout.readline()
        if not line.endswith(b"\n"):
            self.kill()
            raise RunFailed(TransientReason("the supervisor of the program died"))
        return json.loads(line)

    def stop(self) -> None:
        """Kill the program and everything that it has started."""
        self.send(None)
        with suppress(RunFailed):
            # if the program has just ended by itself, this is answered first
            while answer := self.receive(_STOP_SECONDS):
                if "stopped" in answer:
                    return
            self.kill()

    def kill(self) -> None:
        """End the supervisor as well."""
        self._end()


def run_program(
    command: Sequence[str],
    environment: Mapping[str, str],
    folder: Path,
    stdout: Path,
    stderr: Path,
    place: Path,
    watch: Callable[[float], float],
) -> int:
    """Run a program to its end, kill all processes that it leaves behind, and return its exit code, as in `subprocess`.

    The command has an absolute path; no shell is used, standard input is empty, and `environment` has all variables.
    `place` is the folder of the run, which is removed if this process is killed. `watch` is called with the time since
    the start [s] and returns the time until the next call [s], or raises an exception, which stops the program and is
    passed on. OSError if the program cannot be started, RunFailed if the supervisor dies.
    """
    paths = {"folder": str(folder), "stdout": str(stdout), "stderr": str(stderr), "place": str(place)}
    keeper, answer = _take(), {}
    try:
        keeper.send({"command": list(command), "environment": dict(environment), **paths})
        start = time.monotonic()
        while not answer:
            answer = keeper.receive(watch(time.monotonic() - start))
        if "error" in answer:
            raise OSError(answer["errno"], answer["error"])
        return answer["exit_code"]
    finally:
        if not answer and keeper.alive:
            keeper.stop()
        if keeper.alive and len(_idle) < _MOST_IDLE:
            _idle.append(keeper)
        else:
            keeper.kill()


def _end(process: subprocess.Popen, owner: int) -> None:
    """End a supervisor, which kills its program when its standard input closes."""
    process.stdin.close()
    process.stdout.close()
    if owner != os.getpid():  # a forked copy
        return
    try:
        process.wait(_STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)  # they belong to the parent


def _take() -> _Supervisor:
    while True:
        try:
            keeper = _idle.pop()
        except IndexError:
            return _Supervisor()
        if keeper.alive:
            return keeper
