"""Findings as a judgement, and findings as warnings."""

import warnings
from collections.abc import Iterable
from typing import NamedTuple

from samplers.finding import CARE, NOTE, WRONG, Finding

SMALL_PROBABILITY = 0.01  # that chance explains what was found; of 100 independent tests of right results, one fails
TAIL = 0.05  # share of samples, draws or simulations that is as much as a tail of a 90 % interval
HALF = 0.5  # of a power, or of what is inside a band: the other half is missed
CORRELATED = "The errors are correlated"
STATUS = {WRONG: "do not use", CARE: "use with care", NOTE: "use"}
ORDER = ("input", "data", "fit", "samples")


class Findings(tuple[Finding, ...]):
    """Findings, printed as one line each."""

    def __str__(self) -> str:
        return "\n".join(labelled(self)) or "Nothing was found."

    __repr__ = __str__


def in_order(findings: Iterable[Finding]) -> Findings:
    """Findings with causes before what may follow from them, and notes last.

    A check relies on what stands before it in `ORDER`: a fit on right data, samples on a fit.
    """
    return Findings(sorted(findings, key=lambda each: (each.severity == NOTE, ORDER.index(each.about), _rank(each))))


def _rank(finding: Finding) -> int:
    return [*STATUS].index(finding.severity)  # the most severe first


class Judgement(NamedTuple):
    """Whether a result can be used, from all that was found; ``str`` gives it in one sentence."""

    status: str  # "use", "use with care" or "do not use"
    findings: Findings  # causes first, then what may follow from them, notes last
    tests: tuple[tuple[str, str], ...] = ()  # names of the tests, and what was tested or why it was not

    def __str__(self) -> str:
        kinds = list(dict.fromkeys(each.kind for each in self.findings if each.severity != NOTE))
        reasons = [f"{kind[0].lower()}{kind[1:]}" for kind in kinds[:1]]
        if others := len(kinds[1:]):
            reasons.append(f"fix this first, {others} other finding{'s' if others > 1 else ''} may follow from it")
        if self.width_factor > 1.0:
            reasons.append(f"multiply standard deviations by {self.width_factor:.2g}, because errors are correlated")
        text = f"{self.status[0].upper()}{self.status[1:]}"
        return f"{text}: {'; '.join(reasons)}." if reasons else f"{text}."

    __repr__ = __str__

    @property
    def width_factor(self) -> float:
        """Factor of standard deviations from the data, for the effective number of samples; 1 for white errors."""
        return next((each.numbers["factor"] for each in self.findings if each.kind == CORRELATED), 1.0)


def judge(findings: Iterable[Finding], tests: Iterable[tuple[str, str]] = ()) -> Judgement:
    """The judgement that follows from findings: the most severe one decides."""
    found = in_order(findings)
    status = STATUS[min(found, key=_rank).severity] if found else "use"
    return Judgement(status, found, tuple(tests))


class FindingWarning(UserWarning):
    """A finding that a result has among its findings as well."""


def warn(findings: Iterable[Finding], stacklevel: int = 2) -> None:
    """Warn of the findings that are more than a note; `stacklevel` as seen from the caller."""
    for each in findings:
        if each.severity != NOTE:
            warnings.warn(each.message, FindingWarning, stacklevel=stacklevel + 1)


def labelled(findings: Iterable[Finding], of: str = "") -> list[str]:
    """Findings as lines of a text, which begin with CAUTION unless they are notes; `of` is what they are about."""
    return [f"{'Note' if each.severity == NOTE else 'CAUTION'}: {of}{each}" for each in in_order(findings)]


def percent(share: float) -> str:
    """A share in words: "12.3 %"."""
    return f"{100.0 * share:.3g} %"
