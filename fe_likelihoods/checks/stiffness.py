"""Findings about calibrations whose stiffnesses are compared, and about the number of damaged ones."""

from typing import Any

import numpy as np

from .finding import CARE, Finding

__all__ = ["check_laplace", "check_most", "check_normal"]

# Skewness and excess kurtosis of the logarithms in any direction, assumed: a uniform distribution has the excess
# kurtosis -1.2, a double exponential one 3, and an exponential one the skewness 2.
NORMAL = (-1.0, 1.0), (-1.2, 3.0)


def check_laplace(search: Any) -> list[Finding]:
    """Whether a search for modes (`ModeSearch`) says that its highest one is the posterior."""
    ends = sum(end == 0 for end in search.ends)
    faults = [
        (not search.finished, "The limit of simulations ended the search for modes.", "Use a larger limit."),
        (not search.modes[0].converged, "The search ended before the top of the mode.", "Use more starts."),
        (len(search.modes) > 1, f"The search found {len(search.modes)} modes; the highest is used.", "Sample instead."),
        (ends < 2, f"Only one of {len(search.ends)} starts led to the mode.", "Use more starts."),
    ]
    return [Finding("The mode may not be the posterior", CARE, text, action) for said, text, action in faults if said]


def check_normal(skewness: np.ndarray, kurtosis: np.ndarray) -> list[Finding]:
    """Whether the logarithms of the stiffnesses are normal, by skewness and excess kurtosis (n,) in n directions."""
    numbers = zip((skewness, kurtosis), NORMAL, strict=True)
    if all(low < np.min(each) and np.max(each) < high for each, (low, high) in numbers):
        return []
    text = (
        f"The logarithms of the stiffnesses are not normal (skewness {np.max(np.abs(skewness)):.1f}, excess kurtosis "
        f"{np.min(kurtosis):.1f} to {np.max(kurtosis):.1f}): ridges and several modes are not represented."
    )
    return [Finding("A calibration is not normal", CARE, text, "Use narrower priors, or fix what is not identified.")]


def check_most(counts: np.ndarray, most: int, stiffnesses: int) -> list[Finding]:
    """Whether more stiffnesses may be damaged than are allowed: draws (n,) of their number that grow up to `most`."""
    as_many, fewer = (float(np.mean(counts == count)) for count in (most, most - 1))
    if most >= stiffnesses or as_many <= fewer:
        return []
    text = f"The probability of {most} damaged stiffnesses is {as_many:.2f}: there may be more."
    return [Finding("More stiffnesses may be damaged", CARE, text, "Increase most.", {"share": as_many})]
