"""The commands as a user calls them: their files, their messages, their exit codes."""

import contextlib
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
import xarray
from click.testing import CliRunner

from fe_likelihoods import Channel, LinearOscillator, SimulationCache, read_columns, read_record
from fe_likelihoods.command.job import parse_job, read_job
from fe_likelihoods.command.keys import parse_prior, read_quantity
from fe_likelihoods.command.main import TEMPLATES, main
from fe_likelihoods.command.make_posterior import make_problem
from fe_likelihoods.models.rc_column_materials import LowCycleFatigue
from samplers import SamplingWarning
from tests.command.key_tables import PAGE, key_tables
from tests.opensees_column import require_opensees
from tests.signals.test_readers import csmip

ROOT = Path(__file__).resolve().parents[2]
OSCILLATOR = """
[model]
kind = "oscillator"
period = "0.8 s"
[record]
file = "base.csv"
[measurements]
file = "top.csv"
columns = {acceleration = "top [g]", displacement = "top [mm]"}
[priors]
stiffness = "normal(1, 0.3)"
damping = "normal(1, 0.3)"
sigma_acceleration = "half-normal(0.1 g)"
sigma_displacement = "half-normal(5 mm)"
[sampler]
walkers = 20
steps = 2
guide = true
[prediction]
draws = 10
"""


def function_settings(name: str) -> str:
    """Settings of the same oscillator as a function of a module."""
    kind = f'''kind = "function"
function = "{name}.py:simulate"
parameters = ["stiffness", "damping"]
channels = {{acceleration = "absolute acceleration [g]", displacement = "relative displacement [cm]"}}'''
    return OSCILLATOR.replace('kind = "oscillator"\nperiod = "0.8 s"', kind)


def write_oscillator(folder: Path) -> None:
    """Record, measurements and settings of the test of an oscillator."""
    from fe_likelihoods.problems import table_motion

    record = table_motion().trim(0.0, 6.0).resample(0.02)
    response = LinearOscillator(record, 0.8).simulate([1.1, 0.9]) / [[9.80665], [1e-3]]
    base = [f"{t:.2f},{a!r}" for t, a in zip(record.time, record.acceleration.tolist(), strict=True)]
    rows = enumerate(zip(record.time, *response, strict=True))
    top = [f"{t:.2f},{a + 0.01 * (-1) ** (k // 2):.6f},{d + (-1) ** k:.4f}" for k, (t, a, d) in rows]
    (folder / "base.csv").write_text("\n".join(["time_s,base_m_s2", *base]))
    (folder / "top.csv").write_text("\n".join(["time_s,top [g],top [mm]", *top]))
    (folder / "oscillator.toml").write_text(OSCILLATOR)


