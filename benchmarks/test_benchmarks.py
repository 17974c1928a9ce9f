"""Tables of the benchmarks: runs without a result have a row, and weighted samples are scored correctly."""

import json
import re
import shlex
import zipfile
from pathlib import Path

import emcee
import numpy as np
import pytest

from benchmarks import job, new_event, noises, peers, tested_column, transfer, truth
from benchmarks.__main__ import BENCHMARKS, QUICK, main, options_of, parsed
from benchmarks.comparison import compare
from benchmarks.growth import exponent
from benchmarks.rows import Row, as_table, machine, write_json
from benchmarks.targets import as_row, errors, target_named
from fe_likelihoods import (
    BridgeDeck,
    Channel,
    FELikelihood,
    FunctionModel,
    GaussianNoise,
    HalfNormal,
    LinearStructure,
    Measurements,
    Posterior,
    Record,
    peak,
)
from fe_likelihoods.models.linear_system import respond_structure
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


def test_peer_that_is_not_installed_has_a_row(monkeypatch, tmp_path):
    monkeypatch.setattr(peers, "PEERS", {"absent": peers.Peer("no_such_module", peers.run_emcee)})
    (row,) = peers.rows(1)
    assert row == Row("absent: evaluations", "", None, "", "not installed: pip install '.[peers]'")
    assert as_table([row]).splitlines()[-1].split()[:3] == ["absent:", "evaluations", "-"]
    write_json(tmp_path / "rows.json", [row], [machine()])
    assert json.loads((tmp_path / "rows.json").read_text())["rows"][0]["value"] is None


def test_run_is_stopped_at_the_limit():
    limit = 0.1  # less than the imports of a new process take
    assert peers.run_peer("emcee, stretch move", "T3", 1, limit) == {"evaluations": 0, "reason": "stopped at 0 s"}


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
    assert len(cited) > 25
    for command in cited:
        words = shlex.split(re.sub(r"--repeats \d+|--compare \S+ \S+", "", command))
        assert parsed(words)[0], command


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", BENCHMARKS)
def test_every_benchmark_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main([name, "--quick"])
    assert json.loads((tmp_path / "results" / "benchmarks.json").read_text())["rows"] or name.endswith("references")


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


def test_predictions_of_real_events_say_where_the_data_are_missing(tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "_FOLDER", tmp_path)
    (row,) = transfer.transfer()
    assert row.case == "SKIPPED" and row.value is None and str(tmp_path) in row.note
    monkeypatch.setattr(noises, "_FOLDER", tmp_path)
    for part in (noises._painter_street, noises._meloland):
        (row,) = part(1)
        assert row.case == "SKIPPED" and row.value is None and str(tmp_path) in row.note


def test_new_events_say_where_the_data_are_missing_and_have_twins_without_them(tmp_path, monkeypatch):
    monkeypatch.setattr(transfer, "_FOLDER", tmp_path)
    monkeypatch.setattr("benchmarks.measured_transfer.SHARED", tmp_path)
    monkeypatch.setattr(tested_column, "FOLDER", tmp_path)
    rows = new_event.new_event(1, data_sets=2)
    skipped = [row for row in rows if row.case == "SKIPPED"]
    assert [row.what for row in skipped] == ["Painter Street", "frame", "Meloland", "columns"]
    assert all(str(tmp_path) in row.note for row in skipped)
    assert {row.case.split(",")[0] for row in rows if row.case != "SKIPPED"} == {"twins"}


def test_subsets_of_events_are_scored_as_the_t_distribution_says(rng):
    """Ratios of known scatter, from one simulation each: the true share of the others within their intervals."""
    channels, log_ratios, likelihoods = [Channel("top", "displacement", "m")], 0.1 * rng.standard_normal(60), {}
    for k, each in enumerate(log_ratios):
        size = np.array([0.0, 1.0 + k])
        model = FunctionModel(lambda theta, size=size: [theta[0] * size], ["gain"], channels, 0.1, 2)
        likelihoods[f"{k}"] = FELikelihood(model, Measurements(channels, 0.1, [1.1 * np.exp(each) * size]))
    medians = {name: {"gain": 1.1} for name in likelihoods}
    structure = new_event.Structure(likelihoods, medians, [peak("top")])
    rows = {(row.what, row.case): row for row in new_event._subsets("twin", structure, 6)}
    assert rows["sd of the log ratio of the first number", "twin"].value == pytest.approx(log_ratios.std(ddof=1))
    found = rows["within 90%", "twin, 8 of 60, no prior"]
    assert found.value == pytest.approx(90.0, abs=8.0) and found.note.startswith("worst of 6: ")
    assert rows["within 90%", "twin, 1 of 60, default prior"].value > 90.0
    assert ("within 90%", "twin, 1 of 60, no prior") not in rows
    wide, narrow = (rows["upper / lower end", f"twin, 3 of 60, prior worth {n}"].value for n in (3, 12))
    assert wide > narrow


