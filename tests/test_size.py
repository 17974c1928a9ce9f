"""The counts of `tests.size`, on a package of a few lines."""

from dataclasses import dataclass, field

from tests import prose, size

SOURCE = '''"""Sum of the squares of that of one and of another."""

# a comment
def add(a, b):
    """Those of
    both."""

    text = """not
    a docstring"""
    return a + b  # counted
'''


def test_lines_and_prose(tmp_path, monkeypatch):
    monkeypatch.setattr(size, "ROOT", tmp_path)
    (tmp_path / "small").mkdir()
    (tmp_path / "small" / "add.py").write_text(SOURCE)
    (tmp_path / "small" / "empty.py").write_text("")
    assert size.lines_of("small") == (2, 10, 4)
    found = prose.count(tmp_path / "small")
    assert found == (14, 2000 / 14, 1000 / 14)
    first, second, last = prose.phrases(tmp_path / "small")
    assert all("add.py:1: " in line for line in (first, second)) and "add.py:5: ... Those of" in last


def test_the_lint_of_docstrings_can_fail(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(prose, "ROOT", tmp_path)
    for package in prose.PACKAGES:
        (tmp_path / package).mkdir()
        (tmp_path / package / "good.py").write_text('"""Sensor noise in channels."""')
    assert prose.main([]) == 0
    (tmp_path / "samplers" / "bad.py").write_text('"""The noise is that of the sensor."""')
    assert prose.main([]) == 1 and "repeat the noun" in capsys.readouterr().out


def test_nested_settings_count_by_their_fields():
    @dataclass(frozen=True)
    class Inner:
        a: int = 1
        b: int = 2

    @dataclass(frozen=True)
    class Outer:
        c: int = 3
        inner: Inner = field(default_factory=Inner)

    assert size.count_fields(Outer) == 3


def test_the_stack_begins_at_run_mcmc():
    def function():
        return size.stack_to("run_mcmc")

    def step():
        return note()

    def note():
        return function()

    def run_mcmc():
        return step()

    assert len(run_mcmc()) == 3
