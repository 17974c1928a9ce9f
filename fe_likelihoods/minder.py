"""No process outlives those who wait for it.

A process that is killed by -9 cannot clean up, and what it had started goes on for ever. So every process that starts
others keeps one minder beside it: a small interpreter that runs this file, is told each process group that is started
and each that has ended, and kills what is left when its pipe closes, whatever the reason. A thread inside the workers
could do the same only as long as their simulation lets other threads run, which compiled code often does not.

What a group has started is found by two marks: its process group, which children inherit, and a variable of the
environment with a random name, which also those inherit that open a session of their own (a program that puts itself
into the background). The second needs ``/proc``; on other systems such programs are not found.

This file imports the standard library only, so that it can be run alone and starts in no time.
"""

import os
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
    """Read lines ``+GROUP MARK`` and ``-GROUP`` until the pipe closes, then kill the groups that have not ended."""
    groups: dict[int, str] = {}
    for line in sys.stdin:
        sign, (number, *rest) = line[0], line[1:].split()
        if sign == "+":
            groups[int(number)] = rest[0]
        else:
            groups.pop(int(number), None)
    for group, mark in groups.items():
        kill_tree(group, mark)


if __name__ == "__main__":
    main()
