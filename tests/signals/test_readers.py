"""Readers of ground motions and measured responses, on real files where these exist.

There is no real AT2 file among the reference data, so both forms of its header are written here with synthetic numbers.
The same holds for the newer CSMIP form and for COSMOS V2. The older CSMIP form is read from real zip archives.
"""

import csv
import re
import sys
import zipfile

import numpy as np
import pytest

from fe_likelihoods.signals.channels import Channel
from fe_likelihoods.signals.read import read_columns, read_record
from fe_likelihoods.units import G0, to_si

PAINTER = "measured/painter_street_bridge/petrolia_25apr1992_ce89324p.zip"
MELOLAND = "measured/meloland_bridge/imperialvalley79_ce01336p.zip"


TOP = Channel("top", "absolute acceleration", "g")
DRIFT = Channel("drift", "relative displacement", "in")


def write_at2(path, values, header, units="ACCELERATION TIME SERIES IN UNITS OF G"):
    rows = ["".join(f"{value:15.7E}" for value in values[i : i + 5]) for i in range(0, len(values), 5)]
    path.write_text("\n".join(["PEER NGA STRONG MOTION DATABASE RECORD", "Somewhere, 1/1/1999", units, header, *rows]))
    return path


class TestAT2:
    VALUES = np.sin(np.arange(23.0))

    @pytest.mark.parametrize(
        ("header", "units"),
        [
            ("NPTS=     23, DT=   .0050 SEC", "ACCELERATION TIME SERIES IN UNITS OF G"),
            ("NPTS=  23, DT= .00500 SEC,", "ACCELERATION TIME HISTORY IN UNITS OF G. FILTER POINTS: HP=0.1 Hz"),
            ("NPTS= 23 ,  DT=5.0e-3 sec", "acceleration time series in units of g"),
            ("   23    0.0050   NPTS, DT", "ACCELERATION TIME HISTORY IN UNITS OF G"),
            (" 23  .005   NPTS,   DT", "ACCELERATION TIME HISTORY IN UNITS   OF   G"),
        ],
    )
    def test_both_forms_of_the_header(self, tmp_path, header, units):
        record = read_record(write_at2(tmp_path / "NIS090.AT2", self.VALUES, header, units))
        np.testing.assert_allclose(record.acceleration, self.VALUES * G0, atol=1e-7 * G0)
        assert (record.dt, record.name, record.source) == (0.005, "NIS090", "NIS090.AT2: Somewhere, 1/1/1999")

    def test_units_from_the_caller(self, tmp_path):
        path = write_at2(tmp_path / "a.at2", self.VALUES, "NPTS= 23, DT= .01 SEC", "ACCELERATION")
        assert read_record(path, units="cm/s2").acceleration[1] == pytest.approx(0.01 * np.sin(1), rel=1e-6)
        with pytest.raises(ValueError, match=r"a.at2 does not state the unit of its acceleration: give units="):
            read_record(path)

    @pytest.mark.parametrize(
        ("header", "units", "given", "message"),
        [
            ("NPTS= 24, DT= .01 SEC", "UNITS OF G", None, "line 4 announces 24 samples, the file has 23"),
            ("NPTS= 22, DT= .01 SEC", "UNITS OF G", None, "line 4 announces 22 samples, the file has 23"),
            ("NPTS= 23, DT= .01 SEC", "UNITS OF G", "cm/s2", "states the unit 'G' but units = 'cm/s2'"),
            ("NPTS= 23, DT= .01 SEC", "VELOCITY TIME SERIES IN UNITS OF CM/SEC", None, "a unit of velocity"),
            ("NPTS= 23, DT= .01 SEC", "UNITS OF PARSEC", None, "unknown unit 'PARSEC'"),
            ("NPTS= 23, DT= 0.0 SEC", "UNITS OF G", None, "positive number of seconds"),
            ("NPTS= 23, DT= 10 MSEC", "UNITS OF G", None, "line 4: expected DT in seconds, .* got 10 MSEC"),
            ("no header at all", "UNITS OF G", None, "no known format of ground motions"),
        ],
    )
    def test_refusals(self, tmp_path, header, units, given, message):
        with pytest.raises(ValueError, match=message):
            read_record(write_at2(tmp_path / "a.at2", self.VALUES, header, units), units=given)

    @pytest.mark.parametrize(("word", "message"), [("NaN", "finite number, got 'NaN'"), ("*****", r"number, got '\*")])
    def test_bad_samples_are_named_with_their_line(self, tmp_path, word, message):
        path = write_at2(tmp_path / "a.at2", self.VALUES, "NPTS= 23, DT= .01 SEC")
        lines = path.read_text().splitlines()
        path.write_text("\n".join([*lines[:5], " ".join([word, *lines[5].split()[1:]]), *lines[6:]]))
        with pytest.raises(ValueError, match=rf"a.at2, line 6: expected a {message}"):
            read_record(path)

    def test_missing_file(self, tmp_path):
        with pytest.raises(ValueError, match="cannot read .*none.at2: No such file"):
            read_record(tmp_path / "none.at2")


