"""Imports within the two packages, read from their source: for `tests.test_architecture`.

A node of a graph is an entry at the top of a package, a folder or a module. Every import counts: at the top of a
module, inside a function, and under ``TYPE_CHECKING``.
"""

import ast
import functools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

__all__ = [
    "ORDER",
    "PACKAGES",
    "ROOT",
    "Graph",
    "Import",
    "imports",
    "module_cycles",
    "modules",
    "package_graph",
    "second_defaults",
    "tree_of",
]

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("fe_likelihoods", "samplers")
# from the top down: an entry imports only from entries on lines below its own
ORDER = {
    "fe_likelihoods": (
        ("__main__",),
        ("command",),
        ("reporting",),
        ("problems",),
        ("adapters",),
        ("plots",),
        ("column_damage", "information"),
        ("prediction",),
        ("modal",),
        ("events", "models"),
        ("checks",),
        ("likelihood",),
        ("emulation",),
        ("cache",),
        ("simulation",),
        ("noise",),
        ("priors", "signals"),
        ("kernels",),
        ("text_tables", "units"),
    ),
    "samplers": (
        ("cost",),
        ("rare_events", "smc", "tmcmc"),
        ("tempered",),
        ("results",),
        ("reporting",),
        ("evaluation", "replay"),
        ("output", "tempering"),
        ("judgement", "output_file"),
        ("presets", "reports"),
        ("budget", "estimates", "moves"),
        ("proposals", "record", "settings"),
        ("blobs", "emcee_internals", "finding", "interrupts", "resampling"),
    ),
}


class Import(NamedTuple):
    """Full name of an import, and whether it is neither inside a function nor under ``TYPE_CHECKING``."""

    name: str
    at_top: bool


class Graph(NamedTuple):
    """The imports between the entries of a package: pairs of an entry and one that it imports from, and circles."""

    nodes: tuple[str, ...]
    edges: set[tuple[str, str]]
    cycles: list[tuple[str, ...]]


@functools.cache
def _parse(source: str) -> ast.Module:
    return ast.parse(source)


def tree_of(path: Path) -> ast.Module:
    """Syntax tree of a module; equal sources are parsed once."""
    return _parse(path.read_text())


def modules(root: Path = ROOT, package: str | None = None) -> list[Path]:
    """Source files of one package, or of both."""
    return sorted(p for name in ([package] if package else PACKAGES) for p in (root / name).rglob("*.py"))


def imports(path: Path, root: Path = ROOT) -> list[Import]:
    """Every import of a module, relative ones resolved."""
    return list(_imports_of(path.read_text(), path.relative_to(root).with_suffix("").parts[:-1]))


@functools.cache
def _imports_of(source: str, package: tuple[str, ...]) -> tuple[Import, ...]:
    tree = _parse(source)
    guards = [node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"]
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    for_types = {node for block in guards for node in ast.walk(block)}
    late = for_types | {node for block in functions for node in ast.walk(block)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            names = [f"{module}.{alias.name}" for alias in node.names]
        else:
            continue
        found += [Import(name, node not in late) for name in names]
    return tuple(found)


def _strong_components(nodes: list[str], edges: set[tuple[str, str]]) -> list[tuple[str, ...]]:
    """Groups of two or more nodes that reach each other."""
    index = {node: i for i, node in enumerate(nodes)}
    matrix = np.zeros((len(nodes), len(nodes)), dtype=int)
    for a, b in edges:
        matrix[index[a], index[b]] = 1
    _, label = connected_components(csr_array(matrix), connection="strong")
    groups = [tuple(node for node in nodes if label[index[node]] == k) for k in range(label.max() + 1)]
    return [group for group in groups if len(group) > 1]


def package_graph(package: str, root: Path = ROOT) -> Graph:
    """Imports between the folders and modules at the top of a package; the package's own ``__init__`` is left out."""
    edges, nodes = set(), set()
    for path in modules(root, package):
        parts = path.relative_to(root / package).with_suffix("").parts
        if parts == ("__init__",):
            continue
        nodes.add(parts[0])
        for imported in imports(path, root):
            names = imported.name.split(".")
            if names[0] == package and len(names) > 1 and names[1] != parts[0]:
                edges.add((parts[0], names[1]))
    edges = {(a, b) for a, b in edges if b in nodes}
    return Graph(tuple(sorted(nodes)), edges, _strong_components(sorted(nodes), edges))


def module_cycles(root: Path = ROOT) -> list[tuple[str, ...]]:
    """Groups of modules of either package that import each other."""
    names = {".".join(path.relative_to(root).with_suffix("").parts): path for path in modules(root)}
    names = {name: path for name, path in names.items() if not name.endswith("__init__")}
    edges = set()
    for name, path in names.items():
        for imported in imports(path, root):
            target = imported.name if imported.name in names else imported.name.rpartition(".")[0]
            if target in names and target != name:
                edges.add((name, target))
    return _strong_components(sorted(names), edges)


def second_defaults(root: Path = ROOT) -> dict[str, list[str]]:
    """Settings of the samplers whose default is written in more than one class, and those classes.

    A setting is a field of a class whose name ends with "Settings"; a default is that of a field or of a keyword of a
    constructor.
    """
    places: dict[str, list[str]] = {}
    settings = set()
    for path in modules(root, "samplers"):
        for cls in ast.walk(tree_of(path)):
            if not isinstance(cls, ast.ClassDef):
                continue
            for node in cls.body:
                names = []
                if isinstance(node, ast.AnnAssign) and node.value is not None:
                    names = [ast.unparse(node.target)]
                    settings |= set(names) if cls.name.endswith("Settings") else set()
                elif isinstance(node, ast.FunctionDef) and node.name == "__init__":
                    pairs = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
                    names = [
                        argument.arg
                        for argument, default in pairs
                        if default is not None and ast.unparse(default) != "None"
                    ]
                for name in names:
                    places.setdefault(name, []).append(cls.name)
    return {name: places[name] for name in sorted(settings) if len(places[name]) > 1}
