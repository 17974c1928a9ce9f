"""Files as they come from networks, programs and editors: what is harmless is read, what contradicts is refused."""

import re
import tomllib
import warnings
import zipfile

import numpy as np
import pytest

from fe_likelihoods import Channel, read_columns, read_record
from fe_likelihoods.command.describe_files import describe_data
from fe_likelihoods.units import G0
from tests.signals.network_files import csmip_v1, esm, geonet, knet, smc
from tests.signals.test_readers import cosmos, csmip

TOP = Channel("top", "acceleration", "g")
VALUES = 30.0 * np.sin(0.3 * np.arange(61.0)) * np.exp(-0.02 * np.arange(61.0))
COUNTS = np.round(8000 + 5e4 * np.sin(0.2 * np.arange(100))).astype(int)
SAMPLES = np.round(0.1 * np.sin(0.3 * np.arange(40.0)), 4)


def text(*lines):
    return "\n".join([*lines, ""])


def columns(values, form, per_line):
    cells = [form.format(value) for value in values]
    return ["".join(cells[k : k + per_line]) for k in range(0, len(cells), per_line)]


def at2(values=SAMPLES, units="UNITS OF G", end=()):
    header = ("PEER NGA", "Nowhere", f"ACCELERATION TIME SERIES IN {units}", f"NPTS= {len(values)}, DT= .0100 SEC")
    return text(*header, *columns(values, "{:15.7E}", 5), *end)


def afad(names=("N-S",), dt="0.01", count=40, peaks=None, unit="gal", values=None):
    values = np.outer(SAMPLES, np.arange(1, len(names) + 1)) if values is None else values
    peaks = [np.abs(column).max() for column in values.T] if peaks is None else peaks
    return text(
        "STRONG GROUND MOTION RECORDS OF NOWHERE",
        f"NUMBER OF DATA          : {count}",
        f"SAMPLING INTERVAL (sec) : {dt}",
        f"RAW PGA VALUES ({unit})    : " + " ".join(f"({n}) {p:.4f}" for n, p in zip(names, peaks, strict=True)),
        "",
        "   ".join(names),
        *("   ".join(f"{value:.4f}" for value in row) for row in values),
    )


EQSIG = text("m1", "40 0.0100", *(f"{value:.4f}" for value in SAMPLES))
RSPMATCH = text("Matched to a spectrum", "   40  0.0100  12", *columns(SAMPLES, "{:15.6E}", 5))
ROWS = columns(SAMPLES[:39], "{:10.5f}", 8)  # the last row is short
FILES = {
    "AT2": ("a.AT2", at2(), {}),
    "SMC": ("a.smc", text(*smc(VALUES, 200.0)), {}),
    "GeoNet": ("a.V2A", text(*geonet({"Up": VALUES}, 0.02)), {}),
    "K-NET": ("a.NS", text(*knet(COUNTS, 100)), {}),
    "ESM": ("a.ASC", text(*esm(VALUES, 0.005)), {}),
    "V2": ("a.V2", text(*csmip(1, VALUES, 0.0125, " .013 sec, in cm/sec2. (8f10.6)")), {}),
    "V2c": ("a.V2c", text(*cosmos(1, VALUES, 0.005)), {}),
    "V1": ("a.V1", text(*csmip_v1(0.003 * VALUES, 200)), {}),
    "commas": ("a.csv", "time_s,acc_g\n0.00,1.25\n0.01,2.50\n0.02,3.75\n", {}),
    "tabs": ("a.txt", "time_s\tacc_g\tstate\n0.00\t1.25\t\n0.01\t2.50\t\n0.02\t3.75\t\n", {"column": "acc_g"}),
    "blanks": ("a.txt", "time_s acc_g\n0.00 1.25\n0.01 2.50\n0.02 3.75\n", {}),
    "one column": ("a.txt", "acc_g\n1.25\n2.50\n3.75\n", {"dt": 0.01}),
    "recorder": ("a.out", "0.01 -1.0 0.65\n0.02 -2.0 3.05\n", {"column": 3, "time_unit": "s", "units": "g"}),
    "AFAD": ("a.txt", afad(), {}),
    "eqsig": ("a.txt", EQSIG, {"units": "g"}),
    "RSPMatch": ("a.acc", RSPMATCH, {"units": "g"}),
    "rows": ("a.dat", text(*ROWS), {"units": "g", "dt": 0.01, "column": "rows"}),
}
EDITS = {
    "CRLF": lambda text: text.replace("\n", "\r\n").encode(),
    "CR CR LF": lambda text: text.replace("\n", "\r\r\n").encode(),
    "CR": lambda text: text.replace("\n", "\r").encode(),
    "UTF-8 with mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16 LE": lambda text: b"\xff\xfe" + text.encode("utf-16-le"),
    "UTF-16 BE": lambda text: b"\xfe\xff" + text.encode("utf-16-be"),
    "UTF-16 with ^Z and zeros": lambda text: (text + "\x1a\0\0").encode("utf-16"),
    "^Z": lambda text: (text + "\x1a").encode(),
    "^Z after the last number": lambda text: (text[:-1] + "\x1a").encode(),
    "zeros": lambda text: text.encode() + bytes(512),
    "blank lines": lambda text: (text + "\n \n\t\n\f").encode(),
    "no end of line": lambda text: text[:-1].encode(),
    "*** End Data ***": lambda text: (text + "*** End Data ***\n").encode(),
    "end of file, ^Z": lambda text: (text + "\n-- end of file --\nEOF\n\x1a").encode(),
    "blanks at the ends of lines": lambda text: text.replace("\n", "  \n").encode(),
}