def lines(*rows, encoding="utf-8", end="\r\n"):
    return end.join([*rows, ""]).encode(encoding)


POINTS = ("0.00,0.1", "0.01,-0.25", "0.02,12.5", "0.03,0.0")
SEMICOLONS = tuple(row.replace(",", ";").replace(".", ",") for row in POINTS)


PREAMBLE = ("Logger 7, firmware 2.1", "Sampling rate,100", "Date: 2019-07-06", "")
# files as loggers and spreadsheets write them, with the arguments that they need
LOGGERS = {
    "UTF-8 header": (lines("Time [s],Acceleration [m/s²]", *POINTS), {}),
    "Latin-1 header": (lines("Time (s),Acceleration (m/s²)", *POINTS, encoding="latin-1"), {}),
    "quoted decimal commas": (lines("t_s,a_gal", '"0,00","10"', '"0,01","-25"', '"0,02","1250"', '"0,03","0"'), {}),
    "blanks, decimal commas": (lines("t_s a_m/s2", *(row.replace(";", " ") for row in SEMICOLONS)), {}),
    "preamble": (lines(*PREAMBLE, "Time [s],Acceleration [m/s²]", *POINTS), {}),
    "preamble, skipped": (lines(*PREAMBLE, "time_s,acc_m/s2", *POINTS), {"skip": 4}),
    "line of units in brackets": (
        lines(*PREAMBLE, "Time\tAcc", "[ms]\t[gal]", "0\t10", "10\t-25", "20\t1250", "30\t0"),
        {},
    ),
    "quoted names": (lines('"Time, s","Acceleration, m/s²"', *POINTS), {}),
    "separators at ends": (lines("time_s;acc_m/s2;", *(f"{row};" for row in SEMICOLONS)), {}),
    "separators at ends of rows": (lines("time_s;acc_m/s2", *(f"{row};" for row in SEMICOLONS)), {}),
    "separator at the end of the header line": (lines("time_s;acc_m/s2;", *SEMICOLONS), {}),
    "no header": (lines(*POINTS), {"time_unit": "s", "units": "m/s²"}),
    "names without units": (
        lines("Test 7", "t,x,a", "0,9,0.1", "10,9,-0.25", "20,9,12.5", "30,9,0"),
        {"time_unit": "ms", "units": "m/s²", "column": "a"},
    ),
}


