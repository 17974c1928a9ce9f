"""What a benchmark returns, and how it is printed and kept."""

import datetime
import json
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

__all__ = ["Row", "as_table", "machine", "write_json"]


class Row(NamedTuple):
    """One figure: what was measured, on which case, its value (None: not measured) and unit, and what else to know."""

    what: str
    case: str
    value: float | None
    unit: str
    note: str = ""


def machine() -> dict[str, str | int | list[float]]:
    """Where and with what the figures were measured; the load average tells whether others were at work."""
    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        names = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if line.startswith("model name")
        ]
        cpu = names[0] if names else cpu
    versions = {name: metadata.version(name) for name in ("numpy", "numba", "fe-likelihoods")}
    return {
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "cpu": cpu,
        "cores": os.cpu_count() or 1,
        "python": platform.python_version(),
        **versions,
        "load_average": [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else [],
    }


def as_table(rows: Sequence[Row]) -> str:
    """The rows as aligned text, the value with three significant digits, a dash for none."""
    cells = [("what", "case", "value", "unit", "note")]
    cells += [
        (row.what, row.case, "-" if row.value is None else f"{row.value:.3g}", row.unit, row.note) for row in rows
    ]
    widths = [max(len(line[i]) for line in cells) for i in range(5)]
    lines = []
    for line in cells:
        padded = [
            text.rjust(width) if i == 2 else text.ljust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        lines.append("  ".join(padded).rstrip())
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(lines)


def write_json(path: Path, rows: Sequence[Row], machines: Sequence[dict]) -> None:
    """Keep the rows, and the machine before and after, in a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {"machine": machines[0], "load_average_after": machines[-1]["load_average"]}
    path.write_text(json.dumps(kept | {"rows": [row._asdict() for row in rows]}, indent=1) + "\n")
