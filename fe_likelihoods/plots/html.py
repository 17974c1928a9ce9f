"""Objects in notebooks: HTML tables, and histories as small vector graphics, without matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

__all__ = ["html_history", "html_object", "html_table"]

_POINTS = 600  # of a history: twice the width of the graphic
_WIDTH, _HEIGHT = 300, 40


def html_table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table; every cell is escaped, except for the graphics of `html_history`."""
    top = "".join(f"<th>{escape(name)}</th>" for name in header)
    body = "".join("<tr>" + "".join(f"<td>{_cell(value)}</td>" for value in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"


def html_object(title: str, lines: Sequence[str], *parts: str) -> str:
    """An object: a title, lines of text, which are escaped, and parts that are HTML."""
    text = "".join(f"<div>{escape(line)}</div>" for line in lines if line)
    return f"<div><strong>{escape(title)}</strong>{text}{''.join(parts)}</div>"


class _Graphic(str):
    """HTML that is not escaped."""


def html_history(values: NDArray[np.float64]) -> str:
    """A history (n,) as a graphic, from its smallest to its largest value; NaN where a sample is missing.

    Long histories are reduced to the extremes in equal parts, so that no peak is lost.
    """
    values = np.asarray(values, dtype=float)
    parts = [part[~np.isnan(part)] for part in np.array_split(values, min(len(values), _POINTS // 2))]
    low, high = np.nanmin(values), np.nanmax(values)
    scale = (_HEIGHT - 2) / (high - low) if high > low else 0.0
    lines: list[list[str]] = [[]]
    for place, part in enumerate(parts):
        if not len(part):  # a gap interrupts the line
            lines.append([])
            continue
        x = _WIDTH * (place + 0.5) / len(parts)
        ends = [part.min(), part.max()] if np.argmin(part) < np.argmax(part) else [part.max(), part.min()]
        lines[-1] += [f"{x:.1f},{_HEIGHT - 1 - scale * (value - low):.1f}" for value in ends]
    drawn = "".join(
        f'<polyline points="{" ".join(points)}" fill="none" stroke="currentColor" stroke-width="0.7"/>'
        for points in lines
        if points
    )
    return _Graphic(f'<svg width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}">{drawn}</svg>')


def _cell(value: object) -> str:
    if isinstance(value, _Graphic):
        return str(value)
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.4g}"
    return escape(str(value))
