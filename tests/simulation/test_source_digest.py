"""A cache key depends on the source files that the response depends on, and on no others."""

import ast
import functools
import shutil
import sys

import numpy as np
import pytest

from fe_likelihoods import (
    Channel,
    FunctionModel,
    IsolatedBridge,
    LinearOscillator,
    LinearStructure,
    RCColumn,
    Record,
    ShearFrame,
    from_si,
)
from fe_likelihoods.probability.residuals import lag_one_sums
from fe_likelihoods.simulation import source_digest
from fe_likelihoods.cache.rows import simulation_keys
from fe_likelihoods.simulation.code_digest import code_digest
from fe_likelihoods.simulation.fingerprint import simulation_fingerprint
from fe_likelihoods.simulation.source_digest import imported_files

CHANNELS = (Channel("a", "displacement", "m"),)
RECORD = Record("pulse", 0.01, np.sin(np.arange(20) / 3))


def respond(theta):
    return from_si(theta[0] * np.ones((1, 5)), "cm")


def late(theta):
    from fe_likelihoods import to_si

    return to_si(theta[0] * np.ones((1, 5)), "cm")


class OwnColumn:
    """A model of the user's own that uses one of the library."""

    def __init__(self):
        self.column = RCColumn.lhpost(RECORD)
        self.fingerprint = "own " + self.column.fingerprint


def structure():
    return LinearStructure(ShearFrame({"top": 1}, (1.0,), (100.0,)), RECORD)


MODELS = {
    "column": lambda: RCColumn.lhpost(RECORD),
    "bridge": lambda: IsolatedBridge(RECORD),
    "oscillator": lambda: LinearOscillator(RECORD),
    "structure": structure,
    "function": lambda: FunctionModel(respond, ("x",), CHANNELS, 0.1, 5),
    "late": lambda: FunctionModel(late, ("x",), CHANNELS, 0.1, 5),
    "own": OwnColumn,
}


parse_once = functools.cache(ast.parse)  # by the content of a file, of which an edit changes one


@pytest.fixture
def edit(tmp_path, monkeypatch):
    """Append a comment to a file of a copy of the library, which is then the one that is read."""
    monkeypatch.setattr(ast, "parse", parse_once)
    copy = tmp_path / "fe_likelihoods"
    shutil.copytree(source_digest.ROOT, copy, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(source_digest, "ROOT", copy)
    source_digest.source_digest.cache_clear()

    def append(file):
        assert (copy / file).is_file()
        with (copy / file).open("a") as opened:
            opened.write("\n# a comment\n")
        source_digest.source_digest.cache_clear()

    yield append
    source_digest.source_digest.cache_clear()


def keys(*models, statistic=None):
    thetas = np.ones((1, 2))
    return {name: simulation_keys(simulation_fingerprint(MODELS[name](), statistic), thetas)[0] for name in models}


@functools.cache
def keys_of_unchanged_files(*models, statistic=None):
    """The keys before any edit: the files are those of the library, wherever they are copied to."""
    return keys(*models, statistic=statistic)


def changed(edit, file, *models, statistic=None):
    """Models whose keys change with a file."""
    before = keys_of_unchanged_files(*models, statistic=statistic)
    edit(file)
    after = keys(*models, statistic=statistic)
    return {name for name in models if before[name] != after[name]}


@pytest.mark.parametrize("file", ["plots/histories.py", "plots/structures.py"])
def test_a_plot_changes_no_key(edit, file):
    assert changed(edit, file, *MODELS) == set()


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("kernels/concrete04.py", {"column", "own", "late"}),  # imported by other kernels, not by the model
        ("kernels/exponential.py", {"bridge", "own", "late"}),
        ("models/rc_column.py", {"column", "own", "late"}),
        ("models/circular_section.py", {"column", "own", "late"}),
        ("models/linear_oscillator.py", {"oscillator", "own", "late"}),
        ("models/linear_structure.py", {"structure", "own", "late"}),
        ("models/linear_structure_parts.py", {"structure", "own", "late"}),  # imports the model, not the reverse
        ("kernels/complex_modes.py", {"structure", "own", "late"}),
        ("models/isolated_bridge_parts.py", {"bridge", "own", "late"}),
        ("models/function.py", {"function", "own", "late"}),
        ("signals/sdof.py", set(MODELS)),
        ("units.py", set(MODELS)),
        ("simulation/model.py", set(MODELS)),
        ("probability/priors.py", {"late"}),
        ("simulation/disk_cache.py", {"late"}),
    ],
)
def test_a_file_changes_the_keys_of_the_models_that_use_it(edit, file, expected):
    """A late import from the façade and a class of the user may use more than can be seen: they depend on more."""
    assert changed(edit, file, *MODELS) == expected