def read(folder, name, content, **given):
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return read_record(path, **given)


def same(one, other):
    return one.dt == other.dt and one.acceleration.tobytes() == other.acceleration.tobytes()


@pytest.mark.parametrize("form", FILES)
def test_what_editors_and_transfers_do_changes_no_bit(tmp_path, form):
    name, content, given = FILES[form]
    expected = read(tmp_path, name, content, **given)
    wrong = [edit for edit, apply in EDITS.items() if not same(read(tmp_path, name, apply(content), **given), expected)]
    assert not wrong


@pytest.mark.parametrize(
    "form", ["AT2", "SMC", "GeoNet", "K-NET", "ESM", "V2", "V2c", "V1", "AFAD", "eqsig", "RSPMatch"]
)
def test_a_lost_row_of_a_file_that_states_its_number_of_samples_is_refused(tmp_path, form):
    name, content, given = FILES[form]
    lines = content.splitlines()
    for place in (-12, -13) if form == "V2" else (-2, -3, -4):  # V2 has velocities after the accelerations
        cut = text(*lines[:place], *lines[place + 1 :])
        with pytest.raises(ValueError, match="announces|expected|states a peak"):
            read(tmp_path, name, cut, **given)


def test_zeros_directly_after_a_number_of_a_table_may_have_cut_it(tmp_path):
    with pytest.raises(ValueError, match="line 3: expected a number, got '2.5"):
        read(tmp_path, "a.csv", b"time_s,acc_g\n0.00,1.25\n0.01,2.5\0\0\0")
    assert read(tmp_path, "a.AT2", at2()[:-1].encode() + bytes(3)).n_steps == 40  # its number of samples is stated


def test_overflow_and_words_at_the_end_are_no_closing_remarks(tmp_path):
    for last in ("*******", "overload", "NaN", "0.03,***", "0.03"):
        with pytest.raises(ValueError, match="line 4: expected"):
            read(tmp_path, "a.csv", f"time_s,acc_g\n0.00,1\n0.01,2\n{last}\n")
        if last != "overload":  # the number of samples is stated
            with pytest.raises(ValueError, match="line 13: expected|announces"):
                read(tmp_path, "a.AT2", at2(end=(last.replace(",", " "),)))
    lines = at2(end=("Processed by nobody",)).splitlines()
    assert read(tmp_path, "a.AT2", text(*lines)).n_steps == 40
    with pytest.raises(ValueError, match="announces 40 samples, the file has 35"):
        read(tmp_path, "a.AT2", text(*lines[:-2], lines[-1]))