class TestCSV:
    @pytest.mark.parametrize(
        ("text", "given"),
        [
            ("time_s,acc_g\n0,1\n0.5,2\n1,3\n", {}),
            ("# units: g\ntime_s,acc\n0,1\n0.5,2\n1,3\n", {}),
            ("time_ms,acc\n0,1\n500,2\n1000,3\n", {"units": "g"}),
            ("# units: g; dt = 0.5 s\nacc\n1\n2\n3\n", {}),
            ("acc[g]\n1\n2\n3\n", {"dt": 0.5}),
            ("1\n2\n3\n", {"dt": 0.5, "units": "g"}),
            ("Time (s)  a (g)  b (g)\n0 1 9\n0.5 2 9\n1 3 9\n".replace(" (", "("), {"column": "a(g)"}),
        ],
    )
    def test_ways_to_state_unit_and_step(self, path, text, given):
        path.write_text(text, encoding="utf-8")
        record = read_record(path, **given)
        np.testing.assert_allclose(record.acceleration, np.array([1, 2, 3]) * G0)
        assert record.dt == 0.5

    @pytest.mark.parametrize(
        ("text", "given", "message"),
        [
            ("time_s,acc\n0,1\n1,2\n", {}, "does not state the unit of its acceleration"),
            ("time_s,acc_g\n0,1\n1,2\n", {"units": "cm/s2"}, "states the unit 'g' but units = 'cm/s2'"),
            ("# units: cm/s2\ntime_s,acc_g\n0,1\n1,2\n", {}, r"states the unit 'g' but units = 'cm/s2'"),
            ("time_s,disp_in\n0,1\n1,2\n", {}, "expected a unit of acceleration, got 'in'"),
            ("acc_g\n1\n2\n", {}, "no times .* give dt="),
            ("time,acc_g\n0,1\n1,2\n", {}, "'time' has no unit; call it time_s"),
            ("time_s,acc_g\n0,1\n0.5,2\n1,3\n", {"dt": 0.25}, "0.25 s by the argument dt but 0.5 s by the time column"),
            ("# npts = 4\ntime_s,acc_g\n0,1\n1,2\n", {}, "'npts = 4' announces 4 samples, the file has 2"),
            ("time_s,acc_g\n0,1\n1,inf\n", {}, "line 3: expected a finite number, got 'inf'"),
            ("time_s,acc_g\n0,1\n,2\n", {}, "line 3: expected a time, got an empty cell"),
            ("time_s,acc_g\n0,1\n1,\n", {}, "line 3: expected a number, got an empty cell or NaN; .* 1 are missing"),
            ("time_s,acc_g\n0,1\n1,two\n", {}, "line 3: expected a number, got 'two'"),
            ("time_s,acc_g\n0,1\n1\n", {}, "line 3: expected 2 cells"),
            (
                "time_s;acc_g\n0,0;1,0\n0.5;2,0\n",
                {},
                "expected one decimal mark, got '0,0' in line 2 and '0.5' in line 3",
            ),
            ("time_s;acc_g\n0.0;1.0\n", {}, "times that increase over 2 rows or more, got 1 row"),
            ("0.0;1.0\n0.1;2.0\n", {}, "2 columns and no header line; .* or give column=2 and time_unit="),
            ("Time;acc_g\n5.3.2024 10h32;1.0\n5.3.2024 10:32:08;2.0\n", {}, "a clock time such as"),
            ("0,one\n0.5,2\n1,3\n", {"units": "g", "time_unit": "s"}, "line 1: expected a number, got 'one'"),
            ("Time,acc_g\n0,1\n1,2\n", {"time_unit": "g"}, "expected a unit of time, got 'g'"),
            ("Time,acc_g\ns,m/s2\n0,1\n1,2\n", {}, "states the unit 'g' but units = 'm/s2'"),
            ("Time_s,acc_g\n0,1\n1,2\n", {"skip": -1}, "skip must be a number of lines"),
            ("time_s,acc_g\n", {}, "expected rows of numbers, found none"),
            ("time_s,acc_g\n1,1\n0,2\n", {}, "times that increase"),
            ("time_s,a_g,b_g\n0,1,1\n1,2,2\n", {}, "choose it with column=, the columns are time_s, a_g, b_g"),
            ("time_s,a_g\n0,1\n1,2\n", {"column": "c"}, "one column of values named 'c'"),
        ],
    )
    def test_refusals(self, path, text, given, message):
        path.write_text(text)
        with pytest.raises(ValueError, match=message):
            read_record(path, **given)

    @pytest.mark.parametrize(("content", "given"), LOGGERS.values(), ids=LOGGERS)
    def test_files_of_loggers_and_spreadsheets(self, path, content, given):
        path.write_bytes(content)
        record = read_record(path, **given)
        np.testing.assert_allclose(record.acceleration, [0.1, -0.25, 12.5, 0.0])
        assert record.dt == 0.01

    @pytest.mark.parametrize(
        ("step", "digits"), [(1 / 120, 5), (1 / 128, 3), (0.0125, 3), (0.01, 2), (0.02, 2), (0.005, 4)]
    )
    def test_rounding_of_printed_times_is_accepted(self, path, step, digits):
        path.write_text("time_s,acc_g\n" + "".join(f"{k * step:.{digits}f},0\n" for k in range(4000)))
        assert read_record(path).dt == step

    @pytest.mark.parametrize("form", ["", ".6f"])
    def test_single_precision_times_are_accepted(self, path, form):
        times = (np.arange(4000) * np.float32(0.01)).astype(np.float32)
        path.write_text("time_s,acc_g\n" + "".join(f"{float(time):{form}},0\n" for time in times))
        assert read_record(path).dt == 0.01

    @pytest.mark.parametrize("first", [0.0, 43200.0, 1.7e9])
    def test_lost_samples_are_found_where_the_times_are_large(self, path, first):
        rows = [f"{first + 0.01 * k:.2f},0" for k in range(3000)]
        path.write_text("\n".join(["time_s,acc_g", *rows]))
        assert read_record(path).dt == 0.01
        path.write_text("\n".join(["time_s,acc_g", *rows[:1000], *rows[1500:]]))
        with pytest.raises(ValueError, match="line 1002: expected a uniform time step"):
            read_record(path)

    @pytest.mark.parametrize("names", ["Time_A [s],a_g,Time_B [s],b_g", "time1,a_g,time2,b_g"])
    def test_two_columns_of_times(self, path, names):
        channel = Channel("b", "acceleration", "g")
        path.write_text(names + "\n0.00,1,0.5,1\n0.01,2,0.52,2\n")
        with pytest.raises(ValueError, match="expected one column of times, got the columns '[Tt]ime.* with different"):
            read_columns(path, (channel,), ("b_g",), time_unit=None if "[" in names else "s")
        path.write_text(names + "\n0.00,1,0.00,1\n0.01,2,0.01,2\n")
        assert read_columns(path, (channel,), ("b_g",), time_unit=None if "[" in names else "s").dt == 0.01

    def test_two_clocks(self, tmp_path):
        path, channel = tmp_path / "a.csv", Channel("b", "acceleration", "g")
        path.write_text("pc,gps,b_g\n09:58:10.213,09:58:10.000,1\n09:58:10.223,09:58:10.010,2\n")
        with pytest.raises(ValueError, match="got the columns 'pc' and 'gps' with different times"):
            read_columns(path, (channel,), ("b_g",), zero="09:58:10")
        assert read_columns(path, (channel,), ("b_g",), zero="09:58:10", time="gps").start == 0.0
        path.write_text(path.read_text().replace(".213", ".000").replace(".223", ".010"))
        assert read_columns(path, (channel,), ("b_g",), zero="09:58:10").start == 0.0

    def test_a_temperature_is_no_column_of_times(self, path):
        path.write_text("time_s,acc_g,T [°C],T\n0.00,1,20,20\n0.01,2,20,20\n", encoding="utf-8")
        assert read_record(path, column="acc_g").dt == 0.01

    @pytest.mark.parametrize("change", ["missing", "doubled", "shifted"])
    @pytest.mark.parametrize(("step", "digits"), [(0.01, 2), (0.02, 2), (0.005, 4)])
    def test_first_irregular_step_is_named(self, path, step, digits, change):
        times = [f"{k * step:.{digits}f}" for k in range(1000)]
        if change == "missing":
            del times[500]  # row 500 is line 502 of the file
        elif change == "doubled":
            times.insert(500, times[499])
        else:
            times[500] = f"{500 * step + 2 * 10**-digits:.{digits}f}"
        path.write_text("time_s,acc_g\n" + "".join(f"{time},0\n" for time in times))
        with pytest.raises(
            ValueError, match=rf"a.csv, line 502: expected a uniform time step of about {step:g} s, got"
        ):
            read_record(path)


