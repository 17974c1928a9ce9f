"""Process that runs programs one after the other, and kills all processes that a program leaves behind.

On Linux the supervisor is a subreaper (``PR_SET_CHILD_SUBREAPER``): a process whose parent has ended becomes its child,
whatever session, group or environment it has, so that its descendants are exactly the program and the processes that it
started. On other systems, the program's process group is killed. All are also killed, and the folder of the run is
removed, at SIGTERM and when standard input closes, as it does when the process that started the supervisor dies. This
file imports the standard library only, so that it can be run alone and starts quickly.
"""

import ctypes
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress

__all__ = ["main"]

_PR_SET_CHILD_SUBREAPER = 36
_KILL_SECONDS = 10.0  # until processes that cannot be killed are given up


class _Program:
    """The running program, if there is one, and everything that it started."""

    def __init__(self) -> None:
        self.adopts = sys.platform == "linux" and not ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self.process: subprocess.Popen | None = None
        self.exit_code: int | None = None
        self.place = ""  # folder of the run

    def start(
        self, command: list[str], environment: dict[str, str], folder: str, stdout: str, stderr: str, place: str
    ) -> None:
        self.exit_code, self.place = None, place
        with open(stdout, "wb") as out, open(stderr, "wb") as error:
            self.process = subprocess.Popen(
                command,
                env=environment,
                cwd=folder,
                stdin=subprocess.DEVNULL,
                stdout=out,
                stderr=error,
                start_new_session=True,
            )

    def reap(self) -> bool:
        """Collect the exit status of children that have ended; returns whether other children are left."""
        try:
            while True:
                pid, status = os.waitpid(-1, os.WNOHANG)
                if pid == 0:
                    return True
                if self.process is not None and pid == self.process.pid:
                    self.exit_code = self.process.returncode = os.waitstatus_to_exitcode(status)
        except ChildProcessError:
            return False

    def kill(self) -> None:
        """Kill the program and everything that it started."""
        if self.process is not None and not self.adopts:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.process.pid, signal.SIGKILL)
        give_up = time.monotonic() + _KILL_SECONDS
        while self.reap() and time.monotonic() < give_up:
            for pid in _descendants() if self.adopts else [self.process.pid]:
                with suppress(ProcessLookupError, PermissionError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.001)
        self.process = None


def _descendants() -> list[int]:
    """Process ids of this process's descendants, from /proc."""
    parents = {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:
            parents[int(name)] = int(file.read().rpartition(b")")[2].split()[1])
    found, new = [], [os.getpid()]
    while new:
        new = [pid for pid, parent in parents.items() if parent in new]
        found += new
    return found


def main() -> None:
    """Read requests, one line of JSON each, and answer each with one line, until standard input closes.

    A request with the arguments of `_Program.start` runs a program; the answer is ``{"exit_code": int}`` at its end, or
    ``{"errno": int, "error": str}`` if it cannot be started. The request null kills the program, if there is one; the
    answer is ``{"stopped": true}``.
    """
    program = _Program()
    ended, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.set_wakeup_fd(wake)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    terminated: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, _: terminated.append(number))  # an exception could interrupt `kill`
    text = b""
    try:
        while True:
            ready, _, _ = select.select([0, ended], [], [])
            if ended in ready:
                os.read(ended, 4096)
            if terminated:
                return
            if 0 in ready:
                received = os.read(0, 2**20)
                if not received:
                    return
                text += received
                if text.endswith(b"\n"):
                    request, text = json.loads(text), b""
                    if request is None:
                        program.kill()
                        program.exit_code = None
                        _answer(stopped=True)
                    else:
                        try:
                            program.start(**request)
                        except OSError as error:
                            _answer(errno=error.errno, error=f"{error.strerror}: {error.filename}")
            program.reap()
            if program.exit_code is not None:
                program.kill()
                _answer(exit_code=program.exit_code)
                program.exit_code = None
    finally:
        program.kill()
        if program.place:
            shutil.rmtree(program.place, ignore_errors=True)


def _answer(**values: object) -> None:
    with suppress(BrokenPipeError):  # standard input is closed as well
        os.write(1, json.dumps(values).encode() + b"\n")


if __name__ == "__main__":
    main()
