"""The numbers of docs/decisions.rst: its blocks run as printed, and give what the page says within their errors."""

import re

import pytest

from tests.test_readme import ROOT, blocks

PAGE = ROOT / "docs" / "decisions.rst"


def printed(row, text):
    """The numbers of a row of a table."""
    (line,) = re.findall(rf"^   {re.escape(row)}  +(.*)$", text, re.MULTILINE)
    return [float(each) for each in re.findall(r"[\d.]+(?:e-\d+)?", line)]


@pytest.mark.slow
def test_the_page_has_the_numbers_of_its_code(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    for block in blocks(PAGE, "python"):
        exec(block, found)
    text, risk, value = PAGE.read_text(), found["risk"], found["value"]
    for k, name in enumerate(risk.states):
        assert abs(printed(name, text)[0] - risk.rate[k]) < 0.5 * risk.standard_error[k]
    (loss,) = re.findall(r"Expected loss per year: ([\d.]+)", text)
    assert abs(float(loss) - risk.loss) < 0.5 * risk.loss_error
    assert abs(found["annual_loss"](1.0).mean() - risk.loss) < risk.loss_error  # samples one by one, and their mean
    for name, each, error in zip(value.learned, value.value, value.value_error, strict=True):
        assert abs(printed(name, text)[0] - each) <= 0.5 * error
    (perfect,) = re.findall(r"before the decision is worth ([\d.]+)", text)
    assert abs(float(perfect) - value.perfect) < 0.5 * value.perfect_error
    (rare,) = re.findall(r"The probability to exceed 0.09 is ([\d.]+)", text)
    assert abs(float(rare) - found["rare"].probability) < 0.5 * float(rare) * found["rare"].coefficient_of_variation
