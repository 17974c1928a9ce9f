"""Whatever an object of a user holds is digested by its value, or carries none, or is refused with advice."""

import copyreg
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from fe_likelihoods import Channel, FunctionModel
from fe_likelihoods.simulation.code_digest import code_digest, describe_code

from . import held_values
from .held_values import REFUSED, VALUES, WITHOUT_VALUE, Holder

CHANNELS = (Channel("a", "displacement", "m"),)
ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def pandas_if_needed(request):
    if request.node.name.partition("[")[2].rstrip("]") in ("DataFrame", "Series", "Index"):
        pytest.importorskip("pandas", reason="NO PANDAS: install it to test its objects")


@pytest.mark.parametrize("make", VALUES.values(), ids=VALUES)
def test_a_value_is_part_of_the_digest(make):
    one, same, other = (code_digest(Holder(make(k))) for k in (1, 1, 2))
    assert one == same != other


@pytest.mark.parametrize("make", WITHOUT_VALUE.values(), ids=WITHOUT_VALUE)
def test_what_carries_no_value_is_no_obstacle(make):
    assert code_digest(Holder(make(1))) == code_digest(Holder(make(2)))


@pytest.mark.parametrize("make", REFUSED.values(), ids=REFUSED)
def test_a_refusal_says_what_to_do(make):
    with (
        pytest.raises(ValueError, match="give version=, a text .* no digest can be made of"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", ResourceWarning)
        FunctionModel(Holder(make(1)), ("x",), CHANNELS, 0.1, 5)


def test_digests_are_the_same_in_every_process():
    pytest.importorskip("pandas", reason="NO PANDAS: install it to test its objects")
    environment = os.environ | {"PYTHONHASHSEED": "7"}
    command = [sys.executable, "-m", "tests.simulation.held_values"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, check=True)
    here, there = held_values.digests(), json.loads(result.stdout)
    assert [name for name in here if here[name] != there[name]] == []


def test_another_form_of_an_exception_for_pickle_changes_no_digest(monkeypatch):
    before = code_digest(Holder(VALUES["exception"](1)))
    monkeypatch.setitem(copyreg.dispatch_table, ValueError, lambda error: (str, ("another form",)))
    assert code_digest(Holder(VALUES["exception"](1))) == before


def test_use_changes_no_digest():
    """Some objects of other packages compute attributes when they are used first."""
    matrix = VALUES["csr_matrix"](1)
    before = code_digest(Holder(matrix))
    assert matrix.has_sorted_indices and matrix.has_canonical_format
    assert code_digest(Holder(matrix)) == before
    if "pandas" in sys.modules:
        table = held_values.frame(1)
        before = code_digest(Holder(table))
        table["a"], table.iloc[0], table.index.is_unique
        assert code_digest(Holder(table)) == before


@pytest.mark.parametrize("name", ["Generator", "RandomState", "Random", "count", "iterator"])
def test_what_every_use_changes_is_left_out_of_the_steady_digest(name):
    one, other = (describe_code(Holder(VALUES[name](k))) for k in (1, 2))
    assert one.steady == other.steady and one.digest != other.digest
    assert describe_code(Holder(np.arange(1))).steady != describe_code(Holder(np.arange(2))).steady
