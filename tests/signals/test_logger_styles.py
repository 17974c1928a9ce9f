"""Styles of logger files: each is read right, or refused with a sentence that says what to do."""

import numpy as np
import pytest

from fe_likelihoods import Channel, read_columns
from fe_likelihoods.signals.read import read_record
from fe_likelihoods.units import G0, to_si
from tests.signals.logger_styles import ACCELERATION, COLUMNS, READ, REFUSED, STEP

TOP = Channel("top", "acceleration", "g")


@pytest.mark.parametrize("style", READ)
def test_styles_that_are_read(tmp_path, style):
    path = tmp_path / "a.txt"
    path.write_text(READ[style], encoding="utf-8")
    column = COLUMNS.get(style)
    record = read_record(path, column=column)
    assert record.dt == pytest.approx(STEP, rel=1e-12)
    np.testing.assert_allclose(record.acceleration / G0, ACCELERATION, atol=6e-6)


@pytest.mark.parametrize("style", REFUSED)
def test_styles_that_are_refused(tmp_path, style):
    text, message = REFUSED[style]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_record(tmp_path / "a.txt", column=COLUMNS.get(style))


def test_zero_as_clock_time_of_unix_times(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(READ["Unix milliseconds"])  # begins at 10:32:07 UTC
    for zero in ("2024-05-14T10:32:05Z", "14.05.2024 12:32:05+02:00", 1715682725.0):
        assert read_columns(path, (TOP,), ("acc_g",), zero=zero).start == pytest.approx(2.0, abs=1e-6)
    for zero in ("10:32:05", "2024-05-14T10:32:05"):
        with pytest.raises(ValueError, match="are Unix times: give zero='.*' with date and time zone"):
            read_columns(path, (TOP,), ("acc_g",), zero=zero)


def test_a_unix_time_beside_an_elapsed_one(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("timestamp_ms,time_s,acc_g\n1715682727000,0.00,1\n1715682727020,0.02,2\n1715682727040,0.04,3\n")
    assert read_columns(path, (TOP,), ("acc_g",)).start == 0.0
    path.write_text("timestamp_ms,time_s,acc_g\n1715682727000,0.00,1\n1715682727020,0.02,2\n1715682727080,0.04,3\n")
    with pytest.raises(ValueError, match="the columns 'time_s' and 'timestamp_ms' have different times"):
        read_columns(path, (TOP,), ("acc_g",))


@pytest.mark.parametrize(
    ("cell", "value"),
    [("1,234.5", 1234.5), ("-12,345,678", -12345678.0), ("1'234.5", 1234.5), ("1 234.5", 1234.5), ("1.5D+03", 1500.0)],
)
def test_numbers_of_other_countries_and_programs(tmp_path, cell, value):
    (tmp_path / "a.csv").write_text(f"time_s;acc [mm/s2]\n0.0;1\n0.1;{cell}\n")
    assert read_record(tmp_path / "a.csv").acceleration[1] == pytest.approx(1e-3 * value, rel=1e-12)


def test_micro_and_milli():
    for name in ("us", "µs", "μs", "microseconds", "microsec"):
        assert to_si(1.0, name, "time") == 1e-6
    for name in ("ms", "milliseconds", "msec"):
        assert to_si(1.0, name, "time") == 1e-3
    assert to_si(1.0, "mg", "acceleration") == 1e-3 * G0
