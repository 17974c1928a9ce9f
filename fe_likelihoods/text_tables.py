"""Results as text: aligned tables for ``print``, numbers, lists in sentences."""

from collections.abc import Sequence


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
    return " and ".join(filter(None, (", ".join(texts[:-1]), *texts[-1:])))
