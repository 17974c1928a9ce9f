"""Settings of Sphinx. `make docs` builds the pages of this folder, the API reference and the tutorials.

The reference has one page per public name, generated from the docstrings (``api.rst``, ``_templates``); names in code
font link to it (``building.py``).
Tutorials are executed. Pages and tutorials are written into folders that git ignores: ``docs/api`` and
``docs/tutorials``.
"""

import sys
from importlib import metadata
from pathlib import Path

DOCS = Path(__file__).resolve().parent
sys.path[:0] = [str(DOCS), str(DOCS.parent / "tutorials")]  # `building`, and the modules that tutorials share

import building  # noqa: E402
from numpydoc.xref import DEFAULT_LINKS  # noqa: E402

DEFAULT_LINKS.clear()  # to the sites of Python and NumPy, which a build without a network cannot look up

project = "fe-likelihoods"
author = "fe-likelihoods maintainers"
release = metadata.version("fe-likelihoods")

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",  # a copy of MathJax in the pages: formulas are shown without a network
    "numpydoc",
    "sphinx.ext.viewcode",
    "sphinx_gallery.gen_gallery",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "_templates", "tutorials/*.ipynb", "tutorials/*.json", "tutorials/*.py"]
html_theme = "furo"
html_title = f"fe-likelihoods {release}"
html_show_sphinx = html_show_copyright = False
html_static_path = ["_static"]
html_css_files = ["wide.css"]
default_role = "code"

numpydoc_show_class_members = False  # autodoc shows the members with their docstrings
numpydoc_xref_param_type = True  # types of arguments and results that are public names are links
numpydoc_xref_aliases = building.entries()
numpydoc_xref_ignore = "all"
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings state types with shapes and units
maximum_signature_line_length = 88  # one argument per line where a signature is longer


sphinx_gallery_conf = {
    "examples_dirs": "../tutorials",
    "gallery_dirs": "tutorials",
    "filename_pattern": r"/\d\d_",  # executed
    "ignore_pattern": r"own_program\.py$",
    "within_subsection_order": "FileNameSortKey",
    "capture_repr": (),
    "remove_config_comments": True,
    "download_all_examples": False,
    "write_computation_times": False,
    "show_signature": False,
}


def setup(app):
    app.connect("builder-inited", building.remove_old_pages, priority=400)  # before the pages are written
    app.connect("doctree-read", building.link_names)
    app.connect("autodoc-skip-member", building.skip_fields)
    app.connect("autodoc-process-docstring", building.keep_initials)