def write_function(folder: Path, name: str, old: str = "", new: str = "") -> None:
    """The template of a function as NAME.py and NAME.toml, with another line; a module is imported once by its name."""
    shutil.copytree(ROOT / "data" / "templates", folder, dirs_exist_ok=True)
    for kind, before, now in (("py", old, new), ("toml", "my_function.py", f"{name}.py")):
        text = (folder / ("my_function.py" if kind == "py" else "function.toml")).read_text()
        assert before in text
        (folder / f"{name}.{kind}").write_text(text.replace(before, now) if before else text)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the test of an oscillator, which is the current one."""
    write_oscillator(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def run_once(tmp_path_factory):
    """A folder with the files of a finished run, and what the run said."""
    path = tmp_path_factory.mktemp("run")
    write_oscillator(path)
    with contextlib.chdir(path):
        return path, call("run", "oscillator.toml", "--quiet")


@pytest.fixture
def finished(run_once, folder):
    """A copy of these files in the current folder."""
    shutil.copytree(run_once[0], folder, dirs_exist_ok=True)
    return folder


def call(*arguments: str, code: int = 0) -> str:
    """Output of a command that ends with an exit code."""
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == code, result.output
    return result.output


def test_help_imports_neither_numba_nor_matplotlib():
    code = (
        "import sys, fe_likelihoods.command.main as m\n"
        "try: m.main(['--help'])\nexcept SystemExit: pass\n"
        "print(sorted({'numba', 'matplotlib', 'scipy', 'numpy', 'emcee'} & set(sys.modules)))"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert output.splitlines()[-1] == "[]"
    for name in ("new", "check", "run", "report", "data"):
        assert f"  {name} " in output


@pytest.mark.slow  # starts an interpreter
def test_keys_are_there_without_docstrings():
    code = "from tests.command.key_tables import PAGE, key_tables; print(key_tables() in PAGE.read_text())"
    said = subprocess.run(
        [sys.executable, "-OO", "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    ).stdout
    assert said.splitlines()[-1] == "True"


def test_a_section_switches_fatigue_on():
    text = (ROOT / "data" / "templates" / "column.toml").read_text()
    file = ROOT / "data" / "templates" / "column.toml"
    assert make_problem(parse_job(text, file, file.parent)).posterior.likelihood.model.fatigue is None
    failing = text + "\n[model.fatigue]\ncf = 0.15\n"
    model = make_problem(parse_job(failing, file, file.parent)).posterior.likelihood.model
    assert model.fatigue == LowCycleFatigue(cf=0.15)
    wrong = text + "\n[model.fatigue]\ncf = -1.0\n"
    with pytest.raises(ValueError, match=r"column.toml: \[model.fatigue\]"):
        make_problem(parse_job(wrong, file, file.parent))


def test_the_documentation_has_the_keys():
    assert key_tables() in PAGE.read_text(), "python -m tests.command.key_tables writes them again"


@pytest.mark.parametrize("kind", TEMPLATES)
def test_new_writes_files_that_can_be_read(kind, tmp_path):
    assert "SYNTHETIC" in call("new", kind, str(tmp_path / "a"))
    assert {path.name for path in (tmp_path / "a").iterdir()} == set(TEMPLATES[kind])
    of_data = {"modal": "frame", "load-test": "function"}  # other kinds are of models
    assert read_job(tmp_path / "a" / f"{kind}.toml").kind == of_data.get(kind, kind)
    assert "already contains" in call("new", kind, str(tmp_path / "a"), code=1)


@pytest.mark.parametrize("kind", ["function", "opensees", "executable"])
def test_templates_find_the_true_values_of_their_data(kind, tmp_path):
    """One step of Gauss and Newton from the true values stays within 3 standard errors; a long time step does not."""
    if kind == "opensees":
        require_opensees()
    shutil.copytree(ROOT / "data" / "templates", tmp_path, dirs_exist_ok=True)
    code = "my_program" if kind == "executable" else f"my_{kind}"
    text = (tmp_path / f"{code}.py").read_text()
    shifts = []
    for name, coarse in (("fine", text), ("coarse", re.sub(r"(?m)^SUBSTEPS = \d+", "SUBSTEPS = 1", text))):
        (tmp_path / f"{code}_{name}.py").write_text(coarse)
        settings = (tmp_path / f"{kind}.toml").read_text().replace(f"{code}.py", f"{code}_{name}.py")
        (tmp_path / f"{name}.toml").write_text(settings)
        likelihood = make_problem(read_job(tmp_path / f"{name}.toml")).posterior.likelihood
        true, step = np.array([1.15, 0.85]), 1e-3
        points = [true, *(true + step * np.eye(2))]
        responses = np.array([likelihood.model.simulate(point) for point in points])
        residuals = likelihood.measurements.values - responses
        weighted = (residuals / residuals[0].std(axis=1, keepdims=True)).reshape(3, -1)
        slopes = (weighted[1:] - weighted[0]).T / step
        errors = np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
        shifts.append(np.abs(np.linalg.lstsq(slopes, -weighted[0])[0] / errors).max())
    assert shifts[0] < 3.0 < shifts[1]


def test_a_program_needs_a_time_limit_and_zero_may_be_a_clock_time(tmp_path):
    shutil.copytree(ROOT / "data" / "templates", tmp_path, dirs_exist_ok=True)
    settings = (tmp_path / "executable.toml").read_text()

    def measured(old, new):
        (tmp_path / "other.toml").write_text(settings.replace(old, new))
        return make_problem(read_job(tmp_path / "other.toml")).posterior.likelihood.measurements

    usual = measured("", "")
    for zero in (
        '"2024-05-14 10:32:07.000"',
        '"37927 s"',
        "10:32:07",
        "2024-05-14T10:32:07.000",
    ):  # also without quotes
        np.testing.assert_array_equal(measured('"10:32:07"', zero).values, usual.values)
    later = measured('"10:32:07"', '"10:32:08"').values
    np.testing.assert_array_equal(later[:, :-50], usual.values[:, 50:])  # 1 s at 0.02 s
    for old, new, message in (
        ('zero = "10:32:07"', "", 'a clock time such as "10:32:07"'),
        ('"10:32:07"', '"10.32.07"', "zero: expected a number in s"),
        ('time_limit = "20 s"', "", "time_limit: this key is missing"),
    ):
        with pytest.raises(ValueError, match=message):
            measured(old, new)


def test_check_says_what_was_read(folder, monkeypatch):
    simulated, simulate = [], LinearOscillator.simulate

    def counted(model, theta):
        simulated.append((model.fingerprint, *theta))
        return simulate(model, theta)

    monkeypatch.setattr(LinearOscillator, "simulate", counted)
    output = call("check", "oscillator.toml")
    # the mean of the prior is simulated four times
    assert len(simulated) - len(set(simulated)) <= 3
    assert "Record: base, 301 samples at 0.02 s" in output
    assert " 301 " in output and "One simulation takes" in output
    assert re.search(r"measured RMS\n(?s:.*)sigma_displacement \[cm\] +\S+ +\S+ +[\d.]+\n", output)
    assert (folder / "check-oscillator.png").stat().st_size > 10_000
    assert not (folder / "results-oscillator").exists()
    (folder / "other").mkdir()
    (folder / "other" / "notes.txt").write_text("no run")
    assert "is not the folder of a run" in call("run", "oscillator.toml", "--out", "other", code=1)


@pytest.mark.slow
def test_a_motion_that_is_not_read_and_chance_are_told_by_check(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fixed = "    motion = (0.1 * record.acceleration / abs(record.acceleration).max()).tolist()"
    write_function(tmp_path, "unread", "    motion = record.acceleration.tolist()", fixed)
    output = call("check", "unread.toml")
    assert re.search("CAUTION.*: The motion changes nothing: The response to twice the motion equals", output)
    chance = "    return response * (1.0 + 1e-4 * np.random.default_rng().standard_normal())"
    write_function(tmp_path, "chance", "    return response", chance)
    assert re.search("CAUTION.*: The model is not repeatable", call("check", "chance.toml"))
    assert "The model is not repeatable" in call("run", "chance.toml", "--quiet", code=1)


def test_run_writes_its_files(run_once):
    folder, output = run_once
    assert "log-evidence" in output and "Written to results-oscillator/" in output
    results = folder / "results-oscillator"
    for name in (
        "report.html",
        "summary.txt",
        "summary.csv",
        "stages.csv",
        "posterior.nc",
        "run.h5",
        "settings.toml",
    ):
        assert (results / name).stat().st_size > 0, name
    counted = int(re.search(r" from (\d+) simulations\.", (results / "summary.txt").read_text())[1])
    assert counted < SimulationCache(results / "simulations.sqlite").info().simulations  # short parts are fractions
    assert "sigma_displacement [cm]" in (results / "summary.csv").read_text()
    assert "prior of sigma" not in output
    predictions = xarray.load_dataset(results / "posterior.nc", group="predictions")
    assert any(name.endswith("_quantiles") for name in predictions.data_vars)


def test_a_run_with_other_settings_is_refused(finished):
    first = (finished / "results-oscillator" / "summary.csv").read_text()
    (finished / "oscillator.toml").write_text(OSCILLATOR.replace("walkers = 20", "walkers = 24"))
    message = call("run", "oscillator.toml", "--quiet", code=1)
    assert "[sampler] walkers differ" in message and "--out" in message
    assert (finished / "results-oscillator" / "summary.csv").read_text() == first


@pytest.mark.slow
def test_a_finished_run_is_not_repeated(finished):
    results = finished / "results-oscillator"
    first = (results / "summary.csv").read_text()
    assert "Written to" in call("run", "oscillator.toml", "--quiet")
    assert (results / "summary.csv").read_text() == first
    (results / "summary.csv").unlink()
    call("report", "results-oscillator/run.h5")
    assert (results / "summary.csv").read_text() == first


def test_another_file_of_the_same_name_is_refused(finished):
    """Its settings are the same, its data are not."""
    folder = finished
    (folder / "other").mkdir()
    for name in ("oscillator.toml", "top.csv"):
        (folder / "other" / name).write_text((folder / name).read_text())
    lines = (folder / "base.csv").read_text().splitlines()
    (folder / "other" / "base.csv").write_text("\n".join([*lines[:-1], "6.00,0.1"]))
    before = (folder / "results-oscillator" / "origin.json").read_text()
    output = call("run", "other/oscillator.toml", "--quiet", code=1)
    assert "results-oscillator contains a run with other data or another model" in output and "--out" in output
    assert (folder / "results-oscillator" / "origin.json").read_text() == before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[record]", "[recrd]", r"oscillator.toml: recrd: unknown section; did you mean record?"),
        ("[model]", "[model", "not a TOML file"),
        ('"oscillator"', '"osculator"', "[model] kind: expected the kind of the structure; got 'osculator'; did you"),
        ("period", "perod", "oscillator.toml: [model] perod: unknown key of kind oscillator; did you mean period?"),
        ('"0.8 s"', '"0.8 mm"', "[model] period: expected a number in s, or a text with a unit such as '1 s'; got"),
        ('"0.8 s"', "-0.8", "[model] LinearOscillator: period"),
        ("base.csv", "bse.csv", "[record] file: there is no file"),
        ("top [mm]", "top [in]", "[measurements] top.csv: expected one column of values named 'top [in]', the columns"),
        ("displacement =", "displ =", "[measurements] columns: displ: unknown channel; did you mean displacement?"),
        ('acceleration = "top [g]", ', "", "[measurements] columns: expected a column for each channel of the model"),
        ("walkers = 20", "walkers = 2", "[sampler]"),
        ("draws = 10", "draws = -5", "[prediction] draws: expected a whole number >= 0, such as 1; got -5"),
        ("half-normal(5 mm)", "halfnormal(5)", "[priors] sigma_displacement: expected a distribution in quotes"),
        (
            'damping = "normal(1, 0.3)"',
            "damping = 1.0",
            "[priors] a number in the prior is a known parameter of the noise",
        ),
        ("damping =", "dampng =", "[priors] dampng: the model has no such parameter; did you mean damping?"),
        ('damping = "normal(1, 0.3)"', "", '[priors] damping: this prior is missing; write for example damping = "n'),
        (
            "guide = true",
            'guide = true\nkind = "mcmc"',
            "[sampler] kind: expected one of smc, tmcmc; got 'mcmc'",
        ),
        ("[prediction]", "[budget]\nworkers = 2\n[prediction]", "[budget] workers: a built-in model uses all cores"),
    ],
)
def test_errors_name_the_key(folder, old, new, message):
    assert old in OSCILLATOR
    (folder / "oscillator.toml").write_text(OSCILLATOR.replace(old, new, 1))
    output = call("run", "oscillator.toml", "--quiet", code=1)
    assert output.startswith("Error: oscillator.toml: ") and message in output and "Traceback" not in output
    assert output.count("oscillator.toml: ") == 1
    assert not (folder / "results-oscillator").exists()


def test_the_error_says_why_the_first_simulation_has_failed(tmp_path, monkeypatch):
    write_function(tmp_path, "collapsing", "    return response", '    raise RuntimeError("the deck has collapsed")')
    monkeypatch.chdir(tmp_path)
    last = call("check", "collapsing.toml", code=1).splitlines()[-1]
    assert last.startswith("Error: the simulation at the mean of the prior has failed: ")
    assert "the deck has collapsed" in last


def test_a_damaged_table_and_a_missing_file_are_named(folder):
    (folder / "top.csv").write_text("time_s,top [g],top [mm]\n0.00,1.0,1\n0.02,1,abc\n0.04,1,1\n")
    assert "[measurements] top.csv, line 3" in call("check", "oscillator.toml", code=1)
    assert "cannot read nothing.toml: No such file" in call("run", "nothing.toml", code=1)
    assert "No such option" in call("run", "oscillator.toml", "--resume", code=1)


@pytest.mark.slow
def test_measurements_that_hardly_cover_the_record_are_told(folder):
    """Times in milliseconds under a header in seconds, and a record that is much shorter than the measurements."""
    lines = (folder / "top.csv").read_text().splitlines()
    (folder / "top.csv").write_text("\n".join([lines[0], *(f"{20 * k},0.01,{k}" for k in range(301))]))
    output = call("run", "oscillator.toml", code=1)
    assert "[measurements] zero: 1 of 301 samples of acceleration lie within the record, 0 to 6 s" in output
    assert "check time_unit" in output and not (folder / "results-oscillator").exists()

    (folder / "top.csv").write_text("\n".join(lines))
    (folder / "base.csv").write_text("\n".join((folder / "base.csv").read_text().splitlines()[:102]))
    output = call("check", "oscillator.toml")
    caution = "CAUTION: only 101 of 301 samples of acceleration lie within the record: check time_unit"
    assert caution in output and caution in call("run", "oscillator.toml", "--quiet")
    assert caution in (folder / "results-oscillator" / "report.html").read_text(encoding="utf-8")


def test_accelerations_of_a_v2_file(folder):
    base = read_record(folder / "base.csv").acceleration
    top = read_columns(folder / "top.csv", [Channel("top", "acceleration", "g")], ["top [g]"]).values[0]
    lines = [csmip(k, 100 * row, 0.02, "  .020 sec, in cm/sec2. (8f10.4)", 10, 4) for k, row in ((3, base), (7, top))]
    (folder / "both.v2").write_text("\n".join(lines[0] + lines[1]))
    (folder / "frame.toml").write_text(
        "[model]\nkind = 'frame'\nmasses = [1.0]\nstiffnesses = [62.0]\nfloors = {top = 1}\n"
        "[record]\nfile = 'both.v2'\ncolumn = 3\n[measurements]\nfile = 'both.v2'\ncolumns = {top = 7}\n"
        "[priors]\nstiffness_1 = 'normal(1, 0.3)'\ndamping_1 = 'normal(0.05, 0.02)'\n"
    )
    found = make_problem(read_job(folder / "frame.toml"))
    measured = found.posterior.likelihood.measurements
    np.testing.assert_allclose(measured.channel("top"), top, atol=1e-6)
    np.testing.assert_allclose(found.record.acceleration, base, atol=1e-6)
    assert "top is Chan 7: 360 Deg" in measured.description


def test_uneven_times_are_resampled(folder):
    lines = (folder / "top.csv").read_text().splitlines()
    rows = [f"{float(line[:4]) + 0.004 * (k % 2):.3f}{line[4:]}" for k, line in enumerate(lines[1:])]
    (folder / "top.csv").write_text("\n".join([lines[0], *rows]))
    assert "or give resample=0.02" in call("check", "oscillator.toml", code=1)
    text = OSCILLATOR.replace("[priors]", 'resample = "20 ms"\n[priors]')
    (folder / "oscillator.toml").write_text(text)
    measured = make_problem(read_job(folder / "oscillator.toml")).posterior.likelihood.measurements
    assert measured.dt == 0.02 and "interpolated linearly to a step of 0.02 s" in measured.description


def test_files_and_folders_that_cannot_be_used_are_told(folder):
    (folder / "oscillator.toml").write_text(OSCILLATOR, encoding="utf-8-sig")
    (folder / "a file").write_text("")
    output = call("run", "oscillator.toml", "--out", "a file/results", code=1)
    assert "cannot make the folder a file/results: Not a directory; give another one with --out" in output


def test_priors_of_gains_and_lags_make_sensors(folder):
    more = 'gain_displacement = "log-normal(1, 0.05)"\nlag_acceleration = "normal(0, 20 ms, -0.1 s, 0.1 s)"\n'
    more += 'gain_support_0 = "uniform(0.5, 2)"\n'
    (folder / "oscillator.toml").write_text(OSCILLATOR.replace("[sampler]", more + "[sampler]"))
    posterior = make_problem(read_job(folder / "oscillator.toml")).posterior
    names = ("stiffness", "damping", "gain_displacement", "lag_acceleration", "gain_support_0")
    assert tuple(posterior.parameter_names[:5]) == names
    assert posterior.prior.distributions["lag_acceleration"].sd == 0.02
    plain = posterior.likelihood.model.model.simulate([1.0, 1.0])
    shown = posterior.likelihood.model.simulate([1.0, 1.0, 0.5, 0.0, 1.0])
    np.testing.assert_allclose(shown, plain * [[1.0], [0.5]], rtol=1e-12)
    (folder / "oscillator.toml").write_text(OSCILLATOR.replace("[sampler]", 'gain_roof = "uniform(0, 2)"\n[sampler]'))
    assert "[priors] gain_roof: the model has no such parameter" in call("check", "oscillator.toml", code=1)


def test_check_warns_of_what_is_likely_wrong(folder):
    text = OSCILLATOR.replace("guide = true", "")
    lines = (folder / "top.csv").read_text().splitlines()
    lines[5:15] = [line.rpartition(",")[0] + ",nan" for line in lines[5:15]]
    lines[100:120] = [
        ",".join([one.split(",")[0], lines[100].split(",")[1], one.split(",")[2]]) for one in lines[100:120]
    ]
    (folder / "top.csv").write_text("\n".join(lines))
    (folder / "oscillator.toml").write_text(text.replace("[prediction]", "[budget]\nmax_simulations = 5\n[prediction]"))
    output = call("check", "oscillator.toml")
    assert re.search(r"displacement +\w+ +301 +10 ", output) and "The run stops at 5 simulations" in output
    times = [float(lines[k].split(",")[0]) for k in (100, 119)]
    assert "CAUTION: A sensor was stuck: acceleration stands still at" in output
    assert f'missing = [["acceleration", {times[0]:.3f}, {times[1]:.3f}]]' in output


@pytest.mark.parametrize(("clock", "zero"), [(False, "0.3"), (True, '"10:32:00.300000"')])
def test_check_prints_the_line_for_another_clock(folder, clock, zero):
    """The motion begins 0.3 s later in the file of measurements than its settings say."""
    head, *rows = (folder / "top.csv").read_text().splitlines()
    late = [(float(time) + 0.3, rest) for time, _, rest in (row.partition(",") for row in rows)]
    texts = [f"10:32:{time:06.3f},{rest}" if clock else f"{time:.2f},{rest}" for time, rest in late]
    (folder / "top.csv").write_text("\n".join([head, *texts]))
    first = '"10:32:00"' if clock else "0.0"
    text = OSCILLATOR.replace("[measurements]", f"[measurements]\nzero = {first}")
    (folder / "oscillator.toml").write_text(text)
    assert f"In [measurements], if the clocks differ: zero = {zero}\n" in call("check", "oscillator.toml")
    (folder / "oscillator.toml").write_text(text.replace(first, zero))
    assert "clocks" not in call("check", "oscillator.toml").lower()


def test_a_sensor_with_the_opposite_sign_is_reversed(folder):
    usual = make_problem(read_job(folder / "oscillator.toml")).posterior.likelihood.measurements
    for name, code in (("displacement", 0), ("displacment", 1)):
        text = OSCILLATOR.replace("[measurements]", f'[measurements]\nreversed = ["{name}"]')
        (folder / "oscillator.toml").write_text(text)
        if code:
            assert "[measurements] reversed: no channel 'displacment'" in call("check", "oscillator.toml", code=code)
            break
        turned = make_problem(read_job(folder / "oscillator.toml")).posterior.likelihood.measurements
        np.testing.assert_array_equal(turned.values, usual.values * [[1.0], [-1.0]])


def test_sys_exit_of_the_users_code_is_an_error(monkeypatch):
    monkeypatch.setattr("fe_likelihoods.command.runs.run_job", lambda *arguments, **options: sys.exit(0))
    output = call("run", "nothing.toml", code=1)
    assert output.startswith(
        "Error: sys.exit(0) in the user's code has ended the command. Interrupted. What was computed"
    )


def test_quantities_and_priors_as_text():
    for value, dimension, expected in (
        ("48 in", "displacement", 1.2192),
        (2, "time", 2.0),
        ("0.5s", "time", 0.5),
        ("1e-3m", "displacement", 1e-3),
        ("1000psi", "stress", 6894757.293168361),
        (42e6, "stress", 42e6),
    ):
        assert read_quantity(value, dimension) == pytest.approx(expected, rel=1e-12)
    with pytest.raises(ValueError, match='a plain number is in Pa, and 6.1 Pa .* "6.1 ksi"'):
        read_quantity(6.1, "stress")
    for value in ("48", "48 kg", "inf m", True):
        with pytest.raises(ValueError, match="expected a number in m, or a text with a unit such as '1 m'"):
            read_quantity(value, "displacement")
    assert parse_prior("half-normal(5mm)", "displacement").sd == 5e-3
    assert parse_prior("half-normal(0.1 g)", "acceleration").sd == pytest.approx(0.980665)
    assert parse_prior("normal(1, 0.5, 0.2, inf)").bounds == (0.2, float("inf"))
    assert parse_prior("0.4 mm", "displacement") == pytest.approx(4e-4) and parse_prior(4e-4) == 4e-4
    wrong = (
        "uniform(1)",
        "uniform(0, 1, 2)",
        "log-normal()",
        "normal(1, 0.3, 0)",
        "normal",
        "gamma(1, 2)",
        "normal(1, a)",
        "log-normal(1 mm, 0.3 mm)",
        "normal(1, nan)",
        "normal(0, 1)",
        "normal(2,4e6; 0,5e6)",
        True,
    )
    for text in wrong:
        with pytest.raises(ValueError, match="expected"):
            parse_prior(text)
    with pytest.raises(ValueError, match="section is missing"):
        parse_job("", Path("a.toml"), Path("."))


def test_warnings_are_sentences_without_file_and_line(monkeypatch):
    def warns(*arguments, **options):
        print(warnings.formatwarning(SamplingWarning("the samples are few"), SamplingWarning, "a.py", 3), end="")
        raise ValueError("and no more")

    monkeypatch.setattr("fe_likelihoods.command.runs.run_job", warns)
    said = call("run", "nothing.toml", code=1).splitlines()
    assert sorted(said) == ["Error: and no more", "Warning: the samples are few"]
