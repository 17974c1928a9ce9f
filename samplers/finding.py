"""A finding: what a check of data, model, run or prediction has found, for both packages."""

from typing import NamedTuple

NOTE = "note"  # good to know
CARE = "care"  # limits the result
WRONG = "wrong"  # speaks against the result
FALSE_ALARM = 1e-4  # probability in a run, of tests whose alarm ends the run or refuses its result


class Finding(NamedTuple):
    """What a check has found; ``str`` gives it in sentences."""

    kind: str  #: title, equal for all findings of the same kind
    severity: str  #: "note": good to know, "care": limits the result, "wrong": speaks against it
    text: str  #: what was found, with its numbers
    action: str = ""  #: what to do about it
    numbers: dict[str, float] = {}  #: the numbers that it was judged by
    #: what was checked: "input" (data, motions, model by themselves), "data" (beside responses), "fit", or "samples";
    #: a check relies on what stands before it, so a fault there may be its cause
    about: str = "samples"

    @property
    def message(self) -> str:
        """Text and action, without the title."""
        return f"{self.text} {self.action}".rstrip()

    def __hash__(self) -> int:
        return hash(self[:4])

    def __repr__(self) -> str:
        return f"{self.kind}: {self.message}"
