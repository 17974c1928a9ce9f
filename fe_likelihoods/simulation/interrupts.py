"""Ctrl-C and SystemExit in a simulation: neither is a failed simulation, except for SystemExit in a worker process."""

import logging

from samplers import interrupts

from .faults import UnusableModel

__all__ = ["raise_if_it_ends_the_run"]

logger = logging.getLogger(__name__)

_EXIT = (
    "SystemExit in a simulation ends the run, and nothing is stored for this simulation. If the model calls sys.exit "
    "where it fails, raise SimulationFailed instead, or run it in other processes (isolated=True, pool=2): there "
    "SystemExit is a failed simulation"
)


def raise_if_it_ends_the_run(error: BaseException, before: BaseException | None = None) -> None:
    """Raise exceptions that must not become a failed simulation: `UnusableModel`, KeyboardInterrupt and SystemExit.

    Arguments and causes as for `samplers.interrupts.raise_if_it_ends_the_run`.
    """
    if isinstance(error, UnusableModel):
        raise error
    try:
        interrupts.raise_if_it_ends_the_run(error, before)
    except SystemExit as end:
        if _EXIT not in getattr(end, "__notes__", ()):
            end.add_note(_EXIT)
            logger.warning(_EXIT)
        raise
