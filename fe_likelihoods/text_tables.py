"""Results as text: aligned tables for ``print``."""

from collections.abc import Sequence

__all__ = ["text_table"]


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Cells as aligned text, without spaces at the ends of lines.

    Parameters
    ----------
    rows : sequence of sequence of str
        Rows of the same number of cells, the header first. The first column is aligned to the left, others to the
        right.

    Examples
    --------
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
