"""Models defined by a program: parameters and responses are exact, and failing programs are reported."""

import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import ExecutableModel, SimulationFailed
from fe_likelihoods.simulation.label import ModelLabel
from tests.faults.treacherous import CHANNELS, DT, N_STEPS, gone, line

PROGRAM = Path(__file__).with_name("program.py")
NAMES = ("offset", "slope")
THETA = np.array([1.0 / 3.0, 1e-17])


def model_of(what="fine", **options):
    settings = {
        "command": [sys.executable, PROGRAM, "in.txt"],
        "templates": {"in.txt": f"${{offset}}\n$slope\n{N_STEPS} {DT!r}\n{what}"},
        "output": "out.txt",
        "columns": [1],
        "parameter_names": NAMES,
        "channels": CHANNELS,
        "dt": DT,
        "n_steps": N_STEPS,
        "time_limit": 20.0,
    }
    return ExecutableModel(**settings | options)


def failure(model):
    with pytest.raises(SimulationFailed) as caught:
        model.simulate(THETA)
    return caught.value.reason


def family(path):
    return [int(pid) for pid in path.read_text().split()]


# responses ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"what": "commas"}, {"what": "one", "columns": None}], ids=str)
def test_parameters_and_responses_are_exact(options):
    theta = np.array([1.0 / 3.0, -(2.0**-40) / 7.0])
    np.testing.assert_array_equal(model_of(**options).simulate(theta), line(theta))


def test_units_of_the_output_file():
    usual, kilo = (
        model_of(),
        model_of(output_units={CHANNELS[0].name: {"m": "mm", "m/s2": "mm/s2"}[CHANNELS[0].si_unit]}),
    )
    np.testing.assert_allclose(kilo.simulate(THETA), 1e-3 * usual.simulate(THETA), rtol=1e-15)
    assert kilo.fingerprint != usual.fingerprint == model_of(output_units={}).fingerprint
    for given, message in (
        ({"output_units": {"deck": "mm"}}, "output_units names deck; the channels are"),
        ({"output_units": {CHANNELS[0].name: "kN"}}, "expected a unit of"),
        ({"output_units": {CHANNELS[0].name: "mm"}, "output": lambda folder: None}, "let the function return SI units"),
    ):
        with pytest.raises(ValueError, match=message):
            model_of(**given)


def test_parameters_in_the_command_copied_files_and_an_output_function(tmp_path):
    data = tmp_path / "record.txt"
    data.write_text("17 $5\n")
    model = model_of(
        command=[
            sys.executable,
            "-c",
            "import sys; print(*sys.argv[1:]); print(open('sub/record.txt').read())",
            "$slope",
        ],
        templates={"deck/in.txt": "${offset} costs $$5"},
        files={"sub/record.txt": data},
        output=_read_everything,
    )
    response = model.simulate(THETA)
    np.testing.assert_array_equal(response[0, :4], [*THETA, 5.0, 17.0])


def _read_everything(folder):
    offset, _, price = (folder / "deck" / "in.txt").read_text().split()
    slope, amount, _ = (folder.parent / "stdout.txt").read_text().split()
    row = np.zeros((1, N_STEPS))
    row[0, :4] = float(offset), float(slope), float(price[1:]), float(amount)
    return row


def test_runs_leave_no_files(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    model_of().simulate(THETA)
    failure(model_of("fail"))
    assert list(tmp_path.iterdir()) == []


# failures ----------------------------------------------------------------------------------------------------

CASES = {
    "fail": "the program ended with exit code 1: matrix is singular / at step 12",
    "crash": "the program died (signal 6)",
    "silent": "the program succeeded but wrote no file out.txt",
    "nan": "the response of channel 'a' is not finite",
    "short": "the response has shape (1, 19), expected (n_channels, n_steps) = (1, 20)",
    "words": "out.txt is not a table of numbers",
    "empty": "out.txt is empty",
    "one": "out.txt has 1 columns, expected columns 1, counted from 0",
    "hang": "stopped at the time limit of 0.5 s",
    "flood": "stopped because it wrote more than 1000000 bytes",
    "fill": "stopped because it wrote more than 1000000 bytes",
}


@pytest.mark.parametrize("what", CASES)
def test_reason_of_a_failure(what, monkeypatch):
    monkeypatch.setattr(ExecutableModel, "max_output", 1_000_000)
    options = {"time_limit": 0.5} if what == "hang" else {}
    assert failure(model_of(what, **options)).startswith(CASES[what])


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="NO /proc: background processes cannot be found")
def test_hanging_program_is_killed_with_its_children(tmp_path, monkeypatch):
    monkeypatch.setenv("FAMILY", str(tmp_path / "pids"))
    reason = failure(model_of("family", time_limit=1.0))
    assert reason == "stopped at the time limit of 1 s"
    pids = family(tmp_path / "pids")
    assert len(pids) == 4
    assert gone(pids)


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="NO /proc: background processes cannot be found")
def test_processes_left_by_a_program_are_killed(tmp_path, monkeypatch):
    """Also a process without an environment, whose parent has ended."""
    monkeypatch.setenv("FAMILY", str(tmp_path / "pids"))
    np.testing.assert_array_equal(model_of("leftovers").simulate(THETA), line(THETA))
    pids = family(tmp_path / "pids")
    assert len(pids) == 4
    assert gone(pids)