def test_files_that_cannot_be_used_are_named_and_left_out(tmp_path, monkeypatch):
    """A record without one of the channels, and a page that was stored in the place of a file."""
    monkeypatch.setattr(transfer, "_FOLDER", tmp_path)
    (tmp_path / "page_ce89324p.zip").write_text("<html>log in first</html>")
    with zipfile.ZipFile(tmp_path / "channels_ce89324p.zip", "w") as archive:
        archive.writestr("CHAN003.V2", "no record")
    left_out = transfer.read_events()[1]
    assert [row.case for row in left_out] == ["LEFT OUT"] * 2
    assert left_out[0].note.startswith("channels_ce89324p.zip: no channel 3: ")
    assert left_out[1].note.startswith("page_ce89324p.zip: no channel 3: ")
    *first, last = transfer.transfer()
    assert first == left_out and last.case == "SKIPPED"


def test_the_amplitude_dependent_posterior_of_one_event_is_that_of_its_linear_model(rng):
    """Equal likelihoods, and weights with a determinant by differences of the level."""
    supports = [Record(str(number), 0.02, rng.standard_normal(200)) for number in transfer._INPUTS]
    model = LinearStructure(BridgeDeck("ch7"), supports)
    (response,) = model.simulate([4.0, 0.08, 0.7])
    measured = Measurements(model.channels, 0.02, [response + 0.2 * response.std() * rng.standard_normal(200)])
    likelihood = FELikelihood(model, measured, GaussianNoise(measured.channels, level="measured"))
    spread = np.exp([0.005, 0.02, 0.01, 0.02] * rng.standard_normal((100, 4)))  # stands for posterior samples
    posterior = Posterior(likelihood, transfer._PRIOR | {"share_ch7": HalfNormal(1.0)})
    linear = transfer._Fit(posterior, np.array([4.0, 0.08, 0.7, 0.2]) * spread, 0.0, 0.0)
    found = transfer._amplitude_dependent(linear, 1)
    rows = np.arange(0, 100, 20)
    amplitude, plain = found.posterior.likelihood, linear.posterior.likelihood
    np.testing.assert_allclose(
        amplitude.log_likelihood(found.samples[rows]), plain.log_likelihood(linear.samples[rows]), rtol=1e-9
    )
    acceleration = np.stack([support.acceleration for support in model.supports])

    def mapped(frequency, damping, share, p, q):
        system = model.parts.assemble(np.array([frequency, damping, share]))
        displacement = respond_structure(system, acceleration, 0.02).displacement[0]
        ratio = np.sqrt((displacement**4).sum() / (displacement**2).sum()) / transfer._REFERENCE
        return np.array([frequency * ratio ** (p / 2), damping * ratio**-q])

    for row in rows:
        f, zeta, share, noise = linear.samples[row]
        p, q = found.samples[row, 3:5]
        steps = [1e-4 * f, 1e-4 * zeta]
        columns = [
            (mapped(f + steps[0], zeta, share, p, q) - mapped(f - steps[0], zeta, share, p, q)) / (2 * steps[0]),
            (mapped(f, zeta + steps[1], share, p, q) - mapped(f, zeta - steps[1], share, p, q)) / (2 * steps[1]),
        ]
        before = linear.posterior.prior.logpdf(linear.samples[row])
        after = sum(
            distribution.logpdf(value)
            for distribution, value in zip(
                found.posterior.prior.distributions.values(), found.samples[row], strict=True
            )
        )
        powers = sum(prior.logpdf(value) for prior, value in zip(transfer._POWERS.values(), (p, q), strict=True))
        expected = after - before - powers + np.log(np.linalg.det(columns))
        assert found.log_weights[row] == pytest.approx(expected, abs=1e-4)
