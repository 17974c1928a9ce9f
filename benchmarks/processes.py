"""A function in a process of its own, ended after a time limit."""

import multiprocessing
from collections.abc import Callable
from typing import Any

__all__ = ["in_process"]


def _send(function: Callable, arguments: tuple, sender: Any) -> None:
    try:
        answer = function(*arguments)
    except Exception as error:  # whatever another program raises is reported in its row
        answer = {"reason": f"failed: {type(error).__name__}: {(str(error).splitlines() or [''])[0][:120]}"}
    sender.send(answer)


def in_process(function: Callable, *arguments: Any, limit: float) -> Any:
    """Result of a function of a module, or ``{"reason": ...}`` if it raised, died or took longer than `limit` seconds.

    Imports and compilation are part of the time.
    """
    context = multiprocessing.get_context("spawn")  # a fork would inherit numba's threads
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_send, args=(function, arguments, sender))
    process.start()
    sender.close()  # only the child holds this end: the wait ends when the child dies
    try:
        answer = receiver.recv() if receiver.poll(limit) else {"reason": f"stopped at {limit:.0f} s"}
    except EOFError:
        process.join()
        answer = {"reason": f"ended without a result, exit code {process.exitcode}"}
    process.kill()
    process.join()
    return answer
