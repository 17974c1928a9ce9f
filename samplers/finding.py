"""A finding: what a check of data, model, run or prediction has found, for both packages."""

from collections.abc import Iterable
from typing import NamedTuple

NOTE = "note"  # good to know
CARE = "care"  # limits the result
WRONG = "wrong"  # speaks against the result


class Finding(NamedTuple):
    """What a check has found; ``str`` gives it in sentences.

    Attributes
    ----------
    kind : str
        Title, equal for all findings of the same kind.
    severity : {"note", "care", "wrong"}
        Whether it is good to know, limits the result, or speaks against it.
    text : str
        What was found, with its numbers.
    action : str
        What to do about it; may be empty.
    numbers : dict of str to float
        The numbers that it was judged by.
    about : {"input", "data", "fit", "samples"}
        What was checked: data, motions and model by themselves, data beside responses, the fit, or samples and
        parameters. A check relies on what stands before it, so a fault there may be its cause.
    """

    kind: str
    severity: str
    text: str
    action: str = ""
    numbers: dict[str, float] = {}
    about: str = "samples"

    @property
    def message(self) -> str:
        """Text and action, without the title."""
        return f"{self.text} {self.action}".rstrip()

    def __hash__(self) -> int:
        return hash(self[:4])

    def __str__(self) -> str:
        return f"{self.kind}: {self.message}"


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Findings with the most severe first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda each: (WRONG, CARE, NOTE).index(each.severity)))
