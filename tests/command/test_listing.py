"""The command ``data``: what files hold, and lines of a TOML file that read them as they are."""

import tomllib

import numpy as np
import pytest
from click.testing import CliRunner
from scipy.io import savemat

from fe_likelihoods import Channel, Measurements, Record, check_data, read_columns, read_record
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.main import main
from fe_likelihoods.command.make_posterior import make_problem
from fe_likelihoods.signals.datasets import write_dataset
from tests.signals.logger_styles import READ
from tests.signals.network_files import esm, geonet, smc
from tests.signals.test_readers import cosmos, csmip, write_at2

VALUES = np.sin(np.arange(23.0))
TOP = Channel("top", "acceleration", "g")
DESCRIPTOR = "  .020 sec, in cm/sec2. (8f10.6)"


def listed(path, code=0):
    """Output of the command, and its lines for a TOML file."""
    result = CliRunner().invoke(main, ["data", str(path)])
    assert result.exit_code == code, result.output
    return result.output, tomllib.loads(result.output[result.output.find("# lines for the TOML") :])


def read_as_listed(lines):
    """The record and the measured accelerations that the lines name."""
    base, measured = lines["record"], lines.get("measurements")
    record = read_record(base["file"], base.get("column"), resample=base.get("resample"))
    if measured is None:
        return record, None
    options = {key: measured[key] for key in ("zero", "resample", "missing") if key in measured}
    channels = [Channel(name, "acceleration", "g") for name in measured["columns"]]
    return record, read_columns(measured["file"], channels, list(measured["columns"].values()), **options)


def test_a_logger_file(path):
    path.write_text(READ["day first, decimal comma"].replace("1,9854", ""))
    output, lines = listed(path)
    assert "a table of 8 rows" in output and "-2.872    2.686" in output
    assert lines["measurements"]["zero"] == "2024-05-14 10:32:07"
    path.write_text(READ["day first, decimal comma"])
    record, measured = read_as_listed(listed(path)[1])
    np.testing.assert_array_equal(record.acceleration, measured.values[0])
    assert measured.start == 0.0


def test_what_a_file_does_not_state_must_be_written(path):
    times = ("0.00", "0.01", "0.03", "0.04", "0.05", "0.0601")
    path.write_text(
        "time_s,base,top,top [1]\n" + "".join(f"{t},{k},3,{k - 9999 * (k == 0)}\n" for k, t in enumerate(times))
    )
    output, lines = listed(path)
    assert "interpolated linearly to a step of 0.01 s from steps of 0.01 to 0.0101 s, with 1 gap(s) of" in output
    assert "which usually stands for a missing sample" in output
    assert lines["record"]["units"] == "?" and lines["record"]["resample"] == lines["measurements"]["resample"] == 0.01
    assert lines["measurements"]["units"] == {"base": "?", "top": "?"}
    assert lines["measurements"]["columns"]["top_2"] == "top [1]" and lines["measurements"]["missing"] == [-9999]
    path.write_text("time_s,base [g],flow [l/min]\n0.0,1,2\n0.1,2,3\n0.2,1,3\n")
    output, lines = listed(path)
    assert lines["measurements"]["columns"] == {"base": "base [g]"} and "unknown unit 'l/min'" in output
    path.write_text("base [g]\n1\n2\n")
    assert listed(path)[1]["record"]["dt"] == "?"
    path.write_text("t,base [g]\n0.00,1\n0.02,2\n0.04,1\n")
    output, lines = listed(path)
    assert "the column 't' has no unit" in output
    assert lines["record"]["time_unit"] == lines["measurements"]["time_unit"] == "?"


def test_texts_for_lost_samples_have_lines(tmp_path):
    path, job = tmp_path / "a.csv", tmp_path / "a.toml"
    rows = [f"{0.02 * k:.2f},{np.sin(k):.4f},{'OL' if k in (3, 9) else k % 7},{k % 5}" for k in range(30)]
    path.write_text("\n".join(["time_s,base [g],acceleration [g],displacement [µm]", *rows, ""]), encoding="utf-8")
    output, lines = listed(path)
    assert "line 5: expected a number, got 'OL'" in output
    assert lines["record"]["missing"] == lines["measurements"]["missing"] == ["OL"]
    text = '[model]\nkind = "oscillator"\nperiod = "0.4 s"\n[priors]\nstiffness = "normal(1, 0.3)"\n'
    text += 'damping = "normal(1, 0.3)"\n' + output.partition("= column\n")[2]
    text = text.replace('base = "base [g]", ', "")
    job.write_text(text, encoding="utf-8")
    problem = make_problem(read_job(job))
    values = problem.posterior.likelihood.measurements.values
    assert problem.record.n_steps == 30 and np.flatnonzero(np.isnan(values[0])).tolist() == [3, 9]
    np.testing.assert_allclose(values[1], 1e-6 * (np.arange(30) % 5), rtol=1e-15)
    head, _, tail = text.rpartition('missing = ["OL"]')
    job.write_text(f'{head}missing = ["acceleration", 0.1, 0.2]{tail}', encoding="utf-8")
    with pytest.raises(ValueError, match="missing: a time span is a list of its own"):
        make_problem(read_job(job))


