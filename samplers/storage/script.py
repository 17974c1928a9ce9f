"""The calls of a script, matched with those in a journal, so that a script that is started again adds nothing.

A script is a sequence of calls that store steps, and of resets of the chain. When it is started again, each of its
calls is compared with the stored one at the same place. An equal call that is complete returns what it returned; an
equal call that was interrupted is completed. The first call that differs replaces the stored rest, and its steps are
added to the chain. Calls are equal where the number of steps, the initial state and the `options` are.

A loop over ``sample`` that the user leaves early and one that an error ends look the same from inside: the generator
is closed. Such a call stays incomplete, and the next call takes the next place. Started again, the loop gets the stored
states once more; if it does not leave with them, the call goes on.

A call that the limit of simulations has ended is completed by the next equal call, once the limit is raised. Such calls
are counted, so that the same script repeats them as well.
"""

import zlib
from collections import Counter
from typing import NamedTuple

import numpy as np

from .journal import Step

__all__ = ["Call", "Request", "Script", "describe_options", "digest"]


class Call(NamedTuple):
    """A call of the sampler that stores steps, or a reset of the chain.

    Attributes
    ----------
    steps : int, or None
        Number of steps that it asks for; None for a reset.
    begin : str
        Digest of the coordinates that it starts from (`digest`).
    options : str
        Other arguments that determine its steps, such as "thin_by=3".
    made : int
        Number of these steps that are stored.
    complete : bool
        Whether nothing remains to be done.
    annealing : int
        How many annealings the file has had when the call began.
    again : int
        How many further calls of the script went on with it, after its limit of simulations was raised.
    last : Step, or None
        Its last stored step, or the last state of a complete call with ``store=False``; None where there is none or it
        is not known.
    """

    steps: int | None
    begin: str = ""
    options: str = ""
    made: int = 0
    complete: bool = False
    annealing: int = 1
    again: int = 0
    last: Step | None = None


class Request(NamedTuple):
    """What a call of ``sample`` or ``run_mcmc`` asks for.

    Attributes
    ----------
    steps : int
        Number of steps wanted.
    coords : (n, ndim) float, optional
        Where the call is to start; None for a call that leaves this open.
    options : str
        As in `Call`.
    """

    steps: int
    coords: np.ndarray | None
    options: str = ""


def describe_options(thin_by: int, thin: int | None, tune: bool, store: bool) -> str:
    """Arguments of ``sample`` that determine its steps, besides initial state and number of steps, as text."""
    options = [f"thin_by={int(thin_by)}"] if thin is None and int(thin_by) != 1 else []
    options += [] if thin is None else [f"thin={int(thin)}"]
    return ", ".join(options + ["tune"] * bool(tune) + ["store=False"] * (not store))


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
        self._halted: int | None = None
        self._went_on: Counter[int] = Counter()  # with calls that a limit of simulations had ended, by place
        self._expected = 0  # calls that went on with the one that has just been repeated

    def find(self, request: Request, resumable: bool) -> Call | None:
        """The stored call that a new one repeats; None if there is none.

        Parameters
        ----------
        request : Request
            The new call.
        resumable : bool
            Whether the coordinates of an incomplete call are compared elsewhere.
        """
        expected, self._expected = self._expected, 0
        if expected > 0 and self._matches(self.position - 1, request):
            self.position, self._expected = self.position - 1, expected - 1
            return self.calls[self.position]
        if self.position >= len(self.calls):
            return None
        call, coords = self.calls[self.position], request.coords
        if call.complete and self._matches(self.position, request):
            self._expected = call.again
        if (call.steps, call.options) != (request.steps, request.options):
            return None
        if coords is None or digest(coords) == call.begin or (resumable and not call.complete):
            return call
        goes_on = not call.complete and call.last is not None and np.array_equal(coords, call.last.coords)
        return call if goes_on else None

    def _matches(self, place: int, request: Request) -> bool:
        call = self.calls[place]
        same_start = request.coords is None or digest(request.coords) == call.begin
        return (call.steps, call.options) == (request.steps, request.options) and same_start

    @property
    def is_last(self) -> bool:
        """Whether no stored call follows the present one."""
        return self.position >= len(self.calls) - 1

    @property
    def was_halted(self) -> bool:
        """Whether the limit of simulations has ended the present call in this process."""
        return self._halted == self.position

    def halt(self) -> None:
        """Enter that the limit of simulations has ended the present call."""
        self._halted = self.position

    def count_again(self) -> int:
        """How many calls of this process have gone on with the present one after a limit, with this one."""
        self._went_on[self.position] += self.was_halted
        self._halted = None
        return self._went_on[self.position]

    def go_on(self, again: int) -> None:
        """Enter that the present call goes on. Others that were made after it do not count any more."""
        del self.calls[self.position + 1 :]
        self.calls[self.position] = self.calls[self.position]._replace(again=again)

    def begin(self, steps: int | None, begin: str = "", annealing: int = 1, options: str = "") -> int:
        """Enter a new call at the present place, and return the place; a reset is complete at once."""
        del self.calls[self.position :]
        self._halted = None
        self.calls.append(Call(steps, begin, options, annealing=annealing, complete=steps is None))
        self.position += steps is None
        return len(self.calls) - 1

    def stepped(self, step: Step) -> None:
        """Enter a stored step of the present call."""
        if self.position < len(self.calls):
            call = self.calls[self.position]
            self.calls[self.position] = call._replace(made=call.made + 1, last=step)

    def finish(self, last: Step) -> None:
        """Enter that the present call, which stores no steps, is complete with this state."""
        self.calls[self.position] = self.calls[self.position]._replace(last=last)
        self.complete()

    def complete(self) -> None:
        """Enter that the present call is complete."""
        if self.position < len(self.calls):
            self.calls[self.position] = self.calls[self.position]._replace(complete=True)
            self.position += 1

    def skips_reset(self) -> bool:
        """Whether a reset of the chain repeats a stored one; if so, go to the next call."""
        repeats = self.position < len(self.calls) and self.calls[self.position].steps is None
        self.position += repeats
        return repeats
