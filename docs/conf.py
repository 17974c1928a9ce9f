"""Settings of Sphinx: the pages of this folder, and the API from the docstrings. `make docs` builds them."""

import os
import re
from importlib import metadata

os.environ["NUMBA_DISABLE_JIT"] = "1"  # kernels as the plain functions that they are written as

project = "fe-likelihoods"
author = "fe-likelihoods maintainers"
release = metadata.version("fe-likelihoods")

extensions = ["sphinx.ext.autodoc", "numpydoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]
html_theme = "furo"
html_title = f"fe-likelihoods {release}"
html_show_sphinx = False
default_role = "code"

numpydoc_show_class_members = False  # autodoc shows them, with their docstrings
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and units stand in the docstrings; hints would say "ndarray" again
autodoc_default_options = {"members": True, "show-inheritance": True}

_ONE_LINE = re.compile(r"^( *)(\S[^—]* : [^—]*\S) — (.*)$")
_STAR = re.compile(r"(?<=[(, ])\*(?=\w)")


def read_as_numpydoc(app, what, name, obj, options, lines):
    """Parameters that fit on a line, ``name : type — meaning``, as numpydoc's two; ``*shape`` is Python's star."""
    rewritten = []
    for line in lines:
        line = _STAR.sub(r"\\*", line)
        match = _ONE_LINE.match(line)
        rewritten += [f"{match[1]}{match[2]}", f"{match[1]}    {match[3]}"] if match else [line]
    lines[:] = rewritten


def leave_out(app, what, name, obj, skip, options):
    """Fields of NamedTuples, which stand in the docstring of the class and have none of their own."""
    return True if type(obj).__name__ == "_tuplegetter" else None


def setup(app):
    app.connect("autodoc-process-docstring", read_as_numpydoc, priority=100)  # before numpydoc
    app.connect("autodoc-skip-member", leave_out)
