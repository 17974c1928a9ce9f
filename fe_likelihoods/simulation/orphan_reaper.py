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
from contextlib import suppress

__all__ = ["kill_tree", "main"]


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

    A message is a line of JSON: ``["group", id, mark]`` or ``["folder", path]`` for a new one, ``["gone", id or path]``
    for one that has ended.
    """
    groups: dict[int, str] = {}
    folders: set[str] = set()
    for line in sys.stdin:
        kind, what, *mark = json.loads(line)
        if kind == "group":
            groups[what] = mark[0]
        elif kind == "folder":
            folders.add(what)
        else:
            groups.pop(what, None)
            folders.discard(what)
    for group, mark in groups.items():
        kill_tree(group, mark)
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
