"""Rows of cells in CSV files, as loggers and spreadsheets write them, and in Excel workbooks.

Semicolons, tabs, commas or blanks separate cells, whichever splits most of the last lines into numbers. Decimal commas
are read if commas do not separate cells; separators of thousands go if a number shows them: ``1,234.5``, ``1.234,5``,
``1'234``. Text before the header line is left out, as are lines of numbers and words that a header line follows.
"""

import csv
import itertools
import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..units import find_unit
from .clock_times import is_clock, is_date
from .header_statements import read_statements
from .logger_formats import logger_table
from .text_files import LARGEST_FILE, check_count, decode_text, is_number, number_cells, parse_count, read_bytes

__all__ = ["Rows", "read_rows"]

_SEPARATORS = (";", "\t", ",", " ")
_LAST_LINES = 50  # lines that determine the separator
_MISSING = frozenset({"", "nan", "#n/a", "n/a", "na", "null", "-", "--"})
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?$")
_THOUSANDS = re.compile(r"[-+]?[1-9]\d{0,2},\d{3}$")  # 1,000: a thousand, or one with three decimals
# Separators of thousands that cannot be decimal marks: another mark or a second group follows
_GROUPED = re.compile(r"[-+]?[1-9]\d{0,2}(?:(?:,\d{3})+\.\d*|(?:\.\d{3})+,\d*|(?:,\d{3}){2,}|(?:\.\d{3}){2,})$")
_SPACED = re.compile(r"[-+]?[1-9]\d{0,2}(?:['\u2019\u00a0\u202f ]\d{3})+(?:[.,]\d*)?$")
_SPACE = re.compile(r"\d['\u2019\u00a0\u202f ]\d{3}")
_SPACES = str.maketrans("", "", "'\u2019\u00a0\u202f ")
_HUNDREDS = re.compile(r"[-+]?[1-9]\d{2}$")
_NUMBERS = re.compile(r"[\s\d.+\-eEdD]*")
_STEP = re.compile(r"0?\.\d+|\d(?:\.\d+)?[eEdD]-\d+")  # below 1 s
_EXCEL = {".xlsx", ".xlsm"}
_LARGEST_WORKBOOK, _MOST_CELLS = 256 * 2**20, 50_000_000  # bytes of the unpacked workbook; cells of the sheet


class Rows(NamedTuple):
    """Rows of a table, not yet numbers."""

    names: tuple[str, ...]  # cells of the header line, empty without one
    units: tuple[str, ...]  # cells of the line below it, empty without one
    cells: list[tuple[int, list[str]]]  # line number and cells, with decimal points; "" is missing
    comments: list[str]  # without the #
    above: Sequence[str] = ()  # lines above the rows that are no comments


def read_rows(path: str | Path, skip: int | None = None, along_rows: bool = False) -> Rows:
    """Read the rows of a text file, or of the first sheet of an Excel workbook (``.xlsx``, needs openpyxl).

    `skip` lines are above the table; None finds them. With `along_rows` the numbers are one column, row after row, and
    the last row may be shorter. Raises ValueError if the file cannot be read, has no rows of numbers, or has rows of
    different length.
    """
    if skip is not None and (isinstance(skip, bool) or not isinstance(skip, int) or skip < 0):
        raise ValueError(f"skip must be a number of lines, zero or more, got {skip!r}")
    if Path(path).suffix.lower() in _EXCEL:
        cells = [line for line in _workbook(path) if line[0] > (skip or 0)]
        lines, comments, separator = [(number, "\t".join(row)) for number, row in cells], [], ""
    else:
        lines, comments = _lines(path, skip or 0)
        separator = _find_separator([line for _, line in lines[-_LAST_LINES:]])
        cells = _cells_of(lines, separator, str(path))
        if separator == ",":
            _check_decimal_commas(cells, str(path))
        cells, stated = logger_table(cells, str(path))
        comments += stated
    if along_rows and not any("rows" in row for _, row in cells[:_LAST_LINES]):
        cells = _along_rows(cells, str(path))
    elif found := _announced(cells, str(path)):
        cells, comments = found[0], comments + found[1]
    rows = _arrange(cells, comments, str(path), separator)
    return rows._replace(above=[line for number, line in lines if number < rows.cells[0][0]])


