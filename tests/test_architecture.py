"""Who may import whom, where limits that judge stand, and what no source may contain; violations are listed."""

import ast
import graphlib
import re
from pathlib import Path

import pytest

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
        ("models", "population"),
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
        ("rare_events", "smc"),
        ("tempered",),
        ("results",),
        ("reporting",),
        ("evaluation",),
        ("chain", "tempering"),
        ("judgement",),
        ("presets", "reports"),
        ("estimates", "moves"),
        ("proposals", "record", "settings"),
        ("emcee_names", "finding", "interrupts", "resampling"),
    ),
}

TREES = {path: ast.parse(path.read_text()) for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))}


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


def folder(path: Path) -> str:
    """Entry at the top of the package: its folder, or the module itself."""
    return path.relative_to(ROOT).with_suffix("").parts[1]


def imports(path: Path, tree: ast.Module) -> set[str]:
    """Full names of all imports of a module, also those in functions and under ``TYPE_CHECKING``."""
    package, found = path.relative_to(ROOT).parts[:-1], set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *filter(None, [node.module])])
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return found


IMPORTS = {path: imports(path, tree) for path, tree in TREES.items()}


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_import_only_from_folders_below_them(package):
    """So nothing below imports plots: drawing knows the types, and the types do not know drawing."""
    height = {entry: -line for line, entries in enumerate(ORDER[package]) for entry in entries}
    arrows = {
        (folder(path), imported.split(".")[1])
        for path, names in IMPORTS.items()
        for imported in names
        if name(path).startswith(f"{package}/") and imported.startswith(f"{package}.") and folder(path) != "__init__"
    }
    arrows = {(one, other) for one, other in arrows if other in height and one != other}
    assert {folder(path) for path in TREES if name(path).startswith(f"{package}/")} - {"__init__"} == set(height)
    assert len(arrows) > 20 and not [arrow for arrow in sorted(arrows) if height[arrow[0]] <= height[arrow[1]]]


def test_no_modules_import_each_other_in_a_circle():
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in TREES if path.stem[0] != "_"}
    arrows = {
        module: {known for each in IMPORTS[path] for known in (each, each.rpartition(".")[0]) if known in modules}
        for module, path in modules.items()
    }
    assert sum(map(len, arrows.values())) > 500
    graphlib.TopologicalSorter({module: used - {module} for module, used in arrows.items()}).prepare()
    with pytest.raises(graphlib.CycleError):  # control
        graphlib.TopologicalSorter(arrows | {"fe_likelihoods.units": {"fe_likelihoods.plots.style"}}).prepare()


def test_samplers_import_nothing_of_fe_likelihoods():
    """The other direction is free: likelihoods may use samplers."""
    users = {
        name(path).split("/")[0] for path, names in IMPORTS.items() if any(n.startswith("samplers.") for n in names)
    }
    assert users == set(PACKAGES)
    assert not [
        name(path)
        for path, names in IMPORTS.items()
        if name(path).startswith("samplers/") and any(n.startswith("fe_likelihoods") for n in names)
    ]


def test_sources_cite_only_what_a_reader_has():
    """No file outside the repository; pages of docs/theory that exist."""
    files = [
        *TREES,
        *ROOT.glob("tutorials/*.py"),
        *ROOT.glob("docs/**/*.rst"),
        *ROOT.glob("data/*.*"),
        ROOT / "README.md",
    ]
    for path in files:
        if path.suffix not in (".py", ".rst", ".md"):
            continue
        text = path.read_text()
        assert not re.search(r"specs/|papers/\w+\.(txt|md)|FE_SHARED", text), name(path)
        for page in re.findall(r"docs/theory/(\w+)", text):
            assert (ROOT / "docs" / "theory" / f"{page}.rst").is_file(), f"{name(path)} cites docs/theory/{page}"


CHECKS = ("samplers/judgement/", "fe_likelihoods/checks/")
# limits of effort, settings of a search, of an estimate, and of what is printed: they judge nothing
EFFORT = {"AROUND", "FEWEST", "FEWEST_DRAWS", "FLOOR", "LONGEST_LAG", "MOST_DRAWS", "SAME_UNITS", "SECONDS", "SMOOTH"}
EFFORT |= {"WIDEST"}
MAKERS = {"Finding", "warnings.warn", "logger.warning"}


def called(node: ast.AST) -> set[str]:
    """Functions and classes that are called in a part of a module, as they are written."""
    return {ast.unparse(each.func) for each in ast.walk(node) if isinstance(each, ast.Call)}


def limits_of(tree: ast.Module) -> set[str]:
    """Module-level names of numbers."""
    found = set()
    for node in tree.body:
        numbers = isinstance(node, ast.Assign) and [
            each
            for each in ast.walk(node.value)
            if isinstance(each, ast.Constant) and isinstance(each.value, int | float)
        ]
        if numbers and any(numbers):
            found |= {each.id for target in node.targets for each in ast.walk(target) if isinstance(each, ast.Name)}
    return found


def judged_by_limits(tree: ast.Module) -> list[str]:
    """Conditions on a number of the module under which the module warns or makes a finding."""
    limits = limits_of(tree)
    return [
        ast.unparse(node.test)
        for node in ast.walk(tree)
        if isinstance(node, ast.If)
        and {each.id for each in ast.walk(node.test) if isinstance(each, ast.Name)} & limits
        and any(called(statement) & MAKERS for statement in node.body)
    ]


def test_findings_are_made_in_checks_and_judgement_alone():
    """Other modules return numbers; they may ask the checks, keep findings, show them and warn of them."""
    makers = {name(path) for path, tree in TREES.items() if "Finding" in called(tree)}
    makers.remove("samplers/chain.py")  # reads stored findings
    assert not [path for path in makers if not path.startswith(CHECKS)]
    assert len(makers) > 8  # control


def test_limits_that_judge_are_in_checks_and_judgement_alone():
    """No other module of a result warns where a number of its own is exceeded; caches and processes may."""
    control = ast.parse("LIMIT = 0.5\ndef f(x):\n    if x > LIMIT:\n        warnings.warn('large')\n")
    assert judged_by_limits(control) == ["x > LIMIT"]
    for path, tree in TREES.items():
        if not name(path).startswith(CHECKS) and folder(path) not in ("cache", "simulation"):
            assert not judged_by_limits(tree), name(path)


def test_the_limits_of_the_checks_are_few_and_have_a_source():
    """At most 40, each with a comment beside it or above; most recognise sensors and modes."""
    count = 0
    for path in sorted((ROOT / "fe_likelihoods" / "checks").glob("*.py")):
        lines = path.read_text().splitlines()
        for node in TREES[path].body:
            found = limits_of(ast.Module([node], []))
            above = lines[max(node.lineno - 4, 0) : node.lineno - 1]
            said = "#" in lines[node.lineno - 1] or any(line.startswith("#") for line in above)
            assert said or not found, f"{name(path)}: {found} without a source"
            count += len(found - EFFORT)
    assert 10 < count <= 40