def real_columns(path):
    with open(path) as file:
        names, *rows = list(csv.reader(line for line in file if not line.startswith("#")))
    return dict(zip(names, np.array(rows, dtype=float).T, strict=True))


class TestV2OnRealZips:
    @pytest.mark.parametrize(
        ("archive", "folder", "dt"),
        [(PAINTER, "petrolia_1992_mainshock", 0.02), (MELOLAND, "imperial_valley_1979", 0.02)]
        + [(MELOLAND, "imperial_valley_1979", 0.01)],
    )
    def test_every_channel_is_the_same_as_the_measured_csv(self, shared, archive, folder, dt):
        columns = real_columns((shared / archive).parent / folder / f"acc_cm_s2_dt{dt}.csv")
        with open((shared / archive).parent / folder / "channels.csv") as file:
            peaks = {row["sta_chan"]: row for row in csv.DictReader(file)}
        for name, values in columns.items():
            if name != "time_s":
                number = int(name.removeprefix("ch"))
                channel = f"Structure.zip/CHAN{number}.V2" if archive == PAINTER else number
                record = read_record(shared / archive, column=channel)
                assert record.dt == dt
                # The table ends with its shortest channel and has six significant digits.
                np.testing.assert_allclose(record.acceleration[: values.size], to_si(values, "cm/s2"), rtol=5e-6)
                assert record.n_steps == int(peaks[str(number)]["npts"])
                peak = np.abs(record.acceleration).max() * 100
                assert peak == pytest.approx(float(peaks[str(number)]["peak_acc_cm_s2"]), abs=1.1e-3)

    def test_ambiguous_and_absent_channels_are_listed(self, shared):
        with pytest.raises(
            ValueError, match=r"(?s)found 2; choose.*Structure.zip/CHAN12.V2.*Free Field.zip/CHAN012.V2"
        ):
            read_record(shared / PAINTER, column=12)
        with pytest.raises(ValueError, match=r"(?s)column=99, found 0; .*channel 26: CHAN 13: 270 DEG"):
            read_record(shared / MELOLAND, column=99)
        with pytest.raises(ValueError, match="none in 0 file.* named 'CHAN99.V2'"):
            read_record(shared / MELOLAND, column="CHAN99.V2")

    def test_damage_is_found(self, shared, tmp_path):
        with zipfile.ZipFile(shared / MELOLAND) as archive:
            text = archive.read("CHAN02.V2").decode()
        path = tmp_path / "CHAN02.V2"
        damages = {
            "\r\n".join(
                text.split("\r\n")[:100]
            ): "line 101: expected 8 numbers of 10 columns after 432 of 1138 samples, got 0",
            text.replace(
                " 1138 POINTS OF ACCEL", " 1130 POINTS OF ACCEL"
            ): r"line 188: expected 2 numbers of 10 columns after .* samples, got 8",
            text.replace(
                " 1138 POINTS OF ACCEL", " 1136 POINTS OF ACCEL"
            ): "expected 1136 samples as the file announces, but it has more",
            text.replace(" AT  .020 SEC.  (UNITS", " AT  .010 SEC.  (UNITS"): "step is .010 s in the text but 0.02 s",
            text.replace("(UNITS: CM/SEC/SEC)", ""): "expected the unit of acceleration",
            text.replace("(UNITS: CM/SEC/SEC)", "(UNITS: CM/SEC)"): "a unit of velocity",
            text.replace("     7.942", "    ******", 1): "expected a number, got",
        }
        for damaged, message in damages.items():
            assert damaged != text
            path.write_bytes(damaged.encode())
            with pytest.raises(ValueError, match=message):
                read_record(path)
        path.write_bytes(text.encode())
        assert read_record(path).n_steps == 1138
        truncated = tmp_path / "cut.zip"
        truncated.write_bytes((shared / MELOLAND).read_bytes()[:50_000])
        with pytest.raises(ValueError, match="cut.zip: this looks like a damaged zip file"):
            read_record(truncated)


