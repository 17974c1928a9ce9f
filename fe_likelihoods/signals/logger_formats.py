"""Tables in the formats of two logger programs, as header line, line of units and rows for `tables`.

Campbell Scientific TOA5
    Four header lines: environment, names, units, processing (LoggerNet manual, appendix "Campbell Scientific File
    Formats").
LabVIEW measurement (.lvm)
    Tags and values up to ``***End_of_Header***``, the same for each segment, a line of names that begins with
    ``X_Value``, and rows. With X_Columns "No" the cells of this column are empty, with "Multi" each channel has its
    own, and they must agree (National Instruments, "Specification for the LabVIEW Measurement File").
"""

from __future__ import annotations

__all__ = ["logger_table"]

_END = "***End_of_Header***"
_Line = tuple[int, list[str]]


def logger_table(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]]:
    """Return numbered lines of a table with header line and line of units, and what comments would state (a step).

    Lines in another format are returned as they are. Raises ValueError for a LabVIEW file with several segments, or
    without time on its axis.
    """
    first = lines[0][1][0] if lines and lines[0][1] else ""
    if first == "TOA5" and len(lines) > 3:
        units = ["" if unit in ("TS", "RN") else unit for unit in lines[2][1]]
        return [lines[1], (lines[2][0], _bracketed(units)), *lines[4:]], []
    return _labview(lines, file) if first.startswith("LabVIEW Measurement") else (lines, [])


def _bracketed(units: list[str]) -> list[str]:
    return [f"[{unit}]" if unit else "" for unit in units]


def _labview(lines: list[_Line], file: str) -> tuple[list[_Line], list[str]]:
    ends = [place for place, (_, cells) in enumerate(lines) if cells[0] == _END]
    if len(ends) != 2:
        raise ValueError(
            f"{file}: expected a LabVIEW file with one segment, found {max(len(ends) - 1, 0)}; write a file for each "
            "segment (option 'Overwrite file' or 'One header only')"
        )
    tags = {cells[0]: cells[1:] for _, cells in lines[: ends[1]]}
    (number, header), rows = lines[ends[1] + 1] if lines[ends[1] + 1 :] else (0, [""]), lines[ends[1] + 2 :]
    columns, axis = (next(iter(tags.get(tag, ())), "") for tag in ("X_Columns", "X_Dimension"))
    if header[0] != "X_Value" or (axis or "Time") != "Time":
        raise ValueError(
            f"{file}: expected a LabVIEW file whose first column X_Value has times, got {header[0]!r} and X_Dimension "
            f"{axis!r}; write it with times"
        )
    width = len(header) - (header[-1] == "Comment")
    labels = ["", *tags.get("Y_Unit_Label", []), *[""] * width]
    names = ["time [s]" if name == "X_Value" else name for name in header[:width]]
    units = ["s" if name == "X_Value" else label for name, label in zip(header[:width], labels, strict=False)]
    # the text in the column of comments goes; numbers in it show that a row is damaged
    cut = [k for k, (_, cells) in enumerate(rows) if len(cells) == width + 1 and not any(map(str.isdigit, cells[-1]))]
    for k in cut:
        rows[k] = rows[k][0], rows[k][1][:width]
    table = [(number, names), (number, _bracketed(units)), *rows]
    if columns != "No":
        return table, []
    steps = sorted({cell for cell in tags.get("Delta_X", []) if cell})
    if len(steps) != 1:
        raise ValueError(f"{file}: expected one step Delta_X, got {', '.join(steps) or 'none'}; write it with times")
    return [(number, cells[1:]) for number, cells in table], [f"dt = {steps[0].replace(',', '.')} s"]