@pytest.mark.parametrize("units", ["UNITS OF G", "UNITS OF G.", "the units are (g)", "units: g", "UNIT = G"])
def test_the_unit_of_an_at2_file_in_other_words(tmp_path, units):
    record = read(tmp_path, "a.AT2", at2(units=units))
    np.testing.assert_allclose(record.acceleration, SAMPLES * G0, rtol=1e-6)
    with pytest.raises(ValueError, match="states the unit '[gG]' but units = 'cm/s2'"):
        read_record(tmp_path / "a.AT2", units="cm/s2")


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (["-12.34567-0.12345", "0.5-1.5", "2.0"], [-12.34567, -0.12345, 0.5, -1.5, 2.0]),
        (
            [" -12.34567-100.12345", "  12.34567 100.12345", "   0.50000"],
            [-12.34567, -100.12345, 12.34567, 100.12345, 0.5],
        ),
        (
            [" 12.34567100.12345111.00000", "112.34567  0.12345 -1.00000", " -0.50000"],
            [12.34567, 100.12345, 111.0, 112.34567, 0.12345, -1.0, -0.5],
        ),
        (["-1.25E-03-2.50E+00", " 1.25E-03"], [-0.00125, -2.5, 0.00125]),
    ],
)
def test_numbers_that_touch(tmp_path, rows, expected):
    path = tmp_path / "a.dat"
    path.write_text(text(*rows))
    record = read_record(path, units="m/s2", dt=0.01, column="rows")
    np.testing.assert_array_equal(record.acceleration, expected)
    header = ("PEER", "Nowhere", "UNITS OF G", f"NPTS= {len(expected)}, DT= .01 SEC")
    np.testing.assert_allclose(read(tmp_path, "a.AT2", text(*header, *rows)).acceleration, G0 * np.array(expected))


@pytest.mark.parametrize("place", [0, 2, 4])
@pytest.mark.parametrize("mark", ["'", ",", " x ", ".."])
def test_a_damaged_row_never_shortens_the_samples(tmp_path, place, mark):
    for rows in (ROWS, [" 12.34567100.12345111.00000"] * 5):
        damaged = [*rows[:place], rows[place][:14] + mark + rows[place][14:], *rows[place + 1 :]]
        with pytest.raises(ValueError, match="expected"):
            read(tmp_path, "a.dat", text("A title of 1999", *damaged), units="g", dt=0.01, column="rows")
        intact = read(tmp_path, "a.dat", text("A title of 1999", *rows), units="g", dt=0.01, column="rows")
        assert intact.n_steps == (39 if rows is ROWS else 15)


@pytest.mark.parametrize("row", ["0.5-103-0.6-103", "12.34567100.123", "1.2.3", "0.092-0.07730"])
def test_numbers_that_may_be_split_in_two_ways_are_refused(tmp_path, row):
    for before in ("1.00000   2.00000", "1.00000   2.00000   3.00000", ""):
        with pytest.raises(ValueError, match="expected"):
            read(tmp_path, "a.dat", text(before, row), units="g", dt=0.01, column="rows")


# outputs without a header line ----------------------------------------------------------------------------------------


def advised(error):
    """The alternatives of a message, as arguments."""
    found = re.search(r"or give (.*?)\. Numbers with", str(error.value))[1]
    plain = {"units": "g"}
    for choice in re.split(r"; ", found):
        given = dict(re.findall(r"(column|time_unit)='?(\w+)'?", choice))
        yield plain | given | ({"dt": 0.01} if "dt=" in choice else {})


@pytest.mark.parametrize("width", [2, 7])
@pytest.mark.parametrize("times", [True, False])
def test_arguments_proposed_for_a_table_without_a_header_line_work(tmp_path, width, times):
    path, values = tmp_path / "disp.out", np.random.default_rng(width).normal(size=(9, width)).round(3)
    if times:
        values[:, 0] = 0.02 * np.arange(9)
    path.write_text(text(*(" ".join(f"{value:g}" for value in row) for row in values)))
    with pytest.raises(ValueError, match=f"{width} columns and no header line") as error:
        read_record(path, units="g")
    with_times, *choices = advised(error)
    if times:
        record = read_record(path, **with_times)
        np.testing.assert_array_equal(record.acceleration, values[:, 1] * G0)
        assert record.dt == 0.02
    else:
        with pytest.raises(ValueError, match="expected (a uniform time step|times that increase)"):
            read_record(path, **with_times)
    records = [read_record(path, **given) for given in choices]
    np.testing.assert_array_equal(records[0].acceleration, values[:, 0] * G0)
    np.testing.assert_array_equal(records[1].acceleration, values.ravel() * G0)
    measured = read_columns(path, [TOP], [width], "g", dt=0.01)
    np.testing.assert_array_equal(measured.values[0], values[:, -1] * G0)
    with pytest.raises(ValueError, match=f", {width}, without a header line"):
        read_record(path, units="g", dt=0.01, column=width + 1)


