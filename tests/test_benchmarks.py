"""The tables of the benchmarks never pass over a run without an answer, and score weighted samples as they should."""

import json

import numpy as np
import pytest

from tests.benchmarks import peers
from tests.benchmarks.rows import Row, as_table, machine, write_json
from tests.benchmarks.targets import as_row, errors, target_named

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


def test_row_scores_the_answers_and_names_the_runs_without_one():
    row = as_row("peer", "T1", [ANSWER, STOPPED, ANSWER | {"z": 0.4, "evidence": 0.5, "warned": True}])
    assert row.value == pytest.approx(1100 / 3)
    assert row.note == (
        f"z {np.sqrt((0.3**2 + 0.4**2) / 2):.3f}; sd 4.0 %; log Z -0.20(0.10) +0.50(0.10); 5.0 us CPU; "
        "1 of 3 stopped at 150 s; warned"
    )


def test_row_of_runs_that_all_failed_is_still_there():
    assert as_row("peer", "T1", [STOPPED, STOPPED]).note == "2 of 2 stopped at 150 s"


def test_peer_that_is_not_installed_has_a_row(monkeypatch, tmp_path):
    monkeypatch.setattr(peers, "PEERS", {"absent": peers._Peer("no_such_module", peers._emcee)})
    (row,) = peers.rows(1)
    assert row == Row("absent: evaluations", "", None, "", "not installed: pip install '.[peers]'")
    assert as_table([row]).splitlines()[-1].split()[:3] == ["absent:", "evaluations", "-"]
    write_json(tmp_path / "rows.json", [row], [machine()])
    assert json.loads((tmp_path / "rows.json").read_text())["rows"][0]["value"] is None


def test_run_is_stopped_at_the_limit(monkeypatch):
    monkeypatch.setattr(peers, "LIMIT", 0.1)  # less than the imports of a new process take
    assert peers._run("emcee, stretch move", "T3", 1) == {"evaluations": 0, "reason": "stopped at 0 s"}


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
