"""How often the warnings of `Hierarchy` come on right results, and how often a wrong result has none.

The problems are those of `tests.events.hierarchy_problems`, with other seeds than those with which the limits of
the warnings were chosen.
"""

from collections import Counter

from tests.events.hierarchy_problems import RIGHT, WRONG, problem, solve

from .rows import Row

__all__ = ["alarms"]

_FIRST = 500  # seed


def alarms(repeats: int = 1, problems: int = 120) -> list[Row]:
    """Warnings on right and on wrong results, `problems` times `repeats`."""
    found = [solve(problem(seed), seed) for seed in range(_FIRST, _FIRST + problems * repeats)]
    rows = []
    for name, inside in (
        ("right", lambda error: error <= RIGHT),
        ("between", lambda error: RIGHT < error <= WRONG),
        ("wrong", lambda error: error > WRONG),
    ):
        group = [each for each in found if inside(each.error)]
        warned = sum(bool(each.kinds) for each in group)
        kinds = Counter(kind for each in group for kind in set(each.kinds))
        note = ", ".join(f"{kind} {number}" for kind, number in kinds.most_common())
        rows.append(Row(f"{name} results", "", len(group), ""))
        rows.append(Row(f"{name} results with a warning", "", warned, "", note))
    return rows