def _lines(path: str | Path, skip: int) -> tuple[list[tuple[int, str]], list[str]]:
    """Numbers and text of the lines that are not blank, and the comments."""
    lines, comments = [], []
    for number, line in enumerate(decode_text(read_bytes(path)).splitlines(), 1):
        if number <= skip or not line.strip():
            continue
        if line.lstrip().startswith("#"):
            comments.append(line.lstrip("# \t"))
        else:
            lines.append((number, line))
    return lines, comments


def _cells_of(lines: list[tuple[int, str]], separator: str, file: str) -> list[tuple[int, list[str]]]:
    """Numbers and cells of lines; in the last lines, as far as these have nothing but numbers, numbers may touch."""
    cells = [(number, _split(line, separator, f"{file}, line {number}")) for number, line in lines]
    texts = [line for _, line in reversed(lines)]
    plain = (_NUMBERS.fullmatch(line) and (separator == " " or separator not in line) for line in texts)
    first = len(lines) - sum(1 for _ in itertools.takewhile(bool, plain))
    if any(cell.count(".") > 1 for _, row in cells[first:] for cell in row):
        touching = number_cells([line for _, line in lines[first:]])
        cells[first:] = [(number, row) for (number, _), row in zip(lines[first:], touching, strict=True)]
    return cells


def _along_rows(lines: list[tuple[int, list[str]]], file: str) -> list[tuple[int, list[str]]]:
    """One row per number, below lines of text. All lines of numbers but the last one have the same number of them."""
    above = sum(1 for _ in itertools.takewhile(lambda line: _is_title(line[1]), lines))
    width = len(lines[above][1]) if above < len(lines) else 0
    for number, cells in lines[above:]:
        if not all(map(_known, cells)):
            wrong = next(cell for cell in cells if not _known(cell))
            raise ValueError(f"{file}, line {number}: expected numbers below lines of text, got {wrong[:100]!r}")
        if len(cells) != width and (number != lines[-1][0] or len(cells) > width):
            raise ValueError(f"{file}, line {number}: expected {width} numbers as in the first row, got {len(cells)}")
    return [(number, [cell]) for number, cells in lines[above:] for cell in cells]


def _is_title(cells: list[str]) -> bool:
    """Whether a line has words, and no more numbers than other cells: a damaged row of numbers is no title."""
    return any(re.search("[A-Za-z]{2}", cell) for cell in cells) and 2 * sum(map(_known, cells)) <= len(cells)


def _announced(lines: list[tuple[int, list[str]]], file: str) -> tuple[list[tuple[int, list[str]]], list[str]] | None:
    """One row per number below a line with their number and step, and title and step as comments; None without it.

    eqsig writes this line above one sample per line, RSPMatch above several ones. In a table, the line would have as
    many cells as the rows.
    """
    heads = [" ".join(cells).split() for _, cells in lines[:_LAST_LINES]]
    place = next((k for k, head in enumerate(heads) if head and all(map(is_number, head))), len(lines))
    rows = lines[place + 1 :]
    if not rows or not _announces(heads[place]) or len(rows[0][1]) == len(heads[place]):
        return None
    if not all(map(_known, itertools.chain.from_iterable(cells for _, cells in rows))):
        return None
    numbers = _along_rows(rows, file)
    check_count(len(numbers), parse_count(heads[place][0], file), f"{file}, line {lines[place][0]}")
    title = [" ".join(cells) for _, cells in lines[: min(place, 1)]]
    return numbers, [*title, f"dt = {heads[place][1]} s"]


def _announces(head: list[str]) -> bool:
    """Whether the cells of a line are a number of samples, a step below one second, and at most another integer."""
    return 2 <= len(head) <= 3 and all(map(str.isdecimal, (head[0], *head[2:]))) and bool(_STEP.fullmatch(head[1]))


def _split(line: str, separator: str, where: str) -> list[str]:
    if separator == " ":
        return line.split()
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=separator != "\t"))
    except csv.Error as error:
        raise ValueError(f"{where}: expected cells separated by {separator!r} ({error})") from None
    cells = [cell.strip() for cell in cells]
    if not _SPACE.search(line):
        return cells
    return [cell.translate(_SPACES) if _SPACED.match(cell) else cell for cell in cells]


