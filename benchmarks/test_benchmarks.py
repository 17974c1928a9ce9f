"""Every benchmark runs, texts cite those that exist, and runs are compared with the truth."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from benchmarks import truth
from benchmarks.__main__ import BENCHMARKS, QUICK, main, options_of, parsed
from benchmarks.targets import target_named
from tests.statistics import analytic_runs

ROOT = Path(__file__).parents[1]


def test_target_counts_every_point_of_the_likelihood_and_none_outside_the_prior(shared):
    target = target_named("T3")
    target(np.array([[0.0, 0, 0, 0], [9.0, 0, 0, 0]]))
    assert target.evaluations == 1
    target.log_likelihood(np.zeros((5, 4)))
    assert target.evaluations == 6


def test_options_are_those_of_the_functions():
    names, options = parsed(["truth", "screening", "walkers=250,500", "every=5"])
    assert names == ["truth", "screening"]
    assert options == {"truth": {"walkers": (250, 500)}, "screening": {"every": 5}}
    assert parsed([])[0] == list(BENCHMARKS)
    for words, message in (
        (["no_such"], "expected names among"),
        (["screening", "walkers=5"], "no such option: walkers. Options of screening: every"),
        (["screening", "every=many"], "many"),
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
        words = shlex.split(re.sub(r"--repeats \d+", "", command))
        assert parsed(words)[0], command


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main([name, "--quick"])
    assert json.loads((tmp_path / "results" / "benchmarks.json").read_text())["rows"]


def test_run_of_the_truth_benchmark_is_compared_with_the_truth():
    cell = analytic_runs.Cell("sharp", 0.0, "SMC", 300)
    right = analytic_runs.run(cell, 1, steps=2)
    assert not analytic_runs.is_lost(right)
    assert not analytic_runs.is_doubted(right)
    wrong = right | {"log_evidence_error": 20.0 * right["stated_error"] + 1.0}
    lost = right | {"shares": [0.3, 0.7], "true_shares": [0.5, 0.5], "status": "usable"}
    found = truth.line(cell, [right, wrong, lost])
    assert found[:8] == ("sharp", "SMC", 300, 3, 2, 1, 1, 0)  # runs, lost, silent, doubted, false