def test_a_short_last_row_is_never_taken_for_a_cut_table(tmp_path):
    with pytest.raises(ValueError, match="line 5: expected 8 cells .* give column='rows' and dt="):
        read(tmp_path, "a.dat", text(*ROWS), units="g", dt=0.01)
    record = read_record(tmp_path / "a.dat", units="g", dt=0.01, column="rows")
    np.testing.assert_allclose(record.acceleration, SAMPLES[:39] * G0, atol=1e-12)
    with pytest.raises(ValueError, match="line 3: expected 8 numbers as in the first row, got 7"):
        read(tmp_path, "a.dat", text(*ROWS[:2], ROWS[2][:70], *ROWS[3:]), units="g", dt=0.01, column="rows")


def test_the_column_of_times_may_be_named(path):
    path.write_text("Sek.,Scan,Time_2_s,acc_g\n0.00,1,5.0,1\n0.02,2,5.5,2\n0.04,3,6.0,4\n")
    record = read_record(path, column="acc_g", time="Sek.", time_unit="s")
    assert record.dt == 0.02
    assert read_columns(path, [TOP], ["acc_g"], time="Sek.", time_unit="s").dt == 0.02
    assert read_record(path, column="acc_g").dt == 0.5
    with pytest.raises(ValueError, match="found 0; the columns are Sek., Scan, Time_2_s, acc_g"):
        read_record(path, column="acc_g", time="Sec")
    path.write_text("1 0.00\n2 0.02\n4 0.04\n")
    np.testing.assert_allclose(read_record(path, units="g", time=2, time_unit="s").acceleration / G0, [1, 2, 4])


# what headers state ---------------------------------------------------------------------------------------------------


def test_the_header_of_an_afad_file_states_everything(tmp_path):
    record = read(tmp_path, "a.txt", afad())
    assert record.dt == 0.01
    np.testing.assert_allclose(record.acceleration, 0.01 * SAMPLES, rtol=1e-12)
    assert same(read_record(tmp_path / "a.txt", units="gal", dt=0.01), record)
    names = ("N-S", "E-W", "U-D")
    record = read(tmp_path, "a.txt", afad(names), column="E-W")
    np.testing.assert_allclose(record.acceleration, 0.02 * SAMPLES, rtol=1e-12)
    measured = read_columns(tmp_path / "a.txt", [TOP], ["U-D"])
    np.testing.assert_allclose(measured.values[0], 0.03 * SAMPLES, rtol=1e-12)
    unnamed = text(*(line for line in afad(names).splitlines() if not line.startswith("N-S")))
    assert same(read(tmp_path, "a.txt", unnamed, column=2), record)
    with pytest.raises(ValueError, match="states 'PGA VALUES"):
        read_record(tmp_path / "a.txt", column=2, units="g")