def test_histories_are_no_modes(path):
    for text in ("time_s,f [kN],f1\n0,1,2\n0.1,2,4\n0.2,3,3\n", "f [kN],b [mm]\n1,2\n2,4\n"):
        path.write_text(text)
        assert set(listed(path)[1]) == {"record", "measurements"}


@pytest.mark.parametrize("line", ["# units: gal", "Units: gal", "RAW PGA VALUES (gal) : 4.0"])
def test_a_unit_above_the_table_is_listed_as_it_is_read(path, line):
    path.write_text(f"{line}\ntime_s,base\n0.00,1\n0.01,2\n0.02,-4\n")
    output, lines = listed(path)
    assert " gal " in output and "units" not in lines["record"] and "units" not in lines["measurements"]
    record, measured = read_as_listed(lines)
    np.testing.assert_array_equal(record.acceleration, measured.values[0])
    assert record.acceleration[2] == -0.04


def written(path, lines):
    path.write_text("\n".join(lines))
    return path


@pytest.mark.parametrize(
    ("name", "lines", "count"),
    [
        ("a.v2", csmip(3, VALUES, 0.02, DESCRIPTOR) + csmip(7, VALUES, 0.02, DESCRIPTOR), 2),
        ("a.v2c", cosmos(1, VALUES, 0.005), 1),
        ("a.V2A", geonet({"N10E": VALUES, "Up": VALUES}, 0.02), 2),
        ("a.smc", smc(VALUES, 200.0), 0),
        ("a.smc", smc(VALUES, 1.7e38, times=0.02 * np.arange(23)), 0),
        ("a.asc", esm(VALUES, 0.005), 0),
    ],
)
def test_files_of_networks(tmp_path, name, lines, count):
    output, lines = listed(written(tmp_path / name, lines))
    record, measured = read_as_listed(lines)
    assert " 23 " in output and record.n_steps == 23
    assert (measured is None) == (count == 0)
    assert measured is None or len(measured.channels) == count


def test_a_unit_that_a_file_does_not_state(tmp_path):
    path = write_at2(tmp_path / "a.AT2", VALUES, "NPTS=     23, DT=   .0050 SEC")
    path.write_text(path.read_text().replace("UNITS OF G", "AS RECORDED"))
    output, lines = listed(path)
    assert lines["record"]["units"] == "?"


def test_a_data_set_and_a_file_that_cannot_be_read(tmp_path):
    top = Channel("top", "displacement", "mm")
    write_dataset(tmp_path / "a.h5", Record("a", 0.01, VALUES), Measurements((top,), 0.01, VALUES[None]))
    output, lines = listed(tmp_path / "a.h5")
    assert " mm " in output and lines["measurements"] == {"file": str(tmp_path / "a.h5")}
    (tmp_path / "b.csv").write_text("nothing\n")
    result = CliRunner().invoke(main, ["data", str(tmp_path / "a.h5"), str(tmp_path / "b.csv")])
    assert result.exit_code == 1 and "expected rows of numbers, found none" in result.output
    assert "a data set" in result.output


@pytest.mark.parametrize(
    ("text", "section", "given"),
    [
        ("frequency_Hz,top\n1.5,1.0\n4.6,-0.7\n", "modes", {}),
        ("frequency,top\n1.5,1.0\n4.6,-0.7\n", "modes", {"unit": "?"}),
        ("T [s],top [mm]\n0.0,1.0\n0.1,-0.7\n", "measurements", {"columns": {"top": "top [mm]"}}),
        (
            "case,mid [mm],end\none,1,2\ntwo,2,3\n",
            "load_test",
            {"columns": {"mid": "mid [mm]", "end": "end"}, "units": {"end": "?"}},
        ),
        ("truck at [m],mid [mm]\n1,2\n4,5\n", "load_test", {"columns": {"mid": "mid [mm]"}}),
        ("date,f1_Hz,f2_Hz\n2024-05-01,1.1,3.2\n2024-05-02,1.2,3.3\n", "modes", {}),
    ],
)
def test_data_without_time_have_sections_of_their_own(path, text, section, given):
    path.write_text(text)
    assert listed(path)[1][section] == {"file": str(path)} | given


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"channels": [Channel("top", "displacement", "mm")]},
            "accelerations, as files of this format have, got displacement 'top'",
        ),
        ({"zero": "10:32:07"}, "has no clock times; give zero in seconds"),
        ({"dt": 0.01}, "states a step of 0.02 s but dt = 0.01 was given"),
        (
            {"columns": [8]},
            "expected one channel with column=8, .*found 0; choose with column=, its number or the end",
        ),
        ({"columns": [3, 7]}, "expected one column for each of 1 channels"),
        ({"resample": 0.01}, "a uniform step; leave resample out"),
    ],
)
def test_channels_that_cannot_be_read(tmp_path, given, message):
    path = written(tmp_path / "a.v2", csmip(3, VALUES, 0.02, DESCRIPTOR))
    options = {"channels": [TOP], "columns": [3]} | given
    with pytest.raises(ValueError, match=message):
        read_columns(path, **options)
    assert read_columns(path, [TOP], ["3"], zero=0.1).start == -0.1


