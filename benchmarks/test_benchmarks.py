"""Tables of the benchmarks: runs without a result have a row, and weighted samples are scored correctly."""

import json
import re
import shlex
from pathlib import Path

import emcee
import numpy as np
import pytest

from benchmarks import job, truth
from benchmarks.__main__ import BENCHMARKS, QUICK, main, options_of, parsed
from benchmarks.comparison import compare
from benchmarks.growth import exponent
from benchmarks.rows import Row, as_table, machine, write_json
from benchmarks.targets import as_row, errors, target_named
from samplers import SMCSampler
from tests.contract.targets import Gaussian
from tests.statistics import analytic_runs

ROOT = Path(__file__).parents[1]
ANSWER = {
    "evaluations": 100,
    "microseconds": 5.0,
    "z": 0.3,
    "sd": 0.04,
    "evidence": -0.2,
    "error": 0.1,
    "warned": False,
}
STOPPED = {"evaluations": 900, "reason": "stopped at 150 s"}


def test_row_scores_the_results_and_names_the_runs_without_one():
    row = as_row("peer", "T1", [ANSWER, STOPPED, ANSWER | {"z": 0.4, "evidence": 0.5, "warned": True}])
    assert row.value == pytest.approx(1100 / 3)
    assert row.note == (
        f"z {np.sqrt((0.3**2 + 0.4**2) / 2):.3f}; sd 4.0 %; log Z -0.20(0.10) +0.50(0.10); 5.0 us CPU; "
        "1 of 3 stopped at 150 s; warned"
    )


def test_row_of_runs_that_all_failed_is_still_there():
    assert as_row("peer", "T1", [STOPPED, STOPPED]).note == "2 of 2 stopped at 150 s"


def test_errors_of_weighted_samples_are_those_of_repeated_ones(shared, rng):
    target = target_named("T2")
    samples, counts = target.mean + target.sd * rng.standard_normal((500, target.ndim)), rng.integers(0, 4, 500)
    weighted, repeated = errors(target, samples, counts / 7), errors(target, np.repeat(samples, counts, axis=0))
    assert weighted == pytest.approx(repeated)
    assert weighted != pytest.approx(errors(target, samples))


def test_target_counts_every_point_of_the_likelihood_and_none_outside_the_prior(shared):
    target = target_named("T3")
    target(np.array([[0.0, 0, 0, 0], [9.0, 0, 0, 0]]))
    assert target.evaluations == 1
    target.log_likelihood(np.zeros((5, 4)))
    assert target.evaluations == 6


def test_table_has_the_fields_as_columns_and_large_numbers_in_full():
    table = as_table([Row("runs", "a", 234567.0, "", "x"), Row("time", "b", 0.0012345, "s")]).splitlines()
    assert table[0].split() == ["what", "case", "value", "unit", "note"]
    assert [line.split() for line in table[2:]] == [["runs", "a", "234567", "x"], ["time", "b", "0.00123", "s"]]
    assert table[0].index("value") + len("value") == table[3].index("0.00123") + len("0.00123")


def test_options_are_those_of_the_functions():
    names, options = parsed(["truth", "job", "walkers=250,500", "limit=5"])
    assert names == ["truth", "job"]
    assert options == {"truth": {"walkers": (250, 500)}, "job": {"limit": 5.0}}
    assert parsed([])[0] == list(BENCHMARKS)
    for words, message in (
        (["no_such"], "expected names among"),
        (["job", "walkers=5"], "no such option: walkers. Options of job: every, limit"),
        (["job", "every=many"], "many"),
    ):
        with pytest.raises(ValueError, match=message):
            parsed(words)
    for name, options in QUICK.items():
        known = options_of(BENCHMARKS[name])
        assert {key: type(value) for key, value in options.items()} == {key: type(known[key]) for key in options}


def test_the_readme_lists_every_benchmark():
    table = (Path(__file__).parent / "README.md").read_text()
    assert re.findall(r"^\| `(\w+)`", table, re.MULTILINE) == list(BENCHMARKS)