def _find_separator(lines: Sequence[str]) -> str:
    """The separator that splits most lines into several numbers, or into one number if no separator does."""
    best, most = " ", (0, 0)
    for separator in _SEPARATORS:
        widths: Counter[int] = Counter()
        for line in lines:
            try:
                cells = _split(line, separator, "")
            except ValueError:
                continue
            if any(_known(cell) for cell in cells) and all(_known(cell) or _is_missing(cell) for cell in cells):
                widths[len(cells)] += 1
        width, count = max(widths.items(), key=lambda item: item[1], default=(0, 0))
        if (count * (width > 1), count) > most:
            best, most = separator, (count * (width > 1), count)
    if most == (0, 0):  # no line of numbers: the separator that is there, for the message
        best = next((each for each in _SEPARATORS if any(each in line for line in lines)), " ")
    return best


def _known(cell: str) -> bool:
    return not _is_missing(cell) and (
        is_number(cell)
        or bool(_DECIMAL_COMMA.match(cell))
        or bool(_GROUPED.match(cell))
        or is_clock(cell)
        or is_date(cell)
    )


def _is_missing(cell: str) -> bool:
    return cell.lower() in _MISSING


def _arrange(lines: list[tuple[int, list[str]]], comments: list[str], file: str, separator: str) -> Rows:
    """Find header line, line of units and rows of numbers."""
    data = itertools.islice((place for place, (_, cells) in enumerate(lines) if _is_data(cells)), _LAST_LINES)
    places = list(data)
    if places:
        # the width of most first rows: a number above the table is no row
        width = Counter(len(lines[place][1]) for place in places).most_common(1)[0][0]
        first = next(place for place in places if len(lines[place][1]) == width)
    else:
        width, first = max((len(cells) for _, cells in lines), default=0), len(lines)
    spare = not any(cells[-1] for _, cells in lines[first:] if len(cells) == width)
    names, units, after = _find_header(lines[:first], width, spare)
    if not names:
        _check_short_header(lines[:first], width, file)
        # a damaged first row is an error and no text above the table, and a row of missing samples is a row
        after = next((k for k in range(first) if len(lines[k][1]) == width and _is_row(lines[k][1])), first)
    rows = lines[after:]
    if not rows:
        raise ValueError(f"{file}: expected rows of numbers, found none")
    for number, cells in rows:
        if len(cells) != width:
            advice = ""
            if not names and len(cells) < width and number == rows[-1][0] and all(map(_known, cells)):
                advice = "; if the samples follow each other along the rows, give column='rows' and dt="
            raise ValueError(
                f"{file}, line {number}: expected {width} cells as in the first line, got {len(cells)}{advice}"
            )
    rows = _ungrouped(rows, file)
    _check_thousands(rows, file, separator)
    return _without_empty_columns(names, units, _with_points(rows, file), comments)


def _is_data(cells: Sequence[str]) -> bool:
    return any(_known(cell) for cell in cells) and all(_known(cell) or _is_missing(cell) for cell in cells)


def _is_row(cells: Sequence[str]) -> bool:
    """Whether some cells are numbers, or all are missing and not all empty."""
    return any(map(_known, cells)) or (any(cells) and all(map(_is_missing, cells)))


def _check_short_header(lines: Sequence[tuple[int, list[str]]], width: int, file: str) -> None:
    """Raise ValueError if the line above the rows has one name fewer than the rows have cells."""
    number, cells = lines[-1] if lines else (0, [])
    if width > 2 and len(cells) == width - 1 and _is_text(cells) and all(cells):
        raise ValueError(
            f"{file}, line {number}: expected a name for each of the {width} cells in a row, got {len(cells)}; write "
            "decimal points, or semicolons between the cells, if commas separate cells and decimals; leave out the "
            "names of rows, in R with row.names = FALSE"
        )


