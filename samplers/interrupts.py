"""Ctrl-C and SystemExit end a run, and no point that they have interrupted is stored."""

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

logger = logging.getLogger(__name__)

_EXIT = (
    "SystemExit ends the run, and nothing is stored for this evaluation. If a function or model calls sys.exit where "
    "it fails, raise an exception there instead (SimulationFailed), or run it in other processes (pool=2, or "
    "isolated=True for a model): there SystemExit is a failure"
)
_names: dict[int, bytes] = {}


class _RaisesKeyboardInterrupt(NamedTuple):
    """Handler of SIGINT that calls another one, and raises KeyboardInterrupt in place of what that one raises."""

    handler: Callable[..., Any]

    def __call__(self, *arguments: Any) -> None:
        global _interrupts
        try:
            self.handler(*arguments)
        except BaseException as error:
            _interrupts += 1
            if isinstance(error, KeyboardInterrupt):
                raise
            raise KeyboardInterrupt from error


_interrupts = 0


def interrupts() -> int:
    """How often Ctrl-C has interrupted this process in `interrupts_end_the_run`."""
    return _interrupts


def raise_if_interrupted(before: int) -> None:
    """Raise KeyboardInterrupt if there were more `interrupts` than `before`: a bare ``except`` may have caught it."""
    if _interrupts != before:
        raise KeyboardInterrupt


@contextlib.contextmanager
def interrupts_end_the_run() -> Iterator[None]:
    """Context in which Ctrl-C raises KeyboardInterrupt in the main thread, whichever handler of SIGINT is set. A
    handler that raises something else, as `dask_jobqueue` sets one, is called; one that returns has dealt with Ctrl-C.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_ours = isinstance(handler, _RaisesKeyboardInterrupt)
    if threading.current_thread() is not threading.main_thread() or not callable(handler) or is_ours:
        yield
        return
    ours = _RaisesKeyboardInterrupt(handler)
    try:
        signal.signal(signal.SIGINT, ours)
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is ours:  # else the user's code has set another one meanwhile
            signal.signal(signal.SIGINT, handler)


@contextlib.contextmanager
def deferred_interrupts() -> Iterator[None]:
    """Context in which Ctrl-C takes effect at the end, so that a file and the memory of this process agree."""
    handler = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(handler):
        yield
        return
    received: list[tuple] = []
    signal.signal(signal.SIGINT, lambda *arguments: received.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if received:
            handler(*received[0])


def raise_if_it_ends_the_run(error: BaseException, before: BaseException | None = None) -> None:
    """Raise what must not become a failed evaluation: an error with ``ends_run``, KeyboardInterrupt and, but for
    workers, SystemExit, even as cause or context of `error`. What was handled `before` (``sys.exception()`` at the call
    of the function) is no cause.
    """
    if getattr(error, "ends_run", False):
        raise error
    causes = _causes(error, before)
    for kind in (KeyboardInterrupt,) if is_worker() else (KeyboardInterrupt, SystemExit):
        for cause in causes:
            if isinstance(cause, kind):
                if isinstance(cause, SystemExit) and _EXIT not in getattr(cause, "__notes__", ()):
                    cause.add_note(_EXIT)
                    logger.warning(_EXIT)
                raise cause


def _causes(error: BaseException, before: BaseException | None) -> list[BaseException]:
    """An exception with its causes and contexts, apart from what was handled `before`."""
    found: list[BaseException] = []
    left = [error]
    while left:
        each = left.pop()
        if each is not before and all(each is not other for other in found):
            found.append(each)
            left += [other for other in (each.__cause__, each.__context__) if other is not None]
    return found


_is_worker = False


def become_worker() -> None:
    """Note that this process runs functions of another process."""
    global _is_worker
    _is_worker = True


def is_worker() -> bool:
    """Whether this process runs functions of another process, or `multiprocessing` has started it.

    It also starts the workers of other samplers, whose pools wait for ever where a worker ends.
    """
    return _is_worker or multiprocessing.parent_process() is not None


def process_name() -> bytes:
    """Random name of this process; a forked process has a different name."""
    return _names.setdefault(os.getpid(), os.urandom(16))


class Ended(NamedTuple):
    """Value of a function that was ended by KeyboardInterrupt or SystemExit in a pool: raised in the main thread."""

    error: BaseException


class SentFunction:
    """A function for a pool, which returns KeyboardInterrupt and SystemExit as `Ended`: raised, they would end threads
    and processes of `multiprocessing.pool` and workers of dask, and their point would be waited for.
    """

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self.function, self.sender = function, process_name()

    def __call__(self, item: Any) -> Any:
        if self.sender != process_name():
            become_worker()
        try:
            with interrupts_end_the_run():
                return self.function(item)
        except (KeyboardInterrupt, SystemExit) as error:
            if is_worker() and isinstance(error, SystemExit):
                raise RuntimeError(f"SystemExit: {error}") from None
            return Ended(error)
