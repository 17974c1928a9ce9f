"""Parts of the documentation that are made when it is built: the API pages and the arguments of the tutorials."""

import importlib
import pkgutil
import re
import types
from pathlib import Path

DOCS = Path(__file__).resolve().parent
PACKAGES = ("fe_likelihoods", "samplers")


def tutorial_arguments(gallery_conf: dict, script_vars: dict) -> list[str]:
    """Command line of a tutorial: its results go into the build folder."""
    return ["--out", f"../docs/_build/tutorials/{Path(script_vars['src_file']).stem}"]


def api_page(name: str, modules: list[str]) -> str:
    """Page of a package or folder: its own docstring, then each of its modules under a heading."""
    lines = [name, "=" * len(name), "", f".. automodule:: {name}", "   :no-members:", ""]
    for module in modules:
        title = module.removeprefix(f"{name}.")
        lines += [title, "-" * len(title), "", f".. automodule:: {module}", ""]
    return "\n".join(lines)


def api_pages() -> dict[str, str]:
    """Pages of the API reference, one per folder of the packages: name and text."""
    pages = {}
    for package in PACKAGES:
        folder = importlib.import_module(package).__path__
        inner = [
            m for m in pkgutil.walk_packages(folder, f"{package}.") if not m.name.rpartition(".")[2].startswith("_")
        ]
        for name in [package, *(m.name for m in inner if m.ispkg)]:
            modules = [m.name for m in inner if not m.ispkg and m.name.rpartition(".")[0] == name]
            pages[name] = api_page(name, modules)
    return pages


def write_api_pages(app) -> None:
    """Write the pages into ``docs/api``, unless they are up to date there."""
    folder = DOCS / "api"
    folder.mkdir(exist_ok=True)
    pages = {folder / f"{name}.rst": text for name, text in api_pages().items()}
    for path in folder.glob("*.rst"):
        if path not in pages:
            path.unlink()
    for path, text in pages.items():
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def show_kernels_as_functions(app, env, docnames) -> None:
    """Replace compiled kernels by the Python functions that they are written as, which autodoc can read.

    The tutorials have been executed before this event.
    """
    from numba.core.dispatcher import Dispatcher

    for package in PACKAGES:
        path = importlib.import_module(package).__path__
        for module in pkgutil.walk_packages(path, f"{package}."):
            namespace = vars(importlib.import_module(module.name))
            namespace.update({name: f.py_func for name, f in namespace.items() if isinstance(f, Dispatcher)})


def keep_initials(app, what, name, obj, options, lines) -> None:
    """Escape the initials of authors at the beginning of lines, which are no items of a list."""
    lines[:] = [re.sub(r"^(\.\. \[\S+\] )?([A-Z]\. )", r"\1\\\2", line) for line in lines]


def skip_fields(app, what, name, obj, skip, options):
    """Leave out fields of NamedTuples, which the docstring of their class describes, and aliases of types."""
    return True if type(obj).__name__ == "_tuplegetter" or isinstance(obj, types.GenericAlias) else None
