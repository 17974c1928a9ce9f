"""Ctrl-C and SystemExit end a run: neither is a failed simulation, and nothing is stored for the simulation.

A model that calls ``sys.exit`` in a worker process has failed, since its worker goes on. `samplers.interrupts` has the
same rules for plain functions; the two packages do not import each other.
"""

import contextlib
import logging
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

from .faults import UnusableModel

__all__ = ["become_worker", "interrupts_end_the_run", "raise_if_it_ends_the_run"]

logger = logging.getLogger(__name__)

_is_worker = False
_EXIT = (
    "SystemExit in a simulation ends the run, and nothing is stored for this simulation. If the model calls sys.exit "
    "where it fails, raise SimulationFailed instead, or run it in other processes (isolated=True, pool=2): there "
    "SystemExit is a failed simulation"
)


class _RaisesKeyboardInterrupt:
    """Handler of SIGINT that calls another one, and raises KeyboardInterrupt in place of what that one raises."""

    def __init__(self, handler: Callable[..., Any]) -> None:
        self.handler = handler

    def __call__(self, *arguments: Any) -> None:
        try:
            self.handler(*arguments)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            raise KeyboardInterrupt from error


@contextlib.contextmanager
def interrupts_end_the_run() -> Iterator[None]:
    """Context in which Ctrl-C raises KeyboardInterrupt in the main thread, whichever handler of SIGINT is set.

    A library may have set a handler that raises something else: `dask_jobqueue` calls ``sys.exit``. In this context
    such a handler is still called, but KeyboardInterrupt is raised in place of its exception. A handler that returns
    has dealt with Ctrl-C, as one that notes it and lets the present step end: the run goes on. SIGINT that is ignored
    stays ignored. The handler that was set before is put back at the end.
    """
    handler = signal.getsignal(signal.SIGINT)
    raises = handler is signal.default_int_handler or isinstance(handler, _RaisesKeyboardInterrupt)
    if threading.current_thread() is not threading.main_thread() or not callable(handler) or raises:
        yield
        return
    ours = _RaisesKeyboardInterrupt(handler)
    signal.signal(signal.SIGINT, ours)
    try:
        yield
    finally:
        if signal.getsignal(signal.SIGINT) is ours:  # else a model has set another one meanwhile
            signal.signal(signal.SIGINT, handler)


def become_worker() -> None:
    """Note that this process runs functions of another process."""
    global _is_worker
    _is_worker = True


def raise_if_it_ends_the_run(error: BaseException, before: BaseException | None = None) -> None:
    """Raise exceptions that must not become a failed simulation: `UnusableModel`, KeyboardInterrupt and SystemExit.

    The two are also found as causes and contexts of an exception of the model. SystemExit in a worker process is a
    failed simulation. `before` is ``sys.exception()`` at the call of the model: what is handled there is the context of
    the model's errors, but no cause of them.
    """
    if isinstance(error, UnusableModel):
        raise error
    causes = _causes(error, before)
    for cause in causes:
        if isinstance(cause, KeyboardInterrupt):
            raise cause
    # multiprocessing also starts the workers of other samplers, whose pools wait for ever where a worker ends
    if _is_worker or multiprocessing.parent_process() is not None:
        return
    for cause in causes:
        if isinstance(cause, SystemExit):
            if _EXIT not in getattr(cause, "__notes__", ()):
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
