"""No process, and no temporary folder, outlives those who need it.

A process that is killed by -9 cannot clean up, and what it had started goes on for ever. So every process that starts
others keeps one minder beside it: a small interpreter that runs this file, is told each process group that is started
and each that has ended, and kills what is left when its pipe closes, whatever the reason. With temporary folders it is
the same. A thread inside the workers could do so only as long as their simulation lets other threads run, which
compiled code often does not.

What a group has started is found by two marks: its process group, which children inherit, and a variable of the
environment with a random name, which also those inherit that open a session of their own (a program that puts itself
into the background). The second needs ``/proc``; on other systems such programs are not found.

This file imports the standard library only, so that it can be run alone and starts in no time.
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
    """Kill a process group and all processes whose environment has the variable `mark`, this process excepted.

    Parameters
    ----------
    group : int
        Process group, whose leader must not have been waited for (its number could be another's by now).
    mark : str
        Name of the variable; empty for the group alone.
    """
    with suppress(ProcessLookupError, PermissionError):
        os.killpg(group, signal.SIGKILL)
    if not mark or not os.path.isdir("/proc/self"):
        return
    wanted = mark.encode() + b"="
    for _ in range(100):  # one of them may start another while the list is read, and dying takes a moment
        found = False
        for name in filter(str.isdigit, os.listdir("/proc")):
            if int(name) == os.getpid():
                continue
            with suppress(OSError):
                with open(f"/proc/{name}/environ", "rb") as file:
                    environment = file.read()
                # the environment of what is dead is empty
                if environment.startswith(wanted) or b"\0" + wanted in environment:
                    os.kill(int(name), signal.SIGKILL)
                    found = True
        if not found:
            return
        time.sleep(0.01)


def main() -> None:
    """Read lines of JSON until the pipe closes, then kill and remove what is left.

    ``["group", number, mark]`` and ``["folder", path]`` say what there is, ``["gone", number or path]`` what is not.
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