def csmip(channel, values, dt, descriptor, width=10, decimals=6):
    """Lines of a channel in the newer CSMIP form: the data line states the Fortran format, numbers may touch."""
    header = ["Corrected accelerogram   89146-L2500-12044.02"] + [""] * 6 + [f"Chan  {channel}: 360 Deg"] + [""] * 17
    reals = [0.0] * 100
    reals[60] = dt

    def block(numbers, digits):
        cells = [
            re.sub(r"^( *-?)0\.", r"\1.", f"{number:{width}.{digits}f}").rjust(width)[-width:] for number in numbers
        ]
        return ["".join(cells[i : i + 8]) for i in range(0, len(cells), 8)]

    blocks = [f"{len(values):6d} points of accel data equally spaced at {descriptor}", *block(values, decimals)]
    velocity = [f"{len(values):6d} points of veloc data equally spaced at {descriptor}", *block(0 * values, decimals)]
    integers = ["    1" * 16] * 6 + ["    1" * 4]
    return [
        *header,
        *integers,
        *block(reals, 7),
        *blocks,
        *velocity,
        f"/&  ----------  End of data for channel {channel}",
    ]


def cosmos(channel, values, dt, form="(1E15.6)", quantity="acceleration", units="cm/sec2(04)"):
    reals = [-999.0] * 100
    reals[33] = dt
    header = ["Corrected acceleration    (Format v01.20 with 13 text lines)"] + [""] * 7
    header += [f"Sta Chan   {channel}: 90 deg (Rcrdr Chan  1) Location:", *[""] * 4]
    header += [" 100 Integer-header values follow on  10 lines, Format= (10I8)"] + ["    -999" * 10] * 10
    header += [" 100 Real-header values follow on  20 lines, Format= (5F15.6)"]
    header += ["".join(f"{real:15.6f}" for real in reals[i : i + 5]) for i in range(0, 100, 5)]
    header += ['   1 Comment line(s) follow, each starting with a "|":', "| synthetic"]
    data = f"{len(values):8d} {quantity} pts, approx  1 secs, units={units},Format={form}"
    return [*header, data, *(f"{value:15.6E}" for value in values), f"End-of-data for Chan  {channel} {quantity}"]


