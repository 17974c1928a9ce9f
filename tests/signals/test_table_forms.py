"""CSV files as users write them: spellings of units, clock times, lines of units, and text above the table."""

import datetime

import numpy as np
import pytest

from fe_likelihoods import Channel, read_columns, read_record
from fe_likelihoods.signals.tables import unit_in_name
from fe_likelihoods.units import G0

TOP = Channel("top", "acceleration", "g")
ROWS = "0.00,1\n0.01,2\n0.02,4\n"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("moment_kN_m", "kN m"),
        ("moment_MN_m", "MN m"),
        ("base_kip_in", "kip in"),
        ("moment [kN.m]", "kN m"),
        ("moment_lbf_ft", "lbf ft"),
        ("disp_c_m", "m"),
        ("strain_m_m", "m"),
        ("acc_m_s2", "m/s2"),
        ("kappa_1_m", "1/m"),
        ("Time (seconds)", "s"),
        ("time_secs", "s"),
        ("Time [milliseconds]", "ms"),
        ("acc (cm/sec/sec)", "cm/s2"),
    ],
)
def test_units_in_names(name, unit):
    assert unit_in_name(name) == unit


def test_letters_of_directions_are_no_units(path):
    path.write_text("time_s,acc_N,acc_S\n0.00,1,3\n0.01,2,4\n")
    north, south = read_record(path, units="g", column="acc_N"), read_record(path, units="g", column="acc_S")
    np.testing.assert_allclose([north.acceleration, south.acceleration], G0 * np.array([[1, 2], [3, 4]]))
    with pytest.raises(ValueError, match="does not state the unit of its acceleration"):
        read_record(path, column="acc_N")
    path.write_text("time_s,base_N\n0.00,1\n0.01,2\n")
    force = Channel("base", "force", "kN")
    assert read_columns(path, (force,), ("base_N",)).values.tolist() == [[1.0, 2.0]]
    with pytest.raises(ValueError, match="states the unit 'N' but units = 'kN'"):
        read_columns(path, (force,), ("base_N",), "kN")


@pytest.mark.parametrize("units", ["s,furlong", "(s),(furlong)", ",[furlong]"])
def test_line_of_units_with_an_unknown_one(path, units):
    path.write_text(f"Time,Acc\n{units}\n{ROWS}")
    with pytest.raises(ValueError, match="unknown unit 'furlong'; known units: acceleration: m/s2"):
        read_record(path, time_unit="s")


def test_unknown_unit_of_a_column_that_is_not_read(path):
    path.write_text("Time,Acc,Status\ns,g,flag\n0.00,1,7\n0.01,2,7\n")
    np.testing.assert_allclose(read_record(path, column="Acc").acceleration / G0, [1, 2])
    path.write_text("Test,3,A\nTime_s,E,N\n0.00,1,7\n0.01,2,7\n")  # directions, no line of units
    np.testing.assert_allclose(read_record(path, units="g", column="N").acceleration / G0, [7, 7])


CLOCKS = {
    "label without unit": "Timestamp [hh:mm:ss],acc_g\n1:59:59.99,1\n2:00:00.00,2\n2:00:00.01,4\n",
    "noon with AM and PM": "Time,acc_g\n11:59:59.99 AM,1\n12:00:00.00 PM,2\n12:00:00.01 PM,4\n",
    "midnight with AM and PM": "Time,acc_g\n11:59:59.99 p.m.,1\n12:00:00.00 a.m.,2\n12:00:00.01 a.m.,4\n",
    "one o'clock with AM and PM": "Time,acc_g\n12:59:59.99 PM,1\n01:00:00.00 PM,2\n01:00:00.01 PM,4\n",
    "date with AM and PM": "Time,acc_g\n2019-07-06 11:59:59.99 PM,1\n2019-07-07 12:00:00.00 AM,2\n"
    "2019-07-07 12:00:00.01 AM,4\n",
    "midnight": "Time,acc_g\n23:59:59.99,1\n00:00:00.00,2\n00:00:00.01,4\n",
    "dates": "UTC,acc_g\n2019-12-31T23:59:59.990Z,1\n2020-01-01T00:00:00.000Z,2\n2020-01-01T00:00:00.010Z,4\n",
    "blanks, no header": "2019-07-06 03:19:53.00 1\n2019-07-06 03:19:53.01 2\n2019-07-06 03:19:53.02 4\n",
    "elapsed beside the clock": "Clock,time_s,acc_g\n03:19:53,0.00,1\n03:19:53,0.01,2\n03:19:53,0.02,4\n",
}


@pytest.mark.parametrize("text", CLOCKS.values(), ids=CLOCKS)
def test_clock_times(path, text):
    path.write_text(text)
    record = read_record(path, units="g")
    assert record.dt == 0.01
    np.testing.assert_allclose(record.acceleration / G0, [1, 2, 4])


