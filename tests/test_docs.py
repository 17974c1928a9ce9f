"""The documentation has every public module, and no page of it names what is not there. (`make docs` builds it.)"""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted((ROOT / "docs").rglob("*.rst"))
INNER = {  # modules that serve one of those that are documented
    "fe_likelihoods": {"minder", "memory", "moments", "gathering", "cache_file", "cache_rows", "readers"},
    "fe_likelihoods.models": {"inputs", "threads", "code_digest"},
    "fe_likelihoods.kernels": {"linear_solve"},
    "samplers": {
        *("climb", "edges", "evaluation", "families", "fast_sweeps", "journal", "mutation"),
        *("resume", "settings", "shears"),
    },
}


def modules() -> set[str]:
    paths = [path for package in ("fe_likelihoods", "samplers") for path in (ROOT / package).rglob("*.py")]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts) for path in paths if path.stem != "__init__"}


def test_every_module_is_on_a_page_or_an_inner_one():
    documented = set(re.findall(r"automodule:: ([\w.]+)", "".join(page.read_text() for page in PAGES)))
    inner = {f"{package}.{name}" for package, names in INNER.items() for name in names}
    assert documented | inner >= modules(), f"not in docs/api: {modules() - documented - inner}"
    assert documented <= modules(), f"gone, but in docs/api: {documented - modules()}"
    assert inner <= modules(), f"gone, but in this test: {inner - modules()}"


def test_pages_name_tutorials_and_pictures_that_are_there():
    for page in PAGES:
        text = page.read_text()
        for name in re.findall(r"(?:literalinclude|figure):: (\S+)", text):
            assert (page.parent / name).is_file(), f"{page.name} names {name}"
    tutorials = {path.name for path in (ROOT / "tutorials").glob("[0-9]*.py")}
    assert tutorials == set(re.findall(r"tutorials/(\d\w+\.py)", (ROOT / "docs" / "tutorials.rst").read_text()))
    for picture in (ROOT / "docs" / "figures").glob("*.png"):
        assert picture.stat().st_size < 150 * 1024, f"{picture.name}: make figures keeps them small"