@pytest.mark.parametrize(
    ("content", "given", "message"),
    [
        (afad(), {"units": "g"}, r"states 'PGA VALUES \(gal\) .*', the samples have a peak of .* g; the unit is wrong"),
        (afad(count=41), {}, "'NUMBER OF DATA          : 41' announces 41 samples, the file has 40"),
        (afad(peaks=[0.2]), {}, "states 'PGA VALUES"),
        (afad(unit="g"), {"units": "gal"}, "states 'PGA VALUES"),
        (afad(dt="0"), {}, "give dt="),
        (text("Sampling rate;200", "acc_g", "1", "2"), {"dt": 0.01}, "0.005 s by 'Sampling rate;200'"),
        (text("Sampling rate;200", "acc_g", "1", "2"), {}, "states 'Sampling rate;200' without a unit: give dt="),
        (
            text("DT=0.01, NPTS=3", "time_s,acc_g", "0.00,1", "0.01,2"),
            {},
            "'NPTS=3' announces 3 samples, the file has 2",
        ),
        (text("Units: gal", "acc", "1", "2"), {"dt": 0.01, "units": "g"}, "states the unit 'gal' but units = 'g'"),
        (text("Units: counts", "acc", "1", "2"), {"dt": 0.01, "units": "g"}, "unknown unit 'counts'"),
        (text("Peak acceleration: 2.5 g", "acc_g", "1.0", "2.0"), {"dt": 0.01}, "states 'Peak acceleration: 2.5 g'"),
        (text("Scans in file: 3", "acc_g", "1", "2"), {"dt": 0.01}, "'Scans in file: 3' announces 3 samples"),
        (text("Anzahl Werte = 3", "acc_g", "1", "2"), {"dt": 0.01}, "'Anzahl Werte = 3' announces 3 samples"),
        (text("Peak value = 2.5 g", "acc_g", "1.0", "2.0"), {"dt": 0.01}, "states 'Peak value = 2.5 g'"),
        (text("Abtastrate: 200,5 Hz", "acc_g;x", "1,5;1", "2,5;1"), {"dt": 0.005, "column": "acc_g"}, "but 0.00498"),
        (EQSIG, {"units": "g", "dt": 0.02}, "0.02 s by the argument dt but 0.01 s by 'dt = 0.0100 s'"),
        (EQSIG.replace("40 0", "41 0"), {"units": "g"}, "line 2 announces 41 samples, the file has 40"),
        (RSPMATCH.replace("  40 ", "  39 "), {"units": "g"}, "line 2 announces 39 samples, the file has 40"),
    ],
)
def test_a_contradiction_of_what_a_header_states_is_refused(tmp_path, content, given, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, "a.txt", content, **given)


@pytest.mark.parametrize(
    ("line", "step"),
    [
        ("Sampling rate: 200 Hz", 0.005),
        ("Sample Rate (Hz);200", 0.005),
        ("sampling_interval_s: 0.005", 0.005),
        ("Sampling period [ms] : 5", 0.005),
        ("Time step 0.005 seconds", 0.005),
        ("fs = 200 Hz", 0.005),
        ("2 points at equal spacing of 0.005 sec", 0.005),
        ("Abtastintervall: 5 ms", 0.005),
        ("Abtastrate (Hz);200", 0.005),
        ("Zeitschritt = 0.005 s", 0.005),
        ("Fréquence d'échantillonnage : 200 Hz", 0.005),
        ("Frecuencia de muestreo: 200 Hz", 0.005),
        ("Pas de temps (s) : 0.005", 0.005),
    ],
)
def test_the_stated_step_is_used(tmp_path, line, step):
    assert read(tmp_path, "a.txt", text(line, "acc_g", "1", "2")).dt == pytest.approx(step, rel=1e-15)
    assert read_record(tmp_path / "a.txt", dt=step).dt == step
    alone = read(tmp_path, "b.txt", text(line, "1", "2"), units="g")  # the line is no name of the only column
    assert alone.dt == pytest.approx(step, rel=1e-15)
    with pytest.raises(ValueError, match="correct one"):
        read_record(tmp_path / "a.txt", dt=0.99 * step)


@pytest.mark.parametrize(
    "line",
    [
        "Sampling rate,100",
        "Time unit: s",
        "Scan interval: 10 min",
        "Peak velocity: 12.5 cm/s",
        "Peak value: 12.5",
        "Abtastrate: 100 Hz",
        "PGA (g): 4.0",
        "Peak acc.: -39.2 m/s2 at 0.02 s",
        "Samples: 3 of 12 channels",
        "Rate of the clock: 7",
        "PGA (g),4.0",
    ],
)
def test_what_a_header_states_rightly_or_about_something_else_is_no_obstacle(tmp_path, line):
    record = read(tmp_path, "a.txt", text(line, "time_s acc_g", "0.00 1", "0.01 2", "0.02 -4"))
    np.testing.assert_allclose(record.acceleration / G0, [1, 2, -4])
    assert record.dt == 0.01


