"""docs/decisions.rst runs as printed and gives the probability of its rare event within the error."""

import re

import pytest

from tests.test_readme import ROOT, blocks

PAGE = ROOT / "docs" / "decisions.rst"


@pytest.mark.slow
def test_the_page_has_the_probability_of_its_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    for block in blocks(PAGE, "python"):
        exec(block, found)
    text = PAGE.read_text()
    (rare,) = re.findall(r"The probability to exceed 0.09 is ([\d.]+)", text)
    assert abs(float(rare) - found["rare"].probability) < 0.5 * float(rare) * found["rare"].coefficient_of_variation
