"""The counts of `tests.size`, on a package of a few lines."""

from dataclasses import dataclass, field

from tests import size

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
    words, pronouns, chains = size.prose_of("small")
    assert words == 14
    assert pronouns == 2000 / 14
    assert chains == 3000 / 14


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