def test_commands_that_texts_cite_name_benchmarks_and_options():
    cited = []
    for pattern in ("docs/*.rst", "docs/theory/*.rst", "tutorials/*.py", "fe_likelihoods/**/*.py", "samplers/**/*.py"):
        for path in ROOT.glob(pattern):
            text = re.sub(r"\n#? *", " ", path.read_text())
            cited += re.findall(r"`python -m benchmarks ([^`]+)`", text)
    assert cited
    for command in cited:
        words = shlex.split(re.sub(r"--repeats \d+|--compare \S+ \S+", "", command))
        assert parsed(words)[0], command


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main([name, "--quick"])
    assert json.loads((tmp_path / "results" / "benchmarks.json").read_text())["rows"]


def test_two_files_side_by_side(tmp_path):
    before = [Row("time", "a", 2.0, "s"), Row("time", "b", 1.0, "s"), Row("time", "gone", 1.0, "s")]
    after = [Row("time", "a", 1.0, "s"), Row("time", "b", 1.05, "s"), Row("time", "c", None, "s", "stopped")]
    for name, rows, cpu in (("before", before, "one"), ("after", after, "another")):
        write_json(tmp_path / name, rows, [machine() | {"cpu": cpu}])
    lines = compare(tmp_path / "before", tmp_path / "after").splitlines()
    assert "the processors differ" in lines[2]
    assert [line.split() for line in lines[5:]] == [
        ["time", "a", "2", "1", "s", "0.5", "*"],
        ["time", "b", "1", "1.05", "s", "1.05"],
        ["time", "c", "-", "-", "s", "-"],
        ["time", "gone", "1", "-", "s", "-"],
    ]


@pytest.mark.parametrize("content", [None, "not JSON", "[]", '{"rows": []}'])
def test_file_that_cannot_be_compared_is_named(tmp_path, content):
    if content is not None:
        (tmp_path / "other").write_text(content)
    with pytest.raises(ValueError, match="other: expected a file that"):
        compare(tmp_path / "other", tmp_path / "other")


def test_exponent_of_a_power_law():
    assert exponent([10, 20, 40], [9.0, 3.0 * 20**1.5, 3.0 * 40**1.5]) == pytest.approx(1.5)


def test_run_over_its_limit_is_stopped_and_has_a_row():
    rows = job.job(1, limit=0.2)  # less than the imports take
    assert [row.value for row in rows] == [None, None]
    assert all(row.note == "stopped at 0.2 s, after 0 evaluations" for row in rows)


def test_row_of_a_stopped_run_gives_the_evaluations_made(tmp_path):
    backend = emcee.backends.HDFBackend(tmp_path / "chain.h5")
    sampler = SMCSampler(50, 2, Gaussian(2), vectorize=True, seed=1, backend=backend)
    sampler.run_mcmc(None, 1)
    assert job.evaluations_made(tmp_path / "chain.h5") == f"after {sampler.evaluations} evaluations"


def test_two_settings_are_compared_in_cost_and_result():
    default = {"simulations": 10, "seconds": 2.0, "cpu": 2.0, "mean": [1.0, 5.0], "sd": [1.0, 2.0]}
    paper = {"simulations": 40, "seconds": 6.0, "cpu": 4.0, "mean": [1.5, 4.0], "sd": [1.1, 1.0]}
    assert [row.value for row in job.compare_settings(default, paper, "")] == pytest.approx([4.0, 3.0, 2.0, 0.5, 50.0])


def test_run_of_the_truth_benchmark_is_compared_with_the_truth():
    cell = analytic_runs.Cell("sharp", 0.0, "SMC", 300)
    right = analytic_runs.run(cell, 1, steps=2)
    assert not analytic_runs.is_lost(right)
    assert not analytic_runs.is_doubted(right)
    wrong = right | {"log_evidence_error": 20.0 * right["stated_error"] + 1.0}
    lost = right | {"shares": [0.3, 0.7], "true_shares": [0.5, 0.5], "status": "usable"}
    found = truth.line(cell, [right, wrong, lost])
    assert found[:8] == ("sharp", "SMC", 300, 3, 2, 1, 1, 0)  # runs, lost, silent, doubted, false
