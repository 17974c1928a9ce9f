"""Results as text: aligned tables for ``print``, numbers, lists in sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

__all__ = ["NamedResults", "listed", "number", "text_table"]


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Cells as aligned text, without spaces at the ends of lines; header first, the first column aligned to the left.

    >>> print(text_table([("channel", "RMS"), ("deck", "1.2")]))
    channel  RMS
    deck     1.2
    """
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        first, *others = (
            cell.ljust(width) if i == 0 else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        lines.append("  ".join([first, *others]).rstrip())
    return "\n".join(lines)


def number(value: float, digits: int = 3) -> str:
    """A number with some significant digits; "-" for NaN."""
    return "-" if value != value else f"{value:.{digits}g}"  # noqa: PLR0124 - NaN differs from itself


def listed(texts: Sequence[str]) -> str:
    """Texts as a list in a sentence: "a, b and c"."""
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} and {texts[-1]}"


class NamedResults(dict[str, Any]):
    """Results by name, a dict; ``print`` gives one table with a row per name.

    Each value has a property `cells`: texts by the headings of their columns, the same for all values.
    """

    def __str__(self) -> str:
        rows: list[Mapping[str, str]] = [value.cells for value in self.values()]
        head = list(dict.fromkeys(heading for row in rows for heading in row))
        named = zip(self, rows, strict=True)
        return text_table([["event", *head], *([name, *(row.get(h, "-") for h in head)] for name, row in named)])
