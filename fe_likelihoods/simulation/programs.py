"""Programs that run in a process group of their own, which is killed with everything that they leave in it.

The first process of the group is a shell that waits for the end of its standard input, which this process holds open.
So the program is also killed, and the folder of its run removed, when this process is killed.
"""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

from .files import of_this_library

__all__ = ["removed_at_end", "run_program"]

_WATCH = 'trap "" TERM; read -r _; kill -TERM 0; rm -rf "$0" || { sleep 1; rm -rf "$0"; }; kill -KILL 0'


def removed_at_end(place: str | Path) -> subprocess.Popen:
    """A shell that leads a group of processes: it removes a folder and kills its group when its standard input closes.

    Workers and programs may still write in the folder then, so it is removed twice.
    """
    nothing = subprocess.DEVNULL
    command = ["/bin/sh", "-c", _WATCH, place]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=nothing, stderr=nothing, process_group=0)


def run_program(
    command: Sequence[str], folder: Path, stdout: Path, stderr: Path, place: Path, watch: Callable[[float], float]
) -> int:
    """Run a program to its end, kill all processes that it leaves behind, and return its exit code, as in `subprocess`.

    The command has an absolute path; no shell is used, standard input is empty.
    `place` is the folder of the run, which is removed if this process is killed. `watch` is called with the time since
    the start [s] and returns the time until the next call [s], or raises an exception, which stops the program and is
    passed on. OSError if the program cannot be started.
    """
    with of_this_library():
        watcher, program = removed_at_end(place), None
        try:
            with open(stdout, "wb") as out, open(stderr, "wb") as error:
                options = {"stdin": subprocess.DEVNULL, "stdout": out, "stderr": error, "process_group": watcher.pid}
                program = subprocess.Popen(command, cwd=folder, **options)
            start = time.monotonic()
            waiter = threading.Thread(target=program.wait, daemon=True)  # without the pauses of a wait with a limit
            waiter.start()
            while waiter.is_alive():
                waiter.join(watch(time.monotonic() - start))
            return program.returncode
        finally:
            _kill(watcher, program)


def _kill(watcher: subprocess.Popen, program: subprocess.Popen | None) -> None:
    """Kill the group of a program, and the processes that it has started in other groups and that it waits for."""
    for pid in [] if program is None or program.returncode is not None else _descendants(program.pid):
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)
    os.killpg(watcher.pid, signal.SIGKILL)
    watcher.communicate()
    if program is not None:
        program.wait()


def _descendants(pid: int) -> list[int]:
    """Process ids of a process's descendants, from /proc; none on other systems than Linux."""
    parents = {}
    for name in filter(str.isdigit, os.listdir("/proc") if os.path.isdir("/proc") else ()):
        with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    found, new = [], [pid]
    while new:
        new = [child for child, parent in parents.items() if parent in new]
        found += new
    return found
