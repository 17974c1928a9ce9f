"""Damaged input files: every reader returns, or raises ValueError, within a few seconds.

Styles of logger files with other marks between digits, or another order of rows, are refused or read right (`altered`).
"""

import io
import random
import time
import zipfile
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from fe_likelihoods import Channel, Measurements, Record, read_columns, read_record
from fe_likelihoods.command.describe_files import describe_data
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.units import G0
from tests.signals.logger_styles import ACCELERATION, COLUMNS, READ, STEP
from tests.signals.network_files import smc
from tests.signals.test_trade_files import FILES

SLOW = 5.0
TOKENS = (
    b"1" * 5000,
    b"9" * 100_000,
    b"1e99999",
    b"0e400",
    b"1_000",
    b"nan",
    b"(0F0.5)",
    b"NPTS=1 " * 3000,
    b" " * 20_000,
    b"\n" * 5000,
    b'",\r"',
    b"units" * 3000,
    b"((1f1.1" * 2000,
    b"_" * 5000,
    b"\0",
    b"\xff",
    b"dt = ",
    b"-",
    b",",
)
TOP = Channel("top", "absolute acceleration", "g")


class Case(NamedTuple):
    """A reader and valid files for it."""

    name: str  # suffix of the files, with which the table names the reader
    read: Callable  # function of the path
    files: list[bytes]


def zipped(files):
    """A zip archive of names and contents."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files:
            archive.writestr(name, content)
    return stream.getvalue()


def cases(folder):
    """All readers with valid files."""
    values = np.sin(np.arange(23.0))
    record, measured = Record("a", 0.01, values), Measurements((TOP,), 0.01, values[None])
    write_dataset(folder / "valid.h5", record, measured, {"truth": [1.0, 2.0]})
    files = {form: content.encode() for form, (_, content, _) in FILES.items()}
    styles = [text.encode() for text in READ.values()]
    uneven = "\n".join(smc(values, 1.7e38, times=0.01 * np.arange(23) ** 1.01)).encode()
    archive = zipped([("a.v2", files["V2"]), ("inner.zip", zipped([("b.V2", files["V2c"])]))])
    return [
        *(Case(name, partial(read_record, **given), [content.encode()]) for name, content, given in FILES.values()),
        Case("zip", partial(read_record, column="a.v2"), [archive]),
        Case("any", read_record, [*files.values()]),
        Case("csv", read_record, styles),
        Case("uneven.csv", partial(read_record, resample=0.02), styles),
        Case("uneven.smc", partial(read_record, resample=0.01), [uneven]),
        Case("listed", describe_data, [*files.values(), *styles, uneven, archive]),
        Case("columns.csv", lambda path: read_columns(path, [TOP], ["acc_g"]), [files["commas"]]),
        Case("h5", read_dataset, [(folder / "valid.h5").read_bytes()]),
    ]


def damage(data, choose):
    """A damaged copy of a file."""
    data = bytearray(data)
    for _ in range(choose.choice((1, 1, 2, 5))):
        place = choose.randrange(len(data) + 1)
        end = min(len(data), place + choose.choice((1, 4, 40, 400)))
        kind = choose.randrange(6)
        if kind == 0 and place < len(data):
            data[place] ^= 1 << choose.randrange(8)
        elif kind == 1:
            del data[place:end]
        elif kind == 2:
            data[place:place] = data[place:end] * choose.choice((1, 10, 300))
        elif kind == 3:
            data[place:place] = choose.choice(TOKENS)
        elif kind == 4:
            data[place:end] = bytes(choose.randrange(256) for _ in range(end - place))
        else:
            del data[place:]
    return bytes(data)


MARKS = ",.;\t '\n\""


def altered(text, choose):
    """A text with one mark among the digits of its rows replaced or inserted, or a row left out, repeated or moved."""
    lines = text.splitlines()
    rows = [k for k, line in enumerate(lines) if sum(letter.isdigit() for letter in line) > 3 and k >= len(lines) - 8]
    row = choose.choice(rows[1:-1])
    kind = choose.randrange(5)
    if kind == 0:
        del lines[row]
    elif kind == 1:
        lines.insert(row, lines[row])
    elif kind == 2:
        lines[row], lines[row + 1] = lines[row + 1], lines[row]
    else:
        line = lines[row]
        places = [k for k, letter in enumerate(line) if letter in MARKS] if kind == 3 else range(1, len(line))
        place = choose.choice(list(places) or [1])
        lines[row] = line[:place] + choose.choice(MARKS) + line[place + (kind == 3) :]
    return "\n".join(lines) + "\n"


def wrong_in_silence(number, seed, path):
    """Altered texts that are read with other samples than the original, as (style, text)."""
    wrong = []
    styles = [style for style in READ if "without times" not in style]
    for index in range(number):
        choose = random.Random(1_000_003 * seed + index)
        style = styles[index % len(styles)]
        text = altered(READ[style], choose)
        path.write_text(text, encoding="utf-8")
        column = COLUMNS.get(style)
        try:
            record = read_record(path, column=column)
        except ValueError:
            continue
        found = record.acceleration / G0
        if found.shape != (8,) or abs(record.dt - STEP) > 1e-9 or np.abs(found - ACCELERATION).max() > 1e-5:
            wrong.append((style, text))
    return wrong


def read_damaged(case, data, path):
    """What was wrong with the reading of one file: another exception than ValueError, "slow", or nothing."""
    path.write_bytes(data)
    start, found = time.perf_counter(), ""
    try:
        case.read(path)
    except ValueError:
        pass
    except Exception as error:
        found = type(error).__name__
    return "slow" if time.perf_counter() - start > SLOW else found


def fuzz(number, seed, folder):
    """Read damaged files; the bad ones as (reader, what, number)."""
    all_cases, bad = cases(folder), []
    for index in range(number):
        choose = random.Random(1_000_003 * seed + index)
        case = all_cases[index % len(all_cases)]
        data = damage(choose.choice(case.files), choose)
        if found := read_damaged(case, data, folder / f"damaged.{case.name}"):
            bad.append((case.name, found, index))
    return bad
