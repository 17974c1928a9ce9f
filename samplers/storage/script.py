"""The calls of a script, matched with those in a journal, so that a script that is started again adds nothing.

A script is a sequence of calls that store steps, and of resets of the chain. When it is started again, each of its
calls is compared with the stored one at the same place. An equal call that is complete returns what it returned; an
equal call that was interrupted is completed. The first call that differs replaces the stored rest, and its steps are
added to the chain.
"""

import zlib
from typing import NamedTuple

import numpy as np

from .journal import Step

__all__ = ["Call", "Script", "digest"]


class Call(NamedTuple):
    """A call of the sampler that stores steps, or a reset of the chain.

    Attributes
    ----------
    steps : int, or None
        Number of steps that it asks for; None for a reset.
    begin : str
        Digest of the coordinates that it starts from (`digest`).
    made : int
        Number of these steps that are stored.
    complete : bool
        Whether nothing remains to be done.
    annealing : int
        How many annealings the file has had when the call began.
    last : Step, or None
        Its last stored step; None where it has none or where it is not known.
    """

    steps: int | None
    begin: str = ""
    made: int = 0
    complete: bool = False
    annealing: int = 1
    last: Step | None = None


def digest(coords: np.ndarray) -> str:
    """A short identity of coordinates (n, ndim), equal only where all bits are."""
    data = np.ascontiguousarray(coords, dtype=float).tobytes()
    return f"{zlib.crc32(data):08x}{zlib.adler32(data):08x}"


class Script:
    """The calls made so far, and how far the present script has repeated them.

    Parameters
    ----------
    calls : list of Call
        Those that are stored.

    Attributes
    ----------
    calls : list of Call
        Those that are stored, and new ones.
    position : int
        Place of the present or of the next call.
    """

    def __init__(self, calls: list[Call] | None = None):
        self.calls = list(calls or [])
        self.position = 0

    def find(self, steps: int, coords: np.ndarray | None, resumable: bool) -> Call | None:
        """The stored call that a new one repeats; None if there is none.

        Parameters
        ----------
        steps : int
            Number of steps wanted.
        coords : (n, ndim) float, optional
            Where the new call is to start; None for a call that leaves this open.
        resumable : bool
            Whether `coords` of an incomplete call are compared elsewhere.
        """
        if self.position >= len(self.calls):
            return None
        call = self.calls[self.position]
        if call.steps != steps:
            return None
        if coords is None or digest(coords) == call.begin or (resumable and not call.complete):
            return call
        goes_on = not call.complete and call.last is not None and np.array_equal(coords, call.last.coords)
        return call if goes_on else None

    def begin(self, steps: int | None, begin: str = "", annealing: int = 1) -> int:
        """Enter a new call at the present place, and return the place; a reset is complete at once."""
        del self.calls[self.position :]
        self.calls.append(Call(steps, begin, annealing=annealing, complete=steps is None))
        self.position += steps is None
        return len(self.calls) - 1

    def stepped(self, step: Step) -> None:
        """Enter a stored step of the present call."""
        if self.position < len(self.calls):
            call = self.calls[self.position]
            self.calls[self.position] = call._replace(made=call.made + 1, last=step)

    def complete(self) -> None:
        """Enter that the present call is complete."""
        if self.position < len(self.calls):
            self.calls[self.position] = self.calls[self.position]._replace(complete=True)
            self.position += 1

    def skip(self) -> None:
        """Go to the next call: the present one repeats a stored one."""
        self.position += 1

    def skips_reset(self) -> bool:
        """Whether a reset of the chain repeats a stored one; if so, go to the next call."""
        repeats = self.position < len(self.calls) and self.calls[self.position].steps is None
        self.position += repeats
        return repeats
