"""Compare two versions: ``python -m benchmarks --compare before.json after.json``."""

import json
from pathlib import Path

from .rows import aligned, number

__all__ = ["compare"]

CHANGED = 1.1


def _read(path: Path) -> tuple[dict, dict[tuple[str, str], dict]]:
    """The machine, and the rows by their columns "what" and "case".

    Raises
    ------
    ValueError
        If the file does not exist or was not written by the benchmarks.
    """
    try:
        kept = json.loads(path.read_text())
        return kept["machine"], {(row["what"], row["case"]): row for row in kept["rows"] if "what" in row}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: expected a file that `python -m benchmarks` wrote; {error!r}") from None


def compare(before: Path, after: Path) -> str:
    """One table of two files: both values and their ratio, with a star where it differs from 1 by more than 10 %.

    Rows that only one file has show a dash for the other. Figures of different machines, or measured under other load,
    cannot be compared: processor and load average of both files are printed above the table. Tables without a column
    "what" are left out.
    """
    (machine_before, old), (machine_after, new) = _read(before), _read(after)
    lines = [
        f"{name}: {machine.get('date')}, version {machine.get('commit') or machine.get('fe-likelihoods')}, "
        f"{machine.get('cpu')}, load average {(machine.get('load_average') or ['unknown'])[0]}"
        for name, machine in (("before", machine_before), ("after", machine_after))
    ]
    if machine_before.get("cpu") != machine_after.get("cpu"):
        lines.append("the processors differ: ratios of times compare the machines as well")
    cells = [("what", "case", "before", "after", "unit", "after / before", "")]
    for key in [*new, *(key for key in old if key not in new)]:
        values = [None if row is None else row["value"] for row in (old.get(key), new.get(key))]
        ratio = values[1] / values[0] if None not in values and values[0] else None
        star = "*" if ratio is not None and not 1.0 / CHANGED <= ratio <= CHANGED else ""
        unit = (new.get(key) or old[key])["unit"]
        cells.append((*key, number(values[0]), number(values[1]), unit, number(ratio), star))
    return "\n".join([*lines, aligned(cells, right=(2, 3, 5))])