def test_the_statistic_of_the_noise_is_part_of_the_key(edit):
    assert changed(edit, "probability/residuals.py", "oscillator") == set()
    assert changed(edit, "probability/residuals.py", "oscillator", statistic=lag_one_sums) == {"oscillator"}


def test_a_model_that_a_function_uses_is_part_of_its_key(edit):
    column = RCColumn.lhpost(RECORD)

    def shifted(theta):
        return column.simulate(theta) + 1.0

    before = code_digest(shifted)
    edit("models/isolated_bridge.py")
    assert code_digest(shifted) == before
    edit("models/rc_column.py")
    assert code_digest(shifted) != before


def test_the_parts_of_a_structure_that_a_function_uses_are_part_of_its_key(edit):
    model = structure()

    def shifted(theta):
        return model.simulate(theta) + 1.0

    before = code_digest(shifted)
    edit("models/linear_structure_parts.py")
    assert code_digest(shifted) != before


def test_imports_for_type_checkers_do_not_count(tmp_path, monkeypatch):
    for name in ("a", "b", "c", "d", "e", "plots/p"):
        path = tmp_path / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text("x = 1\n")
    (tmp_path / "a.py").write_text(
        "from typing import TYPE_CHECKING\nimport numpy\n"
        "if TYPE_CHECKING:\n    from . import c\nelse:\n    from . import b\n"
        "class A:\n    def f(self):\n        try:\n            import fe_likelihoods.d\n"
        "        except ImportError:\n            from .e import x\n        from .plots import p\n"
    )
    monkeypatch.setattr(source_digest, "ROOT", tmp_path)
    assert {path.stem for path in imported_files("fe_likelihoods.a")} == {"a", "b", "d", "e"}


def test_a_module_of_an_editable_installation_has_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(source_digest, "ROOT", tmp_path)  # has no folder data
    files = imported_files("fe_likelihoods.data.ground_motion")
    assert "ground_motion" in {file.stem for file in files}
    assert source_digest.source_digest("fe_likelihoods.data") != source_digest.source_digest()


def test_a_module_without_a_file_has_no_digest():
    with pytest.raises(ValueError, match="source file of the module fe_likelihoods.nothing"):
        source_digest.source_digest("fe_likelihoods.nothing")


OVERRIDDEN = """
class Scaled(LinearOscillator):
    def _respond(self, theta):
        return 1.0 * super()._respond(theta)
def using(model):
    return lambda theta: model.simulate(theta)
"""


def defined(code, **names):
    space = {"__name__": "someones_model", "LinearOscillator": LinearOscillator, **names}
    exec(code, space)
    return space


def test_the_code_of_a_subclass_is_part_of_the_key():
    one, same, two = (defined(OVERRIDDEN.replace("1.0", number))["Scaled"](RECORD) for number in ("1.0", "1.0", "2.0"))
    assert simulation_fingerprint(one) == simulation_fingerprint(same)
    assert len({simulation_fingerprint(model) for model in (one, two, LinearOscillator(RECORD))}) == 3

    using = defined(OVERRIDDEN)["using"]
    assert code_digest(using(one)) == code_digest(using(same))
    assert len({code_digest(using(model)) for model in (one, two, LinearOscillator(RECORD))}) == 3


def test_a_subclass_without_digest_needs_its_own_fingerprint():
    code = OVERRIDDEN.replace("1.0", "file.fileno()").split("def using")[0]
    with pytest.raises(ValueError, match="Scaled: no digest .* define a property `fingerprint`.* uses file"):
        simulation_fingerprint(defined(code, file=sys.stdout)["Scaled"](RECORD))
    code += "    fingerprint = property(lambda self: 'version 1')\n"
    assert simulation_fingerprint(defined(code, file=sys.stdout)["Scaled"](RECORD)).startswith("version 1 ")