@pytest.mark.parametrize(
    ("form", "unit"),
    [
        ("SMC", "gal"),
        ("GeoNet", "mm/s2"),
        ("K-NET", "gal"),
        ("ESM", "cm/s2"),
        ("V2", "cm/s2"),
        ("V2c", "cm/s2"),
        ("V1", "g"),
        ("AT2", "g"),
    ],
)
def test_arguments_must_agree_with_a_file_that_states_them(tmp_path, form, unit):
    name, content, _ = FILES[form]
    record = read(tmp_path, name, content)
    assert same(read_record(tmp_path / name, units=unit, dt=record.dt), record)
    with pytest.raises(ValueError, match="states the unit .* but units = 'in/s2' was given"):
        read_record(tmp_path / name, units="in/s2")
    with pytest.raises(ValueError, match="states a step of .* but dt = .* was given"):
        read_record(tmp_path / name, dt=2 * record.dt)
    for key, value in (("time_unit", "s"), ("time", "t"), ("skip", 2), ("missing", (-999.0,))):
        with pytest.raises(ValueError, match=f"states its times and samples; leave {key} out"):
            read_record(tmp_path / name, **{key: value})


def test_text_about_other_samples_is_left_out_by_skip(tmp_path):
    expected = read(tmp_path, "a.txt", afad())
    for wrong in (afad(peaks=[0.2]), afad(count=41), afad(dt="0.02")):
        with pytest.raises(ValueError, match="give skip= to leave"):
            read(tmp_path, "a.txt", wrong, units="gal", dt=0.01)
        assert same(read_record(tmp_path / "a.txt", skip=4, units="gal", dt=0.01), expected)


