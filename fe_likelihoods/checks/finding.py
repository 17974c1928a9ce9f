"""Findings as a judgement, and findings as warnings."""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

from samplers.finding import CARE, NOTE, WRONG, Finding, by_severity

__all__ = [
    "CARE",
    "CORRELATED",
    "HALF",
    "NOTE",
    "SMALL_PROBABILITY",
    "TAIL",
    "WRONG",
    "Finding",
    "FindingWarning",
    "Judgement",
    "about",
    "by_severity",
    "grouped",
    "judge",
    "labelled",
    "percent",
    "warn",
]

SMALL_PROBABILITY = 0.01  # that chance explains what was found; of 100 independent tests of right results, one fails
TAIL = 0.05  # share of samples or draws that is as much as a tail of a 90 % interval
HALF = 0.5  # of a power, or of what is inside a band: the other half is missed
CORRELATED = "The errors are correlated"
STATUS = {WRONG: "do not use", CARE: "use with care", NOTE: "use"}
FIRST, LATER, KNOW = "Fix first", "May follow from it", "Good to know"
ORDER = ("input", "data", "fit", "samples")


def about(what: str, findings: Iterable[Finding]) -> list[Finding]:
    """Findings as those about one of `ORDER`."""
    return [each._replace(about=what) for each in findings]


def grouped(findings: Iterable[Finding]) -> dict[str, tuple[Finding, ...]]:
    """Findings as causes, what may follow from them, and notes, by title; one group without a title if nothing follows.

    A check relies on what stands before it in `ORDER`: a fit on right data, samples on a fit. So causes are the first
    of them that are more than notes. In a group the most severe finding comes first.
    """
    found = by_severity(findings)
    places = [ORDER.index(each.about) for each in found if each.severity != NOTE]
    if not places or min(places) == max(places):
        return {"": found} if found else {}
    groups: dict[str, tuple[Finding, ...]] = dict.fromkeys((FIRST, LATER, KNOW), ())
    for each in found:
        title = KNOW if each.severity == NOTE else FIRST if ORDER.index(each.about) == min(places) else LATER
        groups[title] += (each,)
    return {title: group for title, group in groups.items() if group}


class Judgement(NamedTuple):
    """Whether a result can be used, from all that was found; ``str`` gives it in one sentence."""

    status: str  # "use", "use with care" or "do not use"
    findings: tuple[Finding, ...]  # causes first, then what may follow from them, notes last
    tests: tuple[tuple[str, str], ...] = ()  # names of the tests, and what was tested or why it was not

    def __str__(self) -> str:
        groups = grouped(self.findings)
        causes, later = groups.get(FIRST, ()), groups.get(LATER, ())
        deciding = (each for each in self.findings if STATUS[each.severity] == self.status != "use")
        reasons = list(dict.fromkeys(each.kind for each in causes or deciding))
        if later:
            others = f"{len(later)} other finding{'s' if len(later) > 1 else ''}"
            reasons.append(f"fix this first, {others} may follow from it")
        if self.width_factor > 1.0:
            reasons.append(f"multiply standard deviations by {self.width_factor:.2g}, because errors are correlated")
        text = f"{self.status[0].upper()}{self.status[1:]}"
        return f"{text}: {'; '.join(f'{kind[0].lower()}{kind[1:]}' for kind in reasons)}." if reasons else f"{text}."

    __repr__ = __str__

    @property
    def width_factor(self) -> float:
        """Factor of standard deviations from the data, for the effective number of samples; 1 for white errors."""
        return next((each.numbers["factor"] for each in self.findings if each.kind == CORRELATED), 1.0)


def judge(findings: Iterable[Finding], tests: Iterable[tuple[str, str]] = ()) -> Judgement:
    """The judgement that follows from findings: the most severe one decides."""
    groups = grouped(found := tuple(findings))
    status = STATUS[by_severity(found)[0].severity] if found else "use"
    return Judgement(status, sum(groups.values(), ()), tuple(tests))


class FindingWarning(UserWarning):
    """A finding that a result has among its findings as well."""


def warn(findings: Iterable[Finding], stacklevel: int = 2) -> None:
    """Warn of the findings that are more than a note; `stacklevel` as seen from the caller."""
    for each in findings:
        if each.severity != NOTE:
            warnings.warn(each.message, FindingWarning, stacklevel=stacklevel + 1)


def labelled(findings: Iterable[Finding], of: str = "") -> list[str]:
    """Findings as lines of a text, which begin with CAUTION unless they are notes, and say what to fix first.

    `of` is what they are about, such as "event EQ2: ".
    """
    lines = []
    for title, group in grouped(findings).items():
        how = f", {title[0].lower()}{title[1:]}" if title in (FIRST, LATER) else ""
        lines += [f"{'Note' if each.severity == NOTE else f'CAUTION{how}'}: {of}{each}" for each in group]
    return lines


def percent(share: float) -> str:
    """A share in words: "12.3 %"."""
    return f"{100.0 * share:.3g} %"