def _check_decimal_commas(lines: Sequence[tuple[int, list[str]]], file: str) -> None:
    """Raise ValueError if the line above the rows has half as many names as the rows have cells without a point."""
    first = next((k for k, (_, row) in enumerate(lines) if _is_data(row)), 0)
    number, names = lines[first - 1] if first else (0, [])
    rows = [row for _, row in lines[first : first + _LAST_LINES]]
    if (
        rows
        and 2 * len(names) == len(rows[0])
        and _is_text(names)
        and all(names)
        and not any("." in "".join(r) for r in rows)
    ):
        raise ValueError(
            f"{file}, line {number}: expected a name for each of the {len(rows[0])} cells in a row, got {len(names)}: "
            "commas separate cells and decimals. Numbers with decimal commas need another separator between columns, "
            "such as ';'"
        )


def _ungrouped(rows: list[tuple[int, list[str]]], file: str) -> list[tuple[int, list[str]]]:
    """Rows without separators of thousands, if a number such as ``1,234.5`` or ``1.234.567`` shows which mark it is."""
    marked = ((number, cell) for number, cells in rows for cell in cells if "," in cell or cell.count(".") > 1)
    found = next((each for each in marked if _GROUPED.match(each[1])), None)
    if found is None:
        return rows
    mark = next(letter for letter in found[1] if letter in ",.")
    decimal = "." if mark == "," else ","
    grouped = re.compile(rf"[-+]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}})+(?:\{decimal}\d*)?$")
    for number, cells in rows:
        for k, cell in enumerate(cells):
            if mark in cell and grouped.match(cell):
                cells[k] = cell.replace(mark, "")
            elif mark in cell and not (is_clock(cell) or is_date(cell)) and _known(cell):
                raise ValueError(
                    f"{file}: {mark!r} separates thousands in {found[1]!r}, line {found[0]}, but not in {cell!r}, line "
                    f"{number}; write all numbers alike, without separators of thousands"
                )
    return rows


def _check_thousands(rows: list[tuple[int, list[str]]], file: str, separator: str) -> None:
    """Raise ValueError for cells such as ``1,000`` that may be thousands.

    They are taken for numbers with three decimals unless commas separate the cells and the file has no other decimal
    comma, or the column has no other decimal comma and integers of three digits.
    """
    if not any("," in cell for _, cells in rows for cell in cells):
        return
    thousands: dict[int, tuple[int, str]] = {}  # the first such cell of each column
    decimals, hundreds = set(), set()  # columns
    for number, cells in rows:
        for column, cell in enumerate(cells):
            if _THOUSANDS.match(cell):
                thousands.setdefault(column, (number, cell))
            elif _DECIMAL_COMMA.match(cell):
                decimals.add(column)
            elif _HUNDREDS.match(cell):
                hundreds.add(column)
    for column, (number, cell) in thousands.items():
        if (separator == "," and not decimals) or (column in hundreds and column not in decimals):
            raise ValueError(
                f"{file}, line {number}: expected a number, got {cell!r}, which may have a separator of thousands or a "
                "decimal comma; write it without separators of thousands and with a decimal point"
            )


def _find_header(
    lines: Sequence[tuple[int, list[str]]], width: int, spare: bool
) -> tuple[tuple[str, ...], tuple[str, ...], int]:
    """Names, units and the place after them: the last line of words as wide as the rows, and a line of units below.

    Separators at the ends of the rows may be missing at the end of the header line, and the other way round. Only then,
    if the last cells of all rows are empty (`spare`), the header line may have one cell less.
    """
    found: list[tuple[int, tuple[str, ...]]] = []
    for place, (_, cells) in enumerate(lines):
        words = list(cells)
        while len(words) > width and not words[-1]:
            words.pop()
        if spare and len(words) == width - 1 and width > 2:
            words.append("")
        states = width == 1 and any(read_statements(words))  # a line such as "Time step: 10 ms" names no column
        if len(words) == width and _is_text(words) and not states:
            found.append((place, tuple(words)))
    if not found:
        return (), (), len(lines)
    place, last = found[-1]
    if len(found) > 1 and found[-2][0] == place - 1 and _are_units(last):
        return found[-2][1], tuple(cell.strip("[]() ") for cell in last), place + 1
    return last, (), place + 1