def test_the_lines_for_faults_of_sensors_work(tmp_path):
    times, rng = 0.01 * np.arange(2000), np.random.default_rng(1)
    motion = 2.0 * np.sin(13.0 * times) * times * np.exp(-0.3 * times) + 0.01 * rng.standard_normal(2000)
    right = [np.sin(19.0 * times) * times * np.exp(-0.3 * times) + 0.01 * rng.standard_normal(2000) for _ in range(2)]
    stuck, drifting = right[0].copy(), right[1] + 0.1 + 0.03 * times
    stuck[400:450], stuck[700] = stuck[400], 3.0
    rows = zip(times, motion, drifting, stuck, strict=True)
    path, job = tmp_path / "log.csv", tmp_path / "job.toml"
    path.write_text(
        "time_s,base_m_s2,top_g,top_mm\n" + "".join(f"{t:.2f},{b:.5f},{a:.5f},{u:.5f}\n" for t, b, a, u in rows)
    )
    output, lines = listed(path)
    assert "CAUTION: A sensor was stuck: top_mm stands still at 4.000 to 4.490 s" in output
    assert "CAUTION: A channel has spikes: top_mm has spikes of one to three samples at 7.000 s" in output
    assert "CAUTION: A channel drifts: top_g" in output and output.count("CAUTION") == 3
    head = (
        f'[model]\nkind = "oscillator"\nperiod = "0.4 s"\n[record]\nfile = "{path}"\ncolumn = "base_m_s2"\n[priors]\n'
    )
    head += 'stiffness = "normal(1, 0.3)"\ndamping = "normal(1, 0.3)"\n[measurements]\n'
    named = (
        output.partition("[measurements]\n")[2]
        .replace("top_g =", "acceleration =")
        .replace("top_mm =", "displacement =")
    )
    named = named.replace('["top_mm"', '["displacement"').replace('base_m_s2 = "base_m_s2", ', "")
    job.write_text(head + named)
    measured = make_problem(read_job(job)).posterior.likelihood.measurements
    assert np.flatnonzero(np.isnan(measured.values[1])).tolist() == [*range(400, 450), 700]
    np.testing.assert_allclose(measured.values[0], 9.80665 * right[1], atol=0.4)
    assert check_data(measured) == ()  # the samples are left out
    for old, new, message in (
        ('[["displacement"', '[["top"', "missing: no channel 'top'"),
        ("[0.000, ", "[", "baseline: expected a table of points of time and value"),
    ):
        job.write_text(head + named.replace(old, new))
        with pytest.raises(ValueError, match=message):
            make_problem(read_job(job))
    job.write_text(head + named.replace("missing = [[", "missing = [[2.0, 3.0], ["))
    assert np.isnan(make_problem(read_job(job)).posterior.likelihood.measurements.values[:, 200:301]).all()


def test_times_that_repeat_or_contradict_the_header_have_a_line(path):
    times = np.round(0.02 * np.arange(60), 2)
    channel = [Channel("top", "acceleration", "g")]
    repeated = np.where(np.arange(60) == 30, times[29], times)
    path.write_text("time_s,acc_g\n" + "".join(f"{t:.2f},{np.sin(t):.5f}\n" for t in repeated))
    output, lines = listed(path)
    assert "1 row(s) of a repeated time, the first at 0.58 s" in output
    measured = read_columns(path, channel, ["acc_g"], resample=lines["measurements"]["resample"])
    assert np.flatnonzero(np.isnan(measured.values[0])).tolist() == [30]
    assert "without 1 row(s) of a repeated time, the first at 0.58 s" in measured.description
    path.write_text("dt = 0.01 s\ntime_s,acc_g\n" + "".join(f"{t:.2f},{np.sin(t):.5f}\n" for t in times))
    output, lines = listed(path)
    assert "the step is 0.02 s by the time column but 0.01 s by 'dt = 0.01 s'" in output
    assert read_columns(path, channel, ["acc_g"], skip=lines["measurements"]["skip"]).dt == 0.02
    path.write_text("Samples: 99\n" + path.read_text())
    result = CliRunner().invoke(main, ["data", str(path)])
    assert result.exit_code == 1 and "'Samples: 99' announces 99 samples, the file has 60" in result.output


def test_variables_of_matlab_and_files_that_are_no_data(tmp_path):
    savemat(tmp_path / "modes.mat", {"f": [1.0, 3.0], "Phi": np.ones((4, 2))})
    output, lines = listed(tmp_path / "modes.mat")
    assert "Phi       4 x 2" in output and set(lines["modes"]) == {"file", "variables", "columns", "unit"}
    output, _ = listed(tmp_path / "none.h5", 1)
    assert f"cannot read {tmp_path / 'none.h5'}: there is no such file" in output