def test_clock_times_begin_at_the_zero_of_the_record(path):
    path.write_text("Time,acc_g\n23:59:59.99,1\n00:00:00.00,2\n00:00:00.01,4\n")
    for zero, start in (("23:59:59.50", 0.49), (86399.5, 0.49), (0.0, 86399.99)):
        assert read_columns(path, (TOP,), ("acc_g",), zero=zero).start == pytest.approx(start, abs=1e-9)
    with pytest.raises(ValueError, match="the times have no date; give zero='2019-07-06T23:59:59.5' without one"):
        read_columns(path, (TOP,), ("acc_g",), zero="2019-07-06T23:59:59.5")
    path.write_text("Time,acc_g\n2020-01-01T00:00:01,1\n2020-01-01T00:00:02,2\n")
    assert read_columns(path, (TOP,), ("acc_g",), zero="2019-12-31T23:59:59").start == 2.0
    with pytest.raises(ValueError, match="the times have no time zone; give zero='2020-01-01T00:00:00Z' without one"):
        read_columns(path, (TOP,), ("acc_g",), zero="2020-01-01T00:00:00Z")
    path.write_text("Time,acc_g\n2020-01-01 08:00,1\n2020-01-01 08:10,2\n")  # minutes, with a date
    assert read_columns(path, (TOP,), ("acc_g",), zero="2020-01-01 07:50").start == 600.0
    path.write_text("Time,acc_g\n2020-01-01T00:00:01+02:00,1\n2020-01-01T00:00:02+02:00,2\n")
    for zero in ("2020-01-01T00:00:00", "2019-12-31T22:00:00Z", "2019-12-31 17:00:00-0500"):
        assert read_columns(path, (TOP,), ("acc_g",), zero=zero).start == 1.0
    path.write_text(f"time_s,acc_g\n{ROWS}")
    with pytest.raises(ValueError, match="zero='00:00:01' needs a column of clock times; give zero in seconds"):
        read_columns(path, (TOP,), ("acc_g",), zero="00:00:01")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("12:00:00.00,1\n12:00:00.01,2\n12:00:00.03,3\n12:00:00.04,3\n", "line 4: expected a uniform time step"),
        ("12:00:00,1\n12:00:00,2\n12:00:01,3\n", "expected a uniform time step"),
        ("12:00:00.00,1\nnoon,2\n12:00:00.02,3\n", "line 3: expected a clock time such as '03:19:53.010'.*got 'noon'"),
        ("12:00:00.00,1\n,2\n12:00:00.02,3\n", "line 3: expected a time, got an empty cell"),
        ("2019-02-30T12:00:00,1\n2019-02-30T12:00:01,2\n", "line 2: expected a date, got '2019-02-30T12:00:00'"),
        ("2019-02-03T12:00:00,1\n12:00:01,2\n", "expected a date in all clock times or in none"),
        ("12:00:00Z,1\n12:00:01+02:00,2\n", "expected one time zone in all clock times, got 2 kinds; write them alike"),
        (
            "12:59:59.99,1\n1:00:00.00,2\n1:00:00.01,3\n",
            "hours from 0 to 23, got 1 after 12 o'clock, as on a clock of 12 hours",
        ),
        ("13:00:00 PM,1\n13:00:01 PM,2\n", "line 2: .* hours from 1 to 12, got '13:00:00 PM'"),
        ("0:00:00 AM,1\n0:00:01 AM,2\n", "line 2: .* hours from 1 to 12, got '0:00:00 AM'"),
        ("11:59:59 AM,1\n12:00:00,2\n", "expected AM or PM in all clock times or in none"),
        ("03:19,1\n03:20,2\n", "line 2: expected a number, or a clock time such as"),  # or minutes and seconds
        ("99:00:00,1\n99:00:01,2\n", "line 2: .*hours from 0 to 23, got '99:00:00'"),
    ],
)
def test_clock_times_that_are_refused(path, text, message):
    path.write_text("Time,acc_g\n" + text)
    with pytest.raises(ValueError, match=message):
        read_record(path)


def test_clock_times_are_no_values(path):
    path.write_text("time_s,acc_g\n0.00,12:00:00\n0.01,12:00:01\n")
    with pytest.raises(ValueError, match="expected one column of values"):
        read_record(path)


@pytest.mark.parametrize(
    "preamble",
    [
        "Logger export, NPTS=3, DT=0.01",
        "Corrected accelerogram of test 3",
        "Uncorrected accelerogram\nSite 3",
        "2 CORRECTED ACCELEROGRAM",
        "Origin Time 12:00\nScale Factor 1",
    ],
)
@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_text_above_a_table_is_no_other_format(path, preamble, separator):
    path.write_text(f"{preamble}\ntime_s,acc_g\n{ROWS}".replace(",", separator))
    np.testing.assert_allclose(read_record(path).acceleration / G0, [1, 2, 4])
    path.write_text(f"{preamble}\ntime_s,acc\n{ROWS}")
    with pytest.raises(ValueError, match="does not state the unit of its acceleration"):  # not: looks like an AT2 file
        read_record(path)


def test_a_number_for_missing_samples_that_does_not_occur(path):
    path.write_text("time_s,acc_g\n0.00,1\n0.01,-9999.9\n0.02,4\n")
    reads = (
        lambda: read_record(path, missing=(-9999,)),
        lambda: read_record(path, missing=(-9999,)),
        lambda: read_columns(path, (TOP,), ("acc_g",), missing=(-9999,)),
    )
    for read in reads:
        with pytest.warns(UserWarning, match="missing=-9999 is in none of the columns") as caught:
            read()
        assert [warning.filename for warning in caught] == [__file__]


def test_clock_times_of_a_workbook(tmp_path):
    book = pytest.importorskip("openpyxl").Workbook()
    start = datetime.datetime(2019, 7, 6, 3, 19, 53)
    book.active.append(["Time", "acc_g"])
    for k, value in enumerate([1, 2, 4]):
        book.active.append([start + datetime.timedelta(seconds=0.5 * k), value])
    book.save(tmp_path / "a.xlsx")
    record = read_record(tmp_path / "a.xlsx")
    assert record.dt == 0.5
    np.testing.assert_allclose(record.acceleration / G0, [1, 2, 4])
