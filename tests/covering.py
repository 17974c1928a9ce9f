"""Combinations of parameters of which the quick tests make only some."""

from collections import Counter
from collections.abc import Sequence
from itertools import combinations, product
from typing import Any

import pytest


def covering(*factors: Sequence[Any], strength: int = 2) -> list[Any]:
    """Every combination of one value of each factor, as parameters of a test, of which most are slow.

    The quick combinations have every value of each factor (`strength` 1), or every pair of values of two factors (2).
    """
    cases = [set(combinations(enumerate(case), strength)) for case in product(*(range(len(f)) for f in factors))]
    missing, quick, used = set().union(*cases), set(), Counter()
    while missing:
        best = max(range(len(cases)), key=lambda k: (len(cases[k] & missing), -sum(used[part] for part in cases[k])))
        quick.add(best)
        missing -= cases[best]
        used.update(cases[best])
    marks = [() if k in quick else pytest.mark.slow for k in range(len(cases))]
    return [pytest.param(*values, marks=mark) for values, mark in zip(product(*factors), marks, strict=True)]