class TestV2Forms:
    def test_newer_csmip_with_touching_numbers_and_several_channels(self, tmp_path, rng):
        path = tmp_path / "CE89146.V2"
        values = rng.uniform(-99, -10, size=(3, 21))  # ten columns each, without a blank between them
        lines = [line for k in range(3) for line in csmip(k + 1, values[k], 0.0125, " .013 sec, in cm/sec2. (8f10.6)")]
        path.write_text("\n".join(lines))
        record = read_record(path, column=2)
        np.testing.assert_allclose(record.acceleration, values[1] / 100, atol=1e-8)
        assert record.dt == 0.0125, "the step is that of the real header, the data line has three decimals only"
        assert (record.name, record.source) == ("Chan 2: 360 Deg", "CE89146.V2")
        with pytest.raises(ValueError, match=r"(?s)found 3; choose.*channel 1: .*channel 3: "):
            read_record(path)

    def test_cosmos(self, tmp_path, rng):
        path = tmp_path / "n.BNZ.acc.V2c"
        values = rng.normal(size=(2, 50))
        lines = cosmos(1, values[0], 0.02) + cosmos(1, values[0], 0.02, quantity="velocity", units="cm/sec(05)")
        path.write_text("\n".join(lines + cosmos(7, values[1], 0.005)))
        for channel, row, dt in [(1, 0, 0.02), (7, 1, 0.005)]:
            record = read_record(path, column=channel)
            np.testing.assert_allclose(record.acceleration, values[row] / 100, rtol=1e-6)
            assert record.dt == dt

    def test_cosmos_refusals(self, tmp_path):
        path = tmp_path / "a.V2c"
        good = cosmos("?", np.ones(9), 0.02)
        path.write_text("\n".join(good))
        assert read_record(path).n_steps == 9, "a single channel needs no number"
        for lines, message in [
            (cosmos(1, np.ones(9), -999.0), "expected the time step .s. in the header, got -999"),
            (cosmos(1, np.ones(9), 0.02, units="counts(50)"), "unknown unit 'counts'"),
            ([line for line in good if "Real-header" not in line], "Real-header values follow"),
            (cosmos(1, np.ones(9), 0.02, form="(free)"), r"expected a Format such as \(8F10.5\)"),
            (good[:-4], "after 6 of 9 samples"),
        ]:
            path.write_text("\n".join(lines))
            with pytest.raises(ValueError, match=message):
                read_record(path)


