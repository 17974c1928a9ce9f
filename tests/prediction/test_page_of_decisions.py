"""docs/decisions.rst runs as printed and gives the probability of its rare event within the error."""

import re

import numpy as np
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
    # both are estimates, with errors of their logarithms of about this size: three standard errors of their difference
    error = np.sqrt(2.0 * np.log1p(found["rare"].coefficient_of_variation ** 2))
    assert abs(np.log(float(rare) / found["rare"].probability)) < 3.0 * error
