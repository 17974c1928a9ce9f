"""A model that has changed between two runs, or during one: stored rows are verified, adopted, or not used."""

import importlib
import os
import shutil
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import Channel, ExecutableModel, FELikelihood, FunctionModel, Measurements, SimulationCache
from fe_likelihoods.cache.verification import SHARE_OF_TIME, StaleCache
from fe_likelihoods.simulation.failure_reasons import ChangedModel
from tests.covering import covering

CHANNELS = (Channel("u", "displacement", "m"),)
TIME = np.linspace(0.0, 1.0, 20)
MEASURED = Measurements(CHANNELS, 0.01, TIME[None])
POINTS = np.random.default_rng(3).uniform(0.0, 1.0, size=(300, 1))
USUAL = 2 + 3  # verifications of 300 rows under a known label
HELPER = "import math\nE = 2.5\ndef law(a):\n    return E * a\n"
MODEL = '''
import numpy as np
import helper
TIME = np.linspace(0.0, 1.0, 20)[None]
class Steel:
    """Steel of the bars."""
    def __init__(self, k): self.k = k
    def stress(self, e): return self.k * e
STEEL = Steel(2.0)
NAMES = {"b", "a", "c"}
def f(theta):
    """Response."""
    x = STEEL.stress(theta[0])
    return helper.law(x) * TIME * len(NAMES)
'''


