"""Damaged and hostile input files: ValueError, in a short time."""

import time

import h5py
import numpy as np
import pytest

from fe_likelihoods import Channel, Measurements, Record
from fe_likelihoods.signals.datasets import read_dataset, write_dataset
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.units import G0
from tests.faults.fuzz_readers import fuzz, wrong_in_silence, zipped
from tests.signals.test_readers import cosmos

SECONDS = 3.0


def refused(read, path, content, match):
    """The reader raises ValueError with this message, soon."""
    path.write_bytes(content)
    start = time.perf_counter()
    with pytest.raises(ValueError, match=match):
        read(path)
    assert time.perf_counter() - start < SECONDS


def test_fuzz(tmp_path):
    assert fuzz(420, 1, tmp_path) == []


@pytest.mark.parametrize("number", [400, pytest.param(1500, marks=pytest.mark.slow)])
def test_altered_styles_of_loggers_are_refused_or_read_right(number, tmp_path):
    assert wrong_in_silence(number, 1, tmp_path / "a.csv") == []


def test_control_of_altered_styles(tmp_path, monkeypatch):
    """A reader that takes the last mark of a cell for its decimal point is found."""
    monkeypatch.setattr("tests.faults.fuzz_readers.read_record", careless)
    assert len(wrong_in_silence(300, 1, tmp_path / "a.csv")) > 50


def careless(path, column=None):
    """A reader without checks: times and values of all rows that have two numbers."""
    rows = [line.replace(",", ".").replace(";", " ").split() for line in path.read_text(encoding="utf-8").splitlines()]
    values = [float(row[-1]) for row in rows if len(row) > 1 and row[-1].replace(".", "", 1).lstrip("-").isdigit()]
    if len(values) < 2:
        raise ValueError
    return Record("a", 0.02, G0 * np.array(values))


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: zipped([(f"{i}.v2", b"") for i in range(5000)]), "at most 2000 files with"),
        (lambda: zipped([(f"{i}.v2", b"\0" * 2**23) for i in range(20)]), "at most 2000 files with"),
        (
            lambda: zipped([(f"{k}.zip", zipped([(f"{i}.v2", b"\0" * 2**22) for i in range(9)])) for k in "abc"]),
            "at most 2000 files with",
        ),
    ],
    ids=["many", "large", "nested and large"],
)
def test_archives_have_total_limits(make, match, tmp_path):
    content = make()
    assert len(content) < 2**20
    refused(read_record, tmp_path / "a.zip", content, match)


def table(text):
    return "a.csv", text


def at2(header):
    return "a.at2", f"P\nS\nUNITS OF G\n{header}\n1 2"


def v2(form="(1E15.6)", count="       3"):
    return "a.v2", "\n".join(cosmos(1, np.ones(3), 0.01, form=form)).replace("       3 acc", f"{count} acc")


@pytest.mark.parametrize(
    ("file", "match"),
    [
        *((table("# dt=" + "9" * 100_000 + unit + "\nacc_g\n1\n2\n"), "give dt=") for unit in ("", " s")),
        (table("# npts = " + "9" * 5000 + "\n# dt = 1 s\nacc_g\n1\n2\n"), "announces 9{20} samples"),
        (table('time_s,acc_g\n0,"' + "1" * 200_000 + '"\n'), "cells separated by ','"),
        (table("time_s,acc_g\n0,1_000\n1,2\n"), "expected a number, got '1_000'"),
        (table("time_s,acc_g\n0e400,1\n1,2\n2,x\n"), "expected a number, got 'x'"),
        (table("time_s,acc" + "_g" * 50_000 + "(" * 50_000 + "\n0,1\n1,2\n"), "unit"),
        (at2("DT " + "NPTS=1 " * 30_000), "expected a header line"),
        (at2("NPTS, DT\n1 1" + " " * 100_000 + "x"), "expected a header line"),
        (at2("NPTS= " + "9" * 5000 + ", DT= .01"), "announces 9{20} samples"),
        (at2("NPTS= 2, DT= 0" + "1" * 100_000 + "e999999"), "positive|finite"),
        *(
            (v2(form), "expected a Format such as .* of 1 to 1000 numbers")
            for form in ("(1F0.5)", "(0F10.5)", "(1F99999999999999.5)", "(9999F1.1)")
        ),
        (v2(count="9" * 400), "found none in 1 file"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else None,
)
def test_hostile_texts(file, match, tmp_path):
    name, text = file
    refused(read_record, tmp_path / name, text.encode(), match)


def test_hdf5_that_declares_more_than_it_contains(tmp_path):
    top = Channel("top", "absolute acceleration", "g")
    path, values = tmp_path / "a.h5", np.ones(5)
    write_dataset(path, Record("a", 0.01, values), Measurements((top,), 0.01, values[None]))
    with h5py.File(path, "a") as file:
        attributes = dict(file["record/acceleration"].attrs)
        del file["record/acceleration"]
        file.create_dataset("record/acceleration", (10**11,), dtype="<f8", chunks=(1024,)).attrs.update(attributes)
    refused(read_dataset, path, path.read_bytes(), "not a complete data set")
