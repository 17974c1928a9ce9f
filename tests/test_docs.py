"""The documentation covers every folder, page, module and tutorial. (`make docs` builds it; warnings are errors.)"""

import ast
import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SCRIPTS = sorted((ROOT / "tutorials").glob("[0-9]*.py"))


def toctree(page: Path) -> list[str]:
    """Entries of the toctrees of a page."""
    blocks = re.findall(r"\.\. toctree::\n(?:   :.*\n)*\n((?:   \S+\n)+)", page.read_text())
    return [entry for block in blocks for entry in block.split()]


def test_api_lists_every_folder_of_both_packages():
    folders = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for package in ("fe_likelihoods", "samplers")
        for path in (ROOT / package).rglob("__init__.py")
    }
    assert {entry.removeprefix("api/") for entry in toctree(DOCS / "api.rst")} == folders


def test_api_pages_have_every_module(tmp_path):
    spec = importlib.util.spec_from_file_location("building", DOCS / "building.py")
    building = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(building)
    documented = set(re.findall(r"automodule:: (\S+)", "".join(building.api_pages().values())))
    modules = {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for package in building.PACKAGES
        for path in (ROOT / package).rglob("*.py")
    }
    assert documented == {name for name in modules if not name.rpartition(".")[2].startswith("_")}


def test_tutorials_have_the_form_of_the_gallery():
    """A docstring with a title, text in comment cells: sphinx-gallery renders these with their output."""
    for script in SCRIPTS:
        title, underline = ast.get_docstring(ast.parse(script.read_text())).splitlines()[:2]
        assert set(underline) == {"="} and len(underline) >= len(title), script.name
        assert "[markdown]" not in script.read_text(), script.name


def test_figures_are_small():
    for figure in (DOCS / "figures").glob("*.png"):
        assert figure.stat().st_size < 150 * 1024, f"{figure.name}: make figures keeps them small"
