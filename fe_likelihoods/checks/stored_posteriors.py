"""Findings about populations of stored posteriors: do the samples of each test serve, and do draws of it make sense?"""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from .finding import CARE, SMALL_PROBABILITY, Finding

__all__ = ["check_equal_ratios", "check_impossible_draws", "check_new_test", "check_reweighting"]

# Limits with study `hierarchy_warnings` of docs/results.rst, where the exact result is known.
LARGEST_SHAPE = 0.8  # Pareto shape; up to here, right results have it as well
HARMLESS_ERROR = 0.15  # of the means [posterior sd], up to which uneven weights and mixtures do no harm


class _Reweighted(Protocol):
    pareto_shape: float
    shift: float


def check_reweighting(tests: Mapping[str, _Reweighted], error: float, parameters: Sequence[str]) -> list[Finding]:
    """Whether the stored samples of each test suffice; `error` is the largest error of a mean [posterior sd]."""
    found = []
    for name, each in tests.items():
        numbers = {"shape": each.pareto_shape, "error": error}
        if each.pareto_shape > LARGEST_SHAPE:
            text = (
                f"test {name!r}: the population reaches values that the prior of this test, and therefore its samples, "
                f"leave out (Pareto shape {each.pareto_shape:.2f}, above {LARGEST_SHAPE:g}): the spread between "
                "tests is not reliable."
            )
            action = f"Sample this test again with a wider prior of {', '.join(parameters)}."
            found.append(Finding("The prior of a test is too narrow", CARE, text, action, numbers))
    if not found and error > HARMLESS_ERROR:
        worst = max(tests, key=lambda name: tests[name].shift)
        text = (
            f"test {worst!r}: the means have errors of up to {error:.1f} posterior standard deviations, because few of "
            "its samples are where the population is."
        )
        action = "Give more samples of this test, or draw fresh samples with the population as its prior."
        found.append(Finding("Too few samples of a test", CARE, text, action, {"error": error}))
    return found


def check_new_test(outside: Mapping[str, float], share: float) -> list[Finding]:
    """Draws of a new test outside of the bounds of the tests' priors, by parameter, and the share of all such draws."""
    if share <= SMALL_PROBABILITY:
        return []
    named = ", ".join(f"{name} {each:.1%}" for name, each in outside.items() if each > 0.0)
    text = f"{share:.0%} of the draws of a new test are outside the bounds of the priors of the tests ({named})."
    action = (
        "Use scale='log' of Varying for a positive parameter, a narrower prior of the spread, or wider bounds where "
        "they are not physical."
    )
    return [Finding("Draws beyond the bounds of the tests", CARE, text, action, outside)]


def check_equal_ratios(n_events: int, spread: float, resolution: float) -> list[Finding]:
    """Whether ratios of events are equal: the spread of their logarithms is below its `resolution`."""
    if spread > resolution:
        return []
    text = (
        f"The ratios of {n_events} events are equal, so that nothing is left of the error of the model between events: "
        "intervals have no width, and probabilities are 0 or 1."
    )
    return [Finding("No spread between events", CARE, text, "Leave the prior of the scatter in (prior_events=).")]


def check_impossible_draws(possible: np.ndarray) -> list[Finding]:
    """Draws (n,) bool of a new event whose noise is impossible, and which are left out."""
    share = 1.0 - float(np.mean(possible))
    if share <= SMALL_PROBABILITY:
        return []
    text = (
        f"{share:.0%} of the draws have an impossible noise, such as a share of the measured signal of 1 or more, and "
        "are left out."
    )
    action = (
        "Use level='response', whose shares have no upper bound, or state a narrower prior of their spread between "
        "events."
    )
    return [Finding("Impossible draws", CARE, text, action, {"share": share})]
