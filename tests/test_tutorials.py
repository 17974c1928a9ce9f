"""Every tutorial runs from top to bottom without a warning, saves its figures, and finds known numbers."""

import ast
import importlib
import warnings
from pathlib import Path

import numpy as np
import pytest

from tests.scripts import run_script

TUTORIALS = {path.stem: path for path in sorted((Path(__file__).parents[1] / "tutorials").glob("[0-9]*.py"))}


def check_01(found):
    truth, samples = found["truth"], found["samples"]
    assert (np.abs(samples.mean(axis=0) - truth) < 4.0 * samples.std(axis=0)).all()
    assert found["coverage"] == pytest.approx([0.9, 0.9], abs=0.04)  # 800 samples: 4 standard errors


def check_02(found):
    """The data were made with softening in tension."""
    samples, evidence = found["samples"], found["sampler"].log_evidence - found["other"].log_evidence
    assert (np.abs(samples.mean(axis=0) - found["truth"]) < 4.0 * samples.std(axis=0)).all() and evidence > 10.0
    assert found["sampler"].simulations < 1200


def check_03(found):
    """The program prints all digits, so that both runs are the same."""
    assert found["difference"] == pytest.approx(0.0, abs=1e-12) and found["report"]["failure_count"] == 0
    mean, sd = found["draws"].mean(axis=0)[:2], found["draws"].std(axis=0)[:2]
    assert (np.abs(mean - found["TRUTH"]) < 4.0 * sd).all()


def check_04(found):
    """SMC and TMCMC find the exact shares (500 walkers: 4 standard errors), emcee does not leave its mode."""
    share = found["exact"]["share"]
    for name in ("SMC", "TMCMC"):
        assert found["shares"][name] == pytest.approx(share, abs=0.09), name
        sampler = found["samplers"][name]
        assert abs(sampler.log_evidence - found["exact"]["evidence"]) < 4.0 * sampler.log_evidence_error < 0.6, name
    assert found["shares"]["emcee"] == 1.0


def check_05(found):
    assert found["sampler"].simulations < 600
    apart = (found["mean"].value - np.array(list(found["truth"].values()))) / found["sd"].value
    assert np.abs(apart).max() < 4.0


def check_06(found):
    inside, scores = found["inside"], found["scores"]
    assert inside["one event"].value < 0.7 < inside["population of eight"].value
    assert scores["population of eight"] < 0.7 * scores["one event"]


def check_07(found):
    truth = np.array(list(found["TRUTH"].values()))
    assert (np.abs(found["samples"].mean(axis=0) - truth) < 4.0 * found["samples"].std(axis=0)).all()
    assert found["coverage"]["end"] > 0.8 > 0.6 > found["coverage"]["virgin"]
    assert found["found"].presence["bar yield"].probability.tolist() == [0.0, 1.0, 1.0]
    rates = [found["annual_rate"](limit).mean() for limit in found["LIMITS"].values()]
    assert 0.0 < rates[1] < rates[0] < 0.05, "the rate of the weakest motion"


def check_08(found):
    """Gauges tell less along the column and towards its axis; a strong motion tells of the steel, and none of a1."""
    assert found["best"] == "EQ2"
    assert {"strain@0.15:-0.525", "strain@0.15:0.525"} & set(found["six"])
    ranking, gauges = found["ranking"], found["gauges"]
    alone = {place: ranking.alone[ranking.candidates.index(name)] for place, name in gauges.items()}
    for x in found["positions"]:
        assert (np.diff([alone[height, x] for height in found["HEIGHTS"]]) < 0.0).all(), x
    for height in found["HEIGHTS"]:
        outer, *inner, other = (alone[height, x] for x in found["positions"])
        assert min(outer, other) > max(inner)
    left = found["left_of_motion"]
    assert left["EQ2"]["Es"] < 0.5 * left["EQ1"]["Es"] and min(each["a1"] for each in left.values()) > 0.85


def check_09(found):
    loss, truth = found["found"], found["truths"]["after"]
    assert loss.presence() > 0.95 and found["control"].presence() < 0.1
    probability = loss.probability(0.1)
    assert probability[3] > 0.95 and np.delete(probability, [3, 6]).max() < 0.2
    assert np.median(loss.loss[:, 3]) == pytest.approx(truth[3], abs=0.05)
    assert np.median(loss.common) == pytest.approx(0.97, abs=0.02)


def check_10(found):
    """The modes that were left out are near their intervals, the girder has 0.9 of its stiffness."""
    losses = found["loss"].probability(0.1)
    assert losses[2] > 0.95 and np.delete(losses, 2).max() < 0.05
    assert abs(found["stiffness"].mean() - 0.9) < 4.0 * found["stiffness"].std() < 0.02
    low, measured, high = (each[3:5] for each in (found["low"], found["before"].mean_frequencies, found["high"]))
    assert (abs(measured - 0.5 * (low + high)) < 1.5 * (high - low)).all()


@pytest.mark.parametrize(
    "name", [name if name[:2] == "04" else pytest.param(name, marks=pytest.mark.slow) for name in TUTORIALS]
)
def test_tutorial_is_right_and_warns_of_nothing(name, tmp_path):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = run_script(TUTORIALS[name], folder=tmp_path)
    spoken = [each for each in caught if issubclass(each.category, UserWarning | RuntimeWarning)]
    assert not spoken, [str(each.message) for each in spoken]
    assert list(tmp_path.glob("*.png"))
    globals()[f"check_{name[:2]}"](found)


def test_tutorials_are_short_and_import_names_that_exist():
    """Most tutorials run with the slow tests only."""
    for path in TUTORIALS.values():
        assert len(path.read_text().splitlines()) <= 150, path.name
        for node in ast.walk(ast.parse(path.read_text())):
            if (getattr(node, "module", None) or "").partition(".")[0] in ("fe_likelihoods", "samplers"):
                module = importlib.import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), f"{path.name}: {ast.unparse(node)}"
