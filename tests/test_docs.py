"""Tutorials and figures have the form that the documentation needs. (`make docs` builds it; warnings are errors.)"""

import ast
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SCRIPTS = sorted((ROOT / "tutorials").glob("[0-9]*.py"))


def test_tutorials_have_the_form_of_the_gallery():
    """A docstring with a title, text in comment cells: sphinx-gallery renders these with their output."""
    for script in SCRIPTS:
        title, underline = ast.get_docstring(ast.parse(script.read_text())).splitlines()[:2]
        assert set(underline) == {"="} and len(underline) >= len(title), script.name
        assert "[markdown]" not in script.read_text(), script.name


def test_figures_are_small():
    for figure in (DOCS / "figures").glob("*.png"):
        assert figure.stat().st_size < 150 * 1024, f"{figure.name}: make figures keeps them small"
