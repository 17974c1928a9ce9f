"""The reference lists every public name once, each has an example, and the examples of all docstrings run as printed.

Examples run in this process, with NumPy, all public names and the objects of ``docs/examples.py``. Output that an
example does not show is a fault, except where ``...`` stands for it. With the comment ``doctest: +SAMPLED``, which the
pages do not show, numbers may differ by 30 %: they depend on random draws.
"""

import doctest
import importlib
import re
import runpy
from pathlib import Path

import pytest

import fe_likelihoods
import samplers

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = (fe_likelihoods, samplers)
REFERENCE = re.findall(r"^   ~((?:fe_likelihoods|samplers)[\w.]+)$", (ROOT / "docs/api.rst").read_text(), re.MULTILINE)
SAMPLED = doctest.register_optionflag("SAMPLED")
OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
NUMBER = re.compile(r"(\d+\.?\d*(?:e[-+]?\d+)?)")
SLOW = {"fe_likelihoods.reporting.report"}


def module_name(path: Path) -> str:
    """Import path of a module."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = [
    pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW), id=name)
    for package in PACKAGES
    for path in sorted(Path(package.__file__).parent.rglob("*.py"))
    for name in [module_name(path)]
    if ">>> " in path.read_text()
]


class Checker(doctest.OutputChecker):
    """Compares the words, and the numbers of samples with a tolerance."""

    def check_output(self, want: str, got: str, optionflags: int) -> bool:
        """Whether an example printed what it shows."""
        if not optionflags & SAMPLED:
            return super().check_output(want, got, optionflags)
        wanted, found = (map(float, NUMBER.findall(text)) for text in (want, got))
        words, seen = ("".join(NUMBER.sub("#", text).split()) for text in (want, got))
        return words == seen and all(
            abs(a - b) <= 0.3 * max(abs(a), abs(b)) for a, b in zip(wanted, found, strict=True)
        )


@pytest.fixture(scope="module")
def given() -> dict:
    """Names that the examples use."""
    public = {name: getattr(package, name) for package in PACKAGES for name in package.__all__}
    return runpy.run_path(str(ROOT / "docs/examples.py")) | public


@pytest.mark.filterwarnings("error::UserWarning")  # an example shows how it is done right
@pytest.mark.parametrize("name", MODULES)
def test_examples_run_as_printed(name, given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runner = doctest.DocTestRunner(Checker(), verbose=False, optionflags=OPTIONS)
    printed = []
    module = importlib.import_module(name)
    for test in doctest.DocTestFinder().find(module, globs=vars(module) | given):
        runner.run(test, out=printed.append)
    assert not runner.summarize(verbose=False).failed, "".join(printed)


def test_every_public_name_is_in_the_reference_once_and_has_an_example():
    public = {f"{package.__name__}.{name}" for package in PACKAGES for name in package.__all__}
    assert len(set(REFERENCE)) == len(REFERENCE) and public <= set(REFERENCE)
    names = [path.rpartition(".")[2] for path in REFERENCE]
    assert len(set(names)) == len(names), "a link in the guide would be ambiguous"
    for path in REFERENCE:
        module, _, name = path.rpartition(".")
        documented = getattr(importlib.import_module(module), name)
        assert documented.__doc__ and (path not in public or ">>> " in documented.__doc__), path