def test_a_stated_peak_is_compared_without_numbers_for_missing_samples(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text(text("PGA (g): 4.0", "time_s acc_g", "0.00 1", "0.01 -9999", "0.02 -4"))
    assert np.isnan(read_columns(path, [TOP], ["acc_g"], missing=(-9999,)).values[0, 1])


# single formats -------------------------------------------------------------------------------------------------------


def test_a_scale_factor_without_a_number_is_one_gal(tmp_path):
    lines = knet(COUNTS, 100, scale=(1, 1048.2))
    expected = read(tmp_path, "a.NS", text(*lines))
    bare = [line.replace("1(gal)/", "(gal)/") for line in lines]
    assert same(read(tmp_path, "a.NS", text(*bare)), expected)
    with pytest.raises(ValueError, match="the peak of"):
        read(tmp_path, "a.NS", text(*(line.replace("(gal)/1048.2", "(gal)/1000") for line in bare)))


def test_the_stated_peak_of_v2_is_compared(tmp_path):
    lines = csmip(1, VALUES, 0.0125, " .013 sec, in cm/sec2. (8f10.6)")
    lines[18] = f"Peak acceleration = {VALUES[np.argmax(np.abs(VALUES))]:9.3f}    cm/sec/sec   at  0.063 sec"
    assert read(tmp_path, "a.V2", text(*lines)).n_steps == 61
    with pytest.raises(ValueError, match="the file states 'Peak acceleration"):
        read(tmp_path, "a.V2", text(*lines).replace("in cm/sec2", "in mm/sec2"))


def advised_step(error):
    return float(re.search(r"resample=([\d.]+)", str(error.value))[1])


def test_the_advice_for_repeated_times_of_smc_works(tmp_path):
    times = 0.02 * np.arange(61) + 0.002 * np.sin(np.arange(61.0) ** 2)
    times[0], times[31] = 0.0, times[30]
    values = VALUES.copy()
    values[31] = values[30] + 1.0
    path = tmp_path / "a.smc"
    path.write_text(text(*smc(values, 1.7e38, times=times)))
    with pytest.raises(ValueError, match="samples are at uneven times; give their nominal step, resample=") as error:
        read_record(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        record = read_record(path, resample=advised_step(error))
    assert "mean of samples of equal times (1)" in record.source
    kept = np.delete(np.arange(61), 31)
    values[30] += 0.5  # the mean of the two
    expected = np.interp(record.time, times[kept], values[kept])
    np.testing.assert_allclose(record.acceleration, 1e-2 * expected, atol=2e-3)


@pytest.mark.parametrize("seed", range(2))
def test_the_advice_for_uneven_times_of_a_table_works(path, seed):
    chance = np.random.default_rng(seed)
    times = np.cumsum(chance.choice([0.004, 0.010, 0.011, 0.031], size=50, p=[0.1, 0.5, 0.3, 0.1]))
    path.write_text("time_s,acc_g\n" + "".join(f"{time:.3f},{k}\n" for k, time in enumerate(times)))
    with pytest.raises(ValueError, match="expected a uniform time step") as error:
        read_record(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert read_record(path, resample=advised_step(error)).n_steps > 50
    path.write_text("time_s,acc_g\n0.00,1\n0.01,2\n0.01,3\n0.02,3\n0.03,3\n")  # repeated: of packets, as a rule
    with pytest.raises(ValueError, match="print the times with more digits$"):
        read_record(path)


def test_a_last_number_that_is_cut_is_refused(tmp_path):
    for form in ("SMC", "V1"):
        name, content, _ = FILES[form]
        body = content.rstrip("\n").removesuffix("/&  ----------  End of data for channel 2").rstrip("\n")
        with pytest.raises(ValueError, match="the last one is cut|expected a number"):
            read(tmp_path, name, body[:-2])


# lines of the TOML file -----------------------------------------------------------------------------------------------


def sections(text):
    return tomllib.loads(text[text.index("# lines for the TOML file") :])


def test_an_archive_that_holds_channels_twice_is_listed_in_valid_toml(tmp_path):
    path = tmp_path / "a.zip"
    one, other = (text(*cosmos(1, factor * VALUES, 0.005)) for factor in (1.0, 2.0))
    with zipfile.ZipFile(path, "w") as archive, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, content in (("CHAN1.V2", one), ("copy/CHAN1.V2", other), ("chan1-v2.v2", one), ("CHAN1.V2", one)):
            archive.writestr(name, content)
        archive.writestr("twice.v2", one + other)
    found = describe_data(path)
    assert "'twice.v2' is there 2 times" in found
    columns = sections(found)["measurements"]["columns"]
    assert sorted(columns.values()) == ["CHAN1.V2", "chan1-v2.v2", "copy/CHAN1.V2"]
    peaks = {name: np.abs(read_record(path, name).acceleration).max() for name in columns.values()}
    assert peaks["copy/CHAN1.V2"] == pytest.approx(2 * peaks["CHAN1.V2"])
    channels = [Channel(name, "acceleration", "g") for name in columns]
    assert len(read_columns(path, channels, list(columns.values())).channels) == 3


def test_outputs_without_a_header_line_are_listed_by_numbers(tmp_path):
    path = tmp_path / "disp.out"
    path.write_text("0.01 -1.0 0.65\n0.02 -2.0 3.05\n")
    found = sections(describe_data(path))
    assert found["measurements"]["columns"] == {"column_1": "1", "column_2": "2", "column_3": "3"}
    assert (found["record"]["column"], found["record"]["dt"]) == ("1", "?")
    path.write_text(EQSIG)
    found = sections(describe_data(path))["record"]
    assert read_record(path, column=found["column"], units="g").n_steps == 40 and "dt" not in found


def test_components_and_columns_that_are_there_twice_are_listed_in_valid_toml(tmp_path):
    path = tmp_path / "a.V2A"
    path.write_text(text(*geonet({"N 1": VALUES, "Up": VALUES}, 0.02), *geonet({"Up": VALUES, "E": VALUES}, 0.02)))
    found = describe_data(path)
    assert "'Up' is there 2 times" in found
    assert sorted(sections(found)["measurements"]["columns"].values()) == ["E", "N"]
    path = tmp_path / "a.csv"
    path.write_text("time_s,Top (g),top [g],a_g,a_g\n0.00,1,2,3,4\n0.01,1,2,3,4\n")
    found = describe_data(path)
    assert sections(found)["measurements"]["columns"] == {"top": "Top (g)", "top_2": "top [g]"}


@pytest.mark.parametrize("names", ["time_s,acc_g", "acc_g"])
@pytest.mark.parametrize("arguments", [{}, {"column": 1, "dt": 0.01}, {"column": "rows", "dt": 0.01}])
def test_decimal_commas_between_commas_are_never_read_as_other_numbers(names, arguments, tmp_path):
    rows = [
        ",".join(f"{x:.3f}".replace(".", ",") for x in (0.01 * k, np.sin(k))[-len(names.split(",")) :])
        for k in range(9)
    ]
    (tmp_path / "logger.csv").write_text("\n".join([names, *rows]))
    with pytest.raises(ValueError, match="decimal commas need another separator"):
        read_record(tmp_path / "logger.csv", units="g", **arguments)
