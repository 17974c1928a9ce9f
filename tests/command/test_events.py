"""Other events in the TOML file: their predictions, their scores, their errors."""

import contextlib
import csv
import re
import shutil
from collections import Counter

import numpy as np
import pytest

from fe_likelihoods import LinearOscillator, SimulationCache, SimulationFailed, from_si, propagate
from fe_likelihoods.command.events import predict_events, read_events
from fe_likelihoods.command.job import read_job
from fe_likelihoods.command.models import make_problem
from fe_likelihoods.models import linear_oscillator
from fe_likelihoods.prediction.quantities import peak
from fe_likelihoods.signals.read import read_record
from tests.command.test_command import OSCILLATOR, call, folder, write_oscillator  # noqa: F401
from tests.reporting.report_page import read_page

SETTINGS = OSCILLATOR.replace("draws = 10", "draws = 20")
EVENTS = """
[events.weaker]
file = "base.csv"
scale = 0.5
measured = "weaker.csv"
[events.after]
file = "base.csv"
from_state = "end"
rest = "1 s"
"""


def write_files(folder):  # noqa: F811
    """Beside the files of the oscillator: measurements of another event, and settings with two events."""
    record = read_record(folder / "base.csv")
    response = LinearOscillator(record.scale(0.5), 0.8).simulate([1.1, 0.9]) / [[9.80665], [1e-3]]
    rows = [f"{t!r},{a!r},{d!r}" for t, a, d in zip(record.time.tolist(), *response.tolist(), strict=True)]
    (folder / "weaker.csv").write_text("\n".join(["time_s,top [g],top [mm]", *rows]))
    (folder / "oscillator.toml").write_text(SETTINGS + EVENTS)


@pytest.fixture
def events(folder):  # noqa: F811
    write_files(folder)
    return folder


@pytest.fixture(scope="module")
def run_once(tmp_path_factory):
    """A folder with the files of a run with events, and what the run said."""
    path = tmp_path_factory.mktemp("events")
    write_oscillator(path)
    write_files(path)
    with contextlib.chdir(path):
        return path, call("run", "oscillator.toml", "--out", "r", "--quiet")


@pytest.fixture
def finished(run_once, folder):  # noqa: F811
    """A copy of these files in the current folder."""
    shutil.copytree(run_once[0], folder, dirs_exist_ok=True)
    return folder


