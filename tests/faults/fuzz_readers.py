"""Damaged input files: every reader returns, or raises ValueError, within a few seconds.

Files are made from small valid ones by flipping, deleting, repeating and inserting bytes.

Styles of logger files are also changed in the marks between their digits and in the order of their rows: they must be
refused, or read with the same samples (`altered`).
"""

import io
import random
import time
import zipfile
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fe_likelihoods import Channel, Measurements, Record, read_columns, read_record
from fe_likelihoods.command.listing import describe_data
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.units import G0
from tests.signals.logger_styles import ACCELERATION, COLUMNS, READ, STEP
from tests.signals.network_files import csmip_v1, esm, geonet, knet, smc
from tests.signals.test_readers import cosmos, csmip
from tests.signals.test_trade_files import EQSIG, ROWS, RSPMATCH, afad

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
    rows = "\n".join("".join(f"{value:15.7E}" for value in values[i : i + 5]) for i in range(0, 23, 5))
    at2 = [
        f"PEER\nSomewhere\nACCELERATION TIME SERIES IN UNITS OF G\n{header}\n{rows}".encode()
        for header in ("NPTS=  23, DT= .005 SEC", "  23  0.005  NPTS, DT")
    ]
    csv = [
        b"# units: g; dt = 0.5 s\n# npts = 3\nacc\n1\n2\n3\n",
        b"time_s,acc_g\n0,1\n0.5,2\n1,3\n",
        b"Time(s)  a(g)\n0 1\n0.5 2\n1 3\n",
        "Logger 7\nZeit [s];a [m/s²];\n0,0;1,5;\n0,5;2,0;\n1,0;-3;\n".encode(),
        "Time\tAcc\ns\tm/s²\n0\t1\n0.5\t2\n1\t3\n".encode("utf-16"),
    ]
    record, measured = Record("a", 0.01, values), Measurements((TOP,), 0.01, values[None])
    write_dataset(folder / "valid.h5", record, measured, {"truth": [1.0, 2.0]})
    forms = [csmip(1, values, 0.0125, " .013 sec, in cm/sec2. (8f10.6)"), cosmos(1, values, 0.005)]
    v2 = ["\n".join(lines).encode() for lines in forms]
    v2 += ["\n".join(csmip_v1(values, 200, pairs, channel=1)).encode() for pairs in (False, True)]
    styles = [text.encode() for text in READ.values()]
    uneven = "\n".join(smc(values, 1.7e38, times=0.01 * np.arange(23) ** 1.01)).encode()
    archives = [
        zipped([("a.v2", v2[0]), ("inner.zip", zipped([("b.V2", "\n".join(cosmos(2, values, 0.005)).encode())]))])
    ]
    networks = (
        ("smc", read_record, smc(values, 200.0)),
        ("V2A", lambda path: read_record(path, "Up"), geonet({"N": values, "Up": 2.0 * values}, 0.02)),
        ("NS", read_record, knet(np.round(1e4 * values).astype(int), 1)),
        ("asc", read_record, esm(values, 0.005)),
    )
    return [
        Case("at2", read_record, at2),
        Case("v2", lambda path: read_record(path, channel=1), v2),
        Case("zip", lambda path: read_record(path, channel=1), archives),
        *(Case(name, read, ["\n".join(lines).encode()]) for name, read, lines in networks),
        Case("any", read_record, [*at2, *csv, v2[0], *("\n".join(lines).encode() for _, _, lines in networks)]),
        Case("csv", read_record, csv + styles),
        Case("acc", lambda path: read_record(path, units="g"), [text.encode() for text in (EQSIG, RSPMATCH)]),
        Case("afad", read_record, [afad(("N-S",)).encode()]),
        Case("dat", lambda path: read_record(path, "rows", "g", dt=0.01), ["\n".join(ROWS).encode()]),
        Case("uneven.csv", lambda path: read_record(path, resample=0.02), csv + styles),
        Case("uneven.smc", lambda path: read_record(path, resample=0.01), [uneven]),
        Case("listed", describe_data, [*at2, *csv, *styles, *v2, uneven, archives[0]]),
        Case("columns.csv", lambda path: read_columns(path, [TOP], ["acc_g"]), csv[1:2]),
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
    """What came of one file: "read", "ValueError", the name of another exception, or "slow"."""
    path.write_bytes(data)
    start = time.perf_counter()
    try:
        case.read(path)
        found = "read"
    except ValueError:
        found = "ValueError"
    except Exception as error:
        found = type(error).__name__
    return "slow" if time.perf_counter() - start > SLOW else found


def fuzz(number, seed, folder):
    """Read damaged files; a Counter of (reader, what came of it), and the bad ones as (reader, what, bytes)."""
    folder.mkdir(exist_ok=True)
    all_cases, counts, bad = cases(folder), Counter(), []
    for index in range(number):
        choose = random.Random(1_000_003 * seed + index)
        case = all_cases[index % len(all_cases)]
        data = damage(choose.choice(case.files), choose)
        found = read_damaged(case, data, folder / f"damaged.{case.name}")
        counts[case.name, found] += 1
        if found not in ("read", "ValueError"):
            bad.append((case.name, found, index))
    return counts, bad
