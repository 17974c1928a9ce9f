"""Parts of the documentation that are made when it is built: links to the reference."""

import importlib
import re
import types
from functools import cache
from pathlib import Path

from docutils import nodes
from sphinx import addnodes
from sphinx.pycode import ModuleAnalyzer

DOCS = Path(__file__).resolve().parent
ENTRY = re.compile(r"^   ~?((?:fe_likelihoods|samplers)[\w.]+)$", re.MULTILINE)
AMBIGUOUS = ("report", "summary")  # alone, also a command and functions of others
# what the guide calls objects of these classes
INSTANCES = {
    "hierarchy": "fe_likelihoods.Hierarchy",
    "likelihood": "fe_likelihoods.FELikelihood",
    "measurements": "fe_likelihoods.Measurements",
    "posterior": "fe_likelihoods.Posterior",
    "prediction": "fe_likelihoods.prediction.prediction.Prediction",
    "prior": "fe_likelihoods.Prior",
    "record": "fe_likelihoods.Record",
    "sampler": "samplers.SMCSampler",
}


@cache
def entries() -> dict[str, str]:
    """Path of every object that has a page in the reference (``api.rst``), by its name."""
    paths = ENTRY.findall((DOCS / "api.rst").read_text())
    return {path.rpartition(".")[2]: path for path in paths}


def load(path: str):
    """The object with an import path, such as ``fe_likelihoods.Record``."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def target_of(text: str) -> str | None:
    """Path of the object that code in a text names: ``Record``, ``Record.trim``, ``propagate(...)``; else None."""
    found = re.fullmatch(r"([A-Za-z_][\w.]*)(\(.*\))?", text, re.DOTALL)
    if not found:
        return None
    *owner, name = found[1].split(".")
    if not owner and name in AMBIGUOUS and found[2] in (None, "()"):
        return None
    if name in entries() and (not owner or owner[0] in ("fe_likelihoods", "samplers")):
        return entries()[name]
    owner = owner[-1] if owner else ""
    path = entries().get(owner) or INSTANCES.get(owner)
    if path is None or not hasattr(load(path), name) or getattr(load(path), name).__doc__ is None:
        return None
    return f"{path}.{name}"


def link_names(app, doctree) -> None:
    """Make a link of each public name in code font, but not of arguments of the object that a docstring describes."""
    for literal in list(doctree.findall(nodes.literal)):
        target, above, arguments = target_of(literal.astext()), literal.parent, set()
        while above is not None and target:
            if isinstance(above, nodes.reference | addnodes.pending_xref | nodes.title):
                target = None
            if isinstance(above, addnodes.desc):
                arguments |= {each.astext().split("=")[0] for each in above[0].findall(addnodes.desc_parameter)}
            above = above.parent
        if target and literal.astext() not in arguments:
            link = addnodes.pending_xref("", refdomain="py", reftype="obj", reftarget=target, refwarn=False)
            literal.replace_self(link)
            link += literal


def remove_old_pages(app) -> None:
    """Remove pages of an earlier build whose object is no longer in the reference: Sphinx would build them."""
    for page in (DOCS / "api").glob("*.rst"):
        if page.stem not in entries().values():
            page.unlink()


def keep_initials(app, what, name, obj, options, lines) -> None:
    """Escape the initials of authors at the beginning of lines, which are no items of a list."""
    lines[:] = [re.sub(r"^(\.\. \[\S+\] )?([A-Z]\. )", r"\1\\\2", line) for line in lines]


COMMENTED = ("estimates.importance", "judgement.clusters", "rare_events", "reports", "tempering.guide")


@cache
def commented_fields() -> list:
    """Fields of NamedTuples that have a comment of their own."""
    modules = [importlib.import_module(f"samplers.{name}") for name in COMMENTED]
    return [
        vars(vars(module)[owner]).get(name)
        for module in modules
        for owner, name in ModuleAnalyzer.for_module(module.__name__).find_attr_docs()
        if owner
    ]


def skip_fields(app, what, name, obj, skip, options):
    """Leave out aliases of types, and fields of NamedTuples that the docstring of their class describes."""
    is_field = type(obj).__name__ == "_tuplegetter" and all(obj is not each for each in commented_fields())
    return True if is_field or isinstance(obj, types.GenericAlias) else None
