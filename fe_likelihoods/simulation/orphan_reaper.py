"""Kills processes and removes temporary folders whose owner has died.

A process that is killed with SIGKILL cannot clean up, and the processes it had started would run on. Therefore every
process that starts others keeps one reaper: a small interpreter that runs this file. The reaper receives a message for
each process group that is started or has ended. When its pipe closes, for whatever reason, it kills the groups that are
left. Temporary folders are handled in the same way. A thread inside the workers would not be enough, because it runs
only while the simulation lets other threads run, which compiled code often does not.

The descendants of a process are found by two marks: its process group, which children inherit, and an environment
variable with a random name, which is also inherited by children in a session of their own (such as a program that moves
to the background). The second mark needs ``/proc``; on other systems such programs are not found.

This file imports the standard library only, so that it can be run alone and starts quickly.
"""

import json
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from contextlib import suppress

__all__ = ["kill_tree", "main", "terminate"]


def terminate(pid: int, grace: float, runs: Callable[[int], bool] | None = None) -> None:
    """Send SIGTERM to a process, and wait until it has ended.

    Parameters
    ----------
    pid : int
        Process.
    grace : float
        Longest time to wait [s].
    runs : callable, optional
        Returns whether a process runs; needed for a child of this process on systems without ``/proc``.
    """
    with suppress(ProcessLookupError, PermissionError):
        os.kill(pid, signal.SIGTERM)
        give_up = time.monotonic() + grace
        while (runs or _runs)(pid) and time.monotonic() < give_up:
            time.sleep(0.002)


def _runs(pid: int) -> bool:
    """Whether a process exists and is no zombie; a zombie counts as running on systems without /proc."""
    try:
        os.kill(pid, 0)
        with open(f"/proc/{pid}/stat", "rb") as file:
            return file.read().rpartition(b")")[2].split()[0] != b"Z"
    except ProcessLookupError:
        return False
    except OSError:
        return not os.path.isdir("/proc/self")


def kill_tree(group: int, mark: str) -> None:
    """Kill a process group and all other processes whose environment has a variable, except the calling process.

    Parameters
    ----------
    group : int
        Process group. Its leader must not have been waited for, because its id could have been reused.
    mark : str
        Name of the variable; empty for the group alone.
    """
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)
    if not mark or not os.path.isdir("/proc/self"):
        return
    wanted = mark.encode() + b"="
    for _ in range(100):  # a process may start another while the list is read, and dying takes a moment
        found = False
        for name in filter(str.isdigit, os.listdir("/proc")):
            if int(name) == os.getpid():
                continue
            with suppress(OSError):
                with open(f"/proc/{name}/environ", "rb") as file:
                    environment = file.read()
                # the environment of a dead process is empty
                if environment.startswith(wanted) or b"\0" + wanted in environment:
                    os.kill(int(name), signal.SIGKILL)
                    found = True
        if not found:
            return
        time.sleep(0.01)


def main() -> None:
    """Read messages until the pipe closes, then kill the groups and remove the folders that are left.

    A message is a line of JSON: ``["group", id, mark, grace]`` or ``["folder", path]`` for a new one, ``["gone", id or
    path]`` for one that has ended. The grace is the time that a group has to end after SIGTERM [s].
    """
    groups: dict[int, list] = {}
    folders: set[str] = set()
    for line in sys.stdin:
        kind, what, *rest = json.loads(line)
        if kind == "group":
            groups[what] = rest
        elif kind == "folder":
            folders.add(what)
        else:
            groups.pop(what, None)
            folders.discard(what)
    for group, (mark, grace) in groups.items():
        if grace:
            terminate(group, grace)
        kill_tree(group, mark)
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
