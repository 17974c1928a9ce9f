"""Rows that a benchmark returns, and functions that print and store them."""

import datetime
import json
import os
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

__all__ = ["Row", "aligned", "as_table", "machine", "number", "write_json"]


class Row(NamedTuple):
    """One figure: what was measured, the case, its value (None: not measured), its unit and a note."""

    what: str
    case: str
    value: float | None
    unit: str
    note: str = ""


def _commit() -> str:
    """Commit of the working tree, with a plus if files were edited since; empty without a repository."""
    git = ["git", "-C", str(Path(__file__).parent)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
        edited = subprocess.run([*git, "status", "--porcelain", "-uno"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return commit.stdout.strip() + "+" * bool(edited.stdout.strip())


def machine() -> dict[str, str | int | list[float]]:
    """Machine and versions of the measurement; the load average shows whether other processes were running."""
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
        "commit": _commit(),
        **versions,
        "load_average": [round(load, 2) for load in os.getloadavg()] if hasattr(os, "getloadavg") else [],
    }


def number(value: float | None) -> str:
    """Format a number with three significant digits, large ones in full, and a dash for None."""
    if value is None:
        return "-"
    if isinstance(value, int):
        return str(value)
    return f"{value:.0f}" if 1000.0 <= abs(value) < 1e9 else f"{value:.3g}"


def aligned(lines: Sequence[Sequence[str]], right: Sequence[int]) -> str:
    """Align the cells of a table. The first line is the header; the columns `right` are aligned to the right."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    out = []
    for line in lines:
        padded = [
            text.rjust(width) if i in right else text.ljust(width)
            for i, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        out.append("  ".join(padded).rstrip())
    out.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(out)


def as_table(rows: Sequence[tuple]) -> str:
    """NamedTuples of one type as aligned text: their fields are the columns, numbers are aligned to the right."""
    fields = rows[0]._fields
    numeric = [all(not isinstance(value, str) for value in column) for column in zip(*rows, strict=True)]
    cells = [[value if isinstance(value, str) else number(value) for value in row] for row in rows]
    lines = [[name.replace("_", " ") for name in fields], *cells]
    return aligned(lines, right=[i for i, is_number in enumerate(numeric) if is_number])


def write_json(path: Path, rows: Sequence[tuple], machines: Sequence[dict]) -> None:
    """Store the rows, and the machine before and after, in a JSON file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = {"machine": machines[0], "load_average_after": machines[-1]["load_average"]}
    path.write_text(json.dumps(kept | {"rows": [row._asdict() for row in rows]}, indent=1, default=float) + "\n")