class Workshop:
    """A folder with modules of a user, which are imported anew for every run."""

    def __init__(self, folder):
        self.folder = folder
        self.write(model=MODEL, helper=HELPER)

    def write(self, **texts):
        for name, text in texts.items():
            (self.folder / f"{name}.py").write_text(textwrap.dedent(text))

    def run(self, pool=None, points=POINTS, **options):
        """Likelihood of a new process, so to speak, that has evaluated all points."""
        for name in ("model", "helper"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        self.module = importlib.import_module("model")
        model = FunctionModel(self.module.f, ("a",), CHANNELS, 0.01, 20, **options)
        cache = SimulationCache(self.folder / "cache.sqlite")
        likelihood = FELikelihood(model, MEASURED, cache=cache, pool=pool, memory_rows=0)
        likelihood.simulator.statistics(points)
        return likelihood


@pytest.fixture
def workshop(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield Workshop(tmp_path)
    for name in ("model", "helper"):
        sys.modules.pop(name, None)


def true_values(workshop):
    return FELikelihood(FunctionModel(workshop.module.f, ("a",), CHANNELS, 0.01, 20), MEASURED).simulator.statistics(
        POINTS
    )


HARMLESS = {
    "docstring": {"model": MODEL.replace('"""Response."""', '"""Response [m]."""')},
    "renamed local variable": {"model": MODEL.replace("x = ", "strain = ").replace("law(x)", "law(strain)")},
    "log call": {"model": MODEL.replace("    x = ", "    import logging; logging.debug('run')\n    x = ")},
    "unused method": {"model": MODEL.replace("STEEL = ", "    def plot(self): pass\nSTEEL = ")},
    "unused function": {"helper": HELPER + "def other(): return 7\n"},
    "factor in another place": {"helper": HELPER.replace("E * a", "(a * E)")},
}


@pytest.mark.parametrize("texts", HARMLESS.values(), ids=HARMLESS)
def test_rows_are_adopted_after_a_harmless_edit(workshop, texts, caplog):
    first = workshop.run()
    workshop.write(**texts)
    second = workshop.run()
    assert (first.simulations, second.simulations) == (300, 0)
    assert second.simulator.verifications == 59
    assert "FunctionModel: 59 stored simulations agree with new ones: all are used" in caplog.text
    third = workshop.run()  # the label is known now
    assert (third.simulations, third.simulator.verifications) == (0, USUAL)


def test_an_unchanged_model_has_the_same_label_in_every_process(workshop):
    code = (
        "import model; from fe_likelihoods.simulation.label import items_of;"
        "print(sorted(items_of({'function': model.f}).items()))"
    )
    found = set()
    for seed, options in (("1", []), ("2", ["-B"])):
        path = os.pathsep.join([str(workshop.folder), *sys.path])
        environment = {**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": path}
        command = [sys.executable, *options, "-c", code]
        found.add(subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout)
    assert len(found) == 1


CHANGES = {
    "everywhere": {"helper": HELPER.replace("2.5", "3.5")},
    "a value": {"model": MODEL.replace("Steel(2.0)", "Steel(2.1)")},
    "30 % of the space": {"helper": HELPER.replace("return E * a", "return (E if a < 1.4 else 2.6) * a")},
    "failures": {"helper": HELPER.replace("return", "if a > 1.4: raise ArithmeticError('yield')\n    return")},
}


@pytest.mark.parametrize("texts", CHANGES.values(), ids=CHANGES)
def test_a_new_generation_begins_after_a_change(workshop, texts, caplog):
    first = workshop.run()
    workshop.write(**texts)
    second = workshop.run()
    assert "differ from new ones, or are too few: they stay in the file, not used" in caplog.text
    np.testing.assert_array_equal(second.simulator.statistics(POINTS), true_values(workshop))
    assert second.simulator.cache.info().simulations == 600
    assert second.simulator.verifications <= 59
    workshop.write(model=MODEL, helper=HELPER)  # back to the earlier code, whose rows are still there
    third = workshop.run()
    assert (third.simulations, third.simulator.verifications) == (0, USUAL)
    np.testing.assert_array_equal(third.simulator.statistics(POINTS), first.simulator.statistics(POINTS))


def test_a_hidden_change_of_an_adopted_model_is_an_error(workshop, monkeypatch):
    model = MODEL.replace("import helper", "import helper, sys").replace(
        "* TIME", "* TIME * getattr(sys, 'hidden', 1.0)"
    )
    workshop.write(model=model)
    workshop.run()
    workshop.write(model=model.replace("x = ", "strain = ").replace("law(x)", "law(strain)"))
    assert workshop.run().simulations == 0
    monkeypatch.setattr(sys, "hidden", 2.0, raising=False)
    with pytest.raises(StaleCache, match="simulated again"):
        workshop.run()


OPENED = {
    "file": ("return t[0] * np.loadtxt('k.txt') * TIME", "k.txt", "2.5", "3.5"),
    "module": ("import late; return t[0] * late.k * TIME", "late.py", "k = 2.5", "k = 3.5 "),
    "program": (
        "import subprocess; return t[0] * float(subprocess.check_output(['sh', 'k.sh'])) * TIME",
        "k.sh",
        "echo 2.5",
        "echo 3.5",
    ),
}


@pytest.mark.parametrize(("what", "isolated"), covering(list(OPENED), [False, True], strength=1))
def test_what_a_simulation_opens_belongs_to_the_label(workshop, what, isolated):
    """A change in a part of the space, which the usual few rows would not show."""
    sys.modules.pop("late", None)  # of another test; it would be sent by value
    body, name, before, after = OPENED[what]
    body = body.replace("t[0] *", "t[0] * (t[0] > 0.99) *") if isolated else body
    workshop.write(model=f"import numpy as np\nTIME = np.linspace(0.0, 1.0, 20)[None]\ndef f(t):\n    {body}\n")
    (workshop.folder / name).write_text(before)
    points = POINTS[:20]
    first = workshop.run(points=points, isolated=isolated)
    assert [os.path.basename(path) for path in first.simulator.label.opened] == [name]
    same = workshop.run(points=points, isolated=isolated)
    assert (same.simulations, same.simulator.verifications) == (0, 2)
    (workshop.folder / name).write_text(after)
    sys.modules.pop("late", None)
    second = workshop.run(points=points, isolated=isolated)
    assert second.simulator.verifications > 2 or second.simulations > 0


def test_workers_of_a_pool_tell_what_they_open(workshop):
    workshop.write(
        model="import numpy as np\ndef f(t):\n    return t[0] * np.loadtxt('k.txt') * np.linspace(0, 1, 20)[None]\n"
    )
    (workshop.folder / "k.txt").write_text("2.5")
    likelihood = workshop.run(pool=2)
    likelihood.simulator.pool.close()
    assert [os.path.basename(path) for path in likelihood.simulator.label.opened] == ["k.txt"]
    alone = workshop.run()
    assert (alone.simulations, alone.simulator.verifications) == (0, USUAL)


def test_a_copied_folder_has_its_own_files(workshop, monkeypatch):
    workshop.write(
        model="import numpy as np\ndef f(t):\n    return t[0] * np.loadtxt('k.txt') * np.linspace(0, 1, 20)[None]\n"
    )
    (workshop.folder / "k.txt").write_text("2.5")
    workshop.run().simulator.cache.close()
    workshop.folder = Path(shutil.copytree(workshop.folder, f"{workshop.folder}_copy"))
    monkeypatch.chdir(workshop.folder)
    unchanged = workshop.run()
    assert (unchanged.simulations, unchanged.simulator.verifications) == (0, USUAL)
    (workshop.folder / "k.txt").write_text("3.5")
    assert workshop.run().simulations == len(POINTS)


def test_variables_of_the_environment_that_the_code_names(workshop, monkeypatch):
    workshop.write(
        model="import os, numpy as np\ndef f(t):\n    k = float(os.environ['GAIN']) if t[0] > 0.75 else 1.0\n"
        "    return k * t[0] * np.linspace(0, 1, 20)[None]\n"
    )
    monkeypatch.setenv("GAIN", "2.5")
    workshop.run()
    monkeypatch.setenv("GAIN", "3.5")
    second = workshop.run()
    np.testing.assert_array_equal(second.simulator.statistics(POINTS), true_values(workshop))


def test_a_program_that_was_compiled_again_is_verified(workshop):
    script = workshop.folder / "solver.sh"

    def run(text):
        script.write_text(f"{text}\nawk '{{for (i = 0; i < 20; i++) print $1 * i / 19}}' in.txt > out.txt\n")
        model = ExecutableModel(
            ["sh", script], {"in.txt": "$a"}, "out.txt", ("a",), CHANNELS, 0.01, 20, time_limit=60.0
        )
        likelihood = FELikelihood(model, MEASURED, cache=workshop.folder / "cache.sqlite")
        likelihood.simulator.statistics(POINTS[:10])
        return likelihood.simulations, likelihood.simulator.verifications

    assert run("# version 1") == (10, 0)
    assert run("# version 2") == (10, 0)  # to repeat ten would save nothing
    assert run("# version 2") == run("# version 1") == (0, 2)


def test_versions_and_dependencies_are_declared(workshop):
    options = [{}, {"version": "2"}, {"depends_on": [3.0]}]
    assert [workshop.run(**each).simulations for each in options] == [300] * 3
    assert [workshop.run(**each).simulator.verifications for each in options] == [USUAL] * 3


# during a run ---------------------------------------------------------------------------------------------------------


def test_a_value_that_is_set_between_two_batches_is_an_error(workshop, monkeypatch):
    monkeypatch.setattr("fe_likelihoods.cache.verification.SHARE_OF_TIME", np.inf)
    likelihood = workshop.run(points=POINTS[:10])
    sys.modules["helper"].E = 3.0
    with pytest.raises(ChangedModel, match=r"different: helper.E.*an earlier simulation gives another result"):
        likelihood.simulator.statistics(POINTS[10:20])
    assert likelihood.simulator.cache.info().simulations == 10
    again = FELikelihood(likelihood.model, MEASURED, cache=likelihood.simulator.cache)
    again.simulator.statistics(POINTS[:10])
    assert again.simulator.cache.info().simulations == 20  # a generation of its own


def test_a_value_that_is_set_before_the_first_batch_belongs_to_the_label(workshop):
    likelihood = workshop.run(points=POINTS[:0])
    sys.modules["helper"].E = 3.0
    likelihood.simulator.statistics(POINTS)
    np.testing.assert_array_equal(workshop.run().simulator.statistics(POINTS), true_values(workshop))


COUNTERS = {
    "counter": "calls = 0\ndef law(a):\n    global calls\n    calls += 1\n    return 2.5 * a\n",
    "earlier results": "D = {}\ndef law(a):\n    return D.setdefault(float(a), 2.5 * a)\n",
    "rare": "D = []\ndef law(a):\n    if a > 1.0: D.append(a)\n    return 2.5 * a\n",
}


FAILS = MODEL.replace("    x = ", "    if theta[0] > 0.5: raise ValueError('no convergence')\n    x = ")
CHANGED_BELOW = FAILS.replace("law(x)", "law(x) * (1.1 if theta[0] < 0.3 else 1.0)")


def test_failures_alone_are_no_reason_to_adopt(workshop):
    """The edited model fails at the same points, which says nothing about the others."""
    workshop.write(model=FAILS)
    workshop.run()
    workshop.write(model=CHANGED_BELOW)
    likelihood = workshop.run()
    fresh = FELikelihood(FunctionModel(workshop.module.f, ("a",), CHANNELS, 0.01, 20), MEASURED)
    np.testing.assert_array_equal(likelihood.simulator.statistics(POINTS), fresh.simulator.statistics(POINTS))


def test_adoption_waits_while_simulations_are_stopped(workshop):
    """As without a licence: the stored rows count once simulations end again."""
    workshop.run()
    licence = "import os\nif os.path.exists('stopped'): raise OSError('no licence')\n"
    workshop.write(model=MODEL.replace("    x = ", textwrap.indent(licence, "    ") + "    x = "))
    (workshop.folder / "stopped").touch()
    likelihood = workshop.run(points=POINTS[:20])
    assert not np.isfinite(likelihood.simulator.statistics(POINTS[:20])).any()
    (workshop.folder / "stopped").unlink()
    np.testing.assert_array_equal(likelihood.simulator.statistics(POINTS), true_values(workshop))
    assert likelihood.simulator.disk_hits >= 300


@pytest.mark.parametrize("helper", COUNTERS.values(), ids=COUNTERS)
@pytest.mark.parametrize(("share", "most"), [(SHARE_OF_TIME, 20), (np.inf, 2 * 30 + 10)], ids=["usual", "always"])
def test_a_model_may_change_its_own_values(workshop, helper, share, most, monkeypatch):
    """Two points are repeated where a comparison finds a change: 0 to 4 in 300, more if all batches are compared."""
    monkeypatch.setattr("fe_likelihoods.cache.verification.SHARE_OF_TIME", share)
    workshop.write(helper=helper)
    likelihood = workshop.run(points=POINTS[:10])
    for start in range(10, 300, 10):
        likelihood.simulator.statistics(POINTS[start : start + 10])
        workshop.module.f(POINTS[start] / 3.0)
    assert (likelihood.simulations, likelihood.simulator.cache.info().simulations) == (300, 300)
    assert likelihood.simulator.verifications <= most
    assert workshop.run().simulator.verifications == USUAL  # the label is that of the beginning