def test_events_are_predicted_and_scored(finished, run_once):
    events, said = finished, run_once[1]
    assert "events.csv" in said and "Warning:" not in said  # findings are cautions
    with open("r/events.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    record = read_record("base.csv").scale(0.5)
    peaks = np.abs(LinearOscillator(record, 0.8).simulate([1.1, 0.9])).max(axis=1)
    assert [row["event"] for row in rows] == ["weaker", "weaker", "after", "after"]
    for largest, row in zip(peaks, rows[:2], strict=True):
        peak = from_si(largest, row["unit"])
        assert float(row["measured"]) == pytest.approx(peak)
        assert float(row["median"]) == pytest.approx(peak, rel=0.1)
        assert float(row["q05"]) <= float(row["q25"]) <= float(row["median"]) <= float(row["q75"]) <= float(row["q95"])
    assert rows[2]["measured"] == rows[2]["pit"] == ""

    report = read_page(events / "r" / "report.html")
    assert sum(alt.startswith("Predicted histories") for _, alt in report.images) == 3  # with the calibrated event
    told = [title.removeprefix("weaker: ") for title in report.notes if title.startswith("weaker: ")]
    assert told and all(f"CAUTION: event weaker: {title}" in said for title in told)


@pytest.mark.slow
def test_report_makes_events_again_without_simulations(finished, monkeypatch):
    first = (finished / "r" / "events.csv").read_text()
    simulated, one = [], linear_oscillator.respond
    monkeypatch.setattr(linear_oscillator, "respond", lambda *args: simulated.append(args) or one(*args))
    for most in (19, 7):  # at first more rows of the file are verified; samples that were in memory alone are stored
        simulated.clear()
        (finished / "r" / "events.csv").unlink()
        said = call("report", "r")
        assert "events.csv" in said and (finished / "r" / "events.csv").read_text() == first
        motions = Counter(len(motion) for motion, *_ in simulated)  # each has 20 predictions, the measured one samples
        assert 0 < max(motions.values()) <= most


@pytest.mark.slow
def test_an_event_is_added_to_a_finished_run_without_new_samples(events):
    (events / "oscillator.toml").write_text(SETTINGS)
    call("run", "oscillator.toml", "--out", "r", "--quiet")
    stored = SimulationCache("r/simulations.sqlite").info().simulations
    (events / "oscillator.toml").write_text(SETTINGS + EVENTS)
    call("run", "oscillator.toml", "--out", "r", "--quiet")
    assert SimulationCache("r/simulations.sqlite").info().simulations == stored
    assert (events / "r" / "events.csv").is_file()


@pytest.mark.slow
def test_an_event_whose_simulations_all_fail_is_named_in_the_report(events, monkeypatch):
    weak, one = 0.7 * np.abs(read_record("base.csv").acceleration).max(), LinearOscillator.simulate

    def simulate(self, theta):
        if np.abs(self.record.acceleration).max() < weak:
            raise SimulationFailed("no motion")
        return one(self, theta)

    monkeypatch.setattr(LinearOscillator, "simulate", simulate)
    said = call("run", "oscillator.toml", "--out", "r", "--quiet")
    report = read_page(events / "r" / "report.html")
    failed = "weaker: An event is not predicted"
    assert f"CAUTION: event {failed}: " in said and "no motion" in said
    assert failed in report.text and "weaker: There is no prediction." in report.text
    numbers = next(table for table in report.tables if table[0][1:3] == ["Quantity", "Median"])[1:]
    assert {row[0] for row in numbers} == {"after"}


def test_peaks_with_a_noise_in_shares_have_the_error_of_the_model(events, monkeypatch):
    """Histories have the noise of each sample; no response is simulated twice for the two."""
    noise = '[noise]\nlevel = "measured"\nwindow = "1 s"\n'
    text = re.sub(r"(?m)^(sigma_.*|guide = true)\n", "", SETTINGS + EVENTS)
    (events / "oscillator.toml").write_text(text + noise)
    job = read_job("oscillator.toml")
    problem = make_problem(job, SimulationCache(events / "simulations.sqlite", verify=False))
    samples = problem.posterior.sample_prior(12, 1)
    found = read_events(job, problem)
    simulated, one = [], linear_oscillator.respond
    monkeypatch.setattr(linear_oscillator, "respond", lambda *args: simulated.append(args) or one(*args))
    predicted = predict_events(job, found, problem, samples, False)
    assert 24 <= len(simulated) <= 26  # and the response of the calibration, whose residuals are checked
    for event in found:
        measured = event.measured is not None
        options = {"record": event.record, "seed": 1, "progress": False} | event.options
        for quantity, kind in ((peak("displacement"), "model"), (None, True)):
            expected = propagate(problem.posterior, samples, quantity=quantity, noise=measured and kind, **options)
            own = predicted[event.name]["peaks" if quantity else "histories"].quantile(0.5)
            np.testing.assert_allclose(own[1] if quantity else own, expected.quantile(0.5), rtol=1e-12)
    assert predicted["weaker"]["peaks"].noise and not predicted["after"]["peaks"].noise


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('from_state = "end"', 'from_state = "rest"', "[events.after] from_state: expected one of virgin, end"),
        ('measured = "weaker.csv"', 'measured = "waker.csv"', "[events.weaker] measured: there is no file waker.csv"),
        ('measured = "weaker.csv"', 'zero = "1 s"', "[events.weaker] zero: this key has no effect without measured"),
        ("scale = 0.5", "factor = 0.5", "[events.weaker] factor: unknown key"),
        ("[events.weaker]\nfile", "[events.weaker]\ncolumn", "[events.weaker] file: this key is missing"),
        ("[events.weaker]", '[events."a/b"]', "[events.a/b]: expected a name of letters"),
    ],
)
def test_errors_name_section_and_key_before_the_run(events, old, new, message):
    (events / "oscillator.toml").write_text((SETTINGS + EVENTS).replace(old, new))
    assert message in call("run", "oscillator.toml", "--out", "r", code=1)
    assert not (events / "r").exists()


@pytest.mark.parametrize("step", [0.005, 0.04])
def test_a_motion_with_another_step_is_resampled_to_that_of_the_model(events, step):
    """The keys `every` and `dt` of the calibration record do not act on the event by count."""
    text = (SETTINGS + EVENTS).replace('file = "base.csv"\n[measure', 'file = "base.csv"\nevery = 2\n[measure')
    record = read_record("base.csv").resample(step)
    rows = [f"{t!r},{a!r}" for t, a in zip(record.time.tolist(), record.acceleration.tolist(), strict=True)]
    (events / "other.csv").write_text("\n".join(["time_s,base_m_s2", *rows]))
    (events / "oscillator.toml").write_text(
        text.replace('[events.after]\nfile = "base.csv"', '[events.after]\nfile = "other.csv"')
    )
    job = read_job("oscillator.toml")
    problem = make_problem(job)
    assert problem.record.dt == pytest.approx(0.04)
    weaker, after = read_events(job, problem)
    assert weaker.record.dt == after.record.dt == pytest.approx(0.04)
    assert weaker.measured.dt == pytest.approx(0.02)  # compared at their own times
    propagate(problem.posterior, problem.posterior.sample_prior(3, 1), record=after.record, **after.options)
    assert "Event after: other" in call("check", "oscillator.toml")


@pytest.mark.slow
def test_measurements_that_end_between_two_steps_of_the_model_are_scored(events):
    """With `every`, the motion may end one sample before the measurements."""
    for name in ("base.csv", "top.csv", "weaker.csv"):
        path = events / name
        path.write_text("\n".join(path.read_text().splitlines()[:-1]))  # 300 samples, 0 to 5.98 s
    text = (SETTINGS + EVENTS).replace('file = "base.csv"\n[measure', 'file = "base.csv"\nevery = 2\n[measure')
    (events / "oscillator.toml").write_text(text)
    said = call("run", "oscillator.toml", "--out", "r", "--quiet")
    report = read_page(events / "r" / "report.html")
    assert "no scores" not in said + report.text.lower()
    assert any(table[0][-1] == "In the 90 % band" for table in report.tables)