# settings and fingerprint -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"command": ["no_such_program_anywhere", "in.txt"]}, "executable program, .* got 'no_such_program_anywhere'"),
        ({"command": [str(PROGRAM)]}, "expected an executable program"),
        ({"command": f"{sys.executable} in.txt"}, "command must be a list"),
        ({"command": []}, "command must be a list"),
        ({"time_limit": 0.0}, "time_limit must be a positive number of seconds"),
        ({"time_limit": None}, "time_limit"),
        ({"templates": {"in.txt": "$offset $slope $damping"}}, "template in.txt has placeholders for damping"),
        ({"templates": {"in.txt": "$offset"}}, "has a placeholder for slope"),
        ({"templates": {"in.txt": "$offset $slope costs 5 $"}}, "starts no placeholder"),
        ({"templates": {"../in.txt": "$offset $slope"}}, "inside the folder of the run"),
        ({"templates": {"in.txt": Path("/no/such/template")}}, "Path of an existing file"),
        ({"files": {"record.txt": Path("/no/such/record")}}, "Path of an existing file"),
        ({"files": {"in.txt": PROGRAM}}, "in.txt is more than one of a template, a file"),
        ({"output": 3}, "output must be a file name or a function"),
        ({"columns": [0, 1]}, "one column, 0 or more, for each of the 1 channels"),
    ],
    ids=str,
)
def test_wrong_arguments_are_rejected(options, advice):
    with pytest.raises(ValueError, match=advice):
        model_of(**options)


def test_fingerprint_and_label_depend_on_everything_that_is_run(tmp_path):
    script, template, data = tmp_path / "solver", tmp_path / "template", tmp_path / "data"
    script.write_text("#!/bin/sh\necho 1\n")
    script.chmod(0o755)
    template.write_text("$offset $slope")
    data.write_text("1")

    def fingerprint(**options):
        settings = {"command": [str(script), "-x"], "templates": {"in.txt": template}, "files": {"d": data}}
        model = model_of(**settings | options)
        return model.fingerprint, ModelLabel(model).code

    first = fingerprint()
    assert first == fingerprint() == fingerprint(time_limit=1.0)
    prints = {
        first,
        fingerprint(command=[str(script), "-y"]),
        fingerprint(output="other.txt"),
        fingerprint(version="2"),
    }
    prints |= {fingerprint(columns=[2]), fingerprint(output=_read_everything)}
    for path, text in ((script, "#!/bin/sh\necho 2\n"), (template, "$slope $offset"), (data, "2")):
        path.write_text(text)
        prints.add(fingerprint())
    assert len(prints) == 9
    assert len({declared for declared, _ in prints}) == 5  # output, version, columns, function


def test_program_found_by_a_relative_path_is_started_in_another_folder(tmp_path, monkeypatch):
    script = tmp_path / "solver"
    script.write_text(f"#!{sys.executable}\n" + PROGRAM.read_text())
    script.chmod(0o755)
    monkeypatch.chdir(tmp_path)
    model = model_of(command=["./solver", "in.txt"])
    os.chdir("/")
    np.testing.assert_array_equal(model.simulate(THETA), line(THETA))


def test_a_script_that_is_not_in_the_folder_of_the_run_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text(PROGRAM.read_text())
    reason = failure(model_of(command=[sys.executable, "script.py", "in.txt"]))
    assert re.search(r"the program ran in /.*/run, where there is no script\.py: give the absolute path", reason)
    assert "in.txt" not in reason.partition("the program ran in")[2]
    copied = model_of(command=[sys.executable, "script.py", "in.txt"], files={"script.py": PROGRAM})
    np.testing.assert_array_equal(copied.simulate(THETA), line(THETA))