class TestColumns:
    def test_units_by_column_or_for_all(self, path):
        path.write_text("time_s,acc_g,disp [in]\n0,1,2\n0.01,3,4\n")
        expected = [[G0, 3 * G0], [0.0508, 0.1016]]
        for units in (None, ["g", "in"], {DRIFT.name: "in"}):
            found = read_columns(path, (TOP, DRIFT), ("acc_g", "disp [in]"), units, description="two rows")
            np.testing.assert_allclose(found.values, expected)
            assert (found.dt, found.description, found.channels) == (0.01, "two rows", (TOP, DRIFT))

    @pytest.mark.parametrize(
        ("channels", "columns", "units", "message"),
        [
            ((TOP,), ("acc_g", "disp"), None, "one column for each of 1 channels"),
            ((TOP,), "acc_g", None, "one column for each"),
            ((TOP,), ("acc_g",), {"acc_g": "g"}, "a unit for each of"),
            ((TOP,), ("acc",), None, "named 'acc', the columns are time_s, acc_g, disp"),
            ((TOP,), ("time_s",), None, "named 'time_s'"),
            ((DRIFT,), ("disp",), None, "column 'disp' does not state the unit of its displacement.* for instance 'm'"),
            ((DRIFT,), ("acc_g",), None, "expected a unit of displacement, got 'g'"),
            ((TOP,), ("acc_g",), "cm/s2", "states the unit 'g' but units = 'cm/s2'"),
        ],
    )
    def test_refusals(self, path, channels, columns, units, message):
        path.write_text("time_s,acc_g,disp\n0,1,2\n0.01,3,4\n")
        with pytest.raises(ValueError, match=message):
            read_columns(path, channels, columns, units)

    def test_empty_cells_are_missing_samples(self, path):
        path.write_text("Time [s];Acc [g];Top [µm/m]\n0,37;1;\n0,38;;2\n0,39;NaN;3\n0,40;4;#N/A\n", encoding="utf-8")
        strain = Channel("strain", "strain", "microstrain")
        found = read_columns(path, (TOP, strain), ("Acc [g]", "Top [µm/m]"))
        nan = np.nan
        np.testing.assert_allclose(found.values, [[G0, nan, nan, 4 * G0], [nan, 2e-6, 3e-6, nan]])
        assert found.dt == 0.01 and found.start == pytest.approx(0.37)
        np.testing.assert_allclose(found.time, [0.37, 0.38, 0.39, 0.40])
        assert read_columns(path, (TOP,), ("Acc [g]",), zero=0.37).start == 0.0

    def test_a_printed_start_is_a_whole_number_of_steps_within_its_rounding(self, path):
        path.write_text("time_s,acc_g\n" + "".join(f"{(k + 1) / 120:.5f},{k}\n" for k in range(500)))
        found = read_columns(path, (TOP,), ("acc_g",))
        assert (found.dt, found.start) == (1 / 120, 1 / 120)

    @pytest.mark.parametrize("number", ["-9999", "-999.25", "1E+30", "9.97E+36"])
    def test_numbers_for_missing_samples(self, path, number):
        path.write_text(f"time_s,acc_g\n0.00,1\n0.01,{number}\n0.02,{number}\n0.03,4\n")
        for read in (read_record, lambda path: read_columns(path, (TOP,), ("acc_g",))):
            with pytest.raises(ValueError, match="line 3: expected a measured number, got .* in 2 rows, .*missing="):
                read(path)
        found = read_columns(path, (TOP,), ("acc_g",), missing=(float(number),))
        np.testing.assert_array_equal(found.values / G0, [[1, np.nan, np.nan, 4]])
        assert read_record(path, missing=()).acceleration[1] == pytest.approx(float(number) * G0)
        path.write_text(f"time_s,acc_g\n0.00,1\n0.01,{number}\n0.02,{0.995 * float(number)}\n0.03,4\n")
        assert read_record(path).n_steps == 4

    @pytest.mark.parametrize("number", [-999, 99999, -99999, 32767, -32768])
    def test_numbers_that_may_be_measured_are_refused_where_nothing_is_as_large(self, path, number):
        path.write_text(f"time_s,acc_gal\n0.00,120\n0.01,{number}\n0.02,{number}\n0.03,{0.49 * number}\n")
        with pytest.raises(ValueError, match=f"line 3: expected a measured number, got {number} in 2 rows, .*missing="):
            read_record(path)
        assert read_record(path, missing=()).n_steps == 4
        found = read_columns(path, (TOP,), ("acc_gal",), missing=(number,))
        assert np.isnan(found.values).sum() == 2
        path.write_text(f"time_s,acc_gal\n0.00,120\n0.01,{0.6 * number}\n0.02,{number}\n0.03,{-0.3 * number}\n")
        assert read_record(path).n_steps == 4  # a peak beside which the record is large as well

    @pytest.mark.parametrize("word", ["NA", "N/A", "NULL", "null", "-", "--"])
    def test_words_for_missing_samples(self, path, word):
        path.write_text(f"acc_g\n{word}\n{word}\n0\n1\n{word}\n2\n")
        found = read_columns(path, (TOP,), ("acc_g",), dt=0.01)
        np.testing.assert_array_equal(found.values / G0, [[np.nan, np.nan, 0, 1, np.nan, 2]])
        path.write_text(f"{word}\n0\n1\n")
        with pytest.raises(ValueError, match="line 1: expected a number, .* 1 are missing"):
            read_record(path, units="g", dt=0.01)

    @pytest.mark.parametrize(
        "text",
        [
            "time_ms,acc_g\n" + "".join(f"{10 * k},1,{k % 10}\n" for k in range(30)),
            "time_s\tacc_g\n" + "".join(f"{k + 1}\t{k / 100}\t{7 + k}\n" for k in range(30)),
        ],
        ids=["unquoted decimal commas", "names of rows"],
    )
    def test_header_with_one_name_too_few(self, path, text):
        path.write_text(text)
        with pytest.raises(ValueError, match="line 1: expected a name for each of the 3 cells .* got 2; write decimal"):
            read_columns(path, (TOP,), ("acc_g",))

    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_separators_of_thousands(self, path, separator):
        for first in (980, 1000):
            if first == 1000 and separator != ",":
                continue  # numbers with three decimals
            rows = (f'{10 * k}{separator}"{first + 5 * k:,}"\n' for k in range(30))
            path.write_text(f"time_ms{separator}acc_g\n" + "".join(rows))
            with pytest.raises(ValueError, match="got '1,0[0-9]+', which may have a separator of thousands"):
                read_record(path)

    def test_decimal_commas_with_three_digits(self, path):
        path.write_text('time_s,acc_g\n"0,000","1,250"\n"0,010","2,500"\n')
        np.testing.assert_allclose(read_record(path).acceleration / G0, [1.25, 2.5])
        path.write_text("time_ms;acc_g\n0;1,250\n10;2,500\n")
        np.testing.assert_allclose(read_record(path).acceleration / G0, [1.25, 2.5])

    @pytest.mark.parametrize(
        ("first", "dt", "digits", "zero", "start"),
        [(0.37, 0.02, 2, 0.0, 0.37), (86000.123, 0.002, 3, 86000.123, 0.0), (86000.123, 1 / 120, 5, 86000.123, 0.0)],
    )
    def test_a_start_between_two_steps_is_kept(self, path, first, dt, digits, zero, start):
        path.write_text("time_s,acc_g\n" + "".join(f"{first + k * dt:.{digits}f},{k}\n" for k in range(500)))
        assert read_columns(path, (TOP,), ("acc_g",), zero=zero).start == start

    def test_excel(self, tmp_path):
        book = pytest.importorskip("openpyxl").Workbook()
        for row in (["Logger 7"], ["Time", "Acc"], ["s", "m/s²"], [0, 0.1], [0.01, None], [0.02, 12.5], [0.03, 0]):
            book.active.append(row)
        book.save(tmp_path / "a.xlsx")
        found = read_columns(tmp_path / "a.xlsx", (TOP,), ("Acc",))
        np.testing.assert_array_equal(found.values, [[0.1, np.nan, 12.5, 0.0]])
        assert found.dt == 0.01
        with pytest.raises(ValueError, match="line 5: expected a number, got an empty cell"):
            read_record(tmp_path / "a.xlsx")
        (tmp_path / "b.xlsx").write_bytes(b"PK no workbook")
        with pytest.raises(ValueError, match="not a readable Excel workbook"):
            read_record(tmp_path / "b.xlsx")

    def test_excel_without_its_package(self, tmp_path, monkeypatch):
        monkeypatch.setitem(sys.modules, "openpyxl", None)
        (tmp_path / "a.xlsx").write_bytes(b"PK")
        with pytest.raises(ValueError, match="install it with pip install openpyxl, or save the sheet as CSV"):
            read_record(tmp_path / "a.xlsx")