def _are_units(cells: Sequence[str]) -> bool:
    """Whether a line below a header line has units: all cells are units, one is a unit of time, or all are in brackets.

    Cells that are no known unit are refused when their column is read.
    """
    given = [cell for cell in cells if cell]
    if all(map(_unit_of, given)) or all(cell[0] + cell[-1] in ("()", "[]") for cell in given):
        return True
    return any(_is_time_unit(cell) for cell in given)


def _is_time_unit(cell: str) -> bool:
    """Whether a cell is a unit of time; a capital S may be the direction south."""
    text = _unit_of(cell)
    return text != "" and text != "S" and find_unit(text).dimension == "time"


def _is_text(cells: Sequence[str]) -> bool:
    words = any(any(map(str.isalpha, cell)) and not _is_missing(cell) for cell in cells)
    return words and not any(_known(cell) for cell in cells)


def _unit_of(cell: str) -> str:
    """The unit that a cell consists of, with or without brackets; an empty string if the cell is no unit."""
    text = cell.strip("[]() ")
    try:
        find_unit(text)
    except ValueError:
        return ""
    return text


def _with_points(rows: list[tuple[int, list[str]]], file: str) -> list[tuple[int, list[str]]]:
    """Rows with decimal points and empty strings for missing cells."""
    commas = [(number, cell) for number, cells in rows for cell in cells if _DECIMAL_COMMA.match(cell)]
    if commas:
        point = next(((n, cell) for n, cells in rows for cell in cells if "." in cell and is_number(cell)), None)
        if point is not None:
            raise ValueError(
                f"{file}: expected decimal points or decimal commas, got {commas[0][1]!r} in line {commas[0][0]} and "
                f"{point[1]!r} in line {point[0]}; write all numbers alike, without separators of thousands"
            )
    swap = bool(commas)
    return [
        (number, ["" if _is_missing(c) else c.replace(",", ".") if swap and _known(c) else c for c in cells])
        for number, cells in rows
    ]


def _without_empty_columns(
    names: tuple[str, ...], units: tuple[str, ...], rows: list[tuple[int, list[str]]], comments: list[str]
) -> Rows:
    """Rows without columns that have neither a name nor a number, such as after a separator at the end of each line."""
    width = len(rows[0][1])
    empty = {k for k in range(width) if (not names or not names[k]) and not any(cells[k] for _, cells in rows)}
    if not empty or len(empty) == width:
        return Rows(names, units, rows, comments)
    kept = [k for k in range(width) if k not in empty]
    names, units = (tuple(each[k] for k in kept) if each else () for each in (names, units))
    return Rows(names, units, [(number, [cells[k] for k in kept]) for number, cells in rows], comments)


def _workbook(path: str | Path) -> list[tuple[int, list[str]]]:
    """Non-empty rows in the first sheet of an Excel workbook; formulas have their stored values."""
    try:
        from openpyxl import load_workbook
    except ImportError as error:
        raise ValueError(
            f"reading {path} needs the package openpyxl: install it with pip install openpyxl, or save the sheet as CSV"
        ) from error
    read_bytes(path)  # the checks of existence and size
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > min(_LARGEST_WORKBOOK, LARGEST_FILE):
            raise ValueError(f"{path}: expected a workbook of at most {_LARGEST_WORKBOOK} bytes, got {size}")
        book = load_workbook(path, read_only=True, data_only=True)
        sheet, rows, count = book.worksheets[0], [], 0
        for number, values in enumerate(sheet.iter_rows(values_only=True), 1):
            count += len(values)
            if count > _MOST_CELLS:
                raise ValueError(f"{path}: expected at most {_MOST_CELLS} cells; save the table as CSV")
            cells = ["" if value is None else _cell_text(value) for value in values]
            if any(cells) and not cells[0].startswith("#"):
                rows.append((number, cells))
        book.close()
    except ValueError:
        raise
    except Exception as error:  # a damaged workbook may raise anything
        raise ValueError(f"{path}: not a readable Excel workbook ({error}); save it as CSV") from error
    width = max((len(cells) for _, cells in rows), default=0)
    return [(number, cells + [""] * (width - len(cells))) for number, cells in rows]


def _cell_text(value: object) -> str:
    return repr(float(value)) if isinstance(value, int | float) and not isinstance(value, bool) else str(value).strip()
